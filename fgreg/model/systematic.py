"""The rig's constants, which a session takes as known, and how well they are known.

No radius, window or print is exactly as declared, and an error in one of them is the same in every shot: it does not
average out. So each constant is a variable of the graph: the deviation of its true value from the declared one, with a
Gaussian prior of mean zero. Their standard deviations are ``systematic`` of ``session.yaml``. Millimetres, radians,
pixels; ratios for relative deviations.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import SystematicEstimate
from fgreg.schema.kinds import NOISE_MM, Converted, JsonSchema, Number, NumberTuple
from fgreg.schema.problems import FieldError, shown
from fgreg.schema.record import Key, NotStored, record

_RELATIVE = Number(0.0, 1.0)
_DEGREES = Number(0.0, 45.0, unit="deg", degrees=True)


@dataclass(frozen=True, slots=True)
class Systematic:
    """Standard deviations of the rig's constants: ``systematic`` of ``session.yaml``; 0: known exactly.

    The defaults are those of a careful lab (docs/model.md, section 6, gives the reason for each). Not ``declared``:
    ``systematic: none``, all constants are taken as exact and the verdict is at most ``warning``.
    """

    radius_mm: Annotated[float, Key("axis of rotation to element faces", NOISE_MM)] = 0.2
    range_offset_mm: Annotated[float, Key("added to every range: trigger, lens", NOISE_MM)] = 0.1
    sound_speed: Annotated[float, Key("relative", _RELATIVE)] = 0.01
    pitch: Annotated[float, Key("relative", _RELATIVE)] = 0.002
    array_offset_mm: Annotated[float, Key("of the array beside the axis, tangential", NOISE_MM)] = 0.15
    array_tilt_rad: Annotated[
        tuple[float, float, float],
        Key("within the image plane; about the radial direction; of the plane in elevation", NumberTuple(3, _DEGREES)),
    ] = (math.radians(0.2),) * 3
    window_centre_rad: Annotated[float, Key("the window's centre against the image plane", _DEGREES)] = math.radians(
        0.3
    )
    camera_scale: Annotated[float, Key("all lengths of the camera's space, relative", _RELATIVE)] = 0.002
    focal: Annotated[float, Key("focal length of each camera, relative", _RELATIVE)] = 0.002
    principal_point_px: Annotated[float, Key("of each camera, each axis", Number(0.0, 1e4, unit="px"))] = 1.0
    stereo_rotation_rad: Annotated[float, Key("of `right_T_left`, about each axis", _DEGREES)] = math.radians(0.03)
    stereo_translation_mm: Annotated[float, Key("of `right_T_left`, along each axis", NOISE_MM)] = 0.02
    tag_size: Annotated[float, Key("size of printed tags, and of the board, relative", _RELATIVE)] = 0.003
    view_bias_mm: Annotated[
        float, Key("offset of the marker that turns with the angle at which it is seen", NOISE_MM)
    ] = 0.05
    backlash_rad: Annotated[float, Key("of the stage against the direction that it came from", _DEGREES)] = (
        math.radians(0.1)
    )
    declared: Annotated[bool, NotStored(True)] = True

    def sigmas(self, edge_sigma_rad: float, marker_bias_mm: float) -> FloatArray:
        """(COUNT,) standard deviations in the order of :class:`Constant`.

        Args:
            edge_sigma_rad: of the sensitivity window's half width.
            marker_bias_mm: of the marker's constant bias, each axis.
        """
        return np.array(
            [
                edge_sigma_rad,
                self.radius_mm,
                self.range_offset_mm,
                self.sound_speed,
                self.pitch,
                self.array_offset_mm,
                *self.array_tilt_rad,
                self.window_centre_rad,
                self.backlash_rad,
                *[marker_bias_mm] * 3,
                self.camera_scale,
                *[self.focal] * 2,
                *[self.principal_point_px] * 4,
                *[self.stereo_rotation_rad] * 3,
                *[self.stereo_translation_mm] * 3,
                *[self.tag_size] * 2,
                self.view_bias_mm,
            ],
            dtype=np.float64,
        )


CAREFUL_LAB = Systematic()
"""The defaults."""
EXACT = Systematic(0.0, 0.0, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""All constants known exactly, declared by a standard deviation of 0 for each."""
NONE = replace(EXACT, declared=False)
"""``systematic: none``."""
_WORD = "none"


class _SystematicKind(Converted):
    """``systematic`` of ``session.yaml``: a mapping, or the word ``none``."""

    def read(self, value: object, folder: Path | None = None, /) -> Any:
        if value == _WORD:
            return NONE
        if not isinstance(value, dict):
            raise FieldError.of(shown(value), self.expected)
        return super().read(value, folder)

    def write(self, value: Any, folder: Path | None = None, /) -> Any:
        return super().write(value, folder) if value.declared else _WORD

    @property
    def expected(self) -> str:
        return f"{super().expected}, or none"

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        return {"anyOf": [super().json_schema(definitions), {"const": _WORD}]}


SYSTEMATIC = _SystematicKind(record(Systematic), lambda value: value, lambda value: value)
"""``systematic`` of ``session.yaml``."""


@dataclass(frozen=True, slots=True)
class ConstantText:
    """How a constant is called.

    Attributes:
        name: key of ``systematic`` in files, with an index where the key is of several.
        per_unit: of the file's unit in one of the memory's (degrees per radian; 1 where they are the same).
        unit: of the file; empty for relative deviations.
        what: in sentences, after "the".
        remedy: what to do where it is not as declared.
    """

    name: str
    per_unit: float
    unit: str
    what: str
    remedy: str


_DEG = math.degrees(1.0)
_LENS = "calibrate the cameras again"
_STEREO = "calibrate the stereo pair again"
_ARRAY = "measure the array on the probe"


def _texts() -> tuple[ConstantText, ...]:
    axes = "xyz"
    return (
        ConstantText("edge_sigma_deg", _DEG, "deg", "window's half width", "measure the sensitivity window"),
        ConstantText("radius_mm", 1.0, "mm", "probe's radius", "measure the axis of rotation to the element faces"),
        ConstantText("range_offset_mm", 1.0, "mm", "range offset", "measure the trigger delay and the lens"),
        ConstantText("sound_speed", 1.0, "", "sound speed", "measure the medium's temperature or sound speed"),
        ConstantText("pitch", 1.0, "", "element pitch", "check probe.pitch_mm against the data sheet"),
        ConstantText("array_offset_mm", 1.0, "mm", "array's offset beside the axis", _ARRAY),
        ConstantText("array_tilt_deg[0]", _DEG, "deg", "array's tilt within the image plane", _ARRAY),
        ConstantText("array_tilt_deg[1]", _DEG, "deg", "array's turn about the radial direction", _ARRAY),
        ConstantText("array_tilt_deg[2]", _DEG, "deg", "image plane's tilt in elevation", _ARRAY),
        ConstantText("window_centre_deg", _DEG, "deg", "window's centre", "measure the window from both sides"),
        ConstantText("backlash_deg", _DEG, "deg", "stage's backlash", "measure the backlash"),
        *(
            ConstantText(f"marker_bias_mm[{i}]", 1.0, "mm", f"marker's bias along camera {axes[i]}", _LENS)
            for i in range(3)
        ),
        ConstantText("camera_scale", 1.0, "", "scale of the camera's lengths", _STEREO),
        ConstantText("focal[0]", 1.0, "", "left focal length", _LENS),
        ConstantText("focal[1]", 1.0, "", "right focal length", _LENS),
        *(
            ConstantText(
                f"principal_point_px[{2 * side + i}]",
                1.0,
                "px",
                f"{('left', 'right')[side]} principal point's {axes[i]}",
                _LENS,
            )
            for side in range(2)
            for i in range(2)
        ),
        *(
            ConstantText(f"stereo_rotation_deg[{i}]", _DEG, "deg", f"stereo rotation about {axes[i]}", _STEREO)
            for i in range(3)
        ),
        *(
            ConstantText(f"stereo_translation_mm[{i}]", 1.0, "mm", f"stereo translation along {axes[i]}", _STEREO)
            for i in range(3)
        ),
        ConstantText("tag_size", 1.0, "", "tag's printed size", "measure the printed tag"),
        ConstantText("board_size", 1.0, "", "board's printed size", "measure the printed board"),
        ConstantText("view_bias_mm", 1.0, "mm", "marker's bias by viewing angle", "check the print and its light"),
    )


TEXTS = _texts()
"""One for each :class:`Constant`."""


CAUSES = 3
"""Number of causes that are named."""


def largest_causes(constants: Sequence[SystematicEstimate], count: int = CAUSES) -> str:
    """The constants that cause most of the error at the worst target, as text; empty where none does."""
    texts = {text.name: text for text in TEXTS}
    order = sorted(constants, key=lambda constant: -constant.worst_target_mm)[:count]
    parts = [f"{texts[c.name].what} {c.worst_target_mm:.2f} mm" for c in order if c.worst_target_mm >= 0.005]
    return ", ".join(parts)
