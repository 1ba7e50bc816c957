"""Looks and checks of a live session as the events that are recorded. Pure; angles of events are the device's."""

from __future__ import annotations

import math

import numpy as np

from fgreg.detection.check_points import check_measurement, known_point
from fgreg.live.actions import LocatedPulse
from fgreg.live.merge_looks import Spot
from fgreg.model.events import (
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
