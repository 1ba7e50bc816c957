"""The minimal solver gives the same poses whatever was computed before."""

from __future__ import annotations

import numpy as np

from fgreg.geometry.transforms import exp_so3
from fgreg.registration.minimal_solver import poses_of_three


def test_the_poses_are_right_and_do_not_depend_on_earlier_calls() -> None:
    rng = np.random.default_rng(0)
    rotation, translation = exp_so3(np.array([0.3, -0.2, 0.5])), np.array([5.0, -3.0, 60.0])
    points = rng.uniform(-20.0, 20.0, (3, 3))
    direction = rng.standard_normal((3, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = points @ rotation.T + translation - rng.uniform(20.0, 60.0, (3, 1)) * direction
    first = poses_of_three(origin, direction, points)
    assert min(float(np.abs(pose.R - rotation).max() + np.abs(pose.t - translation).max()) for pose in first) < 1e-6
    for _ in range(3):
        poses_of_three(origin + rng.standard_normal((3, 3)), direction, points)
        again = poses_of_three(origin, direction, points)
        assert len(again) == len(first)
        for one, other in zip(first, again, strict=True):
            np.testing.assert_array_equal(one.R, other.R)
            np.testing.assert_array_equal(one.t, other.t)
