"""A main program for tests: turns the stage, and then ends in the way given by its argument.

    python -m tests.stage_main FOLDER END

Prints ``moving`` once the stage turns, and the host's time right before the end.
"""

from __future__ import annotations

import math
import os
import sys
import threading
import time
from pathlib import Path

from fgreg.model.session_model import StageModel
from fgreg.stage.client import StageLink, StageRecord
from fgreg.stage.limits import MotionKind, MotionLimits
from fgreg.stage.stop_on_exit import emergency_stop_all

STAGE = StageModel(math.radians(2.0), (math.radians(-60.0), math.radians(60.0)))
LIMITS = MotionLimits.of_session(STAGE, heartbeat_s=0.5, step_heartbeat_s=0.5, search_speed_rad_s=math.radians(4.0))


def beat_for(link: StageLink, seconds: float) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        link.beat(time.monotonic(), "ok")
        link.poll()
        time.sleep(0.02)


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def _crash() -> None:
    raise RuntimeError("a bug")


def main(folder: Path, end: str) -> None:
    log = (folder / "events.txt").open("a", encoding="utf-8")

    def sink(record: StageRecord) -> None:
        log.write(f"{record.command} {record.scan_rad} {record.reason}\n")
        log.flush()

    options = {"trace": str(folder / "trace")}
    link = StageLink.open("tests.traced_stage:open_stage", options, LIMITS, sink, folder / "watchdog.log")
    beat_for(link, 0.15)
    link.request(MotionKind.SEARCH, "test")
    link.search_to(math.radians(55.0), "a long way")
    until = time.monotonic() + 10.0
    while time.monotonic() < until and not (
        link.view and link.view.moving is MotionKind.SEARCH and link.view.status and link.view.status.moving
    ):
        beat_for(link, 0.05)
    _say(f"moving {link.pid}")
    beat_for(link, 0.15)
    _say(str(time.monotonic()))
    if end == "stall":
        time.sleep(60.0)
    elif end == "crash":
        _crash()
    elif end == "exit":
        os._exit(3)
    elif end == "thread crash":
        thread = threading.Thread(target=_crash)
        thread.start()
        thread.join()
        beat_for(link, 60.0)
    elif end == "emergency":
        threading.Thread(target=emergency_stop_all).start()
        beat_for(link, 60.0)
    elif end == "fork and die":
        if os.fork() == 0:
            time.sleep(5.0)  # holds copies of the sockets, so that the watchdog does not see them closed
            os._exit(0)
        os._exit(0)
    elif end == "fall off the end":
        return
    else:
        beat_for(link, 60.0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
