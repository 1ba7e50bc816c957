"""A folder of pictures played as a video, with the methods of cv2.VideoCapture that are used.

Pictures are ordered by the last number in their names if all have one, else by name. The number also gives the time, at
``fps`` numbers per second from the lowest one, so a picture that is missing in one of two folders shifts no other.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fgreg.detection.frame_files import read_picture
from fgreg.errors import InputError

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp")
_NUMBER = re.compile(r"(\d+)(?!.*\d)")
_MAX_GAP = 100_000


@dataclass(slots=True)
class FolderCapture:
    """Pictures in order, and the time of each (s); ``unreadable``: those that were left out up to now."""

    pictures: list[Path]
    times_s: list[float]
    unreadable: list[Path] = field(default_factory=list)
    _next: int = field(default=0)

    @classmethod
    def of(cls, where: Path, fps: float) -> FolderCapture:
        """All pictures of a folder, or those that a pattern names, such as ``left/*.png``.

        Raises:
            InputError: no folder, no pictures in it, or none that can be used.
        """
        folder, pattern = (where, "*") if where.is_dir() else (where.parent, where.name)
        if not folder.is_dir():
            raise InputError(str(where), "no such folder", "a folder of pictures")
        found = [path for path in folder.glob(pattern) if path.suffix.lower() in SUFFIXES and path.is_file()]
        if not found:
            raise InputError(str(where), "no pictures", f"files that end in {', '.join(SUFFIXES)}")
        first = min(found)
        try:
            read_picture(first)  # so that a kind that cannot be used is refused before anything is played
        except OSError as error:
            raise InputError(str(first), f"a file that cannot be read ({error.strerror})", "a picture") from None
        numbers = [int(match[1]) if (match := _NUMBER.search(path.stem)) else None for path in found]
        whole = [number for number in numbers if number is not None]
        spread = max(whole, default=0) - min(whole, default=0)
        if len(set(whole)) == len(found) and spread < _MAX_GAP + len(found):
            order = sorted(zip(whole, found, strict=True))
            return cls([path for _, path in order], [number / fps for number, _ in order])
        return cls(sorted(found), [i / fps for i in range(len(found))])

    def again(self) -> FolderCapture:
        """The same folder from the beginning."""
        return FolderCapture(self.pictures, self.times_s)

    def isOpened(self) -> bool:
        """Always True: the folder has been read."""
        return True

    def read(self) -> tuple[bool, Any]:
        """The next picture; pictures that cannot be decoded are left out. Raises InputError as ``read_picture``."""
        while self._next < len(self.pictures):
            try:
                picture = read_picture(self.pictures[self._next])
            except OSError:
                picture = None
            self._next += 1
            if picture is not None:
                return True, picture
            self.unreadable.append(self.pictures[self._next - 1])
        return False, None

    def get(self, property_id: int, /) -> float:
        """Time of the last picture, ms; nothing else is known."""
        if property_id == cv2.CAP_PROP_POS_MSEC and self._next:
            return 1000.0 * self.times_s[self._next - 1]
        return float(np.nan)

    def release(self) -> None:
        """Does nothing: no resource is held."""
