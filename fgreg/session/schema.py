"""Typed readers for data from files: each problem is collected with its place, and reading goes on.

A reader that fails returns a value of the right type that means nothing; :meth:`Fields.build` makes an object only
where nothing under it failed, so such a value never gets further.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar, cast

import numpy as np

from fgreg.errors import InputError, one_line
from fgreg.frames import RIGID_TOLERANCE, FloatArray, as_float_array, is_rigid, make_transform, nearest_rotation
from fgreg.session.safe_yaml import YamlMapping, YamlSequence

MAX_TRANSLATION_MM = 2000.0
SHOWN_CHARACTERS = 60

_SYMMETRY_TOLERANCE = 1e-6
_MIN_CORRELATION_EIGENVALUE = 1e-9
_SIGMA_RANGE = (1e-9, 1e6)

Built = TypeVar("Built")


def shown(value: object) -> str:
    """A value in at most about sixty characters on one line, as messages show it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return one_line(repr(value[: 2 * SHOWN_CHARACTERS]), SHOWN_CHARACTERS)
    if isinstance(value, Mapping):
        return f"a mapping with {len(value)} keys"
    if isinstance(value, list):
        if len(value) <= 8 and not any(isinstance(entry, list | Mapping) for entry in value):
            text = "[" + ", ".join(shown(entry) for entry in value) + "]"
            if len(text) <= SHOWN_CHARACTERS:
                return text
        return f"a list of {len(value)}"
    return one_line(repr(value), SHOWN_CHARACTERS)


@dataclass(frozen=True, slots=True)
class Bounds:
    """An interval of finite numbers, and the words for it."""

    low: float = -1e12
    high: float = 1e12
    above: bool = False
    unit: str = ""

    def __contains__(self, value: float) -> bool:
        return (self.low < value if self.above else self.low <= value) and value <= self.high

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        if self == replace(ANY, unit=self.unit):
            return f"a finite number{' in' if unit else ''}{unit}"
        if self.low == -self.high:
            return f"a number within +-{self.high:g}{unit}"
        return f"a number {'>' if self.above else '>='} {self.low:g} and <= {self.high:g}{unit}"


ANY = Bounds()
FINITE = Bounds(-1e100, 1e100)
NOT_NEGATIVE = Bounds(0.0, 1e6)
POSITIVE_MM = Bounds(0.0, 1e4, above=True, unit="mm")
NOISE_MM = Bounds(0.0, 1e4, unit="mm")


@dataclass(frozen=True, slots=True)
class Place:
    """Where in a file: ``session.yaml: probe.pitch_mm (line 7)`` or ``events.jsonl: line 7: trus.x_mm``."""

    file: str
    path: str = ""
    line: int | None = None
    line_first: bool = False

    def key(self, name: str, line: int | None = None) -> Place:
        name = one_line(name, SHOWN_CHARACTERS)
        return replace(self, path=f"{self.path}.{name}" if self.path else name, line=line or self.line)

    def item(self, index: int, line: int | None = None) -> Place:
        return replace(self, path=f"{self.path}[{index}]", line=line or self.line)

    def __str__(self) -> str:
        parts = [self.file]
        if self.line is not None and self.line_first:
            parts.append(f"line {self.line}")
        if self.path:
            at_line = f" (line {self.line})" if self.line is not None and not self.line_first else ""
            parts.append(self.path + at_line)
        return ": ".join(parts)


def nearest(word: str, known: Iterable[str]) -> str | None:
    """The known word that a misspelt one was probably meant to be."""
    by_lower = {name.lower(): name for name in known}
    matches = difflib.get_close_matches(word[:80].lower(), list(by_lower), n=1, cutoff=0.7)
    return by_lower[matches[0]] if matches else None


class Fields:
    """One mapping of a file: reads its keys with their types and collects what is wrong into ``problems``.

    Args:
        value: the mapping.
        known: the keys it may have, besides those that start with ``x_``. Others are reported at once, each with the
            known key it resembles; that one is then not reported as missing too.
        place: where it is.
        problems: what was wrong so far in this file; appended to.
    """

    def __init__(
        self, value: Mapping[str, object], known: Sequence[str], place: Place, problems: list[InputError]
    ) -> None:
        self.place = place
        self.problems = problems
        self._values = value
        self._lines: Mapping[str, int] = value.lines if isinstance(value, YamlMapping) else {}
        self._start = len(problems)
        self._misspelt: set[str] = set()
        for key in value:
            if key in known or key.startswith("x_"):
                continue
            meant = nearest(key, [name for name in known if name not in value])
            if meant is not None:
                self._misspelt.add(meant)
            every = f"one of {', '.join(known)}, or a name that starts with x_"
            self.fail(key, "an unknown key", f"a known one (did you mean {meant}?)" if meant else every)

    @property
    def ok(self) -> bool:
        """Whether nothing was wrong since this mapping was opened."""
        return len(self.problems) == self._start

    @property
    def misspelt(self) -> frozenset[str]:
        """Known keys that are absent but resemble an unknown one."""
        return frozenset(self._misspelt)

    def has(self, key: str) -> bool:
        return key in self._values

    def raw(self, key: str) -> object:
        return self._values.get(key)

    def at(self, key: str) -> Place:
        return self.place.key(key, self._lines.get(key))

    def fail(self, key: str, found: str, expected: str) -> None:
        """Report a problem at a key (or, where ``key`` is empty, of the mapping as a whole)."""
        where = self.at(key) if key else self.place
        self.problems.append(InputError(str(where), found, expected))

    def build(self, make: Callable[[], Built]) -> Built | None:
        """The object, where nothing was wrong since this mapping was opened; a ValueError becomes a problem."""
        if not self.ok:
            return None
        try:
            return make()
        except ValueError as error:
            self.fail("", f"values that do not fit together ({error})", "values that do")
            return None

    def _missing(self, key: str, expected: str) -> None:
        if key not in self._misspelt:
            self.fail(key, "nothing", expected)

    def number(self, key: str, bounds: Bounds = ANY, default: float | None = None) -> float:
        """A finite number in bounds; required where there is no default."""
        if key not in self._values:
            if default is None:
                self._missing(key, str(bounds))
            return math.nan if default is None else default
        value = self._values[key]
        if type(value) not in (int, float) or cast(float, value) not in bounds:
            self.fail(key, shown(value), str(bounds))
            return math.nan
        return float(cast(float, value))

    def integer(self, key: str, low: int, high: int, default: int | None = None) -> int:
        """An integer (3.0 is none) in [low, high]; required where there is no default."""
        expected = f"an integer from {low} to {high}"
        if key not in self._values:
            if default is None:
                self._missing(key, expected)
            return low if default is None else default
        value = self._values[key]
        if type(value) is not int or not low <= value <= high:
            self.fail(key, shown(value), expected)
            return low
        return value

    def choice(self, key: str, allowed: Sequence[int], default: int | None = None) -> int:
        """One of a few integers; required where there is no default."""
        value = self._values.get(key, default)
        if type(value) is not int or value not in allowed:
            expected = " or ".join(str(entry) for entry in allowed)
            if key in self._values:
                self.fail(key, shown(value), expected)
            else:
                self._missing(key, expected)
            return allowed[0]
        return value

    def boolean(self, key: str, default: bool | None = None) -> bool:
        """``true`` or ``false``; required where there is no default."""
        if key not in self._values:
            if default is None:
                self._missing(key, "true or false")
            return bool(default)
        value = self._values[key]
        if not isinstance(value, bool):
            self.fail(key, shown(value), "true or false")
            return False
        return value

    def text(self, key: str, expected: str = "a text", default: str | None = None, allowed: Sequence[str] = ()) -> str:
        """A text that is not empty, one of ``allowed`` where given; required where there is no default."""
        if key not in self._values:
            if default is None:
                self._missing(key, expected)
            return default or ""
        value = self._values[key]
        if isinstance(self._values, YamlMapping):
            value = self._values.texts.get(key, value)
        if not isinstance(value, str) or not value:
            self.fail(key, shown(value), expected)
            return ""
        if allowed and value not in allowed:
            meant = nearest(value, allowed)
            hint = f" (did you mean {meant}?)" if meant else ""
            self.fail(key, shown(value), (expected if len(allowed) > 8 else "one of " + ", ".join(allowed)) + hint)
            return ""
        return value

    def numbers(self, key: str, count: int | None, bounds: Bounds = ANY) -> FloatArray:
        """A list of ``count`` numbers (any count from one where None), each in bounds; required."""
        if key not in self._values:
            self._missing(key, _numbers_expected(count, bounds))
            return as_float_array(np.zeros(count or 1))
        return read_numbers(self._values[key], self.at(key), self.problems, count, bounds)

    def matrix(self, key: str, size: int) -> FloatArray | None:
        """A (size, size) matrix of finite numbers, or None with the problem reported; required."""
        if key not in self._values:
            self._missing(key, _matrix_expected(size))
            return None
        return read_matrix(self._values[key], self.at(key), self.problems, size)

    def transform(self, key: str, max_translation_mm: float = MAX_TRANSLATION_MM) -> FloatArray:
        """A (4, 4) rigid transform, its rotation projected to the nearest proper one; required."""
        if key not in self._values:
            self._missing(key, _matrix_expected(4))
            return as_float_array(np.eye(4))
        return read_transform(self._values[key], self.at(key), self.problems, max_translation_mm)

    def covariance(self, key: str, size: int, *, semidefinite: bool = False) -> FloatArray:
        """A (size, size) covariance, symmetric and positive definite (or semidefinite); required."""
        matrix = self.matrix(key, size)
        if matrix is not None:
            found = covariance_problem(matrix, semidefinite=semidefinite)
            if found is None:
                return as_float_array(0.5 * (matrix + matrix.T))
            definite = "semidefinite" if semidefinite else "definite"
            self.fail(key, found, f"a symmetric, positive {definite} covariance")
        return as_float_array(np.eye(size))

    def child(self, key: str, known: Sequence[str]) -> Fields | None:
        """The mapping at a key, or None with the problem reported; required."""
        expected = f"a mapping with {', '.join(known)}"
        if key not in self._values:
            self._missing(key, expected)
            return None
        value = self._values[key]
        if not isinstance(value, Mapping):
            self.fail(key, shown(value), expected)
            return None
        return Fields(value, known, self.at(key), self.problems)

    def items(self, key: str, expected: str, *, empty: bool = False) -> list[tuple[object, Place]]:
        """The entries of a list and their places; required, and not empty unless ``empty``."""
        if key not in self._values:
            self._missing(key, expected)
            return []
        value = self._values[key]
        if not isinstance(value, list) or not (value or empty):
            self.fail(key, shown(value), expected)
            return []
        lines = value.lines if isinstance(value, YamlSequence) else [self.place.line] * len(value)
        return [(entry, self.at(key).item(i, lines[i])) for i, entry in enumerate(value)]

    def children(self, key: str, known: Sequence[str], *, empty: bool = False) -> list[Fields]:
        """The mappings of a list; entries that are none are reported and left out."""
        out = []
        for entry, place in self.items(key, f"a list of mappings with {', '.join(known)}", empty=empty):
            if isinstance(entry, Mapping):
                out.append(Fields(entry, known, place, self.problems))
            else:
                self.problems.append(InputError(str(place), shown(entry), f"a mapping with {', '.join(known)}"))
        return out


def _numbers_expected(count: int | None, bounds: Bounds) -> str:
    return f"a list of {'numbers' if count is None else f'{count} numbers'}, each {bounds}"


def _matrix_expected(size: int) -> str:
    return f"{size} lists of {size} numbers each"


def read_numbers(
    value: object, place: Place, problems: list[InputError], count: int | None, bounds: Bounds = ANY
) -> FloatArray:
    """As :meth:`Fields.numbers`, of a value at a place."""
    if not isinstance(value, list) or (len(value) != count if count is not None else not value):
        problems.append(InputError(str(place), shown(value), _numbers_expected(count, bounds)))
    else:
        wrong = next((i for i, v in enumerate(value) if type(v) not in (int, float) or v not in bounds), None)
        if wrong is None:
            return as_float_array(value)
        where = place.item(wrong, value.lines[wrong] if isinstance(value, YamlSequence) else None)
        problems.append(InputError(str(where), shown(value[wrong]), str(bounds)))
    return as_float_array(np.zeros(count or 1))


def read_matrix(value: object, place: Place, problems: list[InputError], size: int) -> FloatArray | None:
    """As :meth:`Fields.matrix`, of a value at a place."""
    found = _not_a_matrix(value, size)
    if found is not None:
        problems.append(InputError(str(place), found, _matrix_expected(size)))
        return None
    return as_float_array(value)


def read_transform(
    value: object, place: Place, problems: list[InputError], max_translation_mm: float = MAX_TRANSLATION_MM
) -> FloatArray:
    """As :meth:`Fields.transform`, of a value at a place."""
    matrix = read_matrix(value, place, problems, 4)
    if matrix is not None:
        found = transform_problem(matrix, max_translation_mm)
        if found is None:
            return as_rigid(matrix)
        problems.append(InputError(str(place), *found))
    return as_float_array(np.eye(4))


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
            if type(entry) not in (int, float) or entry not in FINITE:
                return f"{shown(entry)} in row {i}"
    return None


def transform_problem(matrix: FloatArray, max_translation_mm: float = math.inf) -> tuple[str, str] | None:
    """What keeps a (4, 4) matrix of bounded entries from being a rigid transform, and what was expected, or None."""
    if not is_rigid(matrix):
        rotation = matrix[:3, :3]
        off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
        if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > RIGID_TOLERANCE:
            found = f"the last row {shown(matrix[3].tolist())}"
        else:
            found = f"a matrix that is not rigid (R'R - I up to {off:.2g}, det R {np.linalg.det(rotation):.4g})"
        return found, f"a rigid transform (rotation to {RIGID_TOLERANCE:g}, last row [0, 0, 0, 1])"
    distance = float(np.linalg.norm(matrix[:3, 3]))
    if distance > max_translation_mm:
        return f"a translation of {distance:.6g} mm", f"at most {max_translation_mm:g} mm"
    return None


def as_rigid(matrix: FloatArray) -> FloatArray:
    """The transform nearest to a matrix that is rigid within tolerance."""
    return as_float_array(make_transform(nearest_rotation(matrix[:3, :3]), matrix[:3, 3]))


def covariance_problem(matrix: FloatArray, *, semidefinite: bool = False) -> str | None:
    """What keeps a finite (n, n) matrix from being a covariance, or None.

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
