"""A full solve that fails is reported; an old verdict is not reported as a new one."""

from __future__ import annotations

import numpy as np
import pytest

from fgreg.model.estimate import Verdict
from fgreg.online import full_solve as full_solve_module
from fgreg.online.engine import OnlineRegistration
from tests.forward import make_measurements
from tests.online_streams import first, restored


def _failing(*_: object, **__: object) -> object:
    raise ArithmeticError("no posterior")


def test_a_full_solve_that_fails_is_reported_for_as_long_as_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(4), aims=14, pairs=17)
    engine = restored(OnlineRegistration(model), first(measurements, 14))
    assert engine.estimate.verdict is Verdict.OK
    with monkeypatch.context() as patch:
        patch.setattr(full_solve_module, "solve", _failing)
        for pair in measurements.pairs[14:16]:  # the fifteenth pair is due, the sixteenth not
            after = engine.add(pair)
            assert after.verdict is Verdict.WARNING
            assert any("the full solve failed: ArithmeticError: no posterior" in reason for reason in after.reasons)
            assert after.trus_T_camera is not None
    # The next event submits it again.
    again = engine.add(measurements.pairs[16])
    assert again.settled
    assert again.verdict is Verdict.OK
    assert not any("full solve failed" in reason for reason in again.reasons)


def test_a_full_solve_that_fails_when_a_session_is_opened_again_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(4), aims=14, pairs=8)
    engine = OnlineRegistration(model, find_moves=False)
    with monkeypatch.context() as patch:
        patch.setattr(full_solve_module, "solve", _failing)
        restored(engine, first(measurements, 7))
    assert engine.estimate.verdict is Verdict.REFUSED
    assert any("no posterior" in reason for reason in engine.estimate.reasons)
    assert len(engine.measurements().pairs) == 7
    assert engine.add(measurements.pairs[7]).settled
