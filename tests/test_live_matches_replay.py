"""A live session and a replay of what it recorded: settled, they tell the same."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from fgreg.events import AimEvent, CameraMovedEvent, PairEvent
from fgreg.live import LiveSession
from fgreg.online.engine_process import EngineProcess
from fgreg.posterior import pose_tangent
from fgreg.replay import ReplayRequest, replay_session
from fgreg.session.reading import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

PATIENCE_S = 60.0


def test_settled_a_live_session_and_its_replay_have_the_same_epochs_verdict_and_registration(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    write_session(simulate(replace(PRESETS["camera-move"], aims=8, pairs=32), 4), folder)
    given = [e for e in read_session(folder).events if isinstance(e, AimEvent | PairEvent)]  # nobody tells the move
    (folder / "events.jsonl").unlink()
    given[12] = replace(given[12], t=given[11].t - 3.0)  # handed over later than it happened
    engines: list[EngineProcess] = []

    def make_engine(*arguments: object) -> EngineProcess:
        engines.append(EngineProcess(*arguments))  # type: ignore[arg-type]
        return engines[-1]

    try:
        with LiveSession.open(folder, make_engine=make_engine, late=True) as live:
            for number, event in enumerate(given):
                live.add(event)
                if number % 3 == 0:
                    live.refresh()
            end = time.monotonic() + PATIENCE_S
            while not live.engine.moves and time.monotonic() < end:  # the watch answers when it is ready
                time.sleep(0.05)
                live.refresh()
            settled, taken = live.settle(), live.measurements()
    finally:
        for engine in engines:
            engine.close()
    events = read_session(folder).events
    moves = [event for event in events if isinstance(event, CameraMovedEvent)]
    assert len(moves) == 1
    assert moves[0].detected
    assert events[12].t == events[11].t
    replayed = replay_session(ReplayRequest(folder, tmp_path / "replay.yaml"))
    there = replayed.settled
    assert there is not None
    assert (settled.verdict, settled.epoch, settled.pairs) == (there.verdict, there.epoch, there.pairs)
    assert settled.reasons == there.reasons
    assert [p.epoch for p in replayed.solved.recognised.measurements.pairs] == [p.epoch for p in taken.pairs]
    assert settled.trus_T_camera is not None
    assert settled.covariance is not None
    assert there.trus_T_camera is not None
    tangent = pose_tangent(settled.trus_T_camera, there.trus_T_camera)
    assert np.sqrt(tangent @ np.linalg.solve(settled.covariance, tangent)) <= 0.05
    assert replayed.solved.estimate.epochs[-1].verdict is settled.verdict
