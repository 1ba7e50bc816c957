"""The summary of a solved session as text for a terminal.

The text has the verdict first, then reasons, registration, laser line, pairs, tracks and files. It is ASCII except for
names chosen by users, and fits 80 columns.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from fgreg.geometry.transforms import FloatArray, log_so3
from fgreg.model.estimate import (
    AimEstimate,
    EpochEstimate,
    LaserEstimate,
    PairEstimate,
    PointEstimate,
    SessionEstimate,
    Timing,
    Verdict,
)
from fgreg.model.measurements import Look
from fgreg.model.session_model import SessionModel
from fgreg.model.systematic import largest_causes

STYLES = {Verdict.OK: "bold green", Verdict.WARNING: "bold yellow", Verdict.REFUSED: "bold red"}
MEANINGS = {
    Verdict.OK: "the probe may be turned by this registration",
    Verdict.WARNING: "look first: read the reasons before the probe turns",
    Verdict.REFUSED: "no transform below may be used: do not turn the probe",
}
MOST_ROWS = 40
"""Longer tables show only the unused looks and those with the largest NIS."""


@dataclass(frozen=True, slots=True)
class DetectionFigures:
    """Counts of detections, and of the frames in which they were attempted."""

    markers_found: int
    markers_total: int
    sources_found: int
    sources_total: int


@dataclass(frozen=True, slots=True)
class TruthFigures:
    """Errors against a known truth, one entry per epoch (or track); None without a result or truth.

    Attributes:
        tre_mean_mm, tre_worst_mm: target registration error over the session's targets, per epoch.
        track_error_rad: result less truth, per track.
    """

    tre_mean_mm: tuple[float | None, ...] = ()
    tre_worst_mm: tuple[float | None, ...] = ()
    track_error_rad: tuple[float | None, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class SummaryExtras:
    """The parts of a summary besides the estimate.

    Attributes:
        rrd, result: files written.
        elapsed_s: time the solve took.
        detections: None where no frames were used.
        looks: the measured look of each of ``estimate.pairs`` (None: nothing was measured), for scan and range.
        truth: where it is known.
    """

    rrd: Path | None = None
    result: Path | None = None
    elapsed_s: float | None = None
    detections: DetectionFigures | None = None
    looks: tuple[Look | None, ...] = ()
    truth: TruthFigures | None = None


def pm_rotation_sigma_rad(trus_p_pm_mm: FloatArray, covariance: FloatArray) -> float:
    """Sigma of the stage angle at which a PM is in the plane, ``atan2(p_y, p_z)``, from the PM's (3, 3) covariance."""
    y, z = float(trus_p_pm_mm[1]), float(trus_p_pm_mm[2])
    gradient = np.array([0.0, z, -y]) / (y * y + z * z)
    return math.sqrt(max(0.0, float(gradient @ covariance @ gradient)))


def laser_sigmas(laser: LaserEstimate) -> tuple[float, float]:
    """Largest sigma of the beam's direction (rad) and of its position across it, at the laser frame's origin (mm)."""
    direction = np.linalg.eigvalsh(laser.covariance[:2, :2])[-1]
    place = np.linalg.eigvalsh(laser.covariance[3:5, 3:5])[-1]
    return math.sqrt(max(0.0, float(direction))), math.sqrt(max(0.0, float(place)))


def print_summary(
    model: SessionModel, estimate: SessionEstimate, extra: SummaryExtras, console: Console | None = None
) -> None:
    """Print the summary; in colour on a terminal, plain 80 columns elsewhere."""
    print_plain(render_summary(model, estimate, extra), console or Console(highlight=False, emoji=False))


def print_plain(summary: RenderableType, console: Console) -> None:
    """Print; in colour on a terminal, plain 80 columns without trailing blanks elsewhere."""
    if console.is_terminal:
        console.print(summary, crop=False)
        return
    with console.capture() as capture:
        console.print(summary, crop=False)
    # Tables pad their lines: strip trailing blanks for files and pipes.
    console.file.write("".join(line.rstrip() + "\n" for line in capture.get().splitlines()))


def render_summary(model: SessionModel, estimate: SessionEstimate, extra: SummaryExtras) -> RenderableType:
    """The summary as one rich renderable; print it with ``crop=False`` so that long paths stay whole."""
    truth = extra.truth or TruthFigures()
    parts: list[RenderableType] = [_verdict(estimate)]
    parts += [bullet(reason) for reason in estimate.reasons]
    for epoch in estimate.epochs:
        refused = Verdict.REFUSED in (estimate.verdict, epoch.verdict)
        parts += [
            "",
            *_epoch(
                epoch,
                model,
                truth,
                largest_causes(estimate.systematic),
                several=len(estimate.epochs) > 1,
                refused=refused,
            ),
        ]
    if estimate.laser is not None:
        parts += ["", *_laser(estimate.laser)]
    if estimate.pairs:
        parts += ["", *_pairs(model, estimate, extra)]
    if estimate.tracks:
        parts += ["", *_tracks(estimate, truth)]
    if estimate.checks:
        parts += ["", *_checks(estimate)]
    if estimate.assumptions:
        parts += ["", *_assumptions(estimate)]
    closing = [*_aims(estimate.aims), *_points(estimate.points), *_timing(estimate.timing), *_closing(extra)]
    if closing:
        parts += ["", *closing]
    return Group(*(Text(part) if isinstance(part, str) else part for part in parts))


# ---- pieces ----


def clean(text: str) -> str:
    """Text from a file without control characters."""
    return "".join(c if c.isprintable() else "?" for c in text)


def _verdict(estimate: SessionEstimate) -> Text:
    word = Text(f" {estimate.verdict.value.upper()} ", style=f"{STYLES[estimate.verdict]} reverse")
    return Text.assemble(word, " ", (clean(estimate.session), "bold"), f": {MEANINGS[estimate.verdict]}")


def bullet(text: str) -> RenderableType:
    """A list entry whose further lines stand under its first word."""
    grid = Table.grid(padding=(0, 1, 0, 0))
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    grid.add_row("  -", Text(clean(text)))
    return grid


def _heading(text: str) -> Text:
    return Text(text, style="bold")


def _timing(timing: Timing | None) -> Iterator[str]:
    if timing is None:
        return
    for name, found in (("Taking in an event", timing.add), ("Answering a query", timing.track)):
        if found is not None:
            yield f"{name}: median {found.p50:.2f}, 99 % {found.p99:.2f}, longest {found.max:.2f} ms"


def _vector(values: Sequence[float] | FloatArray, decimals: int) -> str:
    return "(" + ", ".join(f"{float(value):.{decimals}f}" for value in values) + ")"


def _number(value: float | None, decimals: int) -> str:
    if value is None:
        return "-"
    if not math.isfinite(value):
        return "inf" if value > 0 else "?"
    return f"{value:.{decimals}f}"


def _in_degrees(value_rad: float | None, decimals: int = 1) -> str:
    return _number(None if value_rad is None else math.degrees(value_rad), decimals)


def _epoch(
    epoch: EpochEstimate, model: SessionModel, truth: TruthFigures, largest: str, *, several: bool, refused: bool
) -> Iterator[RenderableType]:
    where = f", camera epoch {epoch.index} (from {epoch.start_s:.1f} s)" if several else ""
    title = _heading(f"Registration trus_T_camera{where}, {epoch.pairs} pairs: ")
    yield title.append(epoch.verdict.value, style=STYLES[epoch.verdict])
    if epoch.trus_T_camera is None:
        yield "  none could be computed"
        return
    if refused:
        yield Text("  best estimate, for inspection only: not to be used", style=STYLES[Verdict.REFUSED])
    vector = log_so3(epoch.trus_T_camera[:3, :3])
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 1e-12 else np.array([1.0, 0.0, 0.0])
    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_row("  translation", f"{_vector(epoch.trus_T_camera[:3, 3], 2)} mm")
    grid.add_row("  rotation", f"{math.degrees(angle):.2f} deg about {_vector(axis, 4)}")
    if epoch.covariance is not None:
        sigma = np.sqrt(np.clip(np.diag(epoch.covariance), 0.0, None))
        turn, shift = _vector(np.degrees(sigma[:3]), 2), _vector(sigma[3:], 2)
        grid.add_row("  1 sigma", f"{shift} mm, {turn} deg, camera x, y, z")
    tre = epoch.predicted_tre
    if tre is not None:
        figures = f"mean {_number(tre.mean_mm, 2)}, 95 % bound {_number(tre.p95_mm, 2)} mm"
        grid.add_row("  predicted TRE", f"{figures}, over {len(model.targets_mm)} targets")
        at_worst = f"95 % bound {_number(tre.worst_mm, 2)} mm"
        if tre.random is not None and tre.systematic is not None:
            at_worst += (
                f": random {_number(tre.random.worst_mm, 2)}, systematic {_number(tre.systematic.worst_mm, 2)} mm"
            )
            if tre.seen is not None:
                at_worst += f"; against what the scanner shows {_number(tre.seen.worst_mm, 2)} mm"
        grid.add_row("    at worst", at_worst)
        if tre.systematic is not None and largest:
            grid.add_row("    causes", f"{largest} (1 sigma each at the worst target)")
    mean, worst = _entry(truth.tre_mean_mm, epoch.index), _entry(truth.tre_worst_mm, epoch.index)
    if mean is not None or worst is not None:
        grid.add_row("  true TRE", f"mean {_number(mean, 2)}, worst {_number(worst, 2)} mm (against the ground truth)")
    yield grid
    for row in epoch.trus_T_camera:
        yield "    " + "".join(f"{value:13.6f}" for value in row)


def _entry(values: Sequence[float | None], index: int) -> float | None:
    return values[index] if index < len(values) else None


def _laser(laser: LaserEstimate) -> Iterator[RenderableType]:
    direction_rad, place_mm = laser_sigmas(laser)
    yield _heading("Laser line in the marker frame")
    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_row("  origin", f"{_vector(laser.marker_T_laser[:3, 3], 2)} mm, 1 sigma {place_mm:.2f} mm across it")
    grid.add_row(
        "  direction", f"{_vector(laser.marker_T_laser[:3, 2], 4)}, 1 sigma {math.degrees(direction_rad):.2f} deg"
    )
    yield grid


def _table(*columns: tuple[str, str]) -> Table:
    """A table without frame: titles and units in two lines, figures to the right."""
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    for title, unit in columns:
        table.add_column(f"{title}\n{unit}", justify="right", no_wrap=True)
    return table


def _pairs(model: SessionModel, estimate: SessionEstimate, extra: SummaryExtras) -> Iterator[RenderableType]:
    pairs = estimate.pairs
    shown = _rows_shown(pairs)
    used = sum(pair.used for pair in pairs)
    cut = "" if len(shown) == len(pairs) else f"; the {len(shown)} not used or of largest NIS:"
    yield _heading(f"Pairs: {used} of {len(pairs)} looks used{cut}")
    several = len(estimate.epochs) > 1
    table = _table(
        ("PM", ""),
        *([("epoch", "")] if several else []),
        ("used", ""),
        ("scan", "deg"),
        ("rotation", "deg, 1 sigma"),
        ("lambda", "mm"),
        ("range", "mm"),
        ("residual", "mm"),
        ("NIS", ""),
    )
    for position in shown:
        pair = pairs[position]
        look = extra.looks[position] if position < len(extra.looks) else None
        turn = _in_degrees(pair.rotation_rad)
        if pair.rotation_rad is not None and pair.trus_p_pm_mm is not None and pair.covariance is not None:
            turn += f" +- {_in_degrees(pm_rotation_sigma_rad(pair.trus_p_pm_mm, pair.covariance))}"
        table.add_row(
            str(pair.pm),
            *([str(pair.epoch)] if several else []),
            "yes" if pair.used else "NO",
            "-" if look is None else _in_degrees(model.stage.device_from_scan(look.scan_rad)),
            turn,
            _number(pair.lambda_mm, 1),
            "-" if look is None else _number(look.range_mm, 1),
            _number(pair.residual_mm, 3),
            _number(pair.nis, 1),
            style=None if pair.used else "red",
        )
    yield Padding(table, (0, 0, 0, 2))
    yield from (
        bullet(f"PM {pairs[position].pm}, {pairs[position].t:.1f} s, not used: {pairs[position].reason}")
        for position in shown
        if not pairs[position].used
    )


def _rows_shown(pairs: Sequence[PairEstimate]) -> list[int]:
    """Positions of the looks to list, in event order."""
    if len(pairs) <= MOST_ROWS:
        return list(range(len(pairs)))

    def weight(position: int) -> tuple[bool, float]:
        nis = pairs[position].nis
        return pairs[position].used, -(0.0 if nis is None else nis)

    return sorted(sorted(range(len(pairs)), key=weight)[:MOST_ROWS])


def _tracks(estimate: SessionEstimate, truth: TruthFigures) -> Iterator[RenderableType]:
    tracks = estimate.tracks
    answered = sum(track.stage_rad is not None for track in tracks)
    yield _heading(f"Tracks: {answered} of {len(tracks)} answered")
    known = any(error is not None for error in truth.track_error_rad)
    table = _table(
        ("time", "s"),
        ("turn stage to", "deg"),
        ("1 sigma", "deg"),
        ("lambda", "mm"),
        *([("error", "deg")] if known else []),
    )
    for position, track in enumerate(tracks[:MOST_ROWS]):
        table.add_row(
            f"{track.t:.1f}",
            _in_degrees(track.stage_rad),
            _in_degrees(track.sigma_rad),
            _number(track.lambda_mm, 1),
            *([_in_degrees(_entry(truth.track_error_rad, position), 2)] if known else []),
            style=None if track.stage_rad is not None else "red",
        )
    yield Padding(table, (0, 0, 0, 2))
    if len(tracks) > MOST_ROWS:
        yield f"  and {len(tracks) - MOST_ROWS} more"
    yield from (bullet(f"{track.t:.1f} s: {track.reason}") for track in tracks[:MOST_ROWS] if track.stage_rad is None)


def _checks(estimate: SessionEstimate) -> Iterator[RenderableType]:
    checks = estimate.checks
    compared = [check for check in checks if check.error_mm is not None]
    yield _heading(f"Checks: {len(compared)} of {len(checks)} compared (error of the registration, TRUS axes)")
    table = _table(
        ("time", "s"), ("x", "mm"), ("y", "mm"), ("z", "mm"), ("length", "mm"), ("95 % bound", "mm"), ("NIS", ""),
        ("verdict", ""),
    )  # fmt: skip
    for check in compared[:MOST_ROWS]:
        assert check.error_mm is not None
        table.add_row(
            f"{check.t:.1f}",
            *(_number(float(value), 2) for value in check.error_mm),
            _number(float(np.linalg.norm(check.error_mm)), 2),
            _number(check.predicted_95_mm, 2),
            _number(check.nis, 1),
            check.verdict.value,
            style=None if check.verdict is Verdict.OK else STYLES[check.verdict].removeprefix("bold "),
        )
    yield Padding(table, (0, 0, 0, 2))
    if len(compared) > MOST_ROWS:
        yield f"  and {len(compared) - MOST_ROWS} more"
    yield from (bullet(text) for text in dict.fromkeys(check.reason for check in compared if check.reason))
    yield from (bullet(f"{check.t:.1f} s, not compared: {check.reason}") for check in checks if check.error_mm is None)


def _assumptions(estimate: SessionEstimate) -> Iterator[RenderableType]:
    yield _heading("Assumed, and not shown by the data")
    for assumption in estimate.assumptions:
        count = len(assumption.checks)
        covered = f"covered by {count} check{'s' if count > 1 else ''}" if count else "no check covers it"
        yield bullet(f"{assumption.text} ({covered})")


def _aims(aims: Sequence[AimEstimate]) -> Iterator[RenderableType]:
    if not aims:
        return
    residuals = [aim.residual_mm for aim in aims if aim.used and aim.residual_mm is not None]
    text = f"Calibration shots: {sum(aim.used for aim in aims)} of {len(aims)} used"
    if residuals:
        text += (
            f", spot to beam {math.sqrt(float(np.mean(np.square(residuals)))):.2f} mm rms, {max(residuals):.2f} worst"
        )
    yield text
    for number, aim in enumerate(aims):
        if not aim.used:
            yield bullet(f"aim {number}, {aim.t:.1f} s, not used: {aim.reason}")


def _points(points: Sequence[PointEstimate]) -> Iterator[RenderableType]:
    if not points:
        return
    text = f"Known points: {sum(point.used for point in points)} of {len(points)} used as data"
    nis, number = max(
        ((point.nis or 0.0, number) for number, point in enumerate(points) if point.used), default=(0, -1)
    )
    if number >= 0:
        text += f", nis against the other shots {nis:.1f} at most (point {number}, three degrees of freedom)"
    yield text
    for number, point in enumerate(points):
        if not point.used:
            yield bullet(f"known point {number}, {point.t:.1f} s, not used: {point.reason}")


def _closing(extra: SummaryExtras) -> Iterator[RenderableType]:
    found = extra.detections
    if found is not None:
        yield (
            f"Detection: marker in {found.markers_found} of {found.markers_total} shots, "
            f"source in {found.sources_found} of {found.sources_total} frames"
        )
    if extra.elapsed_s is not None:
        yield f"Solved in {extra.elapsed_s:.1f} s"
    # Paths are not wrapped, so that they can be copied.
    for title, path in (("Result", extra.result), ("Recording", extra.rrd)):
        if path is not None:
            yield Text(f"{title:<9}  {clean(str(path))}", no_wrap=True, overflow="ignore")
    if extra.rrd is not None:
        yield Text(
            f"           (open it with: rerun {clean(shlex.quote(str(extra.rrd)))})", no_wrap=True, overflow="ignore"
        )
