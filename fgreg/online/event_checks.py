"""Checks of events before they reach the graph."""

from __future__ import annotations

import math

import numpy as np

from fgreg.errors import EventRefused
from fgreg.geometry.transforms import FloatArray, is_rigid
from fgreg.model.measurements import Aim, MarkerObservation, Pair
from fgreg.online.events import CameraMoved, LoopClosed, OnlineEvent, StaticTags

INT64 = 2**63


def check(event: OnlineEvent, after: float) -> None:
    """Check an event: finite numbers, shapes, transforms, covariances, and a time that does not go back.

    ``after``: time (s) of the last event.

    Raises:
        EventRefused: with the first fault found.
    """
    if not isinstance(event, Aim | Pair | CameraMoved | StaticTags | LoopClosed):
        raise EventRefused(f"a {type(event).__name__} is not an event of a registration")
    if not math.isfinite(event.t):
        raise EventRefused(f"its time is {event.t}, expected a number")
    if event.t < after:
        raise EventRefused(f"its time is {event.t} s, before the last event's {after} s")
    if isinstance(event, Aim | Pair):
        _check_marker(event.marker)
    if isinstance(event, Aim):
        _array("camera_p_spot_mm", event.camera_p_spot_mm, (3,))
        _covariance("covariance of the spot", event.covariance, 3)
    elif isinstance(event, Pair):
        look = event.look
        for name in ("scan_rad", "scan_sigma_rad", "x_mm", "range_mm"):
            if not math.isfinite(getattr(look, name)):
                raise EventRefused(f"{name} is {getattr(look, name)}, expected a number")
        if look.range_mm <= 0.0:
            raise EventRefused(f"range_mm is {look.range_mm}, expected a number > 0")
        if look.amplitude is not None and not math.isfinite(look.amplitude):
            raise EventRefused(f"amplitude is {look.amplitude}, expected a number")
        if look.sweep not in (-1, 0, 1):
            raise EventRefused(f"sweep is {look.sweep}, expected -1, 0 or 1")
        _covariance("covariance of the look", look.covariance, 2)
        for other in look.others:
            if not (math.isfinite(other.x_mm) and math.isfinite(other.range_mm) and other.range_mm > 0.0):
                where = f"[{other.x_mm}, {other.range_mm}]"
                raise EventRefused(f"another position of the look is {where}, expected x and a range > 0")
            _covariance("covariance of another position of the look", other.covariance, 2)
        for name, number in (("pm", event.pm), ("marker id", event.marker.id)):
            if not -INT64 <= number < INT64:
                raise EventRefused(f"{name} is {number}, expected a number of 64 bits")
    elif isinstance(event, CameraMoved):
        if event.camera_new_T_camera_old is not None:
            _transform("camera_new_T_camera_old", event.camera_new_T_camera_old)
        if event.covariance is not None:
            _covariance("covariance of the motion", event.covariance, 6)
    elif isinstance(event, StaticTags):
        for tag, pose in event.camera_T_tag.items():
            _transform(f"camera_T_tag of tag {tag}", pose)
            if tag not in event.covariance:
                raise EventRefused(f"tag {tag} has no covariance")
            _covariance(f"covariance of tag {tag}", event.covariance[tag], 6)


def _check_marker(marker: MarkerObservation) -> None:
    _transform("camera_T_marker", marker.camera_T_marker)
    _covariance("covariance of the marker", marker.covariance, 6)


def _array(name: str, value: FloatArray, shape: tuple[int, ...]) -> None:
    if np.shape(value) != shape:
        raise EventRefused(f"{name} has shape {np.shape(value)}, expected {shape}")
    if not np.isfinite(value).all():
        raise EventRefused(f"{name} has an entry that is not finite")


def _transform(name: str, value: FloatArray) -> None:
    _array(name, value, (4, 4))
    if not is_rigid(value):
        raise EventRefused(f"{name} is not a rigid transform")


def _covariance(name: str, value: FloatArray, size: int) -> None:
    _array(name, value, (size, size))
    scale = float(np.abs(value).max())
    if np.abs(value - value.T).max() > 1e-6 * scale or (np.diag(value) < 0).any():
        raise EventRefused(f"{name} is not symmetric with variances >= 0")
