"""Devices, timing figures and momentary status of a live session. Plain data."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from fgreg.drivers.base import (
    BmodeFrame,
    BmodeSource,
    CommandKind,
    MotionSource,
    Operator,
    PhotoacousticSource,
    PictureSink,
    StereoCamera,
    StereoFrame,
    TransformSink,
)
from fgreg.live.actions import StageView
from fgreg.live.recorder import RecorderState
from fgreg.live.workflow import Stage
from fgreg.model.estimate import TrackEstimate, Verdict
from fgreg.model.time_sync import TimedPose
from fgreg.stage.limits import MotionKind
from fgreg.stage.reconnect import ReconnectingStage

LATENCIES = 100_000
"""Largest number of latencies kept."""


@dataclass(slots=True, eq=False)
class Devices:
    """The connected devices: one per role, any number of sinks and overlays; ``bmode`` only if it is displayed."""

    camera: StereoCamera
    probe: PhotoacousticSource
    operator: Operator
    stage: ReconnectingStage | None = None
    motion: MotionSource | None = None
    bmode: BmodeSource | None = None
    sinks: Sequence[TransformSink] = ()
    overlay: Sequence[PictureSink] = ()

    def roles(self) -> dict[str, Any]:
        """Devices that can be lost, by role; the stage reports its loss itself."""
        found: dict[str, Any] = {"camera": self.camera, "probe": self.probe, "operator": self.operator}
        if self.motion is not None:
            found["motion"] = self.motion
        if self.bmode is not None:
            found["bmode"] = self.bmode
        sink: TransformSink | PictureSink
        for number, sink in enumerate(self.sinks):
            found[f"sink {number + 1}"] = sink
        for number, sink in enumerate(self.overlay):
            found[f"overlay {number + 1}"] = sink
        return found

    def close(self) -> None:
        """Close all devices, the stage first."""
        if self.stage is not None:
            self.stage.close()
        for device in self.roles().values():
            device.close()


@dataclass(slots=True, eq=False)
class Figures:
    """Counts and latencies of the live loop.

    Attributes:
        latency_ms: from a frame's arrival to its stage order, or to the decision that there is none.
        frames, skipped: frames processed, and frames left out for a newer one or as repeated.
        found: frames in which the marker was found. pulses: taken in. orders: sent to the stage.
        pictures, unshown: B-mode pictures taken in, and dropped for newer ones by the driver or the loop.
    """

    latency_ms: deque[float] = field(default_factory=lambda: deque(maxlen=LATENCIES))
    frames: int = 0
    skipped: int = 0
    found: int = 0
    pulses: int = 0
    orders: int = 0
    pictures: int = 0
    unshown: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Status:
    """The session at one moment, for display.

    Attributes:
        now_s: host time. t: session time. stage: current stage of the workflow.
        text: last message to the operator. task: last message that was not about devices: what to do next.
        tracking: tracking result for the newest pose. plane: status of the stage. lost: roles of the lost devices.
        latched: why the stage may not move until a reset; empty if it may.
        pose, frame: newest. bmode: newest, None if its scanner is lost.
        invalid: why the registration is invalid, whatever its verdict was; empty if it is valid.
        heard: the last word in force and who said it. refused: the last refused one, with the reason.
        slow: what is too slow on this machine, why, and what to lower; empty if nothing is.
    """

    now_s: float
    t: float
    stage: str
    text: str
    task: str
    recorder: RecorderState
    tracking: TrackEstimate | None
    plane: StageView | None
    latched: str
    lost: tuple[str, ...]
    pose: TimedPose | None
    frame: StereoFrame | None
    bmode: BmodeFrame | None = None
    invalid: str = ""
    heard: str = ""
    refused: str = ""
    slow: str = ""

    @property
    def verdict(self) -> Verdict:
        """Current verdict; REFUSED if the registration is invalid."""
        return Verdict.REFUSED if self.invalid else self.recorder.registration.verdict

    @property
    def words(self) -> tuple[CommandKind, ...]:
        """The words that have an effect now, a stop first."""
        recorder, plane = self.recorder, self.plane
        usable = recorder.registration.registered and self.verdict is not Verdict.REFUSED
        work = {
            CommandKind.STOP: True,
            CommandKind.RESET: bool(self.latched),
            CommandKind.AIM: self.stage == Stage.AIMING,
            CommandKind.REGISTER: self.stage == Stage.AIMING,
            CommandKind.HOME: plane is not None and not self.latched,
            CommandKind.SEARCH: plane is not None and plane.homed and not self.latched,
            CommandKind.FOLLOW: plane is not None and plane.homed and not self.latched and usable,
            CommandKind.NEXT: plane is not None and plane.requested is MotionKind.SEARCH,
            CommandKind.MOVED: True,
            CommandKind.CHECK: plane is not None and plane.homed,
            CommandKind.POINT: plane is not None and plane.homed,
            CommandKind.VERIFY: plane is not None and usable,
            CommandKind.EXCLUDE: bool(recorder.pms - recorder.excluded),
            CommandKind.INCLUDE: bool(recorder.excluded),
        }
        return tuple(kind for kind, works in work.items() if works)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Reasons for the verdict."""
        return tuple(filter(None, (self.slow, self.invalid, *self.recorder.registration.reasons)))
