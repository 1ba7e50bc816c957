"""The roles a device can have, and the plain data they exchange. A driver is a class that fits one of the protocols.

Conventions for all of them:

- **Time.** Everything that comes in carries a :class:`Stamp`: the device's time and the host's, seconds. Host times are
  ``time.monotonic()`` (:func:`host_now`). ``fgreg.model.time_sync.DeviceClock`` brings device times onto the host's
  clock, ``fgreg.model.time_sync.PoseHistory`` and ``scan_at`` interpolate marker poses and stage angles to a laser
  pulse. Devices without a clock stamp both alike.
- **Never wait.** ``poll`` returns what is there, oldest first, or nothing, at once. What was not fetched in time is
  dropped by the driver, oldest first, and counted in ``dropped``: queues do not grow.
- **Loss.** A device that is gone raises :class:`DeviceLost` from ``poll`` or ``send``, once; after that the driver
  looks for it by itself, ``poll`` returns nothing, and ``connected`` says how things are.
- **Close.** ``close`` lets go of the device, may be called twice, and never raises.
- Frames: ``camera`` is the left camera, millimetres and radians (fgreg.geometry.transforms). Arrays are the receiver's
  own.

The stage is different in one point: only the watchdog process of ``fgreg.stage`` may hold a :class:`RotationStage`;
programs turn it through ``fgreg.stage.client.StageLink``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fgreg.errors import FgregError
from fgreg.geometry.transforms import FloatArray
from fgreg.model.time_sync import Stamp
from fgreg.stage.interface import RotationStage, StageError, StageLost, StageStatus

__all__ = [
    "BmodeFrame",
    "BmodeSource",
    "CommandKind",
    "DeviceLost",
    "DriverContext",
    "MotionSample",
    "MotionSource",
    "Operator",
    "OperatorCommand",
    "PaFrame",
    "PhotoacousticSource",
    "Registration",
    "RotationStage",
    "StageError",
    "StageLost",
    "StageStatus",
    "Stamp",
    "StereoCamera",
    "StereoFrame",
    "TransformSink",
    "host_now",
]


class DeviceLost(FgregError):  # noqa: N818
    """A device is gone: names the role, the device and what was seen; the driver tries to get it back."""


def host_now() -> float:
    """Now, on the host's clock (s): the same for all processes of the machine, set by nobody."""
    return time.monotonic()


@dataclass(frozen=True, slots=True, eq=False)
class StereoFrame:
    """One exposure of the endoscope.

    Attributes:
        stamp: the middle of the exposure, as well as the device knows it.
        left, right: 8 bit, (h, w) grey or (h, w, 3) BGR; ``right`` None for one camera.
        index: counts the device's frames, so that what was dropped shows.
    """

    stamp: Stamp
    left: npt.NDArray[np.uint8]
    right: npt.NDArray[np.uint8] | None
    index: int


@dataclass(frozen=True, slots=True, eq=False)
class PaFrame:
    """What the probe heard after one laser pulse.

    Attributes:
        stamp: the laser pulse.
        data: channel data (elements, samples) or envelope image (depth, lateral), as the session's probe says.
        index: counts the pulses.
    """

    stamp: Stamp
    data: npt.NDArray[Any]
    index: int


@dataclass(frozen=True, slots=True, eq=False)
class BmodeFrame:
    """One B-mode picture, to show with the rest; nothing is measured in it.

    Attributes:
        stamp: when it was taken, as well as the device knows it.
        image: 8 bit, (depth, lateral) grey or (depth, lateral, 3) BGR; columns along TRUS x.
        index: counts the device's pictures, so that what was dropped shows.
        pixel_mm: size of a pixel along depth and laterally, where the device tells it.
        origin_mm: depth below the array's face and TRUS x of the centre of pixel [0, 0], where that is known.
    """

    stamp: Stamp
    image: npt.NDArray[np.uint8]
    index: int
    pixel_mm: tuple[float, float] | None = None
    origin_mm: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MotionSample:
    """Where the endoscope is by its holder's own account: ``base_T_camera`` (4, 4), mm, with its (6, 6) covariance
    (right tangent) where the holder knows one."""

    stamp: Stamp
    base_T_camera: FloatArray
    covariance: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """What goes out to other programs.

    Attributes:
        stamp: of the data it rests on.
        verdict: ``ok``, ``warning`` or ``refused``; where refused, ``trus_T_camera`` is None.
        trus_T_camera, covariance: (4, 4), (6, 6) right tangent.
        scan_rad, sigma_rad: where the plane should be for the present beam, where that can be told.
        stage_rad: what the stage itself reads there, by its own zero and direction.
        reasons: the verdict's, plain sentences.
    """

    stamp: Stamp
    verdict: str
    trus_T_camera: FloatArray | None
    covariance: FloatArray | None
    scan_rad: float | None = None
    sigma_rad: float | None = None
    reasons: tuple[str, ...] = ()
    stage_rad: float | None = None


class Device(Protocol):
    """What all roles but the stage have in common."""

    @property
    def name(self) -> str:
        """What the user calls it: port, path, address."""

    @property
    def connected(self) -> bool:
        """Whether the device is there and answers."""

    @property
    def dropped(self) -> int:
        """Frames, samples or messages dropped so far because nobody fetched or took them in time."""

    def close(self) -> None:
        """Let go of the device."""


class CommandKind(StrEnum):
    """What an operator can say."""

    HOME = "home"
    AIM = "aim"
    NEXT = "next"
    REGISTER = "register"
    SEARCH = "search"
    FOLLOW = "follow"
    MOVED = "moved"
    STOP = "stop"
    RESET = "reset"


@dataclass(frozen=True, slots=True)
class OperatorCommand:
    """Words of the operator.

    ``home`` the stage; ``aim``: the beam is on this ``corner`` [column, row] of the board; ``register``: no more aims;
    ``search``, ``follow``: the stage may turn in search of PMs, after the beam; ``next``: leave this spot; ``moved``:
    the camera has moved; ``stop`` the stage at once; ``reset``: the latched stage was looked at, and may be asked to
    move again.
    """

    kind: CommandKind
    corner: tuple[int, int] | None = None


class Operator(Device, Protocol):
    """Whoever holds the fibre, and whoever speaks for them: a keyboard, a foot switch, a simulated surgeon."""

    def poll(self) -> Sequence[OperatorCommand]:
        """What was said since the last call. Raises DeviceLost."""

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:
        """Something they should know. ``done``: the present spot needs the fibre no longer; ``wants``: what they are
        asked to say."""


class StereoCamera(Device, Protocol):
    """The endoscope."""

    def poll(self) -> Sequence[StereoFrame]:
        """Frames since the last call. Raises DeviceLost."""


class PhotoacousticSource(Device, Protocol):
    """The ultrasound machine with the laser: one frame for each pulse."""

    def poll(self) -> Sequence[PaFrame]:
        """Frames since the last call. Raises DeviceLost."""


class BmodeSource(Device, Protocol):
    """A scanner's pictures for overlay."""

    def poll(self) -> Sequence[BmodeFrame]:
        """Pictures since the last call. Raises DeviceLost."""


class MotionSource(Device, Protocol):
    """Something that knows how the endoscope moves: a robot's kinematics."""

    def poll(self) -> Sequence[MotionSample]:
        """Samples since the last call. Raises DeviceLost."""


class TransformSink(Device, Protocol):
    """Somebody who wants to know the registration: a navigation program."""

    def send(self, registration: Registration) -> None:
        """Hand it on; where the receiver is slow only the newest is kept. Raises DeviceLost."""


@dataclass(frozen=True, slots=True, eq=False)
class DriverContext:
    """What drivers are given besides their options.

    Attributes:
        say: shows one line to the operator.
        corners: columns and rows of the board's inner corners.
        rectified: fgreg.drivers.rectification.Rectification of the endoscope's pictures, where that is wanted.
        room: socket of the simulated room, where there is one.
        paces: of recordings that play together; filled by the drivers.
    """

    say: Callable[[str], None]
    corners: tuple[int, int] | None = None
    rectified: Any = None
    room: Path | None = None
    paces: dict[tuple[Path, float], Any] = field(default_factory=dict)
