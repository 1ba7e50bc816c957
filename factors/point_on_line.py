"""Point on line: the PM of a pair, or the aimed-at spot of a calibration shot, lies on the laser's beam.

Equation (the beam of Song et al.'s arc-to-line registration; docs/model.md, section 2):

    pair:  e = trus_T_camera * camera_T_marker * marker_p(lam) - trus_p_pm
    aim:   e = camera_T_marker * marker_p(lam) - camera_p_spot
    marker_p(lam) = marker_T_nominal * ((x, y, 0) + lam normalise(a, b, 1))

The beam is the chart (x, y, a, b) about a fixed nominal frame: x, y (mm) is where it crosses the nominal xy plane, a, b
are its slopes there. It has the line's four degrees of freedom and no gauge. ``lam`` (mm) is measured from that
crossing, along the unit direction.

Residual: (3,) mm, TRUS axes for a pair, camera axes for an aim. Jacobians, in the order of the keys: (3, 6) for each
pose (right perturbation, rotation rad then translation mm), (3, 4) marker_laser, (3, 1) lam, (3, 3) point.
With q = what a transform A is applied to: d(A q) = A.R [-hat(q), I] xi.
"""

from __future__ import annotations

import math

import gtsam

from fgreg.factors.adapter import Residual, Row, Rows, custom_factor
from fgreg.geometry.transforms import FloatArray, as_float_array

COINCIDENCE_SIGMA_MM = 1e-3
"""Sigma of points that coincide by definition (PM and beam, PM and arc): far below any noise, far above rounding."""

_MINUS_IDENTITY = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))


def _beam_point(marker_laser: Row, lambda_mm: float, marker_T_nominal: Rows) -> tuple[float, float, float]:
    """The beam's point at ``lambda_mm`` in the marker frame."""
    n0, n1, n2, _ = marker_T_nominal
    x, y, a, b = marker_laser
    step = lambda_mm / math.sqrt(a * a + b * b + 1.0)
    x, y = x + step * a, y + step * b
    return (
        n0[0] * x + n0[1] * y + n0[2] * step + n0[3],
        n1[0] * x + n1[1] * y + n1[2] * step + n1[3],
        n2[0] * x + n2[1] * y + n2[2] * step + n2[3],
    )


def _pose_jacobian(r0: Row, r1: Row, r2: Row, px: float, py: float, pz: float) -> Rows:
    """(3, 6) derivative of A p by A's right perturbation, from the rows of A.R: A.R [-hat(p), I]."""
    a, b, c, d, e, f, g, h, i = r0[0], r0[1], r0[2], r1[0], r1[1], r1[2], r2[0], r2[1], r2[2]
    return (
        (c * py - b * pz, a * pz - c * px, b * px - a * py, a, b, c),
        (f * py - e * pz, d * pz - f * px, e * px - d * py, d, e, f),
        (i * py - h * pz, g * pz - i * px, h * px - g * py, g, h, i),
    )


def _beam_jacobians(
    r0: Row, r1: Row, r2: Row, marker_laser: Row, lambda_mm: float, marker_T_nominal: Rows
) -> tuple[Rows, Rows]:
    """(3, 4) by marker_laser and (3, 1) by lam, of the beam point seen through a rotation with these rows."""
    (n00, n01, n02, _), (n10, n11, n12, _), (n20, n21, n22, _), _ = marker_T_nominal
    _, _, a, b = marker_laser
    w = 1.0 / math.sqrt(a * a + b * b + 1.0)
    u, v, reach = a * w, b * w, lambda_mm * w
    columns = []
    for r in (r0, r1, r2):
        p, q, s = r[0], r[1], r[2]
        gx = p * n00 + q * n10 + s * n20  # the nominal x, y axes, along this row's axis
        gy = p * n01 + q * n11 + s * n21
        direction = u * gx + v * gy + w * (p * n02 + q * n12 + s * n22)
        # d normalise(a, b, 1) / da = w (x axis - u direction), likewise b
        columns.append(((gx, gy, reach * (gx - u * direction), reach * (gy - v * direction)), (direction,)))
    (l0, d0), (l1, d1), (l2, d2) = columns
    return (l0, l1, l2), (d0, d1, d2)


def residual(
    trus_T_camera: Rows,
    camera_T_marker: Rows,
    marker_laser: Row,
    lambda_mm: float,
    trus_p_pm: Row,
    marker_T_nominal: Rows,
    want_jacobians: bool = True,
) -> Residual:
    """The miss of a pair's beam point against its PM.

    Args:
        trus_T_camera, camera_T_marker: rows of (4, 4).
        marker_laser: (x mm, y mm, a, b).
        lambda_mm: distance along the beam.
        trus_p_pm: (3,) mm.
        marker_T_nominal: rows of (4, 4), fixed.
        want_jacobians: whether to compute them.

    Returns:
        error (3,) mm in TRUS axes; Jacobians (3, 6), (3, 6), (3, 4), (3, 1), (3, 3), or none.
    """
    mx, my, mz = _beam_point(marker_laser, lambda_mm, marker_T_nominal)
    (b00, b01, b02, bx), (b10, b11, b12, by), (b20, b21, b22, bz), _ = camera_T_marker
    t0, t1, t2, _ = trus_T_camera
    (a00, a01, a02, ax), (a10, a11, a12, ay), (a20, a21, a22, az) = t0, t1, t2
    qx = b00 * mx + b01 * my + b02 * mz + bx
    qy = b10 * mx + b11 * my + b12 * mz + by
    qz = b20 * mx + b21 * my + b22 * mz + bz
    error = (
        a00 * qx + a01 * qy + a02 * qz + ax - trus_p_pm[0],
        a10 * qx + a11 * qy + a12 * qz + ay - trus_p_pm[1],
        a20 * qx + a21 * qy + a22 * qz + az - trus_p_pm[2],
    )
    if not want_jacobians:
        return error, ()
    # trus_R_marker
    c0 = (a00 * b00 + a01 * b10 + a02 * b20, a00 * b01 + a01 * b11 + a02 * b21, a00 * b02 + a01 * b12 + a02 * b22)
    c1 = (a10 * b00 + a11 * b10 + a12 * b20, a10 * b01 + a11 * b11 + a12 * b21, a10 * b02 + a11 * b12 + a12 * b22)
    c2 = (a20 * b00 + a21 * b10 + a22 * b20, a20 * b01 + a21 * b11 + a22 * b21, a20 * b02 + a21 * b12 + a22 * b22)
    by_laser, by_lambda = _beam_jacobians(c0, c1, c2, marker_laser, lambda_mm, marker_T_nominal)
    return error, (
        _pose_jacobian(t0, t1, t2, qx, qy, qz),
        _pose_jacobian(c0, c1, c2, mx, my, mz),
        by_laser,
        by_lambda,
        _MINUS_IDENTITY,
    )


def aim_residual(
    camera_T_marker: Rows,
    marker_laser: Row,
    lambda_mm: float,
    camera_p_spot: Row,
    marker_T_nominal: Rows,
    want_jacobians: bool = True,
) -> Residual:
    """The miss of a calibration shot's beam point against its spot; as :func:`residual`, without ``trus_T_camera``.

    Returns:
        error (3,) mm in camera axes; Jacobians (3, 6), (3, 4), (3, 1), (3, 3), or none.
    """
    mx, my, mz = _beam_point(marker_laser, lambda_mm, marker_T_nominal)
    r0, r1, r2, _ = camera_T_marker
    error = (
        r0[0] * mx + r0[1] * my + r0[2] * mz + r0[3] - camera_p_spot[0],
        r1[0] * mx + r1[1] * my + r1[2] * mz + r1[3] - camera_p_spot[1],
        r2[0] * mx + r2[1] * my + r2[2] * mz + r2[3] - camera_p_spot[2],
    )
    if not want_jacobians:
        return error, ()
    by_laser, by_lambda = _beam_jacobians(r0, r1, r2, marker_laser, lambda_mm, marker_T_nominal)
    return error, (_pose_jacobian(r0, r1, r2, mx, my, mz), by_laser, by_lambda, _MINUS_IDENTITY)


def point_on_line_factor(
    trus_T_camera_key: int,
    camera_T_marker_key: int,
    marker_laser_key: int,
    lambda_key: int,
    trus_p_pm_key: int,
    marker_T_nominal: FloatArray,
    sigma_mm: float = COINCIDENCE_SIGMA_MM,
) -> gtsam.CustomFactor:
    """The factor of a pair: Pose3, Pose3, Vector 4, double, Point3; ``marker_T_nominal`` (4, 4)."""
    nominal = _rows(marker_T_nominal)

    def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
        return residual(
            values.atPose3(trus_T_camera_key).matrix().tolist(),
            values.atPose3(camera_T_marker_key).matrix().tolist(),
            values.atVector(marker_laser_key).tolist(),
            values.atDouble(lambda_key),
            values.atPoint3(trus_p_pm_key).tolist(),
            nominal,
            want_jacobians,
        )

    keys = (trus_T_camera_key, camera_T_marker_key, marker_laser_key, lambda_key, trus_p_pm_key)
    noise_model = gtsam.noiseModel.Isotropic.Sigma(3, sigma_mm)
    return custom_factor("point on line", noise_model, keys, 3, (6, 6, 4, 1, 3), evaluate)


def aim_point_on_line_factor(
    camera_T_marker_key: int,
    marker_laser_key: int,
    lambda_key: int,
    camera_p_spot_key: int,
    marker_T_nominal: FloatArray,
    sigma_mm: float = COINCIDENCE_SIGMA_MM,
) -> gtsam.CustomFactor:
    """The factor of a calibration shot: Pose3, Vector 4, double, Point3; ``marker_T_nominal`` (4, 4).

    What is known of the spot itself is a prior on ``camera_p_spot`` with the shot's own (3, 3) covariance.
    """
    nominal = _rows(marker_T_nominal)

    def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
        return aim_residual(
            values.atPose3(camera_T_marker_key).matrix().tolist(),
            values.atVector(marker_laser_key).tolist(),
            values.atDouble(lambda_key),
            values.atPoint3(camera_p_spot_key).tolist(),
            nominal,
            want_jacobians,
        )

    keys = (camera_T_marker_key, marker_laser_key, lambda_key, camera_p_spot_key)
    noise_model = gtsam.noiseModel.Isotropic.Sigma(3, sigma_mm)
    return custom_factor("aim point on line", noise_model, keys, 3, (6, 4, 1, 3), evaluate)


def _rows(matrix: FloatArray) -> Rows:
    return tuple(tuple(row) for row in as_float_array(matrix, 4, 4).tolist())
