"""Calibrations that users have: each kind written by other means, and read as the same camera model."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from fgreg.drivers.calibration_files import read_calibration
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.model.camera_model import StereoRig

# Left turned by asin(0.6) about z against the rectified frame, right not at all: figures one can check by hand.
CAMERA_INFO = """\
image_width: 640
image_height: 480
camera_name: {name}
camera_matrix:
  rows: 3
  cols: 3
  data: [800.0, 0.0, 320.5, 0.0, 810.0, 240.25, 0.0, 0.0, 1.0]
distortion_model: {model}
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.25, 0.125, 0.001, -0.002, {k3}]
rectification_matrix:
  rows: 3
  cols: 3
  data: {r}
projection_matrix:
  rows: 3
  cols: 4
  data: [700.0, 0.0, 300.0, {p3}, 0.0, 700.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0]
"""
TURNED = "[0.8, -0.6, 0.0, 0.6, 0.8, 0.0, 0.0, 0.0, 1.0]"
LEVEL = "[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]"


def info(
    folder: Path, name: str, *, r: str = LEVEL, p3: float = 0.0, model: str = "plumb_bob", k3: float = 0.5
) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(CAMERA_INFO.format(name=name, r=r, p3=p3, model=model, k3=k3), encoding="utf-8")
    return path


def transform_of(rig: StereoRig) -> FloatArray:
    assert rig.right_T_left is not None
    return rig.right_T_left


def storage(path: Path, **values: Any) -> Path:
    """A file as OpenCV itself writes it."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        file.write(key, value)
    file.release()
    return path


M1 = np.array([[800.0, 0, 320], [0, 400, 120], [0, 0, 1]])
M2 = np.array([[805.0, 0, 322], [0, 402, 121], [0, 0, 1]])
D1, D2 = np.array([[-0.3, 0.1, 0.001, 0.002, 0.05]]), np.array([[-0.31, 0.12, 0.0, 0.0]])
R = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
T = np.array([[-5.2], [0.1], [0.03]])


def test_ros_camera_info_with_hand_computed_numbers(tmp_path: Path) -> None:
    # P[0][3] = -700 px * 0.005 m. right_T_left: R_left (the right camera is level), 5 mm along -x.
    files = [info(tmp_path, "left", r=TURNED), info(tmp_path, "right", p3=-3.5)]
    rig = read_calibration(files).rig
    assert rig.left.image_size == (640, 480)
    np.testing.assert_array_equal(rig.left.matrix, [[800, 0, 320.5], [0, 810, 240.25], [0, 0, 1]])
    np.testing.assert_array_equal(rig.left.distortion, [-0.25, 0.125, 0.001, -0.002, 0.5])
    expected = as_float_array([[0.8, -0.6, 0, -5], [0.6, 0.8, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(transform_of(rig), expected, atol=1e-12)


def test_a_turned_right_camera_moves_the_baseline_into_its_axes(tmp_path: Path) -> None:
    # right_T_left = [R_right', R_right' b]: R' (-5, 0, 0) = (-4, 3, 0) where R is TURNED.
    files = [info(tmp_path, "left"), info(tmp_path, "right", r=TURNED, p3=-3.5)]
    expected = as_float_array([[0.8, 0.6, 0, -4], [-0.6, 0.8, 0, 3], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(transform_of(read_calibration(files).rig), expected, atol=1e-12)


def test_rectified_images_have_the_projection_matrix_no_distortion_and_parallel_cameras(tmp_path: Path) -> None:
    files = [info(tmp_path, "left", r=TURNED), info(tmp_path, "right", p3=-3.5)]
    rig = read_calibration(files, rectified=True).rig
    assert rig.right is not None
    np.testing.assert_array_equal(rig.left.matrix, [[700, 0, 300], [0, 700, 230], [0, 0, 1]])
    np.testing.assert_array_equal(rig.left.distortion, np.zeros(5))
    expected = as_float_array([[1, 0, 0, -5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(transform_of(rig), expected, atol=1e-12)


def test_an_echoed_camera_info_message_is_read_as_well(tmp_path: Path) -> None:
    k = [800.0, 0.0, 320.0, 0.0, 800.0, 240.0, 0.0, 0.0, 1.0]
    p = [800.0, 0.0, 320.0, 0.0, 0.0, 800.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    message: dict[str, Any] = {"header": {"frame_id": "left"}, "height": 480, "width": 640}
    message |= {"distortion_model": "plumb_bob", "d": [0.1, 0.0, 0.0, 0.0, 0.0], "k": k, "r": r, "p": p}
    message |= {"binning_x": 0, "binning_y": 0, "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0}}
    path = tmp_path / "left.yaml"
    path.write_text(yaml.safe_dump(message), encoding="utf-8")
    rig = read_calibration([path]).rig
    assert rig.right is None
    assert rig.left.distortion[0] == 0.1
    path.write_text(yaml.safe_dump(message | {"binning_x": 2}), encoding="utf-8")
    with pytest.raises(InputError, match=r"binning_x.*found 2, expected 0 or 1"):
        read_calibration([path])


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_opencv_files_of_every_kind_give_the_stereo_rig(tmp_path: Path, suffix: str) -> None:
    path = storage(tmp_path / f"s.{suffix}", M1=M1, D1=D1, M2=M2, D2=D2, R=R, T=T, image_width=640, image_height=240)
    rig = read_calibration([path]).rig
    assert rig.right is not None
    assert rig.right_T_left is not None
    assert rig.left.image_size == (640, 240)
    np.testing.assert_allclose(rig.left.matrix, M1)
    np.testing.assert_allclose(rig.right.distortion, [-0.31, 0.12, 0, 0, 0])
    # By OpenCV itself: a point of the left camera, seen by the right one.
    left_p = np.array([[3.0, -2.0, 60.0]])
    seen, _ = cv2.projectPoints(left_p, cv2.Rodrigues(R)[0], T, M2, D2)
    right_p = left_p @ rig.right_T_left[:3, :3].T + rig.right_T_left[:3, 3]
    again, _ = cv2.projectPoints(right_p, np.zeros(3), np.zeros(3), rig.right.matrix, rig.right.distortion)
    np.testing.assert_allclose(seen, again, atol=1e-9)


def test_plain_json_with_opencvs_names_is_the_same_rig_and_a_lens_is_never_left_out(tmp_path: Path) -> None:
    values = {"camera_matrix_left": M1, "distortion_coefficients_left": D1, "camera_matrix_right": M2}
    values |= {"distortion_coefficients_right": D2, "rotation_matrix": R, "translation_vector": T}
    values |= {"image_size": np.array([640, 240])}
    plain, stored = tmp_path / "s.json", storage(tmp_path / "s.yml", **values)
    plain.write_text(json.dumps({key: value.tolist() for key, value in values.items()}), encoding="utf-8")
    for path in (plain, stored):
        rig = read_calibration([path]).rig
        assert rig.right is not None
        np.testing.assert_allclose(rig.left.distortion, D1[0])
        np.testing.assert_allclose(rig.right.distortion, [*D2[0], 0.0])
        np.testing.assert_allclose(transform_of(rig)[:3, 3], T.ravel())
    storage(stored, camera_matrix_left=M1, lens_distortion_left=D1, camera_matrix_right=M2, R=R, T=T)
    with pytest.raises(InputError, match="found nothing, beside 'lens_distortion_left', expected D1, distCoeffs1"):
        read_calibration([stored], image_size=(640, 240))


def test_opencvs_own_stereo_sample_writes_intrinsics_and_extrinsics_without_a_size(tmp_path: Path) -> None:
    files = [storage(tmp_path / "intrinsics.yml", M1=M1, D1=D1, M2=M2, D2=D2), storage(tmp_path / "e.yml", R=R, T=T)]
    with pytest.raises(InputError, match="no size of the images"):
        read_calibration(files)
    rig = read_calibration(files, image_size=(640, 240)).rig
    assert rig.right_T_left is not None
    np.testing.assert_allclose(rig.right_T_left[:3, 3], T.ravel())


def test_opencv_projection_matrices_are_the_model_of_rectified_images(tmp_path: Path) -> None:
    p1 = np.array([[500.0, 0, 300, 0], [0, 500, 100, 0], [0, 0, 1, 0]])
    p2 = p1.copy()
    p2[0, 3] = -2500.0
    path = storage(tmp_path / "s.yml", M1=M1, D1=D1, M2=M2, D2=D2, R=R, T=T, P1=p1, P2=p2, image_size=(640, 240))
    rig = read_calibration([path], rectified=True).rig
    assert rig.right_T_left is not None
    np.testing.assert_allclose(rig.left.matrix, p1[:, :3])
    np.testing.assert_allclose(rig.right_T_left[:3, 3], [-5, 0, 0])


def kalibr() -> dict[str, Any]:
    camera = {
        "camera_model": "pinhole",
        "distortion_coeffs": [-0.2, 0.05, 0.0001, -0.0002],
        "distortion_model": "radtan",
        "intrinsics": [461.5, 460.25, 362.5, 246.5],
        "resolution": [752, 480],
        "rostopic": "/cam0/image_raw",
    }
    transform = [[0.0, -1.0, 0.0, -0.004], [1.0, 0.0, 0.0, 0.0005], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    return {"cam0": camera, "cam1": {**camera, "cam_overlaps": [0], "T_cn_cnm1": transform}}


def test_kalibr_camchain_in_metres(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump(kalibr()), encoding="utf-8")
    rig = read_calibration([path]).rig
    matrix = as_float_array([[461.5, 0, 362.5], [0, 460.25, 246.5], [0, 0, 1]])
    np.testing.assert_allclose(rig.left.matrix, matrix)
    np.testing.assert_allclose(rig.left.distortion, [-0.2, 0.05, 0.0001, -0.0002, 0])
    expected = as_float_array([[0, -1, 0, -4], [1, 0, 0, 0.5], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(transform_of(rig), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_model": "ds"}, "camera_model.*found 'ds', expected pinhole"),
        ({"camera_model": "omni"}, "camera_model.*found 'omni', expected pinhole"),
        ({"distortion_model": "fov"}, "distortion model 'fov', expected plumb_bob, radtan"),
        ({"intrinsics": [1.0, 2.0]}, "cam1.intrinsics.*expected a list of 4 numbers"),
        ({"T_cn_cnm1": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "cam1.T_cn_cnm1.*not rigid"),
        ({"resolution": [640, 480]}, "resolution.*two cameras of one size"),
    ],
)
def test_a_kalibr_file_that_cannot_be_used_says_why(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    chain = kalibr()
    chain["cam1"] |= change
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump(chain), encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_calibration([path])


def test_millimetres_read_as_metres_are_refused_until_the_unit_is_given(tmp_path: Path) -> None:
    files = [info(tmp_path, "left"), info(tmp_path, "right", p3=-3500.0)]
    with pytest.raises(InputError, match=r"cameras 5000 mm apart.*say so where lengths are in mm"):
        read_calibration(files)
    rig = read_calibration(files, unit="mm").rig
    assert rig.right_T_left is not None
    assert rig.right_T_left[0, 3] == pytest.approx(-5.0)
    path = storage(tmp_path / "s.yml", M1=M1, M2=M2, R=R, T=T / 1000.0, image_size=(640, 240))
    with pytest.raises(InputError, match=r"cameras 0\.005201 mm apart.*lengths are in m\b"):
        read_calibration([path])


def test_swapped_cameras_are_read_with_a_warning(tmp_path: Path) -> None:
    found = read_calibration([info(tmp_path, "left"), info(tmp_path, "right", p3=3.5)])
    assert "are the two swapped?" in found.warnings[0]


def test_monocular_info_as_the_right_camera_has_no_baseline(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"right\.yaml: found a projection matrix without a baseline"):
        read_calibration([info(tmp_path, "left"), info(tmp_path, "right")])


def test_lens_models_are_opencvs_and_others_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"left\.yaml: D: found the distortion model 'fov'"):
        read_calibration([info(tmp_path, "left", model="fov")])
    eight = np.array([[-0.3, 0.1, 0.0, 0.0, 0.05, 0.0, 0.0, 0.0]])
    path = storage(tmp_path / "c.yml", camera_matrix=M1, distortion_coefficients=eight, image_size=(640, 240))
    np.testing.assert_allclose(read_calibration([path]).rig.left.distortion, [-0.3, 0.1, 0, 0, 0.05])
    eight[0, 5] = 0.01
    storage(path, camera_matrix=M1, distortion_coefficients=eight, image_size=(640, 240))
    np.testing.assert_allclose(read_calibration([path]).rig.left.distortion, eight[0])
    tilted = np.array([[-0.3, 0.1, 0.0, 0.0, 0.05, 0, 0, 0, 0, 0, 0, 0, 0.01, 0.0]])
    storage(path, camera_matrix=M1, distortion_coefficients=tilted, image_size=(640, 240))
    with pytest.raises(InputError, match="14 coefficients, of OpenCV's model with a tilted sensor"):
        read_calibration([path])


def test_four_parameters_of_an_opencv_file_are_fisheye_only_where_it_says_so(tmp_path: Path) -> None:
    four = np.array([[0.1, 0.05, 0.01, 0.02]])
    path = storage(tmp_path / "f.yml", K1=M1, D1=four, K2=M2, D2=four, R=R, T=T, image_size=(640, 240))
    rig = read_calibration([path]).rig
    assert not rig.left.fisheye
    np.testing.assert_allclose(rig.left.distortion, [0.1, 0.05, 0.01, 0.02, 0.0])
    path.write_text(path.read_text() + "fisheye_model: 1\n")
    rig = read_calibration([path]).rig
    assert rig.right is not None
    assert rig.left.fisheye
    assert rig.right.fisheye
    np.testing.assert_allclose(rig.left.distortion, four[0])
    five = np.array([[0.1, 0.05, 0.01, 0.02, 0.0]])
    storage(path, K1=M1, D1=five, K2=M2, D2=five, R=R, T=T, image_size=(640, 240))
    path.write_text(path.read_text() + "fisheye_model: 1\n")
    with pytest.raises(InputError, match=r"D1: found 5 coefficients, expected 4, of a fisheye lens"):
        read_calibration([path])


def test_ros_models_by_name(tmp_path: Path) -> None:
    path = tmp_path / "left.yaml"
    for model, numbers, fisheye in (
        ("equidistant", [0.1, 0.05, 0.01, 0.02], True),
        ("rational_polynomial", [0.5, -2.7, 0.0007, -0.0002, 1.6, 0.38, -2.5, 1.5], False),
        ("rational_polynomial", [0.1] * 12, False),
    ):
        text = CAMERA_INFO.format(name="left", r=LEVEL, p3=0.0, model=model, k3="K3")
        path.write_text(text.replace("[-0.25, 0.125, 0.001, -0.002, K3]", str(numbers)), encoding="utf-8")
        left = read_calibration([path]).rig.left
        assert left.fisheye is fisheye
        assert left.distortion.tolist() == numbers


def test_kalibrs_equidistant_model_is_fisheye(tmp_path: Path) -> None:
    chain = kalibr()
    chain["cam1"] |= {"distortion_model": "equidistant", "distortion_coeffs": [0.1, 0.05, 0.01, 0.02]}
    path = tmp_path / "camchain.yaml"
    path.write_text(yaml.safe_dump(chain), encoding="utf-8")
    rig = read_calibration([path]).rig
    assert rig.right is not None
    assert rig.right.fisheye
    assert not rig.left.fisheye


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected"),
        ("image_width: 640\n", "no camera_matrix, K or cam0"),
        ("%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 3\n  cols: [", "OpenCV cannot read"),
        (
            "%YAML:1.0\n---\nimage_width: 3\nimage_height: 4\nfoo: 1\n",
            "found nothing, expected 9 numbers called camera_m",
        ),
        ("<?xml version='1.0'?>\n<opencv_storage>\n<M1 type_id='opencv-matrix'>", "OpenCV cannot read"),
        ("\0\1\2", "expected"),
    ],
)
def test_a_file_that_is_no_calibration_is_one_clear_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "c.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=message) as caught:
        read_calibration([path])
    assert str(caught.value).startswith("c.yaml")
    assert str(caught.value).isprintable()
