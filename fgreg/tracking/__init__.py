"""Tracking queries: where to turn the stage for a beam, from a snapshot of the estimate."""

from fgreg.tracking.answer import fast_track
from fgreg.tracking.context import TrackContext, track
from fgreg.tracking.snapshot import EpochSnapshot, Snapshot, make_snapshot

__all__ = [
    "EpochSnapshot",
    "Snapshot",
    "TrackContext",
    "fast_track",
    "make_snapshot",
    "track",
]
