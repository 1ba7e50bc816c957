"""The TRUS probe of a session: its array, what it records, and where it detects a source. Lengths mm, angles rad."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray
from fgreg.schema.kinds import (
    COORDINATE_MM,
    NOT_NEGATIVE,
    POSITIVE_MM,
    Integer,
    Number,
    Numbers,
    NumberTuple,
)
from fgreg.schema.problems import FieldError
from fgreg.schema.record import Key

_MICROSECONDS = Number(-1e6, 1e6, unit="us")


def check_positive(**values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} is {value}, expected a number > 0")


@dataclass(frozen=True, slots=True, eq=False)
class SensitivityModel:
    """Half width of the window in which the probe detects a source, as *stage rotation*, against depth.

    Attributes:
        depth_mm, half_width_rad: (n,).
        curve_rotation_rad, curve_amplitude: (m,), or both None.
    """

    depth_mm: Annotated[FloatArray, Key("from the element; increasing", Numbers(None, Number(0.0, 300.0, unit="mm")))]
    half_width_rad: Annotated[
        FloatArray,
        Key(
            "how far the stage may be turned away from a source that is still detected, at each depth; linear between, "
            "constant beyond",
            Numbers(None, Number(0.0, 45.0, above=True, unit="deg", degrees=True)),
        ),
    ]
    edge_sigma_rad: Annotated[
        float,
        Key(
            "how well the half width is known: one error for the whole session",
            Number(0.0, 45.0, unit="deg", degrees=True),
        ),
    ]
    curve_rotation_rad: Annotated[
        FloatArray | None,
        Key(
            "turn of the stage, for looks that give an amplitude; increasing",
            Numbers(None, Number(-90.0, 90.0, unit="deg", degrees=True)),
            name="curve.rotation_deg",
            required=True,
        ),
    ] = None
    curve_amplitude: Annotated[
        FloatArray | None,
        Key("amplitude at each of these turns", Numbers(None, NOT_NEGATIVE), name="curve.amplitude", required=True),
    ] = None

    def __post_init__(self) -> None:
        _check_table("depth_mm", self.depth_mm, self.half_width_rad, "half_width_deg")
        if self.curve_rotation_rad is not None and self.curve_amplitude is not None:
            _check_table("rotation_deg", self.curve_rotation_rad, self.curve_amplitude, "curve", "amplitude")
            if not self.curve_amplitude.any():
                raise FieldError.of("only zeros", "at least one number > 0", "curve", "amplitude")

    def half_width_at(self, depth_mm: FloatArray | float) -> FloatArray:
        """Half width (rad) at depths from the element (mm), linear between and constant beyond the table."""
        return np.asarray(np.interp(depth_mm, self.depth_mm, self.half_width_rad))


def _check_table(over: str, abscissa: FloatArray, ordinate: FloatArray, *path: str) -> None:
    """Raises FieldError where a table's first column ``over`` does not increase, or where its second, at ``path``, has
    another number of entries."""
    if (np.diff(abscissa) <= 0).any():
        raise FieldError.of("numbers that do not increase", "each number larger than the one before", *path[:-1], over)
    if abscissa.shape != ordinate.shape:
        raise FieldError.of(f"{ordinate.size} numbers", f"{abscissa.size}, one for each in {over}", *path)


@dataclass(frozen=True, slots=True)
class ChannelModel:
    """Sampling of channel data."""

    sampling_mhz: Annotated[float, Key("rate", Number(0.1, 1e4, unit="MHz"))]
    t0_us: Annotated[float, Key("time of sample 0 after the laser's trigger", _MICROSECONDS)] = 0.0
    pulse_delay_us: Annotated[
        float, Key("by which the envelope of a wave has its maximum later than the true arrival", _MICROSECONDS)
    ] = 0.0

    def __post_init__(self) -> None:
        check_positive(sampling_mhz=self.sampling_mhz)


@dataclass(frozen=True, slots=True)
class ImageModel:
    """Scan-converted images (depth, lateral): envelopes, or log-compressed ones."""

    pixel_mm: Annotated[tuple[float, float], Key("pitch along depth and lateral", NumberTuple(2, POSITIVE_MM))]
    origin_mm: Annotated[
        tuple[float, float],
        Key("centre of pixel [0, 0]: range from the element face, x", NumberTuple(2, COORDINATE_MM)),
    ]
    log_db: Annotated[
        float | None,
        Key(
            "where the pictures are log-compressed: the range between their blackest and their whitest value",
            Number(0.0, 200.0, above=True, unit="dB"),
        ),
    ] = None

    def __post_init__(self) -> None:
        check_positive(dz=self.pixel_mm[0], dx=self.pixel_mm[1], log_db=1.0 if self.log_db is None else self.log_db)

    def linear(self, frame: npt.NDArray[np.generic]) -> FloatArray:
        """Pixels in proportion to the envelope: log-compressed ones are taken back, others stay as they are.

        0 is ``log_db`` below the largest value that a pixel can have: of 8-bit pixels 255; of others the least of 1
        (floating-point numbers only), 255, 1023, 4095, 16383 and 65535 that none exceeds, since 16 bits are seldom
        filled. Numbers of which none is above 0, and some are below, are dB.
        """
        pixels = np.asarray(frame, dtype=np.float64)
        if self.log_db is None or not pixels.size:
            return pixels
        top = float(pixels.max())
        if top <= 0.0 and float(pixels.min()) < 0.0:
            below_db = pixels
        else:
            sizes = (1.0 if frame.dtype.kind == "f" else 0.0, *(2.0**bits - 1.0 for bits in (8, 10, 12, 14, 16)))
            below_db = self.log_db * (pixels / next((size for size in sizes if size >= max(top, 1e-9)), top) - 1.0)
        return np.asarray(np.power(10.0, below_db / 20.0))


@dataclass(frozen=True, slots=True, eq=False)
class ProbeModel:
    """The TRUS probe: linear array parallel to the rotation axis at ``radius_mm`` from it."""

    elements: Annotated[int, Key("of the array", Integer(1, 65536))]
    pitch_mm: Annotated[
        float, Key("element i is at x = (i - (elements - 1) / 2) * pitch_mm", Number(1e-3, 100.0, unit="mm"))
    ]
    flip: Annotated[bool, Key("true: element 0 is at +x")]
    radius_mm: Annotated[float, Key("from the axis of rotation to the element faces", POSITIVE_MM)]
    sound_speed_m_s: Annotated[
        float, Key("that ranges were, or are to be, computed with", Number(0.0, 1e5, above=True, unit="m/s"))
    ]
    sensitivity: Annotated[SensitivityModel, Key("the window in which a source is detected")]
    channels: Annotated[ChannelModel | None, Key("of channel data")] = None
    image: Annotated[ImageModel | None, Key("of images")] = None

    def __post_init__(self) -> None:
        check_positive(elements=self.elements, pitch_mm=self.pitch_mm, radius_mm=self.radius_mm)
        check_positive(sound_speed_m_s=self.sound_speed_m_s)

    def is_channel_data(self, frame: npt.NDArray[np.generic]) -> bool:
        """Whether a frame is channel data; all other frames of a probe with ``image`` are images."""
        return self.holds_channels(frame.shape, frame.dtype)

    def holds_channels(self, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> bool:
        """Whether an array of this shape and type is channel data: (elements, samples), float32 or int16."""
        is_type = (dtype.kind, dtype.itemsize) in (("f", 4), ("i", 2))
        return self.channels is not None and is_type and len(shape) == 2 and shape[0] == self.elements

    @property
    def element_x_mm(self) -> FloatArray:
        """TRUS x of each element, (elements,), in the order of the channel data's rows."""
        x = (np.arange(self.elements) - (self.elements - 1) / 2.0) * self.pitch_mm
        return np.asarray(-x if self.flip else x)
