"""Whole commands beside importing the libraries that they use: processor time of processes of their own."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from bench.compare import Row, Section, Target, in_turn, rows_of
from fgreg.workers.threads import NAMES

ROOT = Path(__file__).resolve().parents[2]
LIBRARIES = ("gtsam", "numpy", "poselib", "pydantic", "rich.console", "rich.table", "scipy.special", "typer", "yaml")
"""What ``fgreg solve`` on poses uses; checked against what it loads."""
SOLVE, HELP, IMPORTS, TYPER = "fgreg solve, poses", "fgreg --help", "import its libraries", "import typer"


def environment(byte_code: Path) -> dict[str, str]:
    """Of a process as a user has it: number of threads not set, byte code in a folder of its own."""
    kept = {key: value for key, value in os.environ.items() if key not in ("PYTHONDONTWRITEBYTECODE", *NAMES)}
    return {**kept, "PYTHONPATH": os.fspath(ROOT), "PYTHONPYCACHEPREFIX": os.fspath(byte_code)}


def children_s() -> float:
    """Processor time (s) of all processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run(arguments: list[str], env: dict[str, str]) -> None:
    """Run Python, started outside all checkouts.

    Raises:
        RuntimeError: it failed (status 1 is a refused verdict, no failure).
    """
    done = subprocess.run(
        [sys.executable, *arguments],
        env=env,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        cwd=os.sep,
        check=False,
    )
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(arguments)} ended with {done.returncode}")


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


def bench_command(repeats: int) -> Section:
    """`fgreg solve` of 12 aims and 10 pairs, and `fgreg --help`, in turn with the imports."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        env = environment(folder / "byte code")
        session = Path(shutil.copytree(ROOT / "sessions" / "paper", folder / "paper"))
        check_libraries(session, env)
        imports = f"import {', '.join(LIBRARIES)}"
        groups: dict[str, dict[str, list[str]]] = {
            "12 aims, 10 pairs": {SOLVE: ["-m", "fgreg", "solve", os.fspath(session)], IMPORTS: ["-c", imports]},
            "help": {HELP: ["-m", "fgreg", "--help"], TYPER: ["-c", "import typer"]},
        }
        rows = list[Row]()
        for case, commands in groups.items():
            runs: dict[str, Callable[[], None]] = {
                title: (lambda c=command: run(c, env))  # type: ignore[misc]
                for title, command in commands.items()
            }
            rows += rows_of("command", case, in_turn(runs, repeats, children_s), {})
    ratio = {row.name: row.ratio or 0.0 for row in rows}
    targets = (
        Target("fgreg solve over importing its libraries", 1.0 / ratio[IMPORTS], 2.0),
        Target("fgreg --help over import typer", 1.0 / ratio[TYPER], 1.3),
    )
    return Section(tuple(rows), targets)
