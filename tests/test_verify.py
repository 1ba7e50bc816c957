"""``fgreg verify``: what new shots say of a finished registration."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import fgreg
from fgreg.camera_moves.validity import Validity, Verification, odds_text, verify
from fgreg.cli.main import app
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, make_transform, transform_points
from fgreg.model.measurements import Measurements, Pair
from fgreg.model.session_model import NoiseModel, SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.pipeline.solve import SolveRequest, solve_session
from fgreg.pipeline.verify import verify_session
from fgreg.registration.solve import solve
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session
from fgreg.tracking.snapshot import Snapshot
from tests.forward import make_measurements, make_session

FRAMES = NoiseModel(
    marker_translation_mm=(0.02, 0.02, 0.1), marker_rotation_rad=(1e-3, 1e-3, 1e-3), aim_mm=(0.3, 0.3, 0.1)
)
KNOWN, NEW = 15, 12
SHIFT = make_transform(np.eye(3), np.array([3.0, -3.0, 2.6]))


class Solved:
    """A registration by first hits at the noise of frames, and shots that it has not."""

    def __init__(self, seed: int) -> None:
        model, measurements, truth = make_measurements(
            np.random.default_rng(seed), pairs=KNOWN + NEW, session=make_session(noise_model=FRAMES)
        )
        known = tuple(pair for pair in measurements.pairs if pair.pm < KNOWN)
        solution = solve(replace(measurements, pairs=known), (), model, SolveConfig())
        assert solution.snapshot is not None
        self.model: SessionModel = model
        self.snapshot: Snapshot = solution.snapshot
        self.new = tuple(pair for pair in measurements.pairs if pair.pm >= KNOWN)
        self.camera_T_trus = inverse(truth.trus_T_camera[0])
        self.measurements: Measurements = measurements

    def verified(self, pairs: Sequence[Pair]) -> Verification:
        epoch = self.snapshot.epoch(0)
        assert epoch is not None
        return verify(pairs, self.snapshot, epoch, self.model, SolveConfig())


@pytest.fixture(scope="module")
def solved() -> Solved:
    return Solved(5)


def moved(pairs: Sequence[Pair], new_T_old: FloatArray) -> list[Pair]:
    """The shots as a camera that has moved sees them."""
    return [
        replace(pair, marker=replace(pair.marker, camera_T_marker=new_T_old @ pair.marker.camera_T_marker))
        for pair in pairs
    ]


def test_agreeing_shots_verify_the_registration(solved: Solved) -> None:
    found = solved.verified(solved.new[:6])
    assert found.validity is Validity.VALID
    assert found.log_odds < -math.log(20.0)
    assert found.reason.startswith("the 6 shots agree with the registration (chi square ")
    assert 1.0 < found.shift_mm < 6.0
    assert math.radians(3.0) < found.turn_rad < math.radians(20.0)
    assert [shot.equations for shot in found.shots] == [2] * 6
    assert all(shot.used for shot in found.shots)


@pytest.mark.parametrize("count", [1, 2, 6])
def test_a_shift_of_5_mm_is_a_camera_move(solved: Solved, count: int) -> None:
    found = solved.verified(moved(solved.new[:count], SHIFT))
    assert found.validity is Validity.MOVED
    assert found.p < 0.01
    assert found.log_odds > 0.0
    assert "that the camera has moved: register again" in found.reason


def test_one_shot_does_not_tell_whether_the_camera_has_turned_about_the_targets(solved: Solved) -> None:
    middle = transform_points(solved.camera_T_trus, solved.model.targets_mm.mean(axis=0)[None])[0]
    rotation = exp_so3(np.radians([0.0, 3.0, 0.0]))
    turn = make_transform(rotation, middle - rotation @ middle)
    spots = [float(np.linalg.norm(self_pm(solved, pair) - middle)) for pair in solved.new]
    nearest = solved.new[int(np.argmin(spots))]
    for pairs in (moved([nearest], turn), [nearest]):
        found = solved.verified(pairs)
        assert found.validity is Validity.CANNOT_TELL
        assert "some shifts or turns would not show, however large" in found.reason
        assert math.isinf(found.turn_rad)


def self_pm(solved: Solved, pair: Pair) -> FloatArray:
    """The PM of a pair in the camera's frame, by its look in the middle of the window."""
    look, radius = pair.look, solved.model.probe.radius_mm
    reach = radius + look.range_mm
    trus_p = np.array([look.x_mm, reach * math.sin(look.scan_rad), reach * math.cos(look.scan_rad)])
    return np.asarray(transform_points(solved.camera_T_trus, trus_p[None])[0])


def test_one_outlier_among_agreeing_shots_is_left_out(solved: Solved) -> None:
    pairs = [*solved.new[:6]]
    pairs[2] = replace(pairs[2], look=replace(pairs[2].look, x_mm=pairs[2].look.x_mm + 15.0))
    found = solved.verified(pairs)
    assert found.validity is Validity.VALID
    assert [shot.used for shot in found.shots] == [True, True, False, True, True, True]
    assert f"PM {pairs[2].pm} (nis" in found.reason
    assert found.shots[2].p < 1e-6


def test_shots_that_no_registration_explains_are_degraded(solved: Solved) -> None:
    rng = np.random.default_rng(1)
    pairs = [
        replace(pair, look=replace(pair.look, x_mm=pair.look.x_mm + 4.0 * float(rng.normal())))
        for pair in solved.new[:8]
    ]
    found = solved.verified(pairs)
    assert found.validity is Validity.DEGRADED
    assert "no other registration explains that" in found.reason


def test_without_shots_it_cannot_tell(solved: Solved) -> None:
    assert solved.verified([]).validity is Validity.CANNOT_TELL


def test_false_alarms_are_one_percent_and_shifts_are_found() -> None:
    """240 single shots; tools/study_verify.py has more."""
    alarms = found = count = 0
    for seed in range(20):
        one = Solved(100 + seed)
        for pair in one.new:
            count += 1
            alarms += one.verified([pair]).validity is not Validity.CANNOT_TELL
            found += one.verified(moved([pair], SHIFT)).validity in (Validity.MOVED, Validity.DEGRADED)
    assert alarms <= 0.03 * count
    assert found >= 0.9 * count


def test_odds_in_words() -> None:
    assert odds_text(math.log(25.0)) == "25 to 1"
    assert odds_text(-math.log(3.0)) == "1 to 3"
    assert odds_text(100.0) == "1,000,000 to 1"


def split_session(folder: Path, *, new: int = 6) -> tuple[Path, list[dict[str, Any]]]:
    """A simulated session without its last PMs, solved; and the events of these."""
    write_session(simulate(replace(PRESETS["first-hit"], pairs=15 + new, noise=FRAMES), 3), folder)
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    held_out = [event for event in events if event["type"] == "pair" and event["pm"] >= 15]
    kept = [event for event in events if event not in held_out]
    (folder / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in kept))
    solve_session(SolveRequest(folder))
    return folder, held_out


def lines(path: Path, events: Sequence[dict[str, Any]]) -> Path:
    path.write_text("".join(json.dumps(event) + "\n" for event in events))
    return path


def shifted(events: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    out = json.loads(json.dumps(events))
    for event in out:
        pose = SHIFT @ np.array(event["marker"]["camera_T_marker"])
        event["marker"]["camera_T_marker"] = pose.tolist()
    return list(out)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    return split_session(tmp_path_factory.mktemp("verify") / "session")


def test_the_command_says_it_in_words_json_and_exit_status(
    session: tuple[Path, list[dict[str, Any]]], tmp_path: Path
) -> None:
    folder, events = session
    before = {path: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    good, bad = lines(tmp_path / "good.jsonl", events), lines(tmp_path / "bad.jsonl", shifted(events[:1]))
    said = CliRunner().invoke(app, ["verify", str(folder), str(good)])
    assert said.exit_code == 0
    assert said.stdout.split()[0] == "VALID"
    said = CliRunner().invoke(app, ["verify", str(folder), str(bad)])
    assert said.exit_code == 1
    assert said.stdout.split()[0] == "MOVED"
    said = CliRunner().invoke(app, ["verify", str(folder), str(good), "--json"])
    found = json.loads(said.stdout)
    assert found["verdict"] == "valid"
    assert found["log_odds_moved"] < 0
    assert len(found["shots"]) == 6
    assert found["shown"]["shift_mm"] > 0
    said = CliRunner().invoke(app, ["verify", str(folder), str(lines(tmp_path / "one.jsonl", events[:1])), "-q"])
    assert (said.exit_code, said.stdout) == (0, "")
    assert {path: path.read_bytes() for path in folder.iterdir() if path.is_file()} == before
    assert fgreg.verify(folder, good).verification.validity is Validity.VALID


def test_a_new_session_of_the_rig_serves_as_shots(session: tuple[Path, list[dict[str, Any]]], tmp_path: Path) -> None:
    folder, events = session
    other = tmp_path / "other"
    other.mkdir()
    (other / "session.yaml").write_text((folder / "session.yaml").read_text())
    lines(other / "events.jsonl", events)
    assert verify_session(folder, other).verification.validity is Validity.VALID
    note = {"type": "camera_moved", "t": events[-1]["t"]}
    lines(other / "events.jsonl", [*events, note])
    found = verify_session(folder, other).verification
    assert found.validity is Validity.MOVED
    assert "reports a camera move" in found.reason
    text = (folder / "session.yaml").read_text()
    (other / "session.yaml").write_text(text.replace("radius_mm: 10", "radius_mm: 12"))
    with pytest.raises(InputError, match=r"session\.yaml: probe"):
        verify_session(folder, other)


def test_bad_input_is_named(session: tuple[Path, list[dict[str, Any]]], tmp_path: Path) -> None:
    folder, events = session
    new = lines(tmp_path / "new.jsonl", events)
    with pytest.raises(InputError, match="no pair event"):
        verify_session(folder, lines(tmp_path / "note.jsonl", [{"type": "note", "t": 0, "text": "a"}]))
    with pytest.raises(InputError, match=r"wrong\.jsonl: line 1"):
        verify_session(folder, lines(tmp_path / "wrong.jsonl", [{**events[0], "pm": -1}]))
    with pytest.raises(InputError, match="a shot of the registration itself"):
        verify_session(folder, folder)
    with pytest.raises(InputError, match=r"nowhere\.jsonl"):
        verify_session(folder, tmp_path / "nowhere.jsonl")
    copy = tmp_path / "copy"
    copy.mkdir()
    for name in ("session.yaml", "events.jsonl", "result.yaml"):
        (copy / name).write_text((folder / name).read_text())
    shots = (copy / "events.jsonl").read_text().splitlines()
    (copy / "events.jsonl").write_text("\n".join(shots[:-6]) + "\n")
    with pytest.raises(InputError, match="solve it again"):
        verify_session(copy, new)
    result = (copy / "result.yaml").read_text()
    (copy / "result.yaml").write_text(result.replace("verdict: ok", "verdict: refused", 1))
    with pytest.raises(InputError, match="a refused registration"):
        verify_session(copy, new)
    (copy / "result.yaml").unlink()
    with pytest.raises(InputError, match="run fgreg solve"):
        verify_session(copy, new)
