"""Stored ratios, and what was lost against them."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from bench.compare import Row

RATIOS = Path(__file__).resolve().parent / "ratios.json"
LOSS = 1.25
"""A ratio that fell by more than this factor counts as lost."""
SCATTER = 1.6
"""Upper over lower quartile beyond which a ratio is not kept."""
VERSIONS = ("gtsam", "numpy", "scipy", "opencv-contrib-python-headless", "pyceres", "symforce", "pyapriltags", "pymust")


def stored(rows: Sequence[Row]) -> dict[str, float]:
    """The ratios that are kept: those that tell a loss, of several runs that do not scatter too much to show it."""
    kept = {}
    for row in rows:
        if row.ratio is None or row.low is None or row.high is None or row.runs < 2 or not row.worse:
            continue
        if row.high <= SCATTER * row.low:
            kept[row.key] = float(f"{row.ratio:.4g}")
    return kept


def store(rows: Sequence[Row], path: Path) -> None:
    """Write the ratios; those of parts that were not run stay."""
    known = json.loads(path.read_text()) if path.is_file() else {}
    path.write_text(json.dumps(dict(sorted((known | stored(rows)).items())), indent=1) + "\n")


def losses(rows: Sequence[Row], path: Path) -> list[str]:
    """A line for each ratio that is worse than the stored one by over 25 %.

    Raises:
        FileNotFoundError: nothing is stored.
    """
    before = json.loads(path.read_text())
    lost = []
    for row in rows:
        if row.key not in before or row.ratio is None or not row.worse:
            continue
        if (row.ratio / before[row.key]) ** row.worse > LOSS:
            lost.append(f"{row.key}: {row.ratio:.3g}, stored {before[row.key]:.3g}")
    return lost


def machine() -> str:
    """Cores, kind of processor, load, and versions: a line each."""
    kind = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        kind = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    found = []
    for name in VERSIONS:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} not installed")
    return f"{os.cpu_count()} cores, {kind}, load {load}\nPython {platform.python_version()}, {', '.join(found)}"
