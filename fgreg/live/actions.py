"""What the workflow sees of the world at one moment, and what it can ask for. Plain data."""

from __future__ import annotations

from dataclasses import dataclass

from fgreg.drivers.base import CommandKind, OperatorCommand
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import TrackEstimate, Verdict
from fgreg.model.time_sync import PoseHistory, TimedPose
from fgreg.stage.limits import MotionKind


@dataclass(frozen=True, slots=True, eq=False)
class LocatedPulse:
    """One laser pulse as the probe took it.

    Attributes:
        pulse_s: host time of the pulse.
        scan_rad: where the plane stood; None where it turned, or is not known.
        marker: ``camera_T_marker`` at the pulse; None where that cannot be told, and then ``unpaired`` says why.
        x_mm, range_mm, covariance, amplitude: of the source that was located; None where none was.
    """

    pulse_s: float
    scan_rad: float | None
    marker: TimedPose | None = None
    unpaired: str = ""
    x_mm: float | None = None
    range_mm: float | None = None
    covariance: FloatArray | None = None
    amplitude: float | None = None


@dataclass(frozen=True, slots=True)
class RegistrationState:
    """Of the estimate: verdict, reasons, camera epoch, looks that count in it, whether it has a registration at all."""

    verdict: Verdict = Verdict.REFUSED
    reasons: tuple[str, ...] = ()
    epoch: int = 0
    pairs: int = 0
    registered: bool = False


@dataclass(frozen=True, slots=True)
class StageView:
    """Of the stage: where its plane stands, whether it knows its zero, what motion the operator has asked for, and why
    nothing may move until a reset (``latched``; empty: it may)."""

    scan_rad: float
    moving: bool
    homed: bool
    at_s: float
    requested: MotionKind | None = None
    latched: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """One moment.

    Attributes:
        now_s: host time.
        poses: recent camera_T_marker.
        stage: None where there is none, or it is lost.
        heard: pulses since the last moment, oldest first.
        commands: of the operator since the last moment.
        known: of the estimate.
        answer: where the plane should turn for the newest pose; None where nothing can be told.
        aims: calibration shots recorded.
        camera_moving_s: the camera has been on the move since this host time, or its move is not in the estimate yet:
            what is known of the registration holds no more. None where it holds.
    """

    now_s: float
    poses: PoseHistory
    stage: StageView | None
    heard: tuple[LocatedPulse, ...]
    commands: tuple[OperatorCommand, ...]
    known: RegistrationState
    answer: TrackEstimate | None
    aims: int
    camera_moving_s: float | None = None


# --- what the workflow asks for -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Ask:
    """The operator's request for a kind of motion, to be handed on; homing begins with it."""

    kind: MotionKind


@dataclass(frozen=True, slots=True)
class Sweep:
    """The stage turns to a position of a search."""

    scan_rad: float
    reason: str


@dataclass(frozen=True, slots=True)
class Follow:
    """The stage turns to where the beam will be heard; ``marker_s``: host time of the pose behind it."""

    scan_rad: float
    sigma_rad: float
    marker_s: float
    reason: str


@dataclass(frozen=True, slots=True)
class Halt:
    """The stage stops."""

    reason: str


@dataclass(frozen=True, slots=True)
class Release:
    """The operator has looked at the latched stage: it may be asked to move again."""


@dataclass(frozen=True, slots=True)
class TakeAim:
    """Record a calibration shot at this corner, from the newest frames."""

    corner: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class TakePairs:
    """Record these looks as looks at one PM."""

    pm: int
    looks: tuple[LocatedPulse, ...]


@dataclass(frozen=True, slots=True)
class TakeMove:
    """Record that the camera has moved."""


@dataclass(frozen=True, slots=True)
class Tell:
    """Something the operator should know.

    ``done``: the present spot needs the fibre no longer. ``wants``: what the operator is asked to say.
    """

    text: str
    done: bool = False
    wants: CommandKind | None = None


Action = Ask | Sweep | Follow | Halt | Release | TakeAim | TakePairs | TakeMove | Tell
