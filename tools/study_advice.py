"""Benefit of the advice: simulated surgeons who take their next shots as advised, or at random.

Every session starts with 4 random pairs of one look. Three surgeons go on to 10: two take the best of
`fgreg.registration.next_shot`'s candidates, one of them with looks from both sides at each, as advised by default, the
other with one look (`--one-look`); the third takes a random one of the candidates, with both looks. All have the same
errors: the beam passes the spot by --aim-mm and its direction is off by --lean-deg. Tissue, probe, stage and all noise
are those of the forward model; the end of a beam is its intersection with the tissue. A shot that ends outside the
probe's field is repeated.

Printed: root mean square TRE over sessions and targets at every number of pairs, all arms, and the ratio of advised to
random at 10 (target: at most 0.80).

    python tools/study_advice.py --sessions 100
    python tools/study_advice.py --sessions 100 --sweep window
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.errors import EstimationError
from fgreg.geometry.target_error import tre_mm
from fgreg.geometry.transforms import FloatArray, as_float_array, exp_so3, make_transform
from fgreg.model.measurements import Look, MarkerObservation, Measurements, Pair, default_marker_covariance
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.next_shot import advise
from fgreg.registration.register import Registration, register
from fgreg.session.session_reader import read_session
from fgreg.simulation import sweeps
from fgreg.simulation.config import SimulationConfig, Sweep
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.scene import Scene
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

FIRST, LAST = 4, 10
TRIES = 100


def where_it_ends(scene: Scene, trus_p: FloatArray, trus_d: FloatArray) -> FloatArray | None:
    """First point (3,) of a beam on the tissue; None where it misses."""
    along = np.linspace(0.0, 160.0, 3201)
    points = trus_p + along[:, None] * trus_d
    angle = np.arctan2(points[:, 1], points[:, 2])
    on_surface = scene.tissue.point(points[:, 0], angle)
    above = np.hypot(points[:, 1], points[:, 2]) - np.hypot(on_surface[:, 1], on_surface[:, 2])
    crossing = np.flatnonzero((above[:-1] > 0) & (above[1:] <= 0))
    if crossing.size == 0:
        return None
    i = int(crossing[0])
    return np.asarray(points[i] + above[i] / (above[i] - above[i + 1]) * (points[i + 1] - points[i]))


def take_shot(
    camera_T_marker: FloatArray,
    number: int,
    planes: tuple[int, ...],
    scene: Scene,
    config: SimulationConfig,
    model: SessionModel,
    rng: np.random.Generator,
) -> tuple[Pair, ...] | None:
    """The looks of a shot with the marker held there, by sweeps of the plane; None where it ends outside the field."""
    trus_T_laser = scene.trus_T_camera[0] @ camera_T_marker @ scene.marker_T_laser
    trus_p = where_it_ends(scene, trus_T_laser[:3, 3], trus_T_laser[:3, 2])
    if trus_p is None or abs(trus_p[0]) > 26.0 or abs(math.atan2(trus_p[1], trus_p[2])) > math.radians(48.0):
        return None
    noise = config.noise
    w = rng.standard_normal(3) * noise.marker_rotation_rad
    shift = rng.standard_normal(3) * noise.marker_translation_mm
    seen = make_transform(exp_so3(w) @ camera_T_marker[:3, :3], camera_T_marker[:3, 3] + shift)
    marker = MarkerObservation(
        as_float_array(seen), as_float_array(default_marker_covariance(seen, noise)), 5000 + number
    )
    pairs = []
    for plane in planes:
        kind = Sweep.ALTERNATING if plane else Sweep.WINDOW
        first = model.stage.direction * plane or 1
        heard = sweeps.look(replace(config, sweep=kind), trus_p[None], 1, first, scene.window_edge_rad, rng)
        scan, signed = float(heard.scan_rad[0, 0]), int(heard.device_sweep[0, 0])
        distance = float(config.array.range_mm(trus_p, np.asarray(scan)))
        look = Look(
            scan_rad=scan + noise.scan_rad * float(rng.standard_normal()),
            scan_sigma_rad=noise.scan_rad,
            x_mm=float(trus_p[0]) + noise.lateral_mm * float(rng.standard_normal()),
            range_mm=distance + noise.range_mm * float(rng.standard_normal()),
            covariance=as_float_array(np.diag([noise.lateral_mm**2, noise.range_mm**2])),
            sweep=model.stage.direction * signed,
        )
        pairs.append(Pair(1000.0 + number, 1000 + number, 0, marker, look))
    return tuple(pairs)


def misplaced(
    camera_T_marker: FloatArray, camera_p_spot: FloatArray, rng: np.random.Generator, aim_mm: float, lean_rad: float
) -> FloatArray:
    """The marker as a hand holds it for a wanted pose: rotated about the spot, with the spot missed."""
    turn = exp_so3(rng.standard_normal(3) * lean_rad)
    about = make_transform(turn, camera_p_spot - turn @ camera_p_spot + aim_mm * rng.standard_normal(3))
    return np.asarray(about @ camera_T_marker)


def go_on(
    start: Measurements,
    model: SessionModel,
    scene: Scene,
    config: SimulationConfig,
    rng: np.random.Generator,
    args: argparse.Namespace,
    advised: bool,
    both_sides: bool,
) -> list[FloatArray]:
    """One surgeon's errors (n,) at the targets with 4, 5, ... 10 pairs."""
    settings = SolveConfig()
    now = start
    errors = []
    found: Registration = register(now, model, settings)
    for number in range(FIRST, LAST + 1):
        errors.append(tre_mm(found.optimum.state.trus_T_camera()[0], scene.trus_T_camera[0], model.targets_mm))
        if number == LAST:
            break
        advice = advise(found, both_sides=both_sides)
        candidates = advice.candidates
        shot = None
        for attempt in range(TRIES):
            # After a miss the surgeon takes the next of the list.
            within = min(1 + attempt * attempt, len(advice.order)) if advised else len(advice.order)
            pick = advice.order[rng.integers(within)]
            held = misplaced(
                candidates.camera_T_marker[pick],
                candidates.camera_p_spot_mm[pick],
                rng,
                args.aim_mm,
                math.radians(args.lean_deg),
            )
            shot = take_shot(held, number, candidates.sweeps, scene, config, model, rng)
            if shot is not None:
                break
        if shot is None:
            raise SystemExit("no shot ends in the probe's field")
        now = replace(now, pairs=(*now.pairs, *shot))
        found = register(now, model, settings)
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1, help="of the first session; the others follow")
    parser.add_argument("--sweep", choices=["first-hit", "window"], default="first-hit", help="how PMs are found")
    parser.add_argument("--aim-mm", type=float, default=2.0, help="how far shots pass the spot (sigma per axis)")
    parser.add_argument("--lean-deg", type=float, default=3.0, help="how far beams lean off (sigma per axis)")
    parser.add_argument("--json", action="store_true", help="print one JSON document at the end")
    args = parser.parse_args()
    kind = Sweep.ALTERNATING if args.sweep == "first-hit" else Sweep.WINDOW
    config = replace(PRESETS["first-hit"], pairs=FIRST, tracks_heard=0, tracks_silent=0, sweep=kind)
    arms: dict[str, list[list[FloatArray]]] = {"advised": [], "one look": [], "random": []}
    with tempfile.TemporaryDirectory() as folder:
        for index in range(args.sessions):
            seed = args.seed + index
            simulated = simulate(config, seed)
            path = Path(folder) / str(index)
            write_session(simulated, path)
            session = read_session(path)
            start = extract_measurements(session.events, session.model).measurements
            for place, (arm, sessions) in enumerate(arms.items()):
                rng = np.random.default_rng([seed, place])
                try:
                    sessions.append(
                        go_on(
                            start,
                            session.model,
                            simulated.scene,
                            config,
                            rng,
                            args,
                            advised=arm != "random",
                            both_sides=arm != "one look",
                        )
                    )
                except EstimationError as error:
                    raise SystemExit(f"session {seed}, {arm}: {error}") from error
            ratio = table(arms)[LAST]["ratio"]
            print(f"\rsession {index + 1} of {args.sessions}, ratio up to now {ratio:.3f}", end="", file=sys.stderr)
    print(file=sys.stderr)
    figures = table(arms)
    print("pairs  advised, rms mm   one look   random   ratio   medians of session rms, mm")
    for pairs, row in figures.items():
        print(
            f"{pairs:5d} {row['advised']:16.2f} {row['one look']:10.2f} {row['random']:8.2f} {row['ratio']:7.2f}"
            f"   {row['advised_median']:.2f} {row['one look_median']:.2f} {row['random_median']:.2f}"
        )
    low, high = interval(arms, np.random.default_rng(0))
    print(f"ratio at {LAST} pairs {figures[LAST]['ratio']:.2f} (95 %: {low:.2f} to {high:.2f}); target at most 0.80")
    if args.json:
        print(json.dumps({"sessions": args.sessions, "ratio_95": [low, high], "rows": figures}, indent=2))


def _rms(sessions: list[list[FloatArray]], place: int) -> FloatArray:
    return np.array([math.sqrt(float(np.mean(session[place] ** 2))) for session in sessions])


def table(arms: dict[str, list[list[FloatArray]]]) -> dict[int, dict[str, float]]:
    """Figures by number of pairs."""
    out = {}
    for place, pairs in enumerate(range(FIRST, LAST + 1)):
        row: dict[str, float] = {}
        for arm, sessions in arms.items():
            errors = _rms(sessions, place)
            row[arm], row[f"{arm}_median"] = math.sqrt(float(np.mean(errors**2))), float(np.median(errors))
        out[pairs] = {**row, "ratio": row["advised"] / row["random"]}
    return out


def interval(arms: dict[str, list[list[FloatArray]]], rng: np.random.Generator) -> tuple[float, float]:
    """95 % interval of the ratio at the last number of pairs, by resampling sessions."""
    advised, random = (_rms(arms[arm], -1) ** 2 for arm in ("advised", "random"))
    picks = rng.integers(len(advised), size=(2000, len(advised)))
    ratio = np.sqrt(advised[picks].mean(axis=1) / random[picks].mean(axis=1))
    return float(np.quantile(ratio, 0.025)), float(np.quantile(ratio, 0.975))


if __name__ == "__main__":
    main()
