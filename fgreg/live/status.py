"""What a live session consists of, what it measures of itself, and how it stands at a moment. Plain data."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from fgreg.drivers.base import (
    BmodeFrame,
    BmodeSource,
    MotionSource,
    Operator,
    PhotoacousticSource,
    StereoCamera,
    StereoFrame,
    TransformSink,
)
from fgreg.live.actions import StageView
from fgreg.live.recorder import RecorderState
from fgreg.model.estimate import TrackEstimate, Verdict
from fgreg.model.time_sync import TimedPose
from fgreg.stage.reconnect import ReconnectingStage

LATENCIES = 100_000


@dataclass(slots=True, eq=False)
class Devices:
    """What is connected: one device a role, any number of sinks; ``bmode`` only where somebody looks at it."""

    camera: StereoCamera
    probe: PhotoacousticSource
    operator: Operator
    stage: ReconnectingStage | None = None
    motion: MotionSource | None = None
    bmode: BmodeSource | None = None
    sinks: Sequence[TransformSink] = ()

    def roles(self) -> dict[str, Any]:
        """Those that can be lost, by role."""
        found: dict[str, Any] = {"camera": self.camera, "probe": self.probe, "operator": self.operator}
        if self.motion is not None:
            found["motion"] = self.motion
        if self.bmode is not None:
            found["bmode"] = self.bmode
        for number, sink in enumerate(self.sinks):
            found[f"sink {number + 1}"] = sink
        return found

    def close(self) -> None:
        """Let go of all, the stage first."""
        if self.stage is not None:
            self.stage.close()
        for device in self.roles().values():
            device.close()


@dataclass(slots=True, eq=False)
class Figures:
    """What the loop measures of itself.

    Attributes:
        latency_ms: from a frame's arrival to its order, or to the knowledge that there is none.
        frames, skipped: frames looked into, and left out here: for newer ones, or the same as before.
        found: frames in which the marker was found. pulses: taken in. orders: sent to the stage.
        pictures, unshown: B-mode pictures taken in, and dropped for newer ones by the driver or here.
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
    """The session at one moment, for whoever shows it.

    Attributes:
        now_s: host time. t: session time. stage: how far it has come.
        text: last told to the operator. task: the last of that which was no news of devices, so what comes next.
        answer: where to turn for the newest pose. plane: the stage. lost: devices that are gone, by role.
        pose, frame: newest. bmode: newest, None where its scanner is gone.
        invalid: why what is known of the registration holds no more, whatever its verdict was; empty where it does.
    """

    now_s: float
    t: float
    stage: str
    text: str
    task: str
    recorder: RecorderState
    answer: TrackEstimate | None
    plane: StageView | None
    latched: str
    lost: tuple[str, ...]
    pose: TimedPose | None
    frame: StereoFrame | None
    bmode: BmodeFrame | None = None
    invalid: str = ""

    @property
    def verdict(self) -> Verdict:
        """Of the registration as it counts now."""
        return Verdict.REFUSED if self.invalid else self.recorder.known.verdict

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why."""
        return tuple(filter(None, (self.invalid, *self.recorder.known.reasons)))
