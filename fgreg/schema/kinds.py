"""Kinds of values in a document: each reads, writes and describes its values.

Files hold degrees where a name ends with ``_deg``; in memory they are radians.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.errors import InputError
from fgreg.geometry.transforms import as_float_array
from fgreg.schema.problems import FieldError, Problem, nearest, shown

MAX_TRANSLATION_MM = 2000.0

_UNBOUNDED, FINITE = 1e12, 1e100
"""Bounds that exclude only impossible numbers; the second is for entries of a matrix."""
_OTHER_UNITS = {"mm": ("metres", 1000.0), "MHz": ("Hz", 1e-6)}
"""Units that people use instead, with the factor to the one that is expected."""

JsonSchema = dict[str, Any]


class Kind(ABC):
    """A kind of value: how it is read, written and described."""

    __slots__ = ()

    takes_text = False
    """Whether a number that other YAML readers treat as text (``1e5``) is read as text."""

    @abstractmethod
    def read(self, value: object, folder: Path | None = None, /) -> Any:
        """Convert a value of a document to its form in memory.

        Args:
            value: as parsed.
            folder: to which names of files are relative.

        Raises:
            FieldError: the value is invalid.
        """

    def write(self, value: Any, folder: Path | None = None, /) -> Any:
        """Convert a value in memory to plain data for a document, the inverse of :meth:`read`."""
        del folder
        return value

    @property
    @abstractmethod
    def expected(self) -> str:
        """Description of valid values for messages and tables."""

    @abstractmethod
    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        """The JSON Schema of a value; schemas of mappings go to ``definitions`` by name."""


@dataclass(frozen=True, slots=True)
class Number(Kind):
    """A finite number in an interval.

    Attributes:
        low, high: ends of the interval, in the file's unit.
        above: ``low`` itself is outside.
        unit: for messages.
        degrees: degrees in the file, radians inside.
        decimals: digits after the point that are written; None: all.
    """

    low: float = -_UNBOUNDED
    high: float = _UNBOUNDED
    above: bool = False
    unit: str = ""
    degrees: bool = False
    decimals: int | None = None

    def has(self, value: object) -> bool:
        """Whether a value is a number inside the interval; booleans are not numbers."""
        if type(value) is not float and type(value) is not int:
            return False
        return (self.low < value if self.above else self.low <= value) and value <= self.high

    def _in_other_unit(self, value: object) -> str:
        """What a value outside the interval would be in the unit that people use instead, where that is inside."""
        other, factor = _OTHER_UNITS.get(self.unit, ("", 1.0))
        if not other or not Number().has(value):
            return ""
        number = float(value) * factor  # type: ignore[arg-type]
        return f" (in {other} it would be {number:.4g} {self.unit})" if self.has(number) else ""

    def read(self, value: object, _folder: Path | None = None, /) -> float:
        if not self.has(value):
            raise FieldError.of(shown(value), self.expected + self._in_other_unit(value))
        number = float(value)  # type: ignore[arg-type]
        return math.radians(number) if self.degrees else number

    def write(self, value: Any, _folder: Path | None = None, /) -> float | int | None:
        """With ``decimals``, a number that is not finite is written as null."""
        if self.degrees:
            value = math.degrees(value)
        if self.decimals is not None:
            return round(float(value), self.decimals) + 0.0 if math.isfinite(value) else None  # + 0.0: no -0.0
        return value if type(value) is int else float(value)

    @property
    def expected(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self.low <= -_UNBOUNDED and self.high >= _UNBOUNDED:
            return f"a finite number{' in' if unit else ''}{unit}"
        if self.low == -self.high:
            return f"a number within +-{self.high:g}{unit}"
        low = f"a number {'>' if self.above else '>='} {self.low:g}"
        return f"{low} and <= {self.high:g}{unit}" if self.high < _UNBOUNDED else f"{low}{unit}"

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        low = "exclusiveMinimum" if self.above else "minimum"
        return {"type": "number", low: self.low, "maximum": self.high}


@dataclass(frozen=True, slots=True)
class Figure(Number):
    """A number that may be infinite: ``null`` in the file."""

    def read(self, value: object, _folder: Path | None = None, /) -> float:
        return math.inf if value is None else Number.read(self, value)

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"anyOf": [Number.json_schema(self, definitions), {"type": "null"}]}


@dataclass(frozen=True, slots=True)
class Integer(Kind):
    """An integer in [low, high], or one of ``allowed`` where given; 3.0 is not one."""

    low: int = 0
    high: int = 0
    allowed: tuple[int, ...] = ()

    def read(self, value: object, _folder: Path | None = None, /) -> int:
        if type(value) is not int or not (value in self.allowed if self.allowed else self.low <= value <= self.high):
            raise FieldError.of(shown(value), self.expected)
        return value

    def write(self, value: Any, _folder: Path | None = None, /) -> int:
        return int(value)

    @property
    def expected(self) -> str:
        return " or ".join(map(str, self.allowed)) or f"an integer from {self.low} to {self.high}"

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"enum": [*self.allowed]} if self.allowed else _integer_schema(self.low, self.high)


@dataclass(frozen=True, slots=True)
class Truth(Kind):
    """``true`` or ``false``."""

    def read(self, value: object, _folder: Path | None = None, /) -> bool:
        if not isinstance(value, bool):
            raise FieldError.of(shown(value), self.expected)
        return value

    def write(self, value: Any, _folder: Path | None = None, /) -> bool:
        return bool(value)

    @property
    def expected(self) -> str:
        return "true or false"

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"type": "boolean"}


@dataclass(frozen=True, slots=True)
class Text(Kind):
    """A text that is not empty.

    Attributes:
        what: its description in messages.
        allowed: the only valid texts, where given.
        check: raises InputError or FieldError for a text that cannot be one.
        enum: what the allowed ones become.
    """

    takes_text = True

    what: str = "a text"
    allowed: tuple[str, ...] = ()
    check: Callable[[str], object] | None = None
    enum: type[StrEnum] | None = None

    @classmethod
    def of(cls, enum: type[StrEnum], what: str) -> Text:
        """One of an enumeration's values."""
        return cls(what, tuple(enum), enum=enum)

    def read(self, value: object, _folder: Path | None = None, /) -> str:
        if not isinstance(value, str) or not value:
            raise FieldError.of(shown(value), self.expected)
        if self.allowed and value not in self.allowed:
            meant = nearest(value, self.allowed)
            raise FieldError.of(shown(value), self.expected + (f" (did you mean {meant}?)" if meant else ""))
        if self.check is not None:
            try:
                self.check(value)
            except InputError as error:
                raise FieldError.of(error.found, error.expected) from None
        return value if self.enum is None else self.enum(value)

    def write(self, value: Any, _folder: Path | None = None, /) -> str:
        return str(value)

    @property
    def expected(self) -> str:
        if not self.allowed or len(self.allowed) > 8:
            return self.what
        return self.allowed[0] if len(self.allowed) == 1 else "one of " + ", ".join(self.allowed)

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"enum": [str(entry) for entry in self.allowed]} if self.allowed else {"type": "string", "minLength": 1}


@dataclass(frozen=True, slots=True)
class Numbers(Kind):
    """A list of numbers, each in an interval: ``count`` of them, or at least one where None; read as an array (n,)."""

    count: int | None
    each: Number = Number()

    def read(self, value: object, _folder: Path | None = None, /) -> Any:
        """(n,) array."""
        if not isinstance(value, list) or (len(value) != self.count if self.count is not None else not value):
            raise FieldError.of(shown(value), self.expected)
        has = self.each.has
        for i, entry in enumerate(value):
            if not has(entry):
                raise FieldError.of(shown(entry), self.each.expected, i)
        return as_float_array(np.radians(value) if self.each.degrees else value)

    def write(self, value: Any, _folder: Path | None = None, /) -> list[Any]:
        entries = value.tolist() if type(value) is np.ndarray else value
        written = [self.each.write(entry) for entry in entries]
        if None in written:
            raise FieldError.of("an entry that is not finite", "finite numbers")
        return written

    @property
    def expected(self) -> str:
        return f"a list of {'numbers' if self.count is None else f'{self.count} numbers'}, each {self.each.expected}"

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return list_schema(self.each.json_schema(definitions), self.count or 1, self.count)


@dataclass(frozen=True, slots=True)
class NumberTuple(Numbers):
    """As :class:`Numbers`, read as a tuple."""

    def read(self, value: object, _folder: Path | None = None, /) -> tuple[float, ...]:
        return tuple(Numbers.read(self, value).tolist())


@dataclass(frozen=True, slots=True)
class IntegerPair(Kind):
    """A list of two integers in [low, high], read as a tuple."""

    low: int
    high: int
    what: str

    def read(self, value: object, _folder: Path | None = None, /) -> tuple[int, int]:
        whole = isinstance(value, list) and len(value) == 2 and all(type(entry) is int for entry in value)
        if not (isinstance(value, list) and whole and self.low <= min(value) and max(value) <= self.high):
            raise FieldError.of(shown(value), self.expected)
        return value[0], value[1]

    def write(self, value: Any, _folder: Path | None = None, /) -> list[int]:
        return [int(entry) for entry in value]

    @property
    def expected(self) -> str:
        return self.what

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return list_schema(_integer_schema(self.low, self.high), 2, 2)


@dataclass(frozen=True, slots=True)
class ListOf(Kind):
    """A list of one kind, read as a tuple; not empty unless ``empty``. ``what`` is for messages."""

    each: Kind
    what: str = ""
    empty: bool = False

    def read(self, value: object, folder: Path | None = None, /) -> tuple[Any, ...]:
        if not isinstance(value, list) or not (value or self.empty):
            raise FieldError.of(shown(value), self.expected)
        entries: list[Any] = []
        problems: list[Problem] = []
        for i, entry in enumerate(value):
            try:
                entries.append(self.each.read(entry, folder))
            except FieldError as error:
                problems += error.below(i)
        if problems:
            raise FieldError(problems)
        return tuple(entries)

    def write(self, value: Any, folder: Path | None = None, /) -> list[Any]:
        return [self.each.write(entry, folder) for entry in value]

    @property
    def expected(self) -> str:
        return self.what or "a list of " + self.each.expected.removeprefix("a ").replace("mapping", "mappings", 1)

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return list_schema(self.each.json_schema(definitions), 0 if self.empty else 1, None)


@dataclass(frozen=True, slots=True)
class Anything(Kind):
    """Any value of a document; ``what`` is for messages."""

    what: str

    def read(self, value: object, _folder: Path | None = None, /) -> object:
        return value

    @property
    def expected(self) -> str:
        return self.what

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {}


@dataclass(frozen=True, slots=True)
class Converted(Kind):
    """Another kind with a different form in memory: ``inside`` and ``outside`` convert to it and back."""

    stored: Kind
    inside: Callable[[Any], Any]
    outside: Callable[[Any], Any]

    def read(self, value: object, folder: Path | None = None, /) -> Any:
        return self.inside(self.stored.read(value, folder))

    def write(self, value: Any, folder: Path | None = None, /) -> Any:
        return self.stored.write(self.outside(value), folder)

    @property
    def expected(self) -> str:
        return self.stored.expected

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return self.stored.json_schema(definitions)


SECONDS = Number(unit="s")
ANY_SIZE = Number(-FINITE, FINITE)
NOT_NEGATIVE = Number(0.0, 1e6)
POSITIVE_MM = Number(0.0, 1e4, above=True, unit="mm")
NOISE_MM = Number(0.0, 1e4, unit="mm")
SCAN_DEG = Number(-180.0, 180.0, unit="deg")
COORDINATE_MM = Number(-MAX_TRANSLATION_MM, MAX_TRANSLATION_MM, unit="mm")
POINT_MM = Numbers(3, COORDINATE_MM)


def points(each: Numbers) -> Kind:
    """A list of points [x, y, z], read as an array (n, 3)."""
    stored = ListOf(each, f"a list of points [x, y, z] in {each.each.unit}")
    return Converted(stored, lambda entries: as_float_array(entries, -1, 3), list)


def in_radians(degrees: Number) -> Number:
    """The same interval in degrees in the file, read as radians."""
    return replace(degrees, degrees=True)


def _integer_schema(low: int, high: int) -> JsonSchema:
    return {"type": "integer", "minimum": low, "maximum": high}


def list_schema(items: JsonSchema, least: int, most: int | None) -> JsonSchema:
    schema: JsonSchema = {"type": "array", "items": items, "minItems": least}
    return schema if most is None else {**schema, "maxItems": most}
