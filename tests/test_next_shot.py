"""Advice on the next shot: its figures are those of solving with that shot, and it improves the registration."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fgreg.errors import EstimationError
from fgreg.geometry.target_error import expected_tre_mm
from fgreg.geometry.transforms import as_float_array, inverse, transform_points
from fgreg.graph.packing import pack
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_graph import evaluate
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.measurements import Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.next_shot import TILT_RAD, advise
from fgreg.registration.register import Registration, register
from tests.forward import hear, make_measurements


def _registered(seed: int, pairs: int = 8, **arguments: object) -> tuple[SessionModel, Measurements, Registration]:
    model, measurements, _ = make_measurements(np.random.default_rng(seed), pairs=pairs, **arguments)  # type: ignore[arg-type]
    return model, measurements, register(measurements, model, SolveConfig())


def test_predicted_error_is_that_of_the_session_with_the_shot_added() -> None:
    model, measurements, found = _registered(0)
    advice = advise(found)
    state = found.optimum.state
    for shot in advice.shots[:2]:
        added = [replace(pair, pm=999) for pair in advice.candidates.shots[shot.candidate]]
        assert len({pair.marker.id for pair in added}) == 1
        added = [replace(pair, marker=replace(pair.marker, id=999)) for pair in added]
        longer = pack(replace(measurements, pairs=(*measurements.pairs, *added)), model)
        # Everything linearised at the estimate, the virtual PM at its place.
        private = initial_private(longer, state)
        points = np.concatenate([found.optimum.evaluation.private.trus_p_pm, shot.trus_p_mm[None, None]], axis=1)
        beam = np.concatenate([found.optimum.evaluation.private.beam_error, np.zeros((1, 1, 6))], axis=1)
        old = found.optimum.evaluation.private
        private = replace(private, trus_p_pm=points, beam_error=beam, aim_error=old.aim_error, aim_shift=old.aim_shift)
        covariance = np.linalg.inv(evaluate(longer, state, private).hessian[0])[:6, :6]
        expected = expected_tre_mm(covariance, state.trus_T_camera()[0], model.targets_mm).mean()
        assert shot.expected_mm == pytest.approx(expected, rel=2e-3)
        assert shot.expected_mm < advice.expected_mm


def test_shots_are_ranked_distinct_and_within_reach() -> None:
    model, _, found = _registered(1, pairs=12)
    advice = advise(found, count=4)
    expected = [shot.expected_mm for shot in advice.shots]
    assert len(expected) == 4
    assert expected == sorted(expected)
    low, high = model.stage.limits_device_rad
    for shot in advice.shots:
        assert all(low <= look.device_rad <= high for look in shot.looks)
        assert math.hypot(shot.tilt_right_rad, shot.tilt_down_rad) < 1.2 * TILT_RAD
        assert np.linalg.norm(shot.camera_d) == pytest.approx(1.0)
    worst = advice.order[-1]
    assert advice.shots[0].candidate == advice.order[0] != worst


def test_virtual_pairs_lie_on_their_beam_and_are_detected_where_stated() -> None:
    model, _, found = _registered(2, pairs=10)
    candidates = advise(found).candidates
    state = found.optimum.state
    transform = state.trus_T_camera()[0]
    for i in (0, len(candidates.shots) // 2, -1):
        trus_p = candidates.trus_p_mm[i]
        spot = transform_points(inverse(transform), trus_p)
        np.testing.assert_allclose(candidates.camera_p_spot_mm[i], spot, atol=1e-9)
        marker = candidates.camera_T_marker[i]
        origin = marker[:3, :3] @ state.beam_origin()[0] + marker[:3, 3]
        direction = marker[:3, :3] @ state.beam_direction()[0]
        np.testing.assert_allclose(direction, candidates.camera_d[i], atol=1e-9)
        assert np.linalg.norm(np.cross(spot - origin, direction)) < 1e-9
        assert [pair.look.sweep for pair in candidates.shots[i]] == [1, -1]
        for pair in candidates.shots[i]:
            distance, _, rotation = hear(trus_p, pair.look.scan_rad, model.probe.radius_mm)
            assert pair.look.range_mm == pytest.approx(distance)
            # In the middle of the step of its first detection: 6 deg less half of 2.
            assert rotation * pair.look.sweep == pytest.approx(math.radians(5.0), abs=1e-4)


def test_both_looks_are_given_by_the_device_s_angles_and_directions() -> None:
    _, _, found = _registered(3)
    for direction in (1, -1):
        model = replace(found.model, stage=replace(found.model.stage, direction=direction))
        advice = advise(replace(found, model=model))
        for shot in advice.shots:
            up, down = shot.looks  # the lower angle is that of the sweep upwards
            assert (up.sweep, down.sweep) == (1, -1)
            assert down.device_rad - up.device_rad == pytest.approx(math.radians(10.0), abs=2e-4)
            middle = model.stage.scan_from_device(0.5 * (up.device_rad + down.device_rad))
            assert middle == pytest.approx(math.atan2(shot.trus_p_mm[1], shot.trus_p_mm[2]), abs=1e-4)
        assert any("two looks at each spot" in note for note in advice.notes)


def test_looks_from_both_sides_are_expected_to_help_more_than_one() -> None:
    _, _, found = _registered(0, one_way=True)
    both, one = advise(found), advise(found, both_sides=False)
    assert both.expected_mm == one.expected_mm
    assert both.shots[0].expected_mm < one.shots[0].expected_mm
    _, _, alternating = _registered(1)
    both, one = advise(alternating), advise(alternating, both_sides=False)
    assert both.shots[0].expected_mm < 0.97 * one.shots[0].expected_mm


def test_one_look_comes_from_the_side_used_less() -> None:
    _, measurements, found = _registered(3, one_way=True)
    assert all(pair.look.sweep == 1 for pair in measurements.pairs)
    advice = advise(found, both_sides=False)
    assert advice.candidates.sweeps == (-1,)
    assert [len(shot) for shot in advice.candidates.shots] == [1] * len(advice.candidates.shots)
    assert any("both sides" in note for note in advice.notes)
    device = replace(found.model, stage=replace(found.model.stage, direction=-1))
    assert advise(replace(found, model=device), both_sides=False).shots[0].looks[0].sweep == 1
    _, _, window = _registered(3, first_hit=False)
    assert advise(window, both_sides=False).candidates.sweeps == (0,)
    assert advise(window).candidates.sweeps == (1, -1)


def test_few_pairs_are_reported_and_still_get_advice() -> None:
    for seed in range(4):
        _, _, found = _registered(seed, pairs=4)
        advice = advise(found)
        assert len(advice.shots) == 5
        assert any("few" in note or "another registration" in note for note in advice.notes)


def test_shots_that_exclude_another_minimum_come_first() -> None:
    rivals = 0
    for seed in range(8):
        _, _, found = _registered(seed, pairs=4)
        if not found.ambiguous:
            continue
        advice = advise(found)
        separation = advice.shots[0].separation
        assert separation is not None
        rivals += 1
        assert separation > 4.0
    assert rivals >= 2


def test_another_epoch_is_advised_on_with_its_own_pairs() -> None:
    _, measurements, found = _registered(5, pairs=16, epochs=2)
    last = advise(found)
    assert last.epoch == 1
    assert last.pairs == len({pair.pm for pair in measurements.pairs if pair.epoch == 1})
    assert advise(found, epoch=0).epoch == 0
    with pytest.raises(EstimationError, match="no registration"):
        advise(found, epoch=7)


def test_nothing_outside_the_camera_s_view_is_advised() -> None:
    model, measurements, found = _registered(6, pairs=10)
    matrix = as_float_array([[400.0, 0, 320], [0, 400.0, 240], [0, 0, 1]])
    wide = CameraModel((640, 480), matrix, as_float_array(np.zeros(5)))
    seen = advise(replace(found, model=replace(model, camera=StereoRig(wide))))
    everything = advise(found)
    assert 0 < len(seen.candidates.shots) < len(everything.candidates.shots)
    narrow = CameraModel((64, 48), as_float_array([[4e4, 0, 32], [0, 4e4, 24], [0, 0, 1]]), as_float_array(np.zeros(5)))
    with pytest.raises(EstimationError, match="no spot"):
        advise(replace(found, model=replace(model, camera=StereoRig(narrow))))
    del measurements
