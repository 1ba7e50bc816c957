"""Make the example sessions in sessions/ again: phantom (raw frames) and paper (poses).

    python tools/make_sessions.py                 both, into sessions/
    python tools/make_sessions.py --check         make both in a temporary folder and compare with sessions/
    python tools/make_sessions.py --out DIR paper one of them, elsewhere

Seeds are fixed, so the same versions of numpy and OpenCV give the same bytes; --check compares.
The sizes are printed against the 45 MB that sessions/phantom may take.
"""

from __future__ import annotations

import argparse
import filecmp
import sys
import tempfile
from pathlib import Path

from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

SEEDS = {"phantom": 1, "paper": 1}
LIMIT_MB = 45.0
HOME = Path(__file__).resolve().parent.parent / "sessions"


def make(name: str, folder: Path) -> None:
    """Write one session and print its content."""

    def progress(done: int, total: int) -> None:
        print(f"\r{name}: frame {done} of {total}", end="", file=sys.stderr, flush=True)

    simulated = simulate(PRESETS[name], SEEDS[name])
    write_session(simulated, folder, overwrite=True, progress=progress)
    if simulated.frames:
        print(file=sys.stderr)
    files = [path for path in folder.rglob("*") if path.is_file()]
    megabytes = sum(path.stat().st_size for path in files) / 1e6
    print(f"{name}: seed {SEEDS[name]}, {len(simulated.events)} events, {len(files)} files, {megabytes:.1f} MB")
    if megabytes > LIMIT_MB:
        raise SystemExit(f"{name} takes {megabytes:.1f} MB, more than {LIMIT_MB:.0f} MB")


def differences(one: Path, other: Path) -> list[str]:
    """Names of files that are in one folder only, or differ."""
    names = {str(p.relative_to(root)) for root in (one, other) for p in root.rglob("*") if p.is_file()}
    names -= {"result.yaml"}
    _, differing, absent = filecmp.cmpfiles(one, other, sorted(names), shallow=False)
    return sorted(differing + absent)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="phantom, paper; both where absent")
    parser.add_argument("--out", type=Path, default=HOME, help="folder to put them in (default: sessions/)")
    parser.add_argument("--check", action="store_true", help="write nothing there, only compare; exit 1 if they differ")
    arguments = parser.parse_args()
    names = arguments.names or list(SEEDS)
    for name in names:
        if name not in SEEDS:
            parser.error(f"{name} is not one of {', '.join(SEEDS)}")
    if not arguments.check:
        for name in names:
            make(name, arguments.out / name)
        return 0
    different = False
    with tempfile.TemporaryDirectory() as scratch:
        for name in names:
            make(name, Path(scratch) / name)
            found = differences(Path(scratch) / name, arguments.out / name)
            different |= bool(found)
            print(f"{name}: {'the same' if not found else 'different: ' + ', '.join(found)}")
    return int(different)


if __name__ == "__main__":
    raise SystemExit(main())
