"""A simulated stage that records its orders and motion in a file, to be read after all processes have ended."""

from __future__ import annotations

import json
import math
import os
import time
from pathlib import Path
from typing import Any

from fgreg.drivers.simulated_stage import SimulatedStage
from fgreg.model.session_model import StageModel
from fgreg.stage.interface import StageError, StageLost, StageStatus


class TracedStage(SimulatedStage):
    """Each call and each status is one line of ``trace``; a file ``trouble`` beside it gives the fault."""

    def __init__(self, model: StageModel, trace: Path, **options: Any) -> None:
        self._trace = trace
        self._fails = 0
        super().__init__(model, **options)

    def _note(self, what: str, **more: Any) -> None:
        line = json.dumps({"t": time.monotonic(), "what": what, "pid": os.getpid(), **more})
        with self._trace.open("a", encoding="utf-8") as file:
            file.write(line + "\n")

    def _trouble(self) -> str:
        try:
            return self._trace.with_name("trouble").read_text(encoding="utf-8")
        except FileNotFoundError:
            return ""

    def home(self, speed_rad_s: float) -> None:
        self._note("home")
        super().home(speed_rad_s)

    def move_to(self, scan_rad: float, speed_rad_s: float) -> None:
        self._note("move", scan_deg=math.degrees(scan_rad))
        super().move_to(scan_rad, speed_rad_s)

    def stop(self) -> None:
        self._note("stop")
        if self._trouble() == "stop fails" and self._fails < 3:
            self._fails += 1
            raise StageError("traced stage: no answer")
        super().stop()

    def status(self) -> StageStatus:
        trouble = self._trouble()
        if trouble == "unplugged":
            raise StageLost("traced stage: unplugged")
        if trouble == "broken driver":
            raise ZeroDivisionError("a bug in the driver")
        status = super().status()
        self._note("status", deg=math.degrees(status.scan_rad), moving=status.moving)
        return status

    def close(self) -> None:
        self._note("close")
        super().close()


def open_stage(model: StageModel, *, trace: str, homed: bool = True) -> TracedStage:
    path = Path(trace)
    stage = TracedStage(model, path, homed=homed)
    if stage._trouble() == "unplugged":
        raise StageLost("traced stage: unplugged")
    return stage


def read_trace(path: Path) -> list[dict[str, Any]]:
    """The complete lines written up to now."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]
