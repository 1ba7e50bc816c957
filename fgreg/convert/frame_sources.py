"""The frames that the rows of a table name: NPY files and pictures, or frames inside other programs' files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgreg.convert import child_reader
from fgreg.convert.array_files import ARRAY_SUFFIXES
from fgreg.convert.mapping import RecordingMapping
from fgreg.convert.probe_frames import DeclaredProbe, ProbeFrames
from fgreg.detection.frame_files import png_bytes, read_picture
from fgreg.errors import InputError
from fgreg.schema.files import exists
from fgreg.schema.limits import PICTURE_BYTES
from fgreg.schema.problems import shown
from fgreg.session.yaml_loader import read_bounded


class FrameSources:
    """Names in the session of the frames that rows name, and what is written under them.

    Args:
        mapping: how frames are stored in MATLAB and HDF5 files.
    """

    def __init__(self, mapping: RecordingMapping) -> None:
        self._mapping = mapping
        self._names: dict[tuple[Path, int | None], str] = {}
        self._opened: dict[Path, ProbeFrames] = {}

    @property
    def declared(self) -> list[DeclaredProbe]:
        """What the files of the frames say of the probe."""
        return [frames.declared for frames in self._opened.values()]

    def name(self, path: Path, text: str, index: int | None, where: str, suffix: str) -> str:
        """The name of a frame in the session; the same frame always has the same name.

        Args:
            path: the file.
            text: its name as given.
            index: number of the frame in a file of several, None where that is not said.
            where: the place of the name, for messages.
            suffix: ``.png`` of a picture, ``.npy`` of a frame of the probe.

        Raises:
            InputError: no such file or frame, or one of another kind.
        """
        if not exists(path) or not path.is_file():
            raise InputError(where, f"{shown(text)}: no such file", "a file relative to the table")
        if suffix == ".npy" and path.suffix.lower() in ARRAY_SUFFIXES:
            index = self._index(path, index, where)
        elif suffix == ".npy" and path.suffix.lower() != ".npy":
            expected = f"an NPY array, or a file that ends in {', '.join(ARRAY_SUFFIXES)}"
            raise InputError(where, shown(text), expected)
        else:
            index = None
        stem = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "_" for c in path.stem)[:60]
        number = "" if index is None else f"-{index:06d}"
        return self._names.setdefault((path, index), f"frames/{len(self._names):04d}-{stem}{number}{suffix}")

    def _index(self, path: Path, index: int | None, where: str) -> int:
        """The number of a frame in a file."""
        if path not in self._opened:
            frames = child_reader.open_array_file(path, self._mapping).frames
            if frames is None:
                raise InputError(
                    where, f"{shown(path.name)}, in which no array is called frame", "array.variable in the mapping"
                )
            self._opened[path] = frames
        count = self._opened[path].count
        if index is None and count != 1:
            raise InputError(
                f"{where}_index", "nothing", f"the number of one of the {count} frames in {path.name}, from 0"
            )
        if index is not None and not 0 <= index < count:
            raise InputError(
                f"{where}_index", str(index), f"a number below {count}, from 0: {path.name} has as many frames"
            )
        return index or 0

    def write(self, folder: Path) -> None:
        """Write all named frames; pictures of other formats are converted to PNG."""
        for (path, index), name in self._names.items():
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if index is not None:
                np.save(target, self._opened[path].frame(index), allow_pickle=False)
                continue
            data = read_bounded(path, str(path), PICTURE_BYTES)
            if not name.endswith(".npy"):
                picture = read_picture(path)  # of a PNG too: one that solve would refuse is refused here
                if picture is None:
                    raise InputError(str(path), "a file that is not an image", "a picture (PNG, JPEG, BMP, TIFF)")
                data = data if path.suffix.lower() == ".png" else png_bytes(picture)
            target.write_bytes(data)
