"""Atomic output: a file or folder is written whole or not at all, and replaced only with ``overwrite``."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fgreg.errors import InputError
from fgreg.session.atomic_file import write_atomically
from fgreg.session.session_reader import SETUP_FILE

_SESSION_FILES = frozenset({"session.yaml", "events.jsonl", "ground_truth.yaml", "result.yaml"})


def write_whole(path: Path, text: str, *, overwrite: bool = False) -> None:
    """Write a text file atomically: it gets its name when all of it is on disk.

    Raises:
        InputError: the file exists and ``overwrite`` is not set, it is a session's own file, or it cannot be written.
    """
    if path.name in _SESSION_FILES:
        raise InputError(str(path), "the name of a session's own file", "another name")
    if path.is_dir():
        raise InputError(str(path), "a folder", "the name of a file")
    if os.path.lexists(path) and not overwrite:
        raise InputError(str(path), "a file of this name", "a new name, or --overwrite")
    write_atomically(path, text)


@contextmanager
def whole_folder(folder: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder that is renamed to ``folder`` at the end of the block, and removed after an exception.

    Args:
        folder: new or empty; with ``overwrite`` also one with a session, which is replaced when the new one is
            complete.

    Raises:
        InputError: ``folder`` has other contents, or cannot be written.
    """
    folder = Path(os.path.abspath(folder))  # noqa: PTH100  (keeps the link that the user named)
    if os.path.lexists(folder) and (not folder.is_dir() or any(folder.iterdir())):
        if not overwrite:
            raise InputError(str(folder), "something that is no empty folder", "a new or empty one, or --overwrite")
        if not (folder / SETUP_FILE).is_file():
            raise InputError(str(folder), "no session to overwrite", f"a folder with a {SETUP_FILE}")
    token = secrets.token_hex(6)
    part, older = (folder.with_name(f".{folder.name[:100]}.{token}.{kind}") for kind in ("part", "older"))
    try:
        part.mkdir(parents=True)
        try:
            yield part
            if os.path.lexists(folder):
                folder.rename(older)
            try:
                part.rename(folder)
            except OSError:
                if older.exists():
                    older.rename(folder)
                raise
        finally:
            shutil.rmtree(part, ignore_errors=True)
        shutil.rmtree(older, ignore_errors=True)
    except OSError as error:
        raise InputError(str(folder), f"a place that refuses files ({error.strerror})", "a writable one") from None
