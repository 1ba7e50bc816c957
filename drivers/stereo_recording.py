"""Recorded pictures of an endoscope in pairs: two folders, two videos, or one of either that holds both views.

Pictures of two folders belong together by the last number in their names, else by their order
(fgreg.drivers.image_folder); frames of two videos by their order. Of a long video every n-th frame is taken.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fgreg.detection.frame_files import Picture, as_picture, read_picture
from fgreg.drivers.endoscope import Layout, halves_of, open_video
from fgreg.drivers.image_folder import FolderCapture
from fgreg.errors import InputError

MOST_FRAMES = 300
"""Of a video, about evenly spread."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedPair:
    """One picture of each camera (None: there is none), with a name for messages."""

    name: str
    left: Picture
    right: Picture | None


def sources(paths: list[Path]) -> tuple[Path, Path | None]:
    """Left and right of one or two paths; a folder that holds ``left`` and ``right`` is both.

    Raises:
        InputError: more than two, or the same twice.
    """
    if len(paths) > 2:
        raise InputError(str(paths[2]), "a third source", "left and right, or one folder that has both")
    if len(paths) == 1:
        inner = [paths[0] / name for name in ("left", "right")]
        return (inner[0], inner[1]) if all(part.is_dir() for part in inner) else (paths[0], None)
    if paths[0].resolve() == paths[1].resolve():
        raise InputError(str(paths[1]), "the left source again", "that of the right camera")
    return paths[0], paths[1]


def recorded_pairs(left: Path, right: Path | None, layout: Layout) -> tuple[int, Iterator[RecordedPair]]:
    """How many pairs there are, about, and all of them one after another.

    Args:
        left, right: each a folder, a pattern such as ``left/*.png``, or a video; ``right`` is None for one source.
        layout: of one source: ``mono``, or where left and right are in it.

    Raises:
        InputError: a source that cannot be read, pictures of another kind, or nothing that belongs together.
    """
    folders = [_folder(path) for path in (left, right) if path is not None]
    if len(set(folders)) > 1:
        raise InputError(str(right), "a folder beside a video", "two of one kind")
    count, pairs = _of_folders(left, right) if folders[0] else _of_videos(left, right)
    if right is None and layout in (Layout.SIDE_BY_SIDE, Layout.TOP_BOTTOM):
        return count, (RecordedPair(pair.name, *halves_of(pair.left, layout, pair.name)) for pair in pairs)
    return count, pairs


def _folder(path: Path) -> bool:
    if path.is_dir() or any(sign in path.name for sign in "*?["):
        return True
    if not path.is_file():
        raise InputError(str(path), "nothing", "a folder of pictures, a pattern such as left/*.png, or a video")
    return False


def _of_folders(left: Path, right: Path | None) -> tuple[int, Iterator[RecordedPair]]:
    captures = [FolderCapture.of(path, 1.0) for path in (left, right) if path is not None]
    by_time = [dict(zip(one.times_s, one.pictures, strict=True)) for one in captures]
    common = [time for time in by_time[0] if all(time in other for other in by_time[1:])]
    if not common:
        expected = "names with the same numbers, such as left/007.png and right/007.png"
        raise InputError(str(right), "no picture with a number of the left ones", expected)

    def pairs() -> Iterator[RecordedPair]:
        for time in common:
            pictures = [_picture(pictures[time]) for pictures in by_time]
            yield RecordedPair(by_time[0][time].name, pictures[0], pictures[1] if right is not None else None)

    return len(common), pairs()


def _picture(path: Path) -> Picture:
    try:
        picture = read_picture(path)
    except OSError as error:
        raise InputError(str(path), f"a file that cannot be read ({error.strerror})", "a picture") from None
    if picture is None:
        raise InputError(str(path), "a file that cannot be decoded", "a picture; delete it, or take it again")
    return picture


def _of_videos(left: Path, right: Path | None) -> tuple[int, Iterator[RecordedPair]]:
    captures = [open_video(path) for path in (left, right) if path is not None]
    counts = [capture.get(cv2.CAP_PROP_FRAME_COUNT) for capture in captures]
    frames = int(min((count for count in counts if np.isfinite(count) and count > 0), default=0))
    step = max(1, frames // MOST_FRAMES)

    def pairs() -> Iterator[RecordedPair]:
        try:
            for index in itertools.count():
                read = [capture.read() for capture in captures]
                if not all(good for good, _ in read):
                    return
                if index % step == 0:
                    pictures = [as_picture(frame) for _, frame in read]
                    yield RecordedPair(f"frame {index}", pictures[0], pictures[1] if right is not None else None)
        finally:
            for capture in captures:
                capture.release()

    return -(-frames // step), pairs()
