"""What one new shot, and what a few check points, show of a registration that is no longer right.

Sessions of the simulator (which shares no code with the estimator), 12 aims, first detections from alternating sides.

verify   A registration (15 pairs at the noise of frames, 25 at the published one) against 1, 3 and 6 new shots: nothing
         changed; the camera shifted by 5 mm, in a random direction; turned by 3 deg about the middle of the targets,
         random axis. Shares of the four verdicts of ``fgreg verify``.
         Aims: false alarms 1 %; 5 mm shown by one shot in 90 % (frames) and 70 % (published).
checks   3 and 6 checks of 0.5 mm per axis (all errors), with nothing wrong and with 10 mm of water between fibre and
         tissue, which refracts the beam; also with looks from both sides. Shares of sessions in which the common shift
         is shown, in which any condition of the checks is missed, that name the line to the probe, and `ok`.
         Aims: false alarms 0.3 %; water shown in 75 % (frames, 3 checks), 90 % (two-sided, or 6), 50 % (published).

    python tools/study_verify.py verify checks --sessions 400 --jobs 2

Standard errors follow +-. Session k of a cell is the same whatever else is run.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

import fgreg
from fgreg.camera_moves.validity import Validity, verify
from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, make_transform, transform_points
from fgreg.model.measurements import Pair
from fgreg.model.session_model import NoiseModel
from fgreg.session.session_reader import read_session
from fgreg.simulation.config import SimulationConfig, Sweep
from fgreg.simulation.presets import FIRST_HIT
from fgreg.simulation.simulate import SimulatedSession, simulate
from fgreg.simulation.write import write_session
from study_pool import add_pool_options, pool_of

NOISES = {
    "frames": (NoiseModel((0.001, 0.001, 0.002), (5e-5, 5e-5, 5e-5), 0.0, (0.3, 0.3, 0.1), 0.26, 0.17), 15),
    "published": (NoiseModel(marker_bias_mm=0.1), 25),
}
"""Noise of poses from clean frames, and as published; pairs of the registration."""
SHOTS = (1, 3, 6)
SHIFT_MM, TURN_DEG, WATER_MM = 5.0, 3.0, 10.0
Counts = dict[str, int]


@dataclass(frozen=True, slots=True)
class Cell:
    """``study`` verify or checks; ``checks``, ``water`` and ``two_sided`` of the latter."""

    study: str
    noise: str
    checks: int = 0
    water: bool = False
    two_sided: bool = False

    @property
    def name(self) -> str:
        parts = [f"{NOISES[self.noise][1]} pairs, {self.noise}"]
        if self.study == "checks":
            parts += [f"{self.checks} checks", "10 mm of water" if self.water else "nothing wrong"]
        return ", ".join(parts + (["two-sided"] if self.two_sided else []))


def configuration(cell: Cell) -> SimulationConfig:
    noise, pairs = NOISES[cell.noise]
    more = max(SHOTS) if cell.study == "verify" else 0
    return replace(
        FIRST_HIT,
        pairs=pairs + more,
        tracks_heard=0,
        tracks_silent=0,
        noise=noise,
        sweep=Sweep.TWO_SIDED if cell.two_sided else Sweep.ALTERNATING,
        checks=cell.checks,
        water_mm=WATER_MM if cell.water else 0.0,
    )


def run(cell: Cell, seed: int) -> Counts:
    """One session: each outcome that it has, counted once."""
    warnings.simplefilter("ignore")
    simulated = simulate(configuration(cell), seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session"
        return checked(simulated, path) if cell.study == "checks" else verified(simulated, path, cell, seed)


def checked(simulated: SimulatedSession, path: Path) -> Counts:
    write_session(replace(simulated, events=[*simulated.events, *simulated.checks]), path)
    estimate = fgreg.solve(path).estimate
    texts = [reason for reason in estimate.reasons if "check" in reason and " mm" in reason]
    shift = [text for text in texts if "are off by" in text]
    return {
        "shift shown": bool(shift),
        "any condition of the checks": bool(texts),
        "line to the probe named": any("along the line to the probe" in text for text in shift),
        "ok": estimate.verdict is fgreg.Verdict.OK,
    }


def verified(simulated: SimulatedSession, path: Path, cell: Cell, seed: int) -> Counts:
    known = NOISES[cell.noise][1]
    held_out = [event for event in simulated.events if event["type"] == "pair" and event["pm"] >= known]
    write_session(replace(simulated, events=[e for e in simulated.events if e not in held_out]), path)
    report = fgreg.solve(path)
    snapshot, model, config = report.solution.snapshot, report.session.model, fgreg.SolveConfig()
    epoch = None if snapshot is None else snapshot.epoch(0)
    if snapshot is None or epoch is None or report.estimate.verdict is fgreg.Verdict.REFUSED:
        return {"refused": 1}
    (path / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in held_out))
    shots = extract_measurements(read_session(path).events, model).measurements.pairs
    counts: Counts = {}
    for change, new_T_old in moves(simulated.scene.trus_T_camera[0], model.targets_mm, seed).items():
        for count in SHOTS:
            pairs = [moved(pair, new_T_old) for pair in shots if pair.pm < known + count]
            found = verify(pairs, snapshot, epoch, model, config)
            counts[f"{change}, {count} new: {found.validity.value}"] = 1
            alarm = found.validity in (Validity.MOVED, Validity.DEGRADED)
            counts[f"{change}, {count} new: alarm"] = int(alarm)
    return counts


def moves(trus_T_camera: FloatArray, targets_mm: FloatArray, seed: int) -> dict[str, FloatArray]:
    """``camera_new_T_camera_old`` of each change."""
    rng = np.random.default_rng([11, seed])
    shift, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    middle = transform_points(inverse(trus_T_camera), targets_mm.mean(axis=0)[None])[0]
    turn = exp_so3(math.radians(TURN_DEG) * axis)
    return {
        "nothing": np.eye(4),
        "5 mm": make_transform(np.eye(3), SHIFT_MM * shift),
        "3 deg": make_transform(turn, middle - turn @ middle),
    }


def moved(pair: Pair, new_T_old: FloatArray) -> Pair:
    return replace(pair, marker=replace(pair.marker, camera_T_marker=new_T_old @ pair.marker.camera_T_marker))


def cells(studies: list[str]) -> Iterator[Cell]:
    for study in studies:
        for noise in NOISES:
            if study == "verify":
                yield Cell(study, noise)
                continue
            for two_sided in (False, True):
                for checks in (3, 6):
                    for water in (False, True):
                        yield Cell(study, noise, checks, water, two_sided)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("studies", nargs="*", choices=["verify", "checks"], default=["verify", "checks"])
    parser.add_argument("--sessions", type=int, default=400, help="per cell")
    parser.add_argument("--seed", type=int, default=0, help="number of the first session")
    add_pool_options(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON document at the end")
    args = parser.parse_args()
    results: dict[str, dict[str, tuple[float, float]]] = {}
    with pool_of(args) as pool:
        for cell in cells(args.studies):
            total: Counts = {}
            seeds = range(args.seed, args.seed + args.sessions)
            for done, counts in enumerate(pool.map(partial(run, cell), seeds), 1):
                for name, count in counts.items():
                    total[name] = total.get(name, 0) + int(count)
                if done % 20 == 0:
                    print(f"\r{cell.name}: {done} of {args.sessions}", end="", file=sys.stderr, flush=True)
            print(file=sys.stderr)
            n = args.sessions - total.pop("refused", 0)
            shares = {name: (count / n, math.sqrt(count / n * (1 - count / n) / n)) for name, count in total.items()}
            results[f"{cell.study}: {cell.name}"] = shares
            print(f"{cell.study}: {cell.name} ({n} sessions)")
            for name, (share, error) in sorted(shares.items()):
                print(f"  {name:<34} {100 * share:5.1f} +- {100 * error:.1f} %", flush=True)
    if args.json:
        print(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
