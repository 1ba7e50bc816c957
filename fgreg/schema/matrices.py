"""Kinds of matrices in a document: square ones, rigid transforms, covariances; the checks that others use, too."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.geometry.transforms import (
    RIGID_TOLERANCE,
    FloatArray,
    as_float_array,
    is_rigid,
    make_transform,
    nearest_rotation,
)
from fgreg.schema.kinds import FINITE, MAX_TRANSLATION_MM, JsonSchema, Kind, list_schema
from fgreg.schema.problems import FieldError, shown

_SYMMETRY_TOLERANCE = 1e-6
_MIN_CORRELATION_EIGENVALUE = 1e-9
_SIGMA_RANGE = (1e-9, 1e6)


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
        number = {"type": "number", "minimum": -FINITE, "maximum": FINITE}
        return list_schema(list_schema(number, self.size, self.size), self.size, self.size)


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
            if type(entry) not in (int, float) or not -FINITE <= entry <= FINITE:
                return f"{shown(entry)} in row {i}"
    return None


def _require_finite(array: FloatArray) -> None:
    if not np.isfinite(array).all():
        raise FieldError.of("an entry that is not finite", "finite numbers")


def transform_problem(matrix: FloatArray, max_translation_mm: float = math.inf) -> tuple[str, str] | None:
    """Why a (4, 4) matrix is not a rigid transform: (found, expected); None where it is one."""
    if not is_rigid(matrix):
        rotation = matrix[:3, :3]
        with np.errstate(all="ignore"):  # of any numbers, for the message only
            off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
            determinant = float(np.linalg.det(rotation))
        if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > RIGID_TOLERANCE:
            found = f"the last row {shown(matrix[3].tolist())}"
        else:
            found = f"a matrix that is not rigid (R'R - I up to {off:.2g}, det R {determinant:.4g})"
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
