"""IPASC's HDF5 and USTB's UFF: channel data as their own libraries write them, and what they say of the probe."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgreg.convert import array_files, child_reader
from fgreg.convert.mapping import RecordingMapping
from fgreg.convert.probe_frames import ProbeFrames, pitch_of
from fgreg.errors import InputError, MissingExtraError
from tests import session_files
from tests.test_convert_tables import POSE, convert, events, mapping, refused, setup

h5py: Any = pytest.importorskip("h5py", reason="h5py is not installed (pip install 'fgreg[hdf5]')")

COUNT, ELEMENTS, SAMPLES = 3, 128, 20
DATA = np.random.default_rng(8).normal(size=(ELEMENTS, SAMPLES, 1, COUNT)).astype(np.float32)
X_M = (np.arange(ELEMENTS) - (ELEMENTS - 1) / 2) * 0.43e-3
TIMES = np.array([100.0, 100.1, 100.2])


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Starting a child for each file takes long; tests/test_convert_arrays.py has one."""
    monkeypatch.setattr(child_reader, "open_array_file", array_files.open_array_file)


def ipasc_acquisition(**changes: Any) -> dict[str, Any]:
    found = {"ad_sampling_rate": 40e6, "speed_of_sound": 1540.0, "measurement_timestamps": TIMES}
    found |= {"acquisition_wavelengths": np.array([800e-9]), "sizes": np.array(DATA.shape), "data_type": "float32"}
    return found | {"overall_gain": None, "dimensionality": "time"} | changes


def ipasc_device(x_m: Any = X_M) -> dict[str, Any]:
    elements = {f"{i:010d}": {"detector_position": np.array([x, 0.0, 0.0])} for i, x in enumerate(x_m)}
    general = {"unique_identifier": "probe", "num_detectors": len(x_m)}
    return {"general": general, "detectors": elements, "illuminators": {}}


def by_hand(path: Path, data: Any = DATA, acquisition: Any = None, device: Any = None) -> Path:
    """In the layout of pacfish: dictionaries are groups, None is the text "None"."""

    def write(group: Any, values: dict[str, Any]) -> None:
        for key, value in values.items():
            if isinstance(value, dict):
                write(group.require_group(key), value)
            else:
                group[key] = "None" if value is None else value

    with h5py.File(path, "w") as file:
        file["binary_time_series_data"] = data
        write(file.require_group("meta_data"), ipasc_acquisition() if acquisition is None else acquisition)
        write(file.require_group("meta_data_device"), ipasc_device() if device is None else device)
    return path


def by_pacfish(path: Path) -> Path:
    pacfish = pytest.importorskip("pacfish", reason="pacfish is not installed")
    pacfish.write_data(str(path), pacfish.PAData(DATA, ipasc_acquisition(), ipasc_device()))
    return path


def opened(path: Path, **options: Any) -> ProbeFrames:
    found = array_files.open_array_file(path, RecordingMapping(**options)).frames
    assert found is not None
    return found


def table(folder: Path, file: str) -> Path:
    """A table of looks at frames of a file."""
    rows = "".join(f"{t},{i},{POSE},{i},{file},{i}\n" for i, t in enumerate(TIMES))
    path = folder / "shots.csv"
    path.write_text("t,pm,camera_T_marker,scan_deg,frame,frame_index\n" + rows)
    return path


def frames_of(folder: Path) -> Any:
    return np.stack([np.load(folder / event["trus"]["frame"]) for event in events(folder)], axis=2)


@pytest.mark.parametrize("writer", ["hand", "pacfish"])
def test_ipasc_frames_that_a_table_names(tmp_path: Path, writer: str) -> None:
    path = {"hand": by_hand, "pacfish": by_pacfish}[writer](tmp_path / "scan.hdf5")
    done = convert(table(tmp_path, path.name), tmp_path / "s", "--setup", setup(tmp_path))
    assert done.exit_code == 0, done.output
    np.testing.assert_array_equal(frames_of(tmp_path / "s"), DATA[:, :, 0])
    declared = opened(path).declared
    assert (declared.elements, declared.sampling_mhz, declared.sound_speed_m_s) == (128, 40.0, 1540.0)
    assert declared.pitch_mm == pytest.approx(0.43)


def test_an_ipasc_file_with_poses_and_angles_beside_its_data_is_a_recording(tmp_path: Path) -> None:
    path = by_hand(tmp_path / "scan.h5")
    message = refused(path, tmp_path / "s", "--setup", setup(tmp_path))
    assert "expected scan_deg; or a CSV table whose column frame names this file" in message
    with h5py.File(path, "a") as file:
        file["scan_deg"], file["pm"] = [1.0, 2.0, 3.0], [0, 0, 1]
        file["marker"] = np.tile(session_files.QUARTER, (3, 1, 1))
    named = mapping(tmp_path, columns={"camera_T_marker": "marker"})
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", named)
    assert done.exit_code == 0, done.output
    assert "not used" not in done.stderr
    assert [event["t"] for event in events(tmp_path / "s")] == TIMES.tolist()
    np.testing.assert_array_equal(frames_of(tmp_path / "s"), DATA[:, :, 0])


@pytest.mark.parametrize("sizes", [True, False])
def test_matlabs_writer_of_ipasc_files_has_the_axes_the_other_way_round(tmp_path: Path, sizes: bool) -> None:
    acquisition = ipasc_acquisition(**({} if sizes else {"sizes": None}))
    for name, data in (("all", DATA.T), ("one", DATA[..., 0, 1].T)):
        found = opened(by_hand(tmp_path / f"{name}.h5", data, acquisition))
        assert found.count == (COUNT if name == "all" else 1)
        np.testing.assert_array_equal(found.frame(1 if name == "all" else 0), DATA[:, :, 0, 1])


@pytest.mark.parametrize("unit", [1e-9, 1.0])
def test_one_of_several_wavelengths_is_taken_by_its_name(tmp_path: Path, unit: float) -> None:
    data = np.concatenate([DATA, DATA + 1], axis=2)
    acquisition = ipasc_acquisition(acquisition_wavelengths=np.array([700.0, 800.0]) * unit, sizes=np.array(data.shape))
    path = by_hand(tmp_path / "a.h5", data, acquisition)
    with pytest.raises(InputError, match=r"wavelengths: found 2: 700 nm, 800 nm, expected one, named in the mapping"):
        opened(path)
    np.testing.assert_array_equal(opened(path, wavelength_nm=800.0).frame(2), DATA[:, :, 0, 2] + 1)
    with pytest.raises(InputError, match=r"expected 900 nm, as array\.wavelength_nm says"):
        opened(path, wavelength_nm=900.0)
    three = by_hand(tmp_path / "b.h5", data[..., 0], acquisition | {"sizes": np.array(data.shape[:3])})
    np.testing.assert_array_equal(opened(three, wavelength_nm=700.0).frame(0), DATA[:, :, 0, 0])


@pytest.mark.parametrize(
    ("acquisition", "device", "message"),
    [
        (
            {"ad_sampling_rate": 62.5e6},
            None,
            "scan.hdf5: sampling rate: found 62.5 MHz, expected 40 MHz (probe.channels)",
        ),
        (
            {},
            ipasc_device(X_M / 2),
            "scan.hdf5: pitch: found 0.215 mm, expected 0.43 mm (probe.pitch_mm), as session.yaml",
        ),
        ({}, ipasc_device(X_M**3), "detector positions: found elements that are not at even distances on a line"),
        (
            {"sizes": np.array([64, 40, 1, 3])},
            None,
            "expected detectors, samples, wavelengths, frames, of sizes [64, 40,",
        ),
    ],
)
def test_what_a_file_says_of_the_probe_is_compared_with_the_setup(
    tmp_path: Path, acquisition: dict[str, Any], device: Any, message: str
) -> None:
    by_hand(tmp_path / "scan.hdf5", DATA, ipasc_acquisition(**acquisition), device)
    assert message in refused(table(tmp_path, "scan.hdf5"), tmp_path / "s", "--setup", setup(tmp_path))
    assert not (tmp_path / "s").exists()


def test_channel_data_are_never_taken_for_pictures(tmp_path: Path) -> None:
    by_hand(tmp_path / "scan.hdf5")
    probe = session_files.setup()["probe"]
    del probe["channels"]
    message = refused(table(tmp_path, "scan.hdf5"), tmp_path / "s", "--setup", setup(tmp_path, probe=probe))
    assert (
        "scan.hdf5: frames: found channel data, expected images: there is no probe.channels, as session.yaml" in message
    )


def test_another_speed_of_sound_is_told_and_the_setups_is_used(tmp_path: Path) -> None:
    by_hand(tmp_path / "scan.hdf5", DATA, ipasc_acquisition(speed_of_sound=1480.0))
    done = convert(table(tmp_path, "scan.hdf5"), tmp_path / "s", "--setup", setup(tmp_path))
    assert done.exit_code == 0, done.output
    assert (
        "warning: scan.hdf5 says 1480 m/s, session.yaml 1540 m/s (probe.sound_speed_m_s): that is used" in done.stderr
    )


def test_positions_of_a_linear_array() -> None:
    assert pitch_of(np.zeros((4, 3)), "f") is None
    line = np.outer(np.arange(5), [0.3, 0.0, 0.4])
    assert pitch_of(line, "f") == pytest.approx(0.5)
    with pytest.raises(InputError, match="not at even distances"):
        pitch_of(np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 1.0, 0]]), "f")


def uff(path: Path, **changes: Any) -> Path:
    """Channel data of a photoacoustic acquisition, as pyuff writes them."""
    pyuff = pytest.importorskip("pyuff_ustb", reason="pyuff-ustb is not installed (pip install 'fgreg[uff]')")
    data = np.ascontiguousarray(np.swapaxes(DATA, 0, 1))
    wave = pyuff.Wave(
        wavefront=pyuff.Wavefront.photoacoustic,
        source=pyuff.Point(distance=0.0, azimuth=0.0, elevation=0.0),
        origin=pyuff.Point(distance=0.0, azimuth=0.0, elevation=0.0),
        apodization=None,
        delay=changes.pop("delay", 0.0),
    )
    values = {"sampling_frequency": 40e6, "initial_time": 0.5e-6, "sound_speed": 1540.0, "modulation_frequency": 0.0}
    values |= {"probe": pyuff.LinearArray(N=ELEMENTS, pitch=changes.pop("pitch", 0.43e-3)), "data": data} | changes
    channels = pyuff.ChannelData(sequence=wave, **values)
    channels.write(str(path), "channel_data", ignore_missing_compulsory_fields=True)
    return path


def test_uff_channel_data_that_a_table_names(tmp_path: Path) -> None:
    path = uff(tmp_path / "scan.uff")
    done = convert(table(tmp_path, "scan.uff"), tmp_path / "s", "--setup", setup(tmp_path))
    assert done.exit_code == 0, done.output
    np.testing.assert_array_equal(frames_of(tmp_path / "s"), DATA[:, :, 0])
    declared = opened(path).declared
    assert (declared.elements, declared.sampling_mhz) == (128, 40.0)
    assert declared.t0_us == pytest.approx(0.5)
    assert declared.pitch_mm == pytest.approx(0.43)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"initial_time": 0.0},
            "channel_data: time of the first sample: found 0 us, expected 0.5 us (probe.channels.t0_us)",
        ),
        ({"pitch": 0.3e-3}, "channel_data: pitch: found 0.3 mm, expected 0.43 mm (probe.pitch_mm)"),
        ({"sampling_frequency": 20e6}, "sampling rate: found 20 MHz, expected 40 MHz"),
        ({"modulation_frequency": 5e6}, "modulation_frequency: found demodulated data"),
        ({"delay": 1e-6}, "sequence.delay: found 1e-06 s, expected 0"),
        ({"data": np.zeros((20, 128, 5, 2))}, "channel_data.data: found 5 waves, expected one"),
        ({"data": np.zeros((20, 64, 1, 3))}, "channel_data: elements: found 64, expected 128"),
        ({"data": np.zeros((20, 128, 1, 3)) * 1j}, "channel_data.data: found complex numbers (IQ data)"),
    ],
)
def test_uff_data_that_are_not_of_this_setup_are_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    uff(tmp_path / "scan.uff", **changes)
    assert message in refused(table(tmp_path, "scan.uff"), tmp_path / "s", "--setup", setup(tmp_path))


def test_the_missing_library_of_uff_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = uff(tmp_path / "scan.uff")
    monkeypatch.setitem(sys.modules, "pyuff_ustb", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'fgreg\[uff\]'"):
        opened(path)
