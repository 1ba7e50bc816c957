"""From raw frames to a registration: close to the truth, and honest about shots that show nothing."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from fgreg.errors import InputError
from fgreg.model.estimate import Verdict
from fgreg.pipeline.solve import SolveReport, SolveRequest, solve_session


def _events(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]


def _write(folder: Path, events: list[dict[str, object]]) -> None:
    (folder / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))


def _frames_of(folder: Path, kind: str) -> list[dict[str, object]]:
    return [event for event in _events(folder) if event["type"] == kind]


@dataclass
class Solved:
    """A session as it was simulated, solved once; ``seen``: items done and in all, as they were reported."""

    report: SolveReport
    seen: list[tuple[int, int]]
    rrd: Path


@pytest.fixture(scope="module")
def solved(_raw_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Solved:
    folder = tmp_path_factory.mktemp("solved")
    seen: list[tuple[int, int]] = []
    request = SolveRequest(_raw_session, out=folder / "result.yaml", rrd=folder / "session.rrd")
    report = solve_session(request, progress=lambda _, done, total: seen.append((done, total)))
    return Solved(report, seen, folder / "session.rrd")


def test_raw_frames_give_a_registration_near_the_truth(solved: Solved) -> None:
    report, seen = solved.report, solved.seen
    assert report.errors is not None
    tre = report.errors.tre_mm[0]
    assert tre is not None
    assert tre.mean() < 0.5
    assert report.estimate.verdict is not Verdict.REFUSED
    assert report.errors.beam_angle_rad is not None
    assert report.errors.beam_angle_rad < np.radians(0.5)
    assert seen[-1][0] == seen[-1][1] > 0
    heard = [e for e in report.errors.track_rad if e is not None]
    assert heard
    assert max(abs(np.degrees(e)) for e in heard) < 2.0


def test_shots_without_a_marker_or_a_sound_are_listed_with_the_reason(raw_session: Path) -> None:
    pairs = _frames_of(raw_session, "pair")
    marker, trus = pairs[0]["marker"], pairs[1]["trus"]
    assert isinstance(marker, dict)
    assert isinstance(trus, dict)
    for view in ("left", "right"):
        path = raw_session / str(marker[view])
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        cv2.imwrite(str(path), np.full_like(picture, 40))
    path = raw_session / str(trus["frame"])
    frame = np.load(path)
    np.save(path, np.random.default_rng(0).normal(0, 20, frame.shape).astype(frame.dtype))
    report = solve_session(SolveRequest(raw_session))
    first, second = report.estimate.pairs[:2]
    assert not first.used
    assert "not found" in first.reason
    assert not second.used
    assert "no signal" in second.reason
    assert all(pair.used for pair in report.estimate.pairs[2:])


def test_a_marker_in_one_view_is_reported_or_used_never_guessed(raw_session: Path) -> None:
    events = _events(raw_session)
    for event in events:
        if event["type"] == "pair":
            marker = event["marker"]
            assert isinstance(marker, dict)
            del marker["right"]
    _write(raw_session, events)
    report = solve_session(SolveRequest(raw_session))
    for pair in report.estimate.pairs:
        assert pair.used or "ambiguous" in pair.reason or "not found" in pair.reason


def test_a_recorded_pose_wins_unless_detection_is_asked_for(raw_session: Path, solved: Solved) -> None:
    events = _events(raw_session)
    pair = next(event for event in events if event["type"] == "pair")
    marker = pair["marker"]
    assert isinstance(marker, dict)
    marker["camera_T_marker"] = np.eye(4).tolist()
    marker["camera_T_marker"][2][3] = 100.0
    _write(raw_session, events)
    posed = solve_session(SolveRequest(raw_session))
    again = solve_session(SolveRequest(raw_session, redetect=True))
    posed_marker = posed.extracted.measurements.pairs[0].marker.camera_T_marker
    np.testing.assert_allclose(posed_marker[:3, 3], [0, 0, 100])
    first, redone = solved.report.estimate.epochs[0].trus_T_camera, again.estimate.epochs[0].trus_T_camera
    assert first is not None
    assert redone is not None
    np.testing.assert_allclose(redone, first)


@pytest.mark.parametrize("damage", ["missing", "cut", "size", "pixels"])
def test_a_damaged_frame_is_named_with_its_line(raw_session: Path, damage: str) -> None:
    pair = _frames_of(raw_session, "pair")[2]
    marker = pair["marker"]
    assert isinstance(marker, dict)
    path = raw_session / str(marker["left"])
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif damage == "size":
        cv2.imwrite(str(path), np.zeros((100, 100), np.uint8))
    else:
        middle = len(data) // 2
        path.write_bytes(data[:middle] + bytes(64) + data[middle + 64 :])
    with pytest.raises(InputError, match=r"events\.jsonl: line \d+: marker\.left"):
        solve_session(SolveRequest(raw_session))
    assert not (raw_session / "result.yaml").exists()


def test_a_wrong_sound_speed_is_reported(raw_session: Path) -> None:
    text = (raw_session / "session.yaml").read_text()
    wrong = text.replace("sound_speed_m_s: 1540.0", "sound_speed_m_s: 1510.0")
    assert wrong != text
    (raw_session / "session.yaml").write_text(wrong)
    report = solve_session(SolveRequest(raw_session))
    estimate = report.estimate
    assert any("the shots measure the sound speed" in reason for reason in estimate.reasons)
    (speed,) = (constant for constant in estimate.systematic if constant.name == "sound_speed")
    assert speed.value / speed.observed == pytest.approx(1540.0 / 1510.0 - 1.0, abs=0.006)
    predicted, errors = estimate.epochs[0].predicted_tre, report.errors
    assert predicted is not None
    assert errors is not None
    assert errors.tre_mm[0] is not None
    assert errors.tre_mm[0].max() < predicted.worst_mm


def test_a_recording_is_written_with_the_result(solved: Solved) -> None:
    assert solved.report.rrd_path == solved.rrd
    assert solved.rrd.stat().st_size > 100_000
