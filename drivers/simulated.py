"""Drivers of the simulated room's devices: they connect to its process (fgreg.drivers.simulated_room).

A lost connection is opened again automatically, as with a real device.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import socket
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np

from fgreg.drivers.base import (
    BmodeFrame,
    CommandKind,
    DeviceLost,
    MotionSample,
    OperatorCommand,
    PaFrame,
    StereoFrame,
    host_now,
)
from fgreg.drivers.simulated_room import simulated
from fgreg.drivers.simulated_stage import SimulatedStage
from fgreg.drivers.simulated_wire import WireClosed, receive, send
from fgreg.errors import FgregError
from fgreg.geometry.transforms import as_float_array
from fgreg.model.session_model import StageModel
from fgreg.model.time_sync import Stamp
from fgreg.simulation.config import default_stage
from fgreg.simulation.room import BUMP_EVERY_S
from fgreg.stage.interface import MAX_CALL_S, StageLost, StageStatus
from fgreg.workers.worker_process import Work, WorkerProcess

if TYPE_CHECKING:
    from fgreg.drivers.base import BmodeSource, DriverContext, MotionSource, Operator, PhotoacousticSource, StereoCamera
    from fgreg.drivers.options import NoOptions, RoomStageOptions

AGAIN_S = 0.2
"""Time between attempts to connect."""
SILENT_S, INTERVALS, MOST_SILENT_S = 1.0, 5.0, 3.0
"""A device that sends by itself is lost after this long without data; where a busy machine delays them, after this many
of its intervals, but at most the last."""
START_S = 60.0
TRUTH_S = 20.0
"""Longest time that a room may take to send the ground truth."""

BEGINS_RAD = math.radians(-17.0)
"""True device angle of the stage at power-on, which the stage does not know."""

Item = TypeVar("Item")


class RoomProcess:
    """Starts a room, and ends it when closed or when this program ends. Use as a context manager.

    Args:
        seed, width_px, aims, bump_every_s, static_tags: of the room (fgreg.simulation.room).
        run: another room to run in its place, given the path of the socket.

    Attributes:
        path: of the socket that its devices are reached by.

    Raises:
        FgregError: the room did not start.
    """

    def __init__(
        self,
        seed: int = 1,
        width_px: int = 640,
        aims: int = 10,
        bump_every_s: float = BUMP_EVERY_S,
        *,
        static_tags: int = 0,
        run: Callable[[Path], AbstractContextManager[Work[tuple[str, str], None]]] | None = None,
    ) -> None:
        run = run or partial(
            simulated, seed=seed, width_px=width_px, aims=aims, bump_every_s=bump_every_s, static_tags=static_tags
        )
        self._folder = Path(tempfile.mkdtemp(prefix="fgreg-room-"))  # of mode 0700
        self.path = self._folder / "socket"
        self._worker: WorkerProcess[tuple[str, str], None] = WorkerProcess(
            run, self.path, name="fgreg-room", what="the simulated room", niceness=0, end_s=3.0, restart=False
        )
        try:
            self.fault("camera", "")
        except FgregError:
            self.close()
            raise

    def __enter__(self) -> RoomProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fault(self, device: str, what: str) -> None:
        """Give one of its devices a fault, or remove it with an empty text (fgreg.drivers.simulated_room.FAULTS).

        Raises:
            FgregError: there is no such device or fault, or the room has ended.
        """
        self._worker.send((device, what))
        self._worker.fetch(math.inf)
        if self._worker.failure:
            raise FgregError(self._worker.failure)

    def close(self) -> None:
        """End the room's process."""
        self._worker.close()
        shutil.rmtree(self._folder, ignore_errors=True)


class _Feed(Generic[Item]):
    """Receives the data of one of the room's devices in a thread; base class of the drivers."""

    def __init__(
        self, role: str, path: Path, most: int, made: Callable[[dict[str, Any], bytearray], Item], *, sends: bool
    ) -> None:
        self._role, self._path, self._made, self._sends = role, path, made, sends
        self._waiting: deque[Item] = deque()
        self._most, self._lock = most, threading.Lock()
        self._connection: socket.socket | None = None
        self._end, self._lost, self._dropped = threading.Event(), "", 0
        self._received_s = self._since_s = -np.inf
        self._interval_s = 0.0  # between data, smoothed
        self._index: int | None = None
        self._thread = threading.Thread(target=self._run, name=f"simulated {role}", daemon=True)
        self._thread.start()

    @property
    def name(self) -> str:
        """Name shown to the user."""
        return f"simulated {self._role}"

    @property
    def connected(self) -> bool:
        """Whether the device is connected, and sends if it has to."""
        if self._connection is None:
            return False
        silent_s = min(max(SILENT_S, INTERVALS * self._interval_s), MOST_SILENT_S)
        return host_now() - self._received_s < silent_s if self._sends else self._steady()

    def _steady(self) -> bool:
        """Whether the room has kept the connection; it closes one to a device with a fault at once."""
        return host_now() - self._since_s > AGAIN_S

    @property
    def dropped(self) -> int:
        """Number of items that were lost because they were not fetched in time."""
        return self._dropped

    def poll(self) -> Sequence[Item]:
        """Items since the last call.

        Raises:
            DeviceLost: the connection is lost; raised once.
        """
        with self._lock:
            items, lost = list(self._waiting), self._lost
            self._waiting.clear()
            self._lost = ""
        if lost:
            raise DeviceLost(lost)
        return items

    def close(self) -> None:
        """Close the connection."""
        self._end.set()
        self._shut()
        self._thread.join(2.0)

    def _shut(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def _run(self) -> None:
        while not self._end.is_set():
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                connection.connect(os.fspath(self._path))
                send(connection, {"role": self._role})
            except (OSError, WireClosed):
                connection.close()
                self._end.wait(AGAIN_S)
                continue
            self._connection, self._index, self._since_s = connection, None, host_now()
            try:
                while not self._end.is_set():
                    self._take(*receive(connection))
            except (WireClosed, KeyError, TypeError, ValueError) as error:
                if self._steady() and not self._end.is_set():
                    with self._lock:
                        self._lost = f"{self.name} is gone ({error})"
            self._shut()
            self._end.wait(AGAIN_S)

    def _take(self, header: dict[str, Any], payload: bytearray) -> None:
        index = header.get("index")
        if isinstance(index, int):
            if self._index is not None:
                self._dropped += max(0, index - self._index - 1)
            self._index = index
        item = self._made(header, payload)
        now_s = host_now()
        if now_s - self._received_s < MOST_SILENT_S:
            self._interval_s += 0.2 * (now_s - self._received_s - self._interval_s)
        self._received_s = now_s
        with self._lock:
            self._waiting.append(item)
            while len(self._waiting) > self._most:
                self._waiting.popleft()
                self._dropped += 1


def _stereo(header: dict[str, Any], payload: bytearray) -> StereoFrame:
    height, width = header["shape"]
    both = np.frombuffer(payload, dtype=np.uint8).reshape(2, height, width)
    return StereoFrame(Stamp(header["device_s"], host_now()), both[0], both[1], header["index"])


def _pa(header: dict[str, Any], payload: bytearray) -> PaFrame:
    data = np.frombuffer(payload, dtype=np.int16).reshape(header["shape"])
    return PaFrame(Stamp(header["device_s"], host_now()), data, header["index"])


def _motion(header: dict[str, Any], _payload: bytearray) -> MotionSample:
    return MotionSample(Stamp(header["device_s"], host_now()), as_float_array(header["pose"], 4, 4))


def _bmode(header: dict[str, Any], payload: bytearray) -> BmodeFrame:
    image = np.frombuffer(payload, dtype=np.uint8).reshape(header["shape"])
    stamp = Stamp(header["device_s"], host_now())
    return BmodeFrame(stamp, image, header["index"], tuple(header["pixel_mm"]), tuple(header["origin_mm"]))


def _command(header: dict[str, Any], _payload: bytearray) -> OperatorCommand:
    corner = header.get("corner")
    return OperatorCommand(CommandKind(header["says"]), None if corner is None else (int(corner[0]), int(corner[1])))


class SimulatedCamera(_Feed[StereoFrame]):
    """The endoscope (StereoCamera)."""

    def __init__(self, path: Path) -> None:
        super().__init__("camera", path, 2, _stereo, sends=True)


class SimulatedProbe(_Feed[PaFrame]):
    """Laser and ultrasound machine (PhotoacousticSource)."""

    def __init__(self, path: Path) -> None:
        super().__init__("probe", path, 64, _pa, sends=True)


class SimulatedMotion(_Feed[MotionSample]):
    """The endoscope's holder (MotionSource)."""

    def __init__(self, path: Path) -> None:
        super().__init__("motion", path, 64, _motion, sends=True)


class SimulatedScanner(_Feed[BmodeFrame]):
    """The ultrasound machine's pictures (BmodeSource)."""

    def __init__(self, path: Path) -> None:
        super().__init__("scanner", path, 2, _bmode, sends=True)


class SimulatedOperator(_Feed[OperatorCommand]):
    """The surgeon, who sends commands and goes on when told that a spot is done (Operator)."""

    def __init__(self, path: Path) -> None:
        super().__init__("operator", path, 64, _command, sends=False)

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:  # noqa: ARG002
        """Send a message: the surgeon goes on to the next spot, and sends the command that is asked for."""
        connection = self._connection
        if connection is not None and (done or wants is not None):
            with contextlib.suppress(WireClosed):
                send(connection, {"next": done, "say": wants})


class RoomStage(SimulatedStage):
    """The room's stage. It turns in the watchdog's process, and sends the room its true angle at every status query.

    Args:
        model: direction and zero.
        path: of the room's socket.

    Raises:
        StageLost: the room does not answer.
    """

    def __init__(self, model: StageModel, path: Path) -> None:
        super().__init__(model, device_rad=BEGINS_RAD)
        self._room = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._room.connect(os.fspath(path))
            send(self._room, {"role": "stage"})
        except (OSError, WireClosed) as error:
            self._room.close()
            raise StageLost(f"simulated stage: the room is not there ({error})") from None
        self._room.settimeout(MAX_CALL_S)

    def status(self) -> StageStatus:
        """The reported status; the room gets the true angle."""
        status = super().status()
        try:
            scan_rad = self.model.scan_from_device(self.device_rad)
            send(self._room, {"scan": scan_rad, "at_s": host_now()})
        except WireClosed as error:
            self._room.close()
            raise StageLost(f"simulated stage: the room is gone ({error})") from None
        return status

    def close(self) -> None:
        """Brake and close."""
        super().close()
        self._room.close()


def ask_truth(path: Path, camera_s: Sequence[float], spots_s: Sequence[float]) -> dict[str, Any]:
    """As :meth:`fgreg.simulation.room.Room.truth_at` of the room whose socket is at ``path``, in host time.

    Raises:
        FgregError: the room does not answer.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(TRUTH_S)
        try:
            connection.connect(os.fspath(path))
            send(connection, {"role": "truth"})
            send(connection, {}, json.dumps({"camera_s": [*camera_s], "spots_s": [*spots_s]}).encode())
            truth = json.loads(receive(connection)[1])
        except (OSError, WireClosed, ValueError) as error:
            raise FgregError(f"the simulated room does not send its ground truth ({error})") from None
    if not isinstance(truth, dict):
        raise FgregError("the simulated room does not send its ground truth")
    return truth


def open_stage(model: StageModel, path: str) -> RoomStage:
    """The stage of the room whose socket is at ``path``, for the watchdog."""
    return RoomStage(model, Path(path))


def open_camera(context: DriverContext, _options: NoOptions) -> StereoCamera:
    """The simulated room's endoscope."""
    return SimulatedCamera(_room(context))


def open_probe(context: DriverContext, _options: NoOptions) -> PhotoacousticSource:
    """The simulated room's laser and ultrasound machine."""
    return SimulatedProbe(_room(context))


def open_motion(context: DriverContext, _options: NoOptions) -> MotionSource:
    """The simulated room's endoscope holder."""
    return SimulatedMotion(_room(context))


def open_scanner(context: DriverContext, _options: NoOptions) -> BmodeSource:
    """The simulated room's ultrasound pictures."""
    return SimulatedScanner(_room(context))


def open_operator(context: DriverContext, _options: NoOptions) -> Operator:
    """The simulated room's surgeon."""
    return SimulatedOperator(_room(context))


def ask_stage(context: DriverContext, _options: RoomStageOptions) -> str:
    """Where the simulated room's stage stands. Raises StageLost."""
    stage = RoomStage(default_stage(), _room(context))
    try:
        status = stage.status()
    finally:
        stage.close()
    zero = "knows its zero position" if status.homed else "has to find its zero position"
    return f"stands at {math.degrees(status.scan_rad):.1f} deg by its own account, {zero}"


def _room(context: DriverContext) -> Path:
    if context.room is None:
        raise AssertionError("a device of the simulated room, and no room")
    return context.room
