"""The PM heard now: an iterated Kalman update of one PM, with the session's estimate as a Gaussian prior.

Unknowns: the PM (no prior), the shared variables and the markers' errors (Gaussian). Measurements: two distances across
each beam, and lateral position, range and rotation of each look. The PM is found by least squares with the residuals'
covariance S = H P H' + R, in which all the Gaussian unknowns are summed up (H by them, P their covariance); they are
then brought to where the PM puts them, and everything is linearised there anew. The fixed point is the optimum of the
reduced problem (fgreg.graph.reduced) with this one PM.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dposv

from fgreg.frames import FloatArray
from fgreg.graph.packing import LINE_SIGMA_MM
from fgreg.measurements import FLOOR_MM, Look, MarkerObservation, Track
from fgreg.sensitivity import amplitude_table, log_interval
from fgreg.tracking.beam import MARKER, Beam, BeamMarker, joint_covariance, place_beam, read_marker
from fgreg.tracking.prepared import Prepared, SharedPlace
from fgreg.tracking.sites import AmplitudeShape, Sites, gaussian_sites, settle_sites
from fgreg.tracking.snapshot import EDGE, RADIUS, SHARED, SPEED, Snapshot
from fgreg.tracking.windows import LookWindow, interpolated, look_window

ROUNDS = 20
SETTLED = 1e-3
"""Square of the PM's last step, in its own standard deviations: the next one is the square of that step."""


@dataclass(frozen=True, slots=True)
class Placed:
    """The PM's plane angle and its sigma (rad), and its lambda in the beam chart (mm)."""

    scan_rad: float
    sigma_rad: float
    lambda_mm: float


def place_pm(query: Track, snapshot: Snapshot, at: Prepared) -> Placed | str:
    """The PM that the query's looks heard; or why it has no place."""
    looks = query.looks
    markers = _distinct(query)
    beams = [read_marker(marker, floor=True) for marker in markers]
    windows = [
        look_window(
            look,
            interpolated(look.range_mm, at.depth, at.half_width),
            snapshot.stage.step_rad,
            snapshot.edge_variance,
        )
        for look in looks
    ]
    shape = _amplitude_shape(looks, windows, at, snapshot) if snapshot.window_shape else None
    found = _update(looks, beams, windows, shape, at, shaped=snapshot.window_shape)
    if found is None and snapshot.window_shape:  # sites that do not settle: the windows as Gaussians
        found = _update(looks, beams, windows, None, at, shaped=False)
    return found or "the beam and what is heard do not settle on a place of the PM"


def _distinct(query: Track) -> list[MarkerObservation]:
    """One of each marker observation: looks that share one share its error."""
    if len(query.look_markers) == 0:
        return [query.marker]
    return list({marker.id: marker for marker in reversed(query.look_markers)}.values())[::-1]


def _amplitude_shape(
    looks: tuple[Look, ...], windows: list[LookWindow], at: Prepared, snapshot: Snapshot
) -> AmplitudeShape | None:
    if at.curve is None or sum(1 for look in looks if look.amplitude) < 2:
        return None
    table = amplitude_table(looks, snapshot.sensitivity, snapshot.amplitude_sigma, at.curve)
    # Best a look that knows only the window: its interval does not hang on the window's edge.
    index = next((i for i, look in enumerate(looks) if look.sweep == 0), 0)
    window = windows[index]
    rotation = table.plane_rad - looks[index].scan_rad
    log = table.log_likelihood + log_interval(window.low - rotation, window.high - rotation, window.soft)
    return AmplitudeShape(index, rotation, log)


def _update(
    looks: tuple[Look, ...],
    markers: list[BeamMarker],
    windows: list[LookWindow],
    shape: AmplitudeShape | None,
    at: Prepared,
    *,
    shaped: bool,
) -> Placed | None:
    lines, count = 2 * len(markers), len(looks)
    first_rotation = lines + 2 * count
    rows, size = first_rotation + count, SHARED + MARKER * len(markers)
    rotations = range(first_rotation, rows)
    prior = joint_covariance(at, markers)
    noise = _noise(looks, lines, rows)
    sites = gaussian_sites(windows)
    right = np.zeros((rows, 4 + count))
    for i, row in enumerate(rotations):
        right[row, 4 + i] = 1.0
    by_point, by_state = right[:, :3], np.zeros((rows, size))
    residual = np.empty(rows)
    x = np.zeros(size)
    point: list[float] | None = None
    for _ in range(ROUNDS):
        values = x.tolist()
        place = at.place if point is None else at.moved(values)
        placed = [
            place_beam(place, marker, values[SHARED + MARKER * k : SHARED + MARKER * (k + 1)])
            for k, marker in enumerate(markers)
        ]
        if point is None:
            point = _start(placed[0], looks[0], windows[0], place)
        for k, beam in enumerate(placed):
            _line_rows(beam, k, point, residual, by_point, by_state)
        for i, look in enumerate(looks):
            _look_rows(look, windows[i], sites.centre[i], place, point, lines + 2 * i, first_rotation + i,
                       residual, by_point, by_state)  # fmt: skip
        right[:, 3] = residual - by_state @ x
        gain = by_state @ prior
        total = gain @ by_state.T + noise
        for i, row in enumerate(rotations):
            total[row, row] += 1.0 / sites.precision[i]
        weighted, solution = _solve(total, right, by_point)
        if weighted is None or solution is None:
            return None
        if shaped:
            settled = _settled(sites, weighted, solution, first_rotation, windows, shape)
            if settled is None:
                return None
            for i, row in enumerate(rotations):
                total[row, row] += 1.0 / settled.precision[i] - 1.0 / sites.precision[i]
                right[row, 3] += sites.centre[i] - settled.centre[i]
            sites = settled
            weighted, solution = _solve(total, right, by_point)
            if weighted is None or solution is None:
                return None
        step = solution[:, 0]
        pull = weighted[:, 3] - weighted[:, :3] @ step
        x = -(pull @ gain)
        information = by_point.T @ weighted[:, :3]
        far = float(step @ information @ step)
        s0, s1, s2 = step.tolist()
        point = [point[0] - s0, point[1] - s1, point[2] - s2]
        if far < SETTLED:
            return _read(point, information, placed[0])
        if not math.isfinite(far):
            return None
    return None


def _solve(total: FloatArray, right: FloatArray, by_point: FloatArray) -> tuple[FloatArray | None, FloatArray | None]:
    """S^-1 times ``right`` (rows, n), and the PM's response (3, n - 3) to its columns from 3 on."""
    _, weighted, failed = dposv(total, right)
    if failed:
        return None, None
    normal = by_point.T @ weighted
    _, solution, failed = dposv(normal[:, :3], normal[:, 3:])
    return (weighted, solution) if not failed else (None, None)


def _settled(
    sites: Sites,
    weighted: FloatArray,
    solution: FloatArray,
    first_rotation: int,
    windows: list[LookWindow],
    shape: AmplitudeShape | None,
) -> Sites | None:
    """The windows' sites, from the solution with those of before."""
    # Residuals and their responses once the PM has moved: W r and W, the projected inverse of S.
    left = weighted[first_rotation:, 3:] - weighted[first_rotation:, :3] @ solution
    table = left.tolist()
    variance = [1.0 / precision for precision in sites.precision]
    mean = [sites.centre[i] + variance[i] * row[0] for i, row in enumerate(table)]
    spread = [
        [(variance[i] if i == j else 0.0) - variance[i] * row[1 + j] * variance[j] for j in range(len(table))]
        for i, row in enumerate(table)
    ]
    if not all(spread[i][i] > 0.0 for i in range(len(table))):
        return None
    return settle_sites(sites, mean, spread, windows, shape)


def _read(point: list[float], information: FloatArray, beam: Beam) -> Placed | None:
    px, y, z = point
    square = y * y + z * z
    by_angle = np.array([0.0, z / square, -y / square])
    _, spread, failed = dposv(information, by_angle)
    variance = float(by_angle @ spread.ravel())
    if failed or not variance > 0.0:
        return None
    start, along = beam.start, beam.along
    lambda_mm = along[0] * (px - start[0]) + along[1] * (y - start[1]) + along[2] * (z - start[2])
    return Placed(math.atan2(y, z), math.sqrt(variance), lambda_mm)


def _noise(looks: tuple[Look, ...], lines: int, rows: int) -> FloatArray:
    """Noise (rows, rows) of the measurements but for the rotations'."""
    noise = np.zeros((rows, rows))
    for row in range(lines):
        noise[row, row] = LINE_SIGMA_MM**2
    for i, look in enumerate(looks):
        (a, b), (_, d) = look.covariance.tolist()
        floor = FLOOR_MM**2
        if not (a >= floor and d >= floor and (a - floor) * (d - floor) >= b * b):  # as usable_covariance
            a, d = a + floor, d + floor
        row = lines + 2 * i
        noise[row, row], noise[row + 1, row + 1] = a, d
        noise[row, row + 1] = noise[row + 1, row] = b
    return noise


def _start(beam: Beam, look: Look, window: LookWindow, at: SharedPlace) -> list[float]:
    """Where the beam is at the look's range from its element: of two such places, the likelier one."""
    (sx, sy, sz), (ax, ay, az) = beam.start, beam.along
    sine, cosine = math.sin(look.scan_rad), math.cos(look.scan_rad)
    dy, dz, heard = sy - at.radius * sine, sz - at.radius * cosine, at.speed * look.range_mm
    across = ay * ay + az * az
    if across < 1e-6:  # along the probe's axis: only the lateral position tells
        k = (look.x_mm - sx) * ax
        return [sx + k * ax, sy + k * ay, sz + k * az]
    middle = -(ay * dy + az * dz) / across
    reach = math.sqrt(max(middle * middle - (dy * dy + dz * dz - heard * heard) / across, 0.0))
    best, least = middle, math.inf
    for k in (middle - reach, middle + reach):
        x, y, z = sx + k * ax, sy + k * ay, sz + k * az
        rotation = math.atan2(y * cosine - z * sine, y * sine + z * cosine)
        far = ((rotation - window.centre) / window.sigma) ** 2 + (x - look.x_mm) ** 2
        if far < least:
            best, least = k, far
    return [sx + best * ax, sy + best * ay, sz + best * az]


def _line_rows(
    beam: Beam,
    index: int,
    point: list[float],
    residual: FloatArray,
    by_point: FloatArray,
    by_state: FloatArray,
) -> None:
    """Two distances of the point from the beam, and their derivatives, into rows 2 index and 2 index + 1."""
    (ax, ay, az), (sx, sy, sz) = beam.along, beam.start
    ox, oy, oz = point[0] - sx, point[1] - sy, point[2] - sz
    sign = 1.0 if az >= 0.0 else -1.0
    a = -1.0 / (sign + az)
    b = ax * ay * a
    n0 = (1.0 + sign * ax * ax * a, sign * b, -sign * ax)
    n1 = (b, sign + ay * ay * a, -ay)
    row = 2 * index
    residual[row] = n0[0] * ox + n0[1] * oy + n0[2] * oz
    residual[row + 1] = n1[0] * ox + n1[1] * oy + n1[2] * oz
    across = np.array([n0, n1])
    by_point[row : row + 2] = across
    moves = (across @ beam.rotation) @ beam.moves(ax * ox + ay * oy + az * oz)
    by_state[row : row + 2, :SHARED] = -moves[:, :SHARED]
    begin = SHARED + MARKER * index
    by_state[row : row + 2, begin : begin + MARKER] = -moves[:, SHARED:]


def _look_rows(
    look: Look,
    window: LookWindow,
    centre: float,
    at: SharedPlace,
    point: list[float],
    row: int,
    rotation_row: int,
    residual: FloatArray,
    by_point: FloatArray,
    by_state: FloatArray,
) -> None:
    """Lateral position and range (rows ``row``, ``row + 1``) and rotation, as fgreg.graph.reduced_blocks.look_block."""
    radius, ratio = at.radius, at.speed
    sine, cosine = math.sin(look.scan_rad), math.cos(look.scan_rad)
    dy, dz = point[1] - radius * sine, point[2] - radius * cosine
    distance = max(math.hypot(dy, dz), 1e-9)
    sin_theta, cos_theta = dy / distance, dz / distance
    sin_delta, cos_delta = sin_theta * cosine - cos_theta * sine, cos_theta * cosine + sin_theta * sine
    heard = ratio * look.range_mm
    square = radius * radius + heard * heard + 2.0 * radius * heard * cos_delta
    per_delta = heard * (heard + radius * cos_delta) / square
    per_range = radius * sin_delta / square
    rotation = math.atan2(heard * sin_delta, radius + heard * cos_delta)
    residual[row] = point[0] - look.x_mm
    residual[row + 1] = distance - heard
    residual[rotation_row] = rotation - centre - window.gain * at.edge
    by_point[row, 0] = 1.0
    by_point[row + 1, 1], by_point[row + 1, 2] = sin_theta, cos_theta
    by_point[rotation_row, 1] = per_delta * cos_theta / distance
    by_point[rotation_row, 2] = -per_delta * sin_theta / distance
    by_state[rotation_row, EDGE] = -window.gain
    by_state[row + 1, SPEED] = -look.range_mm
    by_state[rotation_row, SPEED] = per_range * look.range_mm
    by_state[row + 1, RADIUS] = -cos_delta
    by_state[rotation_row, RADIUS] = per_delta * sin_delta / distance - heard * sin_delta / square
