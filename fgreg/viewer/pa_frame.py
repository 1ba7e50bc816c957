"""A photoacoustic frame as an image with square pixels in (x, range), and the pixel coordinates of points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray
from fgreg.model.probe_model import ProbeModel

DYNAMIC_RANGE_DB = 30.0
"""Largest range shown between black and white, below the frame's own maximum."""
NOISE_QUANTILE = 0.92
"""Pixels below this quantile are black: most of a frame is noise."""


@dataclass(frozen=True, slots=True, eq=False)
class PaPicture:
    """A frame as an image: rows are range, downwards; columns are TRUS x, to the right.

    Attributes:
        image: (rows, columns) uint8, logarithmic.
        range_mm, x_mm: of the centre of pixel [0, 0].
        pixel_mm: side of a pixel.
        wavefront: whether rows of a column are arrival times, so that a point shows as a curve (channel data).
    """

    image: npt.NDArray[np.uint8]
    range_mm: float
    x_mm: float
    pixel_mm: float
    wavefront: bool

    def pixels(self, x_mm: FloatArray | float, range_mm: FloatArray | float) -> FloatArray:
        """(..., 2) picture coordinates (column, row) of points; the first pixel's centre is (0.5, 0.5)."""
        x, r = np.broadcast_arrays(np.asarray(x_mm, dtype=np.float64), np.asarray(range_mm, dtype=np.float64))
        return np.stack([(x - self.x_mm) / self.pixel_mm, (r - self.range_mm) / self.pixel_mm], axis=-1) + 0.5

    @property
    def extent_mm(self) -> tuple[float, float, float, float]:
        """Outer edges: smallest and largest x, smallest and largest range."""
        half = self.pixel_mm / 2.0
        rows, columns = self.image.shape
        return (
            self.x_mm - half,
            self.x_mm + (columns - 0.5) * self.pixel_mm,
            self.range_mm - half,
            self.range_mm + (rows - 0.5) * self.pixel_mm,
        )


def sample_ranges_mm(samples: int, probe: ProbeModel) -> FloatArray:
    """(samples,) range in mm of each sample of channel data: c (t0 + s / fs - delay)."""
    if probe.channels is None:
        raise ValueError("the probe has no channels")
    time_us = probe.channels.t0_us + np.arange(samples) / probe.channels.sampling_mhz - probe.channels.pulse_delay_us
    return np.asarray(probe.sound_speed_m_s * 1e-3 * time_us)


def pa_picture(frame: npt.NDArray[np.generic], probe: ProbeModel, largest_side: int = 480) -> PaPicture | None:
    """The image of a frame; None where the probe does not define the sampling of its frames.

    Each pixel is the largest absolute value of the samples it covers, so that no short pulse is lost.
    """
    if frame.ndim != 2:
        return None
    data: FloatArray = np.asarray(frame, dtype=np.float64)
    ranges: FloatArray
    values: FloatArray
    x: FloatArray
    if probe.channels is not None and (probe.image is None or probe.is_channel_data(frame)):
        x, ranges = probe.element_x_mm, sample_ranges_mm(data.shape[1], probe)
        if data.shape[0] != len(x):
            return None
        values, wavefront = np.abs(data - data.mean(axis=1, keepdims=True)).T, True
        if probe.flip:
            x, values = x[::-1], values[:, ::-1]
    elif probe.image is not None:
        (dz, dx), (z0, x0) = probe.image.pixel_mm, probe.image.origin_mm
        x = np.asarray(x0 + dx * np.arange(data.shape[1]), dtype=np.float64)
        ranges = np.asarray(z0 + dz * np.arange(data.shape[0]), dtype=np.float64)
        values, wavefront = np.abs(probe.image.linear(frame)), False
    else:
        return None
    kept = ranges >= 0.0
    if kept.sum() < 2 or len(x) < 2:
        return None
    ranges, values = ranges[kept], values[kept]
    pixel = max(ranges[-1] - ranges[0], x[-1] - x[0]) / (largest_side - 1)
    rows = _resampled(values, ranges, pixel)
    both = _resampled(rows.T, x, pixel).T
    return PaPicture(_compressed(both), float(ranges[0]), float(x[0]), float(pixel), wavefront)


def _resampled(values: FloatArray, at_mm: FloatArray, pixel_mm: float) -> FloatArray:
    """Rows at increasing ``at_mm`` resampled to ``pixel_mm``: the maximum of several in one, else the nearest."""
    count = round((at_mm[-1] - at_mm[0]) / pixel_mm) + 1
    edges = at_mm[0] + (np.arange(count) - 0.5) * pixel_mm
    starts = np.searchsorted(at_mm, edges)
    stops = np.append(starts[1:], len(at_mm))
    nearest = np.clip(np.round(np.interp(edges + 0.5 * pixel_mm, at_mm, np.arange(len(at_mm)))), 0, len(at_mm) - 1)
    out: FloatArray = values[nearest.astype(np.int64)]
    filled = stops > starts
    out[filled] = np.maximum.reduceat(values, starts[filled], axis=0)
    return np.asarray(out)


def _compressed(values: FloatArray) -> npt.NDArray[np.uint8]:
    """Absolute values as logarithmic grey levels above the noise; all black without a signal."""
    values = np.where(np.isfinite(values), values, 0.0)
    top = float(values.max())
    if top <= 0.0:
        return np.zeros(values.shape, dtype=np.uint8)
    black = max(float(np.quantile(values, NOISE_QUANTILE)) / top, 10.0 ** (-DYNAMIC_RANGE_DB / 20.0))
    level = 1.0 - np.log(np.maximum(values / top, 1e-6)) / math.log(min(black, 0.99))
    return np.asarray(np.clip(255.0 * level, 0.0, 255.0).astype(np.uint8))


def texture(picture: PaPicture, largest_side: int = 160) -> npt.NDArray[np.uint8]:
    """(rows, columns, 3) a small blue version of an image, for the image plane in the 3D view."""
    rows, columns = picture.image.shape
    step = max(1, -(-max(rows, columns) // largest_side))
    small = np.maximum.reduceat(
        np.maximum.reduceat(picture.image, np.arange(0, rows, step), axis=0), np.arange(0, columns, step), axis=1
    )
    level = small[..., None] / 255.0
    return np.asarray((np.array([14.0, 34.0, 48.0]) + level * np.array([150.0, 215.0, 207.0])).astype(np.uint8))
