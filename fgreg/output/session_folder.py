"""Folders of sessions that are complete or absent; an older session is replaced in one step, and only that.

Of an older session only its own files are replaced: ``session.yaml``, ``events.jsonl`` and what was cut off from it,
``ground_truth.yaml``, ``result.yaml``, the stage's orders, the rig and the frames that it names. Everything else in the
folder goes over into the new one. A session that another process records is never touched.
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from fgreg.errors import InputError
from fgreg.output.atomic_file import OLDER, PART, SESSION_FILES, SWAP, beside, lock, sync_folder, why_refused

SETUP_FILE, EVENTS_FILE = SESSION_FILES[:2]
STAGE_LOG = "stage-orders.log"
CUT_SUFFIX = ".cut"
"""What was cut off from ``events.jsonl`` is kept in a file with this after its name, and a number from the second."""

_FORMAT = b"fgreg-session/"
_RIG = re.compile(r"""^["']?rig["']?\s*:\s*["']?([^"'#\s]+)""", re.MULTILINE)
_FRAME_KEYS = ("left", "right", "frame")
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2


def check_folder(folder: Path, *, overwrite: bool = False) -> Path:
    """Whether a session can be written to ``folder``, to be asked before the work begins; returns it without links.

    Raises:
        InputError: it is not new or empty, nor, with ``overwrite``, a session; or another process records to it.
    """
    try:
        place = Path(os.path.realpath(folder))
        if os.path.lexists(place) and (not place.is_dir() or any(place.iterdir())):
            found = "a folder that is not empty" if place.is_dir() else "a file"
            if not overwrite:
                raise InputError(str(folder), found, "a new or empty folder, or --overwrite")
            if not _is_session(place):
                raise InputError(str(folder), "no session to overwrite", f"a folder with the {SETUP_FILE} of a session")
            with _unrecorded(place):
                pass
        within = (place, *place.parents) if not _is_session(place) else place.parents
        above = next((parent for parent in within if os.path.lexists(parent)), place)
        if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
            raise InputError(str(folder), f"{above}, which cannot be written to", "a writable place")
    except (OSError, ValueError) as error:
        raise InputError(str(folder), f"no access ({why_refused(error)})", "a writable place") from None
    return place


@contextmanager
def new_session(folder: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder that becomes ``folder`` at the end of the block, and is removed after an exception.

    Args:
        folder: new or empty; with ``overwrite`` also a session, which is locked and replaced when the new one is
            complete.

    Raises:
        InputError: as :func:`check_folder`, the system refuses, or a file in the folder that is not the session's has
            the name of a new one.
    """
    place = check_folder(folder, overwrite=overwrite)
    with ExitStack() as stack:
        replaced = _is_session(place)
        if replaced:
            stack.enter_context(_unrecorded(place))
        try:
            # An empty folder may be somebody's working directory or a mount: it stays, and the new one is made inside.
            inside = place.is_dir() and not replaced
            part = beside(place / place.name if inside else place, PART)
            part.mkdir(parents=True)
            stack.callback(shutil.rmtree, part, ignore_errors=True)
            handle = os.open(part, os.O_RDONLY | os.O_CLOEXEC)
            stack.callback(os.close, handle)
            with suppress(OSError):  # a file system without locks
                lock(handle)
            yield part
            if replaced:
                _sync(part)
                _replace(part, place)
            elif inside:  # session.yaml comes last: without it there is no session
                for entry in sorted(part.iterdir(), key=lambda entry: entry.name == SETUP_FILE):
                    entry.rename(place / entry.name)
            else:
                part.rename(place)
            sync_folder(place.parent)
        except OSError as error:
            raise InputError(
                str(folder), f"a place that refuses files ({why_refused(error)})", "a writable one"
            ) from None


def _is_session(folder: Path) -> bool:
    file = folder / SETUP_FILE
    if file.is_symlink() or not file.is_file():
        return False
    with file.open("rb") as stream:
        return _FORMAT in stream.read(1_000_000)


@contextmanager
def _unrecorded(folder: Path) -> Iterator[None]:
    """Hold the lock of a session's recorder.

    Raises:
        InputError: another process records to it.
        OSError: it cannot be read.
    """
    try:
        handle = os.open(folder / EVENTS_FILE, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        yield
        return
    try:
        alone = True
        with suppress(OSError):  # where there are no locks nobody records
            alone = lock(handle)
        if not alone:
            raise InputError(str(folder), "a session that another program is recording", "one that nobody records")
        yield
    finally:
        os.close(handle)


def own_files(folder: Path) -> set[Path]:
    """Files of a session, relative to its folder: by their names, and those that its set-up and its events name."""
    names = [*SESSION_FILES, STAGE_LOG, *(path.name for path in folder.glob(f"{EVENTS_FILE}{CUT_SUFFIX}*"))]
    with suppress(OSError):
        names += _RIG.findall((folder / SETUP_FILE).read_text(encoding="utf-8", errors="replace"))
    with suppress(OSError):
        if (folder / EVENTS_FILE).is_file():  # a pipe would be waited for
            with (folder / EVENTS_FILE).open("rb") as lines:
                for line in lines:
                    with suppress(ValueError, RecursionError):
                        names += _frames(json.loads(line))
    found = {Path(os.path.normpath(name)) for name in names if "\0" not in name}
    inside = {path for path in found if not path.is_absolute() and ".." not in path.parts}
    return {path for path in inside if (real := folder / path).is_file() and os.path.realpath(real) == str(real)}


def _frames(value: object) -> Iterator[str]:
    if isinstance(value, dict):
        for key, entry in value.items():
            if key in _FRAME_KEYS and isinstance(entry, str):
                yield entry
            else:
                yield from _frames(entry)
    elif isinstance(value, list):
        for entry in value:
            yield from _frames(entry)


def _replace(part: Path, place: Path) -> None:
    """Put a complete new session in the place of an older one; files that are not the older one's go over.

    Raises:
        InputError: one of these has the name of a new file, or cannot be moved: it is named, and stays where it is.
        OSError: the system refuses.
    """
    own, others = own_files(place), other_files(place)
    for path in others:
        if any(os.path.lexists(part / above) and not (part / above).is_dir() for above in path.parents) or (
            os.path.lexists(part / path)
        ):
            raise InputError(str(place / path), "a file that the older session does not name", "it elsewhere")
    new = part.rename(beside(place, SWAP))
    older = new
    if not _exchange(new, place):
        older = place.rename(beside(place, OLDER))
        try:
            new.rename(place)
        except BaseException:
            if not os.path.lexists(place):
                older.rename(place)
                new.rename(part)
            raise
    sync_folder(place.parent)
    for path in others:
        try:
            (place / path).parent.mkdir(parents=True, exist_ok=True)
            (older / path).rename(place / path)
        except OSError as error:
            found = f"a file that cannot go over into the new session ({why_refused(error)})"
            raise InputError(str(older / path), found, "it moved by hand") from None
    for path in own:
        (older / path).unlink(missing_ok=True)
    for folder, _, _ in os.walk(older, topdown=False):
        with suppress(OSError):  # not empty: something came meanwhile
            Path(folder).rmdir()


def other_files(folder: Path) -> list[Path]:
    """Everything in a session's folder that is not its own, relative to it; links to folders are files here."""
    found, own = [], own_files(folder)
    for root, folders, files in os.walk(folder):
        links = [name for name in folders if (Path(root) / name).is_symlink()]
        found += [(Path(root) / name).relative_to(folder) for name in [*files, *links]]
    return sorted(path for path in found if path not in own)


def _exchange(a: Path, b: Path) -> bool:
    """Exchange two names in one step; False where the system or the file system has no such call.

    Raises:
        OSError: it refuses for another reason.
    """
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "renameat2"):
        return False
    if library.renameat2(_AT_FDCWD, os.fsencode(a), _AT_FDCWD, os.fsencode(b), _RENAME_EXCHANGE) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP, errno.EPERM):
        return False
    raise OSError(code, os.strerror(code))


def _sync(folder: Path) -> None:
    """Flush a folder and everything in it to disk."""
    for root, _, files in os.walk(folder, topdown=False):
        for name in files:
            handle = os.open(Path(root) / name, os.O_RDONLY | os.O_CLOEXEC)
            try:
                os.fsync(handle)
            finally:
                os.close(handle)
        sync_folder(Path(root))
