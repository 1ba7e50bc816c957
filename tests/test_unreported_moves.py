"""A camera that moved, and no one reported it: found in a recorded session, and solved as epochs."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgreg.camera_moves.found import DetectedMove
from fgreg.camera_moves.recorded_session import EpochsFound, find_epochs, find_moves, placed, renumbered, split_epochs
from fgreg.cli.main import main
from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.geometry.target_error import tre_mm
from fgreg.geometry.transforms import FloatArray, make_transform
from fgreg.model.estimate import Verdict
from fgreg.model.events import AimEvent, CameraMovedEvent, PairEvent
from fgreg.model.measurements import EpochStart, Measurements, Pair
from fgreg.model.session_model import NoiseModel, SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.live_session import LiveSession
from fgreg.pipeline.replay import ReplayRequest, replay_session
from fgreg.pipeline.solve import SolveRequest, move_conditions, solve_session
from fgreg.registration.move_doubt import move_doubt
from fgreg.registration.register import register
from fgreg.registration.verdict import MOST_WRONG
from fgreg.session.result_file import read_result
from fgreg.session.session_reader import read_ground_truth, read_session
from fgreg.simulation.presets import FIRST_HIT, PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session
from tests.forward import make_measurements
from tests.online_streams import sigmas_between, unreported_move

CONFIG = SolveConfig()


def _shift(mm: float) -> FloatArray:
    return make_transform(np.eye(3), mm * np.array([0.6, -0.8, 0.0]))


def test_too_few_pairs_to_register_are_no_error() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(6), aims=12, pairs=4)
    assert find_moves(measurements, model, CONFIG) == ()


def test_solved_as_epochs_both_registrations_are_good() -> None:
    model, measurements, truth = unreported_move(7, _shift(10.0), after=10, before=12)
    (move,) = find_moves(measurements, model, CONFIG)
    assert abs(move.since - 12) <= 1
    assert move.since_t == measurements.pairs[move.since].t
    assert move.last_t < move.since_t <= move.alarm_t
    assert move.log_bayes is not None
    assert move.log_bayes > 0
    assert f"between pair {move.since} and {move.since + 1}" in move.text
    split = split_epochs(measurements, [move])
    found = register(split, model, CONFIG)
    assert len(split.epochs) == 2
    for epoch in (0, 1):
        estimate = found.optimum.state.trus_T_camera(epoch)[0]
        assert tre_mm(estimate, truth[epoch].trus_T_camera[0], model.targets_mm).mean() < 3.0
    together = register(measurements, model, CONFIG)
    assert len(together.shots.pm_inlier) - together.shots.pm_inlier.sum() > 5  # unsplit, one side of it is outliers


def _pairs(epochs: tuple[int, ...], pms: tuple[int, ...]) -> tuple[Pair, ...]:
    _, measurements, _ = make_measurements(np.random.default_rng(8), aims=0, pairs=len(pms))
    return tuple(
        replace(pair, epoch=epoch, pm=pm, t=float(i))
        for i, (pair, epoch, pm) in enumerate(zip(measurements.pairs, epochs, pms, strict=True))
    )


def test_later_epochs_are_renumbered_and_keep_their_motion() -> None:
    motion = EpochStart(4.0, np.eye(4), np.eye(6))
    whole = Measurements((), _pairs((0, 0, 0, 0, 1, 1), (0, 1, 2, 3, 4, 5)), (EpochStart(0.0), motion))
    split = split_epochs(whole, [DetectedMove(0, 2, 2.0, 1.0, 3.0, 9.0)])
    assert [pair.epoch for pair in split.pairs] == [0, 0, 1, 1, 2, 2]
    assert [epoch.t for epoch in split.epochs] == [0.0, 2.0, 4.0]
    assert split.epochs[2] is motion
    assert not split.epochs[1].motion_known


def test_looks_at_one_pm_stay_together() -> None:
    whole = Measurements((), _pairs((0, 0, 0, 0), (0, 1, 1, 2)), (EpochStart(0.0),))
    split = split_epochs(whole, [DetectedMove(0, 2, 2.0, 1.0, 3.0, 9.0)])
    assert [pair.epoch for pair in split.pairs] == [0, 0, 0, 1]


def test_events_between_pairs_follow_the_pair_that_a_move_begins_with() -> None:
    # Events 1, 3, 4 and 6 are the pairs; the move is before the third of them.
    assert renumbered((0, 0, 0, 0, 0, 0, 0), (1, 3, 4, 6), [DetectedMove(0, 2, 4.0, 3.0, 6.0, 9.0)]) == (
        0, 0, 0, 0, 1, 1, 1,
    )  # fmt: skip


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated session of two camera epochs whose ``camera_moved`` is taken out: not to be written to."""
    folder = tmp_path_factory.mktemp("unreported") / "session"
    config = replace(PRESETS["camera-move"], pairs=22)
    write_session(simulate(config, 2), folder)
    lines = (folder / "events.jsonl").read_text().splitlines(keepends=True)
    kept = [line for line in lines if json.loads(line)["type"] != "camera_moved"]
    assert len(kept) == len(lines) - 1
    (folder / "events.jsonl").write_text("".join(kept))
    return folder


def _run(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["fgreg", *(str(word) for word in words)])
    with pytest.raises(SystemExit) as exit_:
        main()
    assert isinstance(exit_.value.code, int)
    return exit_.value.code


def test_switched_off_nothing_is_detected_and_the_session_is_refused(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _run(monkeypatch, "solve", recorded, "--no-detect-moves", "--json", "--out", tmp_path / "result.yaml")
    document = json.loads(capsys.readouterr().out)
    assert len(document["epochs"]) == 1
    assert document["verdict"] == "refused"
    assert not any("the camera moved between" in reason for reason in document["reasons"])


def test_solve_and_replay_of_the_session_find_the_same_epochs_and_name_the_move(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _run(monkeypatch, "solve", recorded, "--json", "--out", tmp_path / "solved.yaml")
    document = json.loads(capsys.readouterr().out)
    assert any("the camera moved between pair 11 and 12" in reason for reason in document["reasons"])
    solved = read_result(tmp_path / "solved.yaml")
    replayed = replay_session(ReplayRequest(recorded, tmp_path / "replayed.yaml")).solved.estimate
    assert len(solved.epochs) == 2
    assert {pair.epoch for pair in solved.pairs} == {0, 1}
    assert tuple(replayed.reasons) == tuple(solved.reasons)
    assert [epoch.start_s for epoch in replayed.epochs] == [epoch.start_s for epoch in solved.epochs]
    assert [pair.epoch for pair in replayed.pairs] == [pair.epoch for pair in solved.pairs]
    for here, there in zip(replayed.epochs, solved.epochs, strict=True):
        assert here.trus_T_camera is not None
        assert there.trus_T_camera is not None
        np.testing.assert_allclose(here.trus_T_camera, there.trus_T_camera, atol=1e-6)


def test_a_session_recorded_while_the_engine_looks_for_moves_has_the_move_as_an_event(
    recorded: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "again"
    folder.mkdir()
    (folder / "session.yaml").write_text((recorded / "session.yaml").read_text())
    events = [e for e in read_session(recorded).events if isinstance(e, AimEvent | PairEvent)]

    def engine(model: SessionModel, config: SolveConfig) -> OnlineRegistration:
        return OnlineRegistration(model, config, verdicts=False)

    with LiveSession.open(folder, CONFIG, engine) as live:
        for event in events:
            live.add(event)
        before, (move,) = live.estimate, live.engine.moves
    moves = [event for event in read_session(folder).events if isinstance(event, CameraMovedEvent)]
    assert [(event.detected, event.since_t) for event in moves] == [(True, move.since_t)]
    assert move.since == sum(isinstance(event, PairEvent) for event in events) // 2
    with LiveSession.open(folder, CONFIG, engine) as again:
        after = again.estimate
    assert before is not None
    assert after is not None
    assert before.trus_T_camera is not None
    assert after.epoch == before.epoch == 1
    assert sigmas_between(after, before) < 0.05


@pytest.mark.parametrize("late", [-2, 0, 2])
def test_a_boundary_is_placed_where_the_two_registrations_have_it(late: int) -> None:
    model, measurements, _ = unreported_move(7, _shift(10.0), after=10, before=12)
    (move,) = find_moves(measurements, model, CONFIG)
    assert move.since == 12
    misplaced = replace(move, since=12 + late, since_t=measurements.pairs[12 + late].t)
    registration = register(split_epochs(measurements, [misplaced]), model, CONFIG)
    assert [m.since for m in placed(measurements, [misplaced], registration, CONFIG)] == [12]


def test_the_error_against_the_truth_is_that_of_the_camera_now(recorded: Path, tmp_path: Path) -> None:
    truth = tmp_path / "truth"
    shutil.copytree(recorded, truth)
    found = solve_session(SolveRequest(truth))
    assert found.errors is not None
    assert len(found.errors.tre_mm) == 2
    assert found.errors.tre_mm[1] is not None
    assert found.errors.tre_mm[1].max() < 5.0
    whole = solve_session(SolveRequest(truth, detect_moves=False))
    assert whole.errors is not None
    (error,) = whole.errors.tre_mm
    assert error is not None
    now = read_ground_truth(truth)
    assert now is not None
    estimate = whole.estimate.epochs[0].trus_T_camera
    assert estimate is not None
    targets = whole.session.model.targets_mm
    np.testing.assert_array_equal(error, tre_mm(estimate, now.trus_T_camera[1], targets))


def test_steady_sessions_are_neither_split_nor_refused_for_a_move() -> None:
    for seed in range(4):
        model, measurements, _ = make_measurements(np.random.default_rng([seed, 9]), pairs=15)
        found = find_epochs(measurements, model, CONFIG)
        assert found.moves == ()
        assert found.registration is not None
        doubt = move_doubt(found.registration, 0, CONFIG.limit_mm)
        assert doubt is not None
        assert doubt.wrong < MOST_WRONG


def test_a_move_with_inliers_on_both_of_its_sides_is_found(tmp_path: Path) -> None:
    # Among few precise pairs the largest consensus is of some pairs before the move and some after it.
    noise = NoiseModel((0.001, 0.001, 0.002), (5e-5, 5e-5, 5e-5), 0.0, (0.3, 0.3, 0.1), 0.24, 0.16)
    near = replace(FIRST_HIT, camera_distance_mm=(105.0, 135.0), marker_distance_mm=(45.0, 160.0), noise=noise)
    config = replace(near, pairs=15, tracks_heard=0, tracks_silent=0, epochs=2)
    write_session(simulate(replace(config, camera_moves_reported=False), 20079), tmp_path / "session")
    session = read_session(tmp_path / "session")
    measurements = extract_measurements(session.events, session.model, redetect=False).measurements
    together = register(measurements, session.model, CONFIG).shots.pm_inlier
    assert together[:8].any()
    assert together[8:].any()
    found = find_epochs(measurements, session.model, CONFIG)
    assert [move.since for move in found.moves] == [8]
    assert found.registration is not None
    assert found.registration.shots.pm_inlier.all()


def test_as_few_pairs_after_a_move_as_determine_a_registration_are_refused() -> None:
    whole = Measurements((), _pairs((0,) * 12, tuple(range(12))), (EpochStart(0.0),))
    for since, verdicts in ((5, [Verdict.WARNING]), (6, [Verdict.WARNING, Verdict.REFUSED])):
        move = DetectedMove(0, since, float(since), since - 1.0, 11.0, 9.0)
        conditions = move_conditions(EpochsFound((move,)), split_epochs(whole, [move]))
        assert [condition.verdict for condition in conditions] == verdicts
