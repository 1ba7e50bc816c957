"""Looks, checks and camera moves of a live session as recorded events. Pure; angles of events are the device's."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from fgreg.detection.check_points import check_measurement, known_point
from fgreg.live.actions import LocatedPulse
from fgreg.live.merge_looks import Spot
from fgreg.live.scope_holder import HolderMove
from fgreg.model.events import (
    CameraMovedEvent,
    CheckEvent,
    MarkerRecord,
    OtherRecord,
    PairEvent,
    PlaneRecord,
    PointEvent,
    TrackEvent,
    TrusRecord,
)
from fgreg.model.session_model import SessionModel, StageModel


def look_record(look: LocatedPulse, stage: StageModel) -> TrusRecord:
    """A look as recorded."""
    if look.scan_rad is None:
        raise AssertionError("a look without a plane angle")
    return TrusRecord(
        math.degrees(stage.device_from_scan(look.scan_rad)),
        look.x_mm,
        look.range_mm,
        covariance=look.covariance,
        amplitude=look.amplitude,
        others=tuple(OtherRecord(other.x_mm, other.range_mm, other.covariance) for other in look.others),
        sweep=stage.direction * look.sweep,
    )


def pair_events(pm: int, spot: Spot, start_s: float, stage: StageModel) -> list[PairEvent]:
    """The looks at a PM; ``start_s``: host time of session time 0."""
    marker = MarkerRecord(spot.marker.parent_T_child, spot.marker.covariance)
    return [PairEvent(max(0.0, look.pulse_s - start_s), 0, pm, marker, look_record(look, stage)) for look in spot.looks]


def query_event(looks: list[PairEvent]) -> TrackEvent:
    """Looks at one PM as a query, which no estimate takes in."""
    last = looks[-1]
    if len(looks) == 1:
        return TrackEvent(last.t, 0, last.marker, last.trus)
    return TrackEvent(last.t, 0, last.marker, several=tuple(look.trus for look in looks))


def point_event(
    kind: type[CheckEvent] | type[PointEvent], t: float, point: tuple[float, ...], scan_rad: float, model: SessionModel
) -> CheckEvent | PointEvent | str:
    """A check or a known point, or why there is none."""
    rig = model.camera
    if rig is None or rig.right is None:
        return "session.yaml has no stereo camera"
    device = math.degrees(model.stage.device_from_scan(scan_rad))
    plane = PlaneRecord(device, point[4], point[5])
    event = kind(t, 0, left=np.array(point[:2]), right=np.array(point[2:4]), trus=plane)
    why = known_point(event, 0, model) if isinstance(event, PointEvent) else check_measurement(event, 0, model)
    return why if isinstance(why, str) else event


def move_event(
    t: float, by_tags: HolderMove | None, by_holder: Sequence[HolderMove], session_t: Callable[[float], float]
) -> CameraMovedEvent:
    """A camera move that has ended: by the static tags where they measured it, as they are more accurate.

    Args:
        t: session time at which it ended. session_t: session time of a host time.
        by_tags, by_holder: what they show of it.
    """
    measured = by_holder if by_tags is None or by_tags.covariance is None else [by_tags]
    motion, covariance = None, None
    if len(measured) == 1:  # of several in a row one may be missing
        motion, covariance = measured[0].camera_new_T_camera_old, measured[0].covariance
    if by_tags is None or (by_tags.reported and motion is None):  # else it would count as a move that no one reported
        return CameraMovedEvent(t, 0, motion, covariance)
    # Noticed some frames after it: pairs in between belong to the new epoch.
    return CameraMovedEvent(t, 0, motion, covariance, detected=True, since_t=min(t, session_t(by_tags.since_s)))
