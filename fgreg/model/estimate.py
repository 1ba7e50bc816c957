"""The estimate: registration, beam, PMs, tracks and a verdict. Millimetres, radians.

The classes also describe ``result.yaml``. Transforms are written to 1e-9 in rotation and 1e-6 mm in translation, so
that rotations stay rigid to 1e-8; angles and lengths to 1e-6; covariances to ten digits; times in full.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated

from fgreg.geometry.transforms import FloatArray
from fgreg.schema.hashes import Hashes
from fgreg.schema.kinds import ANY_SIZE, SECONDS, Figure, Integer, ListOf, Number, Numbers, Text
from fgreg.schema.matrices import Covariance, Transform
from fgreg.schema.record import Key, NotStored, record

RESULT_FORMAT = "fgreg-result/1"

# A best estimate of a refused session may be anywhere.
_TRANSFORM = Transform(max_translation_mm=math.inf, decimals=(9, 6))
_COUNT = Integer(0, 2**31 - 1)
_SIZE = Number(ANY_SIZE.low, ANY_SIZE.high, decimals=6)
_ANGLE = Number(ANY_SIZE.low, ANY_SIZE.high, degrees=True, decimals=6)
_FINE = Number(ANY_SIZE.low, ANY_SIZE.high, decimals=9)
_NOT_NEGATIVE_FINE = Number(0.0, ANY_SIZE.high, decimals=9)
_NOT_NEGATIVE = Number(0.0, ANY_SIZE.high, decimals=6)
_TRE = Figure(0.0, ANY_SIZE.high, decimals=6)


def _covariance(size: int) -> Covariance:
    return Covariance(size, semidefinite=True, digits=10)


class Verdict(StrEnum):
    """``ok``: usable; ``warning``: usable, but a condition is missed; ``refused``: no transform may be used."""

    OK = "ok"
    WARNING = "warning"
    REFUSED = "refused"

    @property
    def severity(self) -> int:
        return [Verdict.OK, Verdict.WARNING, Verdict.REFUSED].index(self)


VERDICT = Text.of(Verdict, "a verdict")


def worst_verdict(*verdicts: Verdict) -> Verdict:
    """The most severe of the verdicts; ``ok`` where there are none."""
    return max(verdicts, key=lambda verdict: verdict.severity, default=Verdict.OK)


@dataclass(frozen=True, slots=True, eq=False)
class LaserEstimate:
    """The beam: ``marker_T_laser`` (4, 4), covariance (6, 6), right tangent."""

    marker_T_laser: Annotated[FloatArray, Key("z along the beam", _TRANSFORM)]
    covariance: Annotated[
        FloatArray, Key("of the transform; 0 for the roll about the beam and the shift along it", _covariance(6))
    ]


@dataclass(frozen=True, slots=True)
class PredictedPart:
    """Figures of a predicted error, mm."""

    mean_mm: Annotated[float, Key("average over targets of sqrt(E|e|^2)", _TRE, name="mean")]
    p95_mm: Annotated[float, Key("average over targets of the 95 % quantile of |e|", _TRE, name="p95")]
    worst_mm: Annotated[float, Key("the largest of those quantiles", _TRE, name="worst")]


@dataclass(frozen=True, slots=True)
class PredictedTre:
    """Predicted target registration error, mm, from the posterior at each target."""

    mean_mm: Annotated[float, Key("average over targets of sqrt(E|e|^2)", _TRE, name="mean")]
    p95_mm: Annotated[float, Key("average over targets of the 95 % quantile of |e|", _TRE, name="p95")]
    worst_mm: Annotated[float, Key("the largest of those quantiles", _TRE, name="worst")]
    random: Annotated[PredictedPart | None, Key("the part that more shots reduce", brief=True)] = None
    systematic: Annotated[PredictedPart | None, Key("the part of the rig's constants", brief=True)] = None
    seen: Annotated[
        PredictedPart | None,
        Key("the same for a target that the scanner itself shows with its own systematic error", brief=True),
    ] = None


@dataclass(frozen=True, slots=True, eq=False)
class TargetEstimate:
    """Predicted error e at one target, mm."""

    name: Annotated[str, Key("of the target; its number from 1 where it has none", Text())]
    trus_p_mm: Annotated[FloatArray, Key("where it is", Numbers(3, _SIZE))]
    rms_mm: Annotated[float, Key("sqrt(E|e|^2)", _TRE, name="rms")]
    p95_mm: Annotated[float, Key("95 % quantile of |e|", _TRE, name="p95")]
    random_mm: Annotated[float, Key("part of `p95` that more shots reduce", _TRE, name="random_p95")]
    systematic_mm: Annotated[float, Key("part of `p95` of the rig's constants", _TRE, name="systematic_p95")]


@dataclass(frozen=True, slots=True)
class SystematicEstimate:
    """One of the rig's constants: what is known of it before and after the session, and what it does."""

    name: Annotated[str, Key("key of `systematic`, with an index where it has several", Text())]
    prior_sigma: Annotated[float, Key("standard deviation before the session, in the key's unit", _NOT_NEGATIVE_FINE)]
    value: Annotated[float, Key("estimate of the true value less the declared one", _FINE)]
    sigma: Annotated[float, Key("its standard deviation", _NOT_NEGATIVE_FINE)]
    observed: Annotated[float, Key("share of the prior variance that was removed", Number(0.0, 1.0, decimals=4))]
    score: Annotated[float, Key("standard normal where the declared value and its deviation are right", _SIZE)]
    worst_target_mm: Annotated[float, Key("1 sigma of the error at the worst target that is due to it", _NOT_NEGATIVE)]


@dataclass(frozen=True, slots=True, eq=False)
class CertificateEstimate:
    """What is proved of a registration, with beam, rig's constants and inliers as estimated. None: not known."""

    proved: Annotated[bool, Key("no other registration explains the pairs within `within_chi2` of its chi square")]
    gap: Annotated[
        float | None, Key("by which part the chi square of the pairs may still be lower", _NOT_NEGATIVE, null=True)
    ]
    within_chi2: Annotated[float | None, Key("for what follows", _NOT_NEGATIVE, null=True)]
    within_rad: Annotated[
        float | None,
        Key(
            "all that do are turned by at most this from it",
            Number(0.0, ANY_SIZE.high, degrees=True, decimals=6),
            null=True,
        ),
    ]
    within_mm: Annotated[
        float | None, Key("and move the middle of the pairs by at most this", _NOT_NEGATIVE, null=True)
    ]
    other_trus_T_camera: Annotated[
        FloatArray | None, Key("another minimum, which refuses it", _TRANSFORM, brief=True)
    ] = None
    reason: Annotated[str, Key("why it is not proved", brief=True)] = ""


@dataclass(frozen=True, slots=True, eq=False)
class EpochEstimate:
    """One camera epoch: registration (None where none can be computed), covariance (6, 6) over the right tangent."""

    index: Annotated[int, Key("its place in the list, from 0", _COUNT)]
    start_s: Annotated[float, Key("time of its first event", SECONDS)]
    trus_T_camera: Annotated[
        FloatArray | None, Key("the registration; null where none can be computed", _TRANSFORM, null=True)
    ]
    covariance: Annotated[FloatArray | None, Key("of the registration", _covariance(6), null=True)]
    pairs: Annotated[int, Key("looks that were recorded in it", _COUNT)]
    verdict: Annotated[Verdict, Key("on this epoch", VERDICT)]
    predicted_tre: Annotated[
        PredictedTre | None, Key("predicted target registration error", name="predicted_tre_mm", null=True)
    ]
    targets: Annotated[
        tuple[TargetEstimate, ...],
        Key(
            "the predicted error at each target, mm",
            ListOf(record(TargetEstimate)),
            name="target_errors_mm",
            brief=True,
        ),
    ] = ()
    certificate: Annotated[
        CertificateEstimate | None, Key("what is proved of it, where that was asked for", brief=True)
    ] = None


_USED, _UNUSED = ("used", True), ("used", False)


@dataclass(frozen=True, slots=True, eq=False)
class PairEstimate:
    """One look, in event order. Figures are None where they are not known; ``covariance`` (3, 3)."""

    t: Annotated[float, NotStored(math.nan)]
    pm: Annotated[int, Key("of the look", _COUNT)]
    epoch: Annotated[int, Key("index of its camera epoch", _COUNT)]
    used: Annotated[bool, Key("whether it is an inlier of the estimate")]
    lambda_mm: Annotated[
        float | None,
        Key("distance along the beam from the laser frame's origin", _SIZE, null=True, required_if=_USED),
    ] = None
    theta_rad: Annotated[
        float | None, Key("arc angle theta' (TRUS convention)", _ANGLE, null=True, required_if=_USED)
    ] = None
    rotation_rad: Annotated[
        float | None,
        Key(
            "turn of the stage (device) from the look's `scan_deg` that brings the PM into the plane",
            _ANGLE,
            null=True,
            required_if=_USED,
        ),
    ] = None
    trus_p_pm_mm: Annotated[FloatArray | None, Key("the PM", Numbers(3, _SIZE), null=True, required_if=_USED)] = None
    covariance: Annotated[FloatArray | None, Key("of the PM", _covariance(3), null=True, required_if=_USED)] = None
    residual_mm: Annotated[
        float | None,
        Key("root of the squared (x, range) misfit, both in mm", _NOT_NEGATIVE, null=True, required_if=_USED),
    ] = None
    nis: Annotated[
        float | None,
        Key(
            "squared misfit over its predicted covariance, both by the estimate without this PM",
            _NOT_NEGATIVE,
            null=True,
            required_if=_USED,
        ),
    ] = None
    nis_dof: Annotated[
        int | None,
        Key(
            "degrees of freedom of `nis`: 2 of one look, 5 more of each further one, 3 where it shares the marker",
            _COUNT,
        ),
    ] = None
    spot_error_mm: Annotated[
        FloatArray | None,
        Key("the PM, less where the camera sees its spot, where the pair has one; camera axes", Numbers(3, _SIZE)),
    ] = None
    influence_mm: Annotated[
        float | None,
        Key(
            "mean distance by which the targets move where this PM is left out; absent where the others do not "
            "determine the registration",
            _NOT_NEGATIVE,
        ),
    ] = None
    reason: Annotated[str, Key("why it was not used", brief=True, required_if=_UNUSED)] = ""


@dataclass(frozen=True, slots=True)
class TrackEstimate:
    """Where to turn to: absolute device angle and sigma (rad), or None with a reason."""

    t: Annotated[float, Key("of the query", SECONDS)]
    stage_rad: Annotated[
        float | None, Key("where to turn to, absolute device angle; null where there is no answer", _ANGLE, null=True)
    ]
    sigma_rad: Annotated[
        float | None,
        Key("its standard deviation", Number(0.0, ANY_SIZE.high, degrees=True, decimals=6), null=True),
    ]
    lambda_mm: Annotated[float | None, Key("distance along the beam", _SIZE, null=True)]
    causal: Annotated[bool, Key("true: from what was known at `t` (replay); false: from the whole session")]
    reason: Annotated[str, Key("why there is no answer", brief=True, required_if=("stage_deg", None))] = ""


@dataclass(frozen=True, slots=True, eq=False)
class CheckEstimate:
    """The registration at one check point. Figures are None where there are none, with a reason."""

    t: Annotated[float, Key("of the check", SECONDS)]
    error_mm: Annotated[
        FloatArray | None,
        Key(
            "where the registration puts the camera's point, less where the TRUS probe has it; TRUS axes; null where "
            "it could not be compared",
            Numbers(3, _SIZE),
            null=True,
        ),
    ]
    predicted_95_mm: Annotated[
        float | None, Key("95 % quantile of its length, by the registration and the check", _NOT_NEGATIVE, null=True)
    ]
    nis: Annotated[
        float | None,
        Key("squared error over its predicted covariance, three degrees of freedom", _NOT_NEGATIVE, null=True),
    ]
    verdict: Annotated[Verdict, Key("warning: off by more than that explains, or not compared", VERDICT)]
    reason: Annotated[str, Key("why it was not compared", brief=True, required_if=("error_mm", None))] = ""


@dataclass(frozen=True, slots=True)
class Assumption:
    """What the data of line and arc cannot show."""

    text: Annotated[str, Key("the assumption, and what it is worth")]
    checks: Annotated[
        tuple[int, ...],
        Key(
            "places in `checks` of those that have covered it, from 0; empty: nothing has",
            ListOf(_COUNT, "a list of places in `checks`", empty=True),
        ),
    ] = ()


@dataclass(frozen=True, slots=True, eq=False)
class AimEstimate:
    """One calibration shot. Figures are None where they are not known."""

    t: Annotated[float, Key("of the aim", SECONDS)]
    used: Annotated[bool, Key("whether it is an inlier of the estimate")]
    reason: Annotated[str, Key("why it was not used", brief=True, required_if=_UNUSED)] = ""
    lambda_mm: Annotated[
        float | None, Key("distance of the spot along the beam from the laser frame's origin", _SIZE)
    ] = None
    residual_mm: Annotated[float | None, Key("distance of the spot from the beam", _NOT_NEGATIVE)] = None
    nis: Annotated[float | None, Key("as of a pair, two degrees of freedom", _NOT_NEGATIVE)] = None


@dataclass(frozen=True, slots=True, eq=False)
class PointEstimate:
    """The registration at one of its known points. Figures are None where they are not known."""

    t: Annotated[float, Key("of the point", SECONDS)]
    epoch: Annotated[int, Key("its camera epoch", _COUNT)]
    used: Annotated[bool, Key("whether it is data of the estimate")]
    reason: Annotated[str, Key("why it was not used", brief=True, required_if=_UNUSED)] = ""
    error_mm: Annotated[
        FloatArray | None, Key("as of a check; but the point has drawn the registration to itself", Numbers(3, _SIZE))
    ] = None
    nis: Annotated[
        float | None, Key("against all other shots, as of a pair, three degrees of freedom", _NOT_NEGATIVE)
    ] = None


@dataclass(frozen=True, slots=True)
class SettingsUsed:
    """The settings that a result was made with."""

    limit_mm: Annotated[
        float, Key("error (95 %) at the worst target up to which the verdict is ok", Number(0.0, 100.0, above=True))
    ]
    estimate: Annotated[
        tuple[str, ...], Key("constants estimated by --estimate", ListOf(Text(), "a list of texts", empty=True))
    ] = ()
    detect_moves: Annotated[bool, Key("whether unreported camera moves were looked for")] = True
    redetect: Annotated[bool, Key("whether frames were used even where events have poses")] = False


@dataclass(frozen=True, slots=True)
class ExcludedShot:
    """An aim, a look or a known point that was left out by hand."""

    type: Annotated[str, Key("aim, pair or point", Text(allowed=("aim", "pair", "point")))]
    line: Annotated[int, Key("of the shot, in events.jsonl", Integer(1, 2**31 - 1))]
    t: Annotated[float, Key("of the shot", SECONDS)]
    pm: Annotated[int | None, Key("of a look", _COUNT)] = None
    aim: Annotated[int | None, Key("of an aim: its place among the aims, from 0", _COUNT)] = None
    point: Annotated[int | None, Key("of a known point: its place among the points, from 0", _COUNT)] = None
    reason: Annotated[str, Key("why", brief=True)] = ""
    by: Annotated[str, Key("who decided it", brief=True)] = ""

    @property
    def name(self) -> str:
        """PM, aim or known point, with its number."""
        named = (("PM", self.pm), ("aim", self.aim), ("known point", self.point))
        return next(f"{what} {number}" for what, number in named if number is not None)

    @property
    def text(self) -> str:
        """Why it is not used."""
        return "left out by hand" + (f": {self.reason}" if self.reason else "") + (f" ({self.by})" if self.by else "")


@dataclass(frozen=True, slots=True)
class Quantiles:
    """Quantiles of durations, ms."""

    p50: Annotated[float, Key("median", _NOT_NEGATIVE)]
    p99: Annotated[float, Key("99 % quantile", _NOT_NEGATIVE)]
    max: Annotated[float, Key("longest", _NOT_NEGATIVE)]


@dataclass(frozen=True, slots=True)
class Timing:
    """Durations of each kind of step; None where there was no such step."""

    add: Annotated[
        Quantiles | None, Key("taking in an aim, a pair or a move, with the full solve where it is due", null=True)
    ]
    track: Annotated[Quantiles | None, Key("answering a query", null=True)]


@dataclass(frozen=True, slots=True, eq=False)
class SessionEstimate:
    """The whole estimate of a session: the contents of ``result.yaml``.

    ``timing``: only where events were taken in one by one. The required keys of the file come last: one that was cut
    lacks one of them.
    """

    version: Annotated[str, Key("version of fgreg that made it", name="fgreg", required=True)] = field(
        default="", kw_only=True
    )
    session: Annotated[str, Key("its name")]
    inputs: Annotated[
        Mapping[str, str],
        Key(
            "SHA-256 of the files that it was made from: session.yaml, events.jsonl, the rig's, and `frames`, over the "
            "hashes of all frames in the order in which events name them",
            Hashes(),
            brief=True,
        ),
    ] = field(default_factory=dict, kw_only=True)
    settings: Annotated[SettingsUsed | None, Key("what it was made with", brief=True)] = field(
        default=None, kw_only=True
    )
    verdict: Annotated[Verdict, Key("ok: usable; warning: a condition is missed; refused: use no transform", VERDICT)]
    reasons: Annotated[
        tuple[str, ...],
        Key(
            "plain sentences with the figure behind each and what to do about it",
            ListOf(Text(), "a list of texts", empty=True),
        ),
    ]
    assumptions: Annotated[
        tuple[Assumption, ...],
        Key("what the session's data cannot show", ListOf(record(Assumption), empty=True)),
    ] = field(default=(), kw_only=True)
    excluded: Annotated[
        tuple[ExcludedShot, ...],
        Key(
            "shots that were left out by hand; of these looks `pairs` has a line, too",
            ListOf(record(ExcludedShot), empty=True),
            brief=True,
        ),
    ] = field(default=(), kw_only=True)
    checks: Annotated[
        tuple[CheckEstimate, ...], Key("one per check event", ListOf(record(CheckEstimate), empty=True))
    ] = field(default=(), kw_only=True)
    aims: Annotated[
        tuple[AimEstimate, ...], Key("one per aim event", ListOf(record(AimEstimate), empty=True), brief=True)
    ] = field(default=(), kw_only=True)
    points: Annotated[
        tuple[PointEstimate, ...], Key("one per point event", ListOf(record(PointEstimate), empty=True), brief=True)
    ] = field(default=(), kw_only=True)
    systematic: Annotated[
        tuple[SystematicEstimate, ...],
        Key("the rig's constants that are variables", ListOf(record(SystematicEstimate), empty=True), brief=True),
    ] = field(default=(), kw_only=True)
    laser: Annotated[LaserEstimate | None, Key("the beam", null=True)]
    epochs: Annotated[
        tuple[EpochEstimate, ...],
        Key("all camera epochs, also when refused", ListOf(record(EpochEstimate), empty=True)),
    ]
    pairs: Annotated[
        tuple[PairEstimate, ...], Key("one per look, in the order of events", ListOf(record(PairEstimate), empty=True))
    ]
    tracks: Annotated[tuple[TrackEstimate, ...], Key("one per track event", ListOf(record(TrackEstimate), empty=True))]
    timing: Annotated[
        Timing | None, Key("of `fgreg replay` only; null where there was no such event", name="timing_ms")
    ] = None


RESULT = record(SessionEstimate, ("format", RESULT_FORMAT))
"""``result.yaml``."""
