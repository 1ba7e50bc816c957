"""Frames of the probe in files of other programs, and what they say of the probe: one form for all formats."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray
from fgreg.model.probe_model import ProbeModel

_FAR_MM = 1e6
_UNEVEN = 0.05
"""Largest relative difference between the distances of neighbouring elements of a linear array."""


@dataclass(frozen=True, slots=True)
class DeclaredProbe:
    """What a file says of the probe and of its sampling; None where it says nothing.

    Attributes:
        source: of the statement, for messages.
        t0_us: time of sample 0 after the laser pulse.
        channels: whether the frames are channel data, not images.
    """

    source: str
    elements: int | None = None
    pitch_mm: float | None = None
    sampling_mhz: float | None = None
    t0_us: float | None = None
    sound_speed_m_s: float | None = None
    channels: bool = False

    def check(self, probe: ProbeModel) -> list[str]:
        """Compare with session.yaml; returns warnings.

        Raises:
            InputError: the two contradict each other where one of them must be wrong.
        """

        def refuse(key: str, found: str, expected: str) -> InputError:
            return InputError(f"{self.source}: {key}", found, f"{expected}, as session.yaml says")

        if self.channels and probe.channels is None:
            raise refuse("frames", "channel data", "images: there is no probe.channels")
        if self.elements is not None and self.elements != probe.elements:
            raise refuse("elements", str(self.elements), f"{probe.elements} (probe.elements)")
        if self.pitch_mm is not None and abs(self.pitch_mm / probe.pitch_mm - 1.0) > 0.01:
            raise refuse("pitch", f"{self.pitch_mm:.4g} mm", f"{probe.pitch_mm:g} mm (probe.pitch_mm)")
        if probe.channels is not None:
            rate, start = probe.channels.sampling_mhz, probe.channels.t0_us
            if self.sampling_mhz is not None and abs(self.sampling_mhz / rate - 1.0) > 1e-3:
                raise refuse("sampling rate", f"{self.sampling_mhz:.6g} MHz", f"{rate:g} MHz (probe.channels)")
            if self.t0_us is not None and abs(self.t0_us - start) > 0.5 / rate:
                expected = f"{start:g} us (probe.channels.t0_us)"
                raise refuse("time of the first sample", f"{self.t0_us:.6g} us", expected)
        speed, ours = self.sound_speed_m_s, probe.sound_speed_m_s
        if speed is not None and abs(speed / ours - 1.0) > 0.002:
            # Files hold what the scanner beamforms with; what the lab measured goes into session.yaml.
            return [
                f"{self.source} says {speed:g} m/s, session.yaml {ours:g} m/s (probe.sound_speed_m_s): that is used"
            ]
        return []


@dataclass(frozen=True, slots=True, eq=False)
class ProbeFrames:
    """The frames in a file.

    Attributes:
        name: of the file, for messages.
        count: number of frames.
        read: a frame by its number from 0, (elements, samples) or (depth, lateral).
        declared: what the file says of the probe.
        times_s: time of each frame, (count,), or None.
        taken: names of the variables that are read for the frames, or of groups of them, with a ``/`` at the end.
    """

    name: str
    count: int
    read: Callable[[int], npt.NDArray[np.generic]]
    declared: DeclaredProbe
    times_s: FloatArray | None = None
    taken: tuple[str, ...] = ()

    def takes(self, variable: str) -> bool:
        """Whether a variable of the file is read for its frames."""
        return variable in self.taken or any(name.endswith("/") and variable.startswith(name) for name in self.taken)

    def frame(self, index: int) -> npt.NDArray[np.generic]:
        """A frame as a session holds it: int16, and unsigned pixels of 8 and 16 bits, as they are, else float32.

        Raises:
            InputError: no such frame, or one that holds no real numbers.
        """
        if not 0 <= index < self.count:
            raise InputError(f"{self.name}: frame {index}", "no such frame", f"a number below {self.count}")
        stored = self.read(index)
        if stored.dtype.kind not in "iuf":
            is_complex = stored.dtype.kind == "c" or stored.dtype.names == ("real", "imag")  # the latter by MATLAB
            found = "complex numbers (IQ data)" if is_complex else f"an array of {stored.dtype}"
            raise InputError(f"{self.name}: frame {index}", found, "real numbers")
        pixels = (np.uint8, np.uint16) if not self.declared.channels else ()
        kind = stored.dtype.newbyteorder("=") if stored.dtype in (np.int16, *pixels) else np.dtype(np.float32)
        if stored.dtype.kind == "f" and (np.abs(stored) > np.finfo(np.float32).max).any():
            raise InputError(f"{self.name}: frame {index}", "numbers beyond 3e38", "channel data")
        return np.ascontiguousarray(stored, dtype=kind)


def pitch_of(positions_mm: FloatArray, where: str) -> float | None:
    """Distance between neighbouring elements (mm) of positions (n, 3); None where they are all zero or just one.

    Raises:
        InputError: not at even distances on a line.
    """
    if len(positions_mm) < 2 or not np.ptp(positions_mm, axis=0).any():
        return None
    if not np.abs(positions_mm).max() < _FAR_MM:
        raise InputError(where, "elements more than a kilometre away", "their positions in metres")
    steps = np.diff(positions_mm, axis=0)
    pitch = float(np.linalg.norm(positions_mm[-1] - positions_mm[0])) / len(steps)
    if not np.isfinite(steps).all() or (np.linalg.norm(steps - steps.mean(axis=0), axis=1) > _UNEVEN * pitch).any():
        raise InputError(where, "elements that are not at even distances on a line", "a linear array, in its order")
    return pitch


def positive(value: object) -> float | None:
    """A number > 0 that a file states, or None where it states nothing such as 0 or NaN."""
    try:
        number = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return None
    return float(number.flat[0]) if number.size == 1 and np.isfinite(number).all() and number.flat[0] > 0 else None
