"""Sequences in NRRD files: written by pynrrd as PLUS and 3D Slicer lay them out, and by hand as PLUS writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgreg.convert.nrrd_sequence import read_nrrd_sequence
from fgreg.errors import InputError
from tests.test_convert_plus_sequences import IMAGES, POSE, by_hand, convert, events, refused, setup, three

nrrd: Any = pytest.importorskip("nrrd", reason="pynrrd is not installed (pip install 'fgreg[nrrd]')")


def as_plus(path: Path, fields: dict[str, str], images: Any = IMAGES, **header: Any) -> Path:
    """As PLUS: the frames last, its own names of the image's status and orientation."""
    fields = {key.replace("ImageStatus", "Status"): value for key, value in fields.items()}
    kinds = ["domain", "domain", "list"]
    head: dict[str, Any] = {"encoding": "raw", "kinds": kinds, "space dimension": 2}
    head["space directions"] = np.array([[0.2, 0.0], [0.0, 0.1], [np.nan, np.nan]])
    head |= {"ultrasound image orientation": "MFA", "ultrasound image type": "BRIGHTNESS"} | header | fields
    nrrd.write(str(path), images, head, index_order="C")
    return path


def as_slicer(path: Path, images: Any, first: bool) -> Path:
    """As 3D Slicer: volumes of one slice, the list axis first (older) or last, times as its values."""
    count, height, width = images.shape
    head: dict[str, Any] = {"encoding": "gzip"}
    if first:  # file order: list, i, j, k
        data = np.moveaxis(images.reshape(count, 1, height, width), 0, 3)
        head |= {"kinds": ["list", "domain", "domain", "domain"], "labels": ["time", "", "", ""]}
    else:
        data = images.reshape(count, 1, height, width)
        head |= {"kinds": ["domain", "domain", "domain", "list"], "labels": ["", "", "", "time"]}
    axis = 0 if first else 3
    head[f"axis {axis} index type"] = "numeric"
    head[f"axis {axis} index values"] = "0.5 0.75 1.5"
    head[f"axis {axis} item 1 StageAngle"] = "12.5"
    nrrd.write(str(path), np.ascontiguousarray(data), head, index_order="C")
    return path


@pytest.mark.parametrize(("encoding", "suffix"), [("raw", ".seq.nrrd"), ("gzip", ".nhdr"), ("bzip2", ".nrrd")])
def test_an_nrrd_sequence_becomes_the_same_session_as_its_metaimage(tmp_path: Path, encoding: str, suffix: str) -> None:
    fields = three(MarkerToCameraTransformStatus="MISSING")
    done = [
        convert(by_hand(tmp_path / "scan.mha", fields), tmp_path / "mha", "--setup", setup(tmp_path, log_db=60)),
        convert(
            as_plus(tmp_path / f"scan{suffix}", fields, encoding=encoding),
            tmp_path / "n",
            "--setup",
            setup(tmp_path, log_db=60),
        ),
    ]
    assert [run.exit_code for run in done] == [0, 0], done[1].output
    assert "frame 2 is left out: MarkerToCameraTransform is MISSING" in done[1].stderr
    assert events(tmp_path / "n")[1:] == events(tmp_path / "mha")[1:]
    for file in sorted((tmp_path / "mha/frames").iterdir()):
        assert (tmp_path / "n/frames" / file.name).read_bytes() == file.read_bytes()


def test_the_images_status_and_spacing_are_those_of_the_metaimage(tmp_path: Path) -> None:
    path = as_plus(tmp_path / "scan.nrrd", three(ImageStatus="INVALID"), IMAGES.astype(">u2"))
    sequence = read_nrrd_sequence(path)
    assert sequence.fields["ElementSpacing"] == "0.2 0.1"
    assert sequence.fields["UltrasoundImageOrientation"] == "MFA"
    assert sequence.images is not None
    assert sequence.images.dtype == np.dtype(np.uint16)
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path, log_db=60))
    assert "frame 2 is left out: ImageStatus is INVALID" in done.stderr


@pytest.mark.parametrize("first", [True, False])
def test_slicers_volumes_of_one_slice_in_either_order_of_axes(tmp_path: Path, first: bool) -> None:
    sequence = read_nrrd_sequence(as_slicer(tmp_path / "scan.seq.nrrd", IMAGES, first))
    np.testing.assert_array_equal(sequence.images, IMAGES)
    assert [frame["Timestamp"] for frame in sequence.frames] == ["0.5", "0.75", "1.5"]
    assert sequence.frames[1]["StageAngle"] == "12.5"


def test_slicers_times_in_ms_and_the_orientation_that_it_does_not_have(tmp_path: Path) -> None:
    count, height, width = IMAGES.shape
    head: dict[str, Any] = {"kinds": ["domain", "domain", "domain", "list"], "labels": ["", "", "", "time"]}
    head |= {"units": ["mm", "mm", "mm", "ms"], "axis 3 index values": "500 750 1500"}
    for i in range(count):
        head |= {f"axis 3 item {i} StageAngle": "2.5", f"axis 3 item {i} MarkerToCameraTransform": POSE}
    nrrd.write(str(tmp_path / "s.seq.nrrd"), IMAGES.reshape(count, 1, height, width), head, index_order="C")
    words = (tmp_path / "s.seq.nrrd", tmp_path / "out", "--setup", setup(tmp_path, log_db=60))
    mapping = tmp_path / "map.yaml"
    mapping.write_text("format: fgreg-mapping/1\nimages: log\n", encoding="utf-8")
    assert "found nothing, expected M or U and F or N" in refused(*words, "--map", str(mapping))
    mapping.write_text("format: fgreg-mapping/1\nimages: log\norientation: UN\n", encoding="utf-8")
    done = convert(*words, "--map", str(mapping))
    assert done.exit_code == 0, done.output
    pairs = [event for event in events(tmp_path / "out") if event["type"] == "pair"]
    assert [pair["t"] for pair in pairs] == [0.5, 0.75, 1.5]
    np.testing.assert_array_equal(np.load(tmp_path / "out" / pairs[1]["trus"]["frame"]), IMAGES[1][::-1, ::-1])


def test_a_header_as_plus_itself_writes_it(tmp_path: Path) -> None:
    # Fields of the file stand there twice where PLUS has read and written it again.
    head = """NRRD0004
# Complete NRRD file format specification at:
# http://teem.sourceforge.net/nrrd/format.html
# File generated by PLUS version 2.8.0
dimension: 3
encoding: raw
endian: little
kinds: domain domain list
sizes: 4 5 3                              \nspace dimension: 2
space directions: (1,0) (0,1) none
space origin: (0,0)
type: unsigned char
ultrasound image orientation: MF
ultrasound image orientation:=MF
ultrasound image type:=BRIGHTNESS
Seq_Frame0000_Timestamp:=8151.5
Seq_Frame0000_Status:=OK

"""
    path = tmp_path / "scan.nrrd"
    path.write_bytes(head.encode() + IMAGES.tobytes())
    sequence = read_nrrd_sequence(path)
    np.testing.assert_array_equal(sequence.images, IMAGES)
    assert sequence.frames[0] == {"Timestamp": "8151.5", "ImageStatus": "OK"}
    path.write_bytes(head.replace("orientation:=MF", "orientation:=UF").encode() + IMAGES.tobytes())
    with pytest.raises(InputError, match="orientation: found 'MF' and 'UF', expected one value"):
        read_nrrd_sequence(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"NRRD", b"NOPE", "found another file"),
        (b"sizes: 4 5 3", b"sizes: 4 x 3", "cannot be read"),
        (b"sizes: 4 5 3", b"sizes: 4 5 9", "cannot be read"),
        (b"sizes: 4 5 3", b"sizes: 4 5 2", "Seq_Frame0002_FrameNumber: found it, expected frames below 2"),
        (b"sizes: 4 5 3", b"sizes: 99999999 99999999 3", "found 29999999400000003 pixels"),
        (b"domain domain list", b"vector domain list", "of kinds vector domain list, expected two axes"),
        (b"sizes: 4 5 3", b"sizes: ", "kinds: found sizes"),
        (
            b"encoding: raw",
            b"encoding: raw\ndata file: ..",
            "data file: found '..', expected LOCAL, or a file beside it",
        ),
        (b"encoding: raw", b"encoding: hex", "encoding: found 'hex', expected raw, gzip or bzip2"),
        (b"encoding: raw", b"encoding: gzip", "compressed data that are damaged"),
        (b"encoding: raw", b"encoding: raw\nbyte skip: -1", "byte skip: found -1, expected 0"),
        (b"encoding: raw", b"encoding: raw\ndata file: ../x.raw", "data file: found '../x.raw'"),
        (b"type: uint8", b"type: block", "cannot be read"),
        (b"type: uint8", b"no colon", "cannot be read"),
    ],
)
def test_a_bad_nrrd_file_is_one_line_and_leaves_nothing(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    path = as_plus(tmp_path / "scan.nrrd", three())
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))
    assert message in refused(path, tmp_path / "s", "--setup", setup(tmp_path, log_db=60))
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["scan.nrrd", "setup.yaml"]
