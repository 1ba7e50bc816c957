"""A live session and a replay of what it recorded: settled, they report the same."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from fgreg.model.events import AimEvent, CameraMovedEvent, PairEvent
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.live_session import LiveSession
from fgreg.pipeline.replay import ReplayRequest, replay_session
from fgreg.registration.posterior import pose_tangent
from fgreg.session.session_reader import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

FAST = SolveConfig(posterior_effective=60.0, posterior_samples=600)
PATIENCE_S = 60.0


def _waited(live: LiveSession, engine: OnlineRegistration) -> None:
    """As long as the full solve works: pairs are seconds apart."""
    end = time.monotonic() + PATIENCE_S
    while engine._solver.busy:
        assert time.monotonic() < end
        time.sleep(0.005)
        live.refresh()


def test_settled_a_live_session_and_its_replay_have_the_same_epochs_verdict_and_registration(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    write_session(simulate(replace(PRESETS["camera-move"], aims=8, pairs=22), 6), folder)
    given = [e for e in read_session(folder).events if isinstance(e, AimEvent | PairEvent)]  # no one reports the move
    given[12] = replace(given[12], t=given[11].t - 3.0)  # handed over later than it happened
    model = read_session(folder).model
    (folder / "events.jsonl").unlink()
    with (
        OnlineRegistration(model, FAST, full_solve="worker") as engine,
        LiveSession.open(folder, FAST, make_engine=lambda *_: engine, late=True) as live,
    ):
        for event in given:
            live.add(event)
            _waited(live, engine)
        settled, taken = live.settle(), live.measurements()
    events = read_session(folder).events
    moves = [event for event in events if isinstance(event, CameraMovedEvent)]
    assert len(moves) == 1
    assert moves[0].detected
    assert events[12].t == events[11].t
    replayed = replay_session(ReplayRequest(folder, tmp_path / "replay.yaml"), FAST)
    there = replayed.settled
    assert there is not None
    assert (settled.verdict, settled.epoch, settled.pairs) == (there.verdict, there.epoch, there.pairs)
    assert settled.reasons == there.reasons
    assert [p.epoch for p in replayed.solved.extracted.measurements.pairs] == [p.epoch for p in taken.pairs]
    assert settled.trus_T_camera is not None
    assert settled.covariance is not None
    assert there.trus_T_camera is not None
    tangent = pose_tangent(settled.trus_T_camera, there.trus_T_camera)
    assert np.sqrt(tangent @ np.linalg.solve(settled.covariance, tangent)) <= 0.05
    assert replayed.solved.estimate.epochs[-1].verdict is settled.verdict
