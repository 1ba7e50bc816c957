"""SHA-256 of a file."""

from __future__ import annotations

import hashlib
from pathlib import Path

from fgreg.errors import InputError
from fgreg.output.atomic_file import why_refused


def file_hash(path: Path) -> str:
    """64 hexadecimal digits.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    if not path.is_file():  # a pipe would block
        raise InputError(str(path), "no regular file", "a session's file")
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError) as error:
        raise InputError(str(path), f"a file that cannot be read ({why_refused(error)})", "a session's file") from None
