"""One session's least-squares problem as arrays, for optimisers other than GTSAM.

Cost and variables are those of the explicit graph (docs/model.md, sections 3 and 4). Two definitions that the graph
holds to 1e-3 mm are substituted, which leaves the cost as it is and spares an optimiser their curvature: a PM is its
beam's point less a miss ``s``, an arc angle the PM's bearing plus ``d``. Private variables are in units of their
standard deviations.

Shared variables (11): step of ``trus_T_camera`` from the start (rotation ``R0 Exp(w)``, translation ``t0 + R0 v``), the
beam's chart (x, y, a, b), the window's edge. Private ones of a shot (10): marker pose error (6), distance along the
beam, miss (3); of a pair also ``d``. Residuals of an aim (12): marker (6), miss (3), spot (3); of a pair (13): marker
(6), miss (3), x and range (2), across the arc, window.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.factors.point_on_line import COINCIDENCE_SIGMA_MM
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, exp_so3, hat, log_so3
from fgreg.graph.gtsam_values import beam_of_chart
from fgreg.model.measurements import FLOOR_MM, POSE_FLOOR, Measurements, usable_covariance
from fgreg.model.sensitivity import sensitivity_priors
from fgreg.model.session_model import SessionModel

SHARED, OF_AIM, OF_PAIR = 11, 10, 11
"""Numbers of variables."""
ROWS_OF_AIM, ROWS_OF_PAIR = 12, 13
"""Numbers of residuals."""
LAMBDA_MM = 10.0
"""Unit of the distances along the beam."""


def hats(vectors: FloatArray) -> FloatArray:
    """(n, 3, 3) cross-product matrices of (n, 3)."""
    return np.array([hat(v) for v in vectors]).reshape(-1, 3, 3) if len(vectors) < 2 else _hats(vectors)


def _hats(v: FloatArray) -> FloatArray:
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return out


def right_jacobian(w: FloatArray) -> FloatArray:
    """(3, 3) of Exp: ``Exp(w + d) = Exp(w) Exp(J d)``."""
    angle2 = float(w @ w)
    cross = hat(w)
    if angle2 < 1e-8:
        return np.asarray(np.eye(3) - 0.5 * cross + cross @ cross / 6.0)
    angle = np.sqrt(angle2)
    first, second = (1.0 - np.cos(angle)) / angle2, (angle - np.sin(angle)) / (angle2 * angle)
    return np.asarray(np.eye(3) - first * cross + second * (cross @ cross))


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A session of one epoch, one look at each PM, and the window's edge as its only constant.

    Attributes:
        trus_T_camera, marker_T_nominal: (4, 4) start and beam chart.
        rotation, translation_mm: (n, 3, 3), (n, 3) observed markers, the aims' first.
        marker_sigma: (n, 6, 6) square root S of each marker's covariance S S'.
        spot_mm, spot_root: (A, 3), (A, 3, 3) measured spots; U with U' U their information.
        scan_rad, x_mm, range_mm, look_root: (N,) looks, and U (N, 2, 2) with U' U the information of x and range.
        centre_rad, edge_gain, sigma_rad: (N,) of the windows. edge_sigma_rad: of the edge. radius_mm: of the probe.
    """

    trus_T_camera: FloatArray
    marker_T_nominal: FloatArray
    rotation: FloatArray
    translation_mm: FloatArray
    marker_sigma: FloatArray
    spot_mm: FloatArray
    spot_root: FloatArray
    scan_rad: FloatArray
    x_mm: FloatArray
    range_mm: FloatArray
    look_root: FloatArray
    centre_rad: FloatArray
    edge_gain: FloatArray
    sigma_rad: FloatArray
    edge_sigma_rad: float
    radius_mm: float

    @property
    def aims(self) -> int:
        return len(self.spot_mm)

    @property
    def pairs(self) -> int:
        return len(self.scan_rad)

    def start(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Shared (11,), of the aims (A, 10), of the pairs (N, 11): the PMs on their beams, nearest to their arcs."""
        aims, pairs = np.zeros((self.aims, OF_AIM)), np.zeros((self.pairs, OF_PAIR))
        origin, direction = beam_of_chart(np.zeros(4), self.marker_T_nominal)
        origins, directions = self.rotation @ origin + self.translation_mm, self.rotation @ direction
        angle = self.scan_rad + self.centre_rad * (self.radius_mm + self.range_mm) / self.range_mm
        y = self.radius_mm * np.sin(self.scan_rad) + self.range_mm * np.sin(angle)
        z = self.radius_mm * np.cos(self.scan_rad) + self.range_mm * np.cos(angle)
        arcs = np.stack([self.x_mm, y, z], axis=1)
        points = (arcs - self.trus_T_camera[:3, 3]) @ self.trus_T_camera[:3, :3]
        distance = np.sum((np.concatenate([self.spot_mm, points]) - origins) * directions, axis=1)
        aims[:, 6], pairs[:, 6] = distance[: self.aims] / LAMBDA_MM, distance[self.aims :] / LAMBDA_MM
        return np.zeros(SHARED), aims, pairs


def make_scene(
    measurements: Measurements, session: SessionModel, trus_T_camera: FloatArray, marker_T_nominal: FloatArray
) -> Scene:
    """The arrays of a session; looks, sigmas and windows as the explicit graph takes them."""
    markers = [*(aim.marker for aim in measurements.aims), *(pair.marker for pair in measurements.pairs)]
    poses = np.array([marker.camera_T_marker for marker in markers])
    looks = [pair.look for pair in measurements.pairs]
    priors = sensitivity_priors(looks, session.probe.sensitivity, session.stage.step_rad)
    marker = np.array([usable_covariance(one.covariance, POSE_FLOOR) for one in markers], dtype=np.float64)
    spot = [usable_covariance(aim.covariance, (FLOOR_MM,) * 3) for aim in measurements.aims]
    look = [usable_covariance(one.covariance, (FLOOR_MM,) * 2) for one in looks]
    return Scene(
        trus_T_camera=trus_T_camera,
        marker_T_nominal=marker_T_nominal,
        rotation=poses[:, :3, :3],
        translation_mm=poses[:, :3, 3],
        marker_sigma=np.asarray(np.linalg.cholesky(marker), dtype=np.float64),
        spot_mm=np.array([aim.camera_p_spot_mm for aim in measurements.aims]).reshape(-1, 3),
        spot_root=_root(spot),
        scan_rad=np.array([one.scan_rad for one in looks]),
        x_mm=np.array([one.x_mm for one in looks]),
        range_mm=np.array([one.range_mm for one in looks]),
        look_root=_root(look),
        centre_rad=np.asarray(priors.centre_rad),
        edge_gain=np.asarray(priors.edge_gain),
        sigma_rad=np.asarray(priors.sigma_rad),
        edge_sigma_rad=float(session.constant_sigmas[Constant.WINDOW_EDGE]),
        radius_mm=session.probe.radius_mm,
    )


def _root(covariances: list[FloatArray]) -> FloatArray:
    """(n, k, k) U with U' U the inverse of each."""
    return np.array([np.linalg.cholesky(np.linalg.inv(one)).T for one in covariances])


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """Residuals (n, rows), derivatives by the shared (n, rows, 11) and the private variables (n, rows, columns)."""

    residual: FloatArray
    by_shared: FloatArray
    by_private: FloatArray


def _beam_points(
    scene: Scene, chosen: slice, shared: FloatArray, private: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (n, 3) of the beams in camera axes, and their derivatives by chart (n, 3, 4) and private variables."""
    nominal, sigma, rotation = scene.marker_T_nominal[:3, :3], scene.marker_sigma[chosen], scene.rotation[chosen]
    x, y, a, b = shared[6:10]
    chart = np.array([a, b, 1.0])
    length = float(np.sqrt(chart @ chart))
    unit = chart / length
    origin, direction = nominal @ np.array([x, y, 0.0]) + scene.marker_T_nominal[:3, 3], nominal @ unit
    by_slope = nominal @ ((np.eye(3) - np.outer(unit, unit)) / length)[:, :2]
    distance = LAMBDA_MM * private[:, 6]
    error = (sigma @ private[:, :6, None])[..., 0]
    w, u = error[:, :3], error[:, 3:]
    at = origin + distance[:, None] * direction
    turn, w_hat, u_hat = exp_so3(w), hats(w), hats(u)
    w_u = np.cross(w, u)
    moved = u + 0.5 * w_u + np.cross(w, w_u) / 6.0
    camera_q = (rotation @ ((turn @ at[..., None])[..., 0] + moved)[..., None])[..., 0] + scene.translation_mm[chosen]
    full = rotation @ turn
    by_chart = np.empty((len(private), 3, 4))
    by_chart[:, :, :2] = full @ nominal[:, :2]
    by_chart[:, :, 2:] = distance[:, None, None] * (full @ by_slope)
    by_error = np.empty((len(private), 3, 6))
    w_2 = w_hat @ w_hat
    by_error[:, :, :3] = -full @ hats(at) @ (np.eye(3) - 0.5 * w_hat + w_2 / 6.0)
    by_error[:, :, :3] -= rotation @ (0.5 * u_hat + (hats(w_u) + w_hat @ u_hat) / 6.0)
    by_error[:, :, 3:] = rotation @ (np.eye(3) + 0.5 * w_hat + w_2 / 6.0)
    by_private = np.zeros((len(private), 3, private.shape[1]))
    by_private[:, :, :6] = by_error @ sigma
    by_private[:, :, 6] = LAMBDA_MM * (full @ direction)
    return camera_q, by_chart, by_private


def aim_blocks(scene: Scene, shared: FloatArray, private: FloatArray, one: int | None = None) -> Blocks:
    """Of all aims, or of ``one`` with its private variables (1, 10)."""
    chosen = slice(0, scene.aims) if one is None else slice(one, one + 1)
    count = len(private)
    point, by_chart, by_private = _beam_points(scene, chosen, shared, private)
    root = scene.spot_root[chosen]
    by_private[:, :, 7:10] = -COINCIDENCE_SIGMA_MM * np.eye(3)
    residual = np.empty((count, ROWS_OF_AIM))
    residual[:, :6], residual[:, 6:9] = private[:, :6], private[:, 7:10]
    miss = point - COINCIDENCE_SIGMA_MM * private[:, 7:10] - scene.spot_mm[chosen]
    residual[:, 9:] = (root @ miss[..., None])[..., 0]
    shared_rows, private_rows = np.zeros((count, ROWS_OF_AIM, SHARED)), np.zeros((count, ROWS_OF_AIM, OF_AIM))
    _own_rows(private_rows)
    shared_rows[:, 9:, 6:10], private_rows[:, 9:] = root @ by_chart, root @ by_private
    return Blocks(residual, shared_rows, private_rows)


def _own_rows(rows: FloatArray) -> None:
    """Rows of the marker's errors and the misses by themselves."""
    own = np.arange(6)
    rows[:, own, own] = 1.0
    own = np.arange(3)
    rows[:, 6 + own, 7 + own] = 1.0


def pair_blocks(scene: Scene, shared: FloatArray, private: FloatArray, one: int | None = None) -> Blocks:
    """Of all pairs, or of ``one`` with its private variables (1, 11)."""
    chosen = slice(0, scene.pairs) if one is None else slice(one, one + 1)
    markers = slice(scene.aims + chosen.start, scene.aims + chosen.stop)
    count = len(private)
    camera_q, by_chart, by_private = _beam_points(scene, markers, shared, private)
    start = scene.trus_T_camera[:3, :3]
    rotation = start @ exp_so3(shared[:3])
    point = camera_q @ rotation.T + scene.trus_T_camera[:3, 3] + start @ shared[3:6]
    point -= COINCIDENCE_SIGMA_MM * private[:, 7:10]
    by_shared = np.zeros((count, 3, SHARED))
    by_shared[:, :, :3] = -rotation @ hats(camera_q) @ right_jacobian(shared[:3])
    by_shared[:, :, 3:6] = start
    by_shared[:, :, 6:10] = rotation @ by_chart
    by_private = rotation @ by_private
    by_private[:, :, 7:10] = -COINCIDENCE_SIGMA_MM * np.eye(3)
    # The PM from the element, in the stage's axes.
    scan, heard, radius = scene.scan_rad[chosen], scene.range_mm[chosen], scene.radius_mm
    sine, cosine = np.sin(scan), np.cos(scan)
    across = cosine * point[:, 1] - sine * point[:, 2]
    outwards = sine * point[:, 1] + cosine * point[:, 2] - radius
    reach, bearing = np.hypot(across, outwards), np.arctan2(across, outwards)
    unit = COINCIDENCE_SIGMA_MM / heard
    d = unit * private[:, 10]
    sin_d, cos_d = np.sin(d), np.cos(d)
    delta = bearing + d
    up, along = heard * np.sin(delta), radius + heard * np.cos(delta)
    expected = scene.centre_rad[chosen] + scene.edge_gain[chosen] * shared[10]
    look = np.stack([point[:, 0] - scene.x_mm[chosen], reach * cos_d - heard], axis=1)
    root, sigma = scene.look_root[chosen], scene.sigma_rad[chosen]
    residual = np.empty((count, ROWS_OF_PAIR))
    residual[:, :6], residual[:, 6:9] = private[:, :6], private[:, 7:10]
    residual[:, 9:11] = (root @ look[..., None])[..., 0]
    residual[:, 11] = reach * sin_d / COINCIDENCE_SIGMA_MM
    residual[:, 12] = (np.arctan2(up, along) - expected) / sigma
    # Derivatives by the point.
    by_reach = np.stack(
        [np.zeros(count), (across * cosine + outwards * sine) / reach, (outwards * cosine - across * sine) / reach],
        axis=1,
    )
    by_bearing = np.stack(
        [
            np.zeros(count),
            (outwards * cosine - across * sine) / reach**2,
            -(outwards * sine + across * cosine) / reach**2,
        ],
        axis=1,
    )
    of_window = heard * (heard + radius * np.cos(delta)) / (up * up + along * along) / sigma
    by_point = np.zeros((count, 4, 3))
    by_point[:, 0, 0] = 1.0
    by_point[:, 1] = cos_d[:, None] * by_reach
    by_point[:, :2] = root @ by_point[:, :2]
    by_point[:, 2] = (sin_d / COINCIDENCE_SIGMA_MM)[:, None] * by_reach
    by_point[:, 3] = of_window[:, None] * by_bearing
    shared_rows, private_rows = np.zeros((count, ROWS_OF_PAIR, SHARED)), np.zeros((count, ROWS_OF_PAIR, OF_PAIR))
    _own_rows(private_rows)
    shared_rows[:, 9:], private_rows[:, 9:] = by_point @ by_shared, by_point @ by_private
    shared_rows[:, 12, 10] -= scene.edge_gain[chosen] / sigma
    private_rows[:, 9:11, 10] += root[:, :, 1] * (-reach * sin_d * unit)[:, None]
    private_rows[:, 11, 10] += reach * cos_d * unit / COINCIDENCE_SIGMA_MM
    private_rows[:, 12, 10] += of_window * unit
    return Blocks(residual, shared_rows, private_rows)


def cost_at(scene: Scene, shared: FloatArray, steps: int = 8) -> float:
    """Chi square of shared variables (11,), with the private variables at their optimum."""
    _, aims, pairs = scene.start()
    total = float(shared[10] / scene.edge_sigma_rad) ** 2
    for blocks, private in ((aim_blocks, aims), (pair_blocks, pairs)):
        for _ in range(steps):
            found = blocks(scene, shared, private)
            transposed = found.by_private.swapaxes(1, 2)
            gradient = transposed @ found.residual[..., None]
            private = private - np.linalg.solve(transposed @ found.by_private, gradient)[..., 0]
        total += float(np.sum(blocks(scene, shared, private).residual ** 2))
    return total


def shared_from(scene: Scene, trus_T_camera: FloatArray, beam: FloatArray, edge_rad: float) -> FloatArray:
    """Shared variables (11,) of a registration (4, 4), a beam (4,) in the scene's chart, and the window's edge."""
    back = scene.trus_T_camera[:3, :3].T
    turn = log_so3(back @ trus_T_camera[:3, :3])
    shift = back @ (trus_T_camera[:3, 3] - scene.trus_T_camera[:3, 3])
    return np.concatenate([turn, shift, beam, [edge_rad]])
