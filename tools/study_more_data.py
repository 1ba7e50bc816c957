"""What more than beams and arcs brings: the same sessions solved with and without it, against their own bounds.

    python tools/study_more_data.py spots --sessions 300
    python tools/study_more_data.py spots --sessions 300 --pairs 6 10 15 --sweeps window --distance 85
    python tools/study_more_data.py points --sessions 300

Labs whose constants are drawn from their declared ``systematic``, 12 aims, published noise (0.8 mm in depth and 0.6 deg
of the marker) or that of frames. ``spots``: the pixels of each PM's visible spot in both views, 0.5 px each, the sound
coming from 0.3, 0.3, 1 mm (1 sigma) about it. ``points``: three known points, which camera and scanner locate to
0.5 mm per axis each.

Columns: RMS error at the targets without and with, over that of the Cramer-Rao bound of the respective model
(tools/cramer_rao_bound.py) and by itself; share of targets within their stated 95 % bound.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import fgreg
from fgreg.simulation.config import SimulationConfig, Sweep
from fgreg.simulation.deviations import drawn_deviations
from fgreg.simulation.simulate import SimulatedSession, simulate
from fgreg.simulation.write import write_session
from study_pool import add_pool_options, pool_of
from study_systematics import Outcome, outcome, root_ratio, share
from systematic_cells import NOISES, POSES, Cell

SWEEPS = {"window": Sweep.WINDOW, "first-hit": Sweep.ALTERNATING, "two-sided": Sweep.TWO_SIDED}
LIMIT_MM = 20.0
"""Of the verdict: what is refused is ambiguous or contradicts itself, not merely uncertain."""
BEYOND = 70.0
"""Where the scope stands, mm: the markers begin so much nearer than the tissue."""


@dataclass(frozen=True, slots=True)
class Job:
    """One session, with and without."""

    data: str
    noise: str
    sweep: str
    pairs: int
    distance_mm: float
    seed: int

    @property
    def config(self) -> SimulationConfig:
        """With the data."""
        noise = NOISES[self.noise]
        rng = np.random.default_rng([self.seed, self.pairs])
        base = replace(
            POSES,
            pairs=self.pairs,
            tracks_heard=0,
            tracks_silent=0,
            noise=noise,
            beam_offset_mm=noise.beam_offset_mm,
            edge_jitter_rad=noise.window_rad,
            sweep=SWEEPS[self.sweep],
            camera_declared=True,
            camera_distance_mm=(self.distance_mm - 10.0, self.distance_mm + 10.0),
            marker_distance_mm=(max(self.distance_mm - BEYOND, 25.0), self.distance_mm + 45.0),
            spots=self.data == "spots",
            points=3 if self.data == "points" else 0,
            check_sigma_mm=(0.5, 0.5),
        )
        sigmas = base.systematic.sigmas(base.probe.sensitivity.edge_sigma_rad, noise.marker_bias_mm)
        return replace(base, deviations=drawn_deviations(sigmas, rng))


def run(job: Job) -> tuple[Outcome, Outcome]:
    """One session solved without the data and with it."""
    warnings.simplefilter("ignore")
    simulated = simulate(job.config, job.seed)
    events = [{k: v for k, v in event.items() if k != "spot"} for event in simulated.events if event["type"] != "point"]
    less = replace(simulated, events=events)
    return _solved(less, job), _solved(simulated, job)


def _solved(simulated: SimulatedSession, job: Job) -> Outcome:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session"
        write_session(simulated, path)
        (path / "ground_truth.yaml").unlink()
        report = fgreg.solve(path, fgreg.SolveConfig(limit_mm=LIMIT_MM))
    return outcome(Cell("drawn", job.noise, job.pairs), job.seed, simulated, report, 0.0)


def _row(pairs: int, sweep: str, both: Sequence[tuple[Outcome, Outcome]]) -> str:
    refused = [sum(one.verdict == "refused" for one in column) for column in zip(*both, strict=True)]
    cells = [str(pairs), sweep, str(len(both)), f"{refused[0]}, {refused[1]}"]
    # Ambiguous sessions are refused, and either minimum may be the true one.
    kept = [pair for pair in both if all(math.isfinite(one.true2) and one.verdict != "refused" for one in pair)]
    columns = [*zip(*kept, strict=True)]
    true2 = [np.array([one.true2 for one in column]) for column in columns]
    least2 = [np.array([one.least2 for one in column]) for column in columns]
    for k in range(2):
        cells.append(f"{math.sqrt(true2[k].mean()):.2f}")
        cells.append(f"{math.sqrt(least2[k].mean()):.2f}")
        cells.append(root_ratio(true2[k], least2[k]).text(percent=False))
        cells.append(f"{share(np.array([one.targets_in for one in columns[k]])).text(percent=True)}")
    cells.append(root_ratio(true2[1], true2[0]).text(percent=False))
    cells.append(root_ratio(least2[1], least2[0]).text(percent=False))
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", choices=["spots", "points"], help="what is added")
    parser.add_argument("--sessions", type=int, default=100, help="of each row")
    parser.add_argument("--seed", type=int, default=0, help="number of the first session")
    parser.add_argument("--pairs", type=int, nargs="+", default=[10, 15])
    parser.add_argument("--sweeps", nargs="+", choices=SWEEPS, default=["window", "first-hit"])
    parser.add_argument("--noise", choices=NOISES, default="published")
    parser.add_argument("--distance", type=float, default=120.0, help="camera to tissue, mm")
    add_pool_options(parser)
    args = parser.parse_args()
    head = ["without: error, mm", "bound", "ratio", "targets in"]
    heads = ["pairs", "sweeps", "sessions", "refused", *head, *(h.replace("without", "with") for h in head)]
    heads += ["error, with over without", "bound, with over without"]
    print("| " + " | ".join(heads) + " |\n|" + " ---: |" * len(heads))
    with pool_of(args) as pool:
        for sweep in args.sweeps:
            for pairs in args.pairs:
                seeds = range(args.seed, args.seed + args.sessions)
                jobs = [Job(args.data, args.noise, sweep, pairs, args.distance, seed) for seed in seeds]
                print(_row(pairs, sweep, list(pool.map(run, jobs))), flush=True)


if __name__ == "__main__":
    main()
