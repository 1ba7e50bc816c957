"""Pairs by time: interpolated marker poses, refused gaps, and clocks that jitter, drift and jump."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from fgreg.geometry.transforms import FloatArray, exp_so3, log_so3, make_transform
from fgreg.model.time_sync import (
    UNSTEADY_MM_S2,
    UNSTEADY_RAD_S2,
    DeviceClock,
    PairRefused,
    PoseHistory,
    Stamp,
    TimedPose,
    interpolate,
    pose_at,
)
from tests.numerical import random_pose

SIGMAS = np.array([0.01, 0.012, 0.008, 0.1, 0.12, 0.8])


def _timed(t_s: float, pose: FloatArray, scale: float = 1.0) -> TimedPose:
    return TimedPose(t_s, pose, np.diag((scale * SIGMAS) ** 2))


def _steady(t_s: float) -> FloatArray:
    """A body that turns at 2 rad/s about a fixed axis while its origin moves at 50 mm/s."""
    axis = np.array([0.36, 0.48, 0.8])
    return make_transform(
        exp_so3(2.0 * t_s * axis), np.array([10.0, -5.0, 120.0]) + 50.0 * t_s * np.array([0.6, 0, 0.8])
    )


def test_a_steady_motion_is_met_exactly() -> None:
    poses = [_timed(t, _steady(t)) for t in (0.0, 0.033, 0.066, 0.1)]
    for t in (0.001, 0.02, 0.033, 0.05, 0.0999):
        found = pose_at(poses, t)
        assert found.t_s == t
        np.testing.assert_allclose(found.parent_T_child, _steady(t), atol=1e-9)


def test_a_pulse_at_a_pose_gets_that_pose_untouched() -> None:
    poses = [_timed(t, _steady(t)) for t in (0.0, 0.033, 0.066)]
    assert pose_at(poses, 0.033) is poses[1]
    assert pose_at(poses[:1], 0.0) is poses[0]


@pytest.mark.parametrize("seed", range(5))
def test_derivatives_agree_with_numerical_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = random_pose(rng)
    b = a.compose(gtsam.Pose3.Expmap(np.concatenate([rng.normal(size=3) * 0.5, rng.normal(size=3) * 10.0])))
    share = float(rng.uniform(0.05, 0.95))
    middle, from_a, from_b = interpolate(a.matrix(), b.matrix(), share)

    def other(delta_a: FloatArray, delta_b: FloatArray) -> FloatArray:
        moved, _, _ = interpolate(a.retract(delta_a).matrix(), b.retract(delta_b).matrix(), share)
        return np.asarray(gtsam.Pose3(middle).localCoordinates(gtsam.Pose3(moved)))

    step, zero = 1e-6, np.zeros(6)
    for unit, column_a, column_b in zip(np.eye(6), from_a.T, from_b.T, strict=True):
        by_a = (other(step * unit, zero) - other(-step * unit, zero)) / (2.0 * step)
        by_b = (other(zero, step * unit) - other(zero, -step * unit)) / (2.0 * step)
        np.testing.assert_allclose(column_a, by_a, atol=1e-6)
        np.testing.assert_allclose(column_b, by_b, atol=1e-6)


def test_covariance_is_that_of_a_thousand_noisy_interpolations() -> None:
    rng = np.random.default_rng(7)
    a, b = gtsam.Pose3(_steady(0.0)), gtsam.Pose3(_steady(0.06))
    middle = pose_at([_timed(0.0, a.matrix()), _timed(0.06, b.matrix(), 2.0)], 0.02)
    errors = []
    for _ in range(4000):
        noisy = (a.retract(SIGMAS * rng.normal(size=6)), b.retract(2.0 * SIGMAS * rng.normal(size=6)))
        off, _, _ = interpolate(noisy[0].matrix(), noisy[1].matrix(), 1.0 / 3.0)
        errors.append(gtsam.Pose3(middle.parent_T_child).localCoordinates(gtsam.Pose3(off)))
    unsteady = 0.5 * 0.06**2 * 2.0 / 9.0 * np.repeat([UNSTEADY_RAD_S2, UNSTEADY_MM_S2], 3)
    expected = np.cov(np.array(errors).T) + np.diag(unsteady**2)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(middle.covariance / scale, expected / scale, atol=0.08)


def test_half_way_between_two_detections_is_known_better_than_either() -> None:
    still = _steady(0.0)
    middle = pose_at([_timed(0.0, still), _timed(0.02, still)], 0.01)
    sigma = np.sqrt(np.diag(middle.covariance))
    assert (sigma < 0.75 * SIGMAS).all()
    assert (sigma > SIGMAS / math.sqrt(2.0)).all()


@pytest.mark.parametrize(
    ("times", "pulse", "says"),
    [
        ((), 1.0, "no marker pose at all"),
        ((1.0, 1.03), 0.99, "no marker pose before the pulse: the nearest is 10 ms away"),
        ((1.0, 1.03), 1.05, "no marker pose after the pulse: the nearest is 20 ms away"),
        ((1.0, 1.2), 1.1, "200 ms apart, at most 100 ms allowed"),
        ((1.0, 1.03), math.nan, "time is nan"),
    ],
)
def test_where_the_marker_was_not_seen_around_the_pulse_the_pair_is_refused(
    times: tuple[float, ...], pulse: float, says: str
) -> None:
    with pytest.raises(PairRefused, match=says):
        pose_at([_timed(t, _steady(t)) for t in times], pulse)


def test_poses_out_of_order_are_a_defect() -> None:
    with pytest.raises(ValueError, match="time order"):
        pose_at([_timed(1.0, _steady(0.0)), _timed(0.9, _steady(0.0))], 0.95)


def test_nearly_half_a_turn_between_poses_takes_the_shorter_way() -> None:
    a = make_transform(np.eye(3), np.zeros(3))
    b = make_transform(exp_so3(np.array([0.0, 0.0, 3.1])), np.zeros(3))
    middle, _, _ = interpolate(a, b, 0.5)
    np.testing.assert_allclose(log_so3(middle[:3, :3]), [0.0, 0.0, 1.55], atol=1e-9)


def test_history_is_bounded_and_takes_no_pose_from_the_past() -> None:
    history = PoseHistory(keep_s=1.0)
    assert history.newest() is None
    assert all(history.add(_timed(0.03 * i, _steady(0.0))) for i in range(200))
    assert not history.add(_timed(0.5, _steady(0.0)))
    newest = history.newest()
    assert newest is not None
    assert newest.t_s == pytest.approx(0.03 * 199)
    assert history.can_tell(5.0)
    assert not history.can_tell(6.0)
    with pytest.raises(PairRefused, match="before the pulse"):
        history.at(4.9)
    assert history.at(5.5).t_s == 5.5
    history.clear()
    with pytest.raises(PairRefused, match="no marker pose at all"):
        history.at(5.5)


def test_device_clock_leaves_the_jitter_of_the_way_out_and_follows_a_drift() -> None:
    rng = np.random.default_rng(3)
    clock = DeviceClock(latency_s=0.002)
    late = []
    for i in range(3000):
        event = 100.0 + i / 30.0
        device = 5000.0 + (event - 100.0) * (1.0 + 20e-6)  # 20 ppm fast
        host = event + 0.002 + rng.exponential(0.004)
        late.append(clock.host_time(Stamp(device, host)) - event)
    assert np.abs(late[50:]).max() < 1.5e-3
    assert abs(float(np.mean(late[-500:]))) < 5e-4


@pytest.mark.parametrize("device_after", [0.0, 9000.0])
def test_device_that_was_switched_off_and_on_starts_a_new_clock(device_after: float) -> None:
    clock = DeviceClock()
    for i in range(100):
        clock.host_time(Stamp(5000.0 + 0.03 * i, 10.0 + 0.03 * i))
    assert clock.host_time(Stamp(device_after, 20.0)) == pytest.approx(20.0)
    assert clock.host_time(Stamp(device_after + 0.03, 20.04)) == pytest.approx(20.03)


def test_message_held_up_on_its_way_moves_no_clock() -> None:
    clock = DeviceClock()
    for i in range(100):
        clock.host_time(Stamp(5000.0 + 0.03 * i, 10.0 + 0.03 * i))
    assert clock.host_time(Stamp(5003.0, 14.5)) == pytest.approx(13.0)
    assert clock.host_time(Stamp(5003.03, 14.6)) == pytest.approx(13.03)


def test_time_that_is_no_number_is_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        Stamp(math.nan, 1.0)


def test_between_far_apart_frames_a_held_hand_is_as_steady_as_its_poses_and_a_moving_one_is_not() -> None:
    still, moving = PoseHistory(), PoseHistory()
    rng = np.random.default_rng(1)
    for k in range(7):
        for history, speed in ((still, 0.0), (moving, 40.0)):
            pose = np.eye(4)
            pose[:3, 3] = 0.05 * rng.standard_normal(3) + [speed * 0.3 * k, 0.0, 0.0]
            history.add(TimedPose(0.3 * k, pose, 1e-4 * np.eye(6)))
    held, moved = (np.sqrt(history.at(1.05, 0.5).covariance[3, 3]) for history in (still, moving))
    assert 0.05 < held < 0.25
    assert moved > 2.0
    with pytest.raises(PairRefused, match="300 ms apart"):
        still.at(1.05)
