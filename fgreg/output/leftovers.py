"""What an interrupted run left beside its output, and how to take it back."""

from __future__ import annotations

import os
import re
import shlex
from pathlib import Path

from fgreg.output.atomic_file import OLDER, PART, SWAP, lock, short_name
from fgreg.output.session_folder import other_files

_TEMPORARY = re.compile(rf"\.(.+)\.[0-9a-f]{{12,16}}\.({PART}|{SWAP}|{OLDER})", re.DOTALL)


def leftovers(path: Path) -> list[str]:
    """One sentence for each thing that an interrupted run left beside ``path``, or in it where it is a folder.

    What a process writes now is locked, and none.
    """
    path = Path(os.path.realpath(path))
    found = [text for entry in _temporary(path.parent, short_name(path)) if (text := _sentence(entry, path))]
    inside = _temporary(path, None) if path.is_dir() else []
    for entry in inside:
        name = _TEMPORARY.fullmatch(entry.name)
        if name is not None and (text := _sentence(entry, path / name[1])):
            found.append(text)
    return found


def _temporary(folder: Path, name: str | None) -> list[Path]:
    """Entries of a folder with a temporary name, of the output ``name`` or of any."""
    try:
        entries = sorted(folder.iterdir())
    except OSError:
        return []
    matches = ((entry, _TEMPORARY.fullmatch(entry.name)) for entry in entries)
    return [entry for entry, match in matches if match is not None and name in (None, match[1])]


def _sentence(entry: Path, path: Path) -> str:
    """What a leftover is; empty where it is in use or gone by now."""
    try:
        handle = os.open(entry, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return ""
    try:
        if not lock(handle):
            return ""
    except OSError:  # no locks here: what is being written looks the same
        if entry.name.endswith(f".{PART}"):
            return ""
    finally:
        os.close(handle)
    quoted, place = shlex.quote(str(entry)), shlex.quote(str(path))
    if entry.name.endswith(f".{PART}"):
        return f"{entry} is left of an interrupted run that did not complete {path.name}; delete it: rm -r {quoted}"
    which = "the older" if entry.name.endswith(f".{OLDER}") else "the new or the older"
    aside = f", after moving {path.name} elsewhere" if os.path.lexists(path) else ""
    others = other_files(entry) if entry.is_dir() else []
    more = ", and others" if others[1:] else ""
    keep = f" (with {others[0]}, which is not the session's{more}: keep that)" if others else ""
    return (
        f"{entry} is {which} {path.name}, left of a run that was interrupted while it replaced it; "
        f"restore it{aside}: mv {quoted} {place}; or delete it{keep}"
    )
