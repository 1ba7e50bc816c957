"""How poses depend on the camera's constants and the prints: against poses from corners that another rig sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from fgreg.detection.body_pose import choose_pose
from fgreg.detection.pose_least_squares import CornerSet
from fgreg.detection.results import RigidFit
from fgreg.geometry.rig import CAMERA, Constant
from fgreg.geometry.transforms import FloatArray, exp_so3, log_so3, make_transform
from fgreg.model.camera_dependence import (
    CONSTANTS,
    column,
    corner_dependence,
    nominal_pose_dependence,
    nominal_pose_gain,
    nominal_spot_gain,
    plausible_share,
)
from fgreg.model.camera_model import StereoRig
from fgreg.model.lens import focal_px, ideal_by_lens, ideal_from_pixels, pixel_by_ideal_jacobian, pixels_from_normalized
from fgreg.model.session_model import BoardModel, SessionModel
from fgreg.model.systematic import CAREFUL_LAB, Systematic
from tests.forward import make_session
from tests.lens_models import LENSES
from tests.marker_scene import ONE_TAG, RIG, RIGHT_T_LEFT, facing_pose

POSE = facing_pose((12.0, -8.0, 110.0), 25.0)
BOARD_P = np.column_stack([np.tile(np.arange(9.0), 6), np.repeat(np.arange(6.0), 9), np.zeros(54)]) * 9.0
BOARD_POSE = make_transform(exp_so3(np.array([0.3, -0.2, 0.1])), np.array([-40.0, -25.0, 140.0]))
SIGMAS = Systematic().sigmas(0.005, 0.0)[CAMERA]
MEASURED = [Constant(k) for k in range(Constant.CAMERA_SCALE, Constant.VIEW_BIAS)]
"""Constants that change what the cameras see."""


def off_by(constant: Constant, sigmas: float = 1.0) -> FloatArray:
    """Constants (19,) of which one is off by a number of its default sigmas."""
    c = np.zeros(CONSTANTS)
    c[column(constant)] = sigmas * SIGMAS[column(constant)]
    return c


def seen(body_p: FloatArray, camera_T_body: FloatArray, c: FloatArray, size: Constant, rig: StereoRig) -> CornerSet:
    """Corners that a rig off by c sees, in the ideal pixels of the declared one."""

    def get(constant: Constant, count: int = 1) -> FloatArray:
        return c[column(constant) : column(constant) + count]

    assert rig.right is not None
    assert rig.right_T_left is not None
    p = (1.0 + get(size)) * body_p @ camera_T_body[:3, :3].T + camera_T_body[:3, 3]
    right_T_left = rig.right_T_left.copy()
    right_T_left[:3, 3] *= 1.0 + get(Constant.CAMERA_SCALE)
    right_T_left = right_T_left @ make_transform(
        exp_so3(get(Constant.STEREO_ROTATION_X, 3)), get(Constant.STEREO_TRANSLATION_X, 3)
    )
    n = len(body_p)
    ideal: list[FloatArray] = []
    lens: list[FloatArray] = []
    focal: list[FloatArray] = []
    noise: list[FloatArray] = []
    for camera, view_T_camera, first, centre in (
        (rig.left, np.eye(4), Constant.FOCAL_LEFT, Constant.CENTRE_LEFT_X),
        (rig.right, right_T_left, Constant.FOCAL_RIGHT, Constant.CENTRE_RIGHT_X),
    ):
        q = p @ view_T_camera[:3, :3].T + view_T_camera[:3, 3]
        matrix = camera.matrix.copy()
        matrix[:2, :2] *= 1.0 + get(first)
        matrix[:2, 2] += get(centre, 2)
        pixels = pixels_from_normalized(replace(camera, matrix=matrix), q[:, :2] / q[:, 2:])
        ideal.append(ideal_from_pixels(camera, pixels))
        inverse = np.linalg.inv(pixel_by_ideal_jacobian(camera, ideal[-1]))
        noise.append(np.asarray(0.02**2 * inverse @ np.swapaxes(inverse, 1, 2)))  # the same in pixels
        lens.append(ideal_by_lens(camera, ideal[-1]))
        focal.append(np.tile(focal_px(camera), (n, 1)))
    view = np.repeat([0, 1], n)
    return CornerSet(
        body_p_mm=np.tile(body_p, (2, 1)),
        ideal_px=np.concatenate(ideal),
        view=view,
        group=view,
        covariance=block_diag(*np.concatenate(noise)),
        common_px=np.zeros(2 * n),
        outward_px=np.zeros((2 * n, 2)),
        focal_px=np.concatenate(focal),
        view_T_camera=np.repeat(np.stack([np.eye(4), rig.right_T_left]), n, axis=0),
        by_lens=np.concatenate(lens),
    )


def detected(
    c: FloatArray,
    size: Constant,
    noise_px: float = 0.0,
    seed: int = 0,
    rig: StereoRig = RIG,
    tag_pose: FloatArray = POSE,
) -> RigidFit:
    """The pose that the declared rig gives for corners that a rig off by c sees."""
    tag = size is Constant.TAG_SIZE
    body, pose = (ONE_TAG.tags[0].marker_p_corners_mm, tag_pose) if tag else (BOARD_P, BOARD_POSE)
    corners = seen(body, pose, c, size, rig)
    noise = noise_px * np.random.default_rng(seed).normal(size=corners.ideal_px.shape)
    fit = choose_pose(replace(corners, ideal_px=corners.ideal_px + noise), "body", [], size)
    assert isinstance(fit, RigidFit)
    return fit


def twist(moved: FloatArray, pose: FloatArray) -> FloatArray:
    """(6,) that moves ``pose`` to ``moved``, along the camera's axes about the body's origin."""
    return np.concatenate([log_so3(moved[:3, :3] @ pose[:3, :3].T), moved[:3, 3] - pose[:3, 3]])


@pytest.mark.parametrize("constant", MEASURED, ids=lambda constant: constant.name.lower())
def test_the_gain_brings_a_pose_back_to_the_true_one(constant: Constant) -> None:
    size = Constant.BOARD_SIZE if constant is Constant.BOARD_SIZE else Constant.TAG_SIZE
    c = off_by(constant)
    fit = detected(c, size)
    true = POSE if size is Constant.TAG_SIZE else BOARD_POSE
    shift = twist(true, fit.camera_T_body)
    found = fit.dependence.gain @ c
    scale = np.array([0.01] * 3 + [1.0] * 3)
    assert np.linalg.norm((shift - found) / scale) < 0.03 * np.linalg.norm(shift / scale) + 2e-5


@pytest.mark.parametrize("name", LENSES)
def test_gains_hold_with_every_lens_model_far_from_the_axis(name: str) -> None:
    rig = StereoRig(LENSES[name], LENSES[name], RIGHT_T_LEFT)
    pose = facing_pose((40.0, -22.0, 60.0), 25.0)  # 37 deg from the axis
    nominal = nominal_pose_gain(replace(session(), camera=rig), pose)
    scale = np.array([0.01] * 3 + [1.0] * 3)
    for constant in MEASURED:
        if constant is Constant.BOARD_SIZE:
            continue
        c = off_by(constant, 0.05)
        fit = detected(c, Constant.TAG_SIZE, rig=rig, tag_pose=pose)
        shift = twist(pose, fit.camera_T_body)
        for gain in (fit.dependence.gain, nominal):  # with frames, and without
            miss = np.linalg.norm((shift - gain @ c) / scale)
            assert miss < 0.003 * np.linalg.norm(shift / scale) + 2e-5, constant.name


def test_a_tag_that_is_smaller_is_nearer() -> None:
    fit = detected(off_by(Constant.TAG_SIZE, -10.0), Constant.TAG_SIZE)
    moved = fit.dependence.gain @ off_by(Constant.TAG_SIZE, -10.0)
    assert fit.camera_T_body[2, 3] == pytest.approx(110.0 / 0.97, rel=0.002)
    assert fit.camera_T_body[2, 3] + moved[5] == pytest.approx(110.0, rel=0.003)


@pytest.mark.parametrize("size", [Constant.TAG_SIZE, Constant.BOARD_SIZE], ids=["tag", "board"])
def test_the_views_measure_the_size_of_a_print(size: Constant) -> None:
    for percent in (-3.0, 3.0):
        found = []
        for seed in range(10):
            c = off_by(size, percent / 0.3)
            dependence = detected(c, size, noise_px=0.02, seed=seed).dependence
            k = column(size)
            found.append(100.0 * dependence.pull[k] / dependence.information[k, k])
        assert np.mean(found) == pytest.approx(percent, abs=0.1)


def test_misfit_falls_by_what_the_constants_explain() -> None:
    c = np.zeros(CONSTANTS)
    for constant, sigmas in (
        (Constant.STEREO_ROTATION_X, 0.3),
        (Constant.BOARD_SIZE, 0.3),
        (Constant.CENTRE_LEFT_X, 0.2),
    ):
        c += off_by(constant, sigmas)
    dependence = detected(c, Constant.BOARD_SIZE).dependence
    assert 100.0 < dependence.chi_square < dependence.degrees_of_freedom  # below the limit
    left = dependence.chi_square + c @ dependence.information @ c - 2.0 * dependence.pull @ c
    assert abs(left) < 0.01 * dependence.chi_square


def test_a_detection_that_does_not_fit_speaks_softly() -> None:
    good = detected(np.zeros(CONSTANTS), Constant.TAG_SIZE, 0.02)
    corners = seen(ONE_TAG.tags[0].marker_p_corners_mm, POSE, np.zeros(CONSTANTS), Constant.TAG_SIZE, RIG)
    corners.ideal_px[2] += (6.0, -4.0)
    bad = choose_pose(corners, "body", [], Constant.TAG_SIZE)
    assert isinstance(bad, RigidFit)
    k = column(Constant.TAG_SIZE)
    assert bad.dependence.information[k, k] < 0.02 * good.dependence.information[k, k]
    share = plausible_share(bad.dependence.chi_square, bad.dependence.degrees_of_freedom)
    assert share * bad.dependence.chi_square == pytest.approx(10.0 + 3.0 * np.sqrt(20.0))


def test_a_spot_moves_with_its_board() -> None:
    c = off_by(Constant.BOARD_SIZE, 3.0) + off_by(Constant.FOCAL_LEFT) + off_by(Constant.CENTRE_RIGHT_Y)
    fit = detected(c, Constant.BOARD_SIZE)
    declared, scale = BOARD_P[31], 1.0 + c[column(Constant.BOARD_SIZE)]
    spot = fit.camera_T_body[:3, :3] @ declared + fit.camera_T_body[:3, 3]
    true = BOARD_POSE[:3, :3] @ (scale * declared) + BOARD_POSE[:3, 3]
    dependence = corner_dependence(fit.camera_T_body, declared, fit.dependence)
    assert np.linalg.norm(true - spot) > 0.3
    assert np.linalg.norm(spot + dependence.gain @ c - true) < 0.02 * np.linalg.norm(true - spot)


def session(*, camera: bool = True, marker: bool = True, board: bool = True) -> SessionModel:
    return replace(
        make_session(systematic=CAREFUL_LAB),
        camera=RIG if camera else None,
        marker=ONE_TAG if marker else None,
        board=BoardModel(9, 6, 9.0) if board else None,
    )


def test_a_pose_without_frames_depends_as_a_nominal_detection_does() -> None:
    corners = seen(ONE_TAG.tags[0].marker_p_corners_mm, POSE, np.zeros(CONSTANTS), Constant.TAG_SIZE, RIG)
    fit = choose_pose(corners, "body", [], Constant.TAG_SIZE)
    assert isinstance(fit, RigidFit)
    nominal = nominal_pose_dependence(session(), POSE)
    np.testing.assert_allclose(nominal.gain, fit.dependence.gain, rtol=1e-4, atol=1e-4)
    assert not nominal.information.any()
    assert not nominal.pull.any()


def test_poses_without_a_rig_scale_and_stretch() -> None:
    poses = np.stack([POSE, facing_pose((-20.0, 5.0, 90.0), 10.0)])
    for model in (session(camera=False), session(marker=False)):
        gain = nominal_pose_gain(model, poses)
        assert gain.shape == (2, 6, CONSTANTS)
        t = poses[:, :3, 3]
        np.testing.assert_allclose(gain[:, 3:, column(Constant.TAG_SIZE)], t)
        np.testing.assert_allclose(gain[:, 3:, column(Constant.CAMERA_SCALE)], t)
        both = gain[:, 3:, column(Constant.FOCAL_LEFT)] + gain[:, 3:, column(Constant.FOCAL_RIGHT)]
        np.testing.assert_allclose(both, t * [0.0, 0.0, 1.0])
        assert not gain[:, :3].any()


def test_view_bias_is_across_the_line_of_sight_and_grows_with_the_sine() -> None:
    for tilt_deg in (0.0, 30.0):
        pose = facing_pose((0.0, 0.0, 120.0), tilt_deg)
        for model in (session(), session(camera=False)):
            shift = nominal_pose_gain(model, pose)[3:, column(Constant.VIEW_BIAS)]
            assert np.linalg.norm(shift) == pytest.approx(np.sin(np.radians(tilt_deg)), abs=1e-12)
            assert shift[2] == pytest.approx(0.0, abs=1e-12)
            assert shift @ pose[:3, 2] == pytest.approx(-(np.sin(np.radians(tilt_deg)) ** 2), abs=1e-12)


def test_spots_without_frames() -> None:
    spots = np.array([[10.0, -5.0, 130.0], [0.0, 0.0, 90.0]])
    plain = nominal_spot_gain(session(board=False), spots)
    np.testing.assert_allclose(plain[..., column(Constant.CAMERA_SCALE)], spots)
    on_board = nominal_spot_gain(session(), spots)
    # Mostly by the board's size, so a wrong baseline hardly matters.
    size, scale = on_board[..., column(Constant.BOARD_SIZE)], on_board[..., column(Constant.CAMERA_SCALE)]
    np.testing.assert_allclose(size + scale, spots, rtol=1e-3, atol=0.05)
    assert np.linalg.norm(scale) < 0.05 * np.linalg.norm(size)


def test_a_pose_behind_the_camera_is_not_projected() -> None:
    behind = POSE.copy()
    behind[2, 3] = -60.0
    gain = nominal_pose_gain(session(), np.stack([POSE, behind]))
    assert np.isfinite(gain).all()
    np.testing.assert_allclose(gain[0], nominal_pose_gain(session(), POSE))
    np.testing.assert_allclose(gain[1], nominal_pose_gain(session(camera=False), behind))
