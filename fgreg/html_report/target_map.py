"""The map of predicted errors at the targets, as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from fgreg.geometry.transforms import FloatArray
from fgreg.html_report.svg import BLUE, GREY, ORANGE, RED, Plane, circle, cross, drawing, path, text
from fgreg.html_report.words import number
from fgreg.model.estimate import TargetEstimate
from fgreg.model.probe_model import ProbeModel
from fgreg.viewer.scene import array_length_mm

MOST_SLICES = 3
"""Targets of more different x are not shown in slices, but from two sides."""
LABEL = 16
"""Longest name in a picture; the table has all of it."""
WIDTH, HEIGHT = 340.0, 290.0
LETTER = 6.4
"""Width of a letter of a label, px."""
_CLASSES = (
    (0.5, "up to half the limit", "#d3e6f4", BLUE, 1.0),
    (1.0, "up to the limit", "#4a9ad4", BLUE, 1.4),
    (2.0, "beyond the limit", "#ffd08a", ORANGE, 2.6),
    (math.inf, "beyond twice the limit", "#f3b4ae", RED, 2.6),
)
"""Error over limit up to which a class goes; its words, fill, rim and the rim's width."""


@dataclass(frozen=True, slots=True)
class _View:
    """One picture: its heading, the axes to the right and up, the places of its targets."""

    heading: str
    axes: tuple[int, int]
    places: tuple[int, ...]


def error_class(error_mm: float, limit_mm: float) -> int:
    """Which class of the map an error is in."""
    return next(i for i, entry in enumerate(_CLASSES) if not error_mm / limit_mm > entry[0])


def _radius(error_mm: float, limit_mm: float) -> float:
    return 4.0 + 6.0 * min(error_mm / limit_mm, 2.0)


def _spot(at: FloatArray, error_mm: float, limit_mm: float) -> Markup:
    which = error_class(error_mm, limit_mm)
    _, _, fill, rim, width = _CLASSES[which]
    radius = _radius(error_mm, limit_mm)
    mark = cross(at, 0.6 * radius) if which == len(_CLASSES) - 1 else Markup("")
    return circle(at, radius, rim, fill, width) + mark


def error_key() -> Markup:
    """The map's legend."""
    parts = []
    for i, (top, words, *_) in enumerate(_CLASSES):
        at = np.array([20.0 + 190.0 * (i % 2), 20.0 + 40.0 * (i // 2)])
        parts += [_spot(at, min(top, 2.4), 1.0), text(at + np.array([24.0, 4.0]), words)]
    return drawing(400, 80, "Key of the map of errors", parts)


def _views(points_mm: FloatArray) -> list[_View]:
    """Slices of one x each, else all targets from two sides."""
    x = np.round(points_mm[:, 0], 1)
    values = np.unique(x)
    if len(values) <= MOST_SLICES:
        return [_View(f"x = {v:.0f} mm", (1, 2), tuple(np.flatnonzero(x == v).tolist())) for v in values]
    every = tuple(range(len(x)))
    return [_View("Along the probe's axis, from +x", (1, 2), every), _View("From the side, from -y", (0, 2), every)]


def target_maps(targets: Sequence[TargetEstimate], limit_mm: float, probe: ProbeModel) -> list[Markup]:
    """The targets with their 95 % bounds beside the probe, in one or more pictures."""
    if not targets:
        return []
    points = np.array([target.trus_p_mm for target in targets])
    outlines = {(1, 2): _across(probe.radius_mm), (0, 2): _along(array_length_mm(probe) / 2.0, probe.radius_mm)}
    pictures = []
    for view in _views(points):
        outline, pick = outlines[view.axes], list(view.axes)
        plane = Plane.around(np.vstack([points[:, pick], outline]), WIDTH, HEIGHT - 40.0, 44.0)
        drop = np.array([0.0, 14.0])
        body = plane.at(outline) + drop
        parts = [text(np.array([10.0, 18.0]), view.heading, 13.0), path(body, GREY, fill="#eef0f3", closed=True)]
        parts.append(text(body.mean(axis=0) + np.array([0.0, 4.0]), "probe", 11.0, "middle", GREY))
        at = plane.at(points[np.ix_(view.places, pick)]) + drop
        parts += _spots(view.places, at, targets, limit_mm)
        parts.append(plane.ruler(10.0, np.array([12.0, HEIGHT - 14.0])))
        axes = "y right, z up" if view.axes == (1, 2) else "x right, z up"
        parts.append(text(np.array([WIDTH - 10.0, HEIGHT - 10.0]), axes, 11.0, "end", GREY))
        pictures.append(drawing(WIDTH, HEIGHT, f"Predicted errors at the targets. {view.heading}", parts))
    return pictures


def _spots(places: Sequence[int], at: FloatArray, targets: Sequence[TargetEstimate], limit_mm: float) -> list[Markup]:
    """The targets at (n, 2) px, the largest errors below, then a label for each where it covers least."""
    radius = np.array([_radius(targets[i].p95_mm, limit_mm) for i in places])
    taken = [*np.column_stack([at - radius[:, None], at + radius[:, None]])]
    order = np.argsort(-radius, kind="stable")
    parts = [_spot(at[k], targets[places[k]].p95_mm, limit_mm) for k in order]
    for k, place in enumerate(places):
        target = targets[place]
        name = target.name if len(target.name) <= LABEL else target.name[: LABEL - 1] + "\u2026"
        label = f"{name}: {number(target.p95_mm, 1)}"
        box = min(_boxes(at[k], float(radius[k]) + 3.0, LETTER * len(label)), key=lambda box: _covered(box, taken))
        taken.append(box)
        # The end next to the target stays where it is in whatever size the label is shown.
        x, anchor = (box[2], "end") if box[2] <= at[k, 0] else (box[0], "start")
        if box[0] < at[k, 0] < box[2]:
            x, anchor = 0.5 * (box[0] + box[2]), "middle"
        parts.append(text(np.array([x, box[3] - 2.0]), label, 11.0, anchor))
    return parts


def _boxes(at: FloatArray, gap: float, width: float) -> list[FloatArray]:
    """Where a label may stand, (left, top, right, bottom) px: away from the middle, towards it, above, below."""
    tall = 12.0
    left, right = np.array([-gap - width, -0.5 * tall]), np.array([gap, -0.5 * tall])
    first, second = (left, right) if at[0] < 0.5 * WIDTH - 4.0 else (right, left)
    corners = [first, second, np.array([-0.5 * width, -gap - tall]), np.array([-0.5 * width, gap])]
    corners += [corner + np.array([0.0, step]) for step in (-9.0, 9.0) for corner in (first, second)]
    return [np.concatenate([at + corner, at + corner + np.array([width, tall])]) for corner in corners]


def _covered(box: FloatArray, taken: Sequence[FloatArray]) -> float:
    """Area (px^2) that a label covers of others, and that lies outside of the picture."""
    shared = sum(_overlap(box, other) for other in taken)
    outside = (box[2] - box[0]) * (box[3] - box[1]) - _overlap(box, np.array([2.0, 22.0, WIDTH - 2.0, HEIGHT - 24.0]))
    return float(shared + 4.0 * outside)


def _overlap(a: FloatArray, b: FloatArray) -> float:
    size = np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2])
    return float(np.prod(np.maximum(size, 0.0)))


def _across(radius_mm: float) -> FloatArray:
    """(n, 2) the probe's upper half in (y, z)."""
    angle = np.radians(np.linspace(-90.0, 90.0, 37))
    return np.asarray(radius_mm * np.column_stack([np.sin(angle), np.cos(angle)]))


def _along(half_mm: float, radius_mm: float) -> FloatArray:
    """(4, 2) the same in (x, z)."""
    return np.array([[-half_mm, 0.0], [-half_mm, radius_mm], [half_mm, radius_mm], [half_mm, 0.0]])
