"""Known points: points that both devices locate, as data of the registration and never as its checks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import fgreg
from fgreg.cli.main import app
from fgreg.model.estimate import SessionEstimate, Verdict
from fgreg.model.measurements import Check, VisibleSpot
from fgreg.model.plausible import implausible_measurements
from fgreg.pipeline.replay import ReplayRequest, replay_session
from fgreg.session.result_file import read_result
from fgreg.simulation.config import SimulationConfig
from fgreg.simulation.simulate import SimulatedSession, simulate
from tests import session_files
from tests.forward import make_measurements, make_session

CONFIG = SimulationConfig(pairs=8, points=3, checks=2)


def write(folder: Path, made: SimulatedSession, events: list[dict[str, Any]]) -> Path:
    return session_files.write(folder, made.session, events)


@pytest.fixture(scope="module")
def made() -> SimulatedSession:
    return simulate(CONFIG, 2)


def solved(folder: Path) -> SessionEstimate:
    return fgreg.solve(folder).estimate


def test_points_are_data_and_checks_are_not(tmp_path: Path, made: SimulatedSession) -> None:
    with_points = solved(write(tmp_path / "a", made, made.events + made.checks))
    without = solved(write(tmp_path / "b", made, [e for e in made.events if e["type"] != "point"]))
    assert [point.used for point in with_points.points] == [True] * 3
    assert all(point.nis is not None and point.nis < 16.3 for point in with_points.points)
    assert [check.reason for check in with_points.checks] == ["", ""]
    tre = [e.epochs[0].predicted_tre for e in (with_points, without)]
    assert tre[0] is not None
    assert tre[1] is not None
    assert tre[0].worst_mm < 0.95 * tre[1].worst_mm
    read = read_result(tmp_path / "a" / "result.yaml")
    assert [point.used for point in read.points] == [True] * 3


def test_a_point_that_contradicts_the_pairs_gets_a_warning(tmp_path: Path, made: SimulatedSession) -> None:
    points = [e for e in made.events if e["type"] == "point"]
    x, y, z = points[1]["camera_p_mm"]
    wrong = {**points[1], "camera_p_mm": [x + 12.0, y, z]}
    estimate = solved(write(tmp_path, made, [wrong if e is points[1] else e for e in made.events]))
    assert estimate.verdict is not Verdict.OK
    assert any("the known point at" in reason and "contradicts" in reason for reason in estimate.reasons)
    nis = [point.nis or 0.0 for point in estimate.points]
    assert max(nis) == nis[1]


def test_the_same_point_is_never_data_and_check(tmp_path: Path, made: SimulatedSession) -> None:
    point = next(e for e in made.events if e["type"] == "point")
    again = {**point, "type": "check", "t": made.checks[-1]["t"], "camera_p_mm": [0.0, 0.0, 100.0]}
    estimate = solved(write(tmp_path, made, [*made.events, *made.checks, again]))
    assert [bool(check.reason) for check in estimate.checks] == [False, False, True]
    assert "data of the registration" in estimate.checks[2].reason


def test_nor_in_measurements_of_a_program() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(3), pairs=8, points=2)
    first, far = measurements.points[0], measurements.points[0].trus_p_mm + 8.0
    check = Check(99.0, 0, first.camera_p_mm, first.covariance, first.trus_p_mm, first.trus_covariance)
    estimate = fgreg.solve_measurements(measurements, model, checks=[check, replace(check, trus_p_mm=far)])
    assert "data of the registration" in estimate.checks[0].reason
    assert estimate.checks[1].error_mm is not None


def test_a_point_that_is_left_out_by_hand_is_as_if_it_had_never_been_taken(
    tmp_path: Path, made: SimulatedSession
) -> None:
    points = [e for e in made.events if e["type"] == "point"]
    x, y, z = points[1]["camera_p_mm"]
    wrong = {**points[1], "camera_p_mm": [x + 12.0, y, z]}
    there = {**points[1], "type": "check", "t": 1e4}  # is compared again, where the point is no data any more
    events = [*(wrong if e is points[1] else e for e in made.events), there]
    folder = write(tmp_path / "a", made, events)
    run = CliRunner()
    assert run.invoke(app, ["exclude", str(folder), "--point", "1,2", "--reason", "the echo of a clip"]).exit_code == 0
    said = run.invoke(app, ["include", str(folder), "--point", "2"]).output
    assert f"known point 1 at {wrong['t']:.1f} s: left out by hand: the echo of a clip" in " ".join(said.split())
    estimate = solved(folder)
    without = solved(write(tmp_path / "b", made, [e for e in events if e is not wrong]))
    left, right = estimate.epochs[0].trus_T_camera, without.epochs[0].trus_T_camera
    assert left is not None
    assert right is not None
    np.testing.assert_allclose(left, right, atol=1e-9)
    assert [point.used for point in estimate.points] == [True, False, True]
    assert estimate.points[1].reason == "left out by hand: the echo of a clip"
    assert [(shot.type, shot.point, shot.pm, shot.aim) for shot in estimate.excluded] == [("point", 1, None, None)]
    assert sum("left out by hand (known point 1)" in reason for reason in estimate.reasons) == 1
    assert [check.error_mm is not None for check in estimate.checks] == [True]
    assert estimate.verdict is Verdict.WARNING


def test_replay_ends_where_solve_does(tmp_path: Path) -> None:
    made = simulate(replace(CONFIG, pairs=6, checks=1), 2)
    kinds = [e["type"] for e in made.events]
    early = [*made.events]
    point = early.pop(kinds.index("point"))
    place = len(early) - 4
    early.insert(place, {**point, "t": early[place - 1]["t"]})
    later = next(line for line, e in enumerate(early, 1) if e["type"] == "point")
    early.insert(later, {"type": "exclude", "t": early[later - 1]["t"], "line": later})
    folder = write(tmp_path, made, [*early, *made.checks])
    report = replay_session(ReplayRequest(folder, None, None), fgreg.SolveConfig())
    there = solved(folder)
    found, expected = report.solved.estimate.epochs[0], there.epochs[0]
    assert found.trus_T_camera is not None
    assert expected.trus_T_camera is not None
    np.testing.assert_allclose(found.trus_T_camera, expected.trus_T_camera, atol=1e-6)
    assert [(point.used, point.reason) for point in report.solved.estimate.points] == [
        (False, "left out by hand"),
        (True, ""),
        (True, ""),
    ]
    assert report.solved.estimate.excluded == there.excluded
    assert report.solved.estimate.reasons == there.reasons
    assert report.settled is not None


def test_epochs_take_their_points_with_them() -> None:
    model, measurements, truth = make_measurements(
        np.random.default_rng(5), pairs=16, epochs=2, points=4, session=make_session()
    )
    estimate = fgreg.solve_measurements(measurements, model)
    assert [point.epoch for point in estimate.points] == [0, 0, 1, 1]
    for epoch, true in zip(estimate.epochs, truth.trus_T_camera, strict=True):
        assert epoch.trus_T_camera is not None
        assert epoch.covariance is not None
        off = np.linalg.norm(epoch.trus_T_camera[:3, 3] - true[:3, 3])
        assert off < 4.0 * np.sqrt(np.trace(epoch.covariance[3:, 3:])) + 0.5


def test_points_and_spots_in_another_unit_or_behind_the_camera_are_seen() -> None:
    _, measurements, _ = make_measurements(np.random.default_rng(1), pairs=2, points=2, spot_sigma_mm=(0.3, 0.3, 1.0))
    assert not implausible_measurements(measurements)
    points = [
        replace(point, camera_p_mm=point.camera_p_mm / 1000.0, trus_p_mm=point.trus_p_mm / 1000.0)
        for point in measurements.points
    ]
    pairs = [
        replace(pair, spot=VisibleSpot(-pair.spot.camera_p_mm, np.eye(3))) for pair in measurements.pairs if pair.spot
    ]
    doubts = implausible_measurements(replace(measurements, pairs=tuple(pairs), points=tuple(points)))
    assert [text.partition(":")[0] for text in doubts] == [
        "2 of 2 visible spots lie behind the camera",
        "median of point.camera_p_mm",
        "median of point.trus_p_mm",
    ]
    assert all("in metres it would be" in text for text in doubts[1:])
