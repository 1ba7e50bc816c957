"""How many threads linear algebra takes: one a process, where there are as many processes as cores.

NumPy's library reads that from the environment when it is loaded, so this module loads nothing.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

NAMES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


@contextmanager
def one_thread_each() -> Iterator[None]:
    """What is started or imported within uses one thread for linear algebra, unless the user has said how many."""
    before = {name: os.environ.get(name) for name in NAMES}
    os.environ.update({name: "1" for name, value in before.items() if value is None})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
