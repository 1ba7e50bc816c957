"""Geometry of the recording as plain arrays, without Rerun, so that it can be tested alone.

TRUS millimetres and radians unless a name says otherwise. The stage's frame ``plane`` rotates with the image plane: it
equals ``trus`` at stage angle 0, so a point (x, 0, z) of it lies in the image plane at z from the rotation axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fgreg.geometry.transforms import FloatArray, exp_so3, log_so3, make_transform, transform_points
from fgreg.model.camera_model import CameraModel
from fgreg.model.estimate import SessionEstimate
from fgreg.model.measurements import Look
from fgreg.model.probe_model import ProbeModel
from fgreg.model.sensitivity import arc_of_rotation
from fgreg.model.session_model import MarkerModel
from fgreg.viewer.palette import Color

ShotKind = Literal["aim", "pair", "track"]
CHI2_95_3 = 7.814728
"""95 % quantile of chi-square with three degrees of freedom."""
CHI2_95_2 = 5.991465
"""95 % quantile of chi-square with two degrees of freedom."""
ARC_HALF_WIDTHS = 1.5
"""Drawn extent of an arc to either side, in half widths of the sensitivity window."""


def trus_T_plane(scan_rad: float) -> FloatArray:
    """(4, 4) from the rotated image plane's frame to TRUS: +z goes to (0, sin t, cos t), a rotation of -t about x."""
    return make_transform(exp_so3(np.array([-scan_rad, 0.0, 0.0])), np.zeros(3))


def element_centre_mm(look: Look, probe: ProbeModel) -> FloatArray:
    """(3,) the point of the array from which the look's range is measured."""
    t = look.scan_rad
    return np.array([look.x_mm, probe.radius_mm * math.sin(t), probe.radius_mm * math.cos(t)])


def arc_point_mm(look: Look, probe: ProbeModel, theta_rad: FloatArray | float) -> FloatArray:
    """(..., 3) the points of a look's arc at arc angles theta'."""
    theta = np.asarray(theta_rad, dtype=np.float64)
    direction = np.stack([np.zeros_like(theta), np.sin(theta), np.cos(theta)], axis=-1)
    return np.asarray(element_centre_mm(look, probe) + look.range_mm * direction)


def arc_strip_mm(look: Look, probe: ProbeModel, points: int = 25) -> FloatArray:
    """(points, 3) the arc of a look over 1.5 half widths of the sensitivity window to either side of its plane."""
    half = ARC_HALF_WIDTHS * float(probe.sensitivity.half_width_at(look.range_mm))
    rotation = np.linspace(-half, half, points)
    return arc_point_mm(look, probe, look.scan_rad + arc_of_rotation(rotation, look.range_mm, probe.radius_mm))


Reach = Callable[[FloatArray, FloatArray], float | None]
"""Length of a beam (mm), or None, from its origin (3,) and unit direction (3,) in TRUS."""


def nearest_on(strip_mm: FloatArray) -> Reach:
    """The length (mm) along a beam at which it is nearest to a curve (n, 3)."""

    def reach(origin: FloatArray, direction: FloatArray) -> float | None:
        along = (strip_mm - origin) @ direction
        apart = np.linalg.norm(strip_mm - origin - along[:, None] * direction, axis=1)
        return float(along[np.argmin(apart)])

    return reach


def array_length_mm(probe: ProbeModel) -> float:
    """Length of the array along x."""
    return probe.elements * probe.pitch_mm


def probe_points_mm(probe: ProbeModel) -> FloatArray:
    """(n, 3) points about the housing, round ends included."""
    half, radius = array_length_mm(probe) / 2.0 + 4.0, probe.radius_mm
    ring = [[side * half, y * radius, z * radius] for side in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    return np.array([*ring, [-half - radius, 0.0, 0.0], [half + radius, 0.0, 0.0]])


def plane_corners_mm(probe: ProbeModel, depth_mm: float) -> FloatArray:
    """(4, 3) corners of the image plane in its own frame: from the array's face to ``depth_mm``, face first."""
    half, near, far = array_length_mm(probe) / 2.0, probe.radius_mm, probe.radius_mm + depth_mm
    return np.array([[-half, 0.0, near], [half, 0.0, near], [half, 0.0, far], [-half, 0.0, far]])


def image_depth_mm(probe: ProbeModel, targets_mm: FloatArray) -> float:
    """Depth to which the image plane is drawn: beyond the target (n, 3) that is farthest from the axis."""
    return float(np.linalg.norm(targets_mm[:, 1:], axis=1).max()) - probe.radius_mm + 5.0


def picture_corners_mm(
    probe: ProbeModel, shape: tuple[int, int], pixel_mm: tuple[float, float], origin_mm: tuple[float, float]
) -> FloatArray:
    """(4, 3) corners of an image (rows, columns) in the image plane's frame, in the order of :func:`plane_corners_mm`.

    Args:
        probe: depth begins at its array's face.
        shape: rows and columns.
        pixel_mm: size of a pixel along depth and x.
        origin_mm: depth and x of the centre of the first pixel.
    """
    near = probe.radius_mm + origin_mm[0] - pixel_mm[0] / 2.0
    left = origin_mm[1] - pixel_mm[1] / 2.0
    far, right = near + shape[0] * pixel_mm[0], left + shape[1] * pixel_mm[1]
    return np.array([[left, 0.0, near], [right, 0.0, near], [right, 0.0, far], [left, 0.0, far]])


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """Half sizes (3,) mm along the columns of ``rotation`` (3, 3), a proper rotation."""

    half_sizes_mm: FloatArray
    rotation: FloatArray


def ellipsoid_95(covariance: FloatArray) -> Ellipsoid:
    """The 95 % ellipsoid of a (3, 3) covariance: principal sigmas times sqrt of chi-square's 0.95 quantile, 7.815."""
    variance, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    return Ellipsoid(np.sqrt(CHI2_95_3 * np.clip(variance, 0.0, None)), axes)


def ellipse_95(centre: FloatArray, covariance: FloatArray, points: int = 49) -> FloatArray:
    """(points, 2) closed outline of the 95 % ellipse of a (2, 2) covariance about ``centre``."""
    variance, axes = np.linalg.eigh(covariance)
    turn = np.linspace(0.0, 2.0 * math.pi, points)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    return np.asarray(centre + circle * np.sqrt(CHI2_95_2 * np.clip(variance, 0.0, None)) @ axes.T)


def quaternion_xyzw(rotation: FloatArray) -> FloatArray:
    """(4,) unit quaternion, scalar last, of a (3, 3) rotation."""
    vector = log_so3(rotation)
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 0 else vector
    return np.array([*(math.sin(angle / 2.0) * axis), math.cos(angle / 2.0)])


def laser_origin_and_tip(a_T_laser: FloatArray, lambda_mm: float) -> tuple[FloatArray, FloatArray]:
    """The beam's origin (3,) and its point (3,) at ``lambda_mm``, in frame a."""
    ends = transform_points(a_T_laser, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, lambda_mm]]))
    return ends[0], ends[1]


def marker_outlines_mm(marker: MarkerModel) -> list[FloatArray]:
    """One closed (5, 3) outline per tag, marker frame."""
    return [np.vstack([corners, corners[:1]]) for corners in (tag.marker_p_corners_mm for tag in marker.tags)]


def frustum_strips_mm(camera: CameraModel | None, depth_mm: float) -> list[FloatArray]:
    """Outline of a camera in its own frame: the picture's rectangle at ``depth_mm`` and a line to each corner.

    Distortion is ignored. An unknown camera is drawn as a square of 50 degrees.
    """
    if camera is None:
        half = depth_mm * math.tan(math.radians(25.0))
        corners = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    else:
        width, height = camera.image_size
        pixels = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
        corners = depth_mm * (pixels - camera.matrix[:2, 2]) / np.array([camera.matrix[0, 0], camera.matrix[1, 1]])
    rectangle = np.column_stack([corners, np.full(4, depth_mm)])
    return [np.vstack([rectangle, rectangle[:1]]), *(np.vstack([np.zeros(3), corner]) for corner in rectangle)]


@dataclass(frozen=True, slots=True)
class Shot:
    """One aim, pair or track: its number in the session, and its position within its own kind."""

    number: int
    t: float
    kind: ShotKind
    position: int


def shots_of(estimate: SessionEstimate) -> list[Shot]:
    """All shots of a session in time order, numbered from 0; at equal times aims, then pairs, then tracks."""
    listed = [(aim.t, 0, position) for position, aim in enumerate(estimate.aims)]
    listed += [(pair.t, 1, position) for position, pair in enumerate(estimate.pairs)]
    listed += [(track.t, 2, position) for position, track in enumerate(estimate.tracks)]
    kinds: tuple[ShotKind, ...] = ("aim", "pair", "track")
    return [Shot(number, t, kinds[kind], position) for number, (t, kind, position) in enumerate(sorted(listed))]


def live_points_mm(probe: ProbeModel, targets_mm: FloatArray) -> FloatArray:
    """(n, 3) points of the view before the camera's pose is known: the probe, the targets, and room for a camera."""
    half = array_length_mm(probe) / 2.0
    beyond = 1.7 * float(np.linalg.norm(targets_mm[:, 1:], axis=1).max())
    ends = np.array([[side * half, 0.0, height] for side in (-1, 1) for height in (-probe.radius_mm, beyond)])
    return np.vstack([ends, targets_mm])


VIEW_TANGENT = 0.52
"""Tangent of half the vertical angle of Rerun's 3D view."""
MARGIN = 0.88
"""Part of the view that the points fill."""


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """Viewpoint of the 3D view: its position and the point it looks at, (3,) TRUS mm; up is TRUS +z."""

    position_mm: FloatArray
    target_mm: FloatArray

    def axes(self) -> FloatArray:
        """(3, 3) rows: right, down and forward."""
        forward = self.target_mm - self.position_mm
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    def seen(self, points_mm: FloatArray) -> FloatArray:
        """(n, 2) where points (n, 3) are seen: right and down, as tangents of the angles to the view's middle."""
        turned = (np.reshape(points_mm, (-1, 3)) - self.position_mm) @ self.axes().T
        return np.asarray(turned[:, :2] / np.maximum(turned[:, 2:], 1e-6))

    def shifted(self, point_mm: FloatArray, shift: FloatArray) -> FloatArray:
        """(n, 3) the points that are seen by ``shift`` (n, 2) right and down of a point (3,), as far away as it."""
        axes = self.axes()
        depth = float((point_mm - self.position_mm) @ axes[2])
        return np.asarray(point_mm + depth * shift @ axes[:2])


def best_eye(
    points_mm: FloatArray, size_px: tuple[int, int], picture_mm: FloatArray | None = None, margin: float = MARGIN
) -> Eye:
    """The eye from which points (n, 3) fill a view of this size, from above and obliquely to the probe's axis.

    Along the axis the probe is a disc; across it the arcs are lines. So the eye is 40 to 60 degrees off the axis and 20
    to 50 degrees up, where the rectangle about the points fills most of the view. The endoscope's picture should
    neither cover the rest nor be seen edge on.

    Args:
        points_mm: points that must be in view.
        size_px: width and height of the view.
        picture_mm: (4, 3) corners of the picture, where there is one, in order; not among ``points_mm``.
        margin: part of the view that the points fill.
    """
    rest = points_mm
    if picture_mm is not None:
        points_mm = np.concatenate([points_mm, picture_mm])
    half_height = margin * VIEW_TANGENT
    half_width = half_height * size_px[0] / size_px[1]
    best, best_fill = None, -1.0
    for elevation in np.radians([20.0, 27.0, 35.0, 42.0, 50.0]):
        for azimuth in np.radians([40.0, 50.0, 60.0, 120.0, 130.0, 140.0, 220.0, 230.0, 240.0, 300.0, 310.0, 320.0]):
            eye = _eye_from(points_mm, float(elevation), float(azimuth), half_height, half_width)
            extent = np.ptp(eye.seen(points_mm), axis=0)
            fill = float(extent[0] * extent[1])
            if picture_mm is not None:
                shown, others = eye.seen(picture_mm), eye.seen(rest)
                (ax, ay), (bx, by) = shown[2] - shown[0], shown[3] - shown[1]
                area = 0.5 * abs(ax * by - ay * bx)
                boxes = [np.concatenate([part.min(axis=0), part.max(axis=0)]) for part in (shown, others)]
                fill *= math.sqrt(area) * (1.0 - _overlap(*boxes) / max(float(np.prod(np.ptp(shown, axis=0))), 1e-9))
            if fill > best_fill:
                best, best_fill = eye, fill
    assert best is not None
    return best


def _eye_from(points_mm: FloatArray, elevation: float, azimuth: float, half_height: float, half_width: float) -> Eye:
    """The nearest eye in a direction from which points (n, 3) are all in view."""
    flat = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    away = np.array([*(math.cos(elevation) * flat[:2]), math.sin(elevation)])
    right = np.array([-flat[1], flat[0], 0.0])
    axes = np.column_stack([right, np.cross(away, right), away])
    seen = points_mm @ axes
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2.0
    for _ in range(6):  # under perspective the centre of the view is not that of the points
        centred = seen - middle
        distance = _distance_that_shows(centred, half_height, half_width)
        projected = centred[:, :2] / (distance - centred[:, 2])[:, None]
        middle[:2] += distance * (projected.min(axis=0) + projected.max(axis=0)) / 2.0
    distance = _distance_that_shows(seen - middle, half_height, half_width)
    return Eye(axes @ middle + distance * away, axes @ middle)


def _distance_that_shows(centred: FloatArray, half_height: float, half_width: float) -> float:
    """Least distance from which points (n, 3), as right, up and towards the eye, are all in view."""
    fit = np.maximum(np.abs(centred[:, 0]) / half_width, np.abs(centred[:, 1]) / half_height) + centred[:, 2]
    return max(float(fit.max()), 1.0)


LABEL_PX = (7.2, 14.0, 22.0)
"""Of a label: width of a letter, of its margins together, and height; Rerun centres it below its point."""


@dataclass(frozen=True, slots=True, eq=False)
class Label:
    """Words in the 3D view, and the points (k, 3) mm that they may stand at, the best first."""

    text: str
    places_mm: FloatArray
    color: Color


def place_labels(labels: list[Label], eye: Eye | None, size_px: tuple[int, int]) -> list[Label]:
    """The labels with one place each, such that they do not cover each other as seen by the eye.

    A label stands at, above, below or beside one of its points, where it overlaps those before it and the view's edge
    least; the first have the first choice. Without an eye each stands at its first point.
    """
    placed: list[Label] = []
    taken: list[FloatArray] = []
    for label in labels:
        at = label.places_mm[0]
        if eye is not None:
            shifts = label_shifts(label.text, size_px)
            places = np.concatenate([eye.shifted(place, shifts) for place in label.places_mm])
            boxes = [label_box(label.text, seen, size_px) for seen in eye.seen(places)]
            covered = [2.0 * _outside(box, size_px) + sum(_overlap(box, other) for other in taken) for box in boxes]
            best = int(np.argmin(np.round(covered, 3)))
            at = places[best]
            taken.append(boxes[best])
        placed.append(Label(label.text, at[None], label.color))
    return placed


def label_shifts(text: str, size_px: tuple[int, int]) -> FloatArray:
    """(n, 2) from a label's point to where it may stand: at it, above, beside, below; as tangents."""
    letter, margin, height = LABEL_PX
    half = 0.5 * (letter * len(text) + margin) + 8.0
    steps = [(0.0, 0.0), (0.0, -1.4), (1.0, -0.5), (-1.0, -0.5), (0.0, 1.0), (1.0, -1.6), (-1.0, -1.6), (1.0, 0.6)]
    steps += [(-1.0, 0.6), (0.0, -2.6), (0.0, 2.1), (1.0, 1.7), (-1.0, 1.7)]
    return np.asarray(np.array(steps) * [half, height] * 2.0 * VIEW_TANGENT / size_px[1])


def label_box(text: str, seen: FloatArray, size_px: tuple[int, int]) -> FloatArray:
    """(4,) left, top, right and bottom, px from the middle of the view, of a label whose point is ``seen`` (2,)."""
    letter, margin, height = LABEL_PX
    x, y = np.asarray(seen) * 0.5 * size_px[1] / VIEW_TANGENT
    half = 0.5 * (letter * len(text) + margin)
    return np.array([x - half, y, x + half, y + height])


def _overlap(first: FloatArray, second: FloatArray) -> float:
    """Area that two boxes share, px^2."""
    sides = np.minimum(first[2:], second[2:]) - np.maximum(first[:2], second[:2])
    return float(np.prod(np.maximum(sides, 0.0)))


def _outside(box: FloatArray, size_px: tuple[int, int]) -> float:
    """Area of a box that is outside the view, px^2."""
    half = 0.5 * np.array(size_px, dtype=np.float64)
    return float(np.prod(box[2:] - box[:2])) - _overlap(box, np.array([*-half, *half]))
