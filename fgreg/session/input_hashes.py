"""SHA-256 hashes of a session's files: what something was made from."""

from __future__ import annotations

import hashlib

from fgreg.session.event_reader import frames_of
from fgreg.session.file_hash import file_hash
from fgreg.session.session_reader import EVENTS_FILE, SETUP_FILE, Session


def input_hashes(session: Session) -> dict[str, str]:
    """SHA-256 of a session's files; of its frames over their hashes, in the order in which events name them.

    Raises:
        InputError: a file cannot be read.
    """
    folder = session.folder.resolve()
    frames = [use.path for event in session.events for use in frames_of(event, EVENTS_FILE, folder)]
    out = {name: file_hash(folder / name) for name in (SETUP_FILE, EVENTS_FILE)}
    if frames:
        out["frames"] = hashlib.sha256("".join(map(file_hash, frames)).encode()).hexdigest()
    return out
