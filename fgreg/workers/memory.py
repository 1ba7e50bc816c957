"""Keeps freed memory in the process: arrays of some 100 kB are made and freed thousands of times in a solve.

The C library gives the memory of each back to the system, and the system clears every page of it again for the next
one: two fifths of the time of sampling a posterior.
"""

from __future__ import annotations

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
KEPT_BYTES, LARGEST_BYTES = 128 << 20, 32 << 20
"""Free memory that is kept; blocks from the second size on go back to the system as before. glibc takes both up to
such values by itself, while ever larger blocks are freed."""


def keep_freed_memory() -> bool:
    """Do so from now on, where the C library is glibc; returns whether it is. For processes of our own."""
    if sys.platform != "linux":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError):  # another C library
        return False
    return bool(mallopt(_MMAP_THRESHOLD, LARGEST_BYTES)) and bool(mallopt(_TRIM_THRESHOLD, KEPT_BYTES))
