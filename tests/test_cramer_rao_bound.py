"""The bound at the truth: against errors of many solves, and its change with more or better data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cramer_rao_bound import FullTruth, beam_covariance, truth_covariance
from fgreg.geometry.target_error import expected_tre_mm, moved_mm, tre_mm
from fgreg.graph.packing import pack
from fgreg.graph.reduced_solver import optimize
from fgreg.graph.shared_state import make_state
from tests.forward import Truth, make_measurements


def _full(truth: Truth) -> FullTruth:
    return FullTruth(
        truth.trus_T_camera,
        truth.marker_T_laser,
        truth.trus_p_pm_mm,
        truth.pair_camera_T_marker,
        truth.aim_camera_T_marker,
        truth.window_edge_rad,
        truth.marker_bias_mm,
    )


def test_errors_of_many_solves_come_close_to_it() -> None:
    errors, bounds = [], []
    for seed in range(60):
        model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=15)
        covariance = truth_covariance(measurements, model, _full(truth))
        bounds.append(np.mean(expected_tre_mm(covariance[:6, :6], truth.trus_T_camera[0], model.targets_mm) ** 2))
        start = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
        found = optimize(pack(measurements, model), start).state.trus_T_camera()[0]
        errors.append(np.mean(tre_mm(found, truth.trus_T_camera[0], model.targets_mm) ** 2))
    ratio = np.sqrt(np.mean(errors) / np.mean(bounds))
    assert 0.8 < ratio < 1.2


def test_it_falls_with_every_pair() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(1), pairs=12)
    last = np.inf
    for count in (6, 8, 12):
        part = replace(_full(truth), pair_camera_T_marker=truth.pair_camera_T_marker[:count])
        covariance = truth_covariance(replace(measurements, pairs=measurements.pairs[:count]), model, part)
        bound = float(expected_tre_mm(covariance[:6, :6], truth.trus_T_camera[0], model.targets_mm).mean())
        assert bound < last
        last = bound


def test_it_does_not_depend_on_the_noise_drawn() -> None:
    model, measurements, truth = make_measurements(
        np.random.default_rng(2), pairs=10, points=2, spot_sigma_mm=(0.4, 0.4, 2.0)
    )
    exact = truth_covariance(measurements, model, _full(truth))
    rng = np.random.default_rng(0)
    noisier = tuple(
        replace(p, look=replace(p.look, x_mm=p.look.x_mm + rng.normal(), range_mm=p.look.range_mm + rng.normal()))
        for p in measurements.pairs
    )
    again = truth_covariance(replace(measurements, pairs=noisier), model, _full(truth))
    np.testing.assert_allclose(again, exact, rtol=1e-6, atol=1e-9)
    # Spots and points never take information away.
    unseen = replace(measurements, pairs=tuple(replace(p, spot=None) for p in measurements.pairs))
    for less in (unseen, replace(measurements, points=())):
        lost = truth_covariance(less, model, _full(truth)) - exact
        assert (np.linalg.eigvalsh(lost)[-3:] > 0.0).all()
        assert np.linalg.eigvalsh(lost)[0] > -1e-9


def test_bound_of_the_beam_halves_with_four_times_the_aims() -> None:
    sigmas = []
    for aims in (10, 40):
        values = []
        for seed in range(8):
            model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=0, aims=aims)
            full = replace(_full(truth), pair_camera_T_marker=())
            values.append(np.diag(beam_covariance(measurements, model, full))[:2].mean())
        sigmas.append(np.sqrt(np.mean(values)))
    assert 1.7 < sigmas[0] / sigmas[1] < 2.5


def test_a_twist_moves_targets_as_its_covariance_says() -> None:
    _, _, truth = make_measurements(np.random.default_rng(3), pairs=3)
    targets = np.array([[0.0, 0.0, 40.0], [15.0, 20.0, 30.0]])
    step = np.array([1e-5, -2e-5, 3e-5, 1e-3, 2e-3, -1e-3])
    expected = expected_tre_mm(np.outer(step, step), truth.trus_T_camera[0], targets)
    np.testing.assert_allclose(moved_mm(step, truth.trus_T_camera[0], targets), expected, rtol=1e-4)
