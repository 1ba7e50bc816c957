"""Content of the explicit graph: which factors share which variables, and what is left out."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from fgreg.errors import EstimationError
from fgreg.geometry.rig import Constant
from fgreg.graph.gtsam_graph import GraphOptions, Variable, build_graph
from fgreg.graph.gtsam_values import SharedValues, beam_of_chart, laser_chart
from fgreg.model.session_model import NoiseModel
from fgreg.model.systematic import EXACT
from graph_optimum import initial_values, read_estimate
from tests.forward import make_measurements, make_session, random_marker_T_laser, with_noise
from tests.graph_cases import CASES, make_case, off_nominal


def variable_name(key: int) -> str:
    """A key as docs/model.md writes it, such as ``theta[3]``."""
    symbol = gtsam.Symbol(key)
    return f"{Variable(chr(symbol.chr())).name}[{symbol.index()}]"


def counts(explicit_keys: list[int]) -> Counter[str]:
    return Counter(variable_name(key).split("[")[0] for key in explicit_keys)


def test_variables_of_a_plain_session() -> None:
    explicit, _, _ = make_case(1, noise=True, aims=7, pairs=5)
    assert counts(list(explicit.graph.keyVector())) == {
        "trus_T_camera": 1,
        "marker_laser": 1,
        "camera_T_marker": 12,
        "lam": 12,
        "trus_p_pm": 5,
        "camera_p_spot": 7,
        "theta": 5,
        "rig": 1,
    }
    # Per aim: marker pose, point on line, spot. Per pair: marker pose, point on line, point on arc, window. An edge.
    assert explicit.graph.size() == 3 * 7 + 4 * 5 + 1


def test_keys_are_named_after_the_design() -> None:
    assert variable_name(Variable.theta.key(3)) == "theta[3]"
    assert variable_name(Variable.trus_T_camera.key(0)) == "trus_T_camera[0]"
    assert len({variable.value for variable in Variable}) == len(Variable)


def test_looks_with_one_marker_observation_share_its_pose_once() -> None:
    explicit, _, _ = make_case(2, noise=True, aims=0, pairs=4, looks_per_pm=3, share_marker=True)
    assert counts(list(explicit.graph.keyVector())) == {
        "trus_T_camera": 1, "marker_laser": 1, "rig": 1,
        "camera_T_marker": 4, "lam": 4, "trus_p_pm": 4, "theta": 12,
    }  # fmt: skip
    assert explicit.graph.size() == 4 * 2 + 12 * 2 + 1


def test_looks_with_markers_of_their_own_share_the_point_only() -> None:
    explicit, _, _ = make_case(2, noise=True, aims=0, pairs=4, looks_per_pm=3)
    assert counts(list(explicit.graph.keyVector())) == {
        "trus_T_camera": 1, "marker_laser": 1, "rig": 1,
        "camera_T_marker": 12, "lam": 12, "trus_p_pm": 4, "theta": 12,
    }  # fmt: skip


def test_one_observation_at_two_pms_is_two_shots() -> None:
    session, measurements, _ = make_measurements(np.random.default_rng(3), aims=0, pairs=2)
    first, second = measurements.pairs
    measurements = replace(measurements, pairs=(first, replace(second, marker=first.marker)))
    explicit = build_graph(measurements, session)
    assert counts(list(explicit.graph.keyVector()))["camera_T_marker"] == 2


def test_pms_may_have_any_number() -> None:
    session, measurements, truth = make_measurements(np.random.default_rng(3), aims=0, pairs=3)
    odd = {0: -7, 1: 10**18, 2: 0}
    measurements = replace(measurements, pairs=tuple(replace(pair, pm=odd[pair.pm]) for pair in measurements.pairs))
    explicit = build_graph(measurements, session, GraphOptions(marker_T_nominal=truth.marker_T_laser))
    shared = SharedValues(truth.trus_T_camera, np.zeros(4))
    estimate = read_estimate(explicit, initial_values(explicit, shared), shared)
    assert set(estimate.trus_p_pm_mm) == set(odd.values())


@pytest.mark.parametrize("case", CASES)
def test_private_variables_are_eliminated_first_and_all_are(case: str) -> None:
    explicit, shared, _ = make_case(4, noise=True, **CASES[case])
    ordering = explicit.ordering
    order = [ordering.at(i) for i in range(ordering.size())]
    assert order == [*explicit.private, *explicit.shared]
    assert sorted(order) == sorted(explicit.graph.keyVector())
    assert sorted(order) == sorted(initial_values(explicit, shared).keys())
    names = {variable_name(key).split("[")[0] for key in explicit.shared}
    assert names <= {"trus_T_camera", "marker_laser", "rig"}


def test_only_constants_that_are_not_exact_are_variables() -> None:
    bias = (Constant.MARKER_BIAS_X, Constant.MARKER_BIAS_Y, Constant.MARKER_BIAS_Z)
    for session, constants in (
        (make_session(), ()),
        (with_noise(make_session(), marker_bias_mm=0.5), bias),
        (
            make_session(systematic=replace(EXACT, sound_speed=0.01, radius_mm=0.2)),
            (Constant.RADIUS, Constant.SOUND_SPEED),
        ),
    ):
        explicit, _, _ = make_case(6, noise=True, session=session)
        assert explicit.keys.rig is not None
        assert explicit.keys.rig.constants == (Constant.WINDOW_EDGE, *constants)
        assert explicit.keys.rig.key in explicit.graph.keyVector()


def test_an_epoch_without_pairs_is_held_by_the_wide_motion_or_left_out() -> None:
    session, measurements, truth = make_measurements(np.random.default_rng(7), pairs=10, epochs=2)
    measurements = replace(measurements, pairs=measurements.pairs[:5])
    held = build_graph(measurements, session)
    assert held.keys.trus_T_camera[1] in held.shared
    out = build_graph(measurements, session, GraphOptions(unknown_motion_sigma=None))
    assert out.keys.trus_T_camera[1] not in out.shared
    shared = SharedValues(truth.trus_T_camera, np.zeros(4))
    estimate = read_estimate(out, initial_values(out, shared), shared)
    np.testing.assert_array_equal(estimate.shared.trus_T_camera[1], truth.trus_T_camera[1])


def test_a_pair_in_an_epoch_that_is_not_there_is_refused() -> None:
    session, measurements, _ = make_measurements(np.random.default_rng(8), pairs=2)
    stray = replace(measurements.pairs[1], epoch=1)
    with pytest.raises(EstimationError, match="epoch 1, of 1"):
        build_graph(replace(measurements, pairs=(measurements.pairs[0], stray)), session)


def test_another_number_of_registrations_than_epochs_is_refused() -> None:
    explicit, shared, _ = make_case(8, noise=True)
    with pytest.raises(ValueError, match="2 registrations, expected 1"):
        initial_values(explicit, replace(shared, trus_T_camera=shared.trus_T_camera * 2))


def test_noise_of_zero_still_makes_a_graph() -> None:
    silent = NoiseModel((0.0,) * 3, (0.0,) * 3, 0.0, (0.0,) * 3, 0.0, 0.0, 0.0)
    explicit, shared, _ = make_case(9, noise=False, session=make_session(noise_model=silent))
    values = initial_values(explicit, shared)
    assert explicit.graph.error(values) < 1e-12
    assert math.isfinite(explicit.graph.linearize(values).error(values.zeroVectors()))


def test_initial_values_follow_from_the_shared_state() -> None:
    explicit, shared, truth = make_case(10, noise=False, looks_per_pm=2)
    estimate = read_estimate(explicit, initial_values(explicit, shared), shared)
    _, offset = laser_chart(truth.marker_T_laser, off_nominal(truth))
    for pm, point in truth.trus_p_pm_mm.items():
        np.testing.assert_allclose(estimate.trus_p_pm_mm[pm], point, atol=1e-9)
    np.testing.assert_allclose(estimate.pair_lambda_mm, np.array(truth.pair_lambda_mm) + offset, atol=1e-9)
    np.testing.assert_allclose(estimate.aim_lambda_mm, np.array(truth.aim_lambda_mm) + offset, atol=1e-9)
    np.testing.assert_allclose(estimate.theta_rad, truth.theta_rad, atol=1e-9)
    np.testing.assert_allclose(estimate.pair_camera_T_marker, truth.pair_camera_T_marker, atol=1e-12)


def test_a_known_bias_is_taken_off_the_starting_poses() -> None:
    session = with_noise(make_session(), marker_bias_mm=0.5)
    explicit, shared, _ = make_case(11, noise=True, session=session)
    start = read_estimate(explicit, initial_values(explicit, shared), shared)
    bias = shared.constants[Constant.MARKER_BIAS_X : Constant.MARKER_BIAS_Z + 1]
    for pair, pose in zip(explicit.measurements.pairs, start.pair_camera_T_marker, strict=True):
        np.testing.assert_allclose(pair.marker.camera_T_marker[:3, 3] - pose[:3, 3], bias, atol=1e-12)


def test_chart_of_a_beam_is_the_same_line() -> None:
    rng = np.random.default_rng(12)
    for _ in range(20):
        beam, nominal = random_marker_T_laser(rng), random_marker_T_laser(rng)
        chart, offset = laser_chart(beam, nominal)
        origin, direction = beam_of_chart(chart, nominal)
        np.testing.assert_allclose(direction, beam[:3, 2], atol=1e-12)
        # 25 mm from the laser's origin is 25 mm + offset from the chart's.
        np.testing.assert_allclose(origin + (25.0 + offset) * direction, beam[:3, 3] + 25.0 * beam[:3, 2], atol=1e-11)


def test_beam_across_the_nominal_frame_has_no_chart() -> None:
    across = np.eye(4)[:, [1, 2, 0, 3]]  # z along the nominal x
    with pytest.raises(ValueError, match="does not point along"):
        laser_chart(across, np.eye(4))
