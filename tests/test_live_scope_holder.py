"""Moves of the camera as its holder reports them: detected at once, measured between rests, never guessed."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import expm

from fgreg.drivers.base import MotionSample
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, make_transform
from fgreg.live.scope_holder import Holder, HolderMove, HolderSettings
from fgreg.model.time_sync import Stamp

RATE_S = 0.02
START = make_transform(exp_so3(np.array([0.4, -1.1, 0.3])), np.array([250.0, -80.0, 900.0]))
MOVE = make_transform(exp_so3(np.array([0.03, -0.02, 0.05])), np.array([4.0, -3.0, 2.0]))
"""base_T_camera after it: START MOVE."""


class Arm:
    """A holder that is asked at 50 Hz; ``pose(t)`` is its base_T_camera."""

    def __init__(self, settings: HolderSettings | None = None, noise_mm: float = 0.05, seed: int = 4) -> None:
        self.holder = Holder(settings or HolderSettings())
        self.t_s, self.noise_mm = 0.0, noise_mm
        self.rng = np.random.default_rng(seed)
        self.moves: list[tuple[float, HolderMove]] = []
        self.moving: list[tuple[float, bool]] = []

    def run(self, seconds: float, pose: Callable[[float], FloatArray], covariance: FloatArray | None = None) -> None:
        start = self.t_s
        while self.t_s < start + seconds:
            self.t_s += RATE_S
            at = pose(self.t_s - start)
            noise = make_transform(
                exp_so3(2e-4 * self.rng.standard_normal(3)), self.noise_mm * self.rng.standard_normal(3)
            )
            sample = MotionSample(Stamp(500.0 + self.t_s, self.t_s + 0.003), at @ noise, covariance)
            self._took(self.holder.take([sample], self.t_s + 0.003))

    def silence(self, seconds: float) -> None:
        start = self.t_s
        while self.t_s < start + seconds:
            self.t_s += RATE_S
            self._took(self.holder.take([], self.t_s))

    def _took(self, move: HolderMove | None) -> None:
        self.moving.append((self.t_s, self.holder.moving_since_s is not None))
        if move is not None:
            self.moves.append((self.t_s, move))


def on_the_way(t: float) -> FloatArray:
    """From START to START MOVE in a second."""
    share = min(max(t, 0.0), 1.0)
    turn = np.array([0.03, -0.02, 0.05])
    return START @ make_transform(exp_so3(share * turn), share * MOVE[:3, 3])


def moved_arm(covariance: FloatArray | None = None) -> Arm:
    arm = Arm()
    arm.run(1.0, lambda _: START, covariance)
    arm.run(1.0, on_the_way, covariance)
    arm.run(1.0, lambda _: START @ MOVE, covariance)
    return arm


def test_a_camera_at_rest_has_not_moved() -> None:
    arm = Arm(noise_mm=0.1)
    arm.run(60.0, lambda _: START)
    assert arm.moves == []
    assert not any(moving for _, moving in arm.moving)


def test_a_move_is_reported_with_its_motion_once_it_is_over() -> None:
    arm = moved_arm()
    ((t_s, move),) = arm.moves
    assert move.camera_new_T_camera_old is not None
    # By hand: points fixed in the base, seen before and after.
    base_p = np.array([30.0, 10.0, 700.0, 1.0])
    before, after = np.linalg.inv(START) @ base_p, np.linalg.inv(START @ MOVE) @ base_p
    assert np.allclose(move.camera_new_T_camera_old @ before, after, atol=0.2)
    assert np.allclose(move.camera_new_T_camera_old, np.linalg.inv(MOVE), atol=0.1)
    assert 2.0 + 0.3 <= t_s <= 2.0 + 0.6  # the way took from 1 to 2 s
    assert 1.0 < move.since_s < 1.5


def test_while_it_moves_that_is_known() -> None:
    moving = {round(t, 2): value for t, value in moved_arm().moving}
    assert not moving[0.9]
    assert moving[1.5]
    assert moving[2.2]
    assert not moving[2.8]


def test_it_is_noticed_before_the_view_has_shifted_by_much() -> None:
    arm = moved_arm()
    since = arm.moves[0][1].since_s
    shift = np.linalg.inv(on_the_way(since - 1.0)) @ START @ np.array([0.0, 0.0, 100.0, 1.0])
    assert np.linalg.norm(shift[:3] - [0.0, 0.0, 100.0]) < 1.5


def test_the_covariance_is_that_of_the_right_tangent() -> None:
    """Against the spread of motions computed from perturbed poses."""
    rng = np.random.default_rng(8)
    root = rng.normal(0.0, 1.0, (6, 6)) * np.repeat([0.002, 0.3], 3)[:, None]
    covariance = root @ root.T
    settings = HolderSettings(1e-6, 1e-9)
    arm = Arm(settings, noise_mm=0.0)
    for pose in (lambda _: START, on_the_way, lambda _: START @ MOVE):
        arm.run(1.0, pose, covariance)
    move = arm.moves[0][1]
    assert move.covariance is not None

    def exp6(xi: FloatArray) -> FloatArray:
        twist = np.zeros((4, 4))
        twist[:3, :3] = np.array([[0, -xi[2], xi[1]], [xi[2], 0, -xi[0]], [-xi[1], xi[0], 0]])
        twist[:3, 3] = xi[3:]
        return np.asarray(expm(twist))

    mean = inverse(START @ MOVE) @ START
    found = []
    for _ in range(4000):
        old, new = (exp6(root @ rng.standard_normal(6)) for _ in range(2))
        off = inverse(mean) @ inverse(START @ MOVE @ new) @ START @ old
        found.append([off[2, 1], off[0, 2], off[1, 0], *off[:3, 3]])
    spread = np.cov(np.array(found).T)
    scale = np.sqrt(np.diag(spread))
    assert np.abs((move.covariance - spread) / np.outer(scale, scale)).max() < 0.1


def test_the_stated_accuracy_of_a_move_is_in_its_covariance() -> None:
    move = moved_arm().moves[0][1]
    assert move.covariance is not None
    settings = HolderSettings()
    expected = np.repeat([settings.sigma_rad, settings.sigma_mm], 3)
    assert np.allclose(np.sqrt(np.diag(move.covariance)), expected)


def test_there_and_back_is_no_move_but_invalid_meanwhile() -> None:
    arm = Arm()
    arm.run(1.0, lambda _: START)
    arm.run(1.0, lambda t: on_the_way(math.sin(math.pi * t)))
    arm.run(1.0, lambda _: START)
    assert arm.moves == []
    assert any(moving for _, moving in arm.moving)
    assert not arm.moving[-1][1]


def test_one_wrong_sample_is_no_move() -> None:
    arm = Arm()
    arm.run(1.0, lambda _: START)
    arm.run(RATE_S, lambda _: START @ MOVE)
    arm.run(1.0, lambda _: START)
    assert arm.moves == []
    assert not arm.moving[-1][1]


def test_creeping_adds_up() -> None:
    arm = Arm()
    arm.run(1.0, lambda _: START)
    slow = make_transform(np.eye(3), np.array([3.0, 0.0, 0.0]))
    arm.run(60.0, lambda t: START @ make_transform(np.eye(3), slow[:3, 3] * t / 60.0))
    total = np.eye(4)
    assert len(arm.moves) >= 2
    for _, move in arm.moves:
        assert move.camera_new_T_camera_old is not None
        total = move.camera_new_T_camera_old @ total
    assert np.linalg.norm(total[:3, 3] + slow[:3, 3]) < 1.3


def test_a_holder_that_was_silent_and_is_elsewhere_gives_no_motion() -> None:
    arm = Arm()
    arm.run(1.0, lambda _: START)
    arm.silence(3.0)
    arm.run(1.0, lambda _: START @ MOVE)
    ((_, move),) = arm.moves
    assert move.camera_new_T_camera_old is None
    arm.run(1.0, lambda _: START @ MOVE)
    arm.run(1.0, lambda t: START @ MOVE @ inverse(START) @ on_the_way(t))
    arm.run(1.0, lambda _: START @ MOVE @ MOVE)
    assert len(arm.moves) == 2
    known = arm.moves[1][1].camera_new_T_camera_old
    assert known is not None
    assert np.allclose(known, np.linalg.inv(MOVE), atol=0.1)


def test_a_holder_that_falls_silent_on_the_way_ends_the_epoch_without_a_motion() -> None:
    arm = Arm()
    arm.run(1.0, lambda _: START)
    arm.run(0.5, on_the_way)
    arm.silence(3.0)
    ((t_s, move),) = arm.moves
    assert move.camera_new_T_camera_old is None
    assert t_s < 1.5 + 2.1
    assert not arm.moving[-1][1]


def test_silence_at_rest_is_no_move() -> None:
    arm = Arm()
    arm.run(1.0, lambda _: START)
    arm.silence(5.0)
    arm.run(2.0, lambda _: START)
    arm.run(1.0, on_the_way)
    arm.run(1.0, lambda _: START @ MOVE)
    ((_, move),) = arm.moves
    assert move.camera_new_T_camera_old is not None


@pytest.mark.parametrize("values", [{"sigma_mm": 0.0}, {"sigma_rad": math.nan}, {"least_mm": -1.0}])
def test_settings_that_cannot_be(values: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected a number > 0"):
        HolderSettings(**values)
