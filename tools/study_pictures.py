"""Yield and honesty of marker detection in pictures that are not clean.

Renders the pair and track shots of simulated sessions (preset phantom, 19 a session) with one disturbance at a time
(fgreg.simulation.disturbances), detects the marker, and prints for each disturbance, with standard errors: the share of
shots in which the marker is found, the mean NEES (squared Mahalanobis error of the pose over its 6 dimensions, 1
expected) with the corner noise pooled over the session, how many exceed 5 and the largest, median and 95 % errors, and
processor time. The truth is the rendered pose. Where a disturbance has a direction, each session has its own.

Example:
  nice python tools/study_pictures.py --sessions 3
  python tools/study_pictures.py --sessions 1 --only specks,stain --json pictures.json
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.detection.corner_noise import pool_corner_noise
from fgreg.detection.marker import detect_marker
from fgreg.detection.results import MarkerFit, marker_covariance
from fgreg.geometry.transforms import FloatArray, inverse, log_so3
from fgreg.simulation.disturbances import Disturbances
from fgreg.simulation.presets import PHANTOM
from fgreg.simulation.simulate import simulate

ROWS: dict[str, Disturbances] = {
    "clean": Disturbances(),
    "defocus 2 px": Disturbances(defocus_px=2.0),
    "defocus 4 px": Disturbances(defocus_px=4.0),
    "motion 3 px": Disturbances(motion_px=3.0),
    "motion 8 px": Disturbances(motion_px=8.0),
    "specks 1": Disturbances(specks=1),
    "specks 3": Disturbances(specks=3),
    "specks 8": Disturbances(specks=8),
    "stain": Disturbances(stains=1),
    "stains 2": Disturbances(stains=2),
    "glare 3": Disturbances(glare=3),
    "blood 4": Disturbances(blood=4),
    "smoke 0.5": Disturbances(smoke=0.5),
    "drops 2": Disturbances(drops=2),
    "noise x 4": Disturbances(noise_gain=4.0),
    "MJPEG 50": Disturbances(jpeg_quality=50),
    "interlaced 20 mm/s": Disturbances(field_hz=50.0, hand_mm_s=20.0),
    "wet and moving": Disturbances(motion_px=3.0, specks=2, blood=2, noise_gain=2.0, jpeg_quality=80),
}
LARGE_NEES = 5.0


def pose_error(true: FloatArray, found: FloatArray) -> FloatArray:
    """(6,) right tangent (first order in the translation)."""
    error = inverse(true) @ found
    return np.concatenate([log_so3(error[:3, :3]), error[:3, 3]])


def study(disturbances: Disturbances, sessions: int, seed: int) -> dict[str, Any]:
    """The figures of one disturbance."""
    shots = 0
    nees: list[float] = []
    errors: list[FloatArray] = []
    reasons: dict[str, int] = {}
    seconds = 0.0
    for number in range(sessions):
        turn = float(np.random.default_rng((seed, number)).uniform(0.0, math.pi))
        config = replace(PHANTOM, aims=0, disturbances=replace(disturbances, motion_rad=turn))
        session = simulate(config, seed + number)
        fits: list[tuple[FloatArray, MarkerFit]] = []
        for index, event in enumerate(session.events):
            if event["type"] not in ("pair", "track"):
                continue
            left, right = (session.frames[event["marker"][side]]() for side in ("left", "right"))
            start = time.process_time()
            fit = detect_marker(left, right, config.camera, config.marker)
            seconds += time.process_time() - start
            shots += 1
            if isinstance(fit, MarkerFit):
                fits.append((session.true_camera_T_marker[index], fit))
            else:
                reason = fit.reason.split(":")[1].split(",")[0].strip()
                reasons[reason] = reasons.get(reason, 0) + 1
        noise = pool_corner_noise(fit.pose for _, fit in fits)
        for true, fit in fits:
            error = pose_error(true, fit.camera_T_marker)
            errors.append(error)
            nees.append(float(error @ np.linalg.solve(marker_covariance(fit, noise), error)) / 6.0)
    xi = np.array(errors).reshape(-1, 6)
    rotation, translation = np.degrees(np.linalg.norm(xi[:, :3], axis=1)), np.linalg.norm(xi[:, 3:], axis=1)
    share = len(nees) / shots
    figures: dict[str, Any] = {
        "shots": shots,
        "found": share,
        "found_se": math.sqrt(max(share * (1.0 - share), 0.25 / shots) / shots),
        "ms": 1e3 * seconds / shots,
        "reasons": reasons,
    }
    if nees:
        figures |= {
            "nees": float(np.mean(nees)),
            "nees_se": float(np.std(nees) / math.sqrt(len(nees))),
            "nees_large": int(np.sum(np.array(nees) > LARGE_NEES)),
            "nees_largest": float(np.max(nees)),
            "rotation_deg": [float(np.quantile(rotation, q)) for q in (0.5, 0.95)],
            "translation_mm": [float(np.quantile(translation, q)) for q in (0.5, 0.95)],
        }
    return figures


def main() -> None:
    """Run the rows asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=3, help="sessions of 19 shots a row (default 3)")
    parser.add_argument("--seed", type=int, default=1, help="of the first session (default 1, as sessions/phantom)")
    parser.add_argument("--only", default="", help="rows whose names start with one of these, comma separated")
    parser.add_argument("--json", type=Path, help="write all figures here")
    arguments = parser.parse_args()
    chosen = {name: what for name, what in ROWS.items() if name.startswith(tuple(arguments.only.split(",")))}
    if not chosen or arguments.sessions < 1:
        parser.error(f"expected --sessions of 1 or more, and --only of {', '.join(ROWS)}")
    print("                 found, %        NEES (1 expected)  > 5  largest   rotation, deg    translation, mm     ms")
    print("                                                                   median   95 %     median   95 %")
    out: dict[str, Any] = {}
    for name, what in chosen.items():
        row = out[name] = study(what, arguments.sessions, arguments.seed)
        text = f"{name:16}{100 * row['found']:6.1f} +- {100 * row['found_se']:<4.1f}"
        if "nees" in row:
            text += f"{row['nees']:10.2f} +- {row['nees_se']:<6.2f}{row['nees_large']:5d}{row['nees_largest']:9.1f}"
            text += "{:9.4f}{:8.4f}  ".format(*row["rotation_deg"]) + "{:9.4f}{:8.4f}".format(*row["translation_mm"])
        print(f"{text}{row['ms']:8.1f}", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps({"seed": arguments.seed, "rows": out}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
