"""The endoscope's cameras: lens models and stereo pose; also how ``session.yaml`` describes them. Frozen; mm, px."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Self

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.schema.kinds import (
    Converted,
    IntegerPair,
    JsonSchema,
    Number,
    Numbers,
    Text,
    list_schema,
)
from fgreg.schema.matrices import Matrix, Transform
from fgreg.schema.problems import FieldError, shown
from fgreg.schema.record import Key, record

MOST_PX = 1e5
"""Of an entry of a camera's matrix."""
MOST_COEFFICIENT = 1e4
"""Of a lens' coefficient."""
DISTORTION_SIZES = (4, 5, 8, 12)
"""Numbers of coefficients of OpenCV's polynomial lens models: the plain one (4 or 5), rational (8), thin prism (12)."""
FISHEYE_SIZE = 4
"""Of Kannala and Brandt's model."""
POLYNOMIAL_NAMES = ("plumb_bob", "radtan", "rational_polynomial", "pinhole", "none", "")
"""What calibration files call the polynomial models, whose number of coefficients tells which one it is."""
FISHEYE_NAMES = ("fisheye", "equidistant")
_COEFFICIENT = Number(-MOST_COEFFICIENT, MOST_COEFFICIENT)
_TILTED_SIZE = 14
_TILTED = "OpenCV's model with a tilted sensor"
_SIZES = "4, 5, 8 or 12"


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    """A camera with one of OpenCV's lens models.

    Attributes:
        image_size: (w, h) px.
        matrix: (3, 3) px.
        distortion: (4,), (5,), (8,) or (12,): k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4; for a fisheye lens (4,).
        fisheye: the model of Kannala and Brandt, for wide angles: the angle from the axis is distorted.
    """

    image_size: tuple[int, int]
    matrix: FloatArray
    distortion: FloatArray
    fisheye: bool = False


def lens_coefficients(values: FloatArray, name: str) -> tuple[FloatArray, bool]:
    """A calibration file's coefficients in OpenCV's order and whether the lens is a fisheye one.

    Args:
        values: (n,); trailing coefficients of a larger polynomial model that are zero are left out, none is five zeros.
        name: of the model, as files call it.

    Raises:
        FieldError: another model, or a number of coefficients that it does not have.
    """
    values = np.asarray(values, dtype=np.float64).ravel()
    if name in FISHEYE_NAMES:
        if values.size != FISHEYE_SIZE:
            raise FieldError.of(f"{values.size} coefficients", f"{FISHEYE_SIZE}, of a fisheye lens")
        return values, True
    if name not in POLYNOMIAL_NAMES:
        expected = "plumb_bob, radtan, rational_polynomial, or equidistant (fisheye); calibrate with one of these"
        raise FieldError.of(f"the distortion model {shown(name)}", expected)
    expected = f"{_SIZES}, in OpenCV's order"
    if values.size not in (0, *DISTORTION_SIZES, _TILTED_SIZE):
        raise FieldError.of(f"{values.size} coefficients", expected)
    if values[DISTORTION_SIZES[-1] :].any():
        raise FieldError.of(f"{values.size} coefficients, of {_TILTED}", expected)
    needed = next(size for size in DISTORTION_SIZES[1:] if not values[size:].any())
    out = np.zeros(needed)
    out[: values.size] = values[:needed]
    return out, False


@dataclass(frozen=True, slots=True)
class _Distortion(Numbers):
    """The coefficients of a lens, of one of the numbers that OpenCV knows."""

    def read(self, value: object, _folder: Path | None = None, /) -> FloatArray:
        if isinstance(value, list) and len(value) == _TILTED_SIZE:
            raise FieldError.of(f"{_TILTED_SIZE} numbers, {_TILTED}", self.expected)
        if not isinstance(value, list) or len(value) not in DISTORTION_SIZES:
            raise FieldError.of(shown(value), self.expected)
        out: FloatArray = Numbers.read(self, value)
        return out

    @property
    def expected(self) -> str:
        return f"a list of {_SIZES} numbers, each {self.each.expected}"

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        each = self.each.json_schema(definitions)
        return {"anyOf": [list_schema(each, size, size) for size in DISTORTION_SIZES]}


@dataclass(frozen=True, slots=True, eq=False)
class _LensSection:
    """One camera of ``session.yaml``; its image size is that of both."""

    matrix: Annotated[FloatArray, Key("[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], px", Matrix(3))]
    distortion: Annotated[
        FloatArray, Key("[k1, k2, p1, p2, k3, ...], OpenCV's: 4, 5, 8 or 12", _Distortion(None, _COEFFICIENT))
    ]
    model: Annotated[str | None, Key("Kannala-Brandt, with 4 coefficients", Text(allowed=("fisheye",)))] = None

    JSON_RULES: ClassVar = (
        {"if": {"required": ["model"]}, "then": {"properties": {"distortion": {"maxItems": FISHEYE_SIZE}}}},
    )

    def __post_init__(self) -> None:
        if self.model is not None and len(self.distortion) != FISHEYE_SIZE:
            expected = f"{FISHEYE_SIZE} numbers, for model: fisheye"
            raise FieldError.of(f"{len(self.distortion)} numbers", expected, "distortion")
        matrix = self.matrix
        zeros = (matrix[0, 1], matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1.0)
        positive = matrix[0, 0] > 0 and matrix[1, 1] > 0
        if not (positive and max(map(abs, zeros)) <= 1e-9 and np.abs(matrix).max() <= MOST_PX):
            found = "[" + ", ".join("[" + ", ".join(f"{v:g}" for v in row) + "]" for row in matrix) + "]"
            raise FieldError.of(found, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px with fx, fy > 0", "matrix")


@dataclass(frozen=True, slots=True, eq=False)
class StereoRig:
    """The endoscope: left camera (frame ``camera``) and, where there is one, the right with ``right_T_left``."""

    left: CameraModel
    right: CameraModel | None = None
    right_T_left: FloatArray | None = None

    def __post_init__(self) -> None:
        if (self.right is None) != (self.right_T_left is None):
            raise ValueError("right and right_T_left go together")


@dataclass(frozen=True, slots=True, eq=False)
class _CameraSection:
    """``camera`` of ``session.yaml``."""

    JSON_RULES: ClassVar = ({"dependentRequired": {"right": ["right_T_left"], "right_T_left": ["right"]}},)

    image_size: Annotated[
        tuple[int, int],
        Key(
            "width and height, px, of both cameras",
            IntegerPair(1, 32768, "[width, height], two integers from 1 to 32768"),
        ),
    ]
    left: Annotated[_LensSection, Key("the left camera, whose frame is `camera`")]
    right: Annotated[_LensSection | None, Key("the right camera, where there is one")] = None
    right_T_left: Annotated[FloatArray | None, Key("together with `right`", Transform())] = None

    def __post_init__(self) -> None:
        if (self.right is None) != (self.right_T_left is None):
            absent = "right" if self.right is None else "right_T_left"
            raise FieldError.of("nothing", "right and right_T_left together", absent)

    def rig(self) -> StereoRig:
        """The rig that the section describes."""

        def camera(lens: _LensSection) -> CameraModel:
            return CameraModel(self.image_size, lens.matrix, lens.distortion, lens.model is not None)

        return StereoRig(camera(self.left), None if self.right is None else camera(self.right), self.right_T_left)

    @classmethod
    def of(cls, rig: StereoRig) -> Self:
        """The section that describes a rig."""

        def lens(camera: CameraModel) -> _LensSection:
            return _LensSection(camera.matrix, camera.distortion, "fisheye" if camera.fisheye else None)

        right = None if rig.right is None else lens(rig.right)
        return cls(rig.left.image_size, lens(rig.left), right, rig.right_T_left)


STEREO_RIG = Converted(record(_CameraSection), _CameraSection.rig, _CameraSection.of)
"""``camera`` of ``session.yaml``."""
