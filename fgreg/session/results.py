"""``result.yaml``: written whole or not at all, read back with every field checked.

Transforms are rounded to 1e-9 in rotation and 1e-6 mm in translation, so that rotations stay rigid to 1e-8; angles
and lengths to 1e-6; covariances to ten digits; times not at all. A figure that is not finite is written as ``null``.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import secrets
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from fgreg.errors import InputError
from fgreg.estimate import (
    EpochEstimate,
    LaserEstimate,
    PairEstimate,
    PredictedTre,
    Quantiles,
    SessionEstimate,
    Timing,
    TrackEstimate,
    Verdict,
)
from fgreg.frames import FloatArray
from fgreg.models import SessionModel
from fgreg.session.safe_yaml import load_yaml
from fgreg.session.schema import FINITE, Bounds, Fields, Place, as_rigid, shown, transform_problem

RESULT_FILE = "result.yaml"
RESULT_FORMAT = "fgreg-result/1"

_SESSION_FILES = frozenset({"session.yaml", "events.jsonl", "ground_truth.yaml"})
_MAX_BYTES = 256_000_000
_MAX_NODES = 20_000_000
_SECONDS = Bounds(unit="s")
_FIGURE = Bounds(0.0, FINITE.high)
_ANY_LENGTH = math.inf  # a best estimate of a refused session may be anywhere
_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_NOT_PLAIN = frozenset({"null", "true", "false", "yes", "no", "on", "off", "y", "n"})

_TOP = ("format", "fgreg", "session", "verdict", "reasons", "laser", "epochs", "pairs", "tracks", "timing_ms")
_EPOCH = ("index", "start_s", "trus_T_camera", "covariance", "pairs", "verdict", "predicted_tre_mm")
_PAIR = (
    "pm",
    "epoch",
    "used",
    "reason",
    "lambda_mm",
    "theta_deg",
    "rotation_deg",
    "trus_p_pm_mm",
    "covariance",
    "residual_mm",
    "nis",
)
_QUANTILES = ("p50", "p99", "max")
_TRACK = ("t", "stage_deg", "sigma_deg", "lambda_mm", "causal", "reason")


_FORMAT_LINE = b"format: fgreg-result/"
RESULT_NAME = "result.yaml"


def remove_result(path: Path) -> None:
    """Removes an older result before work starts, so that no failure leaves one behind.

    Raises:
        InputError: the folder is absent or cannot be written to, or the path is anything but an older result.
    """
    if path.name in _SESSION_FILES:
        raise InputError(str(path), "the name of a session's own file", "another name for the result")
    if not path.parent.is_dir():
        raise InputError(str(path.parent), "no such folder", f"a folder to write {path.name} to")
    if path.is_dir() and not path.is_symlink():
        raise InputError(str(path), "a folder", "a file name for the result")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(str(path.parent), "a folder that cannot be written to", f"one to write {path.name} to")
    try:
        if os.path.lexists(path) and not _is_result(path):
            raise InputError(str(path), "a file that is no result", "a new name, or that of an older result")
        path.unlink(missing_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(str(path), f"a file that cannot be removed ({_reason(error)})", "an older result") from None


def _is_result(path: Path) -> bool:
    """Whether a file is a result, by its name in a session's folder or by its first line: nothing else is removed."""
    if path.is_symlink() or not path.is_file():
        return False
    if path.name == RESULT_NAME:
        return True
    with path.open("rb") as file:
        return file.read(len(_FORMAT_LINE)) == _FORMAT_LINE


def write_result(estimate: SessionEstimate, model: SessionModel, path: Path, version: str) -> None:
    """Writes a result: to a temporary file beside it first, which then takes its name.

    Args:
        estimate: the answer.
        model: of the session; gives it its name.
        path: the file, replaced where it exists.
        version: of this package.

    Raises:
        InputError: the file cannot be written.
        ValueError: a transform of the estimate is not rigid, or an array not finite (a defect of the estimate).
    """
    text = "\n".join(_document(estimate, model.name, version)) + "\n"
    temporary = path.with_name(f".{path.name[:100]}.{secrets.token_hex(8)}.tmp")
    try:
        try:
            with temporary.open("x", encoding="utf-8", newline="\n") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        _sync_folder(path.parent)
    except OSError as error:
        raise InputError(str(path), f"a file that cannot be written ({_reason(error)})", "a writable place") from None


def _sync_folder(folder: Path) -> None:
    """Makes a rename last through a loss of power; some file systems cannot, and that is no failure."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _reason(error: OSError | ValueError) -> str:
    return getattr(error, "strerror", None) or str(error)


# Writing


def _document(estimate: SessionEstimate, session: str, version: str) -> Iterable[str]:
    yield f"format: {RESULT_FORMAT}"
    yield f"fgreg: {_text(version)}"
    yield f"session: {_text(session)}"
    yield f"verdict: {estimate.verdict}"
    yield from _block("reasons", [f"  - {_text(reason, quote=True)}" for reason in estimate.reasons])
    if estimate.laser is None:
        yield "laser: null"
    else:
        yield "laser:"
        yield from _transform("  marker_T_laser", estimate.laser.marker_T_laser)
        yield from _matrix("  covariance", estimate.laser.covariance)
    yield from _block("epochs", [line for epoch in estimate.epochs for line in _epoch(epoch)])
    yield from _block("pairs", [f"  - {{{_pair(pair)}}}" for pair in estimate.pairs])
    yield from _block("tracks", [f"  - {{{_track(track)}}}" for track in estimate.tracks])
    if estimate.timing is not None:
        yield "timing_ms:"
        yield f"  add: {_quantiles(estimate.timing.add)}"
        yield f"  track: {_quantiles(estimate.timing.track)}"


def _block(key: str, lines: list[str]) -> Iterable[str]:
    yield f"{key}:" if lines else f"{key}: []"
    yield from lines


def _epoch(epoch: EpochEstimate) -> Iterable[str]:
    yield f"  - index: {epoch.index}"
    yield f"    start_s: {_exact(epoch.start_s)}"
    yield from _transform("    trus_T_camera", epoch.trus_T_camera)
    yield from _matrix("    covariance", epoch.covariance)
    yield f"    pairs: {epoch.pairs}"
    yield f"    verdict: {epoch.verdict}"
    tre = epoch.predicted_tre
    if tre is None:
        yield "    predicted_tre_mm: null"
    else:
        figures = (tre.mean_mm, tre.p95_mm, tre.worst_mm)
        mean, p95, worst = (_rounded(value) for value in figures)
        yield f"    predicted_tre_mm: {{mean: {mean}, p95: {p95}, worst: {worst}}}"


def _pair(pair: PairEstimate) -> str:
    parts = [f"pm: {pair.pm}", f"epoch: {pair.epoch}", f"used: {_truth(pair.used)}"]
    figures = [
        ("lambda_mm", pair.lambda_mm),
        ("theta_deg", _degrees(pair.theta_rad)),
        ("rotation_deg", _degrees(pair.rotation_rad)),
        ("trus_p_pm_mm", pair.trus_p_pm_mm),
        ("covariance", pair.covariance),
        ("residual_mm", pair.residual_mm),
        ("nis", pair.nis),
    ]
    for key, value in figures:
        if value is None and not pair.used:
            continue  # a look that was left out has what is known of it, mostly nothing
        if isinstance(value, np.ndarray):
            _require_finite(key, value)
            if value.ndim == 1:
                parts.append(f"{key}: [{', '.join(_rounded(v) for v in value)}]")
            else:
                parts.append(f"{key}: [{', '.join(_row(row) for row in value)}]")
        else:
            parts.append(f"{key}: {_rounded(value)}")
    if pair.reason:
        parts.append(f"reason: {_text(pair.reason, quote=True)}")
    return ", ".join(parts)


def _track(track: TrackEstimate) -> str:
    parts = [
        f"t: {_exact(track.t)}",
        f"stage_deg: {_rounded(_degrees(track.stage_rad))}",
        f"sigma_deg: {_rounded(_degrees(track.sigma_rad))}",
        f"lambda_mm: {_rounded(track.lambda_mm)}",
        f"causal: {_truth(track.causal)}",
    ]
    if track.reason:
        parts.append(f"reason: {_text(track.reason, quote=True)}")
    return ", ".join(parts)


def _quantiles(found: Quantiles | None) -> str:
    if found is None:
        return "null"
    return f"{{p50: {_rounded(found.p50)}, p99: {_rounded(found.p99)}, max: {_rounded(found.max)}}}"


def _transform(key: str, transform: FloatArray | None) -> Iterable[str]:
    if transform is None:
        yield f"{key}: null"
        return
    _require_finite(key, transform)
    problem = transform_problem(transform)
    if problem is not None:
        raise ValueError(f"{key.strip()} is {problem[0]}")
    indent = " " * (len(key) - len(key.lstrip()) + 2)
    yield f"{key}:"
    for row in as_rigid(transform):
        yield f"{indent}- [{', '.join([*(_rounded(v, 9) for v in row[:3]), _rounded(row[3])])}]"


def _matrix(key: str, matrix: FloatArray | None) -> Iterable[str]:
    if matrix is None:
        yield f"{key}: null"
        return
    _require_finite(key, matrix)
    indent = " " * (len(key) - len(key.lstrip()) + 2)
    yield f"{key}:"
    for row in matrix:
        yield f"{indent}- {_row(row)}"


def _row(row: FloatArray) -> str:
    return "[" + ", ".join(_yaml_float(f"{v:.10g}") for v in row) + "]"


def _require_finite(key: str, array: FloatArray) -> None:
    if not np.isfinite(array).all():
        raise ValueError(f"{key.strip()} has an entry that is not finite")


def _degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else math.degrees(angle_rad)


def _rounded(value: float | None, decimals: int = 6) -> str:
    if value is None or not math.isfinite(value):
        return "null"
    return _yaml_float(repr(round(float(value), decimals) + 0.0))  # + 0.0: no -0.0


def _exact(value: float) -> str:
    return _yaml_float(repr(float(value)))


def _yaml_float(text: str) -> str:
    """A float's text as every YAML reader takes for a float: with a dot, and a sign in the exponent."""
    mantissa, exponent, power = text.partition("e")
    if "." not in mantissa:
        mantissa += ".0"
    return mantissa + (exponent + (power if power[0] in "+-" else "+" + power) if exponent else "")


def _truth(value: bool) -> str:
    return "true" if value else "false"


def _text(text: str, quote: bool = False) -> str:
    """A YAML scalar that reads back as ``text``: plain where that is safe, else in double quotes."""
    if not quote and _PLAIN.fullmatch(text) and text.lower() not in _NOT_PLAIN:
        return text
    return '"' + "".join(_escaped(c) for c in text) + '"'


def _escaped(c: str) -> str:
    code = ord(c)
    if c in '"\\':
        return "\\" + c
    if c.isprintable():
        return c
    if 0xD800 <= code <= 0xDFFF:
        return "\\uFFFD"  # half a surrogate pair cannot be written to a file
    return f"\\U{code:08X}"


# Reading


def read_result(path: Path) -> SessionEstimate:
    """Reads a result and checks every field.

    Times of the looks are not in the file: ``t`` of each pair is NaN; nor are the calibration shots. A predicted error
    that is ``null`` reads as infinite.

    Raises:
        InputError: the first problem of the file.
    """
    problems: list[InputError] = []
    file = path.name
    top = Fields(load_yaml(path, file, max_bytes=_MAX_BYTES, max_nodes=_MAX_NODES), _TOP, Place(file), problems)
    top.text("format", RESULT_FORMAT, allowed=(RESULT_FORMAT,))
    top.text("fgreg", "a version")
    session = top.text("session", "the session's name")
    verdict = _read_verdict(top)
    reasons = []
    for entry, place in top.items("reasons", "a list of texts", empty=True):
        if not isinstance(entry, str):
            problems.append(InputError(str(place), shown(entry), "a text"))
        else:
            reasons.append(entry)
    laser = None
    if not top.has("laser"):
        top.fail("laser", "nothing", "marker_T_laser and covariance, or null")
    elif top.raw("laser") is not None and (fields := top.child("laser", ("marker_T_laser", "covariance"))) is not None:
        laser = LaserEstimate(
            fields.transform("marker_T_laser", _ANY_LENGTH), fields.covariance("covariance", 6, semidefinite=True)
        )
    epochs = [_read_epoch(fields, i) for i, fields in enumerate(top.children("epochs", _EPOCH, empty=True))]
    pairs = [_read_pair(fields, len(epochs)) for fields in top.children("pairs", _PAIR, empty=True)]
    tracks = [_read_track(fields) for fields in top.children("tracks", _TRACK, empty=True)]
    timing = None
    if top.has("timing_ms") and (fields := top.child("timing_ms", ("add", "track"))) is not None:
        timing = Timing(_read_quantiles(fields, "add"), _read_quantiles(fields, "track"))
    if problems:
        raise problems[0]
    return SessionEstimate(
        session, verdict, tuple(reasons), laser, tuple(epochs), tuple(pairs), tuple(tracks), timing=timing
    )


def _read_verdict(fields: Fields) -> Verdict:
    text = fields.text("verdict", "a verdict", allowed=tuple(Verdict))
    return Verdict(text) if text else Verdict.REFUSED


def _maybe(fields: Fields, key: str, bounds: Bounds = FINITE, *, required: bool = True) -> float | None:
    """A number or ``null``; where not required, it may also be absent."""
    if fields.has(key) and fields.raw(key) is None:
        return None
    if not fields.has(key) and not required:
        return None
    return fields.number(key, bounds)


def _is_null(fields: Fields, key: str) -> bool:
    return fields.has(key) and fields.raw(key) is None


def _read_epoch(fields: Fields, position: int) -> EpochEstimate:
    index = fields.integer("index", 0, 2**31 - 1)
    if fields.ok and index != position:
        fields.fail("index", str(index), f"{position}, the epoch's place in the list")
    tre = None
    if not _is_null(fields, "predicted_tre_mm"):
        figures = fields.child("predicted_tre_mm", ("mean", "p95", "worst"))
        if figures is not None:
            mean, p95, worst = (_maybe(figures, key, _FIGURE) for key in ("mean", "p95", "worst"))
            tre = PredictedTre(*(math.inf if value is None else value for value in (mean, p95, worst)))
    return EpochEstimate(
        index=index,
        start_s=fields.number("start_s", _SECONDS),
        trus_T_camera=None if _is_null(fields, "trus_T_camera") else fields.transform("trus_T_camera", _ANY_LENGTH),
        covariance=None if _is_null(fields, "covariance") else fields.covariance("covariance", 6, semidefinite=True),
        pairs=fields.integer("pairs", 0, 2**31 - 1),
        verdict=_read_verdict(fields),
        predicted_tre=tre,
    )


def _read_pair(fields: Fields, epochs: int) -> PairEstimate:
    used = fields.boolean("used")
    reason = fields.text("reason", default="" if used else None)

    def figure(key: str, bounds: Bounds = FINITE) -> float | None:
        return _maybe(fields, key, bounds, required=used)

    theta_deg, rotation_deg = figure("theta_deg"), figure("rotation_deg")
    point = covariance = None
    if not _is_null(fields, "trus_p_pm_mm") and (used or fields.has("trus_p_pm_mm")):
        point = fields.numbers("trus_p_pm_mm", 3, FINITE)
    if not _is_null(fields, "covariance") and (used or fields.has("covariance")):
        covariance = fields.covariance("covariance", 3, semidefinite=True)
    return PairEstimate(
        t=math.nan,
        pm=fields.integer("pm", 0, 2**31 - 1),
        epoch=fields.integer("epoch", 0, max(0, epochs - 1)),
        used=used,
        reason=reason,
        lambda_mm=figure("lambda_mm"),
        theta_rad=None if theta_deg is None else math.radians(theta_deg),
        rotation_rad=None if rotation_deg is None else math.radians(rotation_deg),
        trus_p_pm_mm=point,
        covariance=covariance,
        residual_mm=figure("residual_mm", _FIGURE),
        nis=figure("nis", _FIGURE),
    )


def _read_quantiles(fields: Fields, key: str) -> Quantiles | None:
    if _is_null(fields, key) or (found := fields.child(key, _QUANTILES)) is None:
        return None
    return Quantiles(*(found.number(name, _FIGURE) for name in _QUANTILES))


def _read_track(fields: Fields) -> TrackEstimate:
    stage_deg, sigma_deg = _maybe(fields, "stage_deg"), _maybe(fields, "sigma_deg", _FIGURE)
    return TrackEstimate(
        t=fields.number("t", _SECONDS),
        stage_rad=None if stage_deg is None else math.radians(stage_deg),
        sigma_rad=None if sigma_deg is None else math.radians(sigma_deg),
        lambda_mm=_maybe(fields, "lambda_mm"),
        causal=fields.boolean("causal"),
        reason=fields.text("reason", default=None if stage_deg is None else ""),
    )
