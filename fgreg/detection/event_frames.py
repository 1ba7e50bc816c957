"""Marker, board and photoacoustic source in the frames that events name, detected in threads.

OpenCV, numpy and scipy's transforms release the interpreter lock. This module loads OpenCV: events with poses and
points do not need it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.detection.board import detect_board
from fgreg.detection.frame_files import Picture, read_array, read_picture
from fgreg.detection.marker import detect_marker
from fgreg.detection.photoacoustic import locate_in_frame
from fgreg.detection.results import FrameResults
from fgreg.errors import InputError
from fgreg.model.camera_model import StereoRig
from fgreg.model.events import (
    Event,
    MarkerRecord,
    PairEvent,
    Shot,
    TrackEvent,
    looks_of,
    needs_board,
    needs_marker_frames,
)
from fgreg.model.session_model import SessionModel
from fgreg.session.frame_files import check_camera_frame, check_trus_frame

Progress = Callable[[int, int], None]
"""Called with (frames done, total frames)."""


def load_picture(path: Path, line: int, key: str, rig: StereoRig | None) -> Picture:
    """Read an endoscope frame that an event names.

    Raises:
        InputError: missing, not an upright, opaque PNG image of the camera's size, or not decodable.
    """
    where = f"events.jsonl: line {line}: {key}"
    check_camera_frame(path, path.name, where, None if rig is None else rig.left.image_size)
    try:
        picture = read_picture(path)
    except InputError as error:
        raise InputError(where, f"{path.name}: {error.found}", error.expected) from None
    if picture is None:
        raise InputError(where, f"{path.name}, whose pixels cannot be decoded", "a PNG image")
    return picture


def load_trus_frame(path: Path, line: int, key: str, model: SessionModel) -> npt.NDArray[Any]:
    """Read a probe frame that an event names.

    Raises:
        InputError: missing, not an NPY array that fits this probe, or not finite.
    """
    where = f"events.jsonl: line {line}: {key}"
    check_trus_frame(path, path.name, where, model.probe)
    frame = read_array(path)
    if frame is None:
        raise InputError(where, f"{path.name}, which cannot be read", "an NPY array")
    return frame


def marker_pictures(record: MarkerRecord, line: int, rig: StereoRig) -> tuple[Picture, Picture | None]:
    """Left and right frame of a shot; the right one only where the rig has a right camera."""
    if record.left is None:
        raise AssertionError("no frames to load")
    left = load_picture(record.left, line, "marker.left", rig)
    both = record.right is not None and rig.right is not None
    right = load_picture(record.right, line, "marker.right", rig) if both and record.right is not None else None
    return left, right


@contextmanager
def _refusing(where: str) -> Iterator[None]:
    """Turn a detector's error about a frame into an input error that names the event.

    Raises:
        InputError: instead of ValueError, OverflowError or LinAlgError.
    """
    try:
        yield
    except (ValueError, OverflowError, np.linalg.LinAlgError) as error:
        raise InputError(where, f"a frame that cannot be used ({error})", "one as session.yaml says") from error


def detect_in_frames(
    events: Sequence[Event], model: SessionModel, *, redetect: bool = False, progress: Progress | None = None
) -> FrameResults:
    """Detect marker, board and photoacoustic source in the frames, as far as the events need them.

    Args:
        events: as read.
        model: the session's set-up.
        redetect: use the frames even where a pose is recorded.
        progress: called after each frame.

    Raises:
        InputError: a frame is missing or invalid; of several the first in the events' order.
    """
    found = FrameResults()
    rig, marker, board = model.camera, model.marker, model.board
    jobs: list[Callable[[], None]] = []

    def optical(index: int, event: Shot) -> None:
        wants_marker = needs_marker_frames(event.marker, redetect=redetect)
        if rig is None:
            raise InputError("session.yaml: camera", "nothing", f"the cameras, for line {event.line} of events.jsonl")
        if wants_marker and marker is None:
            raise InputError("session.yaml: marker", "nothing", f"the marker, for line {event.line} of events.jsonl")
        left, right = marker_pictures(event.marker, event.line, rig)
        with _refusing(f"events.jsonl: line {event.line}: marker"):
            if wants_marker and marker is not None:
                found.markers[index] = detect_marker(left, right, rig, marker)
            if needs_board(event) and board is not None:
                found.boards[index] = detect_board(left, right, rig, board)

    def acoustic(index: int, number: int, event: PairEvent | TrackEvent, path: Path) -> None:
        key = "trus.frame" if len(looks_of(event)) == 1 else f"looks[{number}].frame"
        frame = load_trus_frame(path, event.line, key, model)
        with _refusing(f"events.jsonl: line {event.line}: {key}"):
            found.finds[index, number] = locate_in_frame(frame, model.probe)

    for index, event in enumerate(events):
        if isinstance(event, Shot) and (needs_board(event) or needs_marker_frames(event.marker, redetect=redetect)):
            jobs.append(partial(optical, index, event))
        if isinstance(event, PairEvent | TrackEvent):
            for number, look in enumerate(looks_of(event)):
                if look.needs_frame and look.frame is not None:
                    jobs.append(partial(acoustic, index, number, event, look.frame))
    _run(jobs, progress)
    return found


def _run(jobs: Sequence[Callable[[], None]], progress: Progress | None) -> None:
    """Run all jobs in threads; raises the first error in the events' order."""
    if not jobs:
        return
    with ThreadPoolExecutor(max_workers=min(8, os.cpu_count() or 1)) as pool:
        futures = [pool.submit(job) for job in jobs]
        try:
            for done, future in enumerate(futures, 1):
                future.result()
                if progress is not None:
                    progress(done, len(jobs))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
