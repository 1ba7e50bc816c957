"""Devices lost in a live session: reported and recorded, the rest goes on, a device that returns is used again."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from fgreg.model.events import NoteEvent
from fgreg.session.session_reader import read_session
from tests.live_rig import STUDIED, Rig, rig, trial


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with rig(tmp_path_factory.mktemp("lost") / "session") as case:
        yield case


@pytest.mark.parametrize(
    "name",
    [
        "camera-gone",
        "camera-frozen",
        "probe-silent",
        "motion-silent",
        "stage-gone",
        "watchdog-killed",
        "locator-killed",
        "engine-killed",
        "disk-full",
    ],
)  # all of them: tools/study_lost.py
def test_a_loss_is_reported_and_the_rest_goes_on(case: Rig, name: str) -> None:
    fault = STUDIED[name]
    orders = fault.role in ("camera", "stage")  # what the stage's orders rest on
    found = trial(case, fault, 1.0, orders=orders, rest_s=0.5)
    assert found.reported_s == found.reported_s, f"never reported: {case.operator.messages[-5:]}"
    frames, pulses, _ = found.rates
    assert fault.role == "camera" or frames > 0.0
    assert fault.role == "probe" or pulses > 0.0
    assert found.back_s == found.back_s, f"never back: {case.session.loop.lost} {case.operator.messages[-5:]}"
    assert not orders or found.order_s == found.order_s, f"the stage is not used again: {case.operator.messages[-5:]}"
    assert fault.role not in case.session.loop.status().lost
    lines = [event.text for event in read_session(case.session.folder).events if isinstance(event, NoteEvent)]
    assert sum(line.startswith(f"{fault.role} lost") for line in lines) == sum(
        said.startswith(f"{fault.role} lost") for _, said in case.operator.messages
    )
