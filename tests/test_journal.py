"""What is recorded is on disk, whole, and read back as it was; what cannot be recorded leaves no trace."""

from __future__ import annotations

import errno
import gzip
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgreg.errors import InputError, JournalError
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.model.events import (
    AimEvent,
    CameraMovedEvent,
    Event,
    ExcludeEvent,
    IncludeEvent,
    MarkerRecord,
    NoteEvent,
    OtherRecord,
    PairEvent,
    RefusedEvent,
    StageEvent,
    TrackEvent,
    TrusRecord,
)
from fgreg.session import append_only_file
from fgreg.session.event_writer import event_document, event_line, writable
from fgreg.session.journal import Journal
from fgreg.session.session_reader import read_session
from tests import session_files


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A session with nothing in it yet, and the frames that events may name."""
    session_files.write(tmp_path / "s", log="")
    session_files.write_frames(tmp_path / "s")
    return (tmp_path / "s").resolve()


def pose(rng: np.random.Generator) -> MarkerRecord:
    root = rng.normal(size=(6, 6)) * 0.01
    transform = make_transform(exp_so3(rng.normal(size=3)), rng.normal(size=3) * 100)
    return MarkerRecord(transform, root @ root.T + 1e-4 * np.eye(6))


def pair(rng: np.random.Generator, t: float, pm: int = 0) -> PairEvent:
    look = TrusRecord(
        rng.normal() * 20,
        rng.normal() * 9,
        20 + rng.random() * 20,
        covariance=np.diag(rng.random(2) + 0.01),
        amplitude=0.7,
        sweep=-1,
        others=(OtherRecord(1 / 3, 40.1, np.diag(rng.random(2) + 0.01)), OtherRecord(-2.0, 1 / 7)),
    )
    return PairEvent(t, 0, pm, pose(rng), look)


def every_kind(rng: np.random.Generator, folder: Path) -> list[Event]:
    frames = folder / "frames"
    both = MarkerRecord(left=frames / "a.png", right=frames / "b.png")
    heard, raw = pair(rng, 0.0).trus, TrusRecord(1 / 3, frame=frames / "c.npy", sweep=1)
    moved = pose(rng)
    return [
        NoteEvent(0.1, 0, "umlaut ä, line\nbreak, half a pair \ud800"),
        AimEvent(0.2, 0, pose(rng), rng.normal(size=3) * 100, np.diag(rng.random(3) + 0.1)),
        AimEvent(0.3, 0, both, corner=(8, 5)),
        pair(rng, 0.4, 3),
        PairEvent(0.4, 0, 4, replace(pose(rng), left=frames / "a.png"), raw),
        TrackEvent(0.5, 0, both, heard),
        TrackEvent(0.6, 0, pose(rng), several=(heard, raw, heard)),
        TrackEvent(0.7, 0, pose(rng), scan_deg=0.1),
        CameraMovedEvent(0.8, 0),
        CameraMovedEvent(0.9, 0, moved.camera_T_marker, moved.covariance),
        CameraMovedEvent(1.0, 0, detected=True, since_t=0.85),
        RefusedEvent(1.0, 0, {"type": "pair", "line": 4}, "no place"),
        RefusedEvent(1.0, 0, {"type": "pair", "t": 0.2}, "earlier than the last"),
        StageEvent(1.1, 0, "turn", -0.1, "track"),
        StageEvent(1.1, 0, "home"),
        ExcludeEvent(1.2, 0, 3, reason="bumped", by="A. N."),
        ExcludeEvent(1.2, 0, shot_line=2),
        IncludeEvent(1.3, 0, 3),
    ]


def test_every_kind_of_event_is_read_back_bit_by_bit(folder: Path) -> None:
    with Journal.open(folder) as journal:
        kept = [journal.append(event).event for event in every_kind(np.random.default_rng(1), folder)]
    read = read_session(folder).events
    assert [event.line for event in read] == list(range(1, 19))
    assert [type(event) for event in read] == [type(event) for event in kept]
    for before, after in zip(kept, read, strict=True):
        assert event_line(event_document(before, folder), "") == event_line(event_document(after, folder), "")


def test_events_without_effect_on_the_estimate_are_not_kept_in_memory(folder: Path) -> None:
    rng = np.random.default_rng(7)
    given: list[Event] = [
        pair(rng, 1.0),
        StageEvent(1.1, 0, "home"),
        TrackEvent(1.2, 0, pose(rng), scan_deg=0.1),
        NoteEvent(1.3, 0, "here"),
    ]
    with Journal.open(folder) as journal:
        for event in given:
            journal.append(event)
        kept = journal.events
    with Journal.open(folder) as journal:
        for events in (kept, journal.events):
            assert [(type(event), event.line) for event in events] == [(PairEvent, 1), (NoteEvent, 4)]


def test_the_file_holds_the_very_doubles_that_were_given(folder: Path) -> None:
    event = pair(np.random.default_rng(2), 1 / 3)
    with Journal.open(folder) as journal:
        journal.append(event)
    line = json.loads((folder / "events.jsonl").read_text())
    assert event.marker.camera_T_marker is not None
    assert np.array(line["marker"]["camera_T_marker"]).tobytes() == event.marker.camera_T_marker.tobytes()
    assert np.array(line["marker"]["covariance"]).tobytes() == np.asarray(event.marker.covariance).tobytes()
    assert (line["t"], line["trus"]["x_mm"]) == (event.t, event.trus.x_mm)


def test_offsets_are_where_lines_start(folder: Path) -> None:
    with Journal.open(folder) as journal:
        offsets = [journal.append(NoteEvent(0.0, 0, "x" * n)).offset for n in (1, 50, 3)]
    data = (folder / "events.jsonl").read_bytes()
    assert offsets == [0, *(i + 1 for i, byte in enumerate(data[:-1]) if byte == ord("\n"))]


def test_events_file_is_made_where_there_is_none(folder: Path) -> None:
    (folder / "events.jsonl").unlink()
    with Journal.open(folder) as journal:
        assert (journal.lines, journal.last_t) == (0, None)
        journal.append(NoteEvent(1.0, 0, "first"))
    assert len(read_session(folder).events) == 1


BAD: list[tuple[str, Callable[[PairEvent], Event]]] = [
    ("at least 5", lambda event: replace(event, t=4.0)),
    ("trus.x_mm: found nan", lambda event: replace(event, trus=replace(event.trus, x_mm=math.nan))),
    ("t: found inf", lambda event: replace(event, t=math.inf)),
    ("trus.range_mm", lambda event: replace(event, trus=replace(event.trus, range_mm=-1.0))),
    ("pm", lambda event: replace(event, pm=-1)),
    ("not rigid", lambda event: replace(event, marker=MarkerRecord(np.diag([1.0, 2.0, 1.0, 1.0])))),
    ("covariance", lambda event: replace(event, marker=replace(event.marker, covariance=-np.eye(6)))),
    ("outside|inside", lambda event: replace(event, marker=MarkerRecord(left=Path("/etc/passwd")))),
    ("no such file", lambda event: replace(event, marker=MarkerRecord(left=Path("frames/none.png")))),
    ("at most 1000000", lambda _event: NoteEvent(6.0, 0, "x" * 1_000_001)),
    ("an earlier line", lambda _event: RefusedEvent(6.0, 0, {"line": 2}, "itself")),
]


@pytest.mark.parametrize(("message", "spoil"), BAD, ids=[message for message, _ in BAD])
def test_what_the_reader_would_not_take_is_refused_before_it_is_written(
    message: str, spoil: Callable[[PairEvent], Event], folder: Path
) -> None:
    good = pair(np.random.default_rng(3), 5.0)
    with Journal.open(folder) as journal:
        journal.append(good)
        before = (folder / "events.jsonl").read_bytes()
        with pytest.raises(InputError, match=message) as caught:
            journal.append(spoil(good))
        assert str(caught.value).isprintable()
        assert (folder / "events.jsonl").read_bytes() == before
        journal.append(replace(good, t=6.0))
    assert len(read_session(folder).events) == 2


def test_a_line_cut_short_anywhere_is_dropped_with_a_warning_and_recording_goes_on(folder: Path) -> None:
    rng = np.random.default_rng(4)
    with Journal.open(folder) as journal:
        for i in range(2):
            journal.append(pair(rng, float(i)))
    path = folder / "events.jsonl"
    whole = path.read_bytes()
    first = whole.index(b"\n") + 1
    for cut in [*range(first + 1, len(whole) - 1, 37), len(whole) - 2]:
        path.write_bytes(whole[:cut])
        with Journal.open(folder) as journal:
            assert len(journal.events) == 1
            assert any("cut short" in warning for warning in journal.warnings)
            journal.append(NoteEvent(0.5, 0, "on"))
        assert path.read_bytes().startswith(whole[:first])
        assert [event.line for event in read_session(folder).events] == [1, 2]


def test_a_last_line_that_lacks_only_its_break_is_kept(folder: Path) -> None:
    path = folder / "events.jsonl"
    path.write_text('{"type": "note", "t": 1, "text": "by hand"}')
    with Journal.open(folder) as journal:
        assert journal.lines == 1
        assert not any("cut short" in warning for warning in journal.warnings)
        journal.append(NoteEvent(2.0, 0, "more"))
    assert len(read_session(folder).events) == 2


@pytest.mark.parametrize("tail", ["", "{", '{"type": "note", "t": 2, "text": "x"}'])
def test_a_bad_line_before_the_last_is_an_error_and_nothing_is_changed(tail: str, folder: Path) -> None:
    path = folder / "events.jsonl"
    path.write_text('{"type": "note", "t": 1, "text": 5}\n' + tail)
    before = path.read_bytes()
    with pytest.raises(InputError, match="line 1"):
        Journal.open(folder)
    assert path.read_bytes().startswith(before[: before.index(b"\n") + 1])
    path.write_text("")
    Journal.open(folder).close()  # no lock is left behind


def test_one_recorder_at_a_time_also_across_processes(folder: Path) -> None:
    script = "import sys\nfrom pathlib import Path\nfrom fgreg.session.journal import Journal\n"
    script += "try:\n    Journal.open(Path(sys.argv[1]))\nexcept Exception as error:\n    print(error)\n"
    with Journal.open(folder) as journal:
        with pytest.raises(JournalError, match="another program is recording"):
            Journal.open(folder)
        other = subprocess.run([sys.executable, "-c", script, folder], capture_output=True, text=True, check=True)
        assert "another program is recording" in other.stdout
        journal.append(NoteEvent(1.0, 0, "still here"))
    Journal.open(folder).close()


def failing(name: str, code: int, monkeypatch: pytest.MonkeyPatch, *, written: int | None = None) -> None:
    """Makes one of the system calls fail; of a write, ``written`` bytes go out before it does."""
    real = getattr(append_only_file, name)

    def fail(handle: int, *rest: Any) -> int:
        if written is not None:
            real(handle, rest[0][:written])
            if code == 0:
                return written
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(append_only_file, name, fail)


FAULTS = [
    ("_write", errno.ENOSPC, None),
    ("_write", errno.EROFS, None),
    ("_write", errno.EIO, 40),
    ("_write", 0, 17),  # a short write without an error
    ("_sync", errno.EIO, None),
    ("_sync", errno.ENOSPC, None),
]


@pytest.mark.parametrize(("call", "code", "written"), FAULTS)
@pytest.mark.parametrize("truncate_fails", [False, True])
def test_a_failing_disk_is_reported_leaves_no_damaged_line_and_is_cleared_when_it_works_again(
    call: str, code: int, written: int | None, truncate_fails: bool, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, path = np.random.default_rng(5), folder / "events.jsonl"
    with Journal.open(folder) as journal:
        journal.append(pair(rng, 1.0))
        whole = path.read_bytes()
        lost = pair(rng, 2.0)
        with monkeypatch.context() as broken:
            failing(call, code, broken, written=written)
            if truncate_fails:
                failing("_truncate", code or errno.EIO, broken)
            for _ in range(2):
                with pytest.raises(JournalError, match=r"events\.jsonl: ") as caught:
                    journal.append(lost)
                assert str(caught.value).isprintable()
        if not truncate_fails:
            assert path.read_bytes() == whole
        journal.append(lost)
    assert path.read_bytes().startswith(whole)
    assert [event.t for event in read_session(folder).events] == [1.0, 2.0]


def _replace(path: Path) -> None:
    other = path.with_name("other")
    other.write_bytes(path.read_bytes())
    other.replace(path)


TAMPERING: list[tuple[str, Callable[[Path], object]]] = [
    ("removed or replaced", _replace),
    ("removed or replaced", lambda path: path.unlink()),
    ("removed or replaced", lambda path: path.parent.rename(path.parent.with_name("elsewhere"))),
    ("was changed", lambda path: os.truncate(path, 10)),
    ("was changed", lambda path: os.truncate(path, 100_000)),
]


@pytest.mark.parametrize(("message", "tamper"), TAMPERING)
def test_a_file_that_others_change_is_reported_and_left_alone(
    message: str, tamper: Callable[[Path], object], folder: Path
) -> None:
    path = folder / "events.jsonl"
    with Journal.open(folder) as journal:
        journal.append(pair(np.random.default_rng(6), 1.0))
        tamper(path)
        before = path.read_bytes() if path.exists() else None
        for _ in range(2):
            with pytest.raises(JournalError, match=message):
                journal.append(NoteEvent(2.0, 0, "lost?"))
        assert (path.read_bytes() if path.exists() else None) == before


def test_a_file_that_is_moved_away_and_back_is_written_to_again(folder: Path) -> None:
    path, away = folder / "events.jsonl", folder / "away"
    with Journal.open(folder) as journal:
        path.rename(away)
        with pytest.raises(JournalError, match="removed or replaced"):
            journal.append(NoteEvent(2.0, 0, "again"))
        away.rename(path)
        journal.append(NoteEvent(2.0, 0, "again"))
    assert len(read_session(folder).events) == 1


def test_frames_are_on_disk_before_the_event_that_names_them(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    real_sync, real_write = append_only_file.sync_path, append_only_file._write

    def sync(path: Path) -> None:
        done.append(f"sync {path.name}")
        real_sync(path)

    def write(handle: int, data: bytes) -> int:
        done.append("event")
        return real_write(handle, data)

    monkeypatch.setattr("fgreg.session.journal.sync_path", sync)
    monkeypatch.setattr(append_only_file, "_write", write)
    with Journal.open(folder) as journal:
        left, right = (folder / "frames" / name for name in ("a.png", "b.png"))
        journal.append(AimEvent(1.0, 0, MarkerRecord(left=left, right=right), corner=(0, 0)))
    assert done == ["sync a.png", "sync b.png", "sync frames", "event"]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 kB in memory."""
    mount = tmp_path / "small"
    mount.mkdir()
    done = None
    if os.geteuid() == 0 and sys.platform == "linux":
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", mount], capture_output=True, check=False
        )
    if done is None or done.returncode != 0:
        pytest.skip("mounting a small file system needs root on Linux")
    yield mount
    subprocess.run(["umount", "-l", mount], check=True)


def test_a_disk_that_is_full_or_turns_read_only_for_real(small_disk: Path) -> None:
    folder, rng = session_files.write(small_disk / "s", log=""), np.random.default_rng(7)
    path = folder / "events.jsonl"
    with Journal.open(folder) as journal:
        (small_disk / "ballast").write_bytes(b"x" * 20_000)
        kept = 0

        def fill() -> None:
            nonlocal kept
            for kept in range(200):
                journal.append(pair(rng, float(kept)))

        with pytest.raises(JournalError, match=r"No space left|bytes were written"):
            fill()
        assert kept > 5
        assert path.read_bytes().count(b"\n") == kept
        assert path.read_bytes().endswith(b"\n")
        (small_disk / "ballast").unlink()
        journal.append(pair(rng, 500.0))
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    with pytest.raises(JournalError, match="Read-only file system"):
        Journal.open(folder)
    subprocess.run(["mount", "-o", "remount,rw", small_disk], check=True)
    assert [event.t for event in read_session(folder).events] == [*map(float, range(kept)), 500.0]


def test_what_json_does_not_have_is_a_text_in_the_record_of_a_refusal(folder: Path) -> None:
    spoilt = replace(pair(np.random.default_rng(8), 1.0), t=math.nan)
    document = writable(event_document(spoilt, folder))
    with Journal.open(folder) as journal:
        journal.append(RefusedEvent(1.0, 0, document, "t is not a number"))
    event = read_session(folder).events[0]
    assert isinstance(event, RefusedEvent)
    assert isinstance(event.event, dict)
    assert event.event["t"] == "nan"


WHOLE = '{"type": "note", "t": 1, "text": "a"}\n{"type": "note", "t": 2, "text": "b"}\n'
REFUSED: list[tuple[str, bytes, str]] = [
    ("CR", WHOLE.replace("\n", "\r").encode(), "line 1: found line breaks by CR alone"),
    ("CR, not ended", WHOLE.replace("\n", "\r").encode()[:-20], "line 1: found line breaks by CR alone"),
    ("gzip", gzip.compress(WHOLE.encode(), mtime=0), "line 1: found gzip data"),
    ("UTF-16", WHOLE.encode("utf-16"), "line 1: found UTF-16"),
    ("UTF-16 without mark, one line", WHOLE.split("\n")[0].encode("utf-16-le"), "line 1: found UTF-16"),
    ("Latin-1", WHOLE.replace("b", "ä").encode("latin-1")[:-1], "line 2: found bytes that are not UTF-8"),
    ("an array", b'[{"type": "note", "t": 1', "line 1: found bad JSON"),
    ("other quotes", WHOLE.encode() + b"{'type': 'note'", "line 3: found bad JSON"),
    ("more after the object", WHOLE.encode() + b'{"type": "note"} {"ty', "line 3: found bad JSON"),
    ("a text", WHOLE.encode() + b"to be continued", "line 3: found bad JSON"),
    ("a long line", WHOLE.encode() + b'{"type": "note", "text": "' + b"x" * 1_000_000, "line 3: found a longer line"),
    ("a bad line before", b'{"type": "note", "t": 1}\n{"type": "no', "line 1: "),
]


@pytest.mark.parametrize(("content", "found"), [case[1:] for case in REFUSED], ids=[case[0] for case in REFUSED])
def test_what_is_no_beginning_of_a_line_is_refused_by_solve_and_recorder_alike_and_kept(
    content: bytes, found: str, folder: Path
) -> None:
    path = folder / "events.jsonl"
    path.write_bytes(content)
    said = []
    for opened in (Journal.open, read_session):
        with pytest.raises(InputError) as caught:
            opened(folder)
        said.append(str(caught.value))
        assert path.read_bytes() == content
    assert said[0] == said[1]
    assert found in said[0]
    assert [entry.name for entry in folder.glob("events*")] == ["events.jsonl"]


@pytest.mark.parametrize(
    "tail",
    ['{"type": "note", "text": "é'.encode()[:-1], b'{"a": [1, {"b": "\\', b'{"t": 1e', b'{"type"\0\0\0', b"\0" * 9],
)
def test_what_is_cut_off_is_kept_in_a_file_of_its_own_that_is_named(tail: bytes, folder: Path) -> None:
    path = folder / "events.jsonl"
    for name in ("events.jsonl.cut", "events.jsonl.cut-2"):
        path.write_bytes(WHOLE.encode() + tail)
        assert len(read_session(folder).events) == 2
        with Journal.open(folder) as journal:
            (warning,) = (text for text in journal.warnings if "cut short" in text)
            assert warning.endswith(f"its {len(tail)} bytes are kept in {name}")
            journal.append(NoteEvent(3.0, 0, "on"))
        assert (folder / name).read_bytes() == tail
        assert path.read_bytes().startswith(WHOLE.encode())
        assert len(read_session(folder).events) == 3


def test_nothing_is_cut_off_that_cannot_be_kept(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder / "events.jsonl"
    path.write_bytes(before := WHOLE.encode() + b'{"type": "no')

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="No space left"):
        Journal.open(folder)
    assert path.read_bytes() == before
    assert [entry.name for entry in folder.glob("*events*")] == ["events.jsonl"]
