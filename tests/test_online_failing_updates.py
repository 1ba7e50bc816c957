"""A failing update, wherever it fails, leaves the online registration as it was, says why, and later events work."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import gtsam
import numpy as np
import pytest

import fgreg.online.engine as engine_module
import fgreg.online.state as state_module
import fgreg.online.summary as summary_module
import fgreg.online.updates as updates_module
import fgreg.online.window as window_module
from fgreg.errors import EventRefused
from fgreg.factors.adapter import FactorError
from fgreg.frames import as_float_array
from fgreg.measurements import Aim, EpochStart, Measurements, Pair
from fgreg.models import SessionModel
from fgreg.online import CameraMoved, OnlineEstimate, OnlineRegistration, StaticTags
from tests.forward import make_measurements
from tests.online_streams import run

FOLLOWING = 10


@lru_cache
def _base(pairs: int) -> tuple[SessionModel, Measurements, OnlineRegistration]:
    model, measurements, _ = make_measurements(np.random.default_rng(8), pairs=pairs + FOLLOWING)
    engine = OnlineRegistration(model, judge=None)
    run(engine, replace(measurements, pairs=measurements.pairs[:pairs]))
    return model, measurements, engine


def _engine(pairs: int) -> tuple[OnlineRegistration, Measurements, tuple[Pair, ...]]:
    """An engine with so many pairs taken in, and the pairs that follow."""
    model, measurements, base = _base(pairs)
    engine = OnlineRegistration(model, judge=None)
    # The state is a value and may be shared; what is stored is not.
    engine._state, engine._t, engine._serial, engine._estimate = base._state, base._t, base._serial, base._estimate
    engine._tools.store.aims.extend(measurements.aims)
    for pair in measurements.pairs[:pairs]:
        engine._tools.store.append(pair)
    return engine, measurements, measurements.pairs[pairs:]


def _bits(estimate: OnlineEstimate) -> bytes:
    arrays = (estimate.trus_T_camera, estimate.covariance, estimate.optimum_trus_T_camera)
    return b"".join(np.asarray(a).tobytes() for a in arrays) + repr((estimate.reasons, estimate.pairs)).encode()


def _raise(error: Exception) -> Callable[..., Any]:
    def fail(*_: object, **__: object) -> Any:
        raise error

    return fail


FAILURES: dict[str, Callable[[pytest.MonkeyPatch], None]] = {
    "a factor raises": lambda patch: patch.setattr(
        window_module, "point_on_line_factor", _raise(FactorError("no beam here"))
    ),
    "a factor raises inside gtsam": lambda patch: patch.setattr(
        window_module,
        "sensitivity_prior_factor",
        lambda theta, *_: gtsam.CustomFactor(
            gtsam.noiseModel.Unit.Create(1), [theta], _raise(RuntimeError("broken callback"))
        ),
    ),
    "a factor gives a number that is not finite": lambda patch: patch.setattr(
        window_module,
        "sensitivity_prior_factor",
        lambda theta, *_: gtsam.PriorFactorDouble(theta, float("nan"), gtsam.noiseModel.Isotropic.Sigma(1, 1.0)),
    ),
    "the private variables' system is singular": lambda patch: patch.setattr(
        window_module, "dtrtrs", lambda _, right: (right, 1)
    ),
    "the summary raises": lambda patch: patch.setattr(
        summary_module, "contributions", _raise(ArithmeticError("summary overflow"))
    ),
    "ISAM2 is indeterminate": lambda patch: patch.setattr(
        window_module, "updated", _raise(RuntimeError("Indeterminant linear system"))
    ),
    "the joint covariance is not finite": lambda patch: patch.setattr(window_module, "finite", lambda _: False),
    "the predicted error is not finite": lambda patch: patch.setattr(
        engine_module, "gaussian_tre", _raise(FloatingPointError("overflow"))
    ),
    "the innovation raises": lambda patch: patch.setattr(
        updates_module, "innovation", _raise(np.linalg.LinAlgError("not positive definite"))
    ),
}


@pytest.mark.parametrize(
    # Beyond 40 pairs not every pair touches the summary; the test below waits for one that does.
    ("failure", "pairs"),
    [(name, 14) for name in FAILURES] + [(name, 45) for name in FAILURES if name != "the summary raises"],
)
def test_a_failing_update_changes_nothing_and_later_events_work(
    failure: str, pairs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine, _, after = _engine(pairs)
    reference, _, _ = _engine(pairs)
    before, state = _bits(engine.estimate), engine.state
    with monkeypatch.context() as patch:
        FAILURES[failure](patch)
        # ``relaxed`` holds its own name of the function that updates a window.
        patch.setattr(state_module, "updated", window_module.updated)
        with pytest.raises(EventRefused) as refused:
            engine.add(after[0])
    assert refused.value.reason
    assert "\n" not in str(refused.value)
    assert engine.state is state
    assert _bits(engine.estimate) == before
    assert len(engine.measurements().pairs) == pairs
    # The next events give what they give where nothing had failed.
    for pair in after[:3]:
        found, expected = engine.add(pair), reference.add(pair)
        np.testing.assert_allclose(
            np.asarray(found.trus_T_camera), np.asarray(expected.trus_T_camera), rtol=0, atol=1e-8
        )
        assert (found.used, found.pairs, found.verdict) == (expected.used, expected.pairs, expected.verdict)


def test_a_failure_while_old_pairs_go_into_the_summary_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, _, after = _engine(45)
    refused = 0
    for pair in after:
        here, before = engine.state, _bits(engine.estimate)
        with monkeypatch.context() as patch:
            patch.setattr(summary_module, "contributions", _raise(ArithmeticError("summary overflow")))
            reason = ""
            try:
                engine.add(pair)
            except EventRefused as error:
                reason = error.reason
        if reason:
            refused += 1
            assert "summary overflow" in reason
            assert engine.state is here
            assert _bits(engine.estimate) == before
            engine.add(pair)
    assert refused


def test_a_failing_camera_move_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, _, after = _engine(12)
    before, state = _bits(engine.estimate), engine.state
    move = CameraMoved(after[0].t, np.eye(4), np.diag([1e-4] * 3 + [1.0] * 3))
    with monkeypatch.context() as patch:
        patch.setattr(updates_module, "passed_from", _raise(RuntimeError("no elimination")))
        with pytest.raises(EventRefused, match="no elimination"):
            engine.add(move)
    assert engine.state is state
    assert _bits(engine.estimate) == before
    assert engine.add(move).epoch == 1


def test_a_failing_judge_leaves_the_estimate_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(8), pairs=10)
    engine = OnlineRegistration(model, judge="inline")
    run(engine, replace(measurements, pairs=measurements.pairs[:9]))
    with monkeypatch.context() as patch:
        patch.setattr("fgreg.online.judge.solve", _raise(RuntimeError("no judgement")))
        estimate = engine.add(measurements.pairs[9])
    assert estimate.trus_T_camera is not None
    assert any("no judgement" in reason for reason in estimate.reasons)


def test_the_linearisation_point_is_handed_to_python_factors_uncopied() -> None:
    # GTSAM's wrapper copies all values at each callback unless their C++ object has a live Python wrapper: the window
    # holds it, and a copy of ISAM2 has one of its own.
    engine, _, _ = _engine(12)
    window = engine.state.window
    assert window is not None
    seen: list[gtsam.Values] = []

    def probe(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> np.ndarray:
        seen.append(values)
        if jacobians is not None:
            jacobians[0] = np.eye(1)
        return np.zeros(1)

    isam = gtsam.ISAM2(window.isam)
    theta = isam.getLinearizationPoint()
    key = gtsam.symbol("L", window.numbers + 1000)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [key], probe))
    values.insert(key, 0.0)
    isam.update(graph, values)
    assert seen
    assert all(each is theta for each in seen)
    assert window.theta is window.isam.getLinearizationPoint()


# --- what must not reach the graph ----------------------------------------------------------------------------------


def _spoil(pair: Pair, what: str) -> Any:
    marker, look = pair.marker, pair.look
    pose = marker.camera_T_marker.copy()
    nan = float("nan")
    if what == "a pose that is not finite":
        pose[0, 3] = nan
        return replace(pair, marker=replace(marker, camera_T_marker=pose))
    if what == "a pose that is not rigid":
        pose[:3, :3] *= 1.1
        return replace(pair, marker=replace(marker, camera_T_marker=pose))
    if what == "a covariance that is not finite":
        return replace(pair, marker=replace(marker, covariance=marker.covariance * nan))
    if what == "a covariance of the wrong shape":
        return replace(pair, marker=replace(marker, covariance=np.eye(3)))
    if what == "a covariance that is not symmetric":
        return replace(pair, look=replace(look, covariance=as_float_array([[0.1, 0.05], [0.0, 0.1]])))
    if what == "a range that is not finite":
        return replace(pair, look=replace(look, range_mm=float("inf")))
    if what == "a range below zero":
        return replace(pair, look=replace(look, range_mm=-3.0))
    if what == "an amplitude that is not finite":
        return replace(pair, look=replace(look, amplitude=nan))
    if what == "a sweep that is none":
        return replace(pair, look=replace(look, sweep=2))
    if what == "a time before the last event's":
        return replace(pair, t=0.5)
    if what == "a time that is not finite":
        return replace(pair, t=nan)
    if what == "a PM number of more than 64 bits":
        return replace(pair, pm=2**64)
    return "no event"


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("a pose that is not finite", "camera_T_marker has an entry that is not finite"),
        ("a pose that is not rigid", "camera_T_marker is no rigid transform"),
        ("a covariance that is not finite", "covariance of the marker has an entry"),
        ("a covariance of the wrong shape", "shape"),
        ("a covariance that is not symmetric", "not symmetric"),
        ("a range that is not finite", "range_mm is inf"),
        ("a range below zero", "range_mm is -3"),
        ("an amplitude that is not finite", "amplitude is nan"),
        ("a sweep that is none", "sweep is 2"),
        ("a time before the last event's", "before the last event"),
        ("a time that is not finite", "its time is nan"),
        ("a PM number of more than 64 bits", "64 bits"),
        ("no event at all", "no event of a registration"),
    ],
)
def test_bad_numbers_are_refused_before_the_graph_sees_them(what: str, said: str) -> None:
    engine, _, after = _engine(9)
    before, state = _bits(engine.estimate), engine.state
    with pytest.raises(EventRefused, match=said):
        engine.add(_spoil(after[0], what))
    assert engine.state is state
    assert _bits(engine.estimate) == before
    assert engine.add(after[0]).used


def test_bad_aims_moves_and_tags_are_refused() -> None:
    engine, measurements, after = _engine(9)
    t, aim = after[0].t, measurements.aims[0]
    bad: list[Any] = [
        Aim(t, aim.marker, np.array([0.0, np.nan, 1.0]), aim.covariance),
        Aim(t, aim.marker, aim.camera_p_spot_mm, -aim.covariance),
        CameraMoved(t, np.ones((4, 4))),
        CameraMoved(t, np.eye(4), np.full((6, 6), np.nan)),
        StaticTags(t, {3: np.zeros((4, 4))}, {}),
    ]
    for event in bad:
        with pytest.raises(EventRefused):
            engine.add(event)
    assert engine.add(StaticTags(t, {3: np.eye(4)}, {3: np.eye(6)})).trus_T_camera is not None


def test_more_pairs_cannot_be_reassigned_than_the_epoch_has() -> None:
    engine, _, _ = _engine(9)
    before = _bits(engine.estimate)
    with pytest.raises(EventRefused, match="of 9 in the epoch"):
        engine.reassign(10, EpochStart(1.0))
    assert _bits(engine.estimate) == before
