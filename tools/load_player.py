"""The process that plays a simulated room for tools/load_live.py: pictures from a file, all else as in the room.

It takes the options that fgreg.drivers.simulated_room takes. At its end it writes what it did to the file --figures.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from played_room import FRAME_RATE, Making, PlayedRoom

from fgreg.drivers.simulated_room import RoomServer, serve
from fgreg.simulation.room import room_config


class Player(RoomServer):
    """The room's server, which writes down what it made for somebody: (the room's time, how late it was), s."""

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--socket", type=Path, required=True)
    parser.add_argument("--pictures", type=Path, required=True, help="made by tools/load_live.py")
    parser.add_argument("--figures", type=Path, required=True, help="written at the end")
    parser.add_argument("--frame-rate", type=float, default=FRAME_RATE, help="a whole part of that of the pictures")
    parser.add_argument("--stay-s", type=float, default=12.0, help="at a spot, while the stage follows")
    for name in ("--seed", "--width", "--aims", "--spots", "--laps"):
        parser.add_argument(name, type=int, required=True)
    parser.add_argument("--bump-every-s", type=float, help="not used: bumps come where the list has them")
    given = parser.parse_args()
    making = Making(room_config(given.seed, given.width, aims=given.aims), given.spots, given.laps, given.pictures)
    room = making.room()
    room.show(making.file(room, "r"))
    server = Player(room, given.socket, given.frame_rate, given.stay_s)
    began = time.monotonic(), time.process_time()
    serve(server)
    lasted, used = time.monotonic() - began[0], time.process_time() - began[1]
    figures = {
        "start_s": server.start_s,
        "made": server.made,
        "bumps": len(room.moved_s),
        "processor_share": used / lasted,
    }
    given.figures.write_text(json.dumps(figures), encoding="utf-8")


if __name__ == "__main__":
    main()
