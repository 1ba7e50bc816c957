"""``rig.yaml``: the rig's constants as a commissioning found them, with their full covariance."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Self

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.model.systematic import TEXTS
from fgreg.schema.hashes import Hashes
from fgreg.schema.kinds import ANY_SIZE, ListOf, Number, Numbers, Text
from fgreg.schema.problems import FieldError
from fgreg.schema.record import Key, record

RIG_FORMAT = "fgreg-rig/1"
SHARED_SECTIONS = ("probe", "camera", "marker", "board")
"""Sections of session.yaml that a rig's values are deviations from."""
MOST_CONDITION = 1e14
"""Largest condition number of the correlation of constants."""
_NAMES = tuple(text.name for text in TEXTS)


@dataclass(frozen=True, slots=True, eq=False)
class CommissionedRig:
    """Contents of ``rig.yaml``: K constants in the units of files, put in their own order.

    ``sessions``: of each session that it was made from, the SHA-256 of its files, and of the sections that the values
    are deviations from (:func:`section_hashes`).
    """

    names: Annotated[
        tuple[str, ...],
        Key(
            "keys of `systematic`, with an index",
            ListOf(Text("a constant of the rig", _NAMES), "a list of names of constants"),
        ),
    ]
    stored_values: Annotated[FloatArray, Key("true less declared", Numbers(None, ANY_SIZE), name="values")]
    stored_covariance: Annotated[
        FloatArray,
        Key(
            "of `values`, one row per name",
            ListOf(Numbers(None, ANY_SIZE), "a list of rows of numbers"),
            name="covariance",
        ),
    ]
    prior_sigmas: Annotated[FloatArray, Key("of the priors", Numbers(None, Number(0.0, 1e6, above=True)))]
    sessions: Annotated[
        tuple[dict[str, str], ...], Key("SHA-256 of files and sections of each session", ListOf(Hashes(), empty=True))
    ] = ()
    created: Annotated[str, Key("when, ISO 8601", Text("a time"))] = field(default="unknown")

    def __post_init__(self) -> None:
        count = len(self.names)
        if len(set(self.names)) != count:
            raise FieldError.of("a name again", "each name once", "names")
        try:
            covariance = np.array(self.stored_covariance, dtype=np.float64)
        except ValueError:
            covariance = np.zeros(0)
        for key, value in (("values", self.stored_values), ("prior_sigmas", self.prior_sigmas)):
            if np.shape(value) != (count,):
                raise FieldError.of(f"{len(value)} numbers", f"{count}, one per name", key)
        if covariance.shape != (count, count):
            raise FieldError.of("rows of other lengths", f"{count} rows of {count} numbers", "covariance")
        order = np.argsort(self.constants)
        object.__setattr__(self, "names", tuple(self.names[i] for i in order))
        for key in ("stored_values", "prior_sigmas"):
            object.__setattr__(self, key, getattr(self, key)[order])
        covariance = covariance[np.ix_(order, order)]
        object.__setattr__(self, "stored_covariance", covariance)
        variance = np.diag(covariance)
        if not (variance > 0.0).all() or not np.allclose(covariance, covariance.T, rtol=1e-6, atol=0.0):
            raise FieldError.of("a matrix that is no covariance", "a symmetric positive definite one", "covariance")
        values = np.linalg.eigvalsh(self.correlation)
        if values[0] <= values[-1] / MOST_CONDITION:
            raise FieldError.of("a matrix that is no covariance", "a symmetric positive definite one", "covariance")

    @classmethod
    def of(
        cls,
        constants: tuple[Constant, ...],
        value: FloatArray,
        covariance: FloatArray,
        prior_sigma: FloatArray,
        sessions: tuple[dict[str, str], ...],
        created: str,
    ) -> Self:
        """From values in the units of the memory."""
        unit = _per_unit(constants)
        names = tuple(TEXTS[constant].name for constant in constants)
        return cls(names, value * unit, covariance * np.outer(unit, unit), prior_sigma * unit, sessions, created)

    def widened(self) -> Self:
        """The same means with the priors' standard deviations: as before the commissioning, but about its values."""
        return replace(self, stored_covariance=np.diag(self.prior_sigmas**2))

    @property
    def constants(self) -> tuple[Constant, ...]:
        """In the order of ``names``."""
        return tuple(Constant(_NAMES.index(name)) for name in self.names)

    @property
    def value(self) -> FloatArray:
        """(K,) means: mm, rad, px, ratios."""
        return np.asarray(self.stored_values / _per_unit(self.constants))

    @property
    def covariance(self) -> FloatArray:
        """(K, K) in the same units."""
        unit = _per_unit(self.constants)
        return np.asarray(self.stored_covariance / np.outer(unit, unit))

    @property
    def sigma(self) -> FloatArray:
        """(K,) standard deviations."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def prior_sigma(self) -> FloatArray:
        """(K,) standard deviations before the commissioning."""
        return np.asarray(self.prior_sigmas / _per_unit(self.constants))

    @property
    def correlation(self) -> FloatArray:
        """(K, K)"""
        root = np.sqrt(np.diag(self.stored_covariance))
        return np.asarray(self.stored_covariance / np.outer(root, root))


def _per_unit(constants: tuple[Constant, ...]) -> FloatArray:
    return np.array([TEXTS[constant].per_unit for constant in constants])


RIG = record(CommissionedRig, ("format", RIG_FORMAT))
"""``rig.yaml``."""
