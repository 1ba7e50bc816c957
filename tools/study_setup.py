"""What ``fgreg setup`` finds of simulated rigs: are its sigmas true, and its signs right?

Rigs are drawn: signs, radius, range offset, window, latencies, backlash, threshold; and with the standard deviations of
a careful lab what no recording shows: tilts, array offset, window centre, sound speed of the water. Each has the
recordings that docs/setup.md asks for: three points in water, two sweeps past a PM, a fibre that is moved. The forward
model shares no code with the estimator.

    python tools/study_setup.py --rigs 20
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.model.session_model import SessionModel
from fgreg.model.systematic import CAREFUL_LAB
from fgreg.pipeline.setup import SetupConfig, find_constants
from fgreg.simulation.config import default_probe, default_stage
from fgreg.simulation.recordings import StillTarget, TrueRig, moving_recording, still_recording, sweep_recording

WATER_M_S = 1482.0
MEASURED_MM = 0.1
"""Standard deviation of a distance or depth that is measured with a caliper."""
SPEEDS = (math.radians(3.0), math.radians(6.0))
SIGNS = ("stage.direction", "probe.flip")


@dataclass(frozen=True, slots=True, eq=False)
class DrawnRig:
    """A rig, and the truth of all that is found of it, by name."""

    rig: TrueRig
    truth: dict[str, float | bool]


def draw_rig(rng: np.random.Generator) -> DrawnRig:
    """A rig with everything drawn."""
    lab = CAREFUL_LAB
    radius, offset = rng.uniform(8.0, 14.0), 0.5 * float(rng.standard_normal())
    half, backlash = math.radians(rng.uniform(4.5, 8.0)), math.radians(0.2) * float(rng.standard_normal())
    tilts = np.array(lab.array_tilt_rad) * rng.standard_normal(3)
    deviations = {
        Constant.RADIUS: radius - default_probe().radius_mm,
        Constant.RANGE_OFFSET: offset,
        Constant.BACKLASH: backlash,
        Constant.ARRAY_OFFSET: lab.array_offset_mm * float(rng.standard_normal()),
        Constant.WINDOW_CENTRE: lab.window_centre_rad * float(rng.standard_normal()),
        **{Constant(Constant.TILT_IN_PLANE + i): float(tilts[i]) for i in range(3)},
    }
    rig = TrueRig(
        direction=int(rng.choice([-1, 1])),
        flip=bool(rng.integers(2)),
        deviations=deviations,
        half_width_rad=half,
        threshold=float(np.exp(rng.uniform(0.0, 5.0))),
        camera_s=float(rng.uniform(0.0, 0.15)),
        pulse_s=float(rng.uniform(0.0, 0.08)),
        stage_s=float(rng.uniform(0.0, 0.08)),
    )
    truth: dict[str, float | bool] = {
        "probe.radius_mm": radius,
        "range_offset_mm": offset,
        "probe.flip": rig.flip,
        "stage.direction": rig.direction,
        "probe.sensitivity.half_width_deg": math.degrees(half),
        "lower_edge_deg": -math.degrees(half),
        "upper_edge_deg": math.degrees(half),
        "settings.hearing_threshold": rig.threshold,
        "stage_less_pulse_latency_s": rig.stage_s - rig.pulse_s,
        "camera_less_pulse_latency_s": rig.camera_s - rig.pulse_s,
        "backlash_deg": math.degrees(backlash),
    }
    return DrawnRig(rig, truth)


def point(rig: TrueRig, x_mm: float, angle_deg: float, depth_mm: float) -> FloatArray:
    """TRUS point at a stage angle, so deep beyond the element faces."""
    rho, angle = rig.array().radius_mm + depth_mm, math.radians(angle_deg)
    return np.array([x_mm, rho * math.sin(angle), rho * math.cos(angle)])


def wires(rig: TrueRig, rng: np.random.Generator) -> list[StillTarget]:
    """Three points: the depth of the first measured, the distance of each other from it, and where it lies from it."""
    places = [point(rig, -4.0, -25.0, 25.0), point(rig, 3.0, 20.0, 30.0), point(rig, 4.0, 35.0, 22.0)]
    places = [place + rng.uniform(-1.0, 1.0, 3) for place in places]
    face = rig.array().radius_mm + float(np.tan(rig.deviations[Constant.TILT_IN_PLANE])) * places[0][0]
    depth = math.hypot(places[0][1], places[0][2]) - face + MEASURED_MM * float(rng.standard_normal())
    targets = [StillTarget(places[0], {"depth_mm": round(depth, 3), "depth_sigma_mm": MEASURED_MM})]
    for place in places[1:]:
        apart = float(np.linalg.norm(place - places[0])) + MEASURED_MM * float(rng.standard_normal())
        facts = {"from": 0, "apart_mm": round(apart, 3), "apart_sigma_mm": MEASURED_MM, "towards": ["+y", "+x"]}
        targets.append(StillTarget(place, facts))
    return targets


def write_recordings(folder: Path, rig: TrueRig, rng: np.random.Generator) -> list[Path]:
    """The recordings of a rig as files."""
    water = WATER_M_S + 3.0 * float(rng.standard_normal())
    recordings = {
        "points": still_recording(rig, wires(rig, rng), rng, medium_m_s=water, declared_m_s=WATER_M_S),
        "sweep-1": sweep_recording(rig, point(rig, 2.0, 5.0, 25.0), SPEEDS, rng),
        "sweep-2": sweep_recording(rig, point(rig, -3.0, -10.0, 38.0), SPEEDS, rng),
        "moved": moving_recording(rig, point(rig, 0.0, 0.0, 30.0), rng),
    }
    paths = []
    for name, lines in recordings.items():
        paths.append(folder / f"{name}.jsonl")
        paths[-1].write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    return paths


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    config = SetupConfig("session.yaml", SessionModel("rig", default_probe(), default_stage()))
    z, sigmas, right, units = defaultdict(list), defaultdict(list), defaultdict(list), {}
    for number in range(options.rigs):
        rng = np.random.default_rng((options.seed, number))
        drawn = draw_rig(rng)
        with tempfile.TemporaryDirectory() as folder:
            paths = write_recordings(Path(folder), drawn.rig, rng)
            found = [one.found for one in find_constants(paths, config)]
        for one in found:
            if one.sigma is None:
                right[one.name].append(one.value == drawn.truth[one.name])
            else:
                relative = drawn.truth[one.name] if one.name.endswith("threshold") else 1.0
                z[one.name].append((float(one.value) - float(drawn.truth[one.name])) / one.sigma)
                sigmas[one.name].append(one.sigma / relative)
                units[one.name] = "of it" if one.name.endswith("threshold") else one.unit
    print("| constant | values | 1 sigma, median | RMS error, sigmas | within 3 sigmas |\n|---|---:|---:|---:|---:|")
    for name, values in z.items():
        rms, within = math.sqrt(np.mean(np.square(values))), np.mean(np.abs(values) <= 3.0)
        print(f"| {name} | {len(values)} | {np.median(sigmas[name]):.3g} {units[name]} | {rms:.2f} | {within:.0%} |")
    every = np.concatenate(list(z.values()))
    print(f"| all | {every.size} | | {math.sqrt(np.mean(every**2)):.2f} | {np.mean(np.abs(every) <= 3.0):.1%} |")
    for name in SIGNS:
        print(f"{name}: right in {sum(right[name])} of {len(right[name])}")


if __name__ == "__main__":
    main()
