"""Files that are complete or absent."""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path

from fgreg.errors import InputError


def write_atomically(path: Path, text: str) -> None:
    """Write to a temporary file in the same folder, which is then renamed; an older file is replaced.

    Raises:
        InputError: the file cannot be written.
    """
    temporary = path.with_name(f".{path.name[:100]}.{secrets.token_hex(8)}.tmp")
    try:
        try:
            with temporary.open("x", encoding="utf-8", newline="\n") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        _sync_folder(path.parent)
    except OSError as error:
        raise InputError(
            str(path), f"a file that cannot be written ({why_refused(error)})", "a writable place"
        ) from None


def _sync_folder(folder: Path) -> None:
    """Flush a rename to disk; file systems that do not support it are ignored."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def why_refused(error: OSError | ValueError) -> str:
    """An error of the file system, in its own words."""
    return getattr(error, "strerror", None) or str(error)
