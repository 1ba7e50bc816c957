"""Where to turn the stage for a beam: absolute angle with its sigma, from a snapshot of the estimate.

With the PM heard now (the paper's Eq. 11): lambda and theta' given the registration. Here the registration and the
beam enter with their covariance, the marker and the look with theirs, so the answer is the posterior of the PM's angle
given the session and the query; the session's estimate itself is not touched. With nothing heard, lambda comes from
the tissue surface that the PMs so far trace.

A query takes a fraction of a millisecond: it works on one PM, in plain floats where numpy's calls would dominate.
"""

from __future__ import annotations

import math

import numpy as np

from fgreg.estimate import TrackEstimate, Verdict
from fgreg.measurements import Track
from fgreg.surface import GRAZING
from fgreg.tracking.beam import MARKER, joint_covariance, place_beam, read_marker
from fgreg.tracking.looks import Placed, place_pm
from fgreg.tracking.prepared import Prepared, prepare
from fgreg.tracking.snapshot import Snapshot

_NOTHING = [0.0] * MARKER


def track(query: Track, snapshot: Snapshot) -> TrackEstimate:
    """Answer one query; ``stage_rad`` None with a reason where it cannot be answered."""
    epoch = snapshot.epoch(query.epoch)
    if epoch is None:
        if query.epoch < snapshot.oldest:
            text = f"camera epoch {query.epoch} is over: queries are answered from epoch {snapshot.oldest} on"
            return _refused(query, snapshot, text)
        return _refused(query, snapshot, f"camera epoch {query.epoch} has no registration")
    if epoch.verdict is Verdict.REFUSED:
        why = f": {epoch.reason}" if epoch.reason else ""
        return _refused(query, snapshot, f"the registration of camera epoch {query.epoch} is refused{why}")
    at = prepare(snapshot, epoch)
    placed = place_pm(query, snapshot, at) if query.looks else _from_surface(query, snapshot, at)
    if isinstance(placed, str):
        return _refused(query, snapshot, placed)
    device_rad = snapshot.stage.device_from_scan(placed.scan_rad)
    low, high = snapshot.stage.limits_device_rad
    for turned in (device_rad, device_rad - 2.0 * math.pi, device_rad + 2.0 * math.pi):
        if low <= turned <= high:
            lambda_mm = placed.lambda_mm - snapshot.origin_shift_mm
            return TrackEstimate(query.t, turned, placed.sigma_rad, lambda_mm, snapshot.causal)
    reason = f"the stage would have to turn to {math.degrees(device_rad):.1f} deg, outside its limits"
    limits = f"{math.degrees(low):.0f} to {math.degrees(high):.0f} deg"
    return _refused(query, snapshot, f"{reason} {limits}")


def _refused(query: Track, snapshot: Snapshot, reason: str) -> TrackEstimate:
    return TrackEstimate(query.t, None, None, None, snapshot.causal, reason)


def _from_surface(query: Track, snapshot: Snapshot, at: Prepared) -> Placed | str:
    """The beam's end on the tissue surface, or why not."""
    if snapshot.surface is None:
        return "no PM is heard and the session's PMs trace no surface yet (at least 5, not in a row)"
    marker = read_marker(query.marker, floor=False)
    beam = place_beam(at.place, marker, _NOTHING)
    along = np.array(beam.along)
    met = snapshot.surface.meet(np.array(beam.start), along)
    if met is None:
        return "no PM is heard and the beam misses the part of the surface that the session's PMs trace"
    # The end moves with the beam's point there and slides along the beam to stay on the surface.
    _, y, z = met.trus_p.tolist()
    by_point = np.array([0.0, z, -y]) / (y * y + z * z)
    towards = max(float(along @ met.normal), 0.5 * GRAZING)
    slide = float(by_point @ along) / towards
    by_end = (by_point - slide * met.normal) @ beam.rotation
    moves = beam.moves(met.distance_mm)
    turns = moves - beam.moves(met.distance_mm - 1.0)
    # How the angle, the way along the beam and (by how far the beam turns) the angle per way respond to the variables.
    response = np.stack([by_end @ moves, (met.normal / -towards) @ beam.rotation @ moves, by_end @ turns])
    spread = response @ joint_covariance(at, [marker]) @ response.T
    way = float(spread[1, 1]) + (met.sigma_mm / towards) ** 2
    # The product of the last two is what is left of second order: its variance, for Gaussians.
    variance = float(spread[0, 0] + way * spread[2, 2] + 2.0 * spread[1, 2] ** 2) + (slide * met.sigma_mm) ** 2
    return Placed(math.atan2(y, z), math.sqrt(variance), met.distance_mm)
