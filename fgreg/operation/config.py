"""CONFIG.yaml of ``fgreg live``: a driver for each role, read and checked before any device is opened.

``example_config`` has all of its keys. Paths are relative to the file's folder.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fgreg.config import SolveConfig
from fgreg.convert.write import camera_yaml
from fgreg.drivers.base import Operator
from fgreg.drivers.options import read_keys, read_path
from fgreg.drivers.registry import DriverEntry, Role, Surroundings, drivers_of
from fgreg.errors import InputError, one_line
from fgreg.models import SessionModel, StereoRig
from fgreg.motion.limits import MotionLimits
from fgreg.operation.conductor import ConductorSettings
from fgreg.operation.config_keys import (
    CALIBRATION_KEYS,
    LIMIT_KEYS,
    LIVE_FORMAT,
    ROOM_KEYS,
    SETTING_KEYS,
    THRESHOLD,
)
from fgreg.operation.holder import HolderSettings
from fgreg.operation.rooms import HEARING_THRESHOLD, room_truth
from fgreg.operation.start import LiveSetup, StageSetup, setup_text
from fgreg.operation.status import Devices
from fgreg.pairing import Latencies
from fgreg.session.reading import SETUP_FILE
from fgreg.session.safe_yaml import load_yaml, parse_yaml, read_bounded
from fgreg.session.schema import Bounds, Fields, Place, shown
from fgreg.session.setup import read_setup

_MAX_BYTES = 1_000_000
SCAN_DEG = Bounds(-180.0, 180.0, unit="deg")
_TOP = ("format", "session", "calibration", "room", *(role.value for role in Role), "settings")


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """A driver with its options, both checked; ``where`` names the place in the file."""

    entry: DriverEntry
    options: Mapping[str, Any]
    where: str

    def open(self, around: Surroundings) -> Any:
        """The device. Raises what its driver raises."""
        return self.entry.open(around, self.options)


@dataclass(frozen=True, slots=True, eq=False)
class LiveConfig:
    """A CONFIG.yaml, read and checked.

    Attributes:
        setup: content of the new session's ``session.yaml``; ``model`` is what it says.
        devices: by role; several of ``sinks`` and ``operator``.
        stage_limits: as MotionLimits.of_session takes them.
        room: options of the simulated room, where its devices are used.
        rectified: fgreg.drivers.rectification.Rectification of the pictures, where they are to be rectified.
        settings, holder, latencies, solve: of the conductor, the endoscope's holder, the devices, the estimate.
        warnings: plain sentences on what is allowed but hardly meant.
    """

    path: Path
    setup: str
    model: SessionModel
    devices: Mapping[Role, tuple[Chosen, ...]]
    stage_limits: Mapping[str, Any]
    room: Mapping[str, Any] | None
    rectified: Any
    settings: ConductorSettings
    holder: HolderSettings
    latencies: Latencies
    solve: SolveConfig
    warnings: tuple[str, ...]

    def around(self, stack: ExitStack, say: Callable[[str], None]) -> Surroundings:
        """What the drivers need; starts the simulated room where one is used, until the stack is left."""
        room = None
        if self.room is not None:
            from fgreg.drivers.simulated import RoomProcess

            process = RoomProcess(self.room["seed"], self.room["width"], self.settings.aims, self.room["bump_every_s"])
            room = stack.enter_context(process).path
        board = self.model.board
        return Surroundings(say, None if board is None else (board.columns, board.rows), self.rectified, room)

    def live_setup(self, stack: ExitStack, say: Callable[[str], None], *, seen: bool = True) -> LiveSetup:
        """What to conduct. Opens no device, but starts the simulated room where one is used.

        Args:
            stack: ends the room.
            say: shows one line to an operator at the terminal; called from several threads.
            seen: whether anybody sees pictures that are only to be shown; where not, their device is not opened.
        """
        around = self.around(stack, say)

        def open_devices(devices: ExitStack, _model: SessionModel) -> Devices:
            def opened(chosen: Chosen) -> Any:
                device = chosen.open(around)
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
            )

        return LiveSetup(
            self.setup,
            open_devices,
            self.stage_setup(around),
            self.settings,
            self.holder,
            self.latencies,
            None if around.room is None else room_truth(around.room),
        )

    def stage_setup(self, around: Surroundings) -> StageSetup | None:
        """The stage for the watchdog; None where there is none."""
        chosen = self.devices.get(Role.STAGE)
        if chosen is None:
            return None
        options = {"path": os.fspath(around.room)} if chosen[0].entry.room and around.room else chosen[0].options
        limits = dict(self.stage_limits)
        if (acceleration := chosen[0].options.get("acceleration_deg_s2")) is not None:
            limits["deceleration"] = math.radians(acceleration)  # what a driver is told to use is what it brakes with
        return StageSetup(chosen[0].entry.factory, options, limits)


_ONE_EACH = (Role.CAMERA, Role.PHOTOACOUSTIC, Role.MOTION, Role.BMODE)


def _together(operators: list[Operator]) -> Operator:
    if len(operators) == 1:
        return operators[0]
    from fgreg.drivers.operators import Operators

    return Operators(operators)


def read_config(path: Path) -> LiveConfig:
    """Reads a CONFIG.yaml. No device is opened.

    Raises:
        InputError: the first problem, with file, key and line.
        MissingExtraError: a driver's library is not installed.
    """
    problems: list[InputError] = []
    reader = _Reader(path, problems)
    found = reader.read()
    if problems:
        raise problems[0]
    if found is None:
        raise AssertionError("no configuration and no problem")
    return found


@dataclass(slots=True, eq=False)
class _Reader:
    """Reads one file; what is wrong goes to ``problems``."""

    path: Path
    problems: list[InputError]
    warnings: list[str] = field(default_factory=list)

    def read(self) -> LiveConfig | None:
        label, folder = self.path.name, self.path.parent
        top = Fields(load_yaml(self.path, label, max_bytes=_MAX_BYTES), _TOP, Place(label), self.problems)
        top.text("format", LIVE_FORMAT, allowed=(LIVE_FORMAT,))
        devices = _devices(top, folder)
        room = self._room(top, devices)
        settings = _settings(top, room is not None)
        limits = _limits(top)
        if self.problems or settings is None:
            return None
        conductor = settings.conductor
        setup, label, rectified = self._session(top, folder, devices, room, conductor.aims)
        model = self._model(setup, label)
        if model is None:
            return None
        _check_model(top, model, devices, conductor.aims)
        if Role.STAGE in devices:
            _check_limits(top, model, limits)
        _check_ports(top, devices)
        self.warnings += _open_to_all(devices)
        return LiveConfig(
            self.path,
            setup,
            model,
            devices,
            limits,
            room,
            rectified,
            conductor,
            settings.holder,
            settings.latencies,
            settings.solve,
            tuple(self.warnings),
        )

    def _room(self, top: Fields, devices: Mapping[Role, tuple[Chosen, ...]]) -> Mapping[str, Any] | None:
        """The room's options; its camera, probe and stage go together, since they see and hear the same things."""
        simulated = [role for role, chosen in devices.items() if any(one.entry.room for one in chosen)]
        world = [role for role in (Role.CAMERA, Role.PHOTOACOUSTIC, Role.STAGE) if role in devices]
        for role in world:
            if simulated and role not in simulated:
                found = f"{devices[role][0].entry.name}, and {simulated[0]} of the simulated room"
                top.fail(role, found, "camera, photoacoustic and stage all simulated, or none")
        if not simulated:
            if top.has("room"):
                top.fail("room", "a room of which no device is used", "drivers called simulated")
            return None
        for key in ("session", "calibration"):
            if top.has(key):
                top.fail(key, "it, and the simulated room", "one of the two: the room brings a set-up of its own")
        if Role.OPERATOR not in simulated:
            self.warnings.append(
                f"{self.path.name}: without a simulated operator nobody tells the room's surgeon to go on"
            )
        if not top.has("room"):
            return {key.name: key.default for key in ROOM_KEYS}
        inner = top.child("room", [key.name for key in ROOM_KEYS])
        return None if inner is None else read_keys(ROOM_KEYS, inner, self.path.parent)

    def _model(self, setup: str, label: str) -> SessionModel | None:
        found = read_setup(parse_yaml(setup, label), label, "session", self.problems)
        self.warnings += found.warnings
        return found.model if not self.problems else None

    def _session(
        self,
        top: Fields,
        folder: Path,
        devices: Mapping[Role, tuple[Chosen, ...]],
        room: Mapping[str, Any] | None,
        aims: int,
    ) -> tuple[str, str, Any]:
        """Text of the ``session.yaml``, what messages call it, the rectification of the pictures. Raises InputError."""
        if room is not None:
            from fgreg.simulation.documents import session_document
            from fgreg.simulation.room import room_config

            config = room_config(room["seed"], room["width"], aims=aims, bump_every_s=room["bump_every_s"])
            return setup_text(session_document(config.scene)), "the simulated room", None
        path = read_path(top, "session", folder)
        if top.problems:
            raise top.problems[0]
        file = path / SETUP_FILE if path.is_dir() else path
        label = str(Path(str(top.raw("session"))) / SETUP_FILE) if path.is_dir() else str(top.raw("session"))
        data = load_yaml(file, label)
        text = read_bounded(file, label, 4_000_000).decode("utf-8-sig")
        if not top.has("calibration"):
            return text, label, None
        if "camera" in data:
            raise InputError(str(top.at("calibration")), "it, and a camera in the session.yaml", "one of the two")
        rig, rectified = self._calibration(top, folder, devices)
        return text.rstrip("\n") + "\n" + camera_yaml(rig), label, rectified

    def _calibration(
        self, top: Fields, folder: Path, devices: Mapping[Role, tuple[Chosen, ...]]
    ) -> tuple[StereoRig, Any]:
        """The rig of the pictures as the loop sees them. Raises InputError."""
        from fgreg.drivers.calibration_files import read_calibration
        from fgreg.drivers.interlaced import Fields as Interlaced
        from fgreg.drivers.interlaced import field_rig
        from fgreg.drivers.rectification import rectification

        inner = top.child("calibration", [key.name for key in CALIBRATION_KEYS])
        values = {} if inner is None else read_keys(CALIBRATION_KEYS, inner, folder)
        if top.problems:
            raise top.problems[0]
        files = [file for file in (values["left"], values["right"]) if file is not None]
        pictures = values["pictures"]
        read = read_calibration(files, unit=values["unit"], rectified=pictures == "rectified")
        rig = read.rig
        self.warnings += read.warnings
        camera = devices[Role.CAMERA][0]
        if not values["of_fields"]:
            rig = field_rig(rig, Interlaced(camera.options.get("fields", "whole")))
        if pictures != "rectify":
            return rig, None
        if camera.entry.name != "endoscope":
            place = str(top.at("calibration").key("pictures"))
            raise InputError(place, f"rectify with the driver {camera.entry.name}", "rectify with endoscope only")
        made = rectification(rig)
        return made.rig, made


def _devices(top: Fields, folder: Path) -> dict[Role, tuple[Chosen, ...]]:
    found: dict[Role, tuple[Chosen, ...]] = {}
    for role in Role:
        if role is Role.OPERATOR and not top.has(role):
            keyboard = drivers_of(role)["keyboard"]
            found[role] = (Chosen(keyboard, {}, str(top.at(role))),)
            continue
        if role in (Role.CAMERA, Role.PHOTOACOUSTIC) or top.has(role):
            several = role is Role.SINKS or (role is Role.OPERATOR and isinstance(top.raw(role), list))
            known = _known_keys(role)
            entries = top.children(role, known) if several else [top.child(role, known)]
            chosen = tuple(one for fields in entries if fields is not None and (one := _chosen(role, fields, folder)))
            if chosen:
                found[role] = chosen
    return found


def _known_keys(role: Role) -> list[str]:
    """Of all of a role's drivers: those of another driver are told as such, by :func:`_chosen`."""
    names = dict.fromkeys(key.name for entry in drivers_of(role).values() for key in entry.keys)
    return ["driver", *names, *(["limits"] if role is Role.STAGE else [])]


def _chosen(role: Role, fields: Fields, folder: Path) -> Chosen | None:
    entries = drivers_of(role)
    name = fields.text("driver", "one of " + ", ".join(entries), allowed=tuple(entries))
    if name not in entries:
        return None
    entry = entries[name]
    own = {"driver", *(key.name for key in entry.keys), *(["limits"] if role is Role.STAGE else [])}
    for key in _known_keys(role):
        if fields.has(key) and key not in own:
            takes = ", ".join(key.name for key in entry.keys) or "no keys"
            fields.fail(key, "a key of another driver", f"one of {name}'s: {takes}" if entry.keys else f"{name} alone")
    options = read_keys(entry.keys, fields, folder)
    entry.require()
    if fields.ok:
        try:
            entry.checked(options)
        except ValueError as error:
            fields.fail("", f"values that do not fit together ({one_line(str(error), 200)})", "values that do")
        except InputError as error:
            fields.fail("", f"{error.found} ({error.where})", error.expected)
    return Chosen(entry, options, str(fields.place)) if fields.ok else None


@dataclass(frozen=True, slots=True, eq=False)
class _Settings:
    """All that ``settings`` says."""

    conductor: ConductorSettings
    holder: HolderSettings = field(default_factory=HolderSettings)
    latencies: Latencies = field(default_factory=Latencies)
    solve: SolveConfig = field(default_factory=SolveConfig)


def _settings(top: Fields, simulated: bool) -> _Settings | None:
    known = [*(key.name for key in SETTING_KEYS), THRESHOLD.name]
    inner = top.child("settings", known) if top.has("settings") or not simulated else None
    if inner is None:
        return _Settings(ConductorSettings(hearing_threshold=HEARING_THRESHOLD)) if simulated else None
    values = dict(read_keys(SETTING_KEYS, inner, Path()))
    if inner.has(THRESHOLD.name) or not simulated:
        values[THRESHOLD.name] = THRESHOLD.read(inner, Path())
    else:
        values[THRESHOLD.name] = HEARING_THRESHOLD
    return inner.build(
        lambda: _Settings(
            holder=HolderSettings(
                values.pop("holder_sigma_mm"),
                math.radians(values.pop("holder_sigma_deg")),
                values.pop("holder_least_mm"),
            ),
            latencies=Latencies(
                values.pop("camera_latency_s"), values.pop("pulse_latency_s"), values.pop("holder_latency_s")
            ),
            solve=SolveConfig(limit_mm=values.pop("limit_mm")),
            conductor=ConductorSettings(**values),
        )
    )


def _limits(top: Fields) -> dict[str, Any]:
    """As MotionLimits.of_session takes them."""
    stage = top.raw(Role.STAGE)
    if not (isinstance(stage, Mapping) and "limits" in stage):
        return _in_radians({key.name: key.default for key in LIMIT_KEYS})
    known = [*(key.name for key in LIMIT_KEYS), "sweep_deg"]
    outer = Fields(stage, tuple(stage), top.at(Role.STAGE), top.problems)
    inner = outer.child("limits", known)
    if inner is None:
        return {}
    values = _in_radians(read_keys(LIMIT_KEYS, inner, Path()))
    if inner.has("sweep_deg"):
        low, high = inner.numbers("sweep_deg", 2, SCAN_DEG)
        if inner.ok and not low < high:
            inner.fail("sweep_deg", shown([float(low), float(high)]), "the lower end, then the upper one")
        values["sweep_rad"] = (math.radians(low), math.radians(high))
    return values


def _in_radians(values: Mapping[str, Any]) -> dict[str, Any]:
    out = {}
    for name, value in values.items():
        if name.endswith("_speed_deg_s"):
            out[name.removesuffix("_deg_s")] = math.radians(value)
        elif name.endswith("_deg"):
            out[name.removesuffix("_deg") + "_rad"] = math.radians(value)
        else:
            out[name] = value
    return out


def _check_limits(top: Fields, model: SessionModel, limits: Mapping[str, Any]) -> None:
    try:
        MotionLimits.of_session(model.stage, **limits)
    except ValueError as error:
        inner = f"{Role.STAGE}.limits" if "sweep" in str(error) else Role.STAGE
        top.fail(inner, str(error), "limits inside those of session.yaml (stage.limits_deg)")


def _check_model(top: Fields, model: SessionModel, devices: Mapping[Role, tuple[Chosen, ...]], aims: int) -> None:
    """Whether the session.yaml has what a live session needs."""
    needs = {"camera": model.camera, "marker": model.marker}
    for name, part in needs.items():
        if part is None:
            more = ", or calibration files here" if name == "camera" else ""
            top.fail("session", f"a session.yaml without {name}", f"one with {name}{more}")
    if aims > 0 and model.board is None:
        top.fail("session", "a session.yaml without board", f"one with board for {aims} aims, or settings.aims: 0")
    if model.probe.channels is None and model.probe.image is None:
        top.fail("session", "a session.yaml without probe.channels and probe.image", "one of them")
    options = devices[Role.CAMERA][0].options
    layout = options.get("layout") or ("separate" if options.get("right") else "mono")
    if model.camera is not None and model.camera.right is None and "layout" in options and layout != "mono":
        top.fail(Role.CAMERA, f"the layout {layout} where one camera is calibrated", "a calibration of both cameras")


def _check_ports(top: Fields, devices: Mapping[Role, tuple[Chosen, ...]]) -> None:
    """Two devices cannot listen at one port."""
    taken: dict[int, str] = {}
    for chosen in (one for several in devices.values() for one in several):
        if chosen.options.get("listen"):
            port = chosen.options["port"]
            if port in taken:
                top.problems.append(InputError(chosen.where, f"port {port} again", f"a port besides {taken[port]}'s"))
            taken[port] = chosen.where


def _open_to_all(devices: Mapping[Role, tuple[Chosen, ...]]) -> list[str]:
    out = []
    for chosen in (one for several in devices.values() for one in several):
        host = str(chosen.options.get("host", ""))
        if chosen.options.get("listen") and not (host.startswith("127.") or host in ("localhost", "::1")):
            out.append(f"{chosen.where}: listens at {host}: other machines can connect, and no password is asked")
    return out


__all__ = ["Chosen", "LiveConfig", "read_config"]
