"""Start-up cost of commands: processor time and wall time of whole processes, alternating on one machine.

    python tools/bench_start.py                              # this checkout against its limits
    python tools/bench_start.py --before ../older --runs 15  # against another checkout

One round runs every command once, so that the machine's other load affects all alike; medians over the rounds.
Limits (exit status 1 where one is missed): ``fgreg --help`` at most 1.3 times ``import typer``; ``fgreg solve`` on
poses at most twice the import of the libraries that it uses, and at most 0.55 of the older checkout's processor time;
on raw frames at most 0.6 of its wall time. Byte code has a folder of its own; it is written in the first round, which
is not counted.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from fgreg.workers.threads import NAMES

ROOT = Path(__file__).resolve().parent.parent
LIBRARIES = ("gtsam", "numpy", "poselib", "pydantic", "rich.console", "rich.table", "scipy.special", "typer", "yaml")
"""What ``fgreg solve`` on poses uses; checked against what it loads."""


def environment(checkout: Path, byte_code: Path) -> dict[str, str]:
    """Environment of a process that imports ``fgreg`` from a checkout, as a user has it: number of threads not set."""
    kept = {key: value for key, value in os.environ.items() if key not in ("PYTHONDONTWRITEBYTECODE", *NAMES)}
    return {**kept, "PYTHONPATH": os.fspath(checkout), "PYTHONPYCACHEPREFIX": os.fspath(byte_code)}


def run(arguments: list[str], env: dict[str, str]) -> tuple[float, float]:
    """Processor time (s, children included) and wall time (s) of a Python process, started outside all checkouts.

    Raises:
        RuntimeError: it failed (status 1 is a refused verdict, no failure).
    """
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, *arguments], env=env, stdout=subprocess.DEVNULL, cwd=os.sep)
    _, status, used = os.wait4(process.pid, 0)
    wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(arguments)} ended with {process.returncode}")
    return used.ru_utime + used.ru_stime, wall


def check_libraries(session: Path, env: dict[str, str]) -> None:
    """Raise RuntimeError where a solve does not load all that it is measured against."""
    code = (
        "import runpy, sys\n"
        f"sys.argv = ['fgreg', 'solve', {os.fspath(session)!r}]\n"
        "try:\n    runpy.run_module('fgreg', run_name='__main__')\n"
        "finally:\n"
        f"    missing = [m for m in {LIBRARIES!r} if m not in sys.modules]\n"
        "    print('not loaded:', *missing, file=sys.stderr) if missing else None\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False, cwd=os.sep
    )
    if done.stderr:
        raise RuntimeError(done.stderr)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, help="another checkout to compare with")
    parser.add_argument("--runs", type=int, default=9)
    parser.add_argument("--sessions", type=Path, default=ROOT / "sessions", help="with paper and phantom")
    args = parser.parse_args()
    checkouts = {"": ROOT} if args.before is None else {"": ROOT, " before": args.before.resolve()}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        commands: dict[str, tuple[list[str], dict[str, str]]] = {}
        for suffix, checkout in checkouts.items():
            env = environment(checkout, folder / f"byte code{suffix}")
            for session in ("paper", "phantom"):
                copy = Path(shutil.copytree(args.sessions.resolve() / session, folder / f"{session}{suffix}"))
                commands[f"solve {session}{suffix}"] = ["-m", "fgreg", "solve", os.fspath(copy)], env
            commands[f"help{suffix}"] = ["-m", "fgreg", "--help"], env
        env = environment(ROOT, folder / "byte code")
        commands["import libraries"] = ["-c", f"import {', '.join(LIBRARIES)}"], env
        commands["import typer"] = ["-c", "import typer"], env
        check_libraries(folder / "paper", env)
        taken: dict[str, list[tuple[float, float]]] = {key: [] for key in commands}
        for number in range(args.runs + 1):
            for key, command in commands.items():
                figures = run(*command)
                if number:
                    taken[key].append(figures)
    processor = {key: statistics.median(cpu for cpu, _ in runs) for key, runs in taken.items()}
    wall = {key: statistics.median(seconds for _, seconds in runs) for key, runs in taken.items()}
    print(f"{'median of ' + str(args.runs) + ' runs':24s} {'processor':>12s} {'wall':>12s}")
    for key in sorted(commands):
        print(f"{key:24s} {1e3 * processor[key]:9.0f} ms {1e3 * wall[key]:9.0f} ms")
    limits = [
        ("help / import typer, processor", processor["help"] / processor["import typer"], 1.3),
        ("solve paper / import libraries, processor", processor["solve paper"] / processor["import libraries"], 2.0),
    ]
    if args.before is not None:
        paper, phantom = "solve paper before", "solve phantom before"
        limits += [
            ("solve paper / before, processor", processor["solve paper"] / processor[paper], 0.55),
            ("solve phantom / before, wall", wall["solve phantom"] / wall[phantom], 0.6),
            ("solve phantom / before, processor", processor["solve phantom"] / processor[phantom], float("inf")),
        ]
    for text, ratio, limit in limits:
        print(f"{text:44s} {ratio:5.2f}" + (f"  (limit {limit:.2f})" if limit < float("inf") else ""))
    return int(any(ratio > limit for _, ratio, limit in limits))


if __name__ == "__main__":
    sys.exit(main())
