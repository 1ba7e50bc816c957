"""Which measured pair stands behind which estimated look."""

from __future__ import annotations

from collections.abc import Sequence

from fgreg.estimate import PairEstimate
from fgreg.measurements import Measurements, Pair


def measured_pairs(pairs: Sequence[PairEstimate], measurements: Measurements) -> tuple[Pair | None, ...]:
    """The measured pair behind each estimated look, None where nothing was measured (no marker, no sound).

    Estimates list every look of the session, measurements only those that were detected; both are in event order, and
    ``t`` and ``pm`` tell them apart. Where several looks share both, those in use are served first.
    """
    waiting: dict[tuple[float, int], list[Pair]] = {}
    for pair in measurements.pairs:
        waiting.setdefault((pair.t, pair.pm), []).append(pair)
    found: list[Pair | None] = [None] * len(pairs)
    for position in sorted(range(len(pairs)), key=lambda i: not pairs[i].used):
        queue = waiting.get((pairs[position].t, pairs[position].pm))
        if queue:
            found[position] = queue.pop(0)
    return tuple(found)
