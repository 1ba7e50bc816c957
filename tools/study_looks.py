"""Benefit of more information per shot: several looks with amplitudes, tracking, an estimated sound speed.

looks     sessions of first hits, and the same sessions with two more looks at each PM, 2 deg on each, and amplitudes
          (5 % noise, unknown peak): ratio of RMS target errors where each look has its own marker detection (target:
          at most 0.80) and where they share one (at most 0.95).
tracking  queries at PMs that the session does not have, answered from the session (of first hits, or of three looks
          with amplitudes at each PM) and from the true registration and beam: RMS angle errors and their ratio (target:
          at most 1.10 after three looks); with three looks, amplitudes and marker detections at most 0.5 deg.
speed     a sound speed 2 % off, with and without --estimate sound_speed, against sessions in which it is right (target:
          at most 10 % worse where estimated, detected where not), without and with wavefronts that give it to 0.3 %.

    python tools/study_looks.py looks tracking --sessions 200
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, inverse, transform_points
from fgreg.graph.shared_state import make_state
from fgreg.model.measurements import Measurements, Pair, Track, Wavefront
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.posterior import target_errors
from fgreg.registration.posterior_mean import PosteriorMean, posterior_mean
from fgreg.registration.register import register
from fgreg.tracking.query import track
from fgreg.tracking.snapshot import make_snapshot
from study_pool import Pool, add_pool_options, pool_of

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))
from tests.forward import Truth, make_measurements, make_session

LADDER = {"looks_per_pm": 3, "look_spacing_deg": 2.0, "amplitude_noise": 0.05}
Row = dict[str, list[float]]


def solved(measurements: Measurements, model: SessionModel, config: SolveConfig | None = None) -> PosteriorMean:
    config = config or SolveConfig()
    return posterior_mean(register(measurements, model, config), config)


def errors(found: PosteriorMean, truth: Truth, model: SessionModel) -> tuple[float, float]:
    """Mean squared target error, and its posterior expectation, mm^2."""
    camera_p = transform_points(inverse(truth.trus_T_camera[0]), model.targets_mm)
    moved = transform_points(found.posterior.mean.trus_T_camera()[0], camera_p) - model.targets_mm
    expected = found.posterior.weight @ target_errors(found.posterior, 0, model.targets_mm) ** 2
    return float(np.mean(np.sum(moved**2, axis=1))), float(np.mean(expected))


def first_looks(measurements: Measurements) -> Measurements:
    """The session with one look at each PM and without amplitudes."""
    first: dict[int, Pair] = {}
    for pair in measurements.pairs:
        first.setdefault(pair.pm, replace(pair, look=replace(pair.look, amplitude=None)))
    return replace(measurements, pairs=tuple(first.values()))


def looks(pairs: int, seed: int) -> Row:
    warnings.simplefilter("ignore")
    out: Row = {}
    for kind, shared in (("own", False), ("shared", True)):
        model, measurements, truth = make_measurements(
            np.random.default_rng([1, shared, seed]),
            pairs=pairs,
            session=make_session(curve=True),
            share_marker=shared,
            **LADDER,  # type: ignore[arg-type]
        )
        for name, of in (("one", first_looks(measurements)), ("three", measurements)):
            actual, expected = errors(solved(of, model), truth, model)
            out[f"{kind} {name} actual"], out[f"{kind} {name} expected"] = [actual], [expected]
    return out


def tracking(pairs: int, seed: int) -> Row:
    out: Row = {}
    sessions: dict[str, dict[str, object]] = {"": {}, "after 3 looks: ": dict[str, object](LADDER)}
    for name, options in sessions.items():
        out |= {name + key: values for key, values in _tracked(pairs, seed, options).items()}
    return out


def _tracked(pairs: int, seed: int, taken: dict[str, object]) -> Row:
    """Squared angle errors (deg^2) of queries after a session with the options ``taken``."""
    warnings.simplefilter("ignore")
    queries, out = 6, Row()
    model, measurements, truth = make_measurements(
        np.random.default_rng([2, seed]),
        pairs=pairs,
        session=make_session(curve=True),
        **taken,  # type: ignore[arg-type]
    )
    found = solved(measurements, model)
    state, covariance = found.registration.optimum.state, found.registration.covariance
    there = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)
    there.constants[:, Constant.WINDOW_EDGE] = truth.window_edge_rad
    session, exact = (
        make_snapshot(
            model,
            SolveConfig(),
            at,
            spread,
            found.posterior.columns,
            (0,),
            origin_shift_mm=0.0,
            surface=None,
            causal=False,
        )
        for at, spread in ((state, covariance), (there, 1e-12 * np.eye(len(covariance))))
    )
    kinds: dict[str, dict[str, object]] = {
        "window look": {"first_hit": False},
        "first hit": {},
        "3 looks, one marker": dict[str, object](LADDER, share_marker=True),
        "3 looks, 3 markers": dict[str, object](LADDER),
    }
    for kind, options in kinds.items():
        _, asked, at = make_measurements(
            np.random.default_rng([3, seed]),
            aims=0,
            pairs=queries,
            session=model,
            marker_T_laser=truth.marker_T_laser,
            trus_T_camera=truth.trus_T_camera[0],
            **options,  # type: ignore[arg-type]
        )
        for pm in range(queries):
            mine = [pair for pair in asked.pairs if pair.pm == pm]
            query = Track(0.0, 0, mine[0].marker, tuple(p.look for p in mine), None, tuple(p.marker for p in mine))
            bearing = math.atan2(at.trus_p_pm_mm[pm][1], at.trus_p_pm_mm[pm][2])
            for name, of in (("session", session), ("truth", exact)):
                reply = track(query, of)
                if reply.stage_rad is not None and reply.sigma_rad is not None:
                    out.setdefault(f"{kind} {name}", []).append(math.degrees(reply.stage_rad - bearing) ** 2)
                    out.setdefault(f"{kind} {name} z", []).append(((reply.stage_rad - bearing) / reply.sigma_rad) ** 2)
    return out


def speed(pairs: int, seed: int) -> Row:
    warnings.simplefilter("ignore")
    out, estimate = Row(), SolveConfig(estimate_sound_speed=True)
    for ratio in (1.0, 1.02):
        model, measurements, truth = make_measurements(
            np.random.default_rng([4, seed]), pairs=pairs, sound_speed_ratio=ratio
        )
        registration = register(measurements, model, SolveConfig())
        out[f"{ratio} taken as given"] = [errors(posterior_mean(registration, SolveConfig()), truth, model)[0]]
        out[f"{ratio} estimated"] = [errors(solved(measurements, model, estimate), truth, model)[0]]
        rng = np.random.default_rng([5, seed])
        heard = [Wavefront(ratio + 0.003 * float(rng.standard_normal()), 0.003) for _ in measurements.pairs]
        shots = zip(measurements.pairs, heard, strict=True)
        pairs_heard = tuple(replace(pair, look=replace(pair.look, wavefront=wave)) for pair, wave in shots)
        by_frames = register(replace(measurements, pairs=pairs_heard), model, estimate)
        out[f"{ratio} estimated, wavefronts"] = [errors(posterior_mean(by_frames, estimate), truth, model)[0]]
    return out


def collect(part: Callable[[int], Row], seeds: Iterable[int], pool: Pool) -> dict[str, FloatArray]:
    rows: Row = {}
    for done, row in enumerate(pool.map(part, seeds), 1):
        for key, values in row.items():
            rows.setdefault(key, []).extend(values)
        print(f"\r{done} sessions", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return {key: np.array(values) for key, values in rows.items()}


def rms(squares: FloatArray) -> float:
    return float(np.sqrt(squares.mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=["looks", "tracking", "speed"], metavar="PART")
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="number of the first session")
    parser.add_argument("--pairs", type=int, nargs="+", default=[10, 25])
    add_pool_options(parser)
    args = parser.parse_args()
    known = {"looks": looks, "tracking": tracking, "speed": speed}
    if not set(args.parts) <= set(known):
        parser.error("parts are looks, tracking, speed")
    seeds = range(args.seed, args.seed + args.sessions)
    with pool_of(args) as pool:
        for part in args.parts:
            for pairs in args.pairs:
                got = collect(partial(known[part], pairs), seeds, pool)
                print(f"{part}, {pairs} pairs, {args.sessions} sessions")
                for key, values in got.items():
                    if "noticed" in key:
                        print(f"  {key:34s} {values.mean():.3f} of sessions")
                    else:
                        print(f"  {key:34s} {rms(values):.3f}")
                if part == "looks":
                    for kind, most in (("own", 0.80), ("shared", 0.95)):
                        ratio = rms(got[f"{kind} three actual"]) / rms(got[f"{kind} one actual"])
                        expected = rms(got[f"{kind} three expected"]) / rms(got[f"{kind} one expected"])
                        print(f"  {kind}: ratio {ratio:.3f} (expected {expected:.3f}, at most {most})")
                if part == "tracking":
                    for key in [key for key in got if key.endswith("session")]:
                        ratio = rms(got[key]) / rms(got[key.replace("session", "truth")])
                        print(f"  {key.removesuffix(' session')}: ratio {ratio:.3f} (at most 1.10)")
                if part == "speed":
                    right = rms(got["1.0 taken as given"])
                    for key in ("1.02 taken as given", "1.02 estimated", "1.02 estimated, wavefronts"):
                        print(f"  {key}: {rms(got[key]) / right:.3f} of the right speed's error")
                sys.stdout.flush()


if __name__ == "__main__":
    main()
