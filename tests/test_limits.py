"""Files that unpack, nest, count or compute far beyond what is real: refused in one line, before the work is done."""

from __future__ import annotations

import importlib
import os
import resource
import sqlite3
import struct
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fgreg.convert.mapping import RecordingMapping
from fgreg.convert.plus import read_plus
from fgreg.convert.sequence_file import read_sequence
from fgreg.convert.table import read_table
from fgreg.convert.write import write_session
from fgreg.detection.frame_files import decode_picture
from fgreg.drivers.calibration_files import read_calibration
from fgreg.drivers.confined_parsers import is_storage, read_storage
from fgreg.drivers.ros_recordings import Recording
from fgreg.errors import InputError
from fgreg.live.config import read_config
from fgreg.pipeline import replay
from fgreg.pipeline.solve import SolveRequest, solve_session
from fgreg.schema import limits
from fgreg.session import event_reader
from fgreg.session.frame_files import check_camera_frame, check_trus_frame
from fgreg.session.session_reader import check_session
from tests import bags, live_configs, session_files

POSE = "1 0 0 0 0 1 0 0 0 0 1 100 0 0 0 1"
OPENCV = {
    "json": '{"M1": {"type_id": "opencv-matrix"}, "a": ' + "[" * 100_000 + "]" * 100_000 + "}",
    "yaml": "%YAML:1.0\n---\na: " + "[" * 100_000 + "]" * 100_000,
    "xml": '<?xml version="1.0"?>\n<opencv_storage>' + "<a>" * 100_000 + "</a>" * 100_000 + "</opencv_storage>",
}


@pytest.mark.parametrize("kind", OPENCV)
def test_opencv_files_that_end_its_parser_are_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(OPENCV[kind], encoding="utf-8")
    assert is_storage(path.read_bytes())
    with pytest.raises(InputError, match="something that OpenCV cannot read"):
        read_storage(path, path.name)


def test_deep_but_readable_opencv_files_are_judged_by_their_content(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text('{"M1": {"type_id": "opencv-matrix"}, "a": ' + "[" * 1000 + "]" * 1000 + "}", encoding="utf-8")
    with pytest.raises(InputError, match="no size of the images"):
        read_calibration([path])


def test_a_live_session_refuses_them_before_it_starts(tmp_path: Path) -> None:
    session, data = session_files.setup(), live_configs.config()
    del session["camera"]
    (tmp_path / "deep.yaml").write_text(OPENCV["yaml"], encoding="utf-8")
    data["calibration"] = {"left": "deep.yaml"}
    with pytest.raises(InputError, match=r"deep.yaml: found something that OpenCV cannot read \(its parser ended by"):
        read_config(live_configs.write(tmp_path, data, session))


def sequence(path: Path, head: str, pixels: bytes = b"") -> Path:
    path.write_bytes(f"ObjectType = Image\nElementType = MET_UCHAR\n{head}ElementDataFile = LOCAL\n".encode() + pixels)
    return path


def test_a_sequence_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    packed = zlib.compress(bytes(1 << 20))
    head = f"CompressedData = True\nDimSize = 1000 1000 {limits.SEQUENCE_BYTES // 1_000_000 + 1}\n"
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="DimSize: found 1074000000 bytes"):
            read_sequence(sequence(tmp_path / "a.mha", head, packed))
        with pytest.raises(InputError, match="found frame 9999998, expected numbers below 200000"):
            read_sequence(sequence(tmp_path / "b.mha", "DimSize = 0 0 0\nSeq_Frame009999998_Timestamp = 0\n"))
        assert tracemalloc.get_traced_memory()[1] < 10_000_000
    finally:
        tracemalloc.stop()


def test_numbers_beyond_any_pm_are_refused(tmp_path: Path) -> None:
    fields = (
        "Timestamp = 0",
        f"MarkerToCameraTransform = {POSE}",
        "StageAngle = 0",
        "FgregPm = 1e308",
        "FgregX = 0",
        "FgregRange = 30",
    )
    head = "DimSize = 1 1 1\n" + "".join(f"Seq_Frame0000_{field}\n" for field in fields)
    imported = read_plus(sequence(tmp_path / "a.mha", head, b"\0"), RecordingMapping())
    setup = session_files.write(tmp_path / "s")
    with pytest.raises(InputError, match=r"frame 0: pm: found 1e\+308, expected an integer from 0 to 2147483647"):
        write_session(imported, setup, tmp_path / "out")


def test_tables_are_bounded_in_columns_lines_and_names(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(",".join(f"c{i}" for i in range(limits.TABLE_COLUMNS + 1)) + "\n", encoding="utf-8")
    with pytest.raises(InputError, match="1001 columns, expected at most 1000"):
        read_table(path, RecordingMapping())
    path.write_text("t,type,text\n" + "0,note,x\n" * limits.EVENT_LINES, encoding="utf-8")
    with pytest.raises(InputError, match="200001 lines, expected at most 200000"):
        read_table(path, RecordingMapping())
    path.write_text(f"t,pm,scan_deg,camera_T_marker,frame\n0,1,0,{POSE},{'a' * 300}.npy\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"line 2: frame: found .*: no such file"):
        read_table(path, RecordingMapping())


def png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def test_a_picture_of_too_many_pixels_is_refused_by_its_header(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(png(100_000, 100_000))
    with pytest.raises(InputError, match="100000 x 100000 px, expected at most 33554432 px"):
        check_camera_frame(path, "a.png", "left", None)
    assert decode_picture(path.read_bytes(), "a.png") is None


def test_a_picture_of_which_the_decoder_says_that_it_is_damaged_is_none(capfd: pytest.CaptureFixture[str]) -> None:
    picture = np.random.default_rng(1).integers(0, 255, (100, 150, 3), dtype=np.uint8)
    data = cv2.imencode(".jpg", picture)[1].ravel()
    assert decode_picture(data.tobytes(), "a.jpg") is not None
    data[2000:2300] = 7
    assert cv2.imdecode(data, cv2.IMREAD_UNCHANGED) is not None
    capfd.readouterr()
    assert decode_picture(data.tobytes(), "a.jpg") is None
    assert "Corrupt JPEG data" in capfd.readouterr().err  # passed on; a command leads it nowhere


@pytest.mark.parametrize(
    ("head", "size", "found"),
    [
        (b"\x93NUMPY\x02\x00" + struct.pack("<I", 3_000_000_000), 3_100_000_000, "not an NPY array"),
        (b"\x93NUMPY\x01\x00" + struct.pack("<H", 60_000), 10**9, "not an NPY array"),
    ],
)
def test_headers_of_arrays_are_bounded(head: bytes, size: int, found: str, tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    path.write_bytes(head)
    os.truncate(path, size)  # a hole: takes no room on the disk
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=found):
            check_trus_frame(path, "a.npy", "frame", None)
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
    finally:
        tracemalloc.stop()


def test_a_large_array_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.zeros(2))
    data = path.read_bytes()[:-16].replace(b"(2,), }        ", b"(128, 400000), }")
    path.write_bytes(data)
    os.truncate(path, len(data) + 8 * 128 * 400_000)
    with pytest.raises(InputError, match=r"found 'a.npy' with .* bytes, expected at most 67108864"):
        check_trus_frame(path, "a.npy", "frame", None)


def test_problems_and_lines_of_a_session_are_bounded(tmp_path: Path) -> None:
    folder = session_files.write(tmp_path / "s")
    (folder / "events.jsonl").write_text("x\n" * 3000, encoding="utf-8")
    problems, _ = check_session(folder)
    assert len(problems) == limits.PROBLEMS + 1


def test_pairs_are_bounded_for_solve_and_replay_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = session_files.write(tmp_path / "s")
    session_files.write_frames(folder)
    pairs = sum(event["type"] == "pair" for event in session_files.events())
    monkeypatch.setattr(replay, "REPLAYED_PAIRS", pairs - 1)
    with pytest.raises(InputError, match=rf"events.jsonl: found {pairs} pairs, expected at most {pairs - 1}"):
        replay.replay_session(replay.ReplayRequest(folder))
    monkeypatch.setattr(event_reader, "PAIRS", pairs)
    assert not check_session(folder)[0]
    monkeypatch.setattr(event_reader, "PAIRS", pairs - 1)
    with pytest.raises(InputError, match=rf"events.jsonl: found more than {pairs - 1} pairs"):
        solve_session(SolveRequest(folder))


@pytest.mark.parametrize("compression", ["lz4", "zstd"])
def test_chunks_of_a_recording_are_unpacked_to_their_stated_size_at_most(
    compression: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage: Any = importlib.import_module("rosbags.rosbag2.storage_mcap")
    pack: Any = storage.zstd.compress if compression == "zstd" else importlib.import_module("lz4.frame").compress
    with Recording(bags.write_bag(tmp_path / "bag", [("/a", 0.0, bags.number(1.0))], mcap=True)) as recording:
        assert len(list(recording.messages(["/a"]))) == 1
    bomb = pack(bytes(50_000_000))
    with pytest.raises(storage.ReaderError, match="expected 1000 bytes, got 1001"):
        storage.decompress(bomb, compression, 1000, 0)
    monkeypatch.setattr("fgreg.drivers.ros_limits.CHUNK_BYTES", 10_000_000)
    with pytest.raises(ValueError, match="a chunk of 50000000 bytes, at most 10000000 are read"):
        storage.decompress(bomb, compression, 50_000_000, 0)


@pytest.mark.parametrize(
    "computed",
    [
        "VIEW messages AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) SELECT i FROM n",
        "TABLE messages(id INTEGER, data AS (zeroblob(1000000000)))",
    ],
)
def test_tables_of_a_recording_that_are_computed_are_refused(computed: str, tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    with sqlite3.connect(path) as base:
        base.execute(f"CREATE {computed}")
    base.close()
    with pytest.raises(InputError, match="tables that are computed"):
        Recording(path)


def test_memory_is_given_back(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    if not Path("/proc/self/statm").exists():
        pytest.skip("limits of memory are Linux's")
    with pytest.raises(MemoryError), limits.memory_at_most(100 << 20):
        np.ones(50_000_000)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
