"""Channel data in USTB's ultrasound file format (``.uff``), read by ``pyuff-ustb`` (extra ``[uff]``)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.convert.hdf5_file import open_hdf5
from fgreg.convert.mapping import RecordingMapping
from fgreg.convert.probe_frames import DeclaredProbe, ProbeFrames, pitch_of, positive
from fgreg.errors import InputError, MissingExtraError
from fgreg.geometry.transforms import as_float_array
from fgreg.schema.limits import ARRAY_BYTES

_CLASS = "uff.channel_data"
_MM_PER_M, _MHZ_PER_HZ, _US_PER_S = 1e3, 1e-6, 1e6


def channel_data_of(file: Any) -> list[str]:
    """Names of the channel data in an open HDF5 file; empty where it is no UFF file."""
    found = []
    for name, item in file.items():
        kind = item.attrs.get("class", b"")
        if (kind.decode("ascii", "replace") if isinstance(kind, bytes) else str(kind)) == _CLASS:
            found.append(str(name))
    return found


def read_uff(path: Path, mapping: RecordingMapping) -> ProbeFrames:
    """The frames of a file's channel data: ``data`` (samples, channels, waves, frames).

    Raises:
        InputError: damaged, demodulated or complex data, several waves, several channel data and none named.
        MissingExtraError: ``pyuff-ustb`` is not installed.
    """
    try:
        import pyuff_ustb
    except ImportError:
        raise MissingExtraError("pyuff-ustb", "uff") from None
    with open_hdf5(path) as file:
        there = channel_data_of(file)
        name = mapping.array_variable or (there[0] if len(there) == 1 else "")
        if name not in there:
            found = f"channel data {', '.join(there)}"[:200]
            raise InputError(path.name, found, "one of them, named in the mapping: array.variable")
        where = f"{path.name}: {name}"
        stored = file[name].get("data")
        if stored is not None and (not hasattr(stored, "shape") or stored.dtype.kind == "c"):
            raise InputError(f"{where}.data", "complex numbers (IQ data)", "channel data as received")
        if (
            stored is None
            or not 2 <= len(stored.shape) <= 4
            or math.prod(stored.shape) * stored.dtype.itemsize > ARRAY_BYTES
        ):
            raise InputError(
                f"{where}.data", "no array of samples, channels, waves, frames", f"one of at most {ARRAY_BYTES} bytes"
            )
        data, declared = _channel_data(pyuff_ustb.Uff(str(path)).read(name), where)

    def read(index: int) -> npt.NDArray[Any]:
        return data[:, :, index].T

    return ProbeFrames(path.name, data.shape[2], read, declared, taken=(f"{name}/",))


def _channel_data(stored: Any, where: str) -> tuple[npt.NDArray[Any], DeclaredProbe]:
    """(samples, channels, frames), and what is said of it."""
    if isinstance(stored, list):
        raise InputError(where, f"{len(stored)} objects", "one")
    if positive(stored.modulation_frequency) is not None:
        raise InputError(f"{where}.modulation_frequency", "demodulated data", "channel data as received (0)")
    data = np.asarray(stored.data)
    data = data.reshape(*data.shape, *[1] * (4 - data.ndim))
    if data.shape[2] != 1:
        raise InputError(f"{where}.data", f"{data.shape[2]} waves", "one: what the array hears after a laser pulse")
    wave = stored.sequence[0] if isinstance(stored.sequence, list) else stored.sequence
    delay = 0.0 if wave is None else float(np.asarray(wave.delay if wave.delay is not None else 0.0).flat[0])
    if delay != 0.0:
        raise InputError(
            f"{where}.sequence.delay", f"{delay:g} s", "0: times after the laser pulse, from initial_time on"
        )
    rate, start = positive(stored.sampling_frequency), stored.initial_time
    geometry = None if stored.probe is None else np.atleast_2d(np.asarray(stored.probe.geometry, dtype=np.float64))
    positions = None if geometry is None else geometry.T if geometry.shape[0] == 7 else geometry
    return data[:, :, 0], DeclaredProbe(
        where,
        elements=data.shape[1],
        pitch_mm=None
        if positions is None
        else pitch_of(as_float_array(positions[:, :3] * _MM_PER_M), f"{where}.probe"),
        sampling_mhz=None if rate is None else rate * _MHZ_PER_HZ,
        t0_us=None if start is None else float(np.asarray(start).flat[0]) * _US_PER_S,
        sound_speed_m_s=positive(stored.sound_speed),
        channels=True,
    )
