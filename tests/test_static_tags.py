"""Static tags: the camera's motion against them, false alarms without a move, tags that move by themselves."""

from __future__ import annotations

import math

import numpy as np

from fgreg.camera_moves.static_tags import (
    TagFrame,
    TagMoveDetector,
    TagPose,
    TagSettings,
    average_tags,
    detect_tag_move,
    detector_from,
    tag_motion,
)
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, log_so3, make_transform

SIGMA = np.array([0.01, 0.01, 0.01, 0.1, 0.1, 0.8])
COVARIANCE = np.diag(SIGMA**2)
SETTINGS = TagSettings()


def _tags(rng: np.random.Generator, count: int = 3) -> dict[int, FloatArray]:
    return {
        i: make_transform(exp_so3(rng.uniform(-0.4, 0.4, 3)), np.array([*rng.uniform(-35.0, 35.0, 2), 110.0]))
        for i in range(count)
    }


def _frame(rng: np.random.Generator, tags: dict[int, FloatArray]) -> TagFrame:
    """Every tag with noise of its own, right tangent, rotation and translation apart."""
    seen = {}
    for tag, pose in tags.items():
        noise = rng.normal(size=6) * SIGMA
        seen[tag] = pose @ make_transform(exp_so3(noise[:3]), noise[3:])
    return TagFrame(seen, dict.fromkeys(tags, COVARIANCE))


def _motion() -> FloatArray:
    return make_transform(exp_so3(np.array([0.03, -0.02, 0.01])), np.array([3.0, -1.0, 2.0]))


def _moved(tags: dict[int, FloatArray], motion: FloatArray) -> dict[int, FloatArray]:
    return {tag: motion @ pose for tag, pose in tags.items()}


def _exact(tags: dict[int, FloatArray]) -> dict[int, TagPose]:
    return {tag: TagPose(pose, COVARIANCE, 1) for tag, pose in tags.items()}


def test_the_motion_of_exact_tags_is_recovered() -> None:
    tags = _tags(np.random.default_rng(1))
    found = tag_motion(_exact(tags), _exact(_moved(tags, _motion())))
    assert found is not None
    np.testing.assert_allclose(found.camera_new_T_camera_old, _motion(), atol=1e-9)
    assert found.tags == (0, 1, 2)
    assert found.apart == ()


def test_the_motions_covariance_covers_its_errors() -> None:
    rng = np.random.default_rng(2)
    tags, nees = _tags(rng), []
    for _ in range(150):
        old = average_tags([_frame(rng, tags)], 0.0)
        new = average_tags([_frame(rng, _moved(tags, _motion()))], 0.0)
        found = tag_motion(old, new)
        if found is None or found.apart:
            continue
        error = inverse(found.camera_new_T_camera_old) @ _motion()
        step = np.concatenate([log_so3(error[:3, :3]), error[:3, 3]])
        nees.append(step @ np.linalg.solve(found.covariance, step))
    assert len(nees) > 140
    assert 5.2 < np.mean(nees) < 6.8


def test_a_bumped_tag_is_set_apart_and_does_not_pass_for_a_moved_camera() -> None:
    tags = _tags(np.random.default_rng(3))
    bumped = tags | {1: tags[1] @ make_transform(np.eye(3), np.array([4.0, 0.0, 0.0]))}
    found = tag_motion(_exact(tags), _exact(bumped))
    assert found is not None
    assert found.apart == (1,)
    np.testing.assert_allclose(found.camera_new_T_camera_old, np.eye(4), atol=1e-9)


def test_two_tags_that_contradict_each_other_give_no_evidence() -> None:
    tags = _tags(np.random.default_rng(4), 2)
    bumped = tags | {1: tags[1] @ make_transform(np.eye(3), np.array([6.0, 0.0, 0.0]))}
    assert tag_motion(_exact(tags), _exact(bumped)) is None


def test_no_tag_in_common_gives_no_evidence() -> None:
    tags = _exact(_tags(np.random.default_rng(4), 2))
    assert tag_motion({0: tags[0]}, {1: tags[1]}) is None


def test_averaging_leaves_the_share_of_variance_that_stays() -> None:
    rng = np.random.default_rng(5)
    frames = [_frame(rng, _tags(np.random.default_rng(5))) for _ in range(20)]
    mean = average_tags(frames, 0.2)[0]
    np.testing.assert_allclose(mean.covariance, COVARIANCE * (0.2 + 0.8 / mean.frames))


def test_one_misread_frame_does_not_spoil_the_average() -> None:
    rng = np.random.default_rng(6)
    tags = _tags(rng, 1)
    flipped = TagFrame({0: tags[0] @ make_transform(exp_so3(np.array([0.8, 0.0, 0.0])), np.zeros(3))}, {0: COVARIANCE})
    frames = [flipped, *(_frame(rng, tags) for _ in range(9))]
    mean = average_tags(frames, 0.0)[0]
    assert mean.frames == 9
    assert np.linalg.norm(log_so3(tags[0][:3, :3].T @ mean.camera_T_tag[:3, :3])) < 0.02


def test_a_shift_is_found_within_ten_frames_and_its_frames_start_the_new_reference() -> None:
    rng = np.random.default_rng(7)
    tags, detector = _tags(rng), TagMoveDetector()
    for _ in range(60):
        detector, check = detect_tag_move(detector, _frame(rng, tags), SETTINGS)
        assert not check.alarm
    moved = _moved(tags, make_transform(np.eye(3), np.array([2.0, 0.0, 0.0])))
    count = 0
    while not check.alarm and count < 10:
        detector, check = detect_tag_move(detector, _frame(rng, moved), SETTINGS)
        count += 1
    assert check.alarm
    assert check.motion is not None
    detector = detector_from(detector.recent[-min(count, check.frames) :], SETTINGS)
    for _ in range(40):
        detector, check = detect_tag_move(detector, _frame(rng, moved), SETTINGS)
        assert not check.alarm


def test_a_slow_creep_is_found_against_the_epochs_start() -> None:
    rng = np.random.default_rng(8)
    tags, detector, alarm = _tags(rng), TagMoveDetector(), False
    for count in range(300):
        creep = make_transform(np.eye(3), np.array([0.02 * max(count - 60, 0), 0.0, 0.0]))
        detector, check = detect_tag_move(detector, _frame(rng, _moved(tags, creep)), SETTINGS)
        alarm = alarm or check.alarm
    assert alarm


def test_the_threshold_is_the_chi_square_of_its_probability() -> None:
    assert math.isclose(TagSettings(p=1e-5).threshold, 33.107, abs_tol=0.01)
