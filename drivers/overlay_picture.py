"""The endoscope's picture with what the surgeon needs to know, for any sink that takes pictures.

    +--------------------------------------------------------------+
    | sign, pattern, verdict, predicted error                      |   banner
    |   image plane (solid, bold at the probe's face)              |
    |   the plane where the stage will turn (dashed), and the turn |
    |   beam with its end (ring), PMs (discs; crosses: not used)   |
    | stage: angle, where to                               legend  |   foot
    +--------------------------------------------------------------+

Where the registration is refused, or there is none, only the banner is drawn. Colours are those of the recording
(:mod:`fgreg.viewer.palette`); form tells the same as colour.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.errors import one_line
from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import CameraModel
from fgreg.model.estimate import Verdict, worst_verdict
from fgreg.viewer import palette
from fgreg.viewer.endoscope_lines import Lines, Seen, lines_of
from fgreg.viewer.palette import Color
from fgreg.viewer.verdict_strip import strip

Picture = npt.NDArray[np.uint8]

DESIGN_PX = 1280
"""Width of a picture for which the sizes below are; others are scaled."""
BANNER, FOOT, TEXT, SMALL = 54, 38, 0.85, 0.62
LINE, BOLD, DISC, RING = 2, 5, 7, 11
DASH, GAP = 16.0, 11.0
GROUND: Color = (14, 15, 18)
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4
"""Lines are drawn to a sixteenth of a pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class OverlayState:
    """What there is to show.

    Attributes:
        verdict: None where there is no registration yet.
        trus_T_camera: (4, 4), mm; None where there is none.
        seen: beam, PMs and planes.
        error_mm: the predicted error at the worst target, 95 % bound; None if unknown.
        stage_deg, goal_deg: where the stage stands and will turn, as it reads itself; None if unknown.
        sigma_deg: 1 sigma of ``goal_deg``.
        why: of the verdict; shown where it is refused.
        hidden: why nothing may be drawn on this picture; empty where it may.
        no_goal: why there is no goal.
        lost: roles of the lost devices.
    """

    verdict: Verdict | None
    trus_T_camera: FloatArray | None
    seen: Seen
    error_mm: float | None = None
    stage_deg: float | None = None
    goal_deg: float | None = None
    sigma_deg: float | None = None
    why: str = ""
    hidden: str = ""
    no_goal: str = ""
    lost: tuple[str, ...] = ()

    @property
    def usable(self) -> bool:
        """Whether anything of the registration may be shown."""
        known = self.verdict in (Verdict.OK, Verdict.WARNING) and self.trus_T_camera is not None
        return known and not self.hidden


def overlay_picture(image: Picture, camera: CameraModel, state: OverlayState) -> Picture:
    """(h, w, 3) BGR: a picture (h, w) or (h, w, 3) BGR of the camera with the state drawn on it. The input is kept."""
    drawn = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy(), dtype=np.uint8)
    height, width = drawn.shape[:2]
    why = state.hidden or state.why
    if state.usable and (width, height) != camera.image_size:
        calibrated = "{} x {}".format(*camera.image_size)
        why = f"the picture has {width} x {height} px, the camera's calibration {calibrated}"
    elif state.usable and state.trus_T_camera is not None:
        why = ""
        _draw_lines(drawn, lines_of(camera, state.trus_T_camera, state.seen))
        _draw_foot(drawn, state)
    _draw_banner(drawn, state, why)
    return drawn


def _draw_lines(image: Picture, lines: Lines) -> None:
    scale = image.shape[1] / DESIGN_PX
    _lines(image, lines.plane, palette.PLANE, LINE * scale)
    _lines(image, lines.array, palette.PLANE, BOLD * scale)
    _lines(image, list(_dashes(lines.goal, scale)), palette.GOAL, LINE * scale)
    if lines.turn and (head := _arrow_head(lines.turn[-1], 14.0 * scale)) is not None:
        _lines(image, [*lines.turn, head], palette.GOAL, LINE * scale)
    _lines(image, lines.crosses, palette.UNUSED, LINE * scale, palette.MARKER)
    for point in lines.pms:
        if any(np.linalg.norm(point - spot) < RING * scale for spot in lines.spot):
            continue  # the ring stands for it, so that the laser's spot is seen
        _circle(image, point, DISC * scale, palette.PM, filled=True)
    beam = [_up_to(line, lines.spot, RING * scale) for line in lines.beam]
    _lines(image, beam, palette.BEAM, (LINE + 1) * scale)
    for point in lines.spot:  # a ring about what is seen of the laser's spot
        _circle(image, point, RING * scale, palette.BEAM, filled=False)


def _draw_banner(image: Picture, state: OverlayState, why: str) -> None:
    """The verdict's strip with a plate in its middle, below it why."""
    height, width = image.shape[:2]
    scale = width / DESIGN_PX
    rows = min(round(BANNER * scale), height)
    shown = None if state.trus_T_camera is None else state.verdict
    word = "NO REGISTRATION YET" if shown is None else shown.value.upper()
    if shown is not None and state.lost:
        shown = worst_verdict(shown, Verdict.WARNING)
    image[:rows] = _strip(shown, width, round(BANNER * scale))[:rows]
    color = palette.UNUSED if shown is None else palette.VERDICTS[shown]
    if state.usable and not why and state.error_mm is not None:
        word += f"   error at most {state.error_mm:.1f} mm (95 % bound)"
    if state.lost:
        word += f"   LOST: {', '.join(state.lost)}"
    left = round(BANNER * 1.6 * scale) + 8
    room = width - left - 40
    text, size = _fitted(one_line(word), room, TEXT * scale)
    text_width = _width(text, size)
    at = max(left, (width - text_width) // 2)
    pad = round(18 * scale)
    cv2.rectangle(image, (at - pad, 0), (at + text_width + pad, rows - 1), _bgr(GROUND), cv2.FILLED)
    _text(image, text, (at, rows // 2), size, palette.MARKER)
    cv2.line(image, (0, rows), (width, rows), _bgr(color), max(1, round(3 * scale)))
    if why:
        text, size = _fitted(one_line(why), width - 2 * pad, SMALL * scale)
        low = rows + round(FOOT * scale)
        cv2.rectangle(image, (0, rows + 2), (width, low), _bgr(GROUND), cv2.FILLED)
        _text(image, text, (pad, (rows + low) // 2), size, palette.MARKER)


def _draw_foot(image: Picture, state: OverlayState) -> None:
    """The stage's angles, and the legend of the lines."""
    height, width = image.shape[:2]
    scale = width / DESIGN_PX
    top, pad = height - round(FOOT * scale), round(18 * scale)
    image[top:] = _bgr(GROUND)
    at, middle = width - pad, (top + height) // 2
    for name, sample in (
        ("not used", "cross"),
        ("PM", "disc"),
        ("beam", "ring"),
        ("turn to", "dashes"),
        ("plane", "line"),
    ):
        at -= _width(name, SMALL * scale)
        _text(image, name, (at, middle), SMALL * scale, palette.TEXT)
        at -= round(44 * scale)
        _sample(image, sample, at, middle, scale)
        at -= round(12 * scale)
    text, size = _fitted(_stage(state), at - 2 * pad, TEXT * scale)
    _text(image, text, (pad, middle), size, palette.MARKER)


def _stage(state: OverlayState) -> str:
    now = "stage: angle not known" if state.stage_deg is None else f"stage {state.stage_deg:.1f} deg"
    if state.goal_deg is None:
        return one_line(f"{now}, no angle to turn to{': ' if state.no_goal else ''}{state.no_goal}")
    turn = "" if state.stage_deg is None else f" ({state.goal_deg - state.stage_deg:+.1f})"
    sigma = "" if state.sigma_deg is None else f", 1 sigma {state.sigma_deg:.1f} deg"
    return f"{now}, turn to {state.goal_deg:.1f} deg{turn}{sigma}"


def _sample(image: Picture, form: str, at: int, middle: int, scale: float) -> None:
    """A sample of a line or mark, 36 px wide."""
    ends = np.array([[at, middle], [at + 36.0 * scale, middle]])
    centre = ends.mean(axis=0)
    if form == "line":
        _lines(image, [ends], palette.PLANE, LINE * scale)
    elif form == "dashes":
        _lines(image, list(_dashes([ends], scale)), palette.GOAL, LINE * scale)
    elif form == "disc":
        _circle(image, centre, DISC * scale, palette.PM, filled=True)
    elif form == "ring":
        _lines(image, [np.array([ends[0], centre])], palette.BEAM, (LINE + 1) * scale)
        _circle(image, centre, 0.8 * RING * scale, palette.BEAM, filled=False)
    else:
        half = 7.0 * scale
        cross = [centre + np.array([[-half, -half], [half, half]]), centre + np.array([[-half, half], [half, -half]])]
        _lines(image, cross, palette.UNUSED, LINE * scale, palette.MARKER)


def _lines(
    image: Picture, lines: Sequence[FloatArray], color: Color, thickness: float, halo: Color = (0, 0, 0)
) -> None:
    """Lines with a halo, so that they are seen on bright and on dark ground."""
    points = [np.rint(line * (1 << _SHIFT)).astype(np.int32) for line in lines]
    inner = max(1, round(thickness))
    for shade, width in ((halo, inner + 2), (color, inner)):
        cv2.polylines(image, points, False, _bgr(shade), width, cv2.LINE_AA, _SHIFT)


def _circle(image: Picture, centre: FloatArray, radius: float, color: Color, *, filled: bool) -> None:
    x, y = (round(float(value) * (1 << _SHIFT)) for value in centre)
    size, line = round(radius * (1 << _SHIFT)), max(2, round(radius / 4))
    halo = (cv2.FILLED, cv2.FILLED) if filled else (line + 2, line)
    cv2.circle(image, (x, y), size + ((2 << _SHIFT) if filled else 0), (0, 0, 0), halo[0], cv2.LINE_AA, _SHIFT)
    cv2.circle(image, (x, y), size, _bgr(color), halo[1], cv2.LINE_AA, _SHIFT)


def _dashes(lines: Sequence[FloatArray], scale: float) -> Iterator[FloatArray]:
    """The dashes of lines, by length along them."""
    for line in lines:
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        for start in np.arange(0.0, along[-1], (DASH + GAP) * scale)[:2000]:
            at = np.linspace(start, min(start + DASH * scale, along[-1]), 4)
            yield np.column_stack([np.interp(at, along, line[:, axis]) for axis in (0, 1)])


def _up_to(line: FloatArray, ends: FloatArray, radius: float) -> FloatArray:
    """The points of a line outside of a circle about its end."""
    if not len(ends):
        return line
    outside = line[np.linalg.norm(line - ends[0], axis=1) >= radius]
    towards = (line[0] - ends[0]) / max(float(np.linalg.norm(line[0] - ends[0])), 1e-9)
    return np.vstack([outside, ends[0] + radius * towards]) if len(outside) else outside


def _arrow_head(line: FloatArray, size: float) -> FloatArray | None:
    """(3, 2) the head at a line's end; None where the line is too short for one."""
    along = line[-1] - line[0]
    if np.linalg.norm(along) < size:
        return None
    step = next((line[-1] - point for point in line[::-1] if np.linalg.norm(line[-1] - point) > 0.5 * size), along)
    back = -size * step / np.linalg.norm(step)
    turns = [np.array([[c, -s], [s, c]]) for c, s in ((0.85, 0.53), (0.85, -0.53))]
    return np.stack([line[-1] + turns[0] @ back, line[-1], line[-1] + turns[1] @ back])


@lru_cache(maxsize=16)
def _strip(verdict: Verdict | None, width: int, rows: int) -> Picture:
    color = palette.UNUSED if verdict is None else palette.VERDICTS[verdict]
    drawn = strip(verdict, color)
    whole = cv2.resize(drawn[:, : round(width * drawn.shape[0] / rows)], (width, rows), interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(whole[..., ::-1])


def _fitted(text: str, room: int, size: float) -> tuple[str, float]:
    """The text and its size such that it fits: first smaller, then cut."""
    width = _width(text, size)
    if width > room:
        size *= max(0.75, room / width)
    while _width(text, size) > room and len(text) > 4:
        text = text[: max(1, len(text) * 9 // 10 - 3)].rstrip() + "..."
    return text, size


def _width(text: str, size: float) -> int:
    return int(cv2.getTextSize(text, _FONT, size, _weight(size))[0][0])


def _text(image: Picture, text: str, at: tuple[int, int], size: float, color: Color) -> None:
    """A text whose left end and vertical middle are given."""
    (_, high), _ = cv2.getTextSize(text, _FONT, size, _weight(size))
    cv2.putText(image, text, (at[0], at[1] + high // 2), _FONT, size, _bgr(color), _weight(size), cv2.LINE_AA)


def _weight(size: float) -> int:
    return max(1, round(2 * size))


def _bgr(color: Color) -> tuple[int, int, int]:
    return color[2], color[1], color[0]
