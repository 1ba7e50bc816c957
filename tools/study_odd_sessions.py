"""Sessions that are valid but odd: an answer or a clear refusal, with its time and memory.

Each row is a simulated session changed in one way and given to ``fgreg solve`` (and ``fgreg replay``) in a process of
its own. Printed: verdict, error against the truth at the worst target of the last epoch and the bound that the result
states there, exit status, time, largest memory, lines on standard error. A row misses its aim where the command crashes
(a status other than 0, 1, 2), prints anything but lines of its own, or is ``ok`` with an error beyond its bound.

    python tools/study_odd_sessions.py                  # all rows, some minutes
    python tools/study_odd_sessions.py --rows repeated  # one of them; --list names them
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from fgreg.simulation.presets import FIRST_HIT
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

MEMORY_BYTES = 8_000_000_000
TIMEOUT_S = 1800.0
Events = list[dict[str, Any]]
Setup = dict[str, Any]


def _of(events: Events, kind: str) -> Events:
    return [event for event in events if event["type"] == kind]


def _more(events: Events, shots: Events, count: int, **changes: Any) -> Events:
    """The events and ``count`` more copies of the shots, a second apart."""
    last = events[-1]["t"]
    return [*events, *({**deepcopy(shots[k % len(shots)]), "t": last + 1.0 + k, **changes} for k in range(count))]


def repeated(_setup: Setup, events: Events) -> Events:
    """One pair a thousand times."""
    return _more(events, _of(events, "pair")[:1], 1000)


def pairs_1000(_setup: Setup, events: Events) -> Events:
    """1,000 pairs, each of its own PM."""
    return events


def pairs_20000(_setup: Setup, events: Events) -> Events:
    """20,000 pairs, each of its own PM: more than a replay takes."""
    return events


def looks_500(_setup: Setup, events: Events) -> Events:
    """500 looks at one PM."""
    first = _of(events, "pair")[0]
    return _more(events, [first], 500, pm=first["pm"])


def tracks_10000(_setup: Setup, events: Events) -> Events:
    """10,000 tracking queries."""
    return _more(events, _of(events, "track"), 10_000)


def epochs_50(_setup: Setup, events: Events) -> Events:
    """50 reported camera moves after the pairs, the last one followed by the same pairs again."""
    last = events[-1]["t"]
    moved: Events = [{"type": "camera_moved", "t": last + k} for k in range(1, 50)]
    return _more([*events, *moved], _of(events, "pair"), len(_of(events, "pair")))


def zero_noise(setup: Setup, events: Events) -> Events:
    """A session.yaml that says every noise is zero."""
    setup["noise"] = _scaled(setup["noise"], 0.0)
    return _without_covariances(events)


def huge_noise(setup: Setup, events: Events) -> Events:
    """Noise 100 times as large as it is."""
    setup["noise"] = _scaled(setup["noise"], 100.0)
    return _without_covariances(events)


def singular_covariances(_setup: Setup, events: Events) -> Events:
    """Covariances of looks with one direction without noise."""
    for event in _of(events, "pair"):
        event["trus"]["covariance"] = [[0.01, 0.01], [0.01, 0.01]]
    return events


def tiny_radius(setup: Setup, events: Events) -> Events:
    """A probe's radius of 0.001 mm."""
    setup["probe"]["radius_mm"] = 0.001
    return events


def same_place(_setup: Setup, events: Events) -> Events:
    """All pairs with the marker pose of the first."""
    pairs = _of(events, "pair")
    for event in pairs:
        event["marker"] = pairs[0]["marker"]
    return events


def no_aims(_setup: Setup, events: Events) -> Events:
    """No calibration shot."""
    return [event for event in events if event["type"] != "aim"]


def one_instant(_setup: Setup, events: Events) -> Events:
    """All events at one time."""
    return [{**event, "t": 1.0} for event in events]


ROWS: dict[str, Callable[[Setup, Events], Events]] = {
    row.__name__.replace("_", "-"): row
    for row in (
        repeated,
        pairs_1000,
        pairs_20000,
        looks_500,
        tracks_10000,
        epochs_50,
        zero_noise,
        huge_noise,
        singular_covariances,
        tiny_radius,
        same_place,
        no_aims,
        one_instant,
    )
}


PAIRS = {"pairs-1000": 1_000, "pairs-20000": 20_000}
"""Of the simulated session; 15 where absent."""


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, dict):
        return {key: _scaled(each, factor) for key, each in value.items()}
    if isinstance(value, list):
        return [_scaled(each, factor) for each in value]
    return value * factor if isinstance(value, int | float) and not isinstance(value, bool) else value


def _without_covariances(events: Events) -> Events:
    for event in events:
        event.pop("covariance", None)
        for part in ("marker", "trus"):
            if part in event:
                event[part].pop("covariance", None)
    return events


def make(row: str, folder: Path) -> Path:
    """Write a row's session."""
    config = replace(FIRST_HIT, aims=12, pairs=PAIRS.get(row, 15), tracks_heard=1, tracks_silent=1)
    write_session(simulate(config, 1), folder)
    setup = yaml.safe_load((folder / "session.yaml").read_text(encoding="utf-8"))
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()]
    events = ROWS[row](setup, events)
    (folder / "session.yaml").write_text(yaml.safe_dump(setup), encoding="utf-8")
    (folder / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events), encoding="utf-8")
    return folder


def run(command: str, folder: Path) -> dict[str, Any]:
    """A command's verdict, status, time (s), memory (MB) and lines on standard error."""
    start = time.monotonic()
    limit = (MEMORY_BYTES, MEMORY_BYTES)
    with tempfile.TemporaryFile() as stdout, tempfile.TemporaryFile() as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", "fgreg", command, str(folder), "--json"],
            stdout=stdout,
            stderr=stderr,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, limit),
            env={**os.environ, "PYTHONWARNINGS": "default"},
        )
        timer = threading.Timer(TIMEOUT_S, process.kill)
        timer.start()
        _, status, usage = os.wait4(process.pid, 0)
        timer.cancel()
        process.returncode = os.waitstatus_to_exitcode(status)
        for stream in (stdout, stderr):
            stream.seek(0)
        out, err = stdout.read().decode(), stderr.read().decode()
    elapsed = time.monotonic() - start
    document = json.loads(out) if process.returncode in (0, 1) and out else {}
    return {
        "status": process.returncode,
        "verdict": document.get("verdict", "none"),
        "reason": (document.get("reasons") or [""])[0],
        "document": document,
        "elapsed_s": elapsed,
        "memory_mb": usage.ru_maxrss / 1000.0,
        "stderr": err.strip().splitlines(),
    }


def missed(found: dict[str, Any], true_mm: float | None, bound_mm: float | None) -> str:
    """Which aim a run misses; empty where none."""
    if found["status"] not in (0, 1, 2):
        return f"status {found['status']}"
    if any(not line.startswith(("fgreg: error: ", "fgreg: warning: ")) for line in found["stderr"]):
        return "other lines on standard error"
    wrong = true_mm is not None and (bound_mm is None or true_mm > bound_mm)
    return "ok beyond its bound" if found["verdict"] == "ok" and wrong else ""


def _figures(document: dict[str, Any]) -> tuple[float | None, float | None]:
    """(true error, stated bound) at the worst target of the last epoch, mm."""
    epoch = (document.get("epochs") or [{}])[-1]
    true = (document.get("truth") or {}).get("tre_worst_mm") or [None]
    return true[-1], (epoch.get("predicted_tre_mm") or {}).get("worst")


def main() -> None:
    """Run the rows and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS), metavar="ROW")
    parser.add_argument("--list", action="store_true", help="name the rows")
    parser.add_argument("--commands", nargs="*", default=["solve", "replay"], choices=["solve", "replay"])
    options = parser.parse_args()
    if options.list:
        for name, row in ROWS.items():
            print(f"{name:22} {(row.__doc__ or '').strip()}")
        return
    misses = 0
    print(f"{'session':22} {'command':7} {'verdict':8} {'true':>7} {'bound':>7} {'status':>6} {'s':>7} {'MB':>6}")
    for row in options.rows:
        with tempfile.TemporaryDirectory() as folder:
            session = make(row, Path(folder) / "session")
            for command in options.commands:
                found = run(command, session)
                true_mm, bound_mm = _figures(found["document"])
                shown = [f"{'-' if value is None else f'{value:.2f}':>7}" for value in (true_mm, bound_mm)]
                print(
                    f"{row:22} {command:7} {found['verdict']:8} {' '.join(shown)} {found['status']:6} "
                    f"{found['elapsed_s']:7.1f} {found['memory_mb']:6.0f}  "
                    f"{found['reason'][:150] or ' | '.join(found['stderr'])[:150]}",
                    flush=True,
                )
                if miss := missed(found, true_mm, bound_mm):
                    misses += 1
                    print(f"    MISSED: {miss}: {' | '.join(found['stderr'])[-300:]}", flush=True)
    print(f"{misses} missed")
    sys.exit(1 if misses else 0)


if __name__ == "__main__":
    main()
