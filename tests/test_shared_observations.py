"""Looks that share a marker observation have one beam and belong to one camera epoch, however late their pulse came."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.errors import EventRefused
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, make_transform
from fgreg.model.estimate import Verdict
from fgreg.model.measurement_checks import problems_of_all
from fgreg.model.measurements import EpochStart, Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.events import CameraMoved
from fgreg.session.session_reader import read_session
from tests.forward import make_measurements
from tests.online_streams import restored
from tests.session_files import events, write

MOTION = make_transform(exp_so3(np.array([0.02, -0.02, 0.01])), np.array([4.0, -3.0, 2.0]))
COVARIANCE = np.diag([1e-3**2] * 3 + [0.1**2] * 3)


@pytest.fixture(scope="module")
def session() -> tuple[SessionModel, Measurements, FloatArray]:
    """Seven PMs of two looks each; the camera moves while the seventh is looked at the second time."""
    model, measurements, truth = make_measurements(
        np.random.default_rng(5), pairs=7, looks_per_pm=2, share_marker=True, look_spacing_deg=3.0
    )
    return model, measurements, truth.trus_T_camera[0]


def _moved(measurements: Measurements) -> CameraMoved:
    """A move that frames show from just before the last pulse on."""
    t = measurements.pairs[-1].t
    return CameraMoved(t + 2.0, MOTION, COVARIANCE, detected=True, since_t=t)


def test_a_look_that_shares_its_marker_stays_in_the_epoch_of_the_first(
    session: tuple[SessionModel, Measurements, FloatArray],
) -> None:
    model, measurements, true = session
    assert measurements.pairs[-1].marker is measurements.pairs[-2].marker
    engine = restored(OnlineRegistration(model, find_moves=False), measurements)
    estimate = engine.add(_moved(measurements))
    assert [pair.epoch for pair in engine.measurements().pairs] == [0] * 14
    assert estimate.trus_T_camera is not None
    off = estimate.trus_T_camera @ inverse(true @ inverse(MOTION))
    assert np.linalg.norm(off[:3, :3] @ [0.0, 0.0, 40.0] + off[:3, 3] - [0.0, 0.0, 40.0]) < 2.0
    late = replace(measurements.pairs[-1], t=estimate.t + 1.0)
    with pytest.raises(EventRefused, match="the marker of PM 6 was seen in another camera epoch"):
        engine.add(late)


def test_an_estimate_that_left_the_bound_of_its_verdict_is_no_longer_ok(
    session: tuple[SessionModel, Measurements, FloatArray],
) -> None:
    model, measurements, _ = session
    engine = restored(OnlineRegistration(model, SolveConfig(limit_mm=50.0), find_moves=False), measurements)
    report, state, t = engine._report, engine.state, engine.estimate.t
    assert report is not None
    assert report.trus_T_camera is not None
    assert report.predicted_tre is not None
    engine._serial += 1  # the report is of fewer measurements
    near = engine._estimated(state, t)
    assert not any("have moved the estimate" in reason for reason in near.reasons)
    away = make_transform(np.eye(3), np.array([1.1 * report.predicted_tre.worst_mm, 0.0, 0.0]))
    engine._report = replace(report, trus_T_camera=away @ report.trus_T_camera, verdict=Verdict.OK, reasons=())
    far = engine._estimated(state, t)
    assert far.verdict is Verdict.WARNING
    assert "beyond the bound of the full solve before them" in far.reasons[0]


def _pair(t: float, pm: int, marker: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "pair",
        "t": t,
        "pm": pm,
        "marker": marker,
        "trus": {"scan_deg": 1.0, "x_mm": 1.0, "range_mm": 30.0},
    }


def test_recorded_events_are_read_in_the_same_way(tmp_path: Path) -> None:
    pose = next(event["marker"] for event in events() if event["type"] == "pair")
    other = {**pose, "camera_T_marker": [*pose["camera_T_marker"][:2], [0.0, 1.0, 0.0, 151.0], [0.0, 0.0, 0.0, 1.0]]}
    log = [
        _pair(1.0, 0, pose),
        _pair(2.1, 0, pose),
        {"type": "note", "t": 2.2, "text": "between"},
        _pair(2.3, 0, other),
        {"type": "camera_moved", "t": 4.0, "detected": True, "since_t": 2.0},
        _pair(5.0, 0, pose),
    ]
    found = extract_measurements(
        read_session(write(tmp_path / "one", log=log)).events, read_session(tmp_path / "one").model
    )
    assert [pair.epoch for pair in found.measurements.pairs] == [0, 0, 1]
    assert "was seen in another camera epoch" in found.unused[5]


def test_a_programs_measurements_are_checked_for_it(session: tuple[SessionModel, Measurements, FloatArray]) -> None:
    _, measurements, _ = session
    pairs = (*measurements.pairs[:-1], replace(measurements.pairs[-1], epoch=1))
    wrong = replace(measurements, pairs=pairs, epochs=(*measurements.epochs, EpochStart(99.0)))
    assert [place for place, _ in problems_of_all(wrong, ())] == ["pairs[13]"]
