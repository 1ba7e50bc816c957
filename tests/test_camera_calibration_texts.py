"""Calibrations of ost.txt, scikit-surgery and MATLAB: hand-known numbers, and what each convention means to OpenCV."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from fgreg.drivers.calibration_files import read_calibration
from fgreg.errors import InputError
from fgreg.geometry.transforms import as_float_array, transform_points
from tests.test_camera_calibrations import transform_of

OST = """\
# oST version 5.0 parameters


[image]

width
640

height
480

[narrow_stereo/{side}]

camera matrix
800.000000 0.000000 320.500000
0.000000 810.000000 240.250000
0.000000 0.000000 1.000000

distortion
{d}

rectification
{r}
0.000000 0.000000 1.000000

projection
700.000000 0.000000 300.000000 {p3}
0.000000 700.000000 230.000000 0.000000
0.000000 0.000000 1.000000 0.000000

"""
FIVE = "-0.250000 0.125000 0.001000 -0.002000 0.500000"
LEVEL, TURNED = "1.0 0.0 0.0\n0.0 1.0 0.0", "0.8 -0.6 0.0\n0.6 0.8 0.0"
LEFT, RIGHT = OST.format(side="left", d=FIVE, r=TURNED, p3="0.0"), OST.format(side="right", d=FIVE, r=LEVEL, p3="-3.5")
EIGHT = "0.5 -2.7 0.0007 -0.0002 1.6 0.38 -2.5 1.5"


def text(path: Path, content: str) -> Path:
    path.write_text(content, encoding="utf-8")
    return path


@pytest.mark.parametrize("order", ["two files", "left first", "right first"])
def test_ost_txt_of_two_cameras(tmp_path: Path, order: str) -> None:
    if order == "two files":
        files = [text(tmp_path / "left.txt", LEFT), text(tmp_path / "right.txt", RIGHT)]
    else:
        files = [text(tmp_path / "ost.txt", LEFT + RIGHT if order == "left first" else RIGHT + LEFT)]
    rig = read_calibration(files).rig
    assert rig.left.image_size == (640, 480)
    np.testing.assert_array_equal(rig.left.matrix, [[800, 0, 320.5], [0, 810, 240.25], [0, 0, 1]])
    np.testing.assert_array_equal(rig.left.distortion, [-0.25, 0.125, 0.001, -0.002, 0.5])
    # P[0][3] = -700 px * 0.005 m; R_left is the turn, the right camera is level.
    expected = as_float_array([[0.8, -0.6, 0, -5], [0.6, 0.8, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(transform_of(rig), expected, atol=1e-9)
    rectified = read_calibration(files, rectified=True).rig
    assert rectified.left.matrix[0].tolist() == [700, 0, 300]


def test_ost_txt_of_one_camera_with_the_rational_model_or_a_doubtful_one(tmp_path: Path) -> None:
    path = text(tmp_path / "ost.txt", "; of ROS 1\n" + OST.format(side="left", d=EIGHT, r=LEVEL, p3="0.0"))
    rig = read_calibration([path]).rig
    assert rig.right is None
    assert rig.left.distortion.tolist() == [float(value) for value in EIGHT.split()]
    text(path, OST.format(side="left", d="0.1 0.05 0.01 0.02", r=LEVEL, p3="0.0"))
    with pytest.raises(InputError, match=r"4 coefficients without the name of their model.*ost\.yaml"):
        read_calibration([path])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("height\n480\n", "", r"\[narrow_stereo/left\]: height: found nothing"),
        ("800.000000 0.000000", "800.0 x", "line 15: found 'x', expected a number"),
        ("640", "640.5", "whole numbers"),
        ("800.000000", "1e300", r"line 15: found a number that is not finite or beyond"),
        ("projection", "projektion", "line 27: found 'projektion', expected one of width"),
        ("distortion\n", "distortion\n" + "1 2 3 4 5 6 7 8 9 10 11 12\n" * 2, "line 21: found"),
        ("distortion\n", "width\n1\n", "line 19: found a second width"),
    ],
)
def test_a_damaged_ost_txt_says_where(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = text(tmp_path / "ost.txt", LEFT.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_calibration([path])


def scikit_surgery(folder: Path, prefix: str) -> Path:
    """As its own writer does: numpy.savetxt with 8 decimals."""
    for side, shift in (("left", 0.0), ("right", 3.0)):
        matrix = np.array([[1740.0 + shift, 0, 913.5], [0, 1741.0, 449.25], [0, 0, 1.0]])
        np.savetxt(folder / f"{prefix}.{side}.intrinsics.txt", matrix, fmt="%.8f")
        np.savetxt(folder / f"{prefix}.{side}.distortion.txt", np.array([[-0.1, 0.2, 0.001, -0.002, 0.0]]), fmt="%.8f")
    l2r = np.eye(4)
    l2r[:3, :3] = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
    l2r[:3, 3] = [-4.5, 0.1, -0.2]
    np.savetxt(folder / f"{prefix}.l2r.txt", l2r, fmt="%.8f")
    return folder / f"{prefix}.l2r.txt"


def test_scikit_surgerys_files_of_two_cameras_or_one(tmp_path: Path) -> None:
    path = scikit_surgery(tmp_path, "calib")
    with pytest.raises(InputError, match=r"calib\.l2r\.txt: found no size of the images.*--calibration-size"):
        read_calibration([path])
    rig = read_calibration([path], image_size=(1920, 1080)).rig
    assert rig.right is not None
    assert rig.left.image_size == (1920, 1080)
    assert rig.right.matrix[0].tolist() == [1743.0, 0.0, 913.5]
    assert rig.left.distortion.tolist() == [-0.1, 0.2, 0.001, -0.002, 0.0]
    np.testing.assert_allclose(transform_of(rig)[:3, 3], [-4.5, 0.1, -0.2])
    np.testing.assert_allclose(transform_of(rig)[:3, :3], cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0], atol=1e-7)
    one = read_calibration([tmp_path / "calib.right.intrinsics.txt"], image_size=(1920, 1080)).rig
    assert one.right is None
    assert one.left.matrix[0, 0] == 1743.0
    (tmp_path / "calib.right.distortion.txt").unlink()
    with pytest.raises(InputError, match=r"calib\.right\.distortion\.txt: found nothing"):
        read_calibration([path], image_size=(1920, 1080))


ROTATION = cv2.Rodrigues(np.array([0.01, -0.02, 0.3]))[0]  # of OpenCV: right_p = R left_p + t


def matlab() -> dict[str, Any]:
    """toStruct(stereoParams) through jsonencode: rows first, principal points from 1, everything transposed."""
    camera = {
        "RadialDistortion": [-0.3, 0.1, 0.05],
        "TangentialDistortion": [0.001, -0.002],
        "ImageSize": [480, 640],
        "WorldPoints": [[0, 0], [0, 10]],
        "WorldUnits": "mm",
        "EstimateSkew": False,
        "NumRadialDistortionCoefficients": 3,
        "EstimateTangentialDistortion": True,
        "TranslationVectors": [[1, 2, 3]],
        "ReprojectionErrors": [],
        "RotationVectors": [[0, 0, 0]],
        "IntrinsicMatrix": [[800, 0, 0], [0, 810, 0], [321.5, 241.25, 1]],
        "Version": {"Name": "MATLAB", "Version": "9.12", "Release": "(R2022a)", "Date": "06-Jul-2022"},
    }
    right = camera | {"IntrinsicMatrix": [[805, 0, 0], [0, 815, 0], [330, 240, 1]], "RadialDistortion": [-0.31, 0.12]}
    return {
        "CameraParameters1": camera,
        "CameraParameters2": right,
        "RotationOfCamera2": ROTATION.T.tolist(),
        "TranslationOfCamera2": [-5.0, 0.1, 0.2],
        "Version": camera["Version"],
        "RectificationParams": {"Initialized": False},
    }


def written(folder: Path, content: dict[str, Any]) -> Path:
    return text(folder / "stereo.json", json.dumps(content, separators=(",", ":")))


def test_matlabs_struct_becomes_opencvs_convention(tmp_path: Path) -> None:
    read = read_calibration([written(tmp_path, matlab())])
    rig = read.rig
    assert rig.right is not None
    assert rig.left.image_size == (640, 480)
    np.testing.assert_allclose(rig.left.matrix, as_float_array([[800, 0, 320.5], [0, 810, 240.25], [0, 0, 1]]))
    np.testing.assert_allclose(rig.right.matrix, as_float_array([[805, 0, 329], [0, 815, 239], [0, 0, 1]]))
    assert rig.left.distortion.tolist() == [-0.3, 0.1, 0.001, -0.002, 0.05]
    assert rig.right.distortion.tolist() == [-0.31, 0.12, 0.001, -0.002, 0.0]
    # As MATLAB computes it, with rows: [X2 Y2 Z2] = [X1 Y1 Z1] * RotationOfCamera2 + TranslationOfCamera2.
    row = np.array([3.0, -2.0, 60.0])
    right_p = row @ np.array(matlab()["RotationOfCamera2"]) + np.array([-5.0, 0.1, 0.2])
    np.testing.assert_allclose(transform_points(transform_of(rig), row), right_p, atol=1e-9)


def test_a_mat_file_of_the_struct_is_the_rig_of_its_json(tmp_path: Path) -> None:
    expected = read_calibration([written(tmp_path, matlab())]).rig
    savemat(tmp_path / "s.mat", {"stereoParams": matlab()}, do_compression=True)
    rig = read_calibration([tmp_path / "s.mat"]).rig
    assert rig.right is not None
    assert expected.right is not None
    np.testing.assert_array_equal(rig.left.matrix, expected.left.matrix)
    np.testing.assert_array_equal(rig.right.distortion, expected.right.distortion)
    np.testing.assert_allclose(transform_of(rig), transform_of(expected), atol=1e-15)


def test_matlabs_newer_structs_say_the_same(tmp_path: Path) -> None:
    old = read_calibration([written(tmp_path, matlab())]).rig
    new = matlab()
    for key in ("CameraParameters1", "CameraParameters2"):
        matrix = np.array(new[key].pop("IntrinsicMatrix")).T.tolist()
        names = ("RadialDistortion", "TangentialDistortion", "ImageSize")
        new[key]["Intrinsics"] = {"K": matrix} | {name: new[key].pop(name) for name in names}
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.array(new.pop("RotationOfCamera2")).T, new.pop("TranslationOfCamera2")
    new["PoseCamera2"] = {"Dimensionality": 3, "A": pose.tolist()}
    rig = read_calibration([written(tmp_path, {"stereoParams": new})]).rig
    np.testing.assert_allclose(rig.left.matrix, old.left.matrix)
    np.testing.assert_array_equal(rig.left.distortion, old.left.distortion)
    np.testing.assert_allclose(transform_of(rig), transform_of(old), atol=1e-9)
    opencv = {
        "intrinsicMatrix1": old.left.matrix.tolist(),
        "distortionCoefficients1": old.left.distortion.tolist(),
        "intrinsicMatrix2": old.left.matrix.tolist(),
        "distortionCoefficients2": old.left.distortion.tolist(),
        "rotationOfCamera2": ROTATION.tolist(),
        "translationOfCamera2": [-5.0, 0.1, 0.2],
        "imageSize": [480, 640],
    }
    rig = read_calibration([written(tmp_path, opencv)]).rig
    np.testing.assert_allclose(rig.left.matrix, old.left.matrix)
    np.testing.assert_allclose(transform_of(rig), transform_of(old), atol=1e-9)


def test_matlabs_units_sizes_and_one_camera(tmp_path: Path) -> None:
    content = matlab()
    content["CameraParameters1"]["WorldUnits"] = "m"
    content["TranslationOfCamera2"] = [-0.005, 0.0001, 0.0002]
    for camera in (content["CameraParameters1"], content["CameraParameters2"]):
        camera["ImageSize"] = []
    path = written(tmp_path, content)
    with pytest.raises(InputError, match=r"CameraParameters1\.ImageSize: found no size of the images"):
        read_calibration([path])
    rig = read_calibration([path], image_size=(640, 480)).rig
    np.testing.assert_allclose(transform_of(rig)[:3, 3], [-5.0, 0.1, 0.2])
    one = read_calibration([written(tmp_path, matlab()["CameraParameters2"])], image_size=(640, 480)).rig
    assert one.right is None
    np.testing.assert_allclose(one.left.matrix[:2, 2], [329, 239])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"IntrinsicMatrix": [[800, 0, 0], [2, 810, 0], [321.5, 241.25, 1]]}, "IntrinsicMatrix: found another matrix"),
        ({"RadialDistortion": [1e300, 0]}, r"RadialDistortion.*found 1e\+300, expected a finite number"),
        ({"RadialDistortion": [1e6, 0]}, r"IntrinsicMatrix: found a lens with a coefficient of 1e\+06, expected"),
        ({"IntrinsicMatrix": [[1e6, 0, 0], [0, 1, 0], [1, 1, 1]]}, r"IntrinsicMatrix: found an entry of 1e\+06 px"),
        ({"RadialDistortion": [0.1]}, "found 1 radial and 2 tangential coefficients"),
        ({"MappingCoefficients": [800, 0, 0, 0]}, r"CameraParameters1.*found MATLAB's fisheye model \(Scaramuzza's\)"),
        ({"ImageSize": [240, 640]}, r"CameraParameters2\.ImageSize: found another one"),
        ({"WorldUnits": "feet"}, "WorldUnits: found 'feet', expected mm"),
    ],
)
def test_a_matlab_struct_that_cannot_be_used_says_why(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    content = matlab()
    content["CameraParameters1"] |= change
    with pytest.raises(InputError, match=message):
        read_calibration([written(tmp_path, content)])


def test_what_is_given_besides_has_to_agree_and_kinds_are_not_mixed(tmp_path: Path) -> None:
    path = written(tmp_path, matlab())
    with pytest.raises(InputError, match="images of 640 x 480 px, expected 1280 x 720 px"):
        read_calibration([path], image_size=(1280, 720))
    with pytest.raises(InputError, match="found a MATLAB struct, expected a calibration with projection matrices"):
        read_calibration([path], rectified=True)
    with pytest.raises(InputError, match="a second file, expected a MATLAB struct alone"):
        read_calibration([path, path])
    with pytest.raises(InputError, match=r"found an ost\.txt beside a MATLAB struct"):
        read_calibration([path, text(tmp_path / "ost.txt", LEFT)])
    for start in (b"MATLAB 5.0 MAT-file, Platform: GLNXA64", b"\x89HDF\r\n\x1a\n"):
        (tmp_path / "a.mat").write_bytes(start)
        with pytest.raises(InputError, match=r"a\.mat: found something that scipy cannot .*, or the struct as JSON"):
            read_calibration([tmp_path / "a.mat"])
