"""Real webcam frames of two many-tag bodies in a static scene; skipped where the data are not there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fgreg.detection.corner_noise import pool_corner_noise
from fgreg.detection.marker import detect_marker
from fgreg.detection.results import MarkerFit, NotFound, marker_covariance
from fgreg.geometry.transforms import as_float_array, log_so3, make_transform
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.session_model import MarkerModel, TagModel

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "bard_aruco"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the real frames are not here")


def bard_rig() -> StereoRig:
    matrix = np.loadtxt(DATA / "calibration_640x480" / "calib.intrinsics.txt")
    distortion = np.loadtxt(DATA / "calibration_640x480" / "calib.distortion.txt").ravel()
    return StereoRig(CameraModel((640, 480), as_float_array(matrix, 3, 3), as_float_array(distortion, 5)))


def bard_body(name: str) -> MarkerModel:
    # Each line: id, centre, then the corners from the top left; x right and y down, so the printed face looks along -z.
    lines = np.loadtxt(DATA / f"{name}.txt")
    face = np.diag([1.0, -1.0, -1.0])
    tags = tuple(TagModel(int(line[0]), 14.5, as_float_array(make_transform(face, line[1:4]), 4, 4)) for line in lines)
    for tag, line in zip(tags, lines, strict=True):
        assert np.abs(tag.marker_p_corners_mm.ravel() - line[4:]).max() < 1e-9
    return MarkerModel("DICT_ARUCO_ORIGINAL", tags)


@pytest.fixture(scope="module")
def frames() -> list[Any]:
    video = cv2.VideoCapture(str(DATA / "multipattern.avi"))
    out: list[Any] = []
    while True:
        ok, frame = video.read()
        if not ok:
            return out
        out.append(frame)


@pytest.mark.parametrize(("name", "least_tags"), [("reference", 10), ("pointer", 6)])
def test_body_found_in_every_frame_and_repeatable(frames: list[Any], name: str, least_tags: int) -> None:
    assert len(frames) == 10
    rig, body = bard_rig(), bard_body(name)
    fits: list[MarkerFit] = []
    for frame in frames:
        fit = detect_marker(frame, None, rig, body)
        assert isinstance(fit, MarkerFit), fit
        assert len(fit.tags) >= least_tags
        assert fit.pose.rms_px <= 1.4
        fits.append(fit)
    poses = np.array([fit.camera_T_marker for fit in fits])
    assert (poses[:, :3, 3].std(axis=0, ddof=1) < [0.8, 0.8, 1.3]).all()
    turns = log_so3(np.swapaxes(poses[:1, :3, :3], 1, 2) @ poses[:, :3, :3])
    assert (np.degrees(turns.std(axis=0, ddof=1)) < 0.4).all()
    noise = pool_corner_noise(fit.pose for fit in fits)
    sigma = np.sqrt(np.diag(marker_covariance(fits[0], noise)))
    assert (sigma[3:] > 0.05).all()
    assert (sigma[3:] < 3.0).all()


def test_single_small_tags_are_never_given_the_wrong_pose(frames: list[Any]) -> None:
    rig = bard_rig()
    ambiguous = 0
    for name in ("reference", "pointer"):
        body = bard_body(name)
        whole = detect_marker(frames[0], None, rig, body)
        assert isinstance(whole, MarkerFit)
        for tag in body.tags:
            alone = detect_marker(frames[0], None, rig, MarkerModel(body.dictionary, (tag,)))
            if isinstance(alone, NotFound):
                ambiguous += "ambiguous" in alone.reason
                continue
            turn = log_so3(whole.camera_T_marker[:3, :3].T @ alone.camera_T_marker[:3, :3])
            assert np.degrees(np.linalg.norm(turn)) < 10.0
    assert ambiguous >= 6
