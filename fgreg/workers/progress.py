"""Whether another process works or hangs: by its processor time and its state, not by how long it takes.

A process that computes, waits for a processor that others use, or waits for the disk is slow. One that sleeps or is
stopped although an answer is due hangs, and so does one whose disk does not answer. Linux tells this in /proc/PID/stat;
elsewhere all time counts as hanging, and ``known`` says so.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

LOOK_S = 0.1
"""Time between two looks at a process."""
RUNS, WAITS_FOR_DISK = "R", "D"
"""States of a process that runs or is ready to, and of one that waits for the disk."""
DISK_S = 30.0
"""A process that waits for the disk for longer, without any processor time, hangs."""


class Progress:
    """Watches one process; for one thread.

    Attributes:
        worked_s: its processor time at the last look, s, all threads; 0 where it is unknown.
        known: whether the system tells what the process does.
    """

    def __init__(self, pid: int) -> None:
        self._path = Path(f"/proc/{pid}/stat")
        self._looked_s = self._progressed_s = self._disk_s = time.monotonic()
        self.worked_s, self.known = 0.0, False
        self._look(self._looked_s)

    def idle_s(self) -> float:
        """Seconds since it last worked or waited for a processor; it is looked at every ``LOOK_S`` at most."""
        now_s = time.monotonic()
        if now_s - self._looked_s >= LOOK_S:
            self._looked_s = now_s
            if self._look(now_s):
                self._progressed_s = now_s
        return now_s - self._progressed_s

    def _look(self, now_s: float) -> bool:
        try:
            fields = self._path.read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
            state, worked_s = fields[0], (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        except (OSError, IndexError, ValueError):
            return False
        before, self.worked_s, self.known = self.worked_s, worked_s, True
        if worked_s > before or state != WAITS_FOR_DISK:
            self._disk_s = now_s
        return worked_s > before or state == RUNS or (state == WAITS_FOR_DISK and now_s - self._disk_s < DISK_S)
