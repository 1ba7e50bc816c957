"""A simulated room whose pictures are rendered beforehand, so that they cost almost nothing while it runs.

The surgeon follows a fixed list: aims, then spots at tissue in laps, with the camera at one place and, after a bump, at
another, then back again. He is as interactive as in fgreg.simulation.room, but starts to move only where a period of
the hand's tremor starts, and travels for an integer number of periods. So each place is one short clip of pictures that
repeats while he stays, and each way between places is another. Poses are computed at any time as in that room, with the
same function of time as the clips.
"""

from __future__ import annotations

import math
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.simulation.render import UInt8Image
from fgreg.simulation.room import BUMP_S, Place, Room, RoomConfig, Travel, travel_s

FRAME_RATE = 30.0
LOOP_FRAMES = 24
LOOP_S = LOOP_FRAMES / FRAME_RATE
"""Period of the tremor, and of the clip that repeats while the fibre is held."""
PLAYED_TREMOR_HZ = (1.25, 2.5, 5.0, 8.75)
"""Whole numbers of periods in a loop."""
EARLY = 1e-6
"""Tolerance of a frame's time, as a share of the frame interval."""


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """Pictures that are shown one after the other.

    Attributes:
        place: where the fibre is, or goes to. travel, camera: the motions; the clip begins at 0 s.
        first, frames: its pictures among all.
    """

    place: Place
    travel: Travel
    camera: Travel
    first: int
    frames: int


@dataclass(frozen=True, slots=True, eq=False)
class Station:
    """A place of the list: the clip that repeats there, and those on the way to the next."""

    held: Clip
    leaving: tuple[Clip, ...]
    next: int


class PlayedRoom(Room):
    """A room that goes through a fixed list of places.

    Args:
        config: of the room; bumps come from the list, not from it.
        spots: at tissue, for either place of the camera.
        laps: through the spots before the camera is bumped.

    Attributes:
        stations: the list; each names the one after it.
        frames: stereo pictures that its clips have.
    """

    def __init__(self, config: RoomConfig, spots: int = 10, laps: int = 2) -> None:
        super().__init__(replace(config, tremor_hz=PLAYED_TREMOR_HZ, bump_every_s=math.inf))
        if min(spots, laps) < 1:
            raise ValueError(f"{spots} spots in {laps} laps, expected at least one of either")
        here = self.trus_T_camera(0.0)
        there = self._bumped(here)
        self.frames = 0
        self.stations = self._listed(here, there, spots, laps)
        held = self.stations[0].held
        self._station, self._shown = 0, [(0.0, held)]
        self._place, self._travels = held.place, [held.travel]
        self._pictures: UInt8Image | None = None

    def _listed(self, here: FloatArray, there: FloatArray, spots: int, laps: int) -> list[Station]:
        aims = [(aim, here) for aim in self._aims]
        tissue = [[(self._spot(camera), camera) for _ in range(spots)] for camera in (here, there)]
        listed = aims + [spot for lap in tissue for spot in lap * laps]
        clips: dict[tuple[int, ...], Clip] = {}

        def clip(place: Place, start: FloatArray, camera: FloatArray, after: FloatArray, frames: int) -> Clip:
            key = (id(place), id(start), id(camera), id(after))
            if key not in clips:
                took = frames / FRAME_RATE
                travel = Travel(0.0, took, start, place.trus_T_marker)
                clips[key] = Clip(place, travel, Travel(0.0, BUMP_S, camera, after), self.frames, frames)
                self.frames += frames
            return clips[key]

        out = []
        for number, (place, camera) in enumerate(listed):
            following = number + 1 if number + 1 < len(listed) else len(aims)
            goal, after = listed[following]
            at = place.trus_T_marker
            leaving = [] if after is camera else [clip(place, at, camera, after, LOOP_FRAMES)]
            loops = math.ceil(travel_s(at, goal.trus_T_marker) / LOOP_S - EARLY)
            leaving.append(clip(goal, at, after, after, loops * LOOP_FRAMES))
            out.append(Station(clip(place, at, camera, camera, LOOP_FRAMES), tuple(leaving), following))
        return out

    def clips(self) -> list[Clip]:
        """All clips, in the order of their pictures."""
        found = {clip.first: clip for station in self.stations for clip in (station.held, *station.leaving)}
        return [found[first] for first in sorted(found)]

    # --- what happens -----------------------------------------------------------------------------------------------

    def proceed(self, t_s: float) -> Place:
        """The surgeon goes on to the next place, once a period of the tremor starts."""
        station = self.stations[self._station]
        begin = LOOP_S * math.ceil(t_s / LOOP_S - EARLY)
        for clip in station.leaving:
            if clip.camera.start is not clip.camera.end:
                self._cameras.append(replace(clip.camera, start_s=begin, end_s=begin + BUMP_S))
                self.moved_s.append(begin)
            if clip.travel.start is not clip.travel.end:
                self._travels.append(replace(clip.travel, start_s=begin, end_s=begin + clip.travel.end_s))
            self._shown.append((begin, clip))
            begin += clip.frames / FRAME_RATE
        self._station = station.next
        held = self.stations[station.next].held
        self._shown = [*self._shown[-4:], (begin, held)]
        self._place = held.place
        return held.place

    # --- pictures ---------------------------------------------------------------------------------------------------

    def shown(self, t_s: float) -> tuple[Clip, int]:
        """The clip shown at a time, and the index of its picture."""
        begin, clip = next(entry for entry in reversed(self._shown) if entry[0] <= t_s + EARLY)
        return clip, math.floor((t_s - begin) * FRAME_RATE + EARLY) % clip.frames

    def show(self, pictures: UInt8Image) -> None:
        """Show these pictures (n, 2, h, w) from now on."""
        width, height = self.config.scene.camera.left.image_size
        if pictures.shape != (self.frames, 2, height, width):
            raise ValueError(f"pictures of shape {pictures.shape}, expected {(self.frames, 2, height, width)}")
        self._pictures = pictures

    def pictures(self, t_s: float, index: int) -> tuple[UInt8Image, UInt8Image]:  # noqa: ARG002
        """Left and right image (h, w) at a time, as rendered."""
        clip, at = self.shown(t_s)
        if self._pictures is None:
            return self.made(clip, at)
        left, right = self._pictures[clip.first + at]
        return left, right

    def made(self, clip: Clip, at: int) -> tuple[UInt8Image, UInt8Image]:
        """Render one picture of a clip."""
        now = self._place, self._travels, self._cameras
        self._place, self._travels, self._cameras = clip.place, [clip.travel], [clip.camera]
        try:
            return super().pictures(at / FRAME_RATE, clip.first + at)
        finally:
            self._place, self._travels, self._cameras = now


# --- made beforehand -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class Making:
    """Input of a process that renders pictures: plain values."""

    config: RoomConfig
    spots: int
    laps: int
    path: Path

    def room(self) -> PlayedRoom:
        """The room."""
        return PlayedRoom(self.config, self.spots, self.laps)

    def file(self, room: PlayedRoom, mode: str) -> UInt8Image:
        """The file's pictures (n, 2, h, w)."""
        width, height = room.config.scene.camera.left.image_size
        shape = (room.frames, 2, height, width)
        return np.memmap(self.path, np.uint8, mode, shape=shape)  # type: ignore[call-overload,no-any-return]


_room: PlayedRoom | None = None


def _make(making: Making, number: int) -> int:
    global _room  # one a process
    room = _room = making.room() if _room is None else _room
    pictures = making.file(room, "r+")
    clip = room.clips()[number]
    for at in range(clip.frames):
        pictures[clip.first + at] = np.stack(room.made(clip, at))
    return clip.frames


def make_pictures(making: Making, processes: int) -> bool:
    """Make all pictures of a room and write them to the file; False where they are there already.

    An existing file belongs to this room if the last picture of each clip equals the one rendered now.
    """
    room = making.room()
    if making.path.is_file() and _holds(making, room):
        return False
    part = replace(making, path=making.path.with_suffix(".part"))
    part.path.parent.mkdir(parents=True, exist_ok=True)
    part.file(room, "w+")
    numbers = range(len(room.clips()))
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        list(pool.map(_make, [part] * len(numbers), numbers))
    part.path.replace(making.path)
    return True


def _holds(making: Making, room: PlayedRoom) -> bool:
    width, height = room.config.scene.camera.left.image_size
    if making.path.stat().st_size != room.frames * 2 * height * width:
        return False
    pictures = making.file(room, "r")
    ends = [(clip, clip.frames - 1) for clip in room.clips()]
    return all(np.array_equal(np.stack(room.made(clip, at)), pictures[clip.first + at]) for clip, at in ends)
