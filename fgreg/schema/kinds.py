"""Kinds of values in a document: each reads, writes and describes its values.

Files hold degrees where a name ends with ``_deg``; in memory they are radians.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.errors import InputError
from fgreg.geometry.transforms import (
    RIGID_TOLERANCE,
    FloatArray,
    as_float_array,
    is_rigid,
    make_transform,
    nearest_rotation,
)
from fgreg.schema.problems import FieldError, Problem, nearest, shown

MAX_TRANSLATION_MM = 2000.0

_SYMMETRY_TOLERANCE = 1e-6
_MIN_CORRELATION_EIGENVALUE = 1e-9
_SIGMA_RANGE = (1e-9, 1e6)
_UNBOUNDED, _FINITE = 1e12, 1e100
"""Bounds that exclude only impossible numbers; the second is for entries of a matrix."""

JsonSchema = dict[str, Any]


class Kind:
    """A kind of value: how it is read, written and described."""

    __slots__ = ()

    takes_text = False
    """Whether a number that other YAML readers treat as text (``1e5``) is read as text."""

    def read(self, value: object, folder: Path | None = None, /) -> Any:
        """Convert a value of a document to its form in memory.

        Args:
            value: as parsed.
            folder: to which names of files are relative.

        Raises:
            FieldError: the value is invalid.
        """
        raise NotImplementedError

    def write(self, value: Any, folder: Path | None = None, /) -> Any:
        """Convert a value in memory to plain data for a document, the inverse of :meth:`read`."""
        del folder
        return value

    @property
    def expected(self) -> str:
        """Description of valid values for messages and tables."""
        raise NotImplementedError

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        """The JSON Schema of a value; schemas of mappings go to ``definitions`` by name."""
        raise NotImplementedError


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

    def read(self, value: object, _folder: Path | None = None, /) -> float:
        if not self.has(value):
            raise FieldError.of(shown(value), self.expected)
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
    """An integer in [low, high]; 3.0 is not one."""

    low: int
    high: int

    def read(self, value: object, _folder: Path | None = None, /) -> int:
        if type(value) is not int or not self.low <= value <= self.high:
            raise FieldError.of(shown(value), self.expected)
        return value

    def write(self, value: Any, _folder: Path | None = None, /) -> int:
        return int(value)

    @property
    def expected(self) -> str:
        return f"an integer from {self.low} to {self.high}"

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"type": "integer", "minimum": self.low, "maximum": self.high}


@dataclass(frozen=True, slots=True)
class OneOf(Kind):
    """One of a few integers."""

    allowed: tuple[int, ...]

    def read(self, value: object, _folder: Path | None = None, /) -> int:
        if type(value) is not int or value not in self.allowed:
            raise FieldError.of(shown(value), self.expected)
        return value

    def write(self, value: Any, _folder: Path | None = None, /) -> int:
        return int(value)

    @property
    def expected(self) -> str:
        return " or ".join(str(entry) for entry in self.allowed)

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"enum": list(self.allowed)}


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
        return _list_schema(self.each.json_schema(definitions), self.count or 1, self.count)


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
        return _list_schema({"type": "integer", "minimum": self.low, "maximum": self.high}, 2, 2)


@dataclass(frozen=True, slots=True)
class Matrix(Kind):
    """A square matrix of finite numbers, row by row; read as an array (size, size)."""

    size: int

    def read(self, value: object, _folder: Path | None = None, /) -> FloatArray:
        found = _not_a_matrix(value, self.size)
        if found is not None:
            raise FieldError.of(found, f"{self.size} lists of {self.size} numbers each")
        return as_float_array(value)

    def write(self, value: Any, _folder: Path | None = None, /) -> list[list[float]]:
        rows: list[list[float]] = np.asarray(value).tolist()
        return rows

    @property
    def expected(self) -> str:
        return f"{self.size} lists of {self.size} numbers each"

    def json_schema(self, _definitions: dict[str, JsonSchema], /) -> JsonSchema:
        number = {"type": "number", "minimum": -_FINITE, "maximum": _FINITE}
        return _list_schema(_list_schema(number, self.size, self.size), self.size, self.size)


@dataclass(frozen=True, slots=True)
class Transform(Matrix):
    """A rigid transform, (4, 4): the rotation is projected to the nearest proper one.

    Attributes:
        max_translation_mm: longest translation.
        decimals: digits after the point of rotation and translation that are written; None: all.
    """

    size: int = 4
    max_translation_mm: float = MAX_TRANSLATION_MM
    decimals: tuple[int, int] | None = None

    def read(self, value: object, _folder: Path | None = None, /) -> FloatArray:
        matrix = Matrix.read(self, value)
        problem = transform_problem(matrix, self.max_translation_mm)
        if problem is not None:
            raise FieldError.of(*problem)
        return as_rigid(matrix)

    def write(self, value: Any, _folder: Path | None = None, /) -> list[list[float]]:
        """Raises FieldError where rounding is asked for and the matrix is not rigid or finite."""
        if self.decimals is None:
            return Matrix.write(self, value)
        _require_finite(value)
        if (problem := transform_problem(value)) is not None:
            raise FieldError.of(*problem)
        rotation, translation = self.decimals
        places = (rotation, rotation, rotation, translation)
        rows = as_rigid(value).tolist()
        return [[round(v, n) + 0.0 for v, n in zip(row, places, strict=True)] for row in rows]

    @property
    def expected(self) -> str:
        return "a rigid transform, 4x4"


@dataclass(frozen=True, slots=True)
class Covariance(Matrix):
    """A symmetric, positive definite (or semidefinite) matrix; made exactly symmetric on reading.

    Attributes:
        semidefinite: variances may be zero.
        digits: significant ones that are written; None: all.
    """

    semidefinite: bool = False
    digits: int | None = None

    def read(self, value: object, _folder: Path | None = None, /) -> FloatArray:
        matrix = Matrix.read(self, value)
        found = covariance_problem(matrix, semidefinite=self.semidefinite)
        if found is not None:
            definite = "semidefinite" if self.semidefinite else "definite"
            raise FieldError.of(found, f"a symmetric, positive {definite} covariance")
        return as_float_array(0.5 * (matrix + matrix.T))

    def write(self, value: Any, _folder: Path | None = None, /) -> list[list[float]]:
        """Raises FieldError where rounding is asked for and an entry is not finite."""
        if self.digits is None:
            return Matrix.write(self, value)
        _require_finite(value)
        return [[float(f"{v:.{self.digits}g}") for v in row] for row in np.asarray(value).tolist()]

    @property
    def expected(self) -> str:
        return f"a covariance, {self.size}x{self.size}"


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
        return _list_schema(self.each.json_schema(definitions), 0 if self.empty else 1, None)


@dataclass(frozen=True, slots=True)
class Points(Kind):
    """A list of points [x, y, z], read as an array (n, 3)."""

    each: Numbers

    def read(self, value: object, _folder: Path | None = None, /) -> FloatArray:
        return as_float_array(ListOf(self.each, self.expected).read(value), -1, 3)

    def write(self, value: Any, _folder: Path | None = None, /) -> list[Any]:
        return [self.each.write(point) for point in value]

    @property
    def expected(self) -> str:
        return f"a list of points [x, y, z] in {self.each.each.unit}"

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return _list_schema(self.each.json_schema(definitions), 1, None)


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
ANY_SIZE = Number(-_FINITE, _FINITE)
NOT_NEGATIVE = Number(0.0, 1e6)
POSITIVE_MM = Number(0.0, 1e4, above=True, unit="mm")
NOISE_MM = Number(0.0, 1e4, unit="mm")
SCAN_DEG = Number(-180.0, 180.0, unit="deg")
COORDINATE_MM = Number(-MAX_TRANSLATION_MM, MAX_TRANSLATION_MM, unit="mm")
POINT_MM = Numbers(3, COORDINATE_MM)


def in_radians(degrees: Number) -> Number:
    """The same interval in degrees in the file, read as radians."""
    return replace(degrees, degrees=True)


def _list_schema(items: JsonSchema, least: int, most: int | None) -> JsonSchema:
    schema: JsonSchema = {"type": "array", "items": items, "minItems": least}
    return schema if most is None else {**schema, "maxItems": most}


def _not_a_matrix(value: object, size: int) -> str | None:
    """What was found instead of ``size`` lists of ``size`` finite numbers, or None."""
    if not isinstance(value, list):
        return shown(value)
    if len(value) != size:
        return f"a list of {len(value)}"
    for i, row in enumerate(value):
        if not isinstance(row, list):
            return f"{shown(row)} as row {i}"
        if len(row) != size:
            return f"{len(row)} entries in row {i}"
        for entry in row:
            if type(entry) not in (int, float) or not -_FINITE <= entry <= _FINITE:
                return f"{shown(entry)} in row {i}"
    return None


def _require_finite(array: FloatArray) -> None:
    if not np.isfinite(array).all():
        raise FieldError.of("an entry that is not finite", "finite numbers")


def transform_problem(matrix: FloatArray, max_translation_mm: float = math.inf) -> tuple[str, str] | None:
    """Why a (4, 4) matrix is not a rigid transform: (found, expected); None where it is one."""
    if not is_rigid(matrix):
        rotation = matrix[:3, :3]
        off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
        if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > RIGID_TOLERANCE:
            found = f"the last row {shown(matrix[3].tolist())}"
        else:
            found = f"a matrix that is not rigid (R'R - I up to {off:.2g}, det R {np.linalg.det(rotation):.4g})"
        return found, f"a rigid transform (rotation to {RIGID_TOLERANCE:g}, last row [0, 0, 0, 1])"
    distance = math.hypot(*matrix[:3, 3].tolist())
    if distance > max_translation_mm:
        return f"a translation of {distance:.6g} mm", f"at most {max_translation_mm:g} mm"
    return None


def as_rigid(matrix: FloatArray) -> FloatArray:
    """The transform nearest to a matrix that is rigid within tolerance."""
    return as_float_array(make_transform(nearest_rotation(matrix[:3, :3]), matrix[:3, 3]))


def covariance_problem(matrix: FloatArray, *, semidefinite: bool = False) -> str | None:
    """Why a finite (n, n) matrix is not a covariance; None where it is one.

    Checked on the correlations, so that units do not matter: symmetric to 1e-6, smallest eigenvalue above 1e-9. With
    ``semidefinite``, variances may be zero and the eigenvalue only must not be negative beyond rounding.
    """
    variances = np.diag(matrix)
    if (variances < 0).any() or (not semidefinite and (variances == 0).any()):
        return f"the variance {variances.min():.4g} on the diagonal"
    sigmas = np.sqrt(variances)
    if not semidefinite and (sigmas.min() < _SIGMA_RANGE[0] or sigmas.max() > _SIGMA_RANGE[1]):
        return f"standard deviations from {sigmas.min():.2g} to {sigmas.max():.2g} (usable: 1e-9 to 1e6)"
    scale = np.where(sigmas > 0, sigmas, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):  # off-diagonals without measure end as correlations beyond 1
        correlations = np.nan_to_num(matrix / scale[:, None] / scale[None, :], posinf=1e30, neginf=-1e30)
    if np.abs(correlations - correlations.T).max() > _SYMMETRY_TOLERANCE:
        return "a matrix that is not symmetric"
    if np.abs(correlations).max() > 1.0 + _SYMMETRY_TOLERANCE:
        return "a correlation beyond 1"
    smallest = float(np.linalg.eigvalsh(0.5 * (correlations + correlations.T))[0])
    if smallest < (-_SYMMETRY_TOLERANCE if semidefinite else _MIN_CORRELATION_EIGENVALUE):
        return f"a matrix that is not positive definite (eigenvalue {smallest:.2g} of the correlations)"
    return None
