"""Which modules a command loads: only those that it uses."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from fgreg.pipeline.solve import SolveRequest, solve_session

SLOW = ("cv2", "rerun", "matplotlib", "scipy.stats", "scipy.optimize", "scipy.spatial", "scipy.ndimage")
"""Libraries that take 50 ms and more, and that few commands use."""
SOLVER = ("scipy", "gtsam", "poselib", "fgreg.registration.register", "fgreg.graph", "fgreg.factors")
OTHER_COMMANDS = ("fgreg.online", "fgreg.online.live_session", "fgreg.simulation", "fgreg.evaluation", "fgreg.convert")
DETECTORS = ("cv2", "scipy.fft", "fgreg.drivers", "fgreg.detection.marker", "fgreg.detection.photoacoustic")
DRAWING = ("rerun", "fgreg.viewer.recording", "fgreg.viewer.shapes")
PROCESSES = ("multiprocessing", "concurrent.futures.process")

FORBIDDEN: dict[str, tuple[str, ...]] = {
    "--help": ("numpy", "pydantic", "rich", "yaml", *SLOW, *SOLVER, *OTHER_COMMANDS, *PROCESSES),
    "calibrate-camera --help": ("numpy", "rich", "yaml", *SLOW, *SOLVER, *OTHER_COMMANDS, *PROCESSES),
    "solve --help": ("numpy", "rich", "yaml", *SLOW, *SOLVER, *OTHER_COMMANDS, *PROCESSES),
    "check POSES": ("rich", *SLOW, *SOLVER, *OTHER_COMMANDS, *DETECTORS, *DRAWING, *PROCESSES),
    "print marker PDF --dictionary DICT_4X4_50 --id 0 --size-mm 25": (
        *SLOW[1:],
        *SOLVER[1:],
        *OTHER_COMMANDS,
        *DRAWING,
        *PROCESSES,
    ),
    "schema events": ("rich", "yaml", *SLOW, *SOLVER, *OTHER_COMMANDS, *DETECTORS, *DRAWING, *PROCESSES),
    "solve POSES": ("scipy.linalg", *SLOW, *OTHER_COMMANDS, *DETECTORS, *DRAWING, *PROCESSES),
    "solve POSES --quiet": ("rich", *SLOW, *OTHER_COMMANDS, *DETECTORS, *DRAWING, *PROCESSES),
    "solve FRAMES": (*SLOW[1:], *OTHER_COMMANDS, *DRAWING, *PROCESSES),
    "verify POSES NEW": (*SLOW, *OTHER_COMMANDS, *DETECTORS, *DRAWING, *PROCESSES),
    "report POSES": (*SLOW, *SOLVER[1:], *OTHER_COMMANDS, *DETECTORS, *DRAWING, *PROCESSES),
    "replay POSES": (*SLOW, *DETECTORS, "fgreg.simulation", "fgreg.evaluation", "fgreg.convert"),
    "evaluate POSES --jobs 1 --folds 0 --subsets 0 --no-leave-one-out": (
        *SLOW,
        *DETECTORS,
        *DRAWING,
        "fgreg.online",
        "fgreg.simulation",
    ),
    "simulate OUT --preset first-hit": (*SLOW[1:], *SOLVER, *DRAWING, *PROCESSES, "fgreg.online", "fgreg.evaluation"),
}
"""Command, and modules that it must not have loaded when it ends."""

PROGRAM = """
import sys
from fgreg.cli.main import main
try:
    main()
finally:
    print(*sys.modules, sep=chr(10), file=sys.stderr)
"""


@pytest.mark.parametrize("command", FORBIDDEN)
def test_a_command_loads_nothing_that_it_does_not_use(
    command: str, pose_session: Path, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    places = {"POSES": str(pose_session), "OUT": str(tmp_path / "out"), "PDF": str(tmp_path / "m.pdf")}
    if "FRAMES" in command:
        places["FRAMES"] = str(request.getfixturevalue("raw_session"))
    if "NEW" in command or "report" in command:
        solve_session(SolveRequest(pose_session))
    if "NEW" in command:
        lines = (pose_session / "events.jsonl").read_text().splitlines()
        places["NEW"] = str(tmp_path / "new.jsonl")
        event = json.loads(next(line for line in lines if '"pair"' in line))
        event["trus"]["range_mm"] += 0.01  # not a shot of the registration itself
        (tmp_path / "new.jsonl").write_text(json.dumps(event) + "\n")
    words = [places.get(word, word) for word in command.split()]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *words], check=False, capture_output=True, text=True, timeout=120
    )
    assert done.returncode in (0, 1), done.stderr
    loaded = set(done.stderr.splitlines())
    assert "fgreg.cli.main" in loaded
    assert sorted(loaded & set(FORBIDDEN[command])) == []


def test_packages_load_nothing_by_themselves() -> None:
    """What imports one module of a package gets no other one with it."""
    folder = Path(__file__).parent.parent / "fgreg"
    packages = sorted({path.parent.name for path in folder.glob("*/__init__.py")})
    assert {"graph", "detection", "session"} <= set(packages)
    code = f"import sys, {', '.join(f'fgreg.{name}' for name in packages)}\nprint(*sys.modules, sep=chr(10))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, timeout=60)
    below = [name for name in done.stdout.splitlines() if name.startswith("fgreg.") and name.count(".") > 1]
    assert below == []


def test_what_is_forbidden_exists() -> None:
    """A module that was renamed would be forbidden to no effect."""
    names = {name for names in FORBIDDEN.values() for name in names}
    assert sorted(name for name in names if importlib.util.find_spec(name) is None) == []
