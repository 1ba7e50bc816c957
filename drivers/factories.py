"""Devices from the options of a configuration (fgreg.drivers.registry names these functions)."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

from fgreg.drivers.registry import Surroundings
from fgreg.frames import FloatArray

if TYPE_CHECKING:
    from fgreg.drivers.base import (
        BmodeSource,
        MotionSource,
        Operator,
        PhotoacousticSource,
        StereoCamera,
        TransformSink,
    )
    from fgreg.drivers.endoscope import EndoscopeConfig
    from fgreg.drivers.recorded import Pace
    from fgreg.drivers.tcp_link import Endpoint


def check_endoscope(
    *,
    left: str,
    right: str | None,
    layout: str | None,
    swap: bool,
    fields: str,
    width: int | None,
    height: int | None,
    fps: float | None,
    fourcc: str | None,
    loop: bool,
    delay_s: float,
    max_gap_s: float,
    by_arrival: bool,
    silence_s: float,
) -> EndoscopeConfig:
    """The endoscope's configuration. Raises ValueError: values that do not fit together."""
    from fgreg.drivers.endoscope import EndoscopeConfig, InputConfig, Layout
    from fgreg.drivers.interlaced import Fields

    def one(source: str) -> InputConfig:
        return InputConfig(source, width, height, fps, fourcc, loop, delay_s, silence_s)

    chosen = Layout(layout) if layout else (Layout.MONO if right is None else Layout.SEPARATE)
    if swap and chosen in (Layout.MONO, Layout.SEPARATE):
        raise ValueError(f"swap is for frames that hold both views; layout is {chosen}")
    return EndoscopeConfig(
        one(left), None if right is None else one(right), chosen, swap, Fields(fields), max_gap_s, by_arrival
    )


def endoscope(around: Surroundings, **options: object) -> StereoCamera:
    """One or two video inputs."""
    from fgreg.drivers.endoscope import Endoscope

    return Endoscope(check_endoscope(**options), around.rectified)  # type: ignore[arg-type]


def check_recorded_camera(*, path: Path, left: str | None, right: str | None, max_gap_s: float, **_: object) -> None:
    """Raises InputError: no recording, or no such images in it."""
    from fgreg.drivers.recorded import RecordedCamera

    RecordedCamera(path, left, right, max_gap_s=max_gap_s).close()


def recorded_camera(
    around: Surroundings, *, path: Path, left: str | None, right: str | None, max_gap_s: float, speed: float
) -> StereoCamera:
    """Images of a ROS 2 recording."""
    from fgreg.drivers.recorded import RecordedCamera

    return RecordedCamera(path, left, right, _pace(around, path, speed), max_gap_s)


def check_recorded_motion(*, path: Path, topic: str | None, tip_T_camera: FloatArray | None, **_: object) -> None:
    """Raises InputError: no recording, or no such poses in it."""
    from fgreg.drivers.recorded import RecordedMotion

    RecordedMotion(path, topic, tip_T_camera).close()


def recorded_motion(
    around: Surroundings, *, path: Path, topic: str | None, tip_T_camera: FloatArray | None, speed: float
) -> MotionSource:
    """Poses of a ROS 2 recording."""
    from fgreg.drivers.recorded import RecordedMotion

    return RecordedMotion(path, topic, tip_T_camera, _pace(around, path, speed))


def _pace(around: Surroundings, path: Path, speed: float) -> Pace:
    """One for all that play a recording, from the first of them on."""
    from fgreg.drivers.recorded import Pace

    key = (path.resolve(), speed)
    if key not in around.paces:
        around.paces[key] = Pace.of(path, speed)
    pace: Pace = around.paces[key]
    return pace


def simulated_camera(around: Surroundings) -> StereoCamera:
    """The simulated room's endoscope."""
    from fgreg.drivers.simulated import SimulatedCamera

    return SimulatedCamera(_room(around))


def simulated_probe(around: Surroundings) -> PhotoacousticSource:
    """The simulated room's laser and ultrasound machine."""
    from fgreg.drivers.simulated import SimulatedProbe

    return SimulatedProbe(_room(around))


def simulated_motion(around: Surroundings) -> MotionSource:
    """The simulated room's endoscope holder."""
    from fgreg.drivers.simulated import SimulatedMotion

    return SimulatedMotion(_room(around))


def simulated_scanner(around: Surroundings) -> BmodeSource:
    """The simulated room's ultrasound pictures."""
    from fgreg.drivers.simulated import SimulatedScanner

    return SimulatedScanner(_room(around))


def simulated_operator(around: Surroundings) -> Operator:
    """The simulated room's surgeon."""
    from fgreg.drivers.simulated import SimulatedOperator

    return SimulatedOperator(_room(around))


def _room(around: Surroundings) -> Path:
    if around.room is None:
        raise AssertionError("a device of the simulated room, and no room")
    return around.room


def igtl_photoacoustic(
    _around: Surroundings, *, host: str, port: int, listen: bool, device: str, transposed: bool, silent_s: float | None
) -> PhotoacousticSource:
    """Images over OpenIGTLink, one for each laser pulse."""
    from fgreg.drivers.igtl import IgtlPhotoacoustic

    return IgtlPhotoacoustic(_endpoint(host, port, listen), device, transposed, silent_s)


def igtl_bmode(
    _around: Surroundings,
    *,
    host: str,
    port: int,
    listen: bool,
    device: str,
    depth_mm: float,
    x_mm: float | None,
    flip: bool,
    silent_s: float | None,
) -> BmodeSource:
    """B-mode images over OpenIGTLink."""
    from fgreg.drivers.igtl import IgtlBmode

    origin_mm = None if x_mm is None else (depth_mm, x_mm)
    return IgtlBmode(_endpoint(host, port, listen), device, silent_s, origin_mm, flip)


def bk_bmode(
    _around: Surroundings, *, host: str, port: int, rate_hz: int, flip: bool, silent_s: float | None
) -> BmodeSource:
    """Pictures of a BK scanner."""
    from fgreg.drivers.bk_oem import BkOemScanner

    return BkOemScanner(_endpoint(host, port, False), rate_hz, silent_s, flip)


def igtl_motion(
    _around: Surroundings, *, host: str, port: int, listen: bool, device: str, inverted: bool, silent_s: float | None
) -> MotionSource:
    """Transforms of the endoscope's holder."""
    from fgreg.drivers.igtl import IgtlMotion

    return IgtlMotion(_endpoint(host, port, listen), device, inverted, silent_s)


def igtl_sink(
    _around: Surroundings,
    *,
    host: str,
    port: int,
    listen: bool,
    registration: str,
    plane: str,
    status: str,
    verdict: str,
    header_version: int,
) -> TransformSink:
    """Whoever takes the registration."""
    from fgreg.drivers.igtl import IgtlTransformSink
    from fgreg.drivers.igtl_registration import DeviceNames

    names = DeviceNames(registration, plane, status, verdict)
    return IgtlTransformSink(_endpoint(host, port, listen), names, header_version)


def keyboard(around: Surroundings) -> Operator:
    """Whoever sits at the terminal."""
    from fgreg.drivers.keyboard import KeyboardOperator

    return KeyboardOperator(around.say, corners=around.corners)


def igtl_operator(around: Surroundings, *, host: str, port: int, listen: bool, device: str, answers: str) -> Operator:
    """Texts over OpenIGTLink."""
    from fgreg.drivers.operators import IgtlOperator

    return IgtlOperator(_endpoint(host, port, listen), device, answers, around.corners)


def ask_thorlabs(_around: Surroundings, *, port: str | None, **_: object) -> str:
    """What a cube says of itself; nothing moves. Raises StageError: nobody answers, or somebody else."""
    from fgreg.drivers.cube_identity import identify
    from fgreg.drivers.thorlabs_stage import only_port

    return str(identify(port or only_port()))


def ask_room_stage(around: Surroundings) -> str:
    """Where the simulated room's stage stands. Raises StageLost."""
    from fgreg.drivers.simulated import RoomStage
    from fgreg.simulation.config import default_stage

    stage = RoomStage(default_stage(), _room(around))
    try:
        status = stage.status()
    finally:
        stage.close()
    zero = "knows its zero position" if status.homed else "has to find its zero position"
    return f"stands at {math.degrees(status.scan_rad):.1f} deg by its own account, {zero}"


def ask_stand_in(_around: Surroundings, **_: object) -> str:
    """Nobody is there."""
    return "simulated: nothing turns"


def ask_keyboard(_around: Surroundings) -> str:
    """What standard input is; nothing is read. Raises DeviceLost where it is closed."""
    from fgreg.drivers.base import DeviceLost
    from fgreg.drivers.keyboard import standard_input

    fd = standard_input()
    if fd is None:
        raise DeviceLost("standard input is closed")
    return "standard input, a terminal" if os.isatty(fd) else "standard input, not a terminal"


def _endpoint(host: str, port: int, listen: bool) -> Endpoint:
    from fgreg.drivers.tcp_link import Endpoint

    return Endpoint(host, port, listen)
