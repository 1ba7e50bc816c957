"""MATLAB and HDF5 files as sessions: written by scipy, hdf5storage and h5py, each with the same shots."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from fgreg.convert import array_files, child_reader
from fgreg.convert.mapping import MAPPING, RecordingMapping
from fgreg.errors import InputError, MissingExtraError
from fgreg.geometry.transforms import exp_so3, make_transform
from tests.test_convert_tables import convert, events, mapping, refused, setup

h5py: Any = pytest.importorskip("h5py", reason="h5py is not installed (pip install 'fgreg[hdf5]')")

IN_A_CHILD = child_reader.open_array_file
COUNT, ELEMENTS, SAMPLES = 5, 128, 20
TIMES = 10.0 + 0.1 * np.arange(COUNT)
POSES = np.stack([make_transform(exp_so3(np.array([0.1 * i, 0.2, 0])), np.array([i, 2.0, 150])) for i in range(COUNT)])
RF = np.random.default_rng(5).integers(-2000, 2000, (COUNT, ELEMENTS, SAMPLES)).astype(np.int16)
TYPES = ["pair", "pair", "track", "pair", "pair"]
MAP: dict[str, dict[str, Any]] = {
    "columns": {
        "scan_deg": {"column": "stage.angle_rad", "scale": 57.29577951308232},
        "type": "kind",
        "sweep": "stage.sweep",
    },
    "array": {"variable": "rf", "axes": ["samples", "elements", "frames"]},
}


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Starting a child for each file takes long; the last tests do it."""
    monkeypatch.setattr(child_reader, "open_array_file", array_files.open_array_file)


def matlab_variables() -> dict[str, Any]:
    """As a lab's MATLAB script saves them: columns or rows, transforms 4x4xN, a struct, and data samples x channels x N
    in a cell, as Verasonics has them."""
    cell = np.empty((1, 1), dtype=object)
    cell[0, 0] = np.transpose(RF, (2, 1, 0))
    return {
        "t": TIMES[:, None],
        "pm": np.arange(COUNT, dtype=np.uint8)[None],
        "camera_T_marker": np.moveaxis(POSES, 0, 2),
        "rf": cell,
        "kind": np.array(TYPES, dtype=object)[:, None],
        "stage": {
            "angle_rad": np.radians([1.0, 2.0, 3.0, 4.0, 5.0]),
            "sweep": np.array([1.0, -1.0, np.nan, np.nan, np.nan]),
        },
        "operator": "AB",
    }


def by_scipy(path: Path) -> Path:
    scipy.io.savemat(path, matlab_variables(), do_compression=True)
    return path


def by_hdf5storage(path: Path, **changes: Any) -> Path:
    module = pytest.importorskip("hdf5storage", reason="hdf5storage is not installed")
    values = {key: value for key, value in (matlab_variables() | changes).items() if value is not None}
    module.savemat(str(path), values, format="7.3", store_python_metadata=False)
    return path


def by_h5py(path: Path) -> Path:
    """As a Python program saves them: rows first."""
    values = matlab_variables()
    with h5py.File(path, "w") as file:
        file["t"], file["pm"], file["camera_T_marker"] = TIMES, values["pm"].ravel(), POSES
        file.create_dataset("rf", data=np.transpose(RF, (0, 2, 1)), compression="gzip", chunks=(1, SAMPLES, ELEMENTS))
        file["kind"] = TYPES
        file["stage/angle_rad"], file["stage/sweep"] = values["stage"]["angle_rad"], values["stage"]["sweep"]
        file["operator"] = "AB"
    return path


def expected() -> list[dict[str, Any]]:
    out = []
    for i in range(COUNT):
        trus: dict[str, Any] = {"scan_deg": 1.0 + i, "frame": RF[i]}
        if i < 2:
            trus["sweep"] = (1, -1)[i]
        event = {"type": TYPES[i], "t": TIMES[i], "marker": {"camera_T_marker": POSES[i].tolist()}, "trus": trus}
        out.append(event | ({} if TYPES[i] == "track" else {"pm": i}))
    return out


def loaded(folder: Path) -> list[dict[str, Any]]:
    """The events with their frames in place of names."""
    found = events(folder)
    for event in found:
        frame = np.load(folder / event["trus"]["frame"])
        assert frame.dtype == np.int16
        event["trus"]["frame"] = frame
    return found


def assert_same(found: list[dict[str, Any]], right: list[dict[str, Any]]) -> None:
    assert len(found) == len(right)
    for a, b in zip(found, right, strict=True):
        assert a.keys() == b.keys()
        assert a["trus"].keys() == b["trus"].keys()
        assert (a["type"], a["t"], a.get("pm"), a["marker"]) == (b["type"], b["t"], b.get("pm"), b["marker"])
        assert a["trus"]["scan_deg"] == pytest.approx(b["trus"]["scan_deg"], abs=1e-12)
        assert a["trus"].get("sweep") == b["trus"].get("sweep")
        np.testing.assert_array_equal(a["trus"]["frame"], b["trus"]["frame"])


@pytest.mark.parametrize("writer", ["scipy", "hdf5storage", "h5py"])
def test_the_variables_of_a_file_are_the_columns_of_a_table(tmp_path: Path, writer: str) -> None:
    make, ending = {"scipy": (by_scipy, "mat"), "hdf5storage": (by_hdf5storage, "mat"), "h5py": (by_h5py, "h5")}[writer]
    path = make(tmp_path / f"shots.{ending}")
    content: dict[str, Any] = MAP
    if writer == "h5py":
        columns = {
            key: (entry | {"column": "stage/angle_rad"} if isinstance(entry, dict) else entry.replace(".", "/"))
            for key, entry in MAP["columns"].items()
        }
        content = {"columns": columns, "array": {"variable": "rf", "axes": ["frames", "samples", "elements"]}}
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", mapping(tmp_path, **content))
    assert done.exit_code == 0, done.output
    assert_same(loaded(tmp_path / "s"), expected())
    assert "columns that are not used: operator" in done.stderr


def test_struct_and_cell_arrays_of_both_kinds_of_file_have_one_entry_for_each_event(tmp_path: Path) -> None:
    shots = np.zeros((1, COUNT), dtype=[("t", "O"), ("pm", "O"), ("pose", "O"), ("rf", "O"), ("angle", "O")])
    for i in range(COUNT):
        shots[0, i] = (np.array([[TIMES[i]]]), i, POSES[i], RF[i], 1.0 + i)
    scipy.io.savemat(tmp_path / "five.mat", {"shots": shots, "t": TIMES})
    with h5py.File(tmp_path / "seven.mat", "w", userblock_size=512) as file:
        file["t"] = TIMES[:, None]
        for field in ("pm", "pose", "rf", "angle"):
            for i in range(COUNT):
                file[f"#refs#/{field}{i}"] = np.atleast_2d(np.asarray(shots[0, i][field])).T
            names = [[file[f"#refs#/{field}{i}"].ref] for i in range(COUNT)]
            file.create_dataset(f"shots/{field}", data=np.array(names, dtype=h5py.ref_dtype), dtype=h5py.ref_dtype)
    with (tmp_path / "seven.mat").open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64")
    content = {
        "columns": {"pm": "shots.pm", "camera_T_marker": "shots.pose", "scan_deg": "shots.angle"},
        "array": {"variable": "shots.rf", "axes": ["elements", "samples"]},
    }
    right = [event | {"type": "pair", "pm": i} for i, event in enumerate(expected())]
    for event in right:
        event["trus"].pop("sweep", None)
    for kind in ("five", "seven"):
        words = (
            tmp_path / f"{kind}.mat",
            tmp_path / kind,
            "--setup",
            setup(tmp_path),
            "--map",
            mapping(tmp_path, **content),
        )
        done = convert(*words)
        assert done.exit_code == 0, done.output
        assert_same(loaded(tmp_path / kind), right)


def test_images_are_turned_to_depth_and_lateral_and_keep_their_bits(tmp_path: Path) -> None:
    images = np.random.default_rng(2).integers(0, 255, (3, 30, 40)).astype(np.uint8)
    scipy.io.savemat(tmp_path / "a.mat", {"frame": np.transpose(images, (2, 1, 0))})
    mapped = RecordingMapping(array_axes=("lateral", "depth", "frames"))
    frames = array_files.open_array_file(tmp_path / "a.mat", mapped).frames
    assert frames is not None
    np.testing.assert_array_equal(frames.frame(2), images[2])
    assert frames.frame(2).dtype == np.uint8
    with pytest.raises(
        InputError, match=r"a\.mat: frame: found frames of 40 x 30 x 3 numbers and nothing about their axes"
    ):
        array_files.open_array_file(tmp_path / "a.mat", RecordingMapping())


def test_a_table_names_frames_inside_other_files(tmp_path: Path) -> None:
    by_hdf5storage(tmp_path / "data.mat")
    pose = " ".join(map(repr, POSES[0].ravel().tolist()))
    rows = [f"{t},{i},{pose},{i},data.mat,{4 - i}\n" for i, t in enumerate((1.0, 2.0))]
    path = tmp_path / "shots.csv"
    path.write_text("t,pm,camera_T_marker,scan_deg,frame,shot\n" + "".join(rows))
    columns = {"frame_index": {"column": "shot", "offset": -1}}  # MATLAB counts from 1
    named = mapping(tmp_path, columns=columns, array=MAP["array"])
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", named)
    assert done.exit_code == 0, done.output
    frames = [np.load(tmp_path / "s" / event["trus"]["frame"]) for event in events(tmp_path / "s")]
    np.testing.assert_array_equal(frames, RF[[3, 2]])
    named = mapping(tmp_path, array=MAP["array"])
    message = refused(path, tmp_path / "t", "--setup", setup(tmp_path), "--map", named)
    assert (
        "line 2: frame_index: found nothing, expected the number of one of the 5 frames in data.mat, from 0" in message
    )
    named = mapping(tmp_path, columns={"frame_index": {"column": "shot", "offset": 3}}, array=MAP["array"])
    message = refused(path, tmp_path / "t", "--setup", setup(tmp_path), "--map", named)
    assert "line 2: frame_index: found 7, expected a number below 5, from 0" in message


@pytest.mark.parametrize(
    ("change", "content", "message"),
    [
        ({"t": None}, {}, "shots.mat: found camera_T_marker, kind, operator"),
        ({"pm": np.arange(3)}, {}, "shots.mat: pm: found 1 x 3 values, expected 5, as t has 5 rows"),
        ({"camera_T_marker": POSES}, {}, "camera_T_marker: found 5 x 4 x 4 values, expected 4x4x5, as t has 5 rows"),
        ({"t": "soon"}, {}, "shots.mat: t: found no real numbers"),
        ({"camera_T_marker": np.ones((4, 4, 5))}, {}, "shots.mat: row 0: camera_T_marker: found"),
        (
            {"rf": np.zeros((20, 64, 5))},
            {},
            "shots.mat: rf: elements: found 64, expected 128 (probe.elements), as session",
        ),
        ({"rf": np.zeros((20, 128, 3))}, {}, "shots.mat: frames: found 3, expected 5, as there are times"),
        ({"rf": np.zeros((20, 128, 5)) * 1j}, {}, "frame 0: found complex numbers (IQ data), expected real numbers"),
        ({"rf": np.zeros((20, 128))}, {}, "shots.mat: frames: found 1, expected 5"),
        ({}, {"array": {"variable": "rf"}}, "rf: found frames of 20 x 128 x 5 numbers and nothing about their axes"),
        (
            {},
            {"array": {"variable": "RF", "axes": ["samples", "elements"]}},
            "RF: found no such variable, expected one of",
        ),
        (
            {},
            {"array": {"variable": "rf", "axes": ["samples", "frames"]}},
            "expected elements and samples, or depth and",
        ),
        ({"stage": None}, {"columns": {}}, "or a CSV table whose column frame names this file"),
    ],
)
def test_what_does_not_fit_is_named(
    tmp_path: Path, change: dict[str, Any], content: dict[str, Any], message: str
) -> None:
    by_hdf5storage(tmp_path / "shots.mat", **change)
    words = (
        tmp_path / "shots.mat",
        tmp_path / "s",
        "--setup",
        setup(tmp_path),
        "--map",
        mapping(tmp_path, **(MAP | content)),
    )
    assert message in refused(*words)
    assert not (tmp_path / "s").exists()


def test_files_that_are_none_are_refused_and_a_missing_library_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, expected in (("a.mat", "a MATLAB file that cannot be read"), ("a.h5", "another file, expected an HDF5")):
        (tmp_path / name).write_bytes(b"nothing")
        assert expected in refused(tmp_path / name, tmp_path / "s", "--setup", setup(tmp_path))
    path = by_h5py(tmp_path / "b.h5")
    monkeypatch.setitem(sys.modules, "h5py", None)
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path))
    assert isinstance(done.exception, MissingExtraError)
    assert "pip install 'fgreg[hdf5]'" in str(done.exception)


def test_files_are_read_in_a_child_which_may_end(tmp_path: Path) -> None:
    mapped: RecordingMapping = MAPPING.read({"format": "fgreg-mapping/1"} | MAP)
    opened = IN_A_CHILD(by_hdf5storage(tmp_path / "shots.mat"), mapped)
    assert opened.frames is not None
    np.testing.assert_array_equal(opened.frames.frame(3), RF[3])
    np.testing.assert_array_equal(opened.variables["t"].numbers(), TIMES)
    # The type of the numbers of t becomes a code that does not exist, which scipy takes for the place of one.
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"t": np.array([[0.5]])})
    data = path.read_bytes()
    kind = data.index(np.float64(0.5).tobytes()) - 8
    path.write_bytes(data[:kind] + (200).to_bytes(4, "little") + data[kind + 4 :])
    with pytest.raises(InputError, match=r"^a\.mat: found a file that cannot be read \(its reader has ended\)"):
        IN_A_CHILD(path, mapped)
    (tmp_path / "b.mat").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"^b\.mat: found a MATLAB file that cannot be read"):
        IN_A_CHILD(tmp_path / "b.mat", mapped)
