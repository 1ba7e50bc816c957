"""Times of the estimate, in process, and of the whole command. Medians; a benchmark, not a test.

In process: calibration and registration with covariances of 12 aims and 15 pairs (poses), the posterior's samples and
the tracking answers apart; and registration against the number of pairs, to see that it grows linearly.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.model.measurements import Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.posterior_mean import posterior_mean
from fgreg.registration.register import register
from fgreg.registration.solve import distance_to_explicit, solve
from fgreg.session.session_reader import read_session
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session


def median_ms(run: Callable[[], object], repeats: int) -> float:
    """Median wall time (ms) over repeats, after one warm-up."""
    run()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        run()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def session(folder: Path, name: str, pairs: int, seed: int) -> tuple[SessionModel, Measurements]:
    """A simulated pose-level session with first hits."""
    path = folder / name
    write_session(simulate(replace(PRESETS["first-hit"], pairs=pairs), seed), path)
    read = read_session(path)
    return read.model, extract_measurements(read.events, read.model).measurements


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--pairs", type=int, nargs="*", default=[100, 300, 1000, 3000], help="sizes for the growth")
    parser.add_argument("--phantom", type=Path, default=Path("sessions/phantom"), help="session of raw frames")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    config = SolveConfig()
    out: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model, measurements = session(folder, "small", 15, args.seed)
        found = register(measurements, model, config)
        out["register 15 pairs, ms"] = median_ms(lambda: register(measurements, model, config), args.repeats)
        out["explicit graph from there, ms"] = median_ms(lambda: distance_to_explicit(found), args.repeats)
        out["posterior samples, ms"] = median_ms(
            lambda: posterior_mean(found, config),
            args.repeats,
        )
        out["solve 15 pairs, all of it, ms"] = median_ms(lambda: solve(measurements, [], model, config), args.repeats)
        for pairs in args.pairs:
            model, measurements = session(folder, f"s{pairs}", pairs, args.seed)

            def once(m: Measurements = measurements, of: SessionModel = model) -> object:
                return register(m, of, config)

            out[f"register {pairs} pairs, ms"] = median_ms(once, 3)
        for title, path in (("poses", folder / "small"), ("raw frames", args.phantom)):
            if path.is_dir():
                command = [sys.executable, "-m", "fgreg", "solve", str(path), "--out", str(folder / "r.yaml"), "-q"]
                out[f"command on {title}, ms"] = median_ms(lambda c=command: subprocess.run(c, check=False), 5)  # type: ignore[misc]
    for key, value in out.items():
        print(f"{key:36s} {value:10.1f}")
    if args.json:
        print(json.dumps(out, indent=2))


if __name__ == "__main__":
    main()
