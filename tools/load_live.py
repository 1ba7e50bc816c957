"""A live session under the load of an operating room: latency of every frame, and growth of memory and queues.

A room is played by another process (tools/load_player.py): 30 stereo frames of 1280 x 720 px a second that were made
beforehand, 10 laser pulses a second, a surgeon who follows the messages, a camera that is bumped. Measured are: the
time from a frame's arrival at its driver to the stage order, or to the decision that there is none; counts of frames
and pulses; memory, processor time and queues; the end.

    python tools/load_live.py --cache /var/tmp/fgreg           # ten minutes; the pictures (4.5 GB) are kept there
    python tools/load_live.py --cache /var/tmp/fgreg --seconds 60
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.drivers.simulated import RoomProcess
from fgreg.drivers.simulated_room import CAMERA_CLOCK_S, PROBE_CLOCK_S
from fgreg.live.launch import running
from fgreg.live.simulated_room import room_setup
from fgreg.live.viewer_feed import viewer_feed
from fgreg.model.events import CameraMovedEvent, PairEvent
from fgreg.model.solve_config import SolveConfig
from fgreg.session.session_reader import read_session
from fgreg.simulation.room import room_config
from fgreg.workers.threads import NAMES
from load_player import playing
from load_watch import GROWS_FROM_MIN, Made, Processes, Watch
from played_room import FRAME_RATE, Making, make_pictures

STAY_S = 12.0
"""Time that the surgeon stays at a spot while the stage follows."""
P50_MS, P99_MS = 30.0, 80.0
RECORDER_WAITS, PULSES_WAIT = 12, 30
"""Events of some spots; pulses that come while one is waited for (fgreg.live.pulse_locator)."""
GROWTH_MB = 20.0
"""More than this from minute 4 to the end is growth: a process's memory wanders by some MB."""


def measure(options: argparse.Namespace, making: Making, folder: Path) -> dict[str, Any]:
    """Run one session; its figures."""
    figures_file = folder / "player.json"
    play = partial(playing, making=making, frame_rate=options.frame_rate, stay_s=STAY_S, figures=figures_file)
    session_folder = folder / "session"
    with ExitStack() as stack:
        room = stack.enter_context(RoomProcess(run=play))
        feed = stack.enter_context(viewer_feed(options.rrd, "load", live=False, say=print))
        with running(room_setup(room.path, making.config), session_folder, None, feed.taken) as session:
            feed.session(session.model, SolveConfig().limit_mm)
            processes, watch = Processes(), Watch(session)
            until = time.monotonic() + options.seconds

            def on_status(status: Any) -> None:
                feed.status(status)
                watch.see(status)
                processes.see(status.now_s)

            session.loop.run(lambda: time.monotonic() < until, on_status)
            processes.sample(time.monotonic())
            watch.end()
            ending = time.monotonic()
        closed_s = time.monotonic() - ending
    player = json.loads(figures_file.read_text(encoding="utf-8"))
    return {
        **watch.figures(_made(player)),
        "processes": processes.figures(),
        "player": _player(player),
        "end": {"seconds": round(closed_s, 2), "left_behind": processes.left(), **_recorded(session_folder)},
    }


def _made(player: dict[str, Any]) -> Made:
    """The player's frames and pulses by the devices' clocks."""
    frames, pulses = (np.array(player["made"][role])[:, 0] for role in ("camera", "probe"))
    return Made(frames + CAMERA_CLOCK_S, pulses + PROBE_CLOCK_S, player["start_s"] - CAMERA_CLOCK_S)


def _player(player: dict[str, Any]) -> dict[str, Any]:
    late = 1e3 * np.array(player["made"]["camera"])[:, 1]
    return {
        "bumps": player["bumps"],
        "processor_share": round(player["processor_share"], 3),
        "late_ms": {"p99": round(float(np.percentile(late, 99)), 1), "max": round(float(late.max()), 1)},
    }


def _recorded(folder: Path) -> dict[str, Any]:
    """Content on disk, and the result of ``fgreg check``."""
    program = "import sys; from fgreg.cli.main import main; sys.exit(main())"
    check = subprocess.run([sys.executable, "-c", program, "check", str(folder)], capture_output=True, text=True)
    counted = Counter(type(event) for event in read_session(folder).events)
    return {
        "check": check.returncode,
        "check_says": (check.stdout + check.stderr).strip().splitlines()[-1:],
        "pairs_on_disk": counted[PairEvent],
        "moves_on_disk": counted[CameraMovedEvent],
    }


def verdicts(found: dict[str, Any]) -> dict[str, bool]:
    """Each requirement, and whether it is met."""
    latency, counts, end = found["latency_ms"]["all"], found["counts"], found["end"]
    return {
        f"median latency at most {P50_MS:g} ms": latency["p50"] <= P50_MS,
        f"99 % of latencies at most {P99_MS:g} ms": latency["p99"] <= P99_MS,
        f"no process grows by more than {GROWTH_MB:g} MB after minute {GROWS_FROM_MIN}": all(
            process["growth_mb"] <= GROWTH_MB
            for name, process in found["processes"].items()
            if "growth_mb" in process and not name.startswith("room")  # which maps more and more of its file
        ),
        "no queue grows": all(
            queues["recorder"] <= RECORDER_WAITS and queues["pulses"] <= PULSES_WAIT
            for queues in found["queues"].values()
        ),
        "every frame is processed or counted": counts["frames_unaccounted"] == 0,
        "no pulse is lost": counts["pulses_dropped"] == 0 == counts["pulses_unaccounted"],
        "every pair handed over is on disk": counts["pairs_handed_over"] == end["pairs_on_disk"],
        "a clean end": end["check"] == 0 and not end["left_behind"] and end["seconds"] < 15.0,
    }


def show(found: dict[str, Any]) -> None:
    """As text."""
    for name in (
        "counts",
        "latency_ms",
        "from_exposure_ms",
        "turn_ms",
        "look_ms",
        "order_ms",
        "minutes",
        "queues",
        "processes",
        "player",
    ):
        print(name)
        for key, value in found[name].items():
            print(f"  {key:<26} {json.dumps(value) if isinstance(value, dict | list) else value}")
    print("estimate", json.dumps(found["estimate"]))
    print("end", json.dumps(found["end"]))
    for what, met in found["asked"].items():
        print(f"  {'yes' if met else 'NO ':<4} {what}")


def _load() -> str:
    return " ".join(f"{load:.1f}" for load in os.getloadavg())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0, help="of the session (default 600)")
    parser.add_argument("--cache", type=Path, help="folder for the pictures (default: a temporary one)")
    parser.add_argument("--out", type=Path, help="folder for the session (default: a temporary one)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there")
    parser.add_argument("--rrd", type=Path, metavar="FILE", help="record what a viewer would show meanwhile")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--width", type=int, default=1280, help="of the images, px (default 1280)")
    parser.add_argument("--frame-rate", type=float, default=FRAME_RATE, help="30, 15, 10, ... a second (default 30)")
    parser.add_argument("--aims", type=int, default=8, help="calibration shots (default 8)")
    parser.add_argument("--spots", type=int, default=10, help="at tissue, for either place of the camera (default 10)")
    parser.add_argument("--laps", type=int, default=2, help="through the spots between bumps (default 2)")
    options = parser.parse_args()
    if "OMP_NUM_THREADS" not in os.environ:  # as fgreg live has it; NumPy reads that when it is loaded
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **dict.fromkeys(NAMES, "1")})
    config = room_config(options.seed, options.width, aims=options.aims)
    with tempfile.TemporaryDirectory(prefix="fgreg-load-") as temporary:
        cache, folder = options.cache or Path(temporary), options.out or Path(temporary)
        name = f"room-{options.seed}-{options.width}-{options.aims}-{options.spots}-{options.laps}.raw"
        for needed in (cache, folder):
            needed.mkdir(parents=True, exist_ok=True)
        making = Making(config, options.spots, options.laps, cache / name)
        began = time.monotonic()
        print("the pictures", "were made" if make_pictures(making, 2) else "were there", end=", ")
        print(f"{time.monotonic() - began:.0f} s", flush=True)
        before = _load()
        found = measure(options, making, folder)
    print(f"load average of the machine: {before} before, {_load()} after", flush=True)
    found["asked"] = verdicts(found)
    show(found)
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0 if all(found["asked"].values()) else 1


if __name__ == "__main__":
    sys.exit(main())
