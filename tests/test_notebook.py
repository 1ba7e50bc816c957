"""The notebook docs/inspect.ipynb: its cells run, and a click on a PM leaves that PM out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from rerun.notebook import EntitySelectionItem, SelectionChangeEvent

from fgreg.viewer.scene import shots_of

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
    """What a browser sends for a click on the background, then on the look at PM 7."""
    estimate = names["report"].estimate
    (number,) = [
        shot.number for shot in shots_of(estimate) if shot.kind == "pair" and estimate.pairs[shot.position].pm == 7
    ]
    for path in ("/world/probe", f"/world/looks/{number}"):
        (on_event,) = names["viewer"]._event_callbacks
        item = EntitySelectionItem(path, instance_id=0, view_name="Scene", position=[0.0, 0.0, 0.0])
        on_event(SelectionChangeEvent("fgreg", "one", None, [item]))
