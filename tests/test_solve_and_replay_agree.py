"""Whatever a session holds, ``solve``, ``replay`` and ``check`` leave out the same shots for the same reasons."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fgreg
from fgreg.detection.events_to_measurements import MeasurementExtractor
from fgreg.detection.photoacoustic import locate_in_frame
from fgreg.detection.results import PaFind
from fgreg.errors import InputError
from fgreg.model.events import PairEvent
from fgreg.model.measurement_checks import problem_of
from fgreg.model.session_model import NoiseModel
from fgreg.model.solve_config import SolveConfig
from fgreg.pipeline.check import check
from fgreg.pipeline.replay import ReplayRequest, replay_session
from fgreg.pipeline.solve import SolveRequest, solve_session
from fgreg.session.session_reader import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

FAST = SolveConfig(posterior_effective=60.0, posterior_samples=600)
NEGATIVE = Path(__file__).resolve().parents[2] / "shared" / "cases" / "exchange" / "neg_small"
Events = list[dict[str, Any]]


@pytest.fixture(scope="module")
def small_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sessions") / "small"
    config = replace(PRESETS["first-hit"], aims=7, pairs=8, tracks_heard=1, tracks_silent=0)
    write_session(simulate(replace(config, noise=NoiseModel(aim_mm=(0.3, 0.3, 0.1))), 5), folder)
    return folder


def _pairs(events: Events) -> Events:
    return [event for event in events if event["type"] == "pair"]


def _outliers(events: Events, rng: np.random.Generator) -> Events:
    for pair in rng.choice(_pairs(events), 2, replace=False):  # type: ignore[arg-type]
        pair["trus"]["range_mm"] += float(rng.uniform(10.0, 20.0))
    return events


def _repeated(events: Events, rng: np.random.Generator) -> Events:
    again = _pairs(events)[int(rng.integers(8))]
    return [*events, *({**again, "t": events[-1]["t"] + k + 1.0} for k in range(8))]


def _moved(events: Events, rng: np.random.Generator) -> Events:
    for pair in _pairs(events)[int(rng.integers(3, 6)) :]:
        pair["marker"]["camera_T_marker"][0][3] += 12.0
    return events


def _refused(events: Events, rng: np.random.Generator) -> Events:
    line = events.index(_pairs(events)[int(rng.integers(8))]) + 1
    refused = {"type": "refused", "t": events[-1]["t"], "event": {"type": "pair", "t": 0.0, "line": line}}
    return [*events, {**refused, "reason": "by hand"}]


def _left_out(events: Events, rng: np.random.Generator) -> Events:
    """Two PMs and an aim are left out while the session goes on, and one of the PMs counts again at the end."""
    place = events.index(_pairs(events)[6])
    first, second = (int(pm) for pm in rng.choice(6, 2, replace=False))
    choices = [
        {"type": "exclude", "pm": first, "reason": "the fibre was bumped", "by": "A. N."},
        {"type": "exclude", "pm": second},
        {"type": "exclude", "line": 3, "reason": "beside the corner"},
    ]
    now, end = ({"t": events[at]["t"]} for at in (place, -1))
    return [
        *events[:place],
        *({**c, **now} for c in choices),
        *events[place:],
        {"type": "include", "pm": second, **end},
    ]


def _no_noise(events: Events, _rng: np.random.Generator) -> Events:
    for event in events:
        event.pop("covariance", None)
        for part in ("marker", "trus"):
            event.get(part, {}).pop("covariance", None)
    return events


def _huge_noise(events: Events, rng: np.random.Generator) -> Events:
    pair = _pairs(events)[int(rng.integers(8))]
    pair["trus"]["covariance"] = [[1e9, 0.0], [0.0, 1e9]]
    return events


@pytest.mark.parametrize("change", [_outliers, _repeated, _moved, _refused, _left_out, _no_noise, _huge_noise])
def test_pairs_reasons_and_verdict_are_the_same(
    change: Callable[[Events, np.random.Generator], Events], small_session: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(small_session, tmp_path / "session"))
    path = folder / "events.jsonl"
    events = [json.loads(line) for line in path.read_text().splitlines()]
    rng = np.random.default_rng(len(change.__name__))
    path.write_text("".join(json.dumps(event) + "\n" for event in change(events, rng)))
    solved = solve_session(SolveRequest(folder, tmp_path / "solved.yaml"), FAST).estimate
    replayed = replay_session(ReplayRequest(folder, tmp_path / "replayed.yaml"), FAST).solved.estimate
    assert [(p.t, p.pm, p.epoch, p.used, p.reason) for p in replayed.pairs] == [
        (p.t, p.pm, p.epoch, p.used, p.reason) for p in solved.pairs
    ]
    assert (replayed.verdict, replayed.reasons) == (solved.verdict, solved.reasons)
    assert [(a.t, a.used, a.reason) for a in replayed.aims] == [(a.t, a.used, a.reason) for a in solved.aims]
    assert replayed.excluded == solved.excluded
    unused = {left.reason for left in check(folder).unused}
    assert unused <= {p.reason for p in solved.pairs} | {a.reason for a in solved.aims}
    assert bool(unused) == (change in (_refused, _left_out))
    if change is _left_out:
        aim, pair = sorted(solved.excluded, key=lambda shot: shot.type)
        assert [pair.reason, aim.reason] == ["the fibre was bumped", "beside the corner"]
        assert [p.reason for p in solved.pairs if p.pm == pair.pm] == [pair.text]
        assert (aim.aim, solved.aims[2].reason) == (2, aim.text)


def test_a_negative_variance_of_a_detector_is_a_reason_everywhere(
    raw_session: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Whatever a detector gives passes the check that files and programs pass."""

    def spoilt(frame: Any, *args: Any) -> Any:
        found = locate_in_frame(frame, *args)
        if isinstance(found, PaFind) and int(np.abs(frame).sum(dtype=np.float64)) % 3 == 1:  # frames come in any order
            return replace(found, covariance=np.diag([-1.0, 0.01]))
        return found

    monkeypatch.setattr("fgreg.detection.event_frames.locate_in_frame", spoilt)
    solved = solve_session(SolveRequest(raw_session, tmp_path / "solved.yaml"), FAST).estimate
    replayed = replay_session(ReplayRequest(raw_session, tmp_path / "replayed.yaml"), FAST).solved.estimate
    checked = check(raw_session)
    reasons = [p.reason for p in solved.pairs if "the variance -1 on the diagonal" in p.reason]
    assert reasons
    assert [p.reason for p in replayed.pairs] == [p.reason for p in solved.pairs]
    assert {shot.reason for shot in checked.unused if shot.kind == "pair"} == set(reasons)
    assert not [r for r in (*solved.reasons, *replayed.reasons) if "chi square -" in r]
    session = read_session(raw_session)
    live = [MeasurementExtractor(session.model).add(e, 0) for e in session.events if isinstance(e, PairEvent)]
    assert [found for found in live if isinstance(found, str)] == reasons


def test_numbers_of_a_program_are_named_with_their_place(small_session: Path) -> None:
    report = solve_session(SolveRequest(small_session, small_session / "other.yaml"), FAST)
    measured, model = report.extracted.measurements, report.session.model
    pair = measured.pairs[2]
    bad = {
        "the variance -1": replace(pair, look=replace(pair.look, covariance=-np.eye(2))),
        "range_mm is nan": replace(pair, look=replace(pair.look, range_mm=float("nan"))),
        "x_mm is 1e+09": replace(pair, look=replace(pair.look, x_mm=1e9)),
        "standard deviation of 1e+150": replace(pair, look=replace(pair.look, covariance=1e300 * np.eye(2))),
        "camera_T_marker has shape": replace(pair, marker=replace(pair.marker, camera_T_marker=np.eye(3))),
        "its epoch is 4": replace(pair, epoch=4),
    }
    for said, spoilt in bad.items():
        pairs = (*measured.pairs[:2], spoilt, *measured.pairs[3:])
        with pytest.raises(InputError, match=rf"pairs\[2\].*{said.replace('+', '.')}"):
            fgreg.solve_measurements(replace(measured, pairs=pairs), model, FAST)
    assert problem_of(pair) is None


@pytest.mark.skipif(not NEGATIVE.is_dir(), reason="the cases are not here")
def test_a_small_picture_is_left_out_with_one_reason(tmp_path: Path) -> None:
    solved = solve_session(SolveRequest(NEGATIVE, tmp_path / "solved.yaml"), FAST).estimate
    replayed = replay_session(ReplayRequest(NEGATIVE, tmp_path / "replayed.yaml"), FAST).solved.estimate
    (reason,) = [shot.reason for shot in check(NEGATIVE).unused]
    for estimate in (solved, replayed):
        assert [pair.reason for pair in estimate.pairs if not pair.used] == [reason]
    assert solved.verdict is replayed.verdict
