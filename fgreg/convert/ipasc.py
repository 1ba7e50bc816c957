"""IPASC's format for photoacoustic data (HDF5), with the names of fields that ``pacfish`` writes; by ``h5py``.

``binary_time_series_data`` is (detectors, samples, wavelengths, frames); ``meta_data`` and ``meta_data_device`` are in
SI units.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.convert.hdf5_file import check_dataset, open_hdf5
from fgreg.convert.mapping import RecordingMapping
from fgreg.convert.probe_frames import DeclaredProbe, ProbeFrames, pitch_of, positive
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, as_float_array

DATA = "binary_time_series_data"
_NM_PER_M, _MM_PER_M, _MHZ_PER_HZ = 1e9, 1e3, 1e-6


def is_ipasc(file: Any) -> bool:
    """Whether an open HDF5 file is one of IPASC's."""
    return DATA in file and "meta_data" in file


def read_ipasc(path: Path, mapping: RecordingMapping) -> ProbeFrames:
    """The frames of a file, of one wavelength.

    Raises:
        InputError: damaged, data that contradict its sizes, several wavelengths and none named in the mapping.
        MissingExtraError: ``h5py`` is not installed.
    """
    with open_hdf5(path) as file:
        dataset, where = file[DATA], f"{path.name}: {DATA}"
        check_dataset(dataset, where)
        wavelengths = _numbers(file, "meta_data/acquisition_wavelengths")
        axes, shape = _axes(file, dataset.shape, wavelengths, where)
        wavelength = _wavelength(wavelengths, shape[2], mapping, path.name)
        positions = _positions(file)
        speed = positive(_numbers(file, "meta_data/speed_of_sound"))
        rate = positive(_numbers(file, "meta_data/ad_sampling_rate"))
        declared = DeclaredProbe(
            path.name,
            elements=shape[0],
            pitch_mm=None if positions is None else pitch_of(positions, f"{path.name}: detector positions"),
            sampling_mhz=None if rate is None else rate * _MHZ_PER_HZ,
            sound_speed_m_s=speed,
            channels=True,
        )
        times = _numbers(file, "meta_data/measurement_timestamps")

    def read(index: int) -> npt.NDArray[Any]:
        with open_hdf5(path) as file:
            place = (slice(None), slice(None), wavelength, index)
            at = tuple(place[axis] for axis in axes)
            stored = np.asarray(file[DATA][at])
        return stored if axes.index(0) < axes.index(1) else stored.T

    if times is not None and times.size != shape[3]:
        times = None
    return ProbeFrames(path.name, shape[3], read, declared, times, (DATA, "meta_data/", "meta_data_device/"))


def _axes(
    file: Any, shape: tuple[int, ...], wavelengths: FloatArray | None, where: str
) -> tuple[list[int], tuple[int, int, int, int]]:
    """For each axis of the stored array which of (detectors, samples, wavelengths, frames) it is, and their sizes.

    MATLAB's writer stores the axes the other way round and leaves out last ones of size 1. A third and last axis is
    that of the wavelengths where there are as many, else that of the frames.
    """
    stated, detectors = _numbers(file, "meta_data/sizes"), _detectors(file)

    def fits(sizes: tuple[int, ...]) -> bool:
        if stated is None:
            return detectors is None or detectors == sizes[0]
        count = min(stated.size, len(sizes))
        regrouped = stated[0] == sizes[0] and stated.prod() == math.prod(sizes)
        return bool(regrouped or (stated[:count] == sizes[:count]).all())

    for sizes, order in ((shape, 1), (shape[::-1], -1)):
        if 2 <= len(sizes) <= 4 and min(sizes) >= 1 and fits(sizes):
            axes = [0, 1, 2, 3][: len(sizes)]
            if len(sizes) == 3 and sizes[2] > 1 and (wavelengths is None or wavelengths.size != sizes[2]):
                axes = [0, 1, 3]
            full = [1, 1, 1, 1]
            for axis, size in zip(axes, sizes, strict=True):
                full[axis] = size
            return axes[::order], (full[0], full[1], full[2], full[3])
    says = f"sizes {stated.astype(int).tolist()}" if stated is not None else f"{detectors or 'its'} detectors"
    expected = f"detectors, samples, wavelengths, frames, of {says} as meta_data says"
    raise InputError(where, f"an array of shape {list(shape)}", expected)


def _wavelength(wavelengths: FloatArray | None, count: int, mapping: RecordingMapping, name: str) -> int:
    """The place of the wavelength to take."""
    nm = None if wavelengths is None or wavelengths.size != count else wavelengths
    if nm is not None and nm.max() < 1e-3:  # metres, as the format has it; some writers state nanometres
        nm = nm * _NM_PER_M
    wanted = mapping.wavelength_nm
    there = "unnamed ones" if nm is None else ", ".join(f"{value:.6g} nm" for value in nm)
    if wanted is None:
        if count == 1:
            return 0
        raise InputError(
            f"{name}: wavelengths", f"{count}: {there}"[:200], "one, named in the mapping: array.wavelength_nm"
        )
    near: npt.NDArray[np.intp] | list[int] = [] if nm is None else np.flatnonzero(np.abs(nm - wanted) < 0.5)
    if len(near) != 1:
        raise InputError(f"{name}: wavelengths", there[:200], f"{wanted:g} nm, as array.wavelength_nm says")
    return int(near[0])


def _numbers(file: Any, key: str) -> FloatArray | None:
    """The numbers of a field, in one dimension; None where it is absent or states nothing (pacfish writes "None")."""
    if key not in file or not hasattr(file[key], "shape"):
        return None
    dataset = file[key]
    if dataset.dtype.kind not in "iufb" or dataset.shape is None:
        return None
    check_dataset(dataset, key)
    values = np.asarray(dataset[()], dtype=np.float64).ravel()
    return as_float_array(values) if values.size and np.isfinite(values).all() else None


def _detectors(file: Any) -> int | None:
    group = file.get("meta_data_device/detectors")
    return len(group) if group is not None and hasattr(group, "keys") and len(group) > 1 else None


def _positions(file: Any) -> FloatArray | None:
    """(n, 3) positions of the detectors (mm) in the order of their names; None where not all have one."""
    group = file.get("meta_data_device/detectors")
    if group is None or not hasattr(group, "keys"):
        return None
    found = [_numbers(file, f"{group.name}/{key}/detector_position") for key in sorted(group)]
    if not found or any(position is None or position.size != 3 for position in found):
        return None
    return as_float_array(np.array(found) * _MM_PER_M)
