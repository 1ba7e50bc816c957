"""Check points: their error, what it may be, and what becomes of the verdict; the same in solve, replay and live."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fgreg.detection.check_points import PIXEL_SIGMA, check_measurement, in_plane, triangulate
from fgreg.geometry.target_error import offset_quantile_mm
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, make_transform, transform_points
from fgreg.model.estimate import EpochEstimate, SessionEstimate, Verdict
from fgreg.model.events import AimEvent, CheckEvent, PairEvent, PlaneRecord, TrackEvent
from fgreg.model.lens import project
from fgreg.model.measurements import Check
from fgreg.model.session_model import default_targets_mm
from fgreg.model.solve_config import SolveConfig
from fgreg.model.systematic import Systematic
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.live_session import LiveSession
from fgreg.pipeline.replay import ReplayRequest, replay_session
from fgreg.pipeline.solve import SolveRequest, solve_session
from fgreg.registration.checks import (
    ASSUMPTIONS,
    CHECKS_REFUSE,
    COVERED_POWER,
    check_registration,
    direction_text,
    powers,
    with_checks,
)
from fgreg.session.result_file import read_result
from fgreg.session.session_reader import read_ground_truth, read_session
from fgreg.simulation.config import default_rig
from fgreg.simulation.deviations import drawn_deviations
from fgreg.simulation.presets import FIRST_HIT
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session
from tests.session_files import diagonal

PAPER = Path(__file__).parents[1] / "sessions" / "paper"
TRUS_T_CAMERA = make_transform(exp_so3(np.array([3.0, 0.2, -0.1])), np.array([5.0, -8.0, 160.0]))
COVARIANCE = np.diag(np.square([0.004, 0.003, 0.005, 0.2, 0.3, 0.25]))
TARGETS = default_targets_mm(10.0)
POINTS = np.array([[0.0, 0.0, 40.0], [15.0, -12.0, 35.0], [-15.0, 10.0, 45.0], [5.0, 20.0, 30.0]])


def checks_at(error_mm: FloatArray, sigma_mm: float = 0.5, points: FloatArray = POINTS) -> list[Check]:
    """Checks at which ``TRUS_T_CAMERA`` is off by errors (n, 3) or (3,)."""
    camera_p = transform_points(inverse(TRUS_T_CAMERA), points + error_mm)
    half = np.eye(3) * sigma_mm**2 / 2.0
    return [Check(float(i), 0, camera_p[i], half, points[i], half) for i in range(len(points))]


def texts(checks: Sequence[Check], limit_mm: float = 3.0) -> list[str]:
    return [c.text for c in check_registration(checks, TRUS_T_CAMERA, COVARIANCE, limit_mm).conditions]


def test_error_and_its_prediction_are_those_of_a_thousand_perturbed_registrations() -> None:
    rng = np.random.default_rng(1)
    check = checks_at(np.array([0.3, -0.2, 0.6]))[1]
    check = replace(check, covariance=np.diag([0.04, 0.01, 0.25]), trus_covariance=np.diag([0.01, 0.09, 0.16]))
    (found,) = check_registration([check], TRUS_T_CAMERA, COVARIANCE, 3.0).checks
    assert found.error_mm is not None
    assert found.predicted_95_mm is not None
    assert found.nis is not None
    assert_allclose(found.error_mm, [0.3, -0.2, 0.6], atol=1e-9)
    xi = rng.multivariate_normal(np.zeros(6), COVARIANCE, 20_000)
    seen = rng.multivariate_normal(check.camera_p_mm, check.covariance, len(xi))
    moved = np.einsum("nij,nj->ni", exp_so3(xi[:, :3]), seen) + xi[:, 3:]
    there = rng.multivariate_normal(check.trus_p_mm, check.trus_covariance, len(xi))
    error = transform_points(TRUS_T_CAMERA, moved) - there
    error -= found.error_mm
    assert found.predicted_95_mm == pytest.approx(np.quantile(np.linalg.norm(error, axis=1), 0.95), rel=0.03)
    spread = np.cov(error.T)
    assert found.nis == pytest.approx(found.error_mm @ np.linalg.solve(spread, found.error_mm), rel=0.05)


def test_good_checks_change_nothing() -> None:
    found = check_registration(checks_at(0.3 * np.ones((4, 3))), TRUS_T_CAMERA, COVARIANCE, 3.0)
    assert found.conditions == ()
    assert {check.verdict for check in found.checks} == {Verdict.OK}


@pytest.mark.parametrize(
    ("axis", "text"),
    [
        ([1.0, 0.0, 0.0], "off by 2.5 mm along the probe (the registration puts points too far towards +x)"),
        ([-1.0, 0.0, 0.0], "along the probe (the registration puts points too far towards -x)"),
        ([0.0, 0.0, 1.0], "along the line to the probe (the registration puts points too far from it)"),
        ([0.0, 0.0, -1.0], "along the line to the probe (the registration puts points too near it)"),
        ([0.0, 1.0, 0.0], "sideways (the registration puts points at too large stage angles)"),
        ([0.0, -0.66, 0.75], "1.9 mm along the line to the probe (too far from it) and 1.6 mm sideways (at too small"),
    ],
)
def test_a_common_shift_is_named_by_its_axis(axis: list[float], text: str) -> None:
    points = POINTS * np.array([1.0, 0.0, 1.0])  # in the plane at stage angle 0, where z is the line to the probe
    found = check_registration(checks_at(2.5 * np.array(axis), points=points), TRUS_T_CAMERA, COVARIANCE, 3.0)
    assert "the checks are off by 2.5 mm" in found.conditions[0].text
    assert text in found.conditions[0].text
    assert found.conditions[0].verdict is Verdict.WARNING
    assert {check.verdict for check in found.checks} == {Verdict.WARNING}


def test_checks_show_an_error_as_large_as_the_limit_as_often_as_they_say() -> None:
    """A turn of the registration about the probe's axis, by 3 mm at the farthest target."""
    rng, draws = np.random.default_rng(5), 600
    checks = [replace(check, covariance=0.7 * np.eye(3)) for check in checks_at(np.zeros(3))[:3]]
    _, turn = powers(checks, TRUS_T_CAMERA, COVARIANCE, 3.0, TARGETS)
    angle = 3.0 / np.linalg.norm(TARGETS[:, 1:], axis=1).max()
    turned = make_transform(exp_so3(np.array([angle, 0.0, 0.0])), np.zeros(3)) @ TRUS_T_CAMERA
    shown = 0
    for xi in rng.multivariate_normal(np.zeros(6), COVARIANCE, draws):
        truth = turned @ make_transform(exp_so3(xi[:3]), xi[3:])
        camera_p = transform_points(inverse(truth), POINTS[:3]) + rng.normal(0.0, 0.7**0.5, (3, 3))
        trus_p = POINTS[:3] + rng.normal(0.0, 0.5 / 2.0**0.5, (3, 3))
        drawn = [
            replace(check, camera_p_mm=camera_p[i], trus_p_mm=trus_p[i], trus_covariance=check.trus_covariance)
            for i, check in enumerate(checks)
        ]
        found = check_registration(drawn, TRUS_T_CAMERA, COVARIANCE, 30.0)
        shown += any(check.verdict is Verdict.WARNING for check in found.checks)
    assert 0.2 < turn < 0.8
    assert turn - 0.06 < shown / draws < turn + 0.1  # either of the tests is enough: a little more than the better one


def test_a_check_on_the_probes_axis_does_not_show_a_turned_window() -> None:
    points = np.array([[-20.0, 0.0, 0.0], [0.0, 0.0, 0.0], [20.0, 0.0, 0.0]])
    shift, turn = powers(checks_at(np.zeros(3), 0.3, points), TRUS_T_CAMERA, 0.25 * COVARIANCE, 3.0, TARGETS)
    assert shift > COVERED_POWER
    assert turn < 0.01
    # Nor do any checks that are too rough.
    assert max(powers(checks_at(np.zeros(3), 4.0), TRUS_T_CAMERA, COVARIANCE, 3.0, TARGETS)) < COVERED_POWER


def test_axes_turn_with_the_stage_angle_of_the_point() -> None:
    point = np.array([0.0, 40.0 * math.sin(0.5), 40.0 * math.cos(0.5)])
    assert "too far from it" in direction_text(np.array([0.0, math.sin(0.5), math.cos(0.5)]), point)
    assert "too large stage angles" in direction_text(np.array([0.0, math.cos(0.5), -math.sin(0.5)]), point)


def test_one_wrong_check_is_named_by_its_time() -> None:
    error = np.zeros((4, 3))
    error[2] = [0.0, 4.0, 0.0]
    wrong = [text for text in texts(checks_at(error)) if "at 2.0 s is off by 4.0 mm" in text]
    assert len(wrong) == 1
    assert "sideways" in wrong[0]
    found = check_registration(checks_at(error), TRUS_T_CAMERA, COVARIANCE, 3.0).checks
    assert found[2].verdict is Verdict.WARNING


def test_the_mean_error_with_its_own_95_percent_has_to_stay_below_the_limit() -> None:
    """Rough checks do not show that the registration is good, even where they agree with it."""
    assert texts(checks_at(np.zeros(3), sigma_mm=2.0)) == []
    (rough,) = texts(checks_at(np.zeros(3), sigma_mm=6.0))
    assert "the mean error at the checks is 0.0 mm, at most 8.4 mm (95 % bound), and has to be below 3 mm" in rough
    assert "locate the checks more accurately" in rough
    (near,) = texts(checks_at(np.array([0.9, 0.0, 0.0])), limit_mm=1.0)
    assert "at most 1.4 mm" in near
    places = np.repeat(POINTS, 10, axis=0)
    many = checks_at(np.array([0.9, 0.0, 0.0]), points=places + 1e-6 * np.arange(len(places))[:, None])
    assert texts(many, limit_mm=1.2) == []


def test_a_check_written_down_many_times_counts_once() -> None:
    (check,) = checks_at(np.zeros((1, 3)), sigma_mm=2.0, points=POINTS[:1])
    (once,) = texts([check])
    assert "the mean error at the check is 0.0 mm, at most" in once
    (often,) = texts([check] * 40)
    assert once.split("at most")[1] == often.split("at most")[1]


def test_far_beyond_the_limit_the_checks_refuse() -> None:
    found = check_registration(checks_at(np.array([0.0, 0.0, 9.0])), TRUS_T_CAMERA, COVARIANCE, 3.0)
    assert found.conditions[0].verdict is Verdict.REFUSED


@pytest.mark.parametrize("mean", [[0.0, 0.0, 0.0], [1.0, 0.0, 2.0], [0.0, 5.0, 0.0]])
@pytest.mark.parametrize("sigma", [[1.0, 1.0, 1.0], [1.0, 0.3, 0.1], [0.3, 0.3, 0.8]])
def test_the_quantile_of_an_offset_gaussian(mean: list[float], sigma: list[float]) -> None:
    draws = np.random.default_rng(3).normal(size=(200_000, 3)) * sigma + mean
    expected = np.quantile(np.linalg.norm(draws, axis=1), 0.95)
    assert offset_quantile_mm(np.array(mean), np.diag(np.square(sigma))) == pytest.approx(expected, rel=0.015)


def test_pixels_are_triangulated_with_the_covariance_of_half_a_pixel() -> None:
    rig, rng = default_rig(), np.random.default_rng(4)
    assert rig.right is not None
    assert rig.right_T_left is not None
    point = np.array([8.0, -5.0, 120.0])
    left, right = project(rig.left, point), project(rig.right, transform_points(rig.right_T_left, point[None])[0])
    found = triangulate(rig, left, right)
    assert not isinstance(found, str)
    assert_allclose(found[0], point, atol=1e-6)
    draws = []
    for _ in range(800):
        drawn = triangulate(rig, left + PIXEL_SIGMA * rng.normal(size=2), right + PIXEL_SIGMA * rng.normal(size=2))
        assert not isinstance(drawn, str)
        draws.append(drawn[0] - point)
    whitened = np.linalg.solve(np.linalg.cholesky(found[1]), np.array(draws).T)
    assert_allclose(np.mean(whitened**2, axis=1), 1.0, atol=0.2)
    assert "7.0 px apart" in str(triangulate(rig, left, right + np.array([0.0, 7.0])))
    assert "behind the camera" in str(triangulate(rig, left, right + np.array([200.0, 0.0])))


def test_a_point_seen_in_the_plane_is_on_it_and_known_across_it_to_a_sixth_of_the_window() -> None:
    model = read_session(PAPER).model
    point, covariance = in_plane(PlaneRecord(30.0, 4.0, 30.0), model)
    reach = model.probe.radius_mm + 30.0
    angle = model.stage.scan_from_device(math.radians(30.0))
    assert_allclose(point, [4.0, reach * math.sin(angle), reach * math.cos(angle)])
    across = np.array([0.0, math.cos(angle), -math.sin(angle)])
    along = np.array([0.0, math.sin(angle), math.cos(angle)])
    half_width = float(model.probe.sensitivity.half_width_at(30.0))
    sigma = reach * math.hypot(half_width / 6.0, model.noise.scan_rad)
    assert_allclose([across @ covariance @ across, along @ covariance @ along], [sigma**2, model.noise.range_mm**2])
    # and a point without a covariance of its own is known as well
    event = CheckEvent(0.0, 1, camera_p_mm=np.array([0.0, 0.0, 120.0]), trus_p_mm=point)
    check = check_measurement(event, 0, model)
    assert isinstance(check, Check)
    assert_allclose(check.trus_covariance, covariance, atol=1e-9)
    assert_allclose(np.sqrt(np.diag(check.covariance)), model.noise.marker_translation_mm)


def session_with_checks(folder: Path, error_mm: FloatArray, *, after: int | None = None, count: int = 4) -> Path:
    """``sessions/paper`` with checks, at which its true registration is off by ``error_mm``, after so many events."""
    shutil.copytree(PAPER, folder, ignore=shutil.ignore_patterns("result.yaml", ".*"))
    truth = read_ground_truth(folder)
    assert truth is not None
    lines = (folder / "events.jsonl").read_text().splitlines()
    after = len(lines) if after is None else after
    t = json.loads(lines[after - 1])["t"]
    camera_p = transform_points(inverse(truth.trus_T_camera[0]), POINTS + error_mm)
    checks: list[dict[str, Any]] = [
        {
            "type": "check",
            "t": t,
            "camera_p_mm": camera_p[i].tolist(),
            "covariance": diagonal(0.04, 0.04, 0.04),
            "trus_p_mm": POINTS[i].tolist(),
            "trus_covariance": diagonal(0.04, 0.04, 0.04),
        }
        for i in range(count)
    ]
    lines[after:after] = [json.dumps(check) for check in checks]
    (folder / "events.jsonl").write_text("".join(line + "\n" for line in lines))
    return folder


def solved(folder: Path, limit_mm: float = 8.0) -> SessionEstimate:
    return solve_session(SolveRequest(folder), SolveConfig(limit_mm=limit_mm)).estimate


def test_checks_never_enter_the_estimate_and_are_in_the_result(tmp_path: Path) -> None:
    folder = session_with_checks(tmp_path / "s", np.zeros(3))
    shutil.copytree(PAPER, tmp_path / "without", ignore=shutil.ignore_patterns("result.yaml"))
    found, without = solved(folder), solved(tmp_path / "without")
    assert found.epochs[0].trus_T_camera is not None
    assert without.epochs[0].trus_T_camera is not None
    assert_allclose(found.epochs[0].trus_T_camera, without.epochs[0].trus_T_camera, rtol=0, atol=1e-9)
    assert (found.verdict, found.reasons) == (without.verdict, without.reasons)
    assert [entry.text for entry in found.assumptions] == [entry.text for entry in without.assumptions]
    assert [entry.text for entry in found.assumptions] == list(ASSUMPTIONS)
    assert {entry.checks for entry in found.assumptions} == {(0, 1, 2, 3)}
    assert {entry.checks for entry in without.assumptions} == {()}
    written = read_result(folder / "result.yaml")
    assert len(written.checks) == 4
    for read, check in zip(written.checks, found.checks, strict=True):
        assert check.error_mm is not None
        assert read.error_mm is not None
        assert_allclose(read.error_mm, check.error_mm, atol=1e-6)
        assert (read.t, read.verdict) == (check.t, Verdict.OK)


def test_a_shift_costs_the_ok_and_a_far_one_refuses_tracks_too(tmp_path: Path) -> None:
    shifted = solved(session_with_checks(tmp_path / "a", np.array([0.0, 0.0, 5.0])))
    assert shifted.verdict is Verdict.WARNING
    assert any("off by" in reason and "along the line to the probe" in reason for reason in shifted.reasons)
    assert {entry.checks for entry in shifted.assumptions} == {()}
    assert any(track.stage_rad is not None for track in shifted.tracks)
    far = solved(session_with_checks(tmp_path / "b", np.array([0.0, 0.0, 30.0])))
    assert far.verdict is Verdict.REFUSED
    assert far.epochs[0].verdict is Verdict.REFUSED
    assert {track.reason for track in far.tracks} == {CHECKS_REFUSE}


def test_solve_replay_and_live_say_the_same_of_the_checks(tmp_path: Path) -> None:
    folder, config = session_with_checks(tmp_path / "s", np.array([0.0, 0.0, 5.0])), SolveConfig(limit_mm=8.0)
    estimate = solved(folder)
    replayed = replay_session(ReplayRequest(folder, tmp_path / "replay.yaml"), config)
    events = read_session(folder).events
    (folder / "events.jsonl").unlink()
    with LiveSession.open(folder, config) as live:
        for event in events:
            if isinstance(event, AimEvent | PairEvent | CheckEvent):
                live.add(event)
        settled = live.settle()
    with LiveSession.open(folder, config) as live:
        live.settle()
        reopened = live.estimate
    assert isinstance(reopened, OnlineEstimate)
    for found in (replayed.solved.estimate, settled, reopened):
        assert found.verdict is estimate.verdict
        assert [text for text in found.reasons if "off by" in text] == [t for t in estimate.reasons if "off by" in t]
        assert len(found.checks) == 4
        for check, other in zip(found.checks, estimate.checks, strict=True):
            assert check.error_mm is not None
            assert other.error_mm is not None
            assert_allclose(check.error_mm, other.error_mm, atol=1e-6)
            # Online the constants follow the registration by their regression on it, not by the posterior's samples.
            assert check.nis == pytest.approx(other.nis, rel=0.05)


def test_checks_that_the_cameras_locate_coarsely_raise_no_alarm(tmp_path: Path) -> None:
    """A stereo rig that is off within its budget locates points wrongly, by millimetres along the sight."""
    rng, statistics, verdicts = np.random.default_rng(4), [], []
    sigmas = Systematic().sigmas(0.0, 0.0)
    for seed in range(4):
        config = replace(FIRST_HIT, aims=12, pairs=15, tracks_heard=0, tracks_silent=0, checks=4)
        config = replace(config, deviations=drawn_deviations(sigmas, rng), camera_declared=True)
        simulated = simulate(config, seed)
        write_session(replace(simulated, events=[*simulated.events, *simulated.checks]), tmp_path / str(seed))
        found = solve_session(SolveRequest(tmp_path / str(seed)), SolveConfig(limit_mm=5.0)).estimate
        statistics += [check.nis for check in found.checks if check.nis is not None]
        verdicts += [check.verdict for check in found.checks]
        assert all("too coarse to bound an error of 5 mm" in check.reason for check in found.checks)
    assert 1.0 < np.mean(statistics) < 5.0  # three degrees of freedom; some 17 where the constants are ignored
    assert set(verdicts) == {Verdict.OK}


def test_checks_refuse_queries_from_when_they_are_known(tmp_path: Path) -> None:
    events = read_session(PAPER).events
    last_pair = max(i for i, event in enumerate(events) if isinstance(event, PairEvent))
    assert any(isinstance(event, TrackEvent) for event in events[last_pair:])
    folder = session_with_checks(tmp_path / "s", np.array([0.0, 0.0, 30.0]), after=last_pair + 1)
    replayed = replay_session(ReplayRequest(folder, tmp_path / "replay.yaml"), SolveConfig(limit_mm=8.0))
    assert {track.reason for track in replayed.solved.estimate.tracks} == {CHECKS_REFUSE}
    with LiveSession.open(folder, SolveConfig(limit_mm=8.0)) as live:
        query = next(event for event in events[last_pair:] if isinstance(event, TrackEvent))
        assert live.track(replace(query, t=200.0), record=False).reason == CHECKS_REFUSE


def test_a_check_belongs_to_its_camera_epoch() -> None:
    """An old epoch's checks cost no more than a warning and cover nothing; one without registration is not compared."""
    epochs = tuple(
        EpochEstimate(k, float(k), pose, covariance, 6, Verdict.OK, None)
        for k, (pose, covariance) in enumerate([(TRUS_T_CAMERA, COVARIANCE), (TRUS_T_CAMERA, COVARIANCE)])
    )
    estimate = SessionEstimate("two", Verdict.OK, (), None, epochs, (), ())
    far, near = checks_at(np.array([0.0, 0.0, 9.0]))[:2], checks_at(np.zeros(3), 0.3)[2:]
    found = with_checks(estimate, [*far, *(replace(check, epoch=1) for check in near)], 3.0, TARGETS)
    assert [epoch.verdict for epoch in found.epochs] == [Verdict.REFUSED, Verdict.OK]
    assert found.verdict is Verdict.WARNING
    assert found.reasons[0].startswith("epoch 0: the checks are off by 9.0 mm")
    assert {entry.checks for entry in found.assumptions} == {(2, 3)}
    on_axis = np.array([[-15.0, 0.0, 0.0], [15.0, 0.0, 0.0]])
    axis = [replace(check, epoch=1) for check in checks_at(np.zeros(3), 0.3, on_axis)]
    sure = replace(estimate, epochs=(epochs[0], replace(epochs[1], covariance=0.25 * COVARIANCE)))
    layer, window = with_checks(sure, axis, 3.0, TARGETS).assumptions
    assert (layer.checks, window.checks) == ((0, 1), ())
    open_epochs = (epochs[0], replace(epochs[1], trus_T_camera=None, covariance=None))
    (lost,) = with_checks(replace(estimate, epochs=open_epochs), [replace(near[0], epoch=1)], 3.0, TARGETS).checks
    assert (lost.error_mm, lost.nis, lost.verdict) == (None, None, Verdict.WARNING)
    assert lost.reason == "there is no registration of its camera epoch"
