"""SHA-256 hashes of a session's files: what something was made from."""

from __future__ import annotations

import hashlib
from pathlib import Path

from fgreg.errors import InputError
from fgreg.session.atomic_file import why_refused
from fgreg.session.event_reader import frames_of
from fgreg.session.session_reader import EVENTS_FILE, SETUP_FILE, Session


def input_hashes(session: Session) -> dict[str, str]:
    """SHA-256 of a session's files; of its frames over their hashes, in the order in which events name them.

    Raises:
        InputError: a file cannot be read.
    """
    folder = session.folder.resolve()
    frames = [use.path for event in session.events for use in frames_of(event, EVENTS_FILE, folder)]
    out = {name: _file_hash(folder / name) for name in (SETUP_FILE, EVENTS_FILE)}
    if frames:
        out["frames"] = hashlib.sha256("".join(map(_file_hash, frames)).encode()).hexdigest()
    return out


def _file_hash(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(str(path), f"a file that cannot be read ({why_refused(error)})", "a session's file") from None
