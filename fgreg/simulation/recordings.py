"""Set-up recordings of a rig that is not as it is declared: the lines of the files that ``fgreg setup`` reads.

Forward only, with the array, the elevation gain and the misreadings of the simulated sessions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, make_transform
from fgreg.model.probe_model import ProbeModel
from fgreg.model.session_model import NoiseModel, StageModel
from fgreg.simulation.acoustics import Elevation
from fgreg.simulation.array import TrueArray
from fgreg.simulation.config import default_probe, default_stage
from fgreg.simulation.documents import degrees, rows

Document = dict[str, Any]
CAMERA_HZ, PULSE_HZ, STAGE_HZ = 30.0, 10.0, 25.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrueRig:
    """A rig as it is, and what is declared of it.

    Attributes:
        probe, stage: as declared. direction, flip: as wired.
        deviations: true less declared value of the rig's constants.
        half_width_rad: of the window. threshold: amplitude from which a PM is heard.
        camera_s, pulse_s, stage_s: latency of each device: from event to arrival.
        noise: of looks. amplitude_noise: relative.
    """

    probe: ProbeModel = field(default_factory=default_probe)
    stage: StageModel = field(default_factory=default_stage)
    direction: int = 1
    flip: bool = False
    deviations: Mapping[Constant, float] = field(default_factory=dict)
    half_width_rad: float = math.radians(6.0)
    threshold: float = 20.0
    camera_s: float = 0.0
    pulse_s: float = 0.0
    stage_s: float = 0.0
    noise: NoiseModel = field(default_factory=NoiseModel)
    amplitude_noise: float = 0.05

    def array(self, sound_speed_m_s: float | None = None) -> TrueArray:
        """The array as it is, in tissue or in a medium of this sound speed."""
        by = dict(self.deviations)
        if sound_speed_m_s is not None:
            by[Constant.SOUND_SPEED] = sound_speed_m_s / self.probe.sound_speed_m_s - 1.0
        return TrueArray.of(self.probe, by)

    def device_rad(self, scan_rad: float) -> float:
        """Device angle of a plane angle."""
        return self.direction * scan_rad + self.stage.zero_device_rad

    def scan_rad(self, device_rad: float) -> float:
        """Plane angle of a device angle."""
        return self.direction * (device_rad - self.stage.zero_device_rad)

    def heard(
        self,
        array: TrueArray,
        trus_p_mm: FloatArray,
        scan_rad: float,
        rng: np.random.Generator,
        threshold: float | None = None,
    ) -> Document:
        """x, range and amplitude of a pulse; empty where nothing is heard.

        The PM has the amplitude of the threshold (the rig's own, where none is given) at the half width.
        """
        at, gain = np.asarray(scan_rad), Elevation()
        limit = self.threshold if threshold is None else threshold
        offset = float(array.rotation_rad(trus_p_mm, at))
        amplitude = limit / gain.threshold * float(gain.amplitude(offset, self.half_width_rad))
        amplitude *= math.exp(self.amplitude_noise * float(rng.standard_normal()))
        noise_x, noise_range = rng.standard_normal(2)
        if amplitude < limit:
            return {}
        mirror = 1.0 if self.flip is self.probe.flip else -1.0
        return {
            "x_mm": round(mirror * float(array.x_mm(trus_p_mm, at)) + self.noise.lateral_mm * noise_x, 4),
            "range_mm": round(float(array.range_mm(trus_p_mm, at)) + self.noise.range_mm * noise_range, 4),
            "amplitude": round(amplitude, 5),
        }


@dataclass(frozen=True, slots=True, eq=False)
class StillTarget:
    """A target at (3,) ``trus_p_mm``, with what is written of it (keys of a ``target`` line)."""

    trus_p_mm: FloatArray
    facts: Document = field(default_factory=dict)


def still_recording(
    rig: TrueRig,
    targets: Sequence[StillTarget],
    rng: np.random.Generator,
    *,
    step_rad: float = math.radians(1.0),
    pulses: int = 4,
    medium_m_s: float | None = None,
    declared_m_s: float | None = None,
) -> list[Document]:
    """Targets, one after the other, with the stage standing at angles across each: a pulse or more at each.

    Args:
        step_rad: between the angles. pulses: at each.
        medium_m_s: true sound speed. declared_m_s: what is written of it.
    """
    array, t = rig.array(medium_m_s), 0.0
    lines: list[Document] = []
    if declared_m_s is not None:
        lines.append({"type": "medium", "t": t, "sound_speed_m_s": declared_m_s})
    for number, target in enumerate(targets):
        if target.facts:
            lines.append({"type": "target", "t": t, "target": number, **target.facts})
    backlash = rig.deviations.get(Constant.BACKLASH, 0.0)
    for number, target in enumerate(targets):
        middle = rig.device_rad(float(array.plane_angle_rad(target.trus_p_mm)))
        reach = math.ceil(1.5 * rig.half_width_rad / step_rad)
        for device in middle + step_rad * (np.arange(-reach, reach + 1) + rng.uniform(-0.5, 0.5)):
            scan = rig.scan_rad(float(device) - backlash)  # always from smaller device angles
            reading = degrees(float(device) + rig.noise.scan_rad * float(rng.standard_normal()))
            for _ in range(pulses):
                t = round(t + 1.0 / PULSE_HZ, 6)
                heard = rig.heard(array, target.trus_p_mm, scan, rng)
                lines.append({"type": "pulse", "t": t, "target": number, "scan_deg": round(reading, 4), **heard})
    return lines


def sweep_recording(
    rig: TrueRig, trus_p_mm: FloatArray, speeds_rad_s: Sequence[float], rng: np.random.Generator
) -> list[Document]:
    """The stage turned past a PM at constant speed, to and fro at each of the speeds."""
    array = rig.array()
    middle = rig.device_rad(float(array.plane_angle_rad(trus_p_mm)))
    reach = 2.0 * rig.half_width_rad
    backlash = rig.deviations.get(Constant.BACKLASH, 0.0)
    times, angles, senses = [0.0, 0.5], [middle - reach] * 2, [1.0]
    for speed in speeds_rad_s:
        for sense in (1.0, -1.0):
            times += [times[-1] + 2.0 * reach / speed, times[-1] + 2.0 * reach / speed + 0.5]
            angles += [middle + sense * reach] * 2
            senses += [sense, sense]
    lines: list[Document] = []
    for true_s in np.arange(0.0, times[-1], 1.0 / STAGE_HZ):
        device = float(np.interp(true_s, times, angles)) + 0.1 * rig.noise.scan_rad * float(rng.standard_normal())
        lines.append({"type": "stage", "t": float(true_s) + rig.stage_s, "scan_deg": round(degrees(device), 5)})
    for true_s in np.arange(rng.uniform(0.0, 1.0 / PULSE_HZ), times[-1], 1.0 / PULSE_HZ):
        sense = senses[min(int(np.searchsorted(times, true_s, side="right")) - 1, len(senses) - 1)]
        device = float(np.interp(true_s, times, angles)) - sense * backlash
        heard = rig.heard(array, trus_p_mm, rig.scan_rad(device), rng)
        lines.append({"type": "pulse", "t": float(true_s) + rig.pulse_s, **heard})
    return _in_order(lines)


def moving_recording(
    rig: TrueRig, trus_p_mm: FloatArray, rng: np.random.Generator, *, seconds: float = 20.0, reach_mm: float = 20.0
) -> list[Document]:
    """The fibre's tip moved to and fro along the probe about a point, with the stage turned to it."""
    array = rig.array()
    scan = float(array.plane_angle_rad(trus_p_mm))
    trus_T_camera = make_transform(exp_so3(rng.normal(0.0, 1.0, 3)), rng.normal(0.0, 50.0, 3))
    camera_T_trus = inverse(trus_T_camera)
    marker_p_tip = np.array([*rng.uniform(-15.0, 15.0, 2), -40.0])
    held = exp_so3(rng.normal(0.0, 1.0, 3))
    phases, rates = rng.uniform(0.0, 2.0 * math.pi, (4, 2)), rng.uniform([0.15, 0.45], [0.35, 0.8], (4, 2))

    def tip_and_turn(t_s: float) -> tuple[FloatArray, FloatArray]:
        along, *turn = np.sin(2.0 * math.pi * rates * t_s + phases).mean(axis=1)
        return trus_p_mm + np.array([reach_mm * along, 0.0, 0.0]), held @ exp_so3(0.1 * np.array(turn))

    lines: list[Document] = []
    noise = rig.noise
    for true_s in np.arange(0.0, seconds, 1.0 / CAMERA_HZ):
        tip, turn = tip_and_turn(float(true_s))
        pose = camera_T_trus @ make_transform(turn, tip - turn @ marker_p_tip)
        wobble = exp_so3(rng.standard_normal(3) * noise.marker_rotation_rad)
        read = make_transform(wobble @ pose[:3, :3], pose[:3, 3] + rng.standard_normal(3) * noise.marker_translation_mm)
        lines.append({"type": "marker", "t": float(true_s) + rig.camera_s, "camera_T_marker": rows(read)})
    for true_s in np.arange(rng.uniform(0.0, 1.0 / PULSE_HZ), seconds, 1.0 / PULSE_HZ):
        tip, _ = tip_and_turn(float(true_s))
        heard = rig.heard(array, tip, scan, rng)
        device = round(degrees(rig.device_rad(scan)), 4)
        lines.append({"type": "pulse", "t": float(true_s) + rig.pulse_s, "scan_deg": device, **heard})
    return _in_order(lines)


def _in_order(lines: list[Document]) -> list[Document]:
    return sorted(({**line, "t": round(line["t"], 6)} for line in lines), key=lambda line: line["t"])
