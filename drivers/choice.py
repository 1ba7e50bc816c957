"""How CONFIG.yaml names a driver: one of this package, of an installed one, or ``package.module:Class``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fgreg.drivers import plugins
from fgreg.drivers.registry import DriverEntry, Role, drivers_of
from fgreg.errors import InputError, one_line
from fgreg.schema.kinds import JsonSchema, Kind, Text
from fgreg.schema.problems import FieldError, Problem, nearest, shown


@dataclass(frozen=True, slots=True)
class DriverChoice(Kind):
    """A mapping that names one of a role's drivers, with its options: the entry and the options, both checked."""

    role: Role

    def read(self, value: object, folder: Path | None = None, /) -> tuple[DriverEntry, Any]:
        """Raises FieldError, MissingExtraError."""
        entries = drivers_of(self.role)
        if not isinstance(value, Mapping):
            raise FieldError.of(shown(value), self.expected)
        if "driver" not in value:
            for key in value:
                if nearest(key, ["driver"]):
                    raise FieldError.of("an unknown key", "a known one (did you mean driver?)", key)
            raise FieldError.of("nothing", f"one of {', '.join(entries)}", "driver")
        try:
            entry = self._named(value["driver"], folder)
        except FieldError as error:
            raise FieldError(error.below("driver")) from None
        entry.require()
        others = {name for other in entries.values() for name in other.record.names} - {*entry.record.names}
        names = ", ".join(name for name in entry.record.names if name not in ("driver", "limits"))
        takes = f"one of {entry.name}'s: {names}" if names else f"{entry.name} alone"
        problems = [Problem((key,), "a key of another driver", takes) for key in value if key in others]
        own = {key: entry for key, entry in value.items() if key not in others} if problems else value
        try:
            chosen = entry.record.read(own, folder)
            if not problems:
                entry.checked(chosen)
        except FieldError as error:
            problems += error.problems
        except ValueError as error:
            found = f"values that do not fit together ({one_line(str(error), 200)})"
            problems.append(Problem((), found, "values that do"))
        except InputError as error:
            problems.append(Problem((), f"{error.found} ({error.where})", error.expected))
        if problems:
            raise FieldError(problems)
        return entry, chosen

    def _named(self, name: object, folder: Path | None) -> DriverEntry:
        """The driver of a name. Raises FieldError."""
        entries = drivers_of(self.role)
        if isinstance(name, str) and name in entries:
            return entries[name]
        if isinstance(name, str) and ":" in name:
            return plugins.driver_at(self.role, name, name, folder)
        installed = plugins.installed(self.role, folder)
        if isinstance(name, str) and name in installed:
            return installed[name].driver(folder)
        try:
            Text("a driver's name", allowed=(*entries, *installed)).read(name)
        except FieldError as error:
            (problem,) = error.problems
            raise FieldError.of(problem.found, f"{problem.expected}, or {plugins.EXPECTED}") from None
        raise AssertionError(f"{name!r} is no driver")

    @property
    def expected(self) -> str:
        names = dict.fromkeys(name for entry in drivers_of(self.role).values() for name in entry.record.names)
        return f"a mapping with {', '.join(names)}"

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        other: list[JsonSchema] = [{"type": "string", "pattern": "^[^:]+:[^:]+$"}]
        if names := [name for name in plugins.installed(self.role) if name not in drivers_of(self.role)]:
            other.append({"enum": names})
        foreign = {"type": "object", "properties": {"driver": {"anyOf": other}}, "required": ["driver"]}
        return {
            "oneOf": [*(entry.record.json_schema(definitions) for entry in drivers_of(self.role).values()), foreign]
        }
