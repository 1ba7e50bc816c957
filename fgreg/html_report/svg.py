"""Small pieces of SVG. Every text and number is escaped: pieces are joined as ``Markup`` only."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

from fgreg.geometry.transforms import FloatArray

INK, GREY, FAINT, BLUE, ORANGE, RED = "#1d2733", "#6b7683", "#d4d9df", "#0b62a4", "#e08a00", "#b3261e"
"""Colours that stay apart for all common kinds of colour vision, and in grey."""


def piece(name: str, content: Markup | str = "", **attributes: object) -> Markup:
    """An element; ``stroke_width`` is ``stroke-width``, floats have one decimal."""
    written = Markup(" ").join(
        Markup('{}="{}"').format(
            key.rstrip("_").replace("_", "-"), f"{value:.1f}" if isinstance(value, float) else value
        )
        for key, value in attributes.items()
    )
    return Markup("<{0} {1}>{2}</{0}>").format(Markup(name), written, escape(content))


def drawing(width: float, height: float, title: str, parts: Iterable[Markup]) -> Markup:
    """A whole picture that scales with the page; ``title`` says in words what it shows."""
    body = piece("title", title) + Markup("\n").join(parts)
    box = f"0 0 {width:.0f} {height:.0f}"
    return piece(
        "svg", body, viewBox=box, role="img", xmlns="http://www.w3.org/2000/svg", style=f"max-width:{width:.0f}px"
    )


def line(a: FloatArray, b: FloatArray, colour: str = INK, width: float = 1.2, dashes: str = "") -> Markup:
    more: dict[str, object] = {"stroke_dasharray": dashes} if dashes else {}
    ends: dict[str, object] = {"x1": float(a[0]), "y1": float(a[1]), "x2": float(b[0]), "y2": float(b[1])}
    return piece("line", "", **ends, stroke=colour, stroke_width=width, **more)


def path(points: FloatArray, colour: str = INK, width: float = 1.2, fill: str = "none", closed: bool = False) -> Markup:
    """A line through (n, 2) points."""
    text = "M" + " L".join(f"{x:.1f},{y:.1f}" for x, y in points) + (" Z" if closed else "")
    return piece("path", d=text, stroke=colour, stroke_width=width, fill=fill)


def circle(at: FloatArray, radius: float, colour: str = INK, fill: str = "none", width: float = 1.2) -> Markup:
    return piece("circle", cx=float(at[0]), cy=float(at[1]), r=radius, stroke=colour, stroke_width=width, fill=fill)


def cross(at: FloatArray, size: float, colour: str = RED) -> Markup:
    a, b = np.array([size, size]), np.array([size, -size])
    return line(at - a, at + a, colour, 2.0) + line(at - b, at + b, colour, 2.0)


def text(at: FloatArray, content: str, size: float = 12.0, anchor: str = "start", colour: str = INK) -> Markup:
    """A label with a white rim, so that it can be read over lines."""
    place: dict[str, object] = {"x": float(at[0]), "y": float(at[1]), "font_size": size, "text_anchor": anchor}
    rim: dict[str, object] = {"paint_order": "stroke", "stroke": "#fff", "stroke_width": 3.0}
    return piece("text", content, **place, fill=colour, **rim, stroke_linejoin="round")


def arrow(a: FloatArray, b: FloatArray, colour: str = INK, width: float = 1.6, dashes: str = "") -> Markup:
    """A line with a head at ``b``; nothing where it is too short to have a direction."""
    along = b - a
    length = float(np.linalg.norm(along))
    if length < 1e-6:
        return Markup("")
    along, head = along / length, min(8.0, 0.6 * length)
    side = np.array([-along[1], along[0]])
    back = b - head * along
    wings = np.array([back + 0.45 * head * side, b, back - 0.45 * head * side])
    return line(a, back, colour, width, dashes) + path(wings, colour, width, fill=colour, closed=True)


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """A map from millimetres (right, up) to a picture's pixels, of one scale both ways.

    Attributes:
        origin: (2,) px of millimetre (0, 0). scale: px per mm.
    """

    origin: FloatArray
    scale: float

    @classmethod
    def around(cls, points_mm: FloatArray, width: float, height: float, margin: float) -> Plane:
        """The largest that shows all of (n, 2) points within a picture's margins."""
        low, high = points_mm.min(axis=0), points_mm.max(axis=0)
        size = np.maximum(high - low, 1e-6)
        scale = float(min((width - 2 * margin) / size[0], (height - 2 * margin) / size[1]))
        middle = 0.5 * (low + high)
        return cls(np.array([0.5 * width - scale * middle[0], 0.5 * height + scale * middle[1]]), scale)

    def at(self, points_mm: FloatArray) -> FloatArray:
        """(..., 2) px of points (..., 2)."""
        return np.asarray(self.origin + np.asarray(points_mm) * np.array([self.scale, -self.scale]))

    def ruler(self, length_mm: float, at: FloatArray) -> Markup:
        """A scale bar from ``at`` (px) to the right."""
        end = at + np.array([length_mm * self.scale, 0.0])
        tick = np.array([0.0, 4.0])
        parts = (line(at, end), line(at - tick, at + tick), line(end - tick, end + tick))
        return Markup("").join(parts) + text(end + np.array([6.0, 4.0]), f"{length_mm:g} mm", 11.0)
