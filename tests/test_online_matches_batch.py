"""The online registration: the optimum of the batch solver after every event, whatever the session's shape."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from fgreg.geometry.rig import Constant
from fgreg.geometry.target_error import gaussian_quantile_mm
from fgreg.geometry.transforms import as_float_array
from fgreg.model.estimate import Verdict
from fgreg.model.session_model import NoiseModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.cases import is_due
from fgreg.online.engine import OnlineRegistration
from fgreg.online.estimate import gaussian_tre
from fgreg.online.events import CameraMoved
from fgreg.online.full_solve import FullSolveCase, result_of
from fgreg.online.reported_estimate import NOT_SOLVED
from fgreg.online.solver import InProcessSolver
from fgreg.registration.register import register
from fgreg.registration.solve import solve
from fgreg.smoother.isam_window import free_number
from fgreg.smoother.updates import LEAVE, MOST
from tests.forward import make_measurements, make_session
from tests.online_streams import batch, events, first, restored, run, sigmas_apart

SHAPES: dict[str, dict[str, Any]] = {
    "first hit": {"pairs": 20},
    "window only": {"pairs": 20, "first_hit": False},
    "few aims": {"pairs": 20, "aims": 4},
    "two epochs, known motion": {"pairs": 24, "epochs": 2, "known_motion": True},
    "two epochs, unknown motion": {"pairs": 24, "epochs": 2},
    "three looks, own markers": {"pairs": 10, "looks_per_pm": 3},
    "two looks, one marker": {"pairs": 12, "looks_per_pm": 2, "share_marker": True},
    "spots seen": {"pairs": 8, "looks_per_pm": 2, "share_marker": True, "spot_sigma_mm": (0.4, 0.4, 1.5)},
    "known points": {"pairs": 12, "points": 3},
    "known points, two epochs": {"pairs": 24, "epochs": 2, "points": 4, "known_motion": True},
    "marker bias": {"pairs": 18, "session": make_session(noise_model=NoiseModel(marker_bias_mm=0.3))},
}


@pytest.mark.parametrize("shape", SHAPES)
def test_the_optimum_is_that_of_the_batch_solver_after_every_pair(shape: str) -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(1), **SHAPES[shape])
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    pairs = 0
    for event in events(measurements):
        estimate = engine.add(event)
        if isinstance(event, CameraMoved):
            continue
        pairs = len(engine.measurements().pairs)
        if pairs < 8 or pairs % 4:
            continue
        found = batch(first(measurements, pairs), model)
        if estimate.epoch not in found.epochs:
            assert estimate.trus_T_camera is None
            continue
        assert sigmas_apart(found, estimate) < 0.05
        place = found.epochs.index(estimate.epoch)
        assert estimate.covariance is not None
        there = np.sqrt(np.diag(found.covariance))[6 * place : 6 * place + 6]
        np.testing.assert_allclose(np.sqrt(np.diag(estimate.covariance)), there, rtol=0.05)
    assert pairs == len(measurements.pairs)


def test_long_streams_stay_at_the_batch_optimum_while_pairs_go_into_the_marginal_prior() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(3), pairs=MOST + 2 * LEAVE + 1)
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    restored(engine, first(measurements, MOST - 4))
    in_prior = []
    for pair in measurements.pairs[MOST - 4 :]:
        estimate, pairs = engine.add(pair), engine.state.epoch_pairs
        if pairs in (MOST, MOST + 1, MOST + LEAVE + 1, MOST + 2 * LEAVE + 1):  # but for the first: some have just left
            assert sigmas_apart(batch(first(measurements, pairs), model), estimate) < 0.05
            in_prior.append(len(engine.state.marginalised))
    assert in_prior == [0, LEAVE, 2 * LEAVE, 3 * LEAVE]


def test_sound_speed_as_a_variable_is_followed() -> None:
    config = SolveConfig(estimate_sound_speed=True)
    model, measurements, _ = make_measurements(np.random.default_rng(5), pairs=20, sound_speed_ratio=1.01)
    engine = OnlineRegistration(model, config, verdicts=False, find_moves=False)
    estimate = run(engine, measurements)[-1]
    found = register(measurements, model, config)
    assert sigmas_apart(found, estimate) < 0.05
    assert engine.state.active_window is not None
    ratio = float(engine.state.active_window.state.constant(Constant.SOUND_SPEED)[0])
    assert ratio == pytest.approx(float(found.optimum.state.constant(Constant.SOUND_SPEED)[0]), abs=1e-4)
    assert ratio != 1.0


def test_the_radius_as_a_variable_is_refused() -> None:
    with pytest.raises(ValueError, match="holds the probe's radius"):
        OnlineRegistration(make_session(), SolveConfig(estimate_radius=True))


def test_the_same_events_give_the_same_estimates() -> None:
    # Not to the last bit: how GTSAM's and numpy's sums round depends on where arrays happen to lie in memory.
    model, measurements, _ = make_measurements(np.random.default_rng(2), pairs=20)
    one, two = (OnlineRegistration(model, verdicts=False, find_moves=False) for _ in range(2))
    for a, b in zip(run(one, measurements), run(two, measurements), strict=True):
        if a.trus_T_camera is None or b.trus_T_camera is None:
            assert a.trus_T_camera is b.trus_T_camera
            continue
        assert a.used == b.used
        if a.pairs < 4:  # sigma up to 2 rad: what rounds is magnified a million times
            continue
        np.testing.assert_allclose(a.trus_T_camera, b.trus_T_camera, rtol=0, atol=1e-8)
        np.testing.assert_allclose(np.asarray(a.covariance), np.asarray(b.covariance), rtol=1e-7, atol=1e-12)


# --- reports --------------------------------------------------------------------------------------------------------


def test_without_a_full_solve_it_is_at_most_a_warning_and_settled_the_estimate_is_the_solve_s() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(4), pairs=14)
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    estimates = run(engine, measurements)
    assert all(estimate.verdict is not Verdict.OK for estimate in estimates)
    assert estimates[-1].reasons[0] == NOT_SOLVED
    assert not engine.estimate.settled
    settled, solution = engine.settle(), solve(measurements, [], model, SolveConfig())
    assert settled.settled
    assert settled.verdict is solution.verdict
    assert settled.reasons == solution.reasons
    pose, covariance = np.asarray(solution.epochs[0].trus_T_camera), np.asarray(solution.epochs[0].covariance)
    np.testing.assert_allclose(np.asarray(settled.trus_T_camera), pose, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.asarray(settled.covariance), covariance, rtol=1e-8, atol=1e-15)


def test_between_full_solves_the_report_keeps_the_posteriors_shift_and_width() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(4), pairs=11, first_hit=False)
    engine = OnlineRegistration(model, find_moves=False)
    solved, last = restored(engine, first(measurements, 10)).estimate, engine.add(measurements.pairs[10])
    window = engine.state.active_window
    assert solved.settled
    assert not last.settled
    assert window is not None
    taken = first(measurements, 10)
    solution = solve(taken, [], model, SolveConfig())
    report = result_of(FullSolveCase(0, 0, taken), taken, solution).report
    registration = solution.registration
    assert registration is not None
    assert report is not None
    # At the covariance that was solved it gives the posterior's covariance and mean back ...
    wide, shift = report.applied(registration.covariance[:6, :6])
    np.testing.assert_allclose(wide, np.asarray(solved.covariance), rtol=1e-6, atol=1e-12)
    mean = registration.optimum.state.trus_T_camera()[0] @ gtsam.Pose3.Expmap(shift).matrix()
    np.testing.assert_allclose(mean, np.asarray(solved.trus_T_camera), atol=1e-6)
    # ... and with one pair more what the optimum's own covariance makes of them.
    wide, shift = report.applied(window.covariance[:6, :6])
    np.testing.assert_allclose(np.asarray(last.covariance), wide, rtol=1e-3, atol=1e-9)
    mean = np.asarray(last.optimum_trus_T_camera) @ gtsam.Pose3.Expmap(shift).matrix()
    np.testing.assert_allclose(np.asarray(last.trus_T_camera), mean, atol=1e-3)
    assert np.abs(shift).max() > 1e-4


class _Recording(InProcessSolver):
    """``full``: no case is a draft. ``results``: of all cases since they were last cleared."""

    full = False

    def submit(self, case: FullSolveCase) -> None:
        super().submit(replace(case, draft=False, searched=None) if self.full else case)
        found, self.results = self._found, getattr(self, "results", [])
        if found is not None:
            self.results.append(found)


def test_a_draft_leaves_out_what_would_be_done_twice() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(0), pairs=10, epochs=2)
    engines = []
    for full in (False, True):
        engine = OnlineRegistration(model, find_moves=False)
        engine._solver = solver = _Recording(model, SolveConfig(), verdicts=True)
        solver.full = full
        restored(engine, first(measurements, 5))
        for event in list(events(measurements))[-6:-1]:  # the move, and four pairs
            solver.results = []
            engine.add(event)
        engines.append((engine.estimate, solver.results))
    (drafted, results), (whole, all_results) = engines
    assert [result.report is None for result in results] == [True, False]
    assert [result.report is None for result in all_results] == [False, False]
    assert drafted.settled
    assert drafted.reasons == whole.reasons
    np.testing.assert_array_equal(np.asarray(drafted.trus_T_camera), np.asarray(whole.trus_T_camera))
    np.testing.assert_array_equal(np.asarray(drafted.covariance), np.asarray(whole.covariance))


def test_the_schedule_of_full_solves_thins_out() -> None:
    due = [n for n in range(1, 700) if is_due(n)]
    assert due == [*range(1, 11), 12, 15, 20, 25, 30, 40, 60, 80, 160, 320, 640]


def test_closed_form_quantiles_are_within_one_percent() -> None:
    rng = np.random.default_rng(0)
    z = rng.standard_normal((400_000, 3))
    for axes in ((1, 1, 1), (1, 0, 0), (1, 0.5, 0.1), (1, 0.9, 0.05), (1, 0.1, 0.1), (1, 0.4, 0.4), (1, 1, 0.3)):
        variance = np.array(axes, dtype=np.float64)
        drawn = float(np.quantile(np.sqrt((z**2) @ variance), 0.95))
        assert float(gaussian_quantile_mm(np.diag(variance)[None])[0]) == pytest.approx(drawn, rel=0.01)


def test_predicted_tre_of_a_pure_shift_is_that_shift() -> None:
    covariance = np.diag([1e-12] * 3 + [1.0] * 3)
    model = make_session()
    tre = gaussian_tre(as_float_array(covariance), np.eye(4), model.targets_mm)
    assert tre.mean_mm == pytest.approx(np.sqrt(3.0), rel=1e-3)
    assert tre.worst_mm == pytest.approx(np.sqrt(7.815), rel=1e-2)


# --- epochs ---------------------------------------------------------------------------------------------------------


def test_after_a_move_without_a_motion_no_old_transform_is_presented_as_current() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(6), pairs=12, epochs=2)
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    seen = False
    for event in events(measurements):
        estimate = engine.add(event)
        if isinstance(event, CameraMoved):
            seen = True
            assert estimate.epoch == 1
            assert estimate.trus_T_camera is None
            assert estimate.verdict is Verdict.REFUSED
    assert seen
    assert estimate.trus_T_camera is not None


def test_a_reported_motion_gives_the_new_registration_at_once_and_widens_it() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(6), pairs=14, epochs=2, known_motion=True)
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    before = None
    for event in events(measurements):
        estimate = engine.add(event)
        if isinstance(event, CameraMoved):
            assert before is not None
            assert before.predicted_tre is not None
            assert estimate.predicted_tre is not None
            assert estimate.predicted_tre.worst_mm > before.predicted_tre.worst_mm
            tangent = np.linalg.inv(truth.trus_T_camera[1]) @ np.asarray(estimate.trus_T_camera)
            assert np.abs(tangent[:3, 3]).max() < 5.0
        before = estimate
    assert estimate.epoch == 1


def test_numbers_of_private_variables_are_used_again_and_never_twice_at_once() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(4), pairs=MOST + 3, looks_per_pm=2)
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    restored(engine, first(measurements, 2 * MOST - 4))
    for pair in measurements.pairs[2 * MOST - 4 :]:
        engine.add(pair)
        window = engine.state.active_window
        assert window is not None
        taken = [group.prepared.first + i for group in window.groups for i in range(len(group.pairs))]
        assert len(set(taken)) == len(taken)
        assert max(taken, default=0) < 4 * MOST
        free = free_number(window.groups, 3)
        assert not {free, free + 1, free + 2} & set(taken)
    assert engine.state.marginalised
