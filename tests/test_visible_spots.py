"""The laser's spot that the camera sees: from the file to the estimate."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgreg.detection.events_to_measurements import ExtractedMeasurements, extract_measurements
from fgreg.errors import InputError
from fgreg.geometry.transforms import inverse, transform_points
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.readout import read_pairs
from fgreg.registration.register import register
from fgreg.session.session_reader import read_session
from fgreg.simulation.config import SimulationConfig, Sweep
from fgreg.simulation.simulate import SimulatedSession, simulate
from tests import session_files

CONFIG = SimulationConfig(spots=True, camera_declared=True, pairs=10, sweep=Sweep.WINDOW, looks_per_pm=2)


def read(tmp_path: Path, made: SimulatedSession) -> tuple[SessionModel, ExtractedMeasurements]:
    session = read_session(session_files.write(tmp_path, made.session, made.events))
    return session.model, extract_measurements(session.events, session.model)


def pairs_of(made: SimulatedSession) -> list[dict[str, Any]]:
    return [event for event in made.events if event["type"] == "pair"]


def test_spots_lie_where_the_camera_sees_the_pms_and_tell_of_the_registration(tmp_path: Path) -> None:
    made = simulate(CONFIG, 4)
    model, extracted = read(tmp_path, made)
    camera_T_trus = inverse(made.scene.trus_T_camera[0])
    square = []
    for pair in extracted.measurements.pairs:
        assert pair.spot is not None
        assert pair.spot.dependence is not None
        off = pair.spot.camera_p_mm - transform_points(camera_T_trus, np.array(made.truth["pms"][pair.pm]))
        square.append(off @ np.linalg.solve(pair.spot.covariance, off))
        assert pair.spot.dependence.gain.any()
    assert 1.5 < np.mean(square) < 5.0  # 3 expected
    seen = register(extracted.measurements, model, SolveConfig())
    pairs = tuple(replace(pair, spot=None) for pair in extracted.measurements.pairs)
    unseen = register(replace(extracted.measurements, pairs=pairs), model, SolveConfig())
    assert np.linalg.det(seen.covariance[:6, :6]) < 0.5 * np.linalg.det(unseen.covariance[:6, :6])


def test_pixels_of_two_points_leave_their_pair_out_with_the_reason(tmp_path: Path) -> None:
    made = simulate(CONFIG, 4)
    first = pairs_of(made)[0]
    first["spot"] = {**first["spot"], "right": np.add(first["spot"]["right"], [0.0, 30.0]).tolist()}
    _, extracted = read(tmp_path, made)
    index = next(i for i, event in enumerate(made.events) if event["type"] == "pair")
    assert extracted.unused[index].startswith("the visible spot: its two pixels are")
    assert len(extracted.measurements.pairs) == 19


def test_a_highlight_taken_for_the_spot_is_an_outlier(tmp_path: Path) -> None:
    made = simulate(replace(CONFIG, looks_per_pm=1, pairs=12), 3)
    pairs_of(made)[4]["spot"] = pairs_of(made)[7]["spot"]
    model, extracted = read(tmp_path, made)
    found = register(extracted.measurements, model, SolveConfig())
    assert np.flatnonzero(~found.shots.pm_inlier).tolist() == [4]
    square = []
    for estimate, pair in zip(
        read_pairs(extracted.measurements, found, model, 0.0), extracted.measurements.pairs, strict=True
    ):
        assert estimate.spot_error_mm is not None
        assert pair.spot is not None
        square.append(estimate.spot_error_mm @ np.linalg.solve(pair.spot.covariance, estimate.spot_error_mm))
    assert max(square[:4] + square[5:]) < 20.0 < 0.1 * square[4]


def test_pixels_need_two_cameras(tmp_path: Path) -> None:
    setup, pair = session_files.setup(), session_files.events()[3]
    del setup["camera"]["right"], setup["camera"]["right_T_left"]
    pair["spot"] = {"left": [10.0, 20.0], "right": [8.0, 20.0]}
    with pytest.raises(InputError, match=r"spot\.left: found pixels, but no camera with camera\.right"):
        read_session(session_files.write(tmp_path, setup, [pair]))


def test_pixels_are_of_a_picture(tmp_path: Path) -> None:
    setup, pair = session_files.setup(), session_files.events()[3]
    width = setup["camera"]["image_size"][0]
    pair["spot"] = {"left": [10.0, 20.0], "right": [width, 20.0]}
    with pytest.raises(InputError, match=r"spot\.right: found .*, expected a pixel of a picture of"):
        read_session(session_files.write(tmp_path, setup, [pair]))
