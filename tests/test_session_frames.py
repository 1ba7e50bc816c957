"""Frames that events name stay in the session's folder, exist, and are what they should be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numpy.lib import format as npy_format

from fgreg.errors import InputError
from fgreg.session.session_reader import check_session, read_session
from tests import session_files


def checked(folder: Path) -> list[str]:
    return [str(problem) for problem in check_session(folder)[0]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A session with all its frames."""
    session_files.write(tmp_path / "session")
    session_files.write_frames(tmp_path / "session")
    return tmp_path / "session"


def test_a_whole_session_has_no_problem(folder: Path) -> None:
    assert check_session(folder) == ([], [])


@pytest.mark.parametrize(
    "name",
    [
        "../a.png",
        "frames/../../a.png",
        "frames/../a.png",
        "/etc/passwd",
        "C:\\a.png",
        "C:a.png",
        "\\\\server\\share\\a.png",
        "..\\a.png",
        ".",
        "",
        "frames/a\0.png",
        "frames/a\n.png",
        "a" * 2000,
    ],
)
def test_names_that_leave_the_folder_or_are_none(folder: Path, name: str) -> None:
    events = session_files.events()
    events[2]["marker"]["left"] = name
    with pytest.raises(InputError) as caught:
        read_session(session_files.write(folder, None, events))
    assert str(caught.value).startswith("events.jsonl: line 3: marker.left: found ")


def test_links_may_stay_inside_but_not_lead_out(folder: Path) -> None:
    outside = folder.parent / "outside.png"
    outside.write_bytes(session_files.png(640, 480))
    link = folder / "frames" / "a.png"
    link.unlink()
    link.symlink_to("b.png")
    assert checked(folder) == []
    link.unlink()
    link.symlink_to(outside)
    with pytest.raises(InputError, match="leads out of the folder"):
        read_session(folder)
    link.unlink()
    link.symlink_to(link)
    with pytest.raises(InputError, match=r"line 3: marker\.left"):
        read_session(folder)


def test_a_linked_folder_of_frames_may_not_lead_out_either(folder: Path) -> None:
    (folder / "frames").rename(folder.parent / "elsewhere")
    (folder / "frames").symlink_to(folder.parent / "elsewhere")
    with pytest.raises(InputError, match="leads out of the folder"):
        read_session(folder)


def test_a_session_reached_through_a_link_is_fine(folder: Path) -> None:
    link = folder.parent / "link"
    link.symlink_to(folder)
    assert check_session(link) == ([], [])


def test_reading_needs_no_frames_but_checking_does(folder: Path) -> None:
    (folder / "frames" / "a.png").unlink()
    (folder / "frames" / "c.npy").unlink()
    (folder / "frames" / "c.npy").mkdir()
    assert len(read_session(folder).events) == 20
    assert checked(folder) == [
        "events.jsonl: line 3: marker.left: found 'frames/a.png': no such file, expected a file",
        "events.jsonl: line 5: trus.frame: found 'frames/c.npy': a folder, expected a file",
    ]


@pytest.mark.parametrize("cut", [0, 4, 8, 20, 32, 33, 40, 60, -12, -1])
def test_an_image_cut_anywhere_is_no_image(folder: Path, cut: int) -> None:
    path = folder / "frames" / "b.png"
    path.write_bytes(path.read_bytes()[:cut])
    assert checked(folder) == [
        "events.jsonl: line 5: marker.right: found 'frames/b.png', which is not a complete PNG, expected a PNG image"
    ]


def test_an_image_of_another_size_or_kind(folder: Path) -> None:
    (folder / "frames" / "a.png").write_bytes(session_files.png(480, 640))
    (folder / "frames" / "b.png").write_bytes(b"\xff\xd8\xff\xe0 a JPEG image" + b"\0" * 100)
    assert checked(folder) == [
        "events.jsonl: line 3: marker.left: found 'frames/a.png' with 480 x 640 px, "
        "expected camera.image_size, 640 x 480",
        "events.jsonl: line 5: marker.right: found 'frames/b.png', which is not a complete PNG, expected a PNG image",
    ]


def save(folder: Path, array: npt.NDArray[Any]) -> None:
    np.save(folder / "frames" / "c.npy", array)


@pytest.mark.parametrize("dtype", ["float32", "int16", ">f4", ">i2"])
def test_channel_data_in_both_types_and_byte_orders(folder: Path, dtype: str) -> None:
    setup = session_files.setup()
    del setup["probe"]["image"]
    session_files.write(folder, setup)
    save(folder, np.zeros((128, 30), dtype=dtype))
    assert checked(folder) == []


@pytest.mark.parametrize(
    ("shape", "dtype", "found"),
    [
        ((64, 30), "float32", "an array of float32 with shape [64, 30]"),
        ((30, 128), "float32", "an array of float32 with shape [30, 128]"),
        ((128, 30), "float64", "an array of float64 with shape [128, 30]"),
        ((128, 30), "complex64", "an array of complex64 with shape [128, 30]"),
        ((128,), "float32", "an array of float32 with shape [128]"),
        ((128, 0), "float32", "an array of float32 with shape [128, 0]"),
        ((128, 30, 1), "float32", "an array of float32 with shape [128, 30, 1]"),
    ],
)
def test_arrays_that_are_no_channel_data(folder: Path, shape: tuple[int, ...], dtype: str, found: str) -> None:
    setup = session_files.setup()
    del setup["probe"]["image"]
    session_files.write(folder, setup)
    save(folder, np.zeros(shape, dtype=dtype))
    assert checked(folder) == [
        f"events.jsonl: line 5: trus.frame: found 'frames/c.npy' with {found}, "
        "expected channel data (float32 or int16) of shape [128, samples]"
    ]


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32", "float64"])
def test_images_of_any_numbers(folder: Path, dtype: str) -> None:
    setup = session_files.setup()
    del setup["probe"]["channels"]
    session_files.write(folder, setup)
    save(folder, np.zeros((300, 200), dtype=dtype))
    assert checked(folder) == []
    save(folder, np.zeros((300, 200, 3), dtype=dtype))
    assert len(checked(folder)) == 1


def test_pickles_are_never_loaded(folder: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[object, tuple[object, ...]]:
            return (Path.touch, (folder / "sprung",))

    np.save(folder / "frames" / "c.npy", np.array([[Trap()]], dtype=object), allow_pickle=True)
    assert checked(folder) == [
        "events.jsonl: line 5: trus.frame: found 'frames/c.npy' with Python objects, expected an NPY array of numbers"
    ]
    assert not (folder / "sprung").exists()


def test_an_array_shorter_than_its_header_says(folder: Path) -> None:
    path = folder / "frames" / "c.npy"
    data = path.read_bytes()
    path.write_bytes(data[:-1])
    assert checked(folder) == [
        f"events.jsonl: line 5: trus.frame: found 'frames/c.npy' with {len(data) - 1} bytes, "
        f"expected {len(data)} bytes, as its header says"
    ]
    with path.open("wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": (128, 10**15)}
        npy_format.write_array_header_1_0(file, header)
    assert "as its header says" in checked(folder)[0]


def test_no_bytes_crash_the_reader_of_array_headers(folder: Path) -> None:
    """Seeded damage to a header: accepted or refused in one line."""
    path = folder / "frames" / "c.npy"
    data = bytearray(path.read_bytes())
    random = np.random.default_rng(5)
    refused = 0
    for _ in range(200):
        damaged = bytearray(data)
        for _ in range(int(random.integers(1, 4))):
            damaged[int(random.integers(0, 128))] = int(random.integers(0, 256))
        path.write_bytes(damaged)
        problems = checked(folder)
        assert len(problems) <= 1
        refused += len(problems)
    assert refused > 100
