"""Verdicts of mixed simulated sessions, good and bad, against their truth.

Two thirds of the sessions have something wrong, of these kinds in turn:

  few pairs          3 to 7 pairs                      parallel beams   within 0.5 to 3 deg of one direction
  collinear spots    all on one line                   no roll          aims and pairs without roll about the beam
  wrong noise        2 to 5 times what is declared     outlier pairs    20 to 60 % of the PMs are outliers
  flipped marker     10 to 50 % of the pairs and aims have the mirrored planar pose
  swapped marker     the pairs' marker is another rigid body than the aims'
  sweep sign         every sweep is recorded the other way round, in a two-way session
  reversed stage     wired with the other sign than the session states
  sound speed        2 % off                           one-way          all sweeps from one side

The other third is clean: 6 to 40 pairs, 8 to 20 aims, first hits from both sides or the window only. Noise is as
documented. Printed: verdicts against the true error at the worst target, by kind, and

  caught     of sessions whose true worst-target error exceeds twice the limit, those not `ok`       (at least 99 %)
  accepted   of clean sessions whose 95 % error at the worst target (bound at the truth) is below the limit, those `ok`
             (at least 90 %)
  one-way    sessions that are `ok` (none)

The bound at the truth: the 95 % quantile, largest over the targets, of the error of a Gaussian whose covariance is the
inverse of the Hessian at the true registration, beam and window edge. Sessions that break these are listed by seed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import (
    FloatArray,
    as_float_array,
    exp_so3,
    hat,
    inverse,
    make_transform,
    transform_points,
)
from fgreg.graph.packing import pack
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_graph import evaluate
from fgreg.graph.reduced_system import refine
from fgreg.graph.shared_state import make_state
from fgreg.model.estimate import Verdict
from fgreg.model.measurements import MarkerObservation, Measurements
from fgreg.model.session_model import NoiseModel, SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.solve import solve
from fgreg.session.ground_truth import GroundTruth
from fgreg.session.session_reader import read_ground_truth, read_session
from fgreg.simulation.config import SimulationConfig, Sweep
from fgreg.simulation.presets import FIRST_HIT
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session
from study_pool import add_pool_options, pool_of

BAD = (
    "few pairs",
    "parallel beams",
    "collinear spots",
    "no roll",
    "wrong noise",
    "outlier pairs",
    "flipped marker",
    "swapped marker",
    "sweep sign",
    "reversed stage",
    "sound speed",
    "one-way",
)


@dataclass(frozen=True)
class Outcome:
    """One session: its kind, error of the result (mm, worst target), and verdict."""

    seed: int
    kind: str
    verdict: str
    worst_mm: float
    bound_mm: float
    predicted_mm: float
    reasons: tuple[str, ...]


def configuration(kind: str, rng: np.random.Generator) -> SimulationConfig:
    """The simulated session of a kind, before its measurements are changed."""
    base = replace(
        FIRST_HIT,
        pairs=int(rng.integers(10, 31)),
        aims=int(rng.integers(10, 17)),
        tracks_heard=0,
        tracks_silent=0,
        sweep=Sweep.WINDOW if rng.uniform() < 0.25 else Sweep.ALTERNATING,
    )
    match kind:
        case "clean":
            return replace(base, pairs=int(rng.integers(6, 41)), aims=int(rng.integers(8, 21)))
        case "few pairs":
            return replace(base, pairs=int(rng.integers(3, 8)))
        case "parallel beams":
            return replace(base, beam_tilt_rad=math.radians(rng.uniform(0.5, 3.0)))
        case "collinear spots":
            return replace(base, collinear=True)
        case "no roll":
            return replace(base, beam_roll_rad=0.01, aim_roll_rad=0.01)
        case "wrong noise":
            factor = float(rng.uniform(2.0, 5.0))
            true = NoiseModel()
            return replace(base, noise=scaled(true, factor), declared_noise=true)
        case "outlier pairs":
            return replace(base, outlier_pairs=round(float(rng.uniform(0.2, 0.6)) * base.pairs))
        case "sweep sign":
            return replace(base, sweep=Sweep.ALTERNATING)
        case "reversed stage":
            return replace(base, reversed_stage=True)
        case "sound speed":
            factor = 1.02 if rng.uniform() < 0.5 else 0.98
            return replace(base, deviations={Constant.SOUND_SPEED: factor - 1.0})
        case "one-way":
            return replace(base, sweep=Sweep.ONE_WAY)
        case _:
            return base


def scaled(noise: NoiseModel, factor: float) -> NoiseModel:
    """All standard deviations times a factor."""

    def three(values: tuple[float, float, float]) -> tuple[float, float, float]:
        return (factor * values[0], factor * values[1], factor * values[2])

    return NoiseModel(
        three(noise.marker_translation_mm),
        three(noise.marker_rotation_rad),
        noise.marker_bias_mm,
        three(noise.aim_mm),
        factor * noise.lateral_mm,
        factor * noise.range_mm,
        factor * noise.scan_rad,
    )


def flipped(marker: MarkerObservation) -> MarkerObservation:
    """The tag's other planar pose: its normal reflected to the other side of the line of sight."""
    pose = marker.camera_T_marker.copy()
    sight = pose[:3, 3] / np.linalg.norm(pose[:3, 3])
    normal = pose[:3, 2] if pose[:3, 2] @ sight >= 0 else -pose[:3, 2]
    axis = np.cross(normal, sight)
    sine = float(np.linalg.norm(axis))
    pose[:3, :3] = exp_so3(axis / max(sine, 1e-12) * 2.0 * math.atan2(sine, float(normal @ sight))) @ pose[:3, :3]
    return replace(marker, camera_T_marker=as_float_array(pose, 4, 4))


def spoiled(kind: str, measurements: Measurements, rng: np.random.Generator) -> Measurements:
    """The measurements as changed for a kind of session."""
    pairs, aims = list(measurements.pairs), list(measurements.aims)
    if kind == "flipped marker":
        share = float(rng.uniform(0.1, 0.5))
        for i in rng.permutation(len(pairs))[: math.ceil(share * len(pairs))]:
            pairs[i] = replace(pairs[i], marker=flipped(pairs[i].marker))
        for i in rng.permutation(len(aims))[: round(min(share, 0.3) * len(aims))]:
            aims[i] = replace(aims[i], marker=flipped(aims[i].marker))
    elif kind == "swapped marker":
        big = rng.uniform() < 0.5
        turn = exp_so3(rng.normal(size=3) * (1.0 if big else 0.15))
        other_T_marker = make_transform(turn, rng.normal(size=3) * (15.0 if big else 5.0))
        pairs = [
            replace(
                p, marker=replace(p.marker, camera_T_marker=as_float_array(p.marker.camera_T_marker @ other_T_marker))
            )
            for p in pairs
        ]
    elif kind == "sweep sign":
        pairs = [replace(p, look=replace(p.look, sweep=-p.look.sweep)) for p in pairs]
    return replace(measurements, pairs=tuple(pairs), aims=tuple(aims))


def bound_mm(measurements: Measurements, model: SessionModel, truth: GroundTruth) -> float:
    """The 95 % error at the worst target by the Hessian at the truth."""
    if truth.marker_T_laser is None:
        raise SystemExit("no beam in the truth")
    problem = pack(measurements, model)
    state = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
    private = initial_private(problem, state)
    for _ in range(3):
        private = refine(problem, state, private)
    hessian = evaluate(problem, state, private).hessian[0]
    if np.linalg.cond(hessian / np.sqrt(np.outer(np.diag(hessian), np.diag(hessian)))) > 1e10:
        return math.inf
    pose = np.linalg.inv(hessian)[:6, :6]
    steps = np.random.default_rng(0).multivariate_normal(np.zeros(6), pose, 4000, method="cholesky")
    camera_p = transform_points(inverse(truth.trus_T_camera[0]), model.targets_mm)
    move = np.concatenate([-hat(camera_p), np.broadcast_to(np.eye(3), (len(camera_p), 3, 3))], axis=-1)
    error = np.linalg.norm(np.einsum("nij,sj->sni", move, steps), axis=-1)
    return float(np.quantile(error, 0.95, axis=0).max())


def worst_error_mm(trus_T_camera: FloatArray, truth: GroundTruth, targets_mm: FloatArray) -> float:
    """True error at the worst target."""
    camera_p = transform_points(inverse(truth.trus_T_camera[0]), targets_mm)
    return float(np.linalg.norm(transform_points(trus_T_camera, camera_p) - targets_mm, axis=1).max())


def run(job: tuple[int, str, float]) -> Outcome:
    """One session, start to end."""
    seed, kind, limit_mm = job
    rng = np.random.default_rng([seed, 7])
    config = SolveConfig(limit_mm=limit_mm)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session"
        write_session(simulate(configuration(kind, rng), seed), path)
        session, truth = read_session(path), read_ground_truth(path)
        measurements = extract_measurements(session.events, session.model).measurements
    if truth is None:
        raise SystemExit("no truth in the session")
    solution = solve(spoiled(kind, measurements, rng), [], session.model, config)
    epoch = solution.epochs[0]
    worst = math.inf
    if epoch.trus_T_camera is not None:
        worst = worst_error_mm(epoch.trus_T_camera, truth, session.model.targets_mm)
    return Outcome(
        seed,
        kind,
        solution.verdict.value,
        worst,
        bound_mm(measurements, session.model, truth) if kind == "clean" else math.nan,
        math.inf if epoch.predicted_tre is None else epoch.predicted_tre.worst_mm,
        solution.reasons,
    )


def share(part: int, whole: int) -> str:
    return f"{part} of {whole}" + (f" ({part / whole:.1%})" if whole else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0, help="of the first session; the others follow")
    add_pool_options(parser)
    parser.add_argument("--limit-mm", type=float, default=3.0)
    parser.add_argument("--kind", choices=("clean", *BAD), help="this kind only")
    parser.add_argument("--reasons", action="store_true", help="print how often each condition was met, by kind")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    seeds = range(args.seed, args.seed + args.sessions)
    jobs = [
        (
            seed,
            args.kind or ("clean" if seed % 3 == 0 else BAD[(seed // 3 * 2 + seed % 3 - 1) % len(BAD)]),
            args.limit_mm,
        )
        for seed in seeds
    ]
    outcomes = []
    with pool_of(args) as pool:
        for outcome in pool.map(run, jobs):
            outcomes.append(outcome)
            print(f"\r{len(outcomes)} of {len(jobs)}", end="", file=sys.stderr)
    print(file=sys.stderr)

    table: dict[str, Counter[str]] = defaultdict(Counter)
    for o in outcomes:
        wrong = "far off" if o.worst_mm > 2 * args.limit_mm else "off" if o.worst_mm > args.limit_mm else "good"
        table[o.kind][f"{wrong} {o.verdict}"] += 1
    heads = [f"{wrong} {verdict}" for wrong in ("good", "off", "far off") for verdict in Verdict]
    print("true error at the worst target: good (below the limit), off (up to twice), far off; and the verdict")
    print(f"{'':18s}" + "".join(f"{head:>16s}" for head in heads))
    for kind in ("clean", *BAD):
        if table[kind]:
            print(f"{kind:18s}" + "".join(f"{table[kind][head]:16d}" for head in heads))
    far = [o for o in outcomes if o.worst_mm > 2 * args.limit_mm]
    missed = [o for o in far if o.verdict == Verdict.OK]
    within = [o for o in outcomes if o.kind == "clean" and o.bound_mm < args.limit_mm]
    denied = [o for o in within if o.verdict != Verdict.OK]
    one_way = [o for o in outcomes if o.kind == "one-way"]
    one_way_ok = [o for o in one_way if o.verdict == Verdict.OK]
    print(f"caught: {share(len(far) - len(missed), len(far))}, target 99 %")
    print(f"accepted: {share(len(within) - len(denied), len(within))}, target 90 %")
    print(f"one-way ok: {share(len(one_way_ok), len(one_way))}, target 0")
    for title, listed in (("missed", missed), ("one-way but ok", one_way_ok), ("not accepted", denied)):
        for o in listed:
            print(
                f"{title}: seed {o.seed}, {o.kind}, true {o.worst_mm:.1f} mm, predicted {o.predicted_mm:.1f}, "
                f"bound {o.bound_mm:.1f}; {'; '.join(r[:110] for r in o.reasons)}"
            )
    if args.reasons:
        for kind in table:
            counted = Counter(" ".join(r.split()[:7]) for o in outcomes if o.kind == kind for r in o.reasons)
            print(kind, *(f"  {n} x {reason}" for reason, n in counted.most_common(8)), sep="\n")
    if args.json:
        figures = {
            "far_off": len(far),
            "missed": len(missed),
            "within_bound": len(within),
            "denied": len(denied),
            "one_way_ok": len(one_way_ok),
            "table": {kind: dict(row) for kind, row in table.items()},
        }
        print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
