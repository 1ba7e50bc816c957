"""SHA-256 hashes of a session's files: what something was made from, and whether that has changed since."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

from fgreg.errors import InputError
from fgreg.model.estimate import SessionEstimate
from fgreg.session.event_reader import frames_of
from fgreg.session.file_hash import file_hash
from fgreg.session.session_reader import EVENTS_FILE, SETUP_FILE, Session, read_session, session_place

FRAMES = "frames"
_ABSENT = "absent"
"""Stands for a frame that is named, but not there: a pose is recorded beside it."""


def read_with_hashes(folder: str | Path) -> tuple[Session, dict[str, str]]:
    """Read a session, and the SHA-256 of what it is made of: its files, its rig, and its frames where it has some.

    Files are hashed before they are read, so that what is made from a file that changes meanwhile counts as stale.

    Raises:
        InputError: as :func:`fgreg.session.session_reader.read_session`, or a file cannot be read.
    """
    place = session_place(Path(folder))
    hashes = {name: file_hash(place / name) for name in (SETUP_FILE, EVENTS_FILE) if (place / name).is_file()}
    session = read_session(folder)
    if session.model.rig_file is not None:
        hashes[session.model.rig_file.relative_to(place).as_posix()] = file_hash(session.model.rig_file)
    frames = _frames_hash(session)
    return session, hashes if frames is None else {**hashes, FRAMES: frames}


def changed_inputs(folder: Path, inputs: Mapping[str, str]) -> list[str]:
    """Which of the hashed inputs in a session's folder are not what they were: names, and ``frames``."""
    changed = []
    for name, before in inputs.items():
        try:
            if name != FRAMES and file_hash(folder / name) != before:
                changed.append(name)
        except InputError:
            changed.append(name)
    if not changed:  # the events are those of then, so that they name the same frames
        try:
            if _frames_hash(read_session(folder)) != inputs.get(FRAMES):
                changed.append(FRAMES)
        except InputError:
            changed.append(FRAMES)
    return changed


def stale(result: Path, estimate: SessionEstimate) -> str:
    """Why a result in a session's folder is not one of the session as it is; empty where it is one.

    Raises:
        InputError: that cannot be told: the result names no inputs, or there is no session beside it.
    """
    if not estimate.inputs:
        raise InputError(f"{result}: inputs", "none", "the SHA-256 of what it was made from: solve the session again")
    if not (result.parent / SETUP_FILE).exists():
        raise InputError(str(result), "no session beside it", f"the {SETUP_FILE} that it was made from")
    changed = changed_inputs(result.parent.resolve(), estimate.inputs)
    return f"a stale result: {' and '.join(changed)} changed since it was made" if changed else ""


def _frames_hash(session: Session) -> str | None:
    """The hash over the hashes of all frames, in the order in which events name them; None where they name none.

    Raises:
        InputError: one cannot be read.
    """
    folder = session.folder.resolve()
    frames = [use.path for event in session.events for use in frames_of(event, EVENTS_FILE, folder)]
    if not frames:
        return None
    known = {path: file_hash(path) if path.is_file() else _ABSENT for path in dict.fromkeys(frames)}
    return hashlib.sha256("".join(known[path] for path in frames).encode()).hexdigest()
