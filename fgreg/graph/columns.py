"""Places of the shared variables in a vector of all of them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Columns:
    """Places of the shared variables in the vector of their perturbations; None for an absent one.

    Order: 6 per epoch (rotation rad, translation mm; right tangent), beam chart 4, window edge 1, then the optional
    marker bias 3, sound speed ratio 1, probe radius 1.
    """

    epochs: int
    bias: int | None
    sound_speed: int | None
    radius: int | None
    size: int

    @property
    def beam(self) -> int:
        return 6 * self.epochs

    @property
    def edge(self) -> int:
        return 6 * self.epochs + 4


def make_columns(epochs: int, *, bias: bool, sound_speed: bool, radius: bool) -> Columns:
    """The columns for a number of epochs, with the optional variables that are asked for."""
    size = 6 * epochs + 5
    bias_at = size if bias else None
    size += 3 * bias
    sound_at = size if sound_speed else None
    size += sound_speed
    radius_at = size if radius else None
    return Columns(epochs, bias_at, sound_at, radius_at, size + radius)
