"""Check events to measurements: a point in the camera's and in the TRUS frame, each with its covariance."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeVar

import numpy as np

from fgreg.geometry.rig import CAMERA
from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.model.camera_dependence import nominal_point_dependence
from fgreg.model.camera_model import StereoRig
from fgreg.model.events import CheckEvent, PlaneRecord, PointEvent, SpotRecord
from fgreg.model.lens import focal_px, normalized_from_pixels
from fgreg.model.measurement_checks import problem_of
from fgreg.model.measurements import FLOOR_MM, Check, KnownPoint, VisibleSpot, usable_covariance
from fgreg.model.session_model import SessionModel

PIXEL_SIGMA = 0.5
"""Standard deviation of a point in a picture, each axis, px: a well-defined point, found by hand or by a program."""
MOST_APART_PX = 5.0
"""Distance between the two views of one point, across the epipolar line, from which they are of different points."""
PLANE_SHARE = 1.0 / 6.0
"""How well the brightest stage angle is found, as a share of the window's half width (1 deg at 6 deg)."""
_ROUNDS = 10

PointT = TypeVar("PointT", Check, KnownPoint)


def check_measurement(event: CheckEvent, epoch: int, model: SessionModel) -> Check | str:
    """The check as a measurement in camera epoch ``epoch``, or the reason why it is not usable."""
    return _located(event, epoch, model, Check)


def known_point(event: PointEvent, epoch: int, model: SessionModel) -> KnownPoint | str:
    """The point as a measurement in camera epoch ``epoch``, or the reason why it is not usable."""
    return _located(event, epoch, model, KnownPoint)


def _located(event: CheckEvent | PointEvent, epoch: int, model: SessionModel, kind: type[PointT]) -> PointT | str:
    seen = _camera_point(event, model)
    if isinstance(seen, str):
        return seen
    camera_p, covariance = seen
    if event.trus is not None:
        trus_p, trus_covariance = in_plane(event.trus, model)
    elif event.trus_p_mm is not None:
        trus_p, given = event.trus_p_mm, event.trus_covariance
        range_mm = math.hypot(trus_p[1], trus_p[2]) - model.probe.radius_mm
        in_plane_there = _plane_covariance(math.atan2(trus_p[1], trus_p[2]), range_mm, None, model)
        trus_covariance = in_plane_there if given is None else given
    else:
        raise AssertionError("the reader requires the point in the TRUS frame")
    floor = (FLOOR_MM,) * 3
    point = kind(event.t, epoch, camera_p, covariance, trus_p, trus_covariance)
    return problem_of(point) or replace(
        point,
        covariance=usable_covariance(covariance, floor),
        trus_covariance=usable_covariance(trus_covariance, floor),
    )


def _camera_point(
    record: CheckEvent | PointEvent | SpotRecord, model: SessionModel
) -> tuple[FloatArray, FloatArray] | str:
    """The point (3,) mm in the camera's frame and its covariance (3, 3), or the reason why there is none."""
    if record.camera_p_mm is not None:
        default = np.diag(np.square(model.noise.marker_translation_mm))
        return record.camera_p_mm, default if record.covariance is None else record.covariance
    if model.camera is None or record.left is None or record.right is None:
        raise AssertionError("the reader requires both pixels and the cameras")
    return triangulate(model.camera, record.left, record.right)


def visible_spot(record: SpotRecord, model: SessionModel) -> VisibleSpot | str:
    """The laser's spot as a measurement of where the sound comes from, or the reason why it is not usable."""
    seen = _camera_point(record, model)
    if isinstance(seen, str):
        return f"the visible spot: {seen}"
    camera_p, covariance = seen
    whole = covariance + np.diag(np.square(model.noise.spot_mm))
    dependence = nominal_point_dependence(model, camera_p) if model.constant_sigmas[CAMERA].any() else None
    return VisibleSpot(as_float_array(camera_p, 3), as_float_array(whole, 3, 3), dependence)


def in_plane(point: PlaneRecord, model: SessionModel) -> tuple[FloatArray, FloatArray]:
    """A point seen in the image plane: (3,) mm, TRUS, and its covariance (3, 3).

    Along the plane's normal it is known as well as the stage angle at which it is brightest.
    """
    scan_rad = model.stage.scan_from_device(math.radians(point.scan_deg))
    from_axis = model.probe.radius_mm + point.range_mm
    trus_p = np.array([point.x_mm, from_axis * math.sin(scan_rad), from_axis * math.cos(scan_rad)])
    return trus_p, _plane_covariance(scan_rad, point.range_mm, point.covariance, model)


def _plane_covariance(
    scan_rad: float, range_mm: float, covariance: FloatArray | None, model: SessionModel
) -> FloatArray:
    """(3, 3) TRUS, of a point seen in the plane at this angle; ``covariance`` (2, 2) over x and range."""
    noise = model.noise
    turn = math.hypot(noise.scan_rad, PLANE_SHARE * float(model.probe.sensitivity.half_width_at(max(range_mm, 0.0))))
    local = np.zeros((3, 3))
    local[:2, :2] = np.diag(np.square([noise.lateral_mm, noise.range_mm])) if covariance is None else covariance
    local[2, 2] = ((model.probe.radius_mm + max(range_mm, 0.0)) * turn) ** 2
    s, c = math.sin(scan_rad), math.cos(scan_rad)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, s, c], [0.0, c, -s]])
    return np.asarray(axes @ local @ axes.T)


def triangulate(rig: StereoRig, left_px: FloatArray, right_px: FloatArray) -> tuple[FloatArray, FloatArray] | str:
    """The point (3,) mm in the left camera's frame and its covariance (3, 3), from one pixel (2,) in each view.

    Least squares of the reprojection errors, in pixels without distortion. Returns the reason where there is none.
    """
    if rig.right is None or rig.right_T_left is None:
        raise AssertionError("the reader requires both cameras")
    seen = [normalized_from_pixels(camera, px) for camera, px in ((rig.left, left_px), (rig.right, right_px))]
    if not np.isfinite(seen).all():
        return "a pixel is where the lens model cannot be inverted"
    views = ((np.eye(4), focal_px(rig.left)), (rig.right_T_left, focal_px(rig.right)))
    rows = np.concatenate(
        [xy[:, None] * pose[2] - pose[:2] for xy, (pose, _) in zip(seen, views, strict=True)]
    )  # x (row 2) = row 0, y (row 2) = row 1
    point, *_ = np.linalg.lstsq(rows[:, :3], -rows[:, 3], rcond=None)
    for _ in range(_ROUNDS):
        residuals, jacobians = [], []
        for xy, (pose, focal) in zip(seen, views, strict=True):
            x, y, z = pose[:3, :3] @ point + pose[:3, 3]
            if z <= 0.0:
                return "its pixels meet behind the camera: they are not of one point"
            residuals.append((np.array([x, y]) / z - xy) * focal)
            by_point = np.array([[1.0, 0.0, -x / z], [0.0, 1.0, -y / z]]) / z @ pose[:3, :3]
            jacobians.append(by_point * focal[:, None])
        residual, jacobian = np.concatenate(residuals), np.concatenate(jacobians)
        step = np.linalg.lstsq(jacobian, -residual, rcond=None)[0]
        point = point + step
        if np.abs(step).max() < 1e-9:
            break
    if not np.isfinite(point).all() or np.linalg.cond(jacobian) > 1e6:
        return "its rays are parallel: the point is too far away to be located"
    apart = math.sqrt(2.0) * float(np.linalg.norm(residual))
    if apart > MOST_APART_PX:
        return f"its two pixels are {apart:.1f} px apart across the epipolar line: they are not of one point"
    return point, PIXEL_SIGMA**2 * np.linalg.inv(jacobian.T @ jacobian)
