"""The notebook docs/inspect.ipynb: its cells run, and a click on a PM leaves that PM out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.notebook import EntitySelectionItem, SelectionChangeEvent

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "inspect.ipynb"


def test_a_clicked_pm_is_left_out(pose_session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FGREG_SESSION", str(pose_session))
    cells = [cell for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]
    assert not [cell for cell in cells if cell["outputs"] or cell["execution_count"]]
    names: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(cells):
        exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
        if "display(viewer)" in cell["source"]:
            _click(names)
    assert names["clicked"] == [7]
    again = names["again"].estimate
    assert [shot.pm for shot in again.excluded] == [7]
    assert [pair.pm for pair in again.pairs if not pair.used] == [7]
    assert list(pose_session.glob("result.yaml")) == []  # the notebook works on a copy


def _click(names: dict[str, Any]) -> None:
    """What a browser sends for a click on the background, then beside PM 7."""
    (pair,) = [pair for pair in names["report"].estimate.pairs if pair.pm == 7]
    beside = (pair.trus_p_pm_mm + np.array([0.2, -0.3, 0.1])).tolist()
    for path, at in (("/world/probe", [0.0, 0.0, 0.0]), ("/world/looks/pm", beside)):
        (on_event,) = names["viewer"]._event_callbacks
        item = EntitySelectionItem(path, instance_id=0, view_name="World", position=at)
        on_event(SelectionChangeEvent("fgreg", "one", None, [item]))
