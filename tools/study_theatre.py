"""What to expect of a session in a theatre: yield, honesty of the poses, error and verdict, one disturbance at a time.

Simulates sessions of the preset theatre (14 aims, 15 pairs, colour pictures) with one disturbance at one level and no
other, then with all of the preset, detects in their pictures and solves. The scanner's side is not disturbed: x and
range are read with the documented noise. Printed for each row:

  found        markers found, of all aims and pairs; aims lost because their board was not found are counted apart
  NEES         mean squared Mahalanobis error of the marker's pose over its 6 dimensions (1 expected), with standard
               error; how many poses exceed 5, and the largest
  sigma, error of the marker's pose, median: stated turn (deg) and shift (mm), true turn and shift
  worst target largest of the sessions' true errors at the worst target, with the stated 95 % bound of that session
  beyond       sessions whose true error exceeds their bound, and twice their bound
  verdicts     ok, warning, refused; wrong: ok, but off by more than twice the bound (0 expected)

Example:
  nice python tools/study_theatre.py --sessions 2
  python tools/study_theatre.py --sessions 1 --only smoke,theatre --json theatre.json
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.detection.results import BoardFit, MarkerFit, marker_covariance
from fgreg.geometry.transforms import inverse, transform_points
from fgreg.model.estimate import Verdict
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.solve import solve
from fgreg.schema.yaml_writer import yaml_text
from fgreg.session.session_reader import read_session
from fgreg.simulation.disturbances import Disturbances
from fgreg.simulation.presets import THEATRE
from fgreg.simulation.simulate import simulate
from study_pictures import pose_error

ROWS: dict[str, Disturbances] = {
    "clean": Disturbances(),
    "smoke 0.3": Disturbances(smoke=0.3),
    "smoke 0.6": Disturbances(smoke=0.6),
    "smoke 0.8": Disturbances(smoke=0.8),
    "blood 1": Disturbances(blood=1),
    "blood 3": Disturbances(blood=3),
    "blood 6": Disturbances(blood=6),
    "drops 1": Disturbances(drops=1),
    "drops 3": Disturbances(drops=3),
    "specular 1": Disturbances(specular=1.0),
    "specks 3": Disturbances(specks=3),
    "MJPEG 80": Disturbances(jpeg_quality=80),
    "MJPEG 50": Disturbances(jpeg_quality=50),
    "MJPEG 25": Disturbances(jpeg_quality=25),
    "hand 20 mm/s": Disturbances(hand_mm_s=20.0),
    "fields 5 mm/s": Disturbances(hand_mm_s=5.0, field_hz=50.0),
    "fields 20 mm/s": Disturbances(hand_mm_s=20.0, field_hz=50.0),
    "fields 50 mm/s": Disturbances(hand_mm_s=50.0, field_hz=50.0),
    "one field 20 mm/s": Disturbances(hand_mm_s=20.0, field_hz=50.0, deinterlace=True),
    "video curve": Disturbances(video_curve=True),
    "exposure 1.5": Disturbances(exposure=1.5),
    "exposure 2.5": Disturbances(exposure=2.5),
    "theatre": THEATRE.disturbances,
}
LARGE_NEES = 5.0


def session_figures(what: Disturbances, seed: int) -> dict[str, Any]:
    """The figures of one session."""
    config = replace(THEATRE, tracks_heard=0, tracks_silent=0, disturbances=what)
    simulated = simulate(config, seed)
    heard = simulate(replace(config, frames=False), seed)  # the same shots
    events = [
        event | ({"trus": other["trus"]} if "trus" in event else {})
        for event, other in zip(simulated.events, heard.events, strict=True)
    ]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "frames").mkdir()
        document = simulated.session
        document["probe"].pop("channels")
        (folder / "session.yaml").write_text(yaml_text(document), encoding="utf-8")
        (folder / "events.jsonl").write_text("".join(json.dumps(e) + "\n" for e in events), encoding="utf-8")
        for path, frame in simulated.frames.items():
            if path.endswith(".png"):
                cv2.imwrite(str(folder / path), frame(), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        session = read_session(folder)
        extracted = extract_measurements(session.events, session.model)
    out: dict[str, Any] = {"seed": seed, "shots": len(extracted.markers), "found": 0, "poses": []}
    out["boards_lost"] = sum(not isinstance(fit, BoardFit) for fit in extracted.boards.values())
    out["reasons"] = dict(Counter(reason.split(",")[0] for reason in extracted.unused.values()))
    for index, fit in extracted.markers.items():
        if isinstance(fit, MarkerFit):
            out["found"] += 1
            covariance = marker_covariance(fit, extracted.marker_noise)
            error = pose_error(simulated.true_camera_T_marker[index], fit.camera_T_marker)
            sizes = [float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))]
            sigmas = [float(np.sqrt(np.trace(covariance[:3, :3]))), float(np.sqrt(np.trace(covariance[3:, 3:])))]
            nees = float(error @ np.linalg.solve(covariance, error)) / 6.0
            out["poses"].append({"event": index, "nees": nees, "error": sizes, "sigma": sigmas})
    solution = solve(extracted.measurements, [], session.model, SolveConfig())
    epoch = solution.epochs[0]
    out["verdict"], out["verdict_reasons"] = solution.verdict.value, list(solution.reasons)
    out["worst_mm"] = out["bound_mm"] = None
    if epoch.trus_T_camera is not None and epoch.predicted_tre is not None:
        targets = session.model.targets_mm
        camera_p = transform_points(inverse(simulated.scene.trus_T_camera[0]), targets)
        off = np.linalg.norm(transform_points(epoch.trus_T_camera, camera_p) - targets, axis=1)
        out["worst_mm"], out["bound_mm"] = float(off.max()), epoch.predicted_tre.worst_mm
    return out


def row_text(name: str, sessions: list[dict[str, Any]]) -> str:
    """One line of the table."""
    shots, found = (sum(s[key] for s in sessions) for key in ("shots", "found"))
    boards = sum(s["boards_lost"] for s in sessions)
    poses = [pose for s in sessions for pose in s["poses"]]
    text = f"{name:18}{100 * found / shots:6.1f} %{boards:4d}"
    if poses:
        nees = np.array([pose["nees"] for pose in poses])
        se = nees.std() / math.sqrt(len(nees))
        text += f"{nees.mean():9.2f} +- {se:<5.2f}{int((nees > LARGE_NEES).sum()):4d}{nees.max():8.1f}  "
        sigma, error = (np.median([pose[key] for pose in poses], axis=0) for key in ("sigma", "error"))
        text += f"{math.degrees(sigma[0]):7.3f}{sigma[1]:7.3f}{math.degrees(error[0]):7.3f}{error[1]:7.3f}"
    solved = [s for s in sessions if s["worst_mm"] is not None]
    if solved:
        worst = max(solved, key=lambda s: s["worst_mm"] / s["bound_mm"])
        over = (
            sum(s["worst_mm"] > s["bound_mm"] for s in solved),
            sum(s["worst_mm"] > 2 * s["bound_mm"] for s in solved),
        )
        text += f"{worst['worst_mm']:7.2f}{worst['bound_mm']:7.2f}{over[0]:4d}{over[1]:3d}"
    wrong = sum(s["verdict"] == "ok" and s["worst_mm"] > 2 * s["bound_mm"] for s in solved)
    verdicts = Counter(s["verdict"] for s in sessions)
    return text + "  " + "".join(f"{verdicts[verdict.value]:4d}" for verdict in Verdict) + f"{wrong:5d}"


def main() -> None:
    """Run the rows asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=2, help="sessions of 29 shots a row (default 2)")
    parser.add_argument("--seed", type=int, default=1, help="of the first session (default 1)")
    parser.add_argument("--only", default="", help="rows whose names start with one of these, comma separated")
    parser.add_argument("--json", type=Path, help="write all figures here")
    arguments = parser.parse_args()
    chosen = {name: what for name, what in ROWS.items() if name.startswith(tuple(arguments.only.split(",")))}
    if not chosen or arguments.sessions < 1:
        parser.error(f"expected --sessions of 1 or more, and --only of {', '.join(ROWS)}")
    print("                  markers boards pose NEES                     sigma, median  error, median  worst target")
    print("                   found   lost  (1 expected)   > 5  largest    deg    mm    deg    mm  error bound > 1x 2x")
    print(
        "                                                               ... and sessions ok, warning, refused; wrong ok"
    )
    out: dict[str, Any] = {}
    for name, what in chosen.items():
        seeds = range(arguments.seed, arguments.seed + arguments.sessions)
        out[name] = [session_figures(what, seed) for seed in seeds]
        print(row_text(name, out[name]), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(out, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
