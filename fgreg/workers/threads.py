"""Limits linear algebra and OpenCV to one thread per process, since there are as many processes as cores.

The libraries read the number from the environment when they are loaded, so this module loads nothing.
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
    """Processes started and libraries imported in the block use one thread, unless the user has set a number."""
    before = {name: os.environ.get(name) for name in NAMES}
    os.environ.update({name: "1" for name, value in before.items() if value is None})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)


SWITCH_S = 0.0005
"""The interpreter's switch interval (default 0.005). Threads that receive or record need the interpreter several times
per frame, and so does the loop after each call into NumPy or OpenCV."""


@contextmanager
def undisturbed() -> Iterator[None]:
    """A short switch interval, and existing objects kept out of garbage collection, which takes 40 ms each time."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
        sys.setswitchinterval(before)
