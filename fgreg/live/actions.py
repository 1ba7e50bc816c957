"""The workflow's inputs at one moment, and the actions it can ask for. Plain data."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from fgreg.drivers.base import CommandKind, OperatorCommand
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import TrackEstimate, Verdict
from fgreg.model.measurements import OtherPosition
from fgreg.model.time_sync import PoseHistory, TimedPose
from fgreg.stage.limits import MotionKind


@dataclass(frozen=True, slots=True, eq=False)
class LocatedPulse:
    """One laser pulse as the probe received it.

    Attributes:
        pulse_s: host time of the pulse.
        scan_rad: angle of the image plane; None if the plane was turning or its angle is unknown.
        marker: ``camera_T_marker`` at the pulse; None if it is unknown, and then ``unpaired`` gives the reason.
        x_mm, range_mm, covariance, amplitude: of the located source; None if no source was located.
        others: other positions at which it may be.
        sweep: +1 or -1 where the plane stepped towards larger or smaller angles up to this first detection, else 0.
    """

    pulse_s: float
    scan_rad: float | None
    marker: TimedPose | None = None
    unpaired: str = ""
    x_mm: float | None = None
    range_mm: float | None = None
    covariance: FloatArray | None = None
    amplitude: float | None = None
    others: tuple[OtherPosition, ...] = ()
    sweep: int = 0


@dataclass(frozen=True, slots=True)
class RegistrationState:
    """Summary of the estimate.

    Attributes:
        verdict, reasons: of the registration.
        epoch: current camera epoch.
        pairs: inlier looks in this epoch.
        registered: whether the estimate has a registration.
    """

    verdict: Verdict = Verdict.REFUSED
    reasons: tuple[str, ...] = ()
    epoch: int = 0
    pairs: int = 0
    registered: bool = False


@dataclass(frozen=True, slots=True)
class StageView:
    """Status of the stage.

    Attributes:
        scan_rad: angle of the image plane. at_s: host time of this angle. moving: whether the stage turns.
        homed: whether the stage has found its zero position.
        requested: the motion that the operator has asked for.
        latched: why nothing may move until a reset; empty if the stage may move.
    """

    scan_rad: float
    moving: bool
    homed: bool
    at_s: float
    requested: MotionKind | None = None
    latched: str = ""

    @property
    def no_angle(self) -> str:
        """What the stage is, so that its angle says nothing of the plane; empty where it does."""
        return "turning" if self.moving else "" if self.homed else "not homed, and its angle not known"


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """Inputs of one step of the workflow.

    Attributes:
        now_s: host time.
        poses: recent camera_T_marker.
        stage: None if there is no stage or it is lost.
        pulses: those since the last step, oldest first.
        commands: the operator's commands since the last step.
        registration: state of the registration.
        tracking: tracking result for the newest pose: the angle that the plane should turn to; None if there is none.
        aims: number of recorded calibration shots.
        camera_moving_s: host time since which the camera has been moving, or since which a move has been missing in
            the estimate: the registration is invalid. None while it is valid.
        still_until_s: host time of the newest frame in which static tags show that the camera stands: newer poses of
            the marker are not followed. Infinite where no static tags are in view.
        pictured_s: host time of the newest picture in which the marker was looked for.
    """

    now_s: float
    poses: PoseHistory
    stage: StageView | None
    pulses: tuple[LocatedPulse, ...]
    commands: tuple[OperatorCommand, ...]
    registration: RegistrationState
    tracking: TrackEstimate | None
    aims: int
    camera_moving_s: float | None = None
    still_until_s: float = math.inf
    pictured_s: float = math.inf


# --- what the workflow asks for -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Ask:
    """Pass the operator's request for a kind of motion on to the stage; a request for homing also starts it.

    ``by``: who asked for it; empty if unknown.
    """

    kind: MotionKind
    by: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class Sweep:
    """Turn the stage to a position of a PM search."""

    scan_rad: float
    reason: str


@dataclass(frozen=True, slots=True)
class Follow:
    """Turn the stage to where the beam's PM is expected; ``marker_s``: host time of the marker pose it rests on."""

    scan_rad: float
    sigma_rad: float
    marker_s: float
    reason: str


@dataclass(frozen=True, slots=True)
class Halt:
    """Stop the stage."""

    reason: str


@dataclass(frozen=True, slots=True)
class Release:
    """Reset the latched stage, which the operator has inspected: motions may be requested again."""


@dataclass(frozen=True, slots=True)
class TakeAim:
    """Record a calibration shot at this board corner (column, row) from the newest frames."""

    corner: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class TakePoint:
    """Record a point as a check or as data: its pixels in both frames, x and range, and the angle of its plane."""

    kind: CommandKind
    point: tuple[float, float, float, float, float, float]
    scan_rad: float


@dataclass(frozen=True, slots=True)
class TakeChoice:
    """Record that the looks at a PM do not count any more, or (``include``) count again."""

    pm: int
    include: bool
    by: str


@dataclass(frozen=True, slots=True, eq=False)
class TakeVerify:
    """Compare the registration with these pulses as looks at a new PM, the ``number``-th of ``count`` from 0."""

    number: int
    count: int
    looks: tuple[LocatedPulse, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TakePairs:
    """Record these pulses as looks at one PM."""

    pm: int
    looks: tuple[LocatedPulse, ...]


@dataclass(frozen=True, slots=True)
class TakeMove:
    """Record a reported camera move."""


@dataclass(frozen=True, slots=True)
class Tell:
    """A message to the operator.

    Attributes:
        text: the message.
        done: whether the current spot is finished, so that the fibre may move on.
        wants: the command that the operator is asked for.
        answer: whether it only answers a command; what to do next stays as it was.
    """

    text: str
    done: bool = False
    wants: CommandKind | None = None
    answer: bool = False


Action = (
    Ask | Sweep | Follow | Halt | Release | TakeAim | TakePoint | TakeChoice | TakeVerify | TakePairs | TakeMove | Tell
)
