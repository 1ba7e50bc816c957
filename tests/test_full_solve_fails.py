"""A full solve that fails is reported; an old verdict is not passed for a new one."""

from __future__ import annotations

import numpy as np
import pytest

from fgreg.estimate import Verdict
from fgreg.online import OnlineRegistration
from fgreg.online import judge as judge_module
from tests.forward import make_measurements
from tests.online_streams import events


def test_a_judge_that_fails_is_told_for_as_long_as_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(4), aims=14, pairs=18)
    stream = list(events(measurements))
    engine = OnlineRegistration(model, watch=None)
    for event in stream[:-6]:
        before = engine.add(event)
    assert before.verdict is Verdict.OK

    def failing(*_: object) -> object:
        raise ArithmeticError("no posterior")

    with monkeypatch.context() as patch:
        patch.setattr(judge_module, "judge", failing)
        for event in stream[-6:]:
            after = engine.add(event)  # the fifteenth pair is due, the sixteenth not
    assert after.verdict is Verdict.WARNING
    assert any("the full solve failed: ArithmeticError: no posterior" in reason for reason in after.reasons)
    settled = engine.settle()
    assert settled.settled
    assert not any("full solve failed" in reason for reason in settled.reasons)
