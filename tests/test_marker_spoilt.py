"""Markers in pictures that are not clean: found by what is left of them, and with a covariance that holds."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fgreg.detection.corner_noise import pool_corner_noise
from fgreg.detection.marker import detect_marker
from fgreg.detection.results import MarkerFit, marker_covariance
from fgreg.detection.spoilt_tags import find_spoilt_tags
from fgreg.geometry.transforms import FloatArray, make_transform
from fgreg.model.session_model import MarkerModel, TagModel
from fgreg.simulation.disturbances import Disturbances
from fgreg.simulation.presets import PHANTOM
from fgreg.simulation.simulate import simulate
from fgreg.simulation.surfaces import PatchSurface
from tests.marker_scene import ONE_TAG, RIG, facing_pose, frames_of, left_pixels, pose_error, surfaces_of


def fits_of(disturbances: Disturbances, every: int = 1) -> list[tuple[FloatArray, MarkerFit]]:
    """True pose and detection of each shot of the preset phantom in which the marker is found.

    Args:
        every: take one in this many of the 19 pairs and tracks.
    """
    config = replace(PHANTOM, aims=0, disturbances=disturbances)
    session = simulate(config, 1)
    out = []
    for index, event in list(enumerate(session.events))[::every]:
        left, right = (session.frames[event["marker"][side]]() for side in ("left", "right"))
        fit = detect_marker(left, right, config.camera, config.marker)
        if isinstance(fit, MarkerFit):
            out.append((session.true_camera_T_marker[index], fit))
    return out


def nees(fits: list[tuple[FloatArray, MarkerFit]]) -> FloatArray:
    """Squared Mahalanobis error of each pose over its 6 dimensions."""
    noise = pool_corner_noise(fit.pose for _, fit in fits)
    errors = [pose_error(true, fit.camera_T_marker) for true, fit in fits]
    squares = [e @ np.linalg.solve(marker_covariance(f, noise), e) for e, (_, f) in zip(errors, fits, strict=True)]
    return np.array(squares) / 6.0


@pytest.mark.parametrize(
    "disturbances",
    [
        Disturbances(defocus_px=2.0),
        Disturbances(defocus_px=4.0),
        Disturbances(motion_px=3.0, motion_rad=0.4),
        Disturbances(motion_px=8.0, motion_rad=1.9),
        Disturbances(noise_gain=4.0),
        Disturbances(jpeg_quality=50),
        Disturbances(field_hz=50.0, hand_mm_s=20.0),
        Disturbances(smoke=0.5),
    ],
    ids=["defocus-2", "defocus-4", "motion-3", "motion-8", "noise", "jpeg", "interlaced", "smoke"],
)
def test_covariance_holds_where_the_whole_picture_is_worse(disturbances: Disturbances) -> None:
    fits = fits_of(disturbances, every=2)
    assert len(fits) == 10
    assert nees(fits).mean() < 2.0


@pytest.mark.parametrize(
    ("disturbances", "least"),
    [
        (Disturbances(specks=8), 9),
        (Disturbances(stains=2), 17),
        (Disturbances(glare=3), 17),
    ],
    ids=["specks-8", "stains-2", "glare"],
)
def test_tag_with_spots_is_found_with_a_covariance_that_holds(disturbances: Disturbances, least: int) -> None:
    fits = fits_of(disturbances)
    assert len(fits) >= least
    squares = nees(fits)
    assert squares.mean() < 2.0
    assert squares.max() < 5.0


def test_two_good_corners_in_each_view_give_the_pose() -> None:
    for true, fit in fits_of(Disturbances(stains=2)):
        error = pose_error(true, fit.camera_T_marker)
        assert np.degrees(np.linalg.norm(error[:3])) < 0.15
        assert np.linalg.norm(error[3:]) < 0.03


def test_a_covered_side_leaves_three_that_count() -> None:
    true = facing_pose((8.0, -4.0, 120.0), 25.0)
    hand = true @ make_transform(np.eye(3), np.array([0.0, 14.0, 1.0]))
    fit = detect_marker(*frames_of([*surfaces_of(ONE_TAG, true), PatchSurface(hand, 22.0, 6.0, 0.5)]), RIG, ONE_TAG)
    assert isinstance(fit, MarkerFit)
    assert fit.pose.dof == 6  # three sides in two views, two numbers each
    error = pose_error(true, fit.camera_T_marker)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.05
    assert np.linalg.norm(error[3:]) < 0.05


def test_outline_is_named_from_its_cells_as_printed() -> None:
    for roll_deg in (0.0, 100.0, 190.0, 280.0):
        true = facing_pose((5.0, 3.0, 120.0), 20.0, roll_deg=roll_deg)
        left, _ = frames_of(surfaces_of(ONE_TAG, true))
        (tag,) = find_spoilt_tags(left, ONE_TAG.dictionary, frozenset([0]))
        assert tag.id == 0
        expected = left_pixels(true, ONE_TAG.tags[0].marker_p_corners_mm)
        assert np.linalg.norm(tag.corners_px - expected, axis=1).max() < 2.0
        assert find_spoilt_tags(left, ONE_TAG.dictionary, frozenset([1])) == []


def test_nothing_is_found_where_there_is_no_tag() -> None:
    nothing = np.full((720, 1280), 90, dtype=np.uint8)
    assert find_spoilt_tags(nothing, "DICT_4X4_50", frozenset(range(50))) == []
    other = MarkerModel("DICT_5X5_100", (TagModel(3, 30.0),))
    left, _ = frames_of(surfaces_of(other, facing_pose((5.0, 3.0, 120.0), 20.0)))
    assert find_spoilt_tags(left, "DICT_4X4_50", frozenset(range(50))) == []


def test_clutter_of_rectangles_is_not_taken_for_a_tag() -> None:
    rng = np.random.default_rng(0)
    for _ in range(4):
        image = np.full((720, 1280), 90, dtype=np.uint8)
        for _ in range(60):
            centre, size = rng.uniform(0.0, 1.0, 2) * (1280, 720), rng.uniform(10.0, 150.0, 2)
            outline = cv2.boxPoints((tuple(centre), tuple(size), float(rng.uniform(0.0, 180.0))))
            cv2.fillPoly(image, [np.rint(outline).astype(np.int32)], int(rng.integers(0, 255)))
        assert find_spoilt_tags(image, "DICT_4X4_50", frozenset([0])) == []
