"""The report's pictures as SVG, from the figures of a result; the map of errors is in target_map.py."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from markupsafe import Markup

from fgreg.geometry.transforms import FloatArray, inverse, transform_points
from fgreg.html_report.svg import (
    BLUE,
    FAINT,
    GREY,
    INK,
    ORANGE,
    RED,
    Plane,
    arrow,
    circle,
    cross,
    drawing,
    line,
    path,
    piece,
    text,
)
from fgreg.model.estimate import EpochEstimate, PairEstimate, TrackEstimate
from fgreg.model.probe_model import ProbeModel
from fgreg.model.session_model import StageModel
from fgreg.viewer.scene import array_length_mm

AXIS_MM = 22.0
SIGMA_95 = 1.96


def frames_pictures(
    epoch: EpochEstimate, pairs: Sequence[PairEstimate], probe: ProbeModel, stage: StageModel
) -> list[Markup]:
    """Probe, camera, their axes and the PMs of an epoch, along the probe's axis and from the side."""
    if epoch.trus_T_camera is None:
        return []
    found = [pair for pair in pairs if pair.epoch == epoch.index and pair.trus_p_pm_mm is not None]
    points = np.array([pair.trus_p_pm_mm for pair in found]).reshape(-1, 3)
    centre, axes = epoch.trus_T_camera[:3, 3], epoch.trus_T_camera[:3, :3]
    reach = float(np.linalg.norm(points - centre, axis=1).mean()) if len(points) else 60.0
    view = np.array(
        [[0.0, 0.0, 0.0], *([[sx * 0.18, sy * 0.12, 0.3] for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))])]
    )
    outline = transform_points(epoch.trus_T_camera, reach * view)
    half = array_length_mm(probe) / 2.0
    body = np.array(
        [[s * half, y * probe.radius_mm, z * probe.radius_mm] for s in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    )
    tips = np.vstack([AXIS_MM * np.eye(3), centre + AXIS_MM * axes.T])
    everything = np.vstack([points, outline, body, tips])
    pictures = []
    for across, seen in (((1, 2), "along the probe's axis, from +x"), ((0, 2), "from the side, from -y")):
        pick = list(across)
        width, height = 430.0, 430.0
        plane = Plane.around(everything[:, pick], width, height, 44.0)

        def at(p: FloatArray, pick: list[int] = pick, plane: Plane = plane) -> FloatArray:
            return plane.at(np.asarray(p)[..., pick])

        parts = [text(np.array([10.0, 18.0]), f"Seen {seen}", 13.0)]
        if across == (1, 2):
            parts += _stage_limits(plane, stage, probe.radius_mm, points)
            parts.append(circle(at(np.zeros(3)), probe.radius_mm * plane.scale, GREY, "#eef0f3"))
        else:
            corners = np.array([[-half, 0, -1], [half, 0, -1], [half, 0, 1], [-half, 0, 1]], dtype=float)
            corners[:, 2] *= probe.radius_mm
            parts.append(path(at(corners), GREY, fill="#eef0f3", closed=True))
        for pair, point in zip(found, points, strict=True):
            spot = at(point)
            parts.append(circle(spot, 3.2, BLUE, BLUE) if pair.used else cross(spot, 4.0))
        apex = at(centre)
        for i, j in ((1, 2), (2, 3), (3, 4), (4, 1), (0, 1), (0, 2), (0, 3), (0, 4)):
            parts.append(line(at(outline[i]), at(outline[j]), GREY, 1.0))
        parts.append(arrow(apex, at(np.zeros(3)), ORANGE, 1.6, "7 5"))
        parts.append(
            text(0.55 * apex + 0.45 * at(np.zeros(3)) + np.array([8.0, 0.0]), "trus_T_camera", 12.0, colour="#8a5300")
        )
        parts += _axes(at, np.zeros(3), np.eye(3), "TRUS")
        parts += _axes(at, centre, axes, "camera")
        parts.append(plane.ruler(50.0, np.array([14.0, height - 16.0])))
        pictures.append(drawing(width, height, f"Registration seen {seen}: camera, probe, axes, PMs", parts))
    return pictures


def _stage_limits(plane: Plane, stage: StageModel, radius_mm: float, points: FloatArray) -> list[Markup]:
    """The two ends of the stage's turn."""
    reach = float(np.linalg.norm(points[:, 1:], axis=1).max()) if len(points) else 3.0 * radius_mm
    parts = []
    for device in stage.limits_device_rad:
        scan = stage.scan_from_device(device)
        end = plane.at(1.1 * reach * np.array([math.sin(scan), math.cos(scan)]))
        parts.append(line(plane.at(np.zeros(2)), end, FAINT, 1.4, "3 4"))
        parts.append(text(end, f"{math.degrees(device):.0f} deg", 11.0, "middle", GREY))
    return parts


def _axes(at: Callable[[FloatArray], FloatArray], origin: FloatArray, axes: FloatArray, name: str) -> list[Markup]:
    """A frame's three axes, each with its letter (a dot where it points at the viewer), and its name opposite."""
    parts, start = [], at(origin)
    for k, letter in enumerate("xyz"):
        tip = at(origin + AXIS_MM * axes[:, k])
        if float(np.linalg.norm(tip - start)) < 6.0:
            parts.append(circle(start, 3.0, INK, INK))
            continue
        parts.append(arrow(start, tip, INK, 1.8))
        parts.append(text(tip + 9.0 * _unit(tip - start) + np.array([0.0, 4.0]), letter, 12.0, "middle"))
    away = -_unit(at(origin + AXIS_MM * axes.sum(axis=1)) - start)
    anchor = "end" if away[0] < -0.3 else "start" if away[0] > 0.3 else "middle"
    return [*parts, text(start + 12.0 * away + np.array([0.0, 4.0 + 6.0 * away[1]]), name, 12.0, anchor)]


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-9))


def track_picture(tracks: Sequence[TrackEstimate], stage: StageModel) -> Markup | None:
    """Where each answer is within the stage's limits, with its 95 % bound."""
    answered = [track for track in tracks if track.stage_rad is not None][-24:]
    if not answered:
        return None
    low, high = (math.degrees(limit) for limit in stage.limits_device_rad)
    values = [math.degrees(track.stage_rad or 0.0) for track in answered]
    left, right = min([low, *values]), max([high, *values])
    width, row = 620.0, 22.0
    height = 44.0 + row * len(answered)

    def x(angle: float) -> float:
        return 92.0 + (width - 130.0) * (angle - left) / max(right - left, 1e-9)

    parts = []
    for tick in np.arange(math.ceil(left / 20.0) * 20.0, right + 1e-9, 20.0):
        parts.append(line(np.array([x(tick), 24.0]), np.array([x(tick), height - 6.0]), FAINT, 1.0))
        parts.append(text(np.array([x(tick), 16.0]), f"{tick:.0f} deg", 11.0, "middle", GREY))
    parts += [line(np.array([x(end), 22.0]), np.array([x(end), height - 6.0]), RED, 1.6) for end in (low, high)]
    for i, (track, value) in enumerate(zip(answered, values, strict=True)):
        y = 40.0 + row * i
        parts.append(text(np.array([80.0, y + 4.0]), f"{track.t:.1f} s", 12.0, "end"))
        half = SIGMA_95 * math.degrees(track.sigma_rad or 0.0)
        parts.append(line(np.array([x(value - half), y]), np.array([x(value + half), y]), BLUE, 6.0))
        parts.append(circle(np.array([x(value), y]), 4.0, "#fff", INK))
    return drawing(
        width, height, "Where to turn the stage: each answer with its 95 % bound; red: limits of the stage", parts
    )


def nis_picture(ratios: Sequence[tuple[int, float, bool]]) -> Markup | None:
    """NIS over its 95 % bound, (pm, ratio, used), in the order of first looks."""
    if not ratios:
        return None
    width, height, low, high = 720.0, 200.0, -2.0, 2.0
    step = (width - 90.0) / max(len(ratios), 1)

    def y(ratio: float) -> float:
        level = min(max(math.log10(max(ratio, 1e-9)), low), high)
        return 16.0 + (height - 56.0) * (high - level) / (high - low)

    parts = []
    for level in (0.01, 0.1, 1.0, 10.0, 100.0):
        colour, thick = (RED, 1.8) if level == 1.0 else (FAINT, 1.0)
        parts.append(line(np.array([56.0, y(level)]), np.array([width - 10.0, y(level)]), colour, thick))
        parts.append(text(np.array([48.0, y(level) + 4.0]), f"{level:g}", 11.0, "end", GREY))
    every = max(1, math.ceil(len(ratios) / 30))
    for i, (pm, ratio, used) in enumerate(ratios):
        at = np.array([56.0 + step * (i + 0.5), y(ratio)])
        parts.append(circle(at, 4.0, BLUE, BLUE) if used else cross(at, 4.0))
        if i % every == 0:
            parts.append(text(np.array([at[0], height - 22.0]), str(pm), 11.0, "middle", GREY))
    parts.append(text(np.array([width - 10.0, height - 6.0]), "PM", 11.0, "end", GREY))
    return drawing(width, height, "NIS of each PM over its 95 % bound: above the red line it does not fit", parts)


def marked_picture(jpeg_url: str, width: int, height: int, mark_px: FloatArray | None, what: str) -> Markup:
    """A thumbnail with a ring at (2,) px of it; ``what`` it shows, in words."""
    image = piece("image", href=jpeg_url, width=width, height=height)
    ring = (
        [] if mark_px is None else [circle(mark_px, 9.0, "#fff", width=4.0), circle(mark_px, 9.0, "#d6008f", width=2.0)]
    )
    return drawing(width, height, what, [image, *ring])


def camera_point_mm(epoch: EpochEstimate, trus_p_mm: FloatArray) -> FloatArray:
    """(3,) a TRUS point in camera coordinates."""
    assert epoch.trus_T_camera is not None
    return np.asarray(transform_points(inverse(epoch.trus_T_camera), trus_p_mm[None])[0])
