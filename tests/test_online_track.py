"""Queries while the session goes on: the results of the full solve, and refusals where there is no registration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.model.measurements import Measurements, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.events import CameraMoved
from fgreg.registration.solve import solve
from fgreg.tracking.query import track
from tests.forward import make_measurements
from tests.online_streams import restored
from tests.track_cases import held_out, query_of


def _session(seed: int, pairs: int) -> tuple[SessionModel, Measurements, list[Track]]:
    model, measurements, _ = make_measurements(np.random.default_rng(seed), pairs=pairs)
    used, out = held_out(measurements, 3)
    return model, used, [query_of(pairs, looks=1) for pairs in out]


def _engine(model: SessionModel) -> OnlineRegistration:
    return OnlineRegistration(model, verdicts=False, find_moves=False)


@pytest.mark.parametrize("seed", range(2))
def test_after_settling_the_results_are_those_of_the_full_solve(seed: int) -> None:
    model, used, queries = _session(seed, 25)
    engine = restored(_engine(model), used)
    engine.settle()
    silent = [replace(query, looks=(), look_markers=()) for query in queries]
    expected = solve(used, [*queries, *silent], model, SolveConfig()).tracks
    compared = 0
    for query, right in zip([*queries, *silent], expected, strict=True):
        answer = engine.track(query)
        assert answer.causal
        if right.stage_rad is None or right.sigma_rad is None or right.lambda_mm is None:
            assert answer.reason == right.reason
            continue
        assert answer.stage_rad is not None
        assert answer.lambda_mm is not None
        # The registration is the solve's; the beam and the window's edge are the graph's optimum, moved along.
        assert abs(answer.stage_rad - right.stage_rad) < 0.25 * right.sigma_rad
        assert answer.sigma_rad == pytest.approx(right.sigma_rad, rel=0.15)
        assert answer.lambda_mm == pytest.approx(right.lambda_mm, abs=1.0)
        compared += 1
    assert compared >= 3


def test_a_snapshot_is_made_once_an_event() -> None:
    model, used, queries = _session(2, 15)
    engine = restored(_engine(model), replace(used, pairs=used.pairs[:-1]))
    first = engine.snapshot()
    assert engine.snapshot() is first
    assert engine.track(queries[0]) == track(queries[0], first)
    engine.add(used.pairs[-1])
    second = engine.snapshot()
    assert second is not first
    assert (second.t, second.pairs) == (used.pairs[-1].t, first.pairs + 1)
    assert first.pairs == len(used.pairs) - 1


def test_before_a_registration_and_after_a_move_nothing_old_is_presented() -> None:
    model, used, queries = _session(3, 15)
    engine = _engine(model)
    answer = engine.track(queries[0])
    assert answer.stage_rad is None
    assert "the registration of camera epoch 0 is refused: no registration of this camera epoch" in answer.reason
    restored(engine, used)
    assert engine.track(queries[0]).stage_rad is not None
    engine.add(CameraMoved(used.pairs[-1].t + 1.0, None, None))
    old, new = engine.track(queries[0]), engine.track(replace(queries[0], epoch=1))
    assert old.stage_rad is None
    assert old.reason == "camera epoch 0 is over: queries are answered from epoch 1 on"
    assert new.stage_rad is None
    assert "camera epoch 1 is refused" in new.reason


def test_after_a_measured_motion_the_sigma_is_wider_and_after_a_vague_one_nothing_is_answered() -> None:
    model, used, queries = _session(4, 25)
    for sigma_rad, sigma_mm in ((0.005, 0.7), (0.2, 20.0)):
        engine = restored(_engine(model), used)
        before = engine.track(queries[0])
        loose = np.diag(np.square([sigma_rad] * 3 + [sigma_mm] * 3))
        engine.add(CameraMoved(used.pairs[-1].t + 1.0, np.eye(4), loose))
        after = engine.track(replace(queries[0], epoch=1))
        if sigma_rad > 0.1:
            assert after.stage_rad is None
            assert "camera epoch 1 is refused" in after.reason
            continue
        assert before.sigma_rad is not None
        assert after.sigma_rad is not None
        assert after.sigma_rad > 1.1 * before.sigma_rad
