"""Transforms between the coordinate frames that a PLUS sequence names: ``MarkerToTrackerTransform`` and its like.

PLUS names a field after its direction: ``AToBTransform`` maps coordinates of A to those of B. A transform that a file
does not have is composed of those that it has, each as it is or inverted.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Collection
from dataclasses import dataclass

from fgreg.geometry.transforms import FloatArray, inverse

_NAME = re.compile(r"([A-Z]\w*?)To([A-Z]\w*)Transform")
_BASES = ("Tracker", "World")
"""Frames that PLUS's devices measure in; no tool has such a name."""


@dataclass(frozen=True, slots=True)
class Step:
    """One field on the way from one frame to another, and whether it is passed against its direction."""

    name: str
    inverted: bool = False

    def of(self, matrix: FloatArray) -> FloatArray:
        """The step's transform, (4, 4), from that of its field."""
        return inverse(matrix) if self.inverted else matrix


@dataclass(frozen=True, slots=True)
class Chain:
    """Fields whose transforms, the first one applied first, lead from one frame to another.

    ``told``: what has to be said of it; empty where its names say what it is.
    """

    steps: tuple[Step, ...]
    told: str = ""


def chain(fields: Collection[str], child: str, parent: str) -> Chain | None:
    """The shortest way from frame ``child`` to frame ``parent``; None where there is none."""
    beside: dict[str, list[tuple[str, Step]]] = {}
    for name in sorted(fields):
        if found := _NAME.fullmatch(name):
            beside.setdefault(found[1], []).append((found[2], Step(name)))
            beside.setdefault(found[2], []).append((found[1], Step(name, inverted=True)))
    came_by: dict[str, tuple[str, Step]] = {}
    waiting = deque([child])
    while waiting and parent not in came_by:
        here = waiting.popleft()
        for there, step in beside.get(here, ()):
            if there not in came_by and there != child:
                came_by[there] = here, step
                waiting.append(there)
    if parent not in came_by:
        return None
    steps: list[Step] = []
    at = parent
    while at != child:
        at, step = came_by[at]
        steps.append(step)
    return Chain(tuple(reversed(steps)))


def mapped_chain(name: str, fields: Collection[str], child: str, parent: str) -> Chain:
    """The way that begins with a field which a mapping names for ``ChildToParentTransform``.

    A field whose name states the other direction is inverted. One that ends in another frame than ``parent`` goes on
    from there by the file's other transforms. Where they do not lead on, the mapping is believed, and that is told.
    """
    found = _NAME.fullmatch(name)
    if found is None:
        return Chain((Step(name),))
    start, end = found[1], found[2]
    against = end != parent and start != child and (start in (parent, *_BASES) or end == child)
    if against:
        start, end = end, start
    first = Step(name, against)
    if end == parent:
        return Chain((first,))
    rest = chain({field for field in fields if field != name}, end, parent)
    if rest is None:
        text = (
            f"{name} is taken as {child}To{parent}Transform, as the mapping says: no field leads from {end} to {parent}"
        )
        return Chain((first,), text)
    return Chain((first, *rest.steps))
