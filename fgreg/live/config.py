"""CONFIG.yaml of ``fgreg live``: a driver for each role, read and checked before any device is opened.

``example_config`` shows all of its keys. Paths are relative to the file's folder.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fgreg.convert.write import camera_yaml
from fgreg.drivers.base import DriverContext, Operator
from fgreg.drivers.options import (
    Connection,
    EndoscopeOptions,
    IgtlOperatorOptions,
    NoOptions,
    Ros2OperatorOptions,
)
from fgreg.drivers.registry import SEVERAL, DriverEntry, Role, drivers_of
from fgreg.drivers.word_keys import read_key
from fgreg.errors import InputError
from fgreg.live.config_keys import LIVE, CalibrationOptions, LiveDocument, LiveSettings, RoomOptions
from fgreg.live.launch import LiveSetup, StageSetup, setup_text
from fgreg.live.scope_holder import HolderSettings
from fgreg.live.simulated_room import HEARING_THRESHOLD, room_truth
from fgreg.live.status import Devices
from fgreg.live.workflow import WorkflowSettings
from fgreg.model.camera_model import StereoRig
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.time_sync import Latencies
from fgreg.schema.problems import FieldError, input_error, nearest, place_text
from fgreg.schema.record import record
from fgreg.session.session_reader import SETUP_FILE
from fgreg.session.setup_reader import read_setup
from fgreg.session.yaml_loader import load_yaml, parse_yaml, read_bounded
from fgreg.stage.limits import MotionLimits


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """A checked driver with its checked options; ``where`` names the place in the file."""

    entry: DriverEntry
    options: Any
    where: str

    def open(self, context: DriverContext) -> Any:
        """Open the device. Raises what its driver raises."""
        return self.entry.open(context, self.options)


@dataclass(frozen=True, slots=True, eq=False)
class LiveConfig:
    """A CONFIG.yaml, read and checked.

    Attributes:
        setup: text of the new session's ``session.yaml``. model: its content.
        devices: by role; ``sinks``, ``overlay`` and ``operator`` may have several.
        stage_limits: arguments of MotionLimits.of_session.
        room: options of the simulated room, if its devices are used.
        rectified: fgreg.drivers.rectification.Rectification, if the pictures are to be rectified.
        settings, holder, latencies, solve: of the workflow, the endoscope's holder, the devices, the estimate.
        warnings: sentences about settings that are allowed but probably a mistake.
    """

    path: Path
    setup: str
    model: SessionModel
    devices: Mapping[Role, tuple[Chosen, ...]]
    stage_limits: Mapping[str, Any]
    room: RoomOptions | None
    rectified: Any
    settings: WorkflowSettings
    holder: HolderSettings
    latencies: Latencies
    solve: SolveConfig
    warnings: tuple[str, ...]

    def context(
        self, stack: ExitStack, say: Callable[[str], None], typing: Callable[[str], None] | None = None
    ) -> DriverContext:
        """What the drivers need; if the simulated room is used, it is started and runs until the stack is left."""
        room = None
        if self.room is not None:
            from fgreg.drivers.simulated import RoomProcess

            process = RoomProcess(
                self.room.seed,
                self.room.width,
                self.settings.aims,
                self.room.bump_every_s,
                static_tags=self.room.static_tags,
            )
            room = stack.enter_context(process).path
        board = self.model.board
        return DriverContext(
            say, None if board is None else (board.columns, board.rows), self.rectified, room, typing=typing
        )

    def live_setup(
        self,
        stack: ExitStack,
        say: Callable[[str], None],
        *,
        seen: bool = True,
        typing: Callable[[str], None] | None = None,
    ) -> LiveSetup:
        """Set-up of the live session. Opens no device, but starts the simulated room if it is used.

        Args:
            stack: ends the room.
            say: shows one line to an operator at the terminal; called from several threads.
            seen: whether pictures that are only displayed are wanted; if not, their device is not opened.
            typing: shows what is being typed at the terminal; None where the terminal shows it itself.
        """
        context = self.context(stack, say, typing)

        def open_devices(devices: ExitStack, _model: SessionModel) -> Devices:
            def opened(chosen: Chosen) -> Any:
                device = chosen.open(context)
                devices.callback(device.close)
                return device

            roles = [role for role in _ONE_EACH if role in self.devices and (seen or role is not Role.BMODE)]
            first = {role: opened(self.devices[role][0]) for role in roles}
            return Devices(
                first[Role.CAMERA],
                first[Role.PHOTOACOUSTIC],
                _together([opened(chosen) for chosen in self.devices[Role.OPERATOR]]),
                motion=first.get(Role.MOTION),
                bmode=first.get(Role.BMODE),
                sinks=tuple(opened(chosen) for chosen in self.devices.get(Role.SINKS, ())),
                overlay=tuple(opened(chosen) for chosen in self.devices.get(Role.OVERLAY, ())),
            )

        return LiveSetup(
            self.setup,
            open_devices,
            self.stage_setup(context),
            self.settings,
            self.holder,
            self.latencies,
            None if context.room is None else room_truth(context.room),
            self.model.rig_file,
        )

    def stage_setup(self, context: DriverContext) -> StageSetup | None:
        """The stage's driver, options and limits for the watchdog; None if there is no stage."""
        chosen = self.devices.get(Role.STAGE)
        if chosen is None:
            return None
        driver, options = chosen[0].entry.for_watchdog(context, chosen[0].options)
        limits = dict(self.stage_limits)
        if (acceleration := getattr(chosen[0].options, "acceleration_deg_s2", None)) is not None:
            limits["deceleration_rad_s2"] = math.radians(acceleration)  # the driver brakes with this acceleration
        return StageSetup(driver, options, limits)


_ONE_EACH = (Role.CAMERA, Role.PHOTOACOUSTIC, Role.MOTION, Role.BMODE)


def _together(operators: list[Operator]) -> Operator:
    if len(operators) == 1:
        return operators[0]
    from fgreg.drivers.operators import Operators

    return Operators(operators)


def read_config(path: Path) -> LiveConfig:
    """Read a CONFIG.yaml. No device is opened.

    Raises:
        InputError: the first problem, with file, key and line.
        MissingExtraError: a driver's library is not installed.
    """
    data = load_yaml(path, path.name)
    try:
        return _Reader(path, data).read()
    except FieldError as error:
        raise input_error(error.problems[0], path.name, data) from None


@dataclass(slots=True, eq=False)
class _Reader:
    """Reads one file; its methods raise FieldError, InputError."""

    path: Path
    data: Mapping[str, object]
    warnings: list[str] = field(default_factory=list)

    def read(self) -> LiveConfig:
        simulated = _uses_room(self.data)
        document: LiveDocument = LIVE.read(_with_room(self.data) if simulated else self.data, self.path.parent)
        devices = self._devices(document)
        room = self._room(document, devices)
        settings = document.settings
        if settings is None:
            raise FieldError.of("nothing", record(LiveSettings).expected, "settings")
        setup, label, rectified = self._session(document, devices, room, settings.workflow.aims)
        model = self._model(setup, label, document)
        _check_model(model, devices, settings.workflow.aims)
        limits = (document.stage[1].limits if document.stage else None) or {}
        if document.stage:
            _check_limits(model, limits)
        _check_ports(devices)
        _check_keys(devices)
        self.warnings += _open_to_all(devices)
        return LiveConfig(
            self.path,
            setup,
            model,
            devices,
            limits,
            room,
            rectified,
            settings.workflow,
            settings.holder,
            settings.latencies,
            settings.solve,
            tuple(self.warnings),
        )

    def _devices(self, document: LiveDocument) -> dict[Role, tuple[Chosen, ...]]:
        """The drivers of each role; the default operator is the keyboard."""
        found: dict[Role, tuple[Chosen, ...]] = {}
        for role in Role:
            chosen = getattr(document, role)
            several = chosen if role in SEVERAL else () if chosen is None else (chosen,)
            listed = isinstance(self.data.get(role), list)
            places = [
                place_text((role, i) if listed else (role,), self.path.name, self.data) for i in range(len(several))
            ]
            if several:
                found[role] = tuple(
                    Chosen(entry, options, place) for (entry, options), place in zip(several, places, strict=True)
                )
        if Role.OPERATOR not in found:
            keyboard = drivers_of(Role.OPERATOR)["keyboard"]
            found[Role.OPERATOR] = (Chosen(keyboard, NoOptions(), place_text((Role.OPERATOR,), self.path.name)),)
        return found

    def _room(self, document: LiveDocument, devices: Mapping[Role, tuple[Chosen, ...]]) -> RoomOptions | None:
        """The room's options; its camera, probe and stage are used together, since they measure the same scene."""
        simulated = [role for role, chosen in devices.items() if any(one.entry.room for one in chosen)]
        world = [role for role in (Role.CAMERA, Role.PHOTOACOUSTIC, Role.STAGE) if role in devices]
        for role in world:
            if simulated and role not in simulated:
                found = f"{devices[role][0].entry.name}, and {simulated[0]} of the simulated room"
                raise FieldError.of(found, "camera, photoacoustic and stage all simulated, or none", role)
        if not simulated:
            if document.room is not None:
                raise FieldError.of("a room of which no device is used", "drivers called simulated", "room")
            return None
        for key in ("session", "calibration"):
            if key in self.data:
                expected = "one of the two: the room brings a set-up of its own"
                raise FieldError.of("it, and the simulated room", expected, key)
        if Role.OPERATOR not in simulated:
            self.warnings.append(
                f"{self.path.name}: without a simulated operator no one tells the room's surgeon to go on"
            )
        return document.room or RoomOptions()

    def _model(self, setup: str, label: str, document: LiveDocument) -> SessionModel:
        problems: list[InputError] = []
        path = document.session
        folder = None if path is None else (path if path.is_dir() else path.parent).resolve()
        found = read_setup(parse_yaml(setup, label), label, "session", problems, folder)
        self.warnings += found.warnings
        if found.model is None:
            raise problems[0]
        return found.model

    def _session(
        self,
        document: LiveDocument,
        devices: Mapping[Role, tuple[Chosen, ...]],
        room: RoomOptions | None,
        aims: int,
    ) -> tuple[str, str, Any]:
        """Text of the ``session.yaml``, its name in messages, the rectification of the pictures."""
        if room is not None:
            from fgreg.simulation.documents import session_document
            from fgreg.simulation.room import room_config

            config = room_config(
                room.seed, room.width, aims=aims, bump_every_s=room.bump_every_s, static_tags=room.static_tags
            )
            return setup_text(session_document(config.scene)), "the simulated room", None
        path = document.session
        if path is None:
            raise FieldError.of("nothing", "a path", "session")
        file = path / SETUP_FILE if path.is_dir() else path
        name = str(self.data["session"])
        label = str(Path(name) / SETUP_FILE) if path.is_dir() else name
        data = load_yaml(file, label)
        text = read_bounded(file, label, 4_000_000).decode("utf-8-sig")
        if document.calibration is None:
            return text, label, None
        if "camera" in data:
            raise FieldError.of("it, and a camera in the session.yaml", "one of the two", "calibration")
        rig, rectified = self._calibration(document.calibration, devices[Role.CAMERA][0])
        return text.rstrip("\n") + "\n" + camera_yaml(rig), label, rectified

    def _calibration(self, options: CalibrationOptions, camera: Chosen) -> tuple[StereoRig, Any]:
        """The calibration of the pictures that the loop gets, and their rectification."""
        from fgreg.drivers.calibration_files import read_calibration
        from fgreg.drivers.interlacing import Fields as Interlaced
        from fgreg.drivers.interlacing import field_rig
        from fgreg.drivers.rectification import rectification

        files = [file for file in (options.left, options.right) if file is not None]
        read = read_calibration(
            files, unit=options.unit, rectified=options.pictures == "rectified", image_size=options.image_size
        )
        rig = read.rig
        self.warnings += read.warnings
        if not options.of_fields:
            whole = not isinstance(camera.options, EndoscopeOptions)
            rig = field_rig(rig, Interlaced.WHOLE if whole else Interlaced(camera.options.fields))
        if options.pictures != "rectify":
            return rig, None
        if camera.entry.name != "endoscope":
            found = f"rectify with the driver {camera.entry.name}"
            raise FieldError.of(found, "rectify with endoscope only", "calibration", "pictures")
        made = rectification(rig)
        return made.rig, made


def _raw_choices(data: Mapping[str, object]) -> Iterator[object]:
    for role in Role:
        chosen = data.get(role)
        yield from chosen if isinstance(chosen, list) else [chosen]


def _uses_room(data: Mapping[str, object]) -> bool:
    """Whether any device belongs to the simulated room."""
    return any(isinstance(one, Mapping) and one.get("driver") == "simulated" for one in _raw_choices(data))


def _with_room(data: Mapping[str, object]) -> Mapping[str, object]:
    """The configuration with the room's defaults."""
    settings = data.get("settings", {})
    misspelt = "settings" not in data and any(nearest(key, ["settings"]) for key in data)
    if misspelt or not isinstance(settings, Mapping):
        return data
    return {**data, "settings": {"hearing_threshold": HEARING_THRESHOLD, **settings}}


def _check_limits(model: SessionModel, limits: Mapping[str, Any]) -> None:
    try:
        MotionLimits.of_session(model.stage, **limits)
    except FieldError as error:
        raise FieldError(error.below(Role.STAGE, "limits")) from None
    except ValueError as error:
        place = (Role.STAGE, "limits") if "sweep" in str(error) else (Role.STAGE,)
        raise FieldError.of(str(error), "limits inside those of session.yaml (stage.limits_deg)", *place) from None


def _check_model(model: SessionModel, devices: Mapping[Role, tuple[Chosen, ...]], aims: int) -> None:
    """Check that the session.yaml has what a live session needs. Raises FieldError."""
    needs = {"camera": model.camera, "marker": model.marker}
    for name, part in needs.items():
        if part is None:
            more = ", or calibration files here" if name == "camera" else ""
            raise FieldError.of(f"a session.yaml without {name}", f"one with {name}{more}", "session")
    if aims > 0 and model.board is None:
        expected = f"one with board for {aims} aims, or settings.aims: 0"
        raise FieldError.of("a session.yaml without board", expected, "session")
    if model.probe.channels is None and model.probe.image is None:
        raise FieldError.of("a session.yaml without probe.channels and probe.image", "one of them", "session")
    options = devices[Role.CAMERA][0].options
    if isinstance(options, EndoscopeOptions) and model.camera is not None and model.camera.right is None:
        layout = options.layout or ("separate" if options.right else "mono")
        if layout != "mono":
            found = f"the layout {layout} where one camera is calibrated"
            raise FieldError.of(found, "a calibration of both cameras", Role.CAMERA)


def _connections(devices: Mapping[Role, tuple[Chosen, ...]]) -> Iterator[tuple[str, Connection]]:
    """Devices that wait for a connection, with their places in the file."""
    for chosen in (one for several in devices.values() for one in several):
        if isinstance(chosen.options, Connection) and chosen.options.listen:
            yield chosen.where, chosen.options


def _check_ports(devices: Mapping[Role, tuple[Chosen, ...]]) -> None:
    """Check that no two devices listen at one port. Raises InputError."""
    taken: dict[int, str] = {}
    for where, options in _connections(devices):
        if options.port in taken:
            raise InputError(where, f"port {options.port} again", f"a port besides {taken[options.port]}'s")
        taken[options.port] = where


def _check_keys(devices: Mapping[Role, tuple[Chosen, ...]]) -> None:
    """Check that each operator has a key of its own: a word signed for one counts for no other. Raises InputError."""
    taken: dict[bytes, str] = {}
    for chosen in devices[Role.OPERATOR]:
        options = chosen.options
        if not isinstance(options, IgtlOperatorOptions | Ros2OperatorOptions) or options.key is None:
            continue
        if (first := taken.setdefault(read_key(options.key), chosen.where)) is not chosen.where:
            raise InputError(chosen.where, f"the key {options.key.name} again", f"another key than {first}'s")


def _open_to_all(devices: Mapping[Role, tuple[Chosen, ...]]) -> list[str]:
    """Warnings about devices that listen beyond this machine."""
    out = []
    for where, options in _connections(devices):
        if not (options.host.startswith("127.") or options.host in ("localhost", "::1")):
            out.append(f"{where}: listens at {options.host}: other machines can connect, and no password is asked")
    return out
