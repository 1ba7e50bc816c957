"""Devices from the options of a configuration; fgreg.drivers.registry names these functions."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

from fgreg.drivers.options import (
    BkOptions,
    Connection,
    EndoscopeOptions,
    IgtlBmodeOptions,
    IgtlMotionOptions,
    IgtlOperatorOptions,
    IgtlProbeOptions,
    IgtlSinkOptions,
    NoOptions,
    RecordedCameraOptions,
    RecordedMotionOptions,
    RoomStageOptions,
    StandInOptions,
    ThorlabsOptions,
)
from fgreg.drivers.registry import DriverContext

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
    from fgreg.drivers.recorded_devices import Pace
    from fgreg.drivers.tcp_link import Endpoint


def check_endoscope(options: EndoscopeOptions) -> EndoscopeConfig:
    """The endoscope's configuration. Raises ValueError: values that do not fit together."""
    from fgreg.drivers.endoscope import EndoscopeConfig, InputConfig, Layout
    from fgreg.drivers.interlacing import Fields

    def one(source: str) -> InputConfig:
        return InputConfig(
            source,
            options.width,
            options.height,
            options.fps,
            options.fourcc,
            options.loop,
            options.delay_s,
            options.silence_s,
        )

    right = None if options.right is None else one(options.right)
    layout = Layout(options.layout) if options.layout else (Layout.MONO if right is None else Layout.SEPARATE)
    if options.swap and layout in (Layout.MONO, Layout.SEPARATE):
        raise ValueError(f"swap is for frames that hold both views; layout is {layout}")
    fields = Fields(options.fields)
    return EndoscopeConfig(
        one(options.left), right, layout, options.swap, fields, options.max_gap_s, options.by_arrival
    )


def endoscope(context: DriverContext, options: EndoscopeOptions) -> StereoCamera:
    """One or two video inputs."""
    from fgreg.drivers.endoscope import Endoscope

    return Endoscope(check_endoscope(options), context.rectified)


def check_recorded_camera(options: RecordedCameraOptions) -> None:
    """Raises InputError: no recording, or no such images in it."""
    from fgreg.drivers.recorded_devices import RecordedCamera

    RecordedCamera(options.path, options.left, options.right, max_gap_s=options.max_gap_s).close()


def recorded_camera(context: DriverContext, options: RecordedCameraOptions) -> StereoCamera:
    """Images of a ROS 2 recording."""
    from fgreg.drivers.recorded_devices import RecordedCamera

    pace = _pace(context, options.path, options.speed)
    return RecordedCamera(options.path, options.left, options.right, pace, options.max_gap_s)


def check_recorded_motion(options: RecordedMotionOptions) -> None:
    """Raises InputError: no recording, or no such poses in it."""
    from fgreg.drivers.recorded_devices import RecordedMotion

    RecordedMotion(options.path, options.topic, options.tip_T_camera).close()


def recorded_motion(context: DriverContext, options: RecordedMotionOptions) -> MotionSource:
    """Poses of a ROS 2 recording."""
    from fgreg.drivers.recorded_devices import RecordedMotion

    pace = _pace(context, options.path, options.speed)
    return RecordedMotion(options.path, options.topic, options.tip_T_camera, pace)


def _pace(context: DriverContext, path: Path, speed: float) -> Pace:
    """One for all that play a recording, from the first of them on."""
    from fgreg.drivers.recorded_devices import Pace

    key = (path.resolve(), speed)
    if key not in context.paces:
        context.paces[key] = Pace.of(path, speed)
    pace: Pace = context.paces[key]
    return pace


def simulated_camera(context: DriverContext, _options: NoOptions) -> StereoCamera:
    """The simulated room's endoscope."""
    from fgreg.drivers.simulated import SimulatedCamera

    return SimulatedCamera(_room(context))


def simulated_probe(context: DriverContext, _options: NoOptions) -> PhotoacousticSource:
    """The simulated room's laser and ultrasound machine."""
    from fgreg.drivers.simulated import SimulatedProbe

    return SimulatedProbe(_room(context))


def simulated_motion(context: DriverContext, _options: NoOptions) -> MotionSource:
    """The simulated room's endoscope holder."""
    from fgreg.drivers.simulated import SimulatedMotion

    return SimulatedMotion(_room(context))


def simulated_scanner(context: DriverContext, _options: NoOptions) -> BmodeSource:
    """The simulated room's ultrasound pictures."""
    from fgreg.drivers.simulated import SimulatedScanner

    return SimulatedScanner(_room(context))


def simulated_operator(context: DriverContext, _options: NoOptions) -> Operator:
    """The simulated room's surgeon."""
    from fgreg.drivers.simulated import SimulatedOperator

    return SimulatedOperator(_room(context))


def _room(context: DriverContext) -> Path:
    if context.room is None:
        raise AssertionError("a device of the simulated room, and no room")
    return context.room


def igtl_photoacoustic(_context: DriverContext, options: IgtlProbeOptions) -> PhotoacousticSource:
    """Images over OpenIGTLink, one for each laser pulse."""
    from fgreg.drivers.igtl import IgtlPhotoacoustic

    return IgtlPhotoacoustic(_endpoint(options), options.device, options.transposed, options.silent_s)


def igtl_bmode(_context: DriverContext, options: IgtlBmodeOptions) -> BmodeSource:
    """B-mode images over OpenIGTLink."""
    from fgreg.drivers.igtl import IgtlBmode

    origin_mm = None if options.x_mm is None else (options.depth_mm, options.x_mm)
    return IgtlBmode(_endpoint(options), options.device, options.silent_s, origin_mm, options.flip)


def bk_bmode(_context: DriverContext, options: BkOptions) -> BmodeSource:
    """Pictures of a BK scanner."""
    from fgreg.drivers.bk_oem import BkOemScanner
    from fgreg.drivers.tcp_link import Endpoint

    return BkOemScanner(Endpoint(options.host, options.port), options.rate_hz, options.silent_s, options.flip)


def igtl_motion(_context: DriverContext, options: IgtlMotionOptions) -> MotionSource:
    """Transforms of the endoscope's holder."""
    from fgreg.drivers.igtl import IgtlMotion

    return IgtlMotion(_endpoint(options), options.device, options.inverted, options.silent_s)


def igtl_sink(_context: DriverContext, options: IgtlSinkOptions) -> TransformSink:
    """Whoever takes the registration."""
    from fgreg.drivers.igtl import IgtlTransformSink
    from fgreg.drivers.igtl_registration import DeviceNames

    names = DeviceNames(options.registration, options.plane, options.status, options.verdict)
    return IgtlTransformSink(_endpoint(options), names, options.header_version)


def keyboard(context: DriverContext, _options: NoOptions) -> Operator:
    """Whoever sits at the terminal."""
    from fgreg.drivers.keyboard import KeyboardOperator

    return KeyboardOperator(context.say, corners=context.corners)


def igtl_operator(context: DriverContext, options: IgtlOperatorOptions) -> Operator:
    """Texts over OpenIGTLink."""
    from fgreg.drivers.operators import IgtlOperator

    return IgtlOperator(_endpoint(options), options.device, options.answers, context.corners)


def ask_thorlabs(_context: DriverContext, options: ThorlabsOptions) -> str:
    """What a cube says of itself; nothing moves. Raises StageError: nobody answers, or somebody else."""
    from fgreg.drivers.thorlabs_identify import identify
    from fgreg.drivers.thorlabs_stage import only_port

    return str(identify(options.port or only_port()))


def ask_room_stage(context: DriverContext, _options: RoomStageOptions) -> str:
    """Where the simulated room's stage stands. Raises StageLost."""
    from fgreg.drivers.simulated import RoomStage
    from fgreg.simulation.config import default_stage

    stage = RoomStage(default_stage(), _room(context))
    try:
        status = stage.status()
    finally:
        stage.close()
    zero = "knows its zero position" if status.homed else "has to find its zero position"
    return f"stands at {math.degrees(status.scan_rad):.1f} deg by its own account, {zero}"


def ask_stand_in(_context: DriverContext, _options: StandInOptions) -> str:
    """Nobody is there."""
    return "simulated: nothing turns"


def ask_keyboard(_context: DriverContext, _options: NoOptions) -> str:
    """What standard input is; nothing is read. Raises DeviceLost where it is closed."""
    from fgreg.drivers.base import DeviceLost
    from fgreg.drivers.keyboard import standard_input

    fd = standard_input()
    if fd is None:
        raise DeviceLost("standard input is closed")
    return "standard input, a terminal" if os.isatty(fd) else "standard input, not a terminal"


def _endpoint(options: Connection) -> Endpoint:
    from fgreg.drivers.tcp_link import Endpoint

    return Endpoint(options.host, options.port, options.listen)
