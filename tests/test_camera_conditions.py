"""What corners say about prints and cameras: the culprit is named, and a rig within its budget is left in peace."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from fgreg.detection.body_pose import choose_pose
from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.detection.results import RigidFit
from fgreg.geometry.rig import CAMERA, Constant
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform, rotation_to_direction
from fgreg.model.camera_dependence import CONSTANTS, column, corner_dependence
from fgreg.model.corner_information import corner_information, observed_dependences
from fgreg.model.estimate import Verdict
from fgreg.model.measurements import Aim, Look, MarkerObservation, Measurements, Pair
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.systematic import EXACT, NONE
from fgreg.pipeline.solve import SolveRequest, solve_session
from fgreg.registration.camera_conditions import PrintSize, camera_conditions, print_sizes
from fgreg.registration.verdict import Condition, verdict_of
from fgreg.session.session_reader import read_ground_truth, read_session
from tests.marker_scene import ONE_TAG, RIG, facing_pose
from tests.test_camera_dependence import BOARD_P, off_by, seen, session

PHANTOM = Path(__file__).parent.parent / "sessions" / "phantom"
CONFIG = SolveConfig()
SIGMAS = session().constant_sigmas[CAMERA]
AIMS, PAIRS = 10, 12


def measured(c: FloatArray, seed: int, glint: int | None = None) -> Measurements:
    """Aims and pairs of a rig off by c; of one pair (``glint``) two corners are wrong."""
    rng = np.random.default_rng(seed)

    def fit(body_p: FloatArray, pose: FloatArray, size: Constant, noise_px: float, wrong: bool) -> RigidFit:
        corners = seen(body_p, pose, c, size, RIG)
        corners.ideal_px[:] += rng.normal(0.0, noise_px, corners.ideal_px.shape)
        if wrong:
            corners.ideal_px[:2] += (3.0, -2.0)
        found = choose_pose(
            replace(corners, covariance=noise_px**2 * np.eye(len(corners.covariance))), "body", [], size
        )
        assert isinstance(found, RigidFit)
        return found

    aims, pairs = [], []
    for i in range(AIMS + PAIRS):
        place = (rng.uniform(-25, 25), rng.uniform(-18, 18), rng.uniform(85, 145))
        pose = facing_pose(place, rng.uniform(15, 45), rng.uniform(0, 360), rng.uniform(0, 360))
        tag = fit(ONE_TAG.tags[0].marker_p_corners_mm, pose, Constant.TAG_SIZE, 0.01, i == glint)
        marker = MarkerObservation(tag.camera_T_body, np.eye(6), i, tag.dependence)
        if i < AIMS:
            t = np.array([rng.uniform(-20, 20), rng.uniform(-15, 15), rng.uniform(110, 160)])
            lean = exp_so3(rng.choice([-1.0, 1.0], 3) * rng.uniform(0.2, 0.5, 3))
            rotation = rotation_to_direction(t / np.linalg.norm(t)) @ lean
            centre = BOARD_P.mean(axis=0)
            pose = make_transform(rotation, t - rotation @ centre)
            board = fit(BOARD_P[::4], pose, Constant.BOARD_SIZE, 0.03, wrong=False)
            spot = corner_dependence(board.camera_T_body, centre, board.dependence)
            aims.append(Aim(float(i), marker, t, np.eye(3), spot))
        else:
            pairs.append(Pair(float(i), i, 0, marker, Look(0.0, 0.001, 0.0, 30.0, np.eye(2))))
    return Measurements(tuple(aims), tuple(pairs), ())


def sizes(measurements: Measurements, model: SessionModel | None = None) -> tuple[PrintSize, ...]:
    corners = corner_information([*observed_dependences(measurements)])
    assert corners is not None
    return print_sizes(corners, (model or session()).constant_sigmas[CAMERA])


def conditions(measurements: Measurements, model: SessionModel | None = None) -> list[Condition]:
    """With a registration whose targets are some 150 mm from the camera."""
    trus_T_camera = make_transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 180.0]))
    return camera_conditions(measurements, model or session(), CONFIG, [trus_T_camera])


def test_a_rig_within_its_budget_is_left_in_peace() -> None:
    """Of 400 such sessions none had a condition."""
    rng = np.random.default_rng(5)
    for seed in range(12):
        c = SIGMAS * rng.normal(size=CONSTANTS)
        measurements = measured(c, seed)
        assert conditions(measurements) == []
        for size in sizes(measurements):
            assert abs(size.ratio - 1.0 + c[column(size.constant)]) < 4.0 * size.sigma


@pytest.mark.parametrize("percent", [-3.0, 3.0])
def test_prints_of_another_size_are_named(percent: float) -> None:
    c = off_by(Constant.TAG_SIZE, percent / 0.3) + off_by(Constant.BOARD_SIZE, percent / 0.3)
    measurements = measured(c, 1)
    for size in sizes(measurements):
        assert size.ratio == pytest.approx(1.0 / (1.0 + percent / 100.0), abs=0.001)
    (found,) = conditions(measurements)
    assert found.verdict is Verdict.WARNING
    way = "smaller" if percent < 0 else "larger"
    for words in (
        "the stereo views measure the tag",
        f"% {way} than size_mm",
        f"% {way} than square_mm",
        "at the worst",
    ):
        assert words in found.text


def test_one_print_of_another_size_is_named_alone() -> None:
    for constant, name, other in (
        (Constant.TAG_SIZE, "the tag", "the board"),
        (Constant.BOARD_SIZE, "the board", "the tag"),
    ):
        (found,) = conditions(measured(off_by(constant, -10.0), 2))
        assert name in found.text
        assert other not in found.text
        assert "stereo calibration" not in found.text
        assert f"({found.effect_mm:.1f} mm at the worst target)" in found.text


def test_a_print_far_off_is_refused() -> None:
    (found,) = conditions(measured(off_by(Constant.TAG_SIZE, -17.0), 3))
    assert found.verdict is Verdict.REFUSED


@pytest.mark.parametrize(
    ("constant", "sigmas", "words"),
    [
        (Constant.CENTRE_LEFT_X, -6.0, "left principal point's x changed by -"),
        (Constant.FOCAL_RIGHT, 7.0, "right focal length changed by 1."),
        (Constant.STEREO_ROTATION_Z, 7.0, "stereo rotation about z changed by 0.2"),
        (Constant.STEREO_TRANSLATION_Z, 9.0, "stereo translation along z changed by 0.1"),
    ],
)
def test_a_wrong_calibration_is_named(constant: Constant, sigmas: float, words: str) -> None:
    (found,) = conditions(measured(off_by(constant, sigmas), 4))
    assert found.verdict is Verdict.WARNING
    assert words in found.text
    assert "again" in found.text


def test_a_glint_does_not_speak_for_the_rig() -> None:
    measurements = measured(np.zeros(CONSTANTS), 5, glint=AIMS + 3)
    assert conditions(measurements) == []
    for size in sizes(measurements):
        assert size.ratio == pytest.approx(1.0, abs=0.001)


def test_constants_that_are_exact_allow_no_deviation() -> None:
    measurements = measured(off_by(Constant.TAG_SIZE, -1.0) + off_by(Constant.BOARD_SIZE, -1.0), 6)
    assert conditions(measurements) == []
    for systematic in (EXACT, NONE):
        exact = replace(session(), systematic=systematic)
        (found,) = conditions(measurements, exact)
        assert re.search(r"0\.3 % smaller than size_mm \(1 sigma 0\.[01] %\)", found.text)


def test_without_frames_nothing_is_measured() -> None:
    measurements = measured(off_by(Constant.TAG_SIZE, -10.0), 7)
    poses = replace(
        measurements,
        aims=tuple(
            replace(aim, dependence=None, marker=replace(aim.marker, dependence=None)) for aim in measurements.aims
        ),
        pairs=tuple(replace(pair, marker=replace(pair.marker, dependence=None)) for pair in measurements.pairs),
    )
    assert corner_information([*observed_dependences(poses)]) is None
    assert conditions(poses) == []


def test_one_marker_under_several_looks_is_counted_once() -> None:
    measurements = measured(np.zeros(CONSTANTS), 8)
    twice = replace(measurements, pairs=measurements.pairs * 2)
    once = corner_information([*observed_dependences(measurements)])
    again = corner_information([*observed_dependences(twice)])
    assert once is not None
    assert again is not None
    np.testing.assert_array_equal(once.information, again.information)


def test_metres_for_millimetres_cost_the_ok() -> None:
    model = session()
    wrong = replace(model, probe=replace(model.probe, radius_mm=0.01))
    (found,) = conditions(measured(np.zeros(CONSTANTS), 9), wrong)
    assert found.verdict is Verdict.WARNING
    assert "in metres it would be 10 mm" in found.text


def phantom(tmp_path: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """A copy of the phantom's session, with another ``session.yaml``."""
    folder = tmp_path / "phantom"
    shutil.copytree(PHANTOM, folder)
    data = yaml.safe_load((folder / "session.yaml").read_text(encoding="utf-8"))
    change(data)
    (folder / "session.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    return folder


def print_scale(factor: float) -> Callable[[dict[str, Any]], None]:
    """Tag and board declared larger by a factor than they were printed."""

    def change(data: dict[str, Any]) -> None:
        data["marker"]["tags"][0]["size_mm"] *= factor
        data["board"]["square_mm"] *= factor
        data["board"]["charuco"]["marker_mm"] *= factor

    return change


def no_distortion(data: dict[str, Any]) -> None:
    for side in ("left", "right"):
        data["camera"][side]["distortion"] = [0, 0, 0, 0, 0]


def centres_off(data: dict[str, Any]) -> None:
    for side in ("left", "right"):
        for row in range(2):
            data["camera"][side]["matrix"][row][2] += 5.0


def said(folder: Path) -> tuple[list[Condition], tuple[PrintSize, ...]]:
    """Conditions of a session with the true registration, and the measured sizes."""
    read, truth = read_session(folder), read_ground_truth(folder)
    assert truth is not None
    measurements = extract_measurements(read.events, read.model).measurements
    return camera_conditions(measurements, read.model, CONFIG, truth.trus_T_camera), sizes(measurements, read.model)


@pytest.mark.parametrize("percent", [6, -4])
def test_frames_measure_the_printed_size(tmp_path: Path, percent: int) -> None:
    found, measured_sizes = said(phantom(tmp_path, print_scale(1.0 + percent / 100.0)))
    assert verdict_of(found) is Verdict.REFUSED
    assert len(measured_sizes) == 2
    for size in measured_sizes:
        assert size.ratio == pytest.approx(1.0 + percent / 100.0, abs=0.001)
    way = "smaller" if percent > 0 else "larger"
    assert re.search(rf"% {way} than size_mm \(1 sigma [\d.]+ %\) and the board", found[0].text)


def test_solve_says_that_the_prints_are_smaller(tmp_path: Path) -> None:
    report = solve_session(SolveRequest(phantom(tmp_path, print_scale(1.03))))
    assert report.estimate.verdict is Verdict.REFUSED
    assert report.errors is not None
    (error,), (epoch,) = report.errors.tre_mm, report.estimate.epochs
    assert error is not None
    assert epoch.predicted_tre is not None
    assert error.max() < epoch.predicted_tre.worst_mm  # which includes what is named
    assert "the stereo views measure the tag 3.0 % smaller than size_mm (1 sigma 0.5 %)" in report.estimate.reasons[0]
    for size in sizes(report.extracted.measurements, report.session.model):
        assert size.ratio == pytest.approx(1.03, abs=0.001)


def test_the_phantom_itself_is_as_declared() -> None:
    found, measured_sizes = said(PHANTOM)
    assert found == []
    for size in measured_sizes:
        assert size.ratio == pytest.approx(1.0, abs=0.0003)


def test_centres_that_are_off_are_named_with_what_they_mean(tmp_path: Path) -> None:
    found, _ = said(phantom(tmp_path, centres_off))
    assert verdict_of(found) is Verdict.WARNING
    for words in ("left principal point's x", "right principal point's y", "(1.4 mm at the worst target)"):
        assert words in found[0].text


def test_a_lens_without_its_distortion_is_named(tmp_path: Path) -> None:
    found, _ = said(phantom(tmp_path, no_distortion))
    assert verdict_of(found) is not Verdict.OK
    assert "the camera's calibration does not hold (lens distortion)" in found[-1].text
