"""Plays a simulated room for tools/load_live.py: pictures from a file, all else as in the room."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fgreg.drivers.simulated_room import RoomServer, serving
from fgreg.workers.worker_process import Work
from played_room import Making, PlayedRoom


class Player(RoomServer):
    """The room's server; it records the frames and pulses that it sent: (the room's time, delay), s."""

    def __init__(self, room: PlayedRoom, path: Path, frame_rate: float, stay_s: float) -> None:
        super().__init__(room, path, frame_rate=frame_rate, roam_s=stay_s)
        self.made: dict[str, list[tuple[float, float]]] = {"camera": [], "probe": []}

    def _note(self, role: str, t_s: float) -> None:
        if self._to(role):
            self.made[role].append((round(t_s, 6), round(self.now_s() - t_s, 6)))

    def _frame(self, t_s: float, index: int) -> None:
        self._note("camera", t_s)
        super()._frame(t_s, index)

    def _pulse(self, t_s: float, index: int) -> None:
        self._note("probe", t_s)
        super()._pulse(t_s, index)


@contextmanager
def playing(
    path: Path, making: Making, frame_rate: float, stay_s: float, figures: Path
) -> Iterator[Work[tuple[str, str], None]]:
    """Play a room whose devices are reached by the socket at ``path``; at the end, write its record to ``figures``.

    Args:
        making: of the room, its pictures made before.
        frame_rate: that of the pictures, or an integer fraction of it.
        stay_s: time at a spot while the stage follows.
    """
    room = making.room()
    room.show(making.file(room, "r"))
    server = Player(room, path, frame_rate, stay_s)
    began = time.monotonic(), time.process_time()
    with serving(server) as work:
        yield work
    lasted, used = time.monotonic() - began[0], time.process_time() - began[1]
    found = {
        "start_s": server.start_s,
        "made": server.made,
        "bumps": len(room.moved_s),
        "processor_share": used / lasted,
    }
    figures.write_text(json.dumps(found), encoding="utf-8")
