"""What a lab that is not as declared does to the answer, its error bar and its verdict.

Sessions of the simulator (which shares no code with the estimator), each solved from its folder by ``fgreg.solve``. A
cell is KIND/NOISE/PAIRS or KIND/NOISE/PAIRS/two-sided.

  kind   as-declared  nothing deviates
         drawn        all constants drawn from the declared standard deviations, all at once; each PM beside its beam
                      and each window's width varying, as declared. drawn-poses: in a session without a camera;
                      drawn-checks: with three checks, located through the cameras
         careful      the constants of a careful lab, each at its magnitude with a random sign, and the same per PM
         3s-NAME      one constant off by three of its standard deviations, either sign (NAME: a key of `systematic`)
         else         one thing wrong, by far; --list has them all
  noise  frames       what detection in clean frames leaves of the marker; published: noise of poses as published; raw:
                      frames are rendered and detected (a minute a session), all that deviates in what they show
  pairs  first-hit pairs from alternating sides; two-sided: each PM heard from both sides

Printed for each cell: true error at the worst target (RMS and 95 % over sessions), bound (95 % error that the result
predicts there, RMS), share of sessions whose bound holds, share of targets within their own bounds, share of sessions
with the truth in the registration's 95 % region (ellipsoids, from the covariance) and mean NEES (6 expected), predicted
over true RMS at all targets, true RMS over the least that is possible (below), verdicts, `ok` beyond the bound, beyond
twice the bound, and beyond bound and 3 mm; sessions that are not `ok` with a bound below the limit ("denied"); the same
shares by quarter of the predicted error; the error that a target shows which the scanner sees as well, whose map is
wrong by the same constants; time. Standard errors after +-.

The least possible error, where the lab deviates as declared: the posterior Cramer-Rao bound of the model with its
budget (tools/cramer_rao_bound.py). It is the inverse of Fisher's information of all measurements at the session's true
poses, beam and PMs, plus that of the constants' priors. The constants are as declared there: they enter nearly
linearly, so that their draws do not change it. Its mean square at the targets is averaged over sessions. Windows count
as Gaussians of the same variance.

Where the camera moved, the truth is that of the camera now; "unseen" are sessions with fewer epochs than the camera had
places, and not refused. A cell that misses an aim says so.

    python tools/study_systematics.py --sessions 100 --cells radius-1mm/frames/15 drawn/published/25
    python tools/study_systematics.py --sessions 1000 --cells 'drawn/*' --out drawn.jsonl --jobs 2

The second goes on where an earlier run with this --out ended.

Session k of a cell is the same whatever else is run.
"""

from __future__ import annotations

import argparse
import fnmatch
import json
import math
import sys
import tempfile
import time
import warnings
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

import fgreg
from cramer_rao_bound import FullTruth, truth_covariance
from fgreg.geometry.target_error import expected_tre_mm, target_jacobians, tre_mm
from fgreg.geometry.transforms import FloatArray, inverse, log_so3, transform_points
from fgreg.model.systematic import NONE, Systematic
from fgreg.simulation.array import map_by_declared
from fgreg.simulation.config import SimulationConfig
from fgreg.simulation.simulate import SimulatedSession, simulate
from fgreg.simulation.write import write_session
from study_pool import add_pool_options, pool_of
from systematic_cells import LIMIT_MM, RAW, ROWS, TABLE, WITHIN, Cell, all_cells, configuration, parsed

CHI2_6 = 12.592
"""95 % quantile of chi square, 6 degrees of freedom."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One session. ``epochs`` found, ``places`` that the camera had; errors in mm, infinite where there is no estimate.

    ``worst`` and ``bound`` at the worst target, ``true2``, ``predicted2`` and ``least2`` (not a number where the lab is
    not within its budget) mean squares, ``seen`` at the worst target against where the scanner shows it.
    """

    cell: str
    seed: int
    verdict: str
    epochs: int
    places: int
    worst: float
    bound: float
    targets_in: float
    nees: float
    true2: float
    predicted2: float
    least2: float
    seen: float
    seconds: float
    reasons: tuple[str, ...]


_NORMAL = np.random.default_rng(0).standard_normal((2000, 3))


def run(job: tuple[Cell, int, Systematic]) -> Outcome:
    """Simulate and solve one session."""
    cell, seed, systematic = job
    warnings.simplefilter("ignore")
    simulated = simulate(configuration(cell, seed, systematic), seed)
    simulated = replace(simulated, events=[*simulated.events, *simulated.checks])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "session"
        write_session(simulated, path)
        (path / "ground_truth.yaml").unlink()
        start = time.process_time()
        report = fgreg.solve(path, fgreg.SolveConfig(limit_mm=cell.limit_mm))
        seconds = time.process_time() - start
    return outcome(cell, seed, simulated, report, seconds)


def outcome(cell: Cell, seed: int, simulated: SimulatedSession, report: fgreg.SolveReport, seconds: float) -> Outcome:
    """The figures of a solved session, against the camera as it is at its end."""
    estimate, targets = report.estimate, report.session.model.targets_mm
    epoch, truth = estimate.epochs[-1], simulated.scene.trus_T_camera[-1]
    head = (cell.name, seed, estimate.verdict.value, len(estimate.epochs), len(simulated.scene.trus_T_camera))
    if epoch.trus_T_camera is None or epoch.covariance is None:
        return Outcome(*head, *(math.inf,) * 2, 0.0, *(math.inf,) * 5, seconds, estimate.reasons)
    error = tre_mm(epoch.trus_T_camera, truth, targets)
    jacobian = target_jacobians(epoch.trus_T_camera, targets)
    covariance = jacobian @ epoch.covariance @ np.swapaxes(jacobian, 1, 2)
    root = np.linalg.cholesky(covariance + 1e-12 * np.eye(3))
    quantile = np.quantile(np.linalg.norm(np.einsum("nij,sj->nsi", root, _NORMAL), axis=-1), 0.95, axis=1)
    step = inverse(epoch.trus_T_camera) @ truth
    xi = np.concatenate([log_so3(step[:3, :3]), step[:3, 3]])
    return Outcome(
        *head,
        worst=float(error.max()),
        bound=math.inf if epoch.predicted_tre is None else epoch.predicted_tre.worst_mm,
        targets_in=float(np.mean(error <= quantile)),
        nees=float(xi @ np.linalg.solve(epoch.covariance, xi)),
        true2=float(np.mean(error**2)),
        predicted2=float(np.mean(np.trace(covariance, axis1=1, axis2=2))),
        least2=least_square(simulated, report) if cell.kind in WITHIN else math.nan,
        seen=float(np.linalg.norm(seen_error(simulated.config, epoch.trus_T_camera, truth, targets), axis=1).max()),
        seconds=seconds,
        reasons=estimate.reasons,
    )


def least_square(simulated: SimulatedSession, report: fgreg.SolveReport) -> float:
    """The least mean square error at the targets (mm^2) that is possible on average; of a session of one epoch."""
    extracted, scene, model = report.extracted, simulated.scene, report.session.model
    truth = FullTruth(
        trus_T_camera=scene.trus_T_camera,
        marker_T_laser=scene.marker_T_laser,
        trus_p_pm_mm={int(pm): np.array(point) for pm, point in simulated.truth["pms"].items()},
        pair_camera_T_marker=[simulated.true_camera_T_marker[i] for i in extracted.pair_events],
        aim_camera_T_marker=[simulated.true_camera_T_marker[i] for i in extracted.aim_events],
    )
    covariance = truth_covariance(extracted.measurements, model, truth)
    return float(np.mean(expected_tre_mm(covariance[:6, :6], scene.trus_T_camera[0], model.targets_mm) ** 2))


def seen_error(
    config: SimulationConfig, trus_T_camera: FloatArray, truth: FloatArray, targets_mm: FloatArray
) -> FloatArray:
    """(n, 3) where the registration has the targets as the camera sees them, less where the scanner shows them."""
    scan = config.array.plane_angle_rad(targets_mm)
    x, r = config.array.x_mm(targets_mm, scan), config.array.range_mm(targets_mm, scan)
    shown = map_by_declared(config.probe, scan, x, r)
    return transform_points(trus_T_camera, transform_points(inverse(truth), targets_mm)) - shown


@dataclass(frozen=True, slots=True)
class Figure:
    """A number with its standard error."""

    value: float
    error: float

    def text(self, percent: bool) -> str:
        scale, digits = (100.0, 1) if percent else (1.0, 2)
        return f"{scale * self.value:.{digits}f} +- {scale * self.error:.{digits}f}{' %' if percent else ''}"


def share(flags: FloatArray) -> Figure:
    """Of flags, or the mean of shares or of other numbers."""
    n = max(len(flags), 1)
    return Figure(float(flags.mean()) if len(flags) else math.nan, float(flags.std()) / math.sqrt(n))


def rms(values: FloatArray) -> Figure:
    """Root mean square; of finite values."""
    squares = np.square(values[np.isfinite(values)])
    if not len(squares):
        return Figure(math.nan, math.nan)
    root = math.sqrt(float(squares.mean()))
    return Figure(root, float(squares.std()) / math.sqrt(len(squares)) / (2.0 * max(root, 1e-12)))


def root_ratio(squares: FloatArray, others: FloatArray) -> Figure:
    """Root of the ratio of two mean squares over sessions; of those where both are finite."""
    finite = np.isfinite(squares) & np.isfinite(others)
    if not finite.any():
        return Figure(math.nan, math.nan)
    both = np.stack([squares[finite], others[finite]])
    mean = both.mean(axis=1)
    ratio = math.sqrt(mean[0] / mean[1])
    return Figure(ratio, 0.5 * ratio * float(np.linalg.norm(both.std(axis=1) / mean)) / math.sqrt(both.shape[1]))


HOLDING = ("holds", "targets", "region")
VERDICTS = ("ok", "warning", "refused", "split", "unseen")
FAILING = ("ok_beyond", "ok_twice", "ok_far", "denied")
"""Shares of sessions (of targets: the mean over sessions), as the head of this file describes them."""


def figures(outcomes: list[Outcome], limit_mm: float) -> dict[str, Figure]:
    """All figures of some sessions of a cell."""
    worst, bound = np.array([o.worst for o in outcomes]), np.array([o.bound for o in outcomes])
    verdict = np.array([o.verdict for o in outcomes])
    ok, beyond = verdict == "ok", worst > bound
    true2, nees = np.array([o.true2 for o in outcomes]), np.array([o.nees for o in outcomes])
    out = {
        "true_rms": rms(worst),
        "true_95": Figure(float(np.quantile(worst, 0.95)), _quantile_error(worst)),
        "bound": rms(bound),
        "seen_rms": rms(np.array([o.seen for o in outcomes])),
        "predicted_over_true": root_ratio(np.array([o.predicted2 for o in outcomes]), true2),
        "true_over_least": root_ratio(
            *(np.array([(o.true2, o.least2) for o in outcomes if o.epochs == o.places] or [(1.0, math.nan)]).T)
        ),
        "nees": share(nees[np.isfinite(nees)]),
        "seconds": Figure(float(np.median([o.seconds for o in outcomes])), 0.0),
    }
    flags = (
        ~beyond,
        np.array([o.targets_in for o in outcomes]),
        nees <= CHI2_6,
        ok,
        verdict == "warning",
        verdict == "refused",
        np.array([o.epochs > o.places for o in outcomes]),
        np.array([o.epochs < o.places and o.verdict != "refused" for o in outcomes]),
        ok & beyond,
        ok & (worst > 2.0 * bound),
        ok & beyond & (worst > LIMIT_MM),
        ~ok & (bound <= limit_mm),
    )
    out |= {
        name: share(flag.astype(np.float64)) for name, flag in zip(HOLDING + VERDICTS + FAILING, flags, strict=True)
    }
    return out


def _quantile_error(values: FloatArray) -> float:
    """Half the distance of the order statistics one standard deviation of the rank to either side of the 95 %."""
    n = len(values)
    step = math.sqrt(0.95 * 0.05 / n)
    low, high = np.quantile(values, [max(0.95 - step, 0.0), min(0.95 + step, 1.0)])
    return float(0.5 * (high - low)) if math.isfinite(high) else math.inf


def missed(cell: Cell, all_of: dict[str, Figure], quarters: list[dict[str, Figure]]) -> list[str]:
    """Aims that a cell misses, by the figures as they are (with their standard errors beside)."""
    value = {name: figure.value for name, figure in all_of.items()}
    out = []
    if cell.kind in WITHIN:
        out += [name for name in ("targets", "region") if not 0.93 <= value[name] <= 0.97]
        for k, quarter in enumerate(quarters):
            bad = [name for name in ("targets", "region") if not 0.90 <= quarter[name].value <= 0.98]
            out += [f"{name} in quarter {k + 1}" for name in bad]
        out += [] if abs(value["predicted_over_true"] - 1.0) <= 0.05 else ["predicted over true"]
        if cell.kind != "as-declared":  # without deviations the error is smaller than the budget's
            out += [] if abs(value["true_over_least"] - 1.0) <= 0.05 else ["true over least"]
        out += [] if value["denied"] <= 0.03 else ["denied"]
        out += [] if value["split"] <= 0.01 else ["split"]
    elif cell.kind.startswith("3s-"):
        out += [] if value["ok_beyond"] <= 0.20 else ["ok beyond the bound"]
        out += [] if value["ok_twice"] <= 0.005 else ["ok beyond twice the bound"]
    elif cell.kind in ROWS:
        row = ROWS[cell.kind]
        most = 25.0 if cell.kind.endswith("checks") and cell.noise == "published" else row.most
        if row.camera and row.far and cell.noise != RAW:
            most = 100.0  # only frames show it: poses of a tag and a board that are as wrong fit each other
        name = "ok_far" if row.far else "ok_beyond"
        out += [] if 100.0 * value[name] <= most else [f"{name} at most {most:g} %"]
        out += [] if value["unseen"] == 0.0 else ["unseen moves"]
    return out


def report(cell: Cell, outcomes: list[Outcome], reasons: bool) -> dict[str, object]:
    """Print a cell; its figures as a document."""
    total = figures(outcomes, cell.limit_mm)
    order = np.argsort([o.bound for o in outcomes], kind="stable")
    quarters = [
        figures([outcomes[i] for i in part], cell.limit_mm) for part in np.array_split(order, 4) if len(outcomes) >= 8
    ]
    wrong = missed(cell, total, quarters)
    print(f"{cell.name}: {len(outcomes)} sessions{', misses ' + ', '.join(wrong) if wrong else ''}")
    mm = ("true_rms", "true_95", "bound", "seen_rms", "predicted_over_true", "true_over_least", "nees")
    print("   mm   " + ", ".join(f"{name} {total[name].text(percent=False)}" for name in mm))
    for head, shares in (("in", HOLDING), ("are", VERDICTS), ("not", FAILING)):
        print(f"   {head:5s}" + ", ".join(f"{name} {total[name].text(percent=True)}" for name in shares))
    for k, quarter in enumerate(quarters):
        shown = [f"bound {quarter['bound'].value:.2f} true {quarter['true_rms'].value:.2f}"]
        shown += [f"{name} {quarter[name].text(percent=True)}" for name in (*HOLDING, "ok")]
        print(f"   {k + 1}/4  " + ", ".join(shown))
    print(f"   {total['seconds'].value:.3f} s of processor time a session (median)", flush=True)
    if reasons:
        count: dict[str, int] = {}
        for text in (" ".join(r.split()[:9]) for o in outcomes for r in o.reasons):
            count[text] = count.get(text, 0) + 1
        for text, n in sorted(count.items(), key=lambda item: -item[1])[:8]:
            print(f"   {n:5d} x {text}")
    return {
        "cell": cell.name,
        "sessions": len(outcomes),
        "missed": wrong,
        **{name: asdict(figure) for name, figure in total.items()},
        "quarters": [{name: asdict(figure) for name, figure in quarter.items()} for quarter in quarters],
    }


def earlier(path: Path | None) -> dict[tuple[str, int], Outcome]:
    """Outcomes of an earlier run, by cell and seed; a line that was cut short or has other figures is left out."""
    found: dict[tuple[str, int], Outcome] = {}
    if path is None or not path.exists():
        return found
    for line in path.read_text().splitlines():
        try:
            entry = json.loads(line)
            found[entry["cell"], entry["seed"]] = Outcome(**{**entry, "reasons": tuple(entry["reasons"])})
        except (json.JSONDecodeError, TypeError):
            continue
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=100, help="per cell")
    parser.add_argument("--seed", type=int, default=0, help="number of the first session")
    parser.add_argument("--cells", nargs="+", default=["table"], help="names, patterns with *, or `table`")
    parser.add_argument("--list", action="store_true", help="print the names of all cells and end")
    parser.add_argument("--systematic-none", action="store_true", help="sessions that say `systematic: none`")
    add_pool_options(parser)
    parser.add_argument(
        "--out", type=Path, help="each session's outcome, one JSON line each; those there are not repeated"
    )
    parser.add_argument("--reasons", action="store_true", help="print how often each reason of a verdict was given")
    parser.add_argument("--json", action="store_true", help="print one JSON document at the end")
    args = parser.parse_args()
    if args.list:
        print(*all_cells(), sep="\n")
        return
    names: dict[str, None] = {}
    for wanted in args.cells:
        found = TABLE if wanted == "table" else fnmatch.filter(all_cells(), wanted) if "*" in wanted else [wanted]
        names |= dict.fromkeys(found)
    cells = [parsed(name) for name in names]
    systematic = NONE if args.systematic_none else Systematic()
    done = earlier(args.out)
    seeds = range(args.seed, args.seed + args.sessions)
    documents = []
    with pool_of(args) as pool:
        for cell in cells:
            begin = time.perf_counter()
            missing = [seed for seed in seeds if (cell.name, seed) not in done]
            tasks = [(cell, seed, systematic) for seed in missing]
            for count, one in enumerate(pool.map(run, tasks), 1):
                done[one.cell, one.seed] = one
                if args.out is not None:
                    with args.out.open("a") as out:
                        out.write(json.dumps(asdict(one)) + "\n")
                if count % max(len(missing) // 10, 1) == 0:
                    passed = time.perf_counter() - begin
                    print(f"{cell.name}: {count} of {len(missing)}, {passed:.0f} s", file=sys.stderr, flush=True)
            documents.append(report(cell, [done[cell.name, seed] for seed in seeds], args.reasons))
    if args.json:
        print(json.dumps(documents, indent=2))


if __name__ == "__main__":
    main()
