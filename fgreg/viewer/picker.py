"""Which PM was clicked in a Rerun viewer in a notebook."""

from __future__ import annotations

import re
from typing import Any

from fgreg.model.estimate import SessionEstimate
from fgreg.viewer.scene import shots_of

_LOOK = re.compile(r"/?world/looks/(\d+)")
"""Entity of the recording that is the look of a shot: its PM, beam and arc."""


def picked_pm(event: Any, estimate: SessionEstimate) -> int | None:
    """The PM whose look was clicked in a session's recording; None where something else was.

    Args:
        event: what ``rerun.notebook.Viewer.on_event`` hands over. Where the selection changed it has what was clicked.
        estimate: of the session.
    """
    if getattr(event, "type", "") != "selection_change":
        return None
    for item in event.items:
        if item.type == "entity" and (look := _LOOK.fullmatch(item.entity_path)):
            positions = {shot.number: shot.position for shot in shots_of(estimate) if shot.kind == "pair"}
            position = positions.get(int(look[1]))
            return None if position is None else estimate.pairs[position].pm
    return None
