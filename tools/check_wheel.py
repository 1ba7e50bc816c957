"""Build the wheel, install it into an empty environment outside the tree, and use it there.

Checks that the command runs, that a simulated session is solved and reported, and that no top-level package `factors`
or `drivers` came along. Exit status 0 where all holds.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOREIGN = """
import importlib.util, pathlib, sys
import fgreg
assert pathlib.Path(fgreg.__file__).is_relative_to(sys.prefix), fgreg.__file__
for name in ("factors", "drivers", "tests", "tools", "sessions"):
    assert importlib.util.find_spec(name) is None, f"top-level package {name}"
fgreg.solve, fgreg.LiveSession
import fgreg.factors.point_on_line, fgreg.detection.frame_files
import fgreg.drivers.base, fgreg.drivers.thorlabs_stage, fgreg.stage.client, fgreg.search.planner
"""


def run(*command: str | Path, cwd: Path, status: int = 0) -> str:
    """Run a command without the tree on its path; its output. Raises SystemExit where the exit status is another."""
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode != status:
        sys.stderr.write(done.stdout + done.stderr)
        raise SystemExit(f"{' '.join(str(part) for part in command)}: exit status {done.returncode}, expected {status}")
    return done.stdout


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        outside = Path(name)
        run(sys.executable, "-m", "build", "--wheel", "--outdir", outside, ROOT, cwd=outside)
        wheel = next(outside.glob("*.whl"))
        tops = {entry.split("/")[0] for entry in zipfile.ZipFile(wheel).namelist()}
        if any(not top.startswith("fgreg") for top in tops):
            raise SystemExit(f"the wheel holds {sorted(tops)}, expected fgreg only")
        venv.create(outside / "empty", with_pip=True)
        python = outside / "empty" / "bin" / "python"
        run(python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", wheel, cwd=outside)
        run(python, "-c", FOREIGN, cwd=outside)
        fgreg = python.with_name("fgreg")
        if "solve" not in run(fgreg, "--help", cwd=outside):
            raise SystemExit("fgreg --help does not name solve")
        run(fgreg, "simulate", "poses", "--preset", "first-hit", "--pairs", "30", "--seed", "3", cwd=outside)
        run(fgreg, "check", "poses", cwd=outside)
        print(run(fgreg, "solve", "poses", cwd=outside))
        print(run(fgreg, "report", "poses", cwd=outside))
        print(f"{wheel.name}: installed and used in an empty environment")


if __name__ == "__main__":
    main()
