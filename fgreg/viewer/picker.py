"""Which PM was clicked in a Rerun viewer in a notebook."""

from __future__ import annotations

from typing import Any

import numpy as np

from fgreg.model.estimate import SessionEstimate

_PMS = ("/world/looks/pm", "/world/looks/pm_95", "/world/shot/pm")
"""Entities of the recording that are PMs; in their view positions are TRUS mm."""


def picked_pm(event: Any, estimate: SessionEstimate) -> int | None:
    """The PM that was clicked in the 3D view of a session's recording; None where something else was.

    Args:
        event: what ``rerun.notebook.Viewer.on_event`` hands over. Where the selection changed it has the clicked entity
            and the place (3,) mm in the view.
        estimate: of the session.
    """
    known = [(pair.pm, pair.trus_p_pm_mm) for pair in estimate.pairs if pair.trus_p_pm_mm is not None]
    if getattr(event, "type", "") != "selection_change" or not known:
        return None
    for item in event.items:
        if item.type == "entity" and item.position is not None and f"/{item.entity_path.strip('/')}" in _PMS:
            away = [float(np.linalg.norm(trus_p_pm_mm - np.asarray(item.position))) for _, trus_p_pm_mm in known]
            return known[int(np.argmin(away))][0]
    return None
