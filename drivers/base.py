"""The roles a device can have, and the plain data they exchange. A driver is a class that fits one of the protocols.

Conventions for all of them:

- **Time.** All incoming data carry a :class:`Stamp`: the device's time and the host's, seconds. Host times are
  ``time.monotonic()`` (:func:`host_now`). ``fgreg.model.time_sync.DeviceClock`` maps device times to the host's clock,
  ``fgreg.model.time_sync.PoseHistory`` interpolates marker poses to a laser pulse. A device without a clock stamps both
  with the host's time.
- **Never wait.** ``poll`` returns at once with the waiting items, oldest first. The driver drops items that are not
  fetched in time, oldest first, and counts them in ``dropped``: queues do not grow.
- **Loss.** A lost device raises :class:`DeviceLost` from ``poll`` or ``send``, once. After that the driver reconnects
  by itself; meanwhile ``poll`` returns nothing and ``connected`` is False.
- **Close.** ``close`` releases the device, may be called twice, and never raises.
- Frames: ``camera`` is the left camera, millimetres and radians (fgreg.geometry.transforms). Arrays are the receiver's
  own.

The stage differs in one point: only the watchdog process of ``fgreg.stage`` may hold a :class:`RotationStage`;
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


class DeviceLost(FgregError):  # noqa: N818
    """A device is lost; the text names role, device and symptom. The driver tries to reconnect."""


def host_now() -> float:
    """Now on the host's monotonic clock (s), which is the same for all processes of the machine."""
    return time.monotonic()


@dataclass(frozen=True, slots=True, eq=False)
class StereoFrame:
    """One exposure of the endoscope.

    Attributes:
        stamp: the middle of the exposure, as precisely as the device knows it.
        left, right: 8 or 16 bit, (h, w) grey or (h, w, 3) BGR; ``right`` None for one camera.
        index: counts the device's frames, so that gaps show dropped ones.
    """

    stamp: Stamp
    left: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
    right: npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | None
    index: int


@dataclass(frozen=True, slots=True, eq=False)
class PaFrame:
    """The probe's data after one laser pulse.

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
    """One B-mode picture, for display only.

    Attributes:
        stamp: when it was taken, as precisely as the device knows it.
        image: 8 bit, (depth, lateral) grey or (depth, lateral, 3) BGR; columns along TRUS x.
        index: counts the device's pictures, so that gaps show dropped ones.
        pixel_mm: size of a pixel along depth and laterally; None if unknown.
        origin_mm: depth below the array's face and TRUS x of the centre of pixel [0, 0]; None if unknown.
    """

    stamp: Stamp
    image: npt.NDArray[np.uint8]
    index: int
    pixel_mm: tuple[float, float] | None = None
    origin_mm: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MotionSample:
    """The endoscope's pose as its holder measures it: ``base_T_camera`` (4, 4), mm, with its (6, 6) covariance (right
    tangent; rad, mm) or None."""

    stamp: Stamp
    base_T_camera: FloatArray
    covariance: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The registration as it is sent to other programs.

    Attributes:
        stamp: of the newest data behind it.
        verdict: ``ok``, ``warning`` or ``refused``; if refused, ``trus_T_camera`` is None.
        trus_T_camera, covariance: (4, 4), mm; (6, 6), right tangent (rad, mm).
        scan_rad, sigma_rad: plane angle for the current beam and its sigma; None if unknown.
        stage_rad: the same angle as the stage reads it, with its own zero and direction.
        reasons: of the verdict, plain sentences.
    """

    stamp: Stamp
    verdict: str
    trus_T_camera: FloatArray | None
    covariance: FloatArray | None
    scan_rad: float | None = None
    sigma_rad: float | None = None
    reasons: tuple[str, ...] = ()
    stage_rad: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class OverlayPicture:
    """The endoscope's left picture with what is known of the registration drawn on it.

    Attributes:
        stamp: of the exposure.
        image: (h, w, 3) BGR.
        index: of the frame.
    """

    stamp: Stamp
    image: npt.NDArray[np.uint8]
    index: int


class Device(Protocol):
    """Interface that all roles except the stage share."""

    @property
    def name(self) -> str:
        """Name shown to the user: port, path or address."""

    @property
    def connected(self) -> bool:
        """Whether the device is connected and answers."""

    @property
    def dropped(self) -> int:
        """Number of frames, samples or messages dropped because they were not fetched or taken in time."""

    def close(self) -> None:
        """Release the device."""


class CommandKind(StrEnum):
    """Commands of an operator."""

    HOME = "home"
    AIM = "aim"
    NEXT = "next"
    REGISTER = "register"
    SEARCH = "search"
    FOLLOW = "follow"
    MOVED = "moved"
    CHECK = "check"
    POINT = "point"
    VERIFY = "verify"
    EXCLUDE = "exclude"
    INCLUDE = "include"
    STOP = "stop"
    RESET = "reset"


@dataclass(frozen=True, slots=True)
class OperatorCommand:
    """One command of the operator.

    ``home`` the stage; ``aim``: the beam is on this ``corner`` [column, row] of the board; ``register``: no more aims;
    ``search``, ``follow``: the stage may turn to search for PMs, or to follow the beam; ``next``: leave this spot;
    ``moved``: the camera has moved; ``check``: a point that both devices show now, at ``point`` (u, v in the left frame
    and u, v in the right one, px; x and range in the image plane, mm); ``point``: the same as data of the registration;
    ``verify`` the registration with new PMs, which are not added to it; ``exclude``, ``include``: the looks at ``pm``
    do not count, or count again; ``stop`` the stage at once; ``reset``: the latched stage has been inspected, and
    motions may be requested again.

    ``said_s``: host time at which it was said, or arrived. ``peer``: who said it; empty if unknown.
    """

    kind: CommandKind
    corner: tuple[int, int] | None = None
    point: tuple[float, float, float, float, float, float] | None = None
    pm: int | None = None
    said_s: float = field(default_factory=host_now, compare=False)
    peer: str = field(default="", compare=False)


@dataclass(frozen=True, slots=True)
class RefusedWord:
    """A command that was understood and is not obeyed: ``word``, who said it, and why not."""

    word: CommandKind
    peer: str
    reason: str

    @property
    def text(self) -> str:
        """One line."""
        return f"{self.word} from {self.peer or 'the operator'} is refused: {self.reason}"


class Operator(Device, Protocol):
    """Source of the operator's commands: a keyboard, a foot switch, a simulated surgeon."""

    def poll(self) -> Sequence[OperatorCommand | RefusedWord]:
        """Commands since the last call, and those that the driver refuses. Raises DeviceLost."""

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:
        """Show a message. ``done``: the current spot is finished; ``wants``: the command that is asked for."""


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
    """Source of the endoscope's motion: a robot's kinematics."""

    def poll(self) -> Sequence[MotionSample]:
        """Samples since the last call. Raises DeviceLost."""


class TransformSink(Device, Protocol):
    """Receiver of the registration: a navigation program."""

    def send(self, registration: Registration) -> None:
        """Send the registration; for a slow receiver only the newest is kept. Raises DeviceLost."""


class PictureSink(Device, Protocol):
    """Display of the endoscope's picture with the registration drawn on it: a window, a program that takes pictures."""

    def send(self, picture: OverlayPicture) -> None:
        """Show a picture; of several that wait only the newest is. Raises DeviceLost."""


@dataclass(frozen=True, slots=True, eq=False)
class DriverContext:
    """What drivers get besides their options.

    Attributes:
        say: shows one line to the operator.
        typing: shows what has been typed of a line at the terminal; None where the terminal does that itself.
        corners: columns and rows of the board's inner corners.
        rectified: fgreg.drivers.rectification.Rectification of the endoscope's pictures, or None.
        room: socket of the simulated room, or None.
        paces: shared by devices that play one recording together; filled by the drivers.
    """

    say: Callable[[str], None]
    corners: tuple[int, int] | None = None
    rectified: Any = None
    room: Path | None = None
    paces: dict[tuple[Path, float], Any] = field(default_factory=dict)
    typing: Callable[[str], None] | None = None
