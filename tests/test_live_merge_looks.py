"""Looks at one spot as one PM, with the tremor of the hand."""

from __future__ import annotations

import numpy as np
import pytest

from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.live.actions import LocatedPulse
from fgreg.live.merge_looks import LEAST_SCATTER_MM, one_spot
from fgreg.model.time_sync import TimedPose


def look(t_s: float, turn: tuple[float, float, float], origin: tuple[float, float, float]) -> LocatedPulse:
    pose = TimedPose(t_s, make_transform(exp_so3(np.array(turn)), np.array(origin)), t_s * np.eye(6))
    return LocatedPulse(t_s, 0.1, pose, "", 1.0, 30.0, 0.01 * np.eye(2), 2.0)


def test_one_look_is_what_it_was() -> None:
    only = look(1.0, (0.1, 0.0, 0.0), (1.0, 2.0, 3.0))
    spot = one_spot([only])
    assert spot.looks == (only,)
    assert spot.marker is only.marker


def test_several_looks_get_the_mean_pose_and_the_wander_of_the_beams_end() -> None:
    looks = [look(1.0, (0.001, 0.0, 0.0), (0.1, 0.0, 100.0)), look(3.0, (-0.001, 0.0, 0.0), (-0.1, 0.0, 100.0))]
    spot = one_spot(looks)
    np.testing.assert_allclose(
        spot.marker.parent_T_child, make_transform(np.eye(3), np.array([0, 0, 100.0])), atol=1e-12
    )
    np.testing.assert_allclose(spot.marker.covariance, 2.0 * np.eye(6))
    assert spot.marker.t_s == 2.0
    # per axis, one degree of freedom: (0.1^2 + 0.1^2) / 3 mm^2, and at 50 mm (0.05^2 + 0.05^2) / 3 mm^2
    wander = (0.02 + 0.005) / 3.0
    for one in spot.looks:
        assert one.covariance is not None
        np.testing.assert_allclose(one.covariance, (0.01 + wander) * np.eye(2), rtol=1e-6)
        assert one.amplitude == 2.0


def test_a_rest_without_a_tremor_is_not_believed() -> None:
    spot = one_spot([look(float(t), (0.0, 0.0, 0.0), (0.0, 0.0, 90.0)) for t in range(1, 4)])
    for one in spot.looks:
        assert one.covariance is not None
        assert one.covariance[0, 0] == pytest.approx(0.01 + LEAST_SCATTER_MM**2)


def test_looks_without_a_marker_are_refused() -> None:
    with pytest.raises(ValueError, match="without a marker"):
        one_spot([look(1.0, (0.0, 0.0, 0.0), (0.0, 0.0, 90.0)), LocatedPulse(2.0, 0.1)])
    with pytest.raises(ValueError, match="without a marker"):
        one_spot([])
