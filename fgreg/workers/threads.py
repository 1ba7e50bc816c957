"""How many threads linear algebra and OpenCV take: one a process, where there are as many processes as cores.

Their libraries read that from the environment when they are loaded, so this module loads nothing.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

NAMES = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """What is started or imported within uses one thread for these, unless the user has said how many."""
    before = {name: os.environ.get(name) for name in NAMES}
    os.environ.update({name: "1" for name, value in before.items() if value is None})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


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
