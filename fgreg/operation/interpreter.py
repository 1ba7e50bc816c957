"""The interpreter as the camera's loop needs it: its thread shares it with those that receive and record."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager

SWITCH_S = 0.0005
"""After so long a thread at work lets another have the interpreter (Python's own: 0.005). One that receives or records
asks for it several times a frame, and so does the loop after each call into NumPy or OpenCV."""


@contextmanager
def undisturbed() -> Iterator[None]:
    """Short turns for each thread, and no search for garbage in what there is by now: that takes 40 ms each time."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
        sys.setswitchinterval(before)
