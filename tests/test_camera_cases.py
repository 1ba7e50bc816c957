"""Pictures and a calibration file that others made; skipped where they are not there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fgreg.detection.board import detect_board, find_board_corners
from fgreg.detection.corner_noise import CornerNoise
from fgreg.detection.corners import grey
from fgreg.detection.frame_files import Picture, read_picture
from fgreg.detection.marker import detect_marker
from fgreg.detection.results import MarkerFit, NotFound, marker_covariance
from fgreg.drivers.calibration_files import read_calibration
from fgreg.geometry.transforms import as_float_array
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.session_model import BoardModel, CharucoModel, SessionModel
from fgreg.session.session_reader import read_session
from tests.marker_scene import pose_error

HOME = Path(__file__).resolve().parents[1]
DATA = HOME.parent / "shared" / "cases" / "camera"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the pictures are not here")


@pytest.fixture(scope="module")
def model() -> SessionModel:
    return read_session(HOME / "sessions" / "phantom").model


def picture(path: Path) -> Picture:
    read = read_picture(path)
    assert read is not None
    return read


def found(model: SessionModel, left: Path, right: Path) -> MarkerFit:
    assert model.camera is not None
    assert model.marker is not None
    fit = detect_marker(picture(left), picture(right), model.camera, model.marker)
    assert isinstance(fit, MarkerFit), fit
    return fit


@pytest.mark.parametrize(("case", "shot"), [("drops", "pm-02"), ("glare", "pm-00")])
def test_spoilt_tag_has_the_pose_of_the_clean_one(model: SessionModel, case: str, shot: str) -> None:
    frames = HOME / "sessions" / "phantom" / "frames"
    clean = found(model, frames / f"{shot}-left.png", frames / f"{shot}-right.png")
    spoilt = found(model, DATA / f"{case}_left.png", DATA / f"{case}_right.png")
    error = pose_error(clean.camera_T_marker, spoilt.camera_T_marker)
    assert np.degrees(np.linalg.norm(error[:3])) < 0.15
    assert np.linalg.norm(error[3:]) < 0.03
    assert error @ np.linalg.solve(marker_covariance(spoilt, CornerNoise()), error) < 12.0


def test_12_bits_in_16_are_read_with_their_full_depth(model: SessionModel) -> None:
    deep = picture(DATA / "grey12in16.png")
    assert deep.dtype == np.uint16
    assert len(np.unique(grey(deep))) == len(np.unique(deep)) > 100
    assert model.camera is not None
    assert model.marker is not None
    assert isinstance(detect_marker(deep, None, model.camera, model.marker), MarkerFit)


def test_fisheye_file_is_read_as_fisheye() -> None:
    rig = read_calibration([DATA / "opencv_fisheye.yml"]).rig
    assert rig.left.fisheye
    assert rig.left.distortion.tolist() == [0.1, 0.05, 0.01, 0.02]


def test_legacy_board_is_found_or_hinted_at() -> None:
    image = grey(picture(DATA / "charuco_legacy_10x8.png"))
    boards = {legacy: BoardModel(9, 7, 10.0, CharucoModel("DICT_5X5_100", 7.0, legacy)) for legacy in (True, False)}
    found = find_board_corners(image, boards[True])
    assert found is not None
    assert found[1].tolist() == list(range(63))
    camera = CameraModel(
        (720, 600), as_float_array([[900, 0, 360], [0, 900, 300], [0, 0, 1]]), as_float_array(np.zeros(5))
    )
    fit = detect_board(image, None, StereoRig(camera), boards[False])
    assert isinstance(fit, NotFound)
    assert fit.reason.endswith("board.charuco.legacy: true")
