"""Stereo calibration against true cameras and against OpenCV's, and what it says of poor views."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from fgreg.calibration import parameters
from fgreg.calibration.bundle import Bundle, fit
from fgreg.calibration.check import CameraCheck, Validity, check
from fgreg.calibration.comparison import compare
from fgreg.calibration.quality import board_depths_mm, conditions, halves, not_determined
from fgreg.calibration.views import BoardView, CornerTable, spread_views
from fgreg.detection.calibration_start import place_boards, start
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.session_model import BoardModel
from fgreg.pipeline.calibrate_camera import Pictures, calibrate_camera
from fgreg.simulation.config import default_rig
from tests.calibration_views import BOARD, NOISE_PX, simulated_views, table_of

PLAIN = default_rig()
SIZE = PLAIN.left.image_size
assert PLAIN.right is not None
assert PLAIN.right_T_left is not None


def with_lenses(distortion: list[float], focal: float, fisheye: bool) -> StereoRig:
    """The default rig with other lenses."""
    lenses = []
    for camera in parameters.cameras(PLAIN):
        matrix = camera.matrix.copy()
        matrix[[0, 1], [0, 1]] *= focal
        lenses.append(CameraModel(SIZE, matrix, np.array(distortion), fisheye))
    return StereoRig(lenses[0], lenses[1], PLAIN.right_T_left)


RIGS = {
    "pinhole5": PLAIN,
    "pinhole8": with_lenses([0.5, -0.7, 0.0007, -0.0002, 0.3, 0.38, -0.5, 0.2], 0.9, False),
    "fisheye": with_lenses([0.05, -0.02, 0.004, -0.001], 0.7, True),
}


def calibrated(table: CornerTable, like: StereoRig = PLAIN) -> Bundle:
    return fit(table, *start(table, SIZE, len(like.left.distortion), like.left.fisheye))


@pytest.mark.parametrize("model", RIGS)
def test_true_cameras_lie_within_the_sigmas(model: str) -> None:
    rig, squares = RIGS[model], []
    for seed in range(4):
        bundle = calibrated(table_of(simulated_views(rig, seed, 15)), rig)
        assert bundle.sigma_px == pytest.approx(NOISE_PX, rel=0.05)
        _, by = parameters.constants(rig)
        off, spread = by @ parameters.difference(bundle.rig, rig), by @ bundle.covariance @ by.T
        assert (np.abs(off) < 3.5 * np.sqrt(np.diag(spread))).all()
        squares.append(off @ np.linalg.solve(spread, off))
    assert 24.0 < sum(squares) < 82.0  # chi square of 4 x 12 degrees of freedom, 99.8 %


def opencv_rig(table: CornerTable, size: tuple[int, int]) -> StereoRig:
    """Calibrated by OpenCV from the corners that both pictures have."""
    points: list[npt.NDArray[np.float32]] = []
    pixels: tuple[list[npt.NDArray[np.float32]], ...] = ([], [])
    for view in range(len(table.names)):
        sides = [table.subset((table.view == view) & (table.side == side)) for side in range(2)]
        keys = [np.round(one.board_p_mm @ [1.0, 1e3, 0.0]).astype(int) for one in sides]
        _, *common = np.intersect1d(keys[0], keys[1], return_indices=True)
        points.append(sides[0].board_p_mm[common[0]].astype(np.float32))
        for one, chosen, seen in zip(sides, common, pixels, strict=True):
            seen.append(one.pixels[chosen].astype(np.float32)[:, None])
    nothing: Any = None
    alone = [cv2.calibrateCamera(points, seen, size, nothing, nothing)[1:3] for seen in pixels]
    found = cv2.stereoCalibrate(
        points, pixels[0], pixels[1], *alone[0], *alone[1], size, flags=cv2.CALIB_USE_INTRINSIC_GUESS
    )
    _, left, left_lens, right, right_lens, turn, shift, *_ = (np.asarray(part, dtype=np.float64) for part in found)
    return StereoRig(
        CameraModel(size, left, left_lens.ravel()[:5]),
        CameraModel(size, right, right_lens.ravel()[:5]),
        make_transform(turn, shift.ravel()),
    )


def test_opencv_finds_the_same_cameras() -> None:
    table = table_of(simulated_views(PLAIN, 5, 12))
    bundle = calibrated(table)
    off = parameters.difference(bundle.rig, opencv_rig(table, SIZE))
    # The same corners but for those that only one picture has.
    assert (np.abs(off) < np.sqrt(np.diag(bundle.covariance))).all()


def test_opencvs_sample_pictures() -> None:
    """A plain board before two cameras of 640 x 480 px; OpenCV's own documentation calibrates from them."""
    folder = Path(os.environ.get("FGREG_OPENCV_SAMPLES", "/usr/share/doc/opencv-doc/examples/data"))
    if not (folder / "left01.jpg").is_file():
        pytest.skip(f"no {folder}/left01.jpg; set FGREG_OPENCV_SAMPLES to samples/data of OpenCV")
    pictures = Pictures(folder / "left[0-9]*.jpg", folder / "right[0-9]*.jpg")
    report = calibrate_camera(pictures, BoardModel(9, 6, 25.0), None)
    assert len(report.views.table.names) == 13
    assert report.bundle.sigma_px < 0.2
    theirs = opencv_rig(report.views.table, report.views.image_size)
    _, by = parameters.constants(report.rig)
    off = by @ parameters.difference(report.rig, theirs)
    assert (np.abs(off) < 2.0 * np.sqrt(np.diag(by @ report.covariance @ by.T))).all()


def test_strays_do_not_matter() -> None:
    table = table_of(simulated_views(PLAIN, 1, 12))
    wrong = table.pixels.copy()
    wrong[::25] += [3.0, -2.0]
    bundle = calibrated(replace(table, pixels=wrong))
    assert not bundle.used[::25].any()
    assert bundle.used.mean() > 0.95
    assert bundle.sigma_px == pytest.approx(NOISE_PX, rel=0.05)


def test_frontal_views_do_not_tell_the_focal_length() -> None:
    bundle = calibrated(table_of([BoardView(v.name, v.left) for v in simulated_views(PLAIN, 1, 15, tilt_deg=0.0)]))
    named = " ".join(not_determined(bundle.rig, bundle.covariance))
    assert "left.fx" in named
    assert "left.fy" in named
    assert "left.cx" not in named
    tilted = calibrated(table_of(simulated_views(PLAIN, 1, 15)))
    assert not_determined(tilted.rig, tilted.covariance) == []


def test_a_bent_board_shows_in_the_halves() -> None:
    table = table_of(simulated_views(PLAIN, 2, 20))
    flat = calibrated(table)
    both = halves(table, flat)
    assert both is not None
    assert both.factor == 1.0
    # A bow of 1 mm in every other view: the residuals stay well below a pixel, the halves disagree.
    bow = np.where(table.view % 2 == 1, 1.0 - ((table.board_p_mm[:, 0] - 36.0) / 36.0) ** 2, 0.0)
    bent = replace(table, pixels=table.pixels + bow[:, None] * [1.0, 0.3])
    bundle = calibrated(bent)
    both = halves(bent, bundle)
    assert both is not None
    assert both.factor > 2.0
    assert any("two halves" in line for line in conditions(bent, bundle, bundle.covariance, both, SIZE))


def moved_rig(focal: float = 0.0, centre_px: float = 0.0, turn_deg: float = 0.0) -> StereoRig:
    matrix = PLAIN.left.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1.0 + focal
    matrix[0, 2] += centre_px
    turn = make_transform(exp_so3(np.array([0.0, np.radians(turn_deg), 0.0])), np.zeros(3))
    assert PLAIN.right_T_left is not None
    return StereoRig(replace(PLAIN.left, matrix=matrix), PLAIN.right, PLAIN.right_T_left @ turn)


@cache
def calibration() -> tuple[Bundle, tuple[float, float, float]]:
    """Of 25 views of the default rig, and their depths."""
    table = table_of(simulated_views(PLAIN, 0, 25))
    bundle = calibrated(table)
    return bundle, board_depths_mm(table, bundle.left_T_board)


def checked(now: StereoRig, seed: int, count: int = 4) -> CameraCheck:
    before, depths = calibration()
    new = table_of(simulated_views(now, seed, count))
    placed = place_boards(new, before.rig)
    return check(new, before.rig, before.covariance, before.sigma_px, placed, depths, limit_mm=0.5)


def test_check_holds_where_nothing_has_changed() -> None:
    for seed in (50, 51, 52):
        assert checked(PLAIN, seed).validity is Validity.HOLDS


@pytest.mark.parametrize(
    ("change", "name", "size"),
    [
        ({"focal": 0.003}, "FOCAL_LEFT", 0.003),
        ({"centre_px": 2.0}, "CENTRE_LEFT_X", 2.0),
        ({"turn_deg": 0.1}, "STEREO_ROTATION_Y", np.radians(0.1)),
    ],
)
def test_check_says_what_has_changed_and_by_how_much(change: dict[str, float], name: str, size: float) -> None:
    found = checked(moved_rig(**change), 60)
    assert found.validity is Validity.CHANGED
    largest = max(found.changes, key=lambda one: abs(one.change / one.sigma))
    assert largest.constant.name == name
    assert abs(largest.change - size) < 3.0 * largest.sigma
    true = compare(PLAIN, moved_rig(**change), (85.0, 124.0, 153.0))
    assert found.apart.points_rms_mm == pytest.approx(true.points_rms_mm, rel=0.25)


def test_one_view_cannot_tell() -> None:
    assert checked(PLAIN, 70, count=1).validity is Validity.CANNOT_TELL


def test_calibrations_that_differ_by_a_motion_of_space_do_not_differ() -> None:
    assert compare(PLAIN, PLAIN, (100.0,)).points_most_mm < 1e-9
    # A baseline 1 % longer: points 1 % farther, so 1 % of their spread about the middle.
    assert PLAIN.right_T_left is not None
    longer = PLAIN.right_T_left.copy()
    longer[:3, 3] *= 1.01
    apart = compare(PLAIN, StereoRig(PLAIN.left, PLAIN.right, longer), (100.0,))
    assert 0.2 < apart.points_rms_mm < 0.8
    assert max(apart.rays_rms_px) < 1e-9


def test_views_that_are_most_unlike_are_chosen() -> None:
    views = simulated_views(PLAIN, 3, 6)
    again = [view for view in views for _ in range(5)]
    assert {view.name for view in spread_views(again, BOARD, 6)} == {view.name for view in views}
