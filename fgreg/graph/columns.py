"""Places of the shared variables in a vector of all of them."""

from __future__ import annotations

from dataclasses import dataclass

from fgreg.geometry.rig import PROBE, Constant
from fgreg.geometry.transforms import FloatArray


@dataclass(frozen=True, slots=True)
class Columns:
    """Places of the shared variables in the vector of their perturbations.

    Order: 6 per epoch (rotation rad, translation mm; right tangent), beam chart 4, then one for each of ``constants``,
    the rig's constants that are variables, in ascending order.
    """

    epochs: int
    constants: tuple[int, ...]

    @property
    def beam(self) -> int:
        return 6 * self.epochs

    @property
    def first_constant(self) -> int:
        return 6 * self.epochs + 4

    @property
    def size(self) -> int:
        return self.first_constant + len(self.constants)

    @property
    def rig(self) -> slice:
        """The columns of the constants."""
        return slice(self.first_constant, self.size)

    @property
    def of_looks(self) -> tuple[int, ...]:
        """The constants that looks depend on."""
        return tuple(constant for constant in self.constants if constant < PROBE.stop)

    @property
    def of_camera(self) -> tuple[int, ...]:
        """The constants that marker poses and spots depend on."""
        return tuple(constant for constant in self.constants if constant >= PROBE.stop)

    def at(self, constant: Constant) -> int | None:
        """The column of a constant; None where it is not a variable."""
        return self.first_constant + self.constants.index(constant) if constant in self.constants else None


def make_columns(epochs: int, sigmas: FloatArray) -> Columns:
    """The columns for a number of epochs and standard deviations (COUNT,) of the constants.

    Constants of standard deviation 0 are no variables.
    """
    return Columns(epochs, tuple(index for index, sigma in enumerate(sigmas) if sigma > 0.0))
