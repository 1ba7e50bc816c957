"""Tracking queries: where to turn the stage for a beam, from a snapshot of the estimate."""

from fgreg.tracking.query import track
from fgreg.tracking.snapshot import EpochSnapshot, Snapshot, make_snapshot

__all__ = [
    "EpochSnapshot",
    "Snapshot",
    "make_snapshot",
    "track",
]
