"""Stage motion in the search for a PM, and the looks where it stops."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.model.session_model import SensitivityModel, StageModel
from fgreg.simulation.config import SimulationConfig, Sweep


@dataclass(frozen=True, slots=True, eq=False)
class Stops:
    """Stage positions of the looks at n PMs, ``looks`` each, all (n, looks). Truth only.

    Attributes:
        device_rad: where the stage stands. scan_rad: the plane's angle there.
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


def range_mm(trus_p_mm: FloatArray, scan_rad: FloatArray, radius_mm: float) -> FloatArray:
    """Distance of points (..., 3) from the element below them, in the plane across the axis, at stage angles (...)."""
    y, z = radius_mm * np.sin(scan_rad), radius_mm * np.cos(scan_rad)
    return np.asarray(np.hypot(trus_p_mm[..., 1] - y, trus_p_mm[..., 2] - z))


def half_width_rad(table: SensitivityModel, depth_mm: FloatArray) -> FloatArray:
    """Half width at depths, linear between the table's entries."""
    return np.asarray(np.interp(depth_mm, table.depth_mm, table.half_width_rad))


def plane_angle_rad(trus_p_mm: FloatArray) -> FloatArray:
    """Stage angle at which the image plane passes through points (..., 3)."""
    return np.asarray(np.arctan2(trus_p_mm[..., 1], trus_p_mm[..., 2]))


def _detected(
    config: SimulationConfig, trus_p_mm: FloatArray, scan_rad: FloatArray, edge_rad: FloatArray
) -> tuple[BoolArray, FloatArray]:
    """Whether the probe detects points (n, 1, 3) at stage angles (n, m), and the half widths there."""
    depth = range_mm(trus_p_mm, scan_rad, config.probe.radius_mm)
    width = half_width_rad(config.probe.sensitivity, depth) + edge_rad
    return np.abs(plane_angle_rad(trus_p_mm) - scan_rad) < width, width


def look(
    config: SimulationConfig,
    trus_p_pm_mm: FloatArray,
    looks: int,
    first_sign: int,
    window_edge_rad: float,
    rng: np.random.Generator,
) -> Stops:
    """Turn the stage until each of n PMs (n, 3) is detected.

    With sweeps, the device is stepped from one of its limits (alternating from ``first_sign``, or always upwards) and
    stops at the first angle at which the PM is detected; further looks follow on the next steps. Without, each look is
    anywhere in the window.

    Raises:
        ValueError: a PM is out of the stage's reach.
    """
    n = trus_p_pm_mm.shape[0]
    stage, p = true_stage(config), trus_p_pm_mm[:, None]
    edge: FloatArray = window_edge_rad + config.edge_jitter_rad * rng.standard_normal((n, 1))
    phase: FloatArray = rng.uniform(0.0, 1.0, (n, 1))
    if config.sweep is Sweep.WINDOW or n == 0:
        scan = _anywhere(config, p, looks, edge, rng)
        sweep = np.zeros((n, looks), dtype=np.int64)
        device = stage.direction * scan + stage.zero_device_rad
    else:
        signs = np.ones(n, dtype=np.int64)
        if config.sweep is Sweep.ALTERNATING:
            signs = first_sign * (1 - 2 * (np.arange(n) % 2))
        low, high = stage.limits_device_rad
        steps = np.arange(math.ceil((high - low) / stage.step_rad)) + phase
        path = np.where(signs[:, None] > 0, low, high) + signs[:, None] * stage.step_rad * steps
        detected, _ = _detected(config, p, stage.direction * (path - stage.zero_device_rad), edge)
        detected &= (path >= low) & (path <= high)
        if not detected.any(axis=1).all():
            raise ValueError("a PM is never detected between the stage's limits: widen them or take smaller steps")
        order = np.argsort(
            ~detected, axis=1, kind="stable"
        )  # the angles with a detection, in the order they are reached
        count = detected.sum(axis=1)
        pick = np.floor(np.arange(looks) * np.maximum(count[:, None] / looks, 1.0)).astype(np.int64) % count[:, None]
        index = np.take_along_axis(order, pick, axis=1)
        device = np.take_along_axis(path, index, axis=1)
        scan = stage.direction * (device - stage.zero_device_rad)
        sweep = np.zeros((n, looks), dtype=np.int64)
        sweep[:, 0] = np.where(index[:, 0] > 0, signs, 0)  # a detection at the first stop: no direction is known
    _, width = _detected(config, p, scan, edge)
    return Stops(device, scan, sweep, width)


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
        trial = plane_angle_rad(trus_p_mm) + rng.uniform(-widest, widest, (n, looks))
        detected, _ = _detected(config, trus_p_mm, trial, edge_rad)
        scan = np.where(missing & detected, trial, scan)
    raise ValueError("a PM is detected nowhere: its window is too narrow")
