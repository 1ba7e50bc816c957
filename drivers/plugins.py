"""Drivers of other packages: ``package.module:Class``, or a name that an installed package gives (entry points).

A driver's options are the parameters of its class, with their types: truth values, numbers, texts, ``Literal`` texts,
paths, tuples of these, ``None`` beside them; ``Annotated[..., Key(...)]`` adds help, bounds and unit (docs/drivers.md).

CONFIG.yaml is the user's own file, so it may say what is imported. Folders of data may not: neither the file's folder
nor the working directory is searched for modules or entry points, whatever ``sys.path`` says.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.metadata
import inspect
import json
import math
import os
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from fgreg.drivers.base import DriverContext
from fgreg.drivers.options import Limits
from fgreg.drivers.plugin_device import PluginDevice
from fgreg.drivers.registry import DriverEntry, Role
from fgreg.errors import FgregError, one_line
from fgreg.model.session_model import StageModel
from fgreg.schema.files import ExistingPath
from fgreg.schema.kinds import Integer, Kind, ListOf, Number, Text
from fgreg.schema.problems import FieldError, shown
from fgreg.schema.record import Key, kind_of
from fgreg.stage.interface import RotationStage

GROUP = "fgreg.drivers"
"""Entry points of this group are drivers, named ``role.name``."""
EXPECTED = "package.module:Class of an installed package"

_SOURCE = ("poll", "close")
METHODS: Mapping[Role, tuple[str, ...]] = {
    Role.CAMERA: _SOURCE,
    Role.PHOTOACOUSTIC: _SOURCE,
    Role.MOTION: _SOURCE,
    Role.BMODE: _SOURCE,
    Role.OPERATOR: ("poll", "tell", "close"),
    Role.SINKS: ("send", "close"),
    Role.OVERLAY: ("send", "close"),
    Role.STAGE: ("home", "move_to", "stop", "status", "close"),
}
"""What a class of each role has to have."""

_INT = 2**53


@dataclass(frozen=True, slots=True, eq=False)
class PluginEntry(DriverEntry):
    """A driver of another package.

    Attributes:
        make: its class or function.
        place: ``package.module:Class``.
        path: where modules are searched.
    """

    make: Callable[..., Any] = dict
    place: str = ""
    path: tuple[str, ...] = ()

    def checked(self, chosen: Any) -> None:
        """Raises ValueError where the watchdog's process could not be told the options."""
        if self.role is Role.STAGE:
            try:
                json.dumps(_arguments(chosen))
            except TypeError:
                raise ValueError("a stage's options are numbers, truth values and texts only") from None

    def open(self, context: DriverContext, chosen: Any) -> PluginDevice:
        """The device. Raises FgregError, whatever its driver raises."""
        more = {"context": context} if "context" in inspect.signature(self.make).parameters else {}
        made = _made(f"{self.role} {self.name}", lambda: self.make(**more, **_arguments(chosen)))
        return PluginDevice(self.role, self.name, made)

    def for_watchdog(self, _context: DriverContext, chosen: Any) -> tuple[str, dict[str, Any]]:
        """As a driver of this package: the watchdog imports it from where it was found here."""
        return f"{__name__}:open_stage", {"place": self.place, "path": [*self.path], "options": _arguments(chosen)}

    def described(self, _context: DriverContext, chosen: Any, stage: StageModel) -> str | None:
        """Of a stage: where it stands. It is opened for that, which must not move it."""
        if self.role is not Role.STAGE:
            return None

        def ask() -> str:
            device = self.make(stage, **_arguments(chosen))
            try:
                status = device.status()
            finally:
                device.close()
            zero = "knows its zero position" if status.homed else "has to find its zero position"
            fault = f"; {status.fault}" if status.fault else ""
            return f"stands at {math.degrees(status.scan_rad):.1f} deg by its own account, {zero}{fault}"

        return str(_made(f"{self.role} {self.name}", ask))


@dataclass(frozen=True, slots=True)
class InstalledDriver:
    """An entry point of an installed package: ``package`` with its version."""

    role: Role
    name: str
    place: str
    package: str

    def driver(self, folder: Path | None = None) -> PluginEntry:
        """The driver. Raises FieldError."""
        return driver_at(self.role, self.name, self.place, folder)


def searched(folder: Path | None = None) -> tuple[str, ...]:
    """``sys.path`` without the working directory and ``folder``, which hold data."""
    left_out = {os.path.realpath(place) for place in (".", folder) if place is not None}
    return tuple(entry for entry in sys.path if os.path.realpath(entry or ".") not in left_out)


def installed(role: Role, folder: Path | None = None) -> Mapping[str, InstalledDriver]:
    """Drivers of a role that installed packages bring, by name."""
    return {driver.name: driver for driver in _entry_points(searched(folder)) if driver.role is role}


@functools.lru_cache(maxsize=8)
def _entry_points(path: tuple[str, ...]) -> tuple[InstalledDriver, ...]:
    found: dict[tuple[str, str], InstalledDriver] = {}
    for package in importlib.metadata.distributions(path=[*path]):
        try:
            points = [point for point in package.entry_points if point.group == GROUP]
        except (ValueError, OSError):  # damaged metadata of any package
            continue
        for point in points:
            role, _, name = point.name.partition(".")
            if role in [*Role] and name:
                driver = InstalledDriver(Role(role), name, point.value, f"{package.name} {package.version}")
                found.setdefault((role, name), driver)  # the first on the path, as an import finds it
    return tuple(found.values())


def driver_at(role: Role, name: str, place: str, folder: Path | None = None) -> PluginEntry:
    """The driver that ``package.module:Class`` names; ``name`` is what CONFIG.yaml calls it.

    Raises:
        FieldError: it cannot be imported, or is no driver of this role.
    """
    path = searched(folder)
    called = shown(place) if name == place else f"{shown(name)}, {place}"
    try:
        make = _imported(place, path)
    except ValueError:
        raise FieldError.of(called, EXPECTED) from None
    except (Exception, SystemExit) as error:  # a module may raise anything
        why = one_line(f"{type(error).__name__}: {error}", 200)
        raise FieldError.of(f"{called}, which cannot be imported ({why})", EXPECTED) from None
    missing = [each for each in METHODS[role] if not callable(getattr(make, each, None))]
    if not callable(make) or (inspect.isclass(make) and missing):
        lacks = f"a class without {', '.join(missing)}" if inspect.isclass(make) else "no class"
        raise FieldError.of(f"{called}, {lacks}", f"a driver of the role {role} (docs/drivers.md)")
    try:
        options = _options_of(role, make)
    except (TypeError, NameError, ValueError, AttributeError, SyntaxError) as error:
        why = one_line(str(error), 200)
        found = f"{called}, whose parameters are no options ({why})"
        raise FieldError.of(found, "parameters with types (docs/drivers.md)") from None
    text = inspect.getdoc(make) or place
    help_text = one_line(text.strip().splitlines()[0], 100).rstrip(".")
    return PluginEntry(role, name, help_text, options, "", make=make, place=place, path=path)


def open_stage(model: StageModel, *, place: str, path: Sequence[str], options: Mapping[str, Any]) -> RotationStage:
    """A stage of another package, for the watchdog."""
    return cast(RotationStage, _imported(place, path)(model, **options))


def _imported(place: str, path: Sequence[str]) -> Any:
    """What ``package.module:name`` names, searched at ``path``. Raises ValueError for another text, and whatever the
    module raises."""
    module, _, name = place.partition(":")
    if not all(part.isidentifier() for part in (*module.split("."), *name.split("."))):
        raise ValueError(place)
    with _path(path):
        try:
            found = importlib.import_module(module)
        except ValueError as error:
            raise ImportError(str(error)) from error
    return functools.reduce(getattr, name.split("."), found)


@contextmanager
def _path(path: Sequence[str]) -> Iterator[None]:
    """Modules are searched at ``path`` only; what they add to ``sys.path`` stays."""
    before = sys.path[:]
    sys.path[:] = path
    try:
        yield
    finally:
        sys.path[:] = [*before, *(entry for entry in sys.path if entry not in before)]


@functools.lru_cache(maxsize=64)
def _options_of(role: Role, make: Callable[..., Any]) -> type:
    """The described dataclass of a driver's parameters. Raises TypeError, NameError: they have no types that a file
    can have."""
    parameters = list(inspect.signature(make, eval_str=True).parameters.values())
    if role is Role.STAGE:
        if not parameters or parameters[0].kind not in (inspect.Parameter.POSITIONAL_ONLY, _EITHER):
            raise TypeError("the first one is not the session's StageModel")
        del parameters[0]
    fields: list[Any] = []
    for parameter in parameters:
        name = parameter.name
        if parameter.kind in (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD):
            continue
        if name == "context" and role is not Role.STAGE:
            continue
        if parameter.kind is inspect.Parameter.POSITIONAL_ONLY or name in ("driver", "limits"):
            raise TypeError(f"{name} cannot be given by that name")
        hint = Annotated[Any, _key(name, parameter.annotation)]
        if parameter.default is inspect.Parameter.empty:
            fields.append((name, hint))
        else:
            fields.append((name, hint, dataclasses.field(default_factory=functools.partial(_same, parameter.default))))
    if role is Role.STAGE:
        fields.append(("limits", Limits, None))
    return dataclasses.make_dataclass("PluginOptions", fields, frozen=True, kw_only=True, eq=False)


_EITHER = inspect.Parameter.POSITIONAL_OR_KEYWORD


def _same(value: Any) -> Any:
    return value


def _key(name: str, hint: Any) -> Key:
    """The description of a parameter."""
    metadata = getattr(hint, "__metadata__", ())
    hint = hint.__origin__ if metadata else hint
    own = next((entry for entry in metadata if isinstance(entry, Key)), Key(""))
    null = own.null
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        several = [each for each in typing.get_args(hint) if each is not types.NoneType]
        null, hint = True, several[0] if len(several) == 1 else hint
    return dataclasses.replace(own, kind=own.kind or _kind(name, hint), null=null)


def _kind(name: str, hint: Any) -> Kind:
    """The kind of a parameter's type. Raises TypeError."""
    if hint is float:
        return Number()
    if hint is int:
        return Integer(-_INT, _INT)
    if hint is Path:
        return ExistingPath()
    if typing.get_origin(hint) is Literal and all(isinstance(each, str) for each in typing.get_args(hint)):
        return Text("one of its texts", typing.get_args(hint))
    if typing.get_origin(hint) is tuple and typing.get_args(hint)[1:] == (...,):
        return ListOf(_kind(name, typing.get_args(hint)[0]), empty=True)
    if isinstance(hint, type) and issubclass(hint, StrEnum):
        return Text.of(hint, "one of its texts")
    try:
        return kind_of(hint)
    except (TypeError, ValueError):
        what = "no type" if hint is inspect.Parameter.empty else f"the type {getattr(hint, '__name__', hint)}"
        raise TypeError(f"{name} has {what}") from None


def _arguments(chosen: Any) -> dict[str, Any]:
    fields = (field.name for field in dataclasses.fields(chosen))
    return {name: getattr(chosen, name) for name in fields if name != "limits"}


def _made(what: str, make: Callable[[], Any]) -> Any:
    """What ``make`` returns. Raises FgregError for any error of another package."""
    try:
        return make()
    except FgregError:
        raise
    except Exception as error:
        raise FgregError(one_line(f"{what}: its driver failed: {type(error).__name__}: {error}", 500)) from error
