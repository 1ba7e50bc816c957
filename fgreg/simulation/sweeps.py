"""Stage motion in the search for a PM, and the looks where it stops."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.model.probe_model import SensitivityModel
from fgreg.model.session_model import StageModel
from fgreg.simulation.config import SimulationConfig, Sweep


@dataclass(frozen=True, slots=True, eq=False)
class Stops:
    """Stage positions of the looks at n PMs, ``looks`` each, all (n, looks). Truth only.

    Attributes:
        device_rad: where the stage stands by its own reading. scan_rad: the plane's true angle there.
        device_sweep: sign of the device's steps where it stopped at its first hit, else 0.
        half_width_rad: of the window at this depth, with this session's error.
    """

    device_rad: FloatArray
    scan_rad: FloatArray
    device_sweep: IntArray
    half_width_rad: FloatArray


def true_stage(config: SimulationConfig) -> StageModel:
    """The stage as wired, which may differ from the session."""
    return replace(config.stage, direction=-config.stage.direction) if config.reversed_stage else config.stage


def half_width_rad(table: SensitivityModel, depth_mm: FloatArray) -> FloatArray:
    """Half width at depths, linear between the table's entries."""
    return np.asarray(np.interp(depth_mm, table.depth_mm, table.half_width_rad))


def _detected(
    config: SimulationConfig, trus_p_mm: FloatArray, scan_rad: FloatArray, edge_rad: FloatArray
) -> tuple[BoolArray, FloatArray]:
    """Whether the probe detects points (n, 1, 3) at stage angles (n, m), and the half widths there."""
    array = config.array
    depth = array.distance_mm(trus_p_mm, scan_rad)
    width = half_width_rad(config.probe.sensitivity, depth) + edge_rad
    return np.abs(array.rotation_rad(trus_p_mm, scan_rad)) < width, width


def look(
    config: SimulationConfig,
    trus_p_pm_mm: FloatArray,
    looks: int,
    first_sign: int,
    window_edge_rad: float,
    rng: np.random.Generator,
    slip_rad: FloatArray | None = None,
) -> Stops:
    """Turn the stage until each of n PMs (n, 3) is detected.

    With sweeps, the device is stepped from one of its limits (alternating from ``first_sign``, or always upwards) and
    stops at the first angle at which the PM is detected; further looks follow on the next steps. Two-sided, the same
    follows from the other limit: ``2 * looks`` looks. Without sweeps, each look is anywhere in the window.

    The plane stays behind the reading: by the backlash in the direction of the steps, and by ``slip_rad`` (n,).

    Raises:
        ValueError: a PM is out of the stage's reach.
    """
    n = trus_p_pm_mm.shape[0]
    p, slip = trus_p_pm_mm[:, None], np.zeros((n, 1)) if slip_rad is None else slip_rad[:, None]
    edge: FloatArray = window_edge_rad + config.edge_jitter_rad * rng.standard_normal((n, 1))
    phase: FloatArray = rng.uniform(0.0, 1.0, (n, 1))
    if config.sweep is Sweep.WINDOW or n == 0:
        stage = true_stage(config)
        scan = _anywhere(config, p, looks, edge, rng)
        device = stage.direction * scan + stage.zero_device_rad + slip
        if backlash := config.deviations.get(Constant.BACKLASH, 0.0):  # from which side it came is not known
            device += backlash * rng.choice([-1.0, 1.0], device.shape)
        sweep = np.zeros((n, looks), dtype=np.int64)
    else:
        signs = np.ones(n, dtype=np.int64)
        if config.sweep in (Sweep.ALTERNATING, Sweep.TWO_SIDED):
            signs = first_sign * (1 - 2 * (np.arange(n) % 2))
        device, scan, sweep = _first_hits(config, p, looks, signs, edge, phase, slip)
        if config.sweep is Sweep.TWO_SIDED:
            phase = rng.uniform(0.0, 1.0, (n, 1))
            both = zip((device, scan, sweep), _first_hits(config, p, looks, -signs, edge, phase, slip), strict=True)
            device, scan, sweep = (np.concatenate(pair, axis=1) for pair in both)
    _, width = _detected(config, p, scan, edge)
    return Stops(device, scan, sweep, width)


def _first_hits(
    config: SimulationConfig,
    trus_p_mm: FloatArray,
    looks: int,
    signs: IntArray,
    edge_rad: FloatArray,
    phase: FloatArray,
    slip_rad: FloatArray,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Device angles, plane angles and recorded sweeps (n, looks) of PMs (n, 1, 3) stepped to in directions (n,)."""
    stage = true_stage(config)
    low, high = stage.limits_device_rad
    steps = np.arange(math.ceil((high - low) / stage.step_rad)) + phase
    path = np.where(signs[:, None] > 0, low, high) + signs[:, None] * stage.step_rad * steps
    behind = signs[:, None] * config.deviations.get(Constant.BACKLASH, 0.0) + slip_rad
    detected, _ = _detected(config, trus_p_mm, stage.direction * (path - behind - stage.zero_device_rad), edge_rad)
    detected &= (path >= low) & (path <= high)
    if not detected.any(axis=1).all():
        raise ValueError("a PM is never detected between the stage's limits: widen them or take smaller steps")
    order = np.argsort(~detected, axis=1, kind="stable")  # the angles with a detection, in the order of the sweep
    count = detected.sum(axis=1)
    pick = np.floor(np.arange(looks) * np.maximum(count[:, None] / looks, 1.0)).astype(np.int64) % count[:, None]
    index = np.take_along_axis(order, pick, axis=1)
    device = np.take_along_axis(path, index, axis=1)
    sweep = np.zeros((len(signs), looks), dtype=np.int64)
    sweep[:, 0] = np.where(index[:, 0] > 0, signs, 0)  # a detection at the first stop: no direction is known
    return device, stage.direction * (device - behind - stage.zero_device_rad), sweep


def _anywhere(
    config: SimulationConfig, trus_p_mm: FloatArray, looks: int, edge_rad: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Stage angles (n, looks), uniform over those with a detection of each PM."""
    n = trus_p_mm.shape[0]
    widest = float(config.probe.sensitivity.half_width_rad.max()) + max(float(edge_rad.max(initial=0.0)), 0.0)
    scan = np.full((n, looks), np.nan)
    for _ in range(50):
        missing = np.isnan(scan)
        if not missing.any():
            return scan
        middle = config.array.plane_angle_rad(trus_p_mm) - config.array.window_centre_rad
        trial = middle + rng.uniform(-widest, widest, (n, looks))
        detected, _ = _detected(config, trus_p_mm, trial, edge_rad)
        scan = np.where(missing & detected, trial, scan)
    raise ValueError("a PM is detected nowhere: its window is too narrow")
