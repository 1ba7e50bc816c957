"""Sessions of one rig whose constants are not as declared, and their registrations."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.geometry.rig import Constant
from fgreg.model.measurements import Check
from fgreg.model.session_model import NoiseModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.register import Registration, register
from fgreg.session.session_reader import read_session
from fgreg.simulation.config import SimulationConfig, Sweep
from fgreg.simulation.presets import FIRST_HIT
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

OFF = {Constant.TAG_SIZE: 0.006, Constant.SOUND_SPEED: 0.012, Constant.ARRAY_OFFSET: 0.2, Constant.RADIUS: -0.15}
"""True less declared."""
RIG = replace(
    FIRST_HIT,
    pairs=10,
    tracks_heard=0,
    tracks_silent=0,
    noise=NoiseModel((0.001, 0.001, 0.002), (5e-5, 5e-5, 5e-5), 0.0, (0.3, 0.3, 0.1), 0.26, 0.17),
    sweep=Sweep.TWO_SIDED,
    deviations=OFF,
    beam_offset_mm=0.15,
)


def write(folder: Path, seed: int, config: SimulationConfig = RIG) -> Path:
    """A session of the rig, with its check points; without its truth."""
    simulated = simulate(config, seed)
    write_session(replace(simulated, events=[*simulated.events, *simulated.checks]), folder)
    (folder / "ground_truth.yaml").unlink()
    return folder


def solved(folder: Path) -> tuple[Registration, tuple[Check, ...]]:
    """A session's registration and check points."""
    session = read_session(folder)
    extracted = extract_measurements(session.events, session.model)
    return register(extracted.measurements, session.model, SolveConfig()), tuple(extracted.checks.values())


@cache
def _cached(root: Path, seed: int, checks: int) -> tuple[Registration, tuple[Check, ...]]:
    return solved(write(root / f"{seed}-{checks}", seed, replace(RIG, checks=checks)))


def registrations(
    root: Path, seeds: tuple[int, ...] = (1, 2, 3), checks: int = 0
) -> tuple[tuple[Registration, tuple[Check, ...]], ...]:
    """Of sessions of the rig, written below ``root``; solved once."""
    return tuple(_cached(root, seed, checks) for seed in seeds)


def truth(constants: tuple[Constant, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """(K,) true values of constants."""
    return np.array([OFF.get(constant, 0.0) for constant in constants])
