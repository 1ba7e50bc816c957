"""Constants of probe and stage from numbers that are computed by hand, without noise."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fgreg.errors import EstimationError
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform
from fgreg.model.session_model import SessionModel
from fgreg.model.setup_recording import TargetLine
from fgreg.setup.constants import Declared, Found
from fgreg.setup.moving_fibre import Movement, camera_latency
from fgreg.setup.optimum import optimum
from fgreg.setup.still_targets import Medium, TargetLooks, still_targets
from fgreg.setup.sweeps import Sweep, window_of
from fgreg.simulation.config import default_probe, default_stage

DECLARED = Declared.of(SessionModel("rig", default_probe(), default_stage()))
DEG = math.radians(1.0)


def by_name(found: list[Found]) -> dict[str, Found]:
    return {one.name: one for one in found}


def test_the_covariance_of_a_line() -> None:
    # y = a + b t at t = -1, 0, 1 with sigma 0.1: variances 0.01 / 3 and 0.01 / 2.
    t, y = np.array([-1.0, 0.0, 1.0]), np.array([1.0, 3.0, 5.0])
    found = optimum(lambda p: (p[0] + p[1] * t - y) / 0.1, np.zeros(2), np.ones(2))
    np.testing.assert_allclose(found.value, [3.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(found.covariance, np.diag([0.01 / 3.0, 0.01 / 2.0]), rtol=1e-5, atol=1e-9)
    assert found.degrees_of_freedom == 1
    with pytest.raises(EstimationError, match="do not determine"):
        optimum(lambda p: np.full(3, p[0] + p[1]), np.zeros(2), np.ones(2))


def looks(number: int, angle_deg: float, rho: float, x: float, *facts: TargetLine) -> TargetLooks:
    """A target at rho = 40 mm by a radius of 12 and an offset of 0.5 mm; at 6 deg its range is 27.652 mm."""
    u = np.arange(-6.0, 6.5, 1.0)
    ranges = np.sqrt(rho**2 + 12.0**2 - 2.0 * rho * 12.0 * np.cos(u * DEG)) - 0.5
    bell = 30.0 * np.exp(-0.02 * u**2)
    return TargetLooks(number, 0, (u + angle_deg) * DEG, np.full(u.size, x), ranges, bell, facts)


def test_radius_offset_and_signs_of_still_targets() -> None:
    first = looks(0, -30.0, 40.0, -5.0, TargetLine(0.0, 1, 0, depth_mm=28.0, depth_sigma_mm=0.01))
    assert first.range_mm[6] == pytest.approx(27.5)  # 40 - 12 - 0.5
    assert first.range_mm[0] == pytest.approx(math.sqrt(1744.0 - 960.0 * 0.9945218953682733) - 0.5)
    # Both at rho = 40, 60 deg apart: 40 mm across, 10 along.
    apart = math.hypot(40.0, 10.0)
    facts = TargetLine(0.0, 2, 1, of=0, apart_mm=apart, apart_sigma_mm=0.01, towards=("-y", "+x"))
    found = by_name(still_targets([first, looks(1, 30.0, 40.0, 5.0, facts)], [Medium(1.0, 1e-4)], DECLARED))
    assert found["probe.radius_mm"].value == pytest.approx(12.0, abs=0.02)
    assert found["range_offset_mm"].value == pytest.approx(0.5, abs=0.01)
    # The device's angle grows towards -y, x as declared.
    assert found["stage.direction"].value == -1
    assert found["probe.flip"].value is DECLARED.flip
    # Known is rho, by the distance, to 0.01 mm; so is the radius, by the depth.
    assert found["probe.radius_mm"].sigma == pytest.approx(0.02, rel=0.6)


def test_statements_and_measurements_that_do_not_fit_are_refused() -> None:
    third = looks(2, 10.0, 40.0, 0.0, TargetLine(0.0, 2, 2, of=0, towards=("-y",)))
    second = looks(1, 30.0, 40.0, 5.0, TargetLine(0.0, 2, 1, of=0, towards=("+y",)))
    with pytest.raises(EstimationError, match="contradict each other"):
        still_targets([looks(0, -30.0, 40.0, 0.0), second, third], [Medium(1.0, 1e-4)], DECLARED)
    wrong = looks(1, 30.0, 40.0, 5.0, TargetLine(0.0, 2, 1, of=0, apart_mm=20.0, depth_mm=28.0))
    with pytest.raises(EstimationError, match="sigmas off what is heard"):
        still_targets([looks(0, -30.0, 40.0, 0.0), wrong], [Medium(1.0, 1e-4)], DECLARED)
    # Which wire is which: the depth of the first, and the distances of the others from it, exchanged.
    first = looks(0, -30.0, 40.0, 0.0, TargetLine(0.0, 1, 0, depth_mm=28.0))
    apart = [TargetLine(0.0, 2, n, of=0, apart_mm=2.0 * 40.0 * math.sin(t * DEG)) for n, t in ((1, 25.0), (2, 30.0))]
    right = [first, looks(1, 20.0, 40.0, 0.0, apart[0]), looks(2, 30.0, 40.0, 0.0, apart[1])]
    radius = by_name(still_targets(right, [Medium(1.0, 1e-4)], DECLARED))["probe.radius_mm"]
    assert radius.value == pytest.approx(12.0, abs=0.1)
    exchanged = [first, looks(1, 20.0, 40.0, 0.0, apart[1]), looks(2, 30.0, 40.0, 0.0, apart[0])]
    with pytest.raises(EstimationError, match="look which target is which"):
        still_targets(exchanged, [Medium(1.0, 1e-4)], DECLARED)
    # Without distances the radius is hardly seen, and that is not presented as a radius that agrees.
    noisy = replace(first, range_mm=first.range_mm + 0.2 * (-1.0) ** np.arange(13))
    assert not by_name(still_targets([noisy], [Medium(1.0, 1e-4)], DECLARED))["probe.radius_mm"].seen
    moved = replace(first, x_mm=np.where(np.arange(13) < 6, 0.0, 3.0))
    with pytest.raises(EstimationError, match="the x of target 0 scatters by"):
        still_targets([moved], [Medium(1.0, 1e-4)], DECLARED)
    near = looks(1, -29.9, 40.0, 0.0, TargetLine(0.0, 2, 1, of=0, towards=("+y",)))
    with pytest.raises(EstimationError, match="move it farther"):
        still_targets([looks(0, -30.0, 40.0, 0.0), near], [Medium(1.0, 1e-4)], DECLARED)


def sweep(delay_s: float, backlash_deg: float) -> Sweep:
    """Passes from -12 to 12 deg and back, at 4 and at 8 deg/s, past a PM at 1 deg that is heard from -5 to 7."""
    times, angles = [0.0], [-12.0]
    for speed in (4.0, 8.0):
        for end in (12.0, -12.0):
            times += [times[-1] + 24.0 / speed, times[-1] + 24.0 / speed + 0.5]
            angles += [end, end]
    stage, pulses = np.arange(0.0, times[-1], 0.02), np.arange(0.013, times[-1], 0.05)
    moving = np.sign(np.interp(pulses + 0.01, times, angles) - np.interp(pulses - 0.01, times, angles))
    plane = np.interp(pulses, times, angles) - moving * backlash_deg
    heard = np.abs(plane - 1.0) < 6.0
    amplitude = np.where(heard, 40.0 * 0.5 ** ((plane - 1.0) / 6.0) ** 2, np.nan)
    ranges = np.where(heard, 25.0, np.nan)
    return Sweep("sweep", pulses, heard, amplitude, ranges, stage + delay_s, np.interp(stage, times, angles) * DEG)


def test_window_latency_and_threshold_of_a_sweep() -> None:
    found = by_name(window_of([sweep(0.08, 0.3)], DECLARED))
    assert found["probe.sensitivity.half_width_deg"].value == pytest.approx(6.0, abs=0.05)
    assert found["lower_edge_deg"].value == pytest.approx(-6.0, abs=0.1)
    assert found["upper_edge_deg"].value == pytest.approx(6.0, abs=0.1)
    assert found["stage_less_pulse_latency_s"].value == pytest.approx(0.08, abs=0.005)
    assert found["backlash_deg"].value == pytest.approx(0.3, abs=0.03)
    assert found["settings.hearing_threshold"].value == pytest.approx(20.0, rel=0.02)  # half of 40 at the edges


def test_times_and_angles_in_other_units_are_refused() -> None:
    right = sweep(0.0, 0.0)
    slow = replace(right, pulse_s=1e3 * right.pulse_s, stage_s=1e3 * right.stage_s)
    with pytest.raises(EstimationError, match="give t in s"):
        window_of([slow], DECLARED)
    with pytest.raises(EstimationError, match="scan_deg in degrees"):
        window_of([replace(right, stage_rad=DEG * right.stage_rad)], DECLARED)


def movement(turn: FloatArray, delay_s: float) -> Movement:
    """The tip, 50 mm before the marker's origin, at x = 12 sin(2 t) along the camera's y; the marker turns about it."""
    t = np.arange(0.0, 12.0, 0.033)
    poses = []
    for s in t:
        rotation = exp_so3(turn * math.sin(1.3 * s))
        tip = np.array([3.0, 12.0 * math.sin(2.0 * s), 100.0])
        poses.append(make_transform(rotation, tip - rotation @ [0.0, 0.0, 50.0]))
    pulses = np.arange(0.0, 12.0, 0.1)
    return Movement("moved", pulses, 12.0 * np.sin(2.0 * pulses), t + delay_s, np.stack(poses))


def test_latency_of_the_camera_by_a_fibre_that_moves_and_turns() -> None:
    found = camera_latency([movement(np.array([0.1, 0.05, 0.1]), 0.07)], DECLARED.noise)
    assert found.value == pytest.approx(0.07, abs=5e-4)
    moved = movement(np.zeros(3), 0.0)
    poses = moved.camera_T_marker[np.random.default_rng(1).permutation(len(moved.camera_T_marker))]
    other = Movement("moved", moved.pulse_s, moved.x_mm, moved.marker_s, poses)
    with pytest.raises(EstimationError, match="does not explain"):
        camera_latency([other], DECLARED.noise)
    # The hand does nearly the same some seconds later: roughly explained is not enough.
    roughly = replace(moved, x_mm=moved.x_mm + 2.0 * np.sin(0.7 * moved.pulse_s))
    with pytest.raises(EstimationError, match="by one clock"):
        camera_latency([roughly], DECLARED.noise)
