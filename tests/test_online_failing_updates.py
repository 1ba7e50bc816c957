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
import fgreg.online.reported_estimate as report_module
import fgreg.smoother.isam_window as window_module
import fgreg.smoother.marginal_prior as prior_module
import fgreg.smoother.updates as updates_module
from fgreg.errors import EventRefused
from fgreg.factors.adapter import FactorError
from fgreg.geometry.transforms import as_float_array
from fgreg.model.measurements import Aim, Measurements, Pair
from fgreg.model.session_model import SessionModel
from fgreg.online.engine import OnlineRegistration
from fgreg.online.estimate import OnlineEstimate, gaussian_tre
from fgreg.online.events import CameraMoved, StaticTags
from fgreg.smoother.updates import LEAVE, MOST
from tests.forward import make_measurements
from tests.online_streams import batch, first, restored, sigmas_apart

FOLLOWING = 3


@lru_cache
def _base(pairs: int) -> tuple[SessionModel, Measurements, OnlineRegistration]:
    model, measurements, _ = make_measurements(np.random.default_rng(8), pairs=pairs + FOLLOWING)
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    return model, measurements, restored(engine, first(measurements, pairs))


def _engine(pairs: int) -> tuple[OnlineRegistration, Measurements, tuple[Pair, ...]]:
    """An engine with a number of pairs taken in, and the pairs that follow."""
    model, measurements, base = _base(pairs)
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    for name in ("_state", "_t", "_serial", "_estimate", "_misplaced"):  # all are values
        setattr(engine, name, getattr(base, name))
    return engine, measurements, measurements.pairs[pairs:]


@lru_cache
def _expected(pairs: int) -> list[OnlineEstimate]:
    """The estimates at the pairs that follow."""
    engine, _, after = _engine(pairs)
    return [engine.add(pair) for pair in after]


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
    "ISAM2 is indeterminate": lambda patch: patch.setattr(
        gtsam.ISAM2, "update", _raise(RuntimeError("Indeterminant linear system detected"))
    ),
    "ISAM2 throws": lambda patch: patch.setattr(gtsam.ISAM2, "update", _raise(RuntimeError("an invalid key"))),
    "the joint covariance is not finite": lambda patch: patch.setattr(window_module, "finite", lambda _: False),
    "the predicted error is not finite": lambda patch: patch.setattr(
        report_module, "gaussian_tre", _raise(FloatingPointError("overflow"))
    ),
    "the innovation raises": lambda patch: patch.setattr(
        updates_module, "innovation", _raise(np.linalg.LinAlgError("not positive definite"))
    ),
    "looking for misplaced PMs raises": lambda patch: patch.setattr(
        engine_module, "misplaced_pms", _raise(np.linalg.LinAlgError("not positive definite"))
    ),
}


@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.parametrize("pairs", [16, 45], ids=["all in the active window", "most in the marginal prior"])
def test_a_failing_update_changes_nothing_and_later_events_work(
    failure: str, pairs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine, _, after = _engine(pairs)
    before, state = _bits(engine.estimate), engine.state
    with monkeypatch.context() as patch:
        FAILURES[failure](patch)
        with pytest.raises(EventRefused) as refused:
            engine.add(after[0])
    assert refused.value.reason
    assert "\n" not in str(refused.value)
    assert engine.state is state
    assert _bits(engine.estimate) == before
    assert len(engine.measurements().pairs) == pairs
    # The next events give the same as without the failure.
    for pair, expected in zip(after, _expected(pairs), strict=True):
        found = engine.add(pair)
        np.testing.assert_allclose(
            np.asarray(found.trus_T_camera), np.asarray(expected.trus_T_camera), rtol=0, atol=1e-8
        )
        assert (found.used, found.pairs, found.verdict) == (expected.used, expected.pairs, expected.verdict)


def test_a_failure_while_pairs_go_into_the_marginal_prior_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, _, after = _engine(MOST - 1)
    engine.add(after[0])
    here, before = engine.state, _bits(engine.estimate)
    assert not here.marginalised
    with monkeypatch.context() as patch:
        patch.setattr(prior_module, "evaluate", _raise(ArithmeticError("overflow")))
        with pytest.raises(EventRefused, match="overflow"):
            engine.add(after[1])
    assert engine.state is here
    assert _bits(engine.estimate) == before
    assert engine.add(after[1]).pairs == MOST + 1
    assert len(engine.state.marginalised) == LEAVE


def test_numbers_that_overflow_at_few_pairs_leave_the_pair_and_the_full_solve_registers_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Among few pairs that contradict each other full steps may diverge: that is no defect of the pair.
    model, measurements, _ = _base(6)
    engine, _, after = _engine(6)
    with monkeypatch.context() as patch:
        patch.setattr(updates_module, "updated", _raise(ArithmeticError("not finite")))
        estimate = engine.add(after[0])
    assert len(engine.measurements().pairs) == estimate.pairs == 7
    assert sigmas_apart(batch(first(measurements, 7), model), estimate) < 0.05


def test_a_failing_camera_move_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    engine, _, after = _engine(16)
    before, state = _bits(engine.estimate), engine.state
    move = CameraMoved(after[0].t, np.eye(4), np.diag([1e-4] * 3 + [1.0] * 3))
    with monkeypatch.context() as patch:
        patch.setattr(prior_module, "evaluate", _raise(RuntimeError("no elimination")))
        with pytest.raises(EventRefused, match="no elimination"):
            engine.add(move)
    assert engine.state is state
    assert _bits(engine.estimate) == before
    assert engine.add(move).epoch == 1


@pytest.mark.parametrize("what", ["it raises", "its registration raises", "its estimate raises"])
def test_a_failing_full_solve_leaves_the_incremental_estimate_and_says_so(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(8), pairs=12)
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    restored(engine, first(measurements, 8))
    tre, calls = gaussian_tre, 0

    def second_call(*arguments: Any) -> Any:  # the first one is of the pair itself
        nonlocal calls
        calls += 1
        if calls == 2:
            raise ArithmeticError("a defect")
        return tre(*arguments)

    with monkeypatch.context() as patch:
        match what:
            case "it raises":
                patch.setattr("fgreg.online.full_solve.register", _raise(RuntimeError("a defect")))
            case "its registration raises":
                patch.setattr(engine_module, "initialised", _raise(RuntimeError("a defect")))
            case _:
                patch.setattr(report_module, "gaussian_tre", second_call)
        estimate = engine.add(measurements.pairs[8])
    assert estimate.trus_T_camera is not None
    assert estimate.pairs == len(engine.state.shots) == 9
    assert any("the full solve failed" in reason and "a defect" in reason for reason in estimate.reasons)
    assert not any("a defect" in reason for reason in engine.add(measurements.pairs[9]).reasons)


def test_the_linearisation_point_is_handed_to_python_factors_uncopied() -> None:
    # GTSAM's wrapper copies all values at each callback unless their C++ object has a live Python wrapper: the window
    # holds it, and a copy of ISAM2 has one of its own.
    engine, _, _ = _engine(16)
    window = engine.state.active_window
    assert window is not None
    seen: list[gtsam.Values] = []

    def probe(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> np.ndarray:
        seen.append(values)
        if jacobians is not None:
            jacobians[0] = np.eye(1)
        return np.zeros(1)

    isam = gtsam.ISAM2(window.isam)
    theta = isam.getLinearizationPoint()
    key = gtsam.symbol("L", 1000)
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
        ("a pose that is not rigid", "camera_T_marker is a matrix that is not rigid"),
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
        ("no event at all", "not an event of a registration"),
    ],
)
def test_bad_numbers_are_refused_before_the_graph_sees_them(what: str, said: str) -> None:
    engine, _, after = _engine(16)
    before, state = _bits(engine.estimate), engine.state
    with pytest.raises(EventRefused, match=said):
        engine.add(_spoil(after[0], what))
    assert engine.state is state
    assert _bits(engine.estimate) == before
    assert engine.add(after[0]).used


def test_bad_aims_moves_and_tags_are_refused() -> None:
    engine, measurements, after = _engine(16)
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
