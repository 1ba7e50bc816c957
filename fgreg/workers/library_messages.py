"""What C libraries print to file descriptor 2 in a block: the only way in which some tell of damage."""

from __future__ import annotations

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_ONE = threading.Lock()


@contextmanager
def printed_by_libraries() -> Iterator[list[bytes]]:
    """Gives a list of one text, filled when the block ends. One thread at a time; the others wait.

    What other threads print to the descriptor meanwhile is in the text too; all of it is passed on afterwards.
    """
    said = [b""]
    with _ONE, tempfile.TemporaryFile(buffering=0) as file:
        before = os.dup(2)
        try:
            os.dup2(file.fileno(), 2)
            try:
                yield said
            finally:
                os.dup2(before, 2)
            file.seek(0)
            said[0] = file.read()
            if said[0]:
                os.write(2, said[0])
        finally:
            os.close(before)
