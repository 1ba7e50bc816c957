"""What a commissioning finds of a rig: how well each constant is known, whether its error bar is true, and whether a
control chart says pass where nothing has changed and alarm where something has.

Rigs are drawn from the declared standard deviations, all constants at once. Each has sessions of the simulator (which
shares no code with the estimator), of tools/study_systematics.py; they are commissioned from their folders. Then a new
session of the rig is solved with and without ``rig: rig.yaml``, and compared with it; so are new sessions in each of
which one thing has changed.

Printed: for each constant its prior, the standard deviation that remains, the RMS error in standard deviations (1 where
the bar is true), and whether sessions or prior hold it; NEES of all constants over their number; false notes and alarms
of sessions against the others; notes and alarms of changed sessions; error at the worst target, bound and share of
sessions whose bound holds, with and without the rig. Standard errors after +-.

    python tools/study_commission.py --rigs 20
    python tools/study_commission.py --rigs 20 --sessions 4 --noise published --pairs 25 --checks 3
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import fgreg
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.model.systematic import TEXTS, Systematic
from fgreg.pipeline.commission import check_session_against, commission_sessions
from fgreg.registration.commissioning import OBSERVED, OWN
from fgreg.simulation.config import SimulationConfig
from fgreg.simulation.deviations import deviations_of
from fgreg.simulation.simulate import SimulatedSession, simulate
from fgreg.simulation.write import write_session
from study_pool import add_pool_options, pool_of
from study_systematics import outcome
from systematic_cells import NOISES, Cell, configuration

CHANGES = {
    "tag 1 %": {"tag_size": 0.01},
    "tag 3 %": {"tag_size": 0.03},
    "sound speed 3 %": {"sound_speed": 0.03},
    "skew 1 deg": {"array_tilt_deg[1]": 1.0},
    "array 1 mm": {"array_offset_mm": 1.0},
    "window width 2 deg": {"edge_sigma_deg": 2.0},
    "radius 2 mm": {"radius_mm": 2.0},
}
"""What changes between the commissioning and a new session."""


@dataclass(frozen=True, slots=True)
class Job:
    """One rig to draw."""

    seed: int
    sessions: int
    noise: str
    pairs: int
    checks: int
    poses: bool


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Of one rig: arrays (K,) of its constants in the file's unit, verdicts, and errors of a new session.

    ``drawn``: chi square of the rig's constants by their priors, over their number, as ``nees`` is after commissioning.
    ``errors``: (true error, bound) at the worst target, without the rig and with it.
    """

    names: tuple[str, ...]
    prior: FloatArray
    sigma: FloatArray
    error: FloatArray
    nees: float
    drawn: float
    left_out: int
    own: tuple[str, ...]
    changed: dict[str, str]
    errors: tuple[tuple[float, float], ...]


def run(job: Job) -> Found:
    """Simulate and commission one rig."""
    warnings.simplefilter("ignore")
    cell = Cell("drawn-poses" if job.poses else "drawn", job.noise, job.pairs, two_sided=True)
    config = replace(configuration(cell, job.seed, Systematic()), checks=job.checks)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        paths = [root / f"s{k}" for k in range(job.sessions)]
        for k, path in enumerate(paths):
            _write(config, job.seed, k, path)
        report = commission_sessions(paths, root / "rig.yaml", use_checks=job.checks > 0)
        truth = np.array([config.deviations[constant] for constant in report.found.constants])
        error = report.found.value - truth
        charts = [one.chart for one in report.sessions]
        simulated = _write(config, job.seed, job.sessions, root / "new")
        charts.append(check_session_against(report.rig, root / "new", use_checks=job.checks > 0).chart)
        errors = [_solved(cell, job.seed, simulated, root / "new")]
        with (root / "new" / "session.yaml").open("a") as file:
            file.write("rig: rig.yaml\n")
        (root / "new" / "rig.yaml").write_bytes((root / "rig.yaml").read_bytes())
        errors.append(_solved(cell, job.seed, simulated, root / "new"))
        changed = {}
        for number, (name, change) in enumerate(CHANGES.items()):
            other = dict(config.deviations)
            for constant, value in deviations_of(change).items():
                other[constant] += value
            path = root / f"changed{number}"
            _write(replace(config, deviations=other), job.seed, job.sessions + 1 + number, path)
            chart = check_session_against(report.rig, path, use_checks=job.checks > 0).chart
            changed[name] = "refused" if chart is None else chart.verdict.value
    unit = np.array([TEXTS[constant].per_unit for constant in report.found.constants])
    return Found(
        names=report.rig.names,
        prior=report.rig.prior_sigmas,
        sigma=report.found.sigma * unit,
        error=error * unit,
        nees=float(error @ np.linalg.solve(report.found.covariance, error)) / len(error),
        drawn=float(np.mean((truth / report.found.prior_sigma) ** 2)),
        left_out=sum(bool(one.reason) for one in report.sessions),
        own=tuple("refused" if chart is None else chart.verdict.value for chart in charts),
        changed=changed,
        errors=tuple(errors),
    )


def _write(config: SimulationConfig, rig: int, number: int, path: Path) -> SimulatedSession:
    """Session ``number`` of a rig, with a marker bias of its own."""
    rng = np.random.default_rng([rig, number])
    bias = {constant: config.noise.marker_bias_mm * float(rng.standard_normal()) for constant in OWN}
    simulated = simulate(replace(config, deviations={**config.deviations, **bias}), 1000 * rig + number)
    simulated = replace(simulated, events=[*simulated.events, *simulated.checks])
    write_session(simulated, path)
    (path / "ground_truth.yaml").unlink()
    return simulated


def _solved(cell: Cell, seed: int, simulated: SimulatedSession, path: Path) -> tuple[float, float]:
    found = outcome(cell, seed, simulated, fgreg.solve(path), 0.0)
    return found.worst, found.bound


def _share(count: int, total: int) -> str:
    p = count / max(total, 1)
    return f"{100 * p:5.1f} % +- {100 * (p * (1 - p) / max(total, 1)) ** 0.5:.1f}"


def show(found: Sequence[Found]) -> None:
    """Print the figures of all rigs."""
    first = found[0]
    error, sigma = np.stack([one.error for one in found]), np.stack([one.sigma for one in found])
    print(f"{'constant':26s}{'prior':>10s}{'sigma':>10s}{'RMS z':>8s}  held by")
    for k, name in enumerate(first.names):
        factor = 1.0 if TEXTS[_constant(name)].unit else 100.0
        held = "sessions" if 1.0 - np.mean((sigma[:, k] / first.prior[k]) ** 2) >= OBSERVED else "prior"
        z = np.sqrt(np.mean((error[:, k] / sigma[:, k]) ** 2))
        label = name if factor == 1.0 else f"{name}, %"
        line = f"{label:26s}{factor * first.prior[k]:10.3f}{factor * np.sqrt(np.mean(sigma[:, k] ** 2)):10.3f}"
        print(f"{line}{z:8.2f}  {held}")
    nees, drawn = np.array([one.nees for one in found]), np.array([one.drawn for one in found])
    line = f"NEES over {len(first.names)} constants {nees.mean():.2f} +- {nees.std() / len(nees) ** 0.5:.2f}"
    # Most constants are held by their priors: few rigs that happen to be drawn wide make their error look too large.
    print(f"{line}; the draws themselves {drawn.mean():.2f}")
    print(f"sessions left out: {sum(one.left_out for one in found)}")
    own = [verdict for one in found for verdict in one.own]
    print(
        f"unchanged: note {_share(own.count('note'), len(own))}, alarm {_share(own.count('alarm'), len(own))}", end=""
    )
    print(f" of {len(own)} sessions")
    for name in CHANGES:
        said = [one.changed[name] for one in found]
        counts = ", ".join(f"{verdict} {said.count(verdict)}" for verdict in ("pass", "note", "alarm", "refused"))
        print(f"changed, {name}: {counts}")
    for label, place in (("without", 0), ("with", 1)):
        worst, bound = np.array([one.errors[place] for one in found]).T
        line = (
            f"a new session {label} the rig: RMS error at the worst target {np.sqrt(np.mean(worst**2)):.2f} mm, bound "
        )
        print(f"{line}{np.sqrt(np.mean(bound**2)):.2f} mm, holds {_share(int((worst <= bound).sum()), len(worst))}")


def _constant(name: str) -> Constant:
    return next(constant for constant in Constant if TEXTS[constant].name == name)


def main() -> None:
    """Study the rigs asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rigs", type=int, default=20, help="how many to draw")
    parser.add_argument("--sessions", type=int, default=10, help="of each rig")
    parser.add_argument("--pairs", type=int, default=15, help="PMs of each session")
    parser.add_argument("--noise", choices=[*NOISES], default="frames")
    parser.add_argument("--checks", type=int, default=0, help="check points of each session, used as data")
    parser.add_argument("--poses", action="store_true", help="sessions without camera, marker and board sections")
    parser.add_argument("--first", type=int, default=0, help="seed of the first rig")
    add_pool_options(parser)
    args = parser.parse_args()
    seeds = range(args.first, args.first + args.rigs)
    jobs = [Job(seed, args.sessions, args.noise, args.pairs, args.checks, args.poses) for seed in seeds]
    with pool_of(args) as pool:
        show(list(pool.map(run, jobs)))


if __name__ == "__main__":
    main()
