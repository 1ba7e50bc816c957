"""Opened again from its checkpoint a session goes on as if never closed; one that does not fit is left aside."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgreg.config import SolveConfig
from fgreg.detection.marker import detect_marker
from fgreg.errors import JournalError
from fgreg.estimate import Verdict
from fgreg.events import AimEvent, CameraMovedEvent, PairEvent
from fgreg.live import LiveSession
from fgreg.measurements import Pair
from fgreg.online import OnlineEstimate, OnlineEvent, OnlineRegistration
from fgreg.online.numbers import Numbers, Sink, Source
from fgreg.recognition import recognise
from fgreg.session.checkpoint_file import CHECKPOINT_FILE, Checkpoint, read_checkpoint, write_checkpoint
from fgreg.session.event_document import event_document, event_line
from fgreg.session.reading import check_session, read_session
from tests.forward import make_measurements
from tests.online_streams import events as stream_of

Shots = list[AimEvent | PairEvent | CameraMovedEvent]


def same(a: OnlineEstimate | None, b: OnlineEstimate | None) -> None:
    assert a is not None
    assert b is not None
    assert (a.epoch, a.pairs, a.verdict, a.used) == (b.epoch, b.pairs, b.verdict, b.used)
    for x, y in ((a.trus_T_camera, b.trus_T_camera), (a.covariance, b.covariance)):
        assert (x is None) == (y is None)
        if x is not None and y is not None:
            np.testing.assert_allclose(x, y, rtol=0, atol=1e-6)


def as_junk(pair: Pair, rng: np.random.Generator) -> Pair:
    look = pair.look
    return replace(pair, look=replace(look, range_mm=look.range_mm + 8.0 + rng.exponential(8.0), x_mm=look.x_mm + 9.0))


def stream(seed: int, junk: float, pairs: int) -> tuple[OnlineRegistration, OnlineRegistration, list[OnlineEvent]]:
    """Two engines, and events for both: two epochs, aims in between, some PMs looked at again."""
    rng = np.random.default_rng(seed)
    model, measurements, _ = make_measurements(rng, aims=14, pairs=pairs, epochs=2, known_motion=True)
    found: list[OnlineEvent] = []
    late = list(measurements.aims[10:])
    count = 0
    for event in stream_of(replace(measurements, aims=measurements.aims[:10])):
        if isinstance(event, Pair):
            count += 1
            if rng.uniform() < junk:
                event = as_junk(event, rng)
            if count % 30 == 0 and late:
                found.append(replace(late.pop(), t=event.t))
        found.append(event)
    return OnlineRegistration(model, judge=None), OnlineRegistration(model, judge=None), found


@pytest.mark.parametrize(("junk", "pairs"), [(0.0, 160), (0.2, 60)], ids=["clean", "a fifth junk"])
def test_an_engine_taken_up_at_its_rests_goes_on_as_one_that_never_stopped(junk: float, pairs: int) -> None:
    unbroken, engine, events = stream(3, junk, pairs)
    rests = 0
    for event in events:
        expected, found = unbroken.add(event), engine.add(event)
        if not expected.verdict == found.verdict == Verdict.REFUSED:  # among tied minima the last digit chooses
            same(found, expected)
        write = engine.rest()
        if write is None:
            continue
        rests += 1
        sink = Sink()
        write(sink)
        model = engine._model
        engine = OnlineRegistration(model, judge=None)
        same(engine.resume(Source(sink.numbers())), expected)
        assert engine.kept == unbroken.kept
        for a, b in zip(engine.measurements().pairs, unbroken.measurements().pairs, strict=True):
            assert a.marker.camera_T_marker.tobytes() == b.marker.camera_T_marker.tobytes()
            assert (a.t, a.pm, a.epoch, a.marker.id, a.look.x_mm) == (b.t, b.pm, b.epoch, b.marker.id, b.look.x_mm)
    assert rests >= 3
    assert engine.kept == unbroken.kept


def test_the_judgement_and_the_surface_are_taken_up_too() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(4), aims=10, pairs=22)
    engine, sink = OnlineRegistration(model), Sink()
    for event in stream_of(measurements):
        estimate = engine.add(event)
        if (write := engine.rest()) is not None:
            sink, expected, snapshot = Sink(), estimate, engine.snapshot()
            write(sink)
    again = OnlineRegistration(model)
    found = again.resume(Source(sink.numbers()))
    assert (found.reasons, found.settled, found.predicted_tre) == (
        expected.reasons,
        expected.settled,
        expected.predicted_tre,
    )
    assert again.snapshot().surface is not None
    assert snapshot.surface is not None


# --- sessions -------------------------------------------------------------------------------------------------------


def emptied(session: Path) -> tuple[Path, Shots]:
    found = read_session(session).events
    (session / "events.jsonl").unlink()
    return session, [e for e in found if isinstance(e, AimEvent | PairEvent | CameraMovedEvent)]


def recorded(
    session: Path, count: int | None = None
) -> tuple[Path, OnlineEstimate, list[AimEvent | PairEvent | CameraMovedEvent]]:
    """A session that was recorded with a checkpoint; its estimate, and the events that are left."""
    folder, events = emptied(session)
    with LiveSession.open(folder) as live:
        for event in events[:count]:
            live.add(event)
        estimate = live.estimate
    assert (folder / CHECKPOINT_FILE).is_file()
    assert estimate is not None
    return folder, estimate, [] if count is None else events[count:]


def test_a_session_closed_again_and_again_is_as_one_that_was_never_closed(pose_session: Path, tmp_path: Path) -> None:
    unbroken = Path(shutil.copytree(pose_session, tmp_path / "unbroken"))
    _, estimate, _ = recorded(unbroken)
    folder, events = emptied(pose_session)
    for start in range(0, len(events), 11):
        with LiveSession.open(folder) as live:
            assert live.checkpoints.note in ("", "the checkpoint was not used: there is none")
            for event in events[start : start + 11]:
                live.add(event)
            last = live.estimate
    same(last, estimate)
    with LiveSession.open(folder) as live:
        same(live.estimate, estimate)
    assert check_session(folder) == ([], [])
    assert (folder / "events.jsonl").read_bytes() == (unbroken / "events.jsonl").read_bytes()


def test_a_copy_without_the_checkpoint_is_the_same_session(pose_session: Path) -> None:
    folder, estimate, _ = recorded(pose_session)
    (folder / CHECKPOINT_FILE).unlink()
    with LiveSession.open(folder) as live:
        same(live.estimate, estimate)
    with LiveSession.open(folder) as live:  # that one left a checkpoint
        assert not live.checkpoints.note
        same(live.estimate, estimate)


def test_raw_frames_are_not_looked_at_again(raw_session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, estimate, left = recorded(raw_session, 13)
    with monkeypatch.context() as patch:
        looked: list[object] = []

        def detect(*arguments: Any) -> object:
            looked.append(arguments)
            return detect_marker(*arguments)

        patch.setattr("fgreg.recognition.detect_marker", detect)
        with LiveSession.open(folder) as live:
            assert not live.checkpoints.note
            same(live.estimate, estimate)
            assert len(looked) < 7
            for event in left:
                live.add(event)
            last, found = live.estimate, live.measurements()
    (folder / CHECKPOINT_FILE).unlink()
    with LiveSession.open(folder) as live:
        same(live.estimate, last)
        for a, b in zip(live.measurements().pairs, found.pairs, strict=True):
            assert a.marker.covariance.tobytes() == b.marker.covariance.tobytes()


@pytest.fixture(scope="module")
def at_eighteen(_pose_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session recorded up to its 18th event, with its checkpoint."""
    folder = tmp_path_factory.mktemp("recorded") / "poses"
    return recorded(Path(shutil.copytree(_pose_session, folder)), 18)[0]


def damage(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


def other_events(folder: Path) -> None:
    """The first pair's range is another one."""
    path = folder / "events.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    events = read_session(folder).events
    place, pair = next((i, e) for i, e in enumerate(events) if isinstance(e, PairEvent))
    assert pair.trus.range_mm is not None
    moved = replace(pair, trus=replace(pair.trus, range_mm=pair.trus.range_mm + 0.01))
    lines[place] = event_line(event_document(moved, folder.resolve()), "")
    path.write_bytes(b"".join(lines))


def refused_since(folder: Path) -> None:
    """Somebody refuses the first event by hand."""
    path = folder / "events.jsonl"
    t = read_session(folder).events[-1].t
    with path.open("ab") as file:
        file.write(b'{"type": "refused", "t": %a, "event": {"line": 1}, "reason": "by hand"}\n' % t)


def in_place(change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        path = folder / CHECKPOINT_FILE
        path.write_bytes(change(path.read_bytes()))

    return apply


def fifo(folder: Path) -> None:
    (folder / CHECKPOINT_FILE).unlink()
    os.mkfifo(folder / CHECKPOINT_FILE)


def link(folder: Path) -> None:
    path = folder / CHECKPOINT_FILE
    path.rename(folder / "elsewhere")
    path.symlink_to(folder / "elsewhere")


def longer_setup(folder: Path) -> None:
    with (folder / "session.yaml").open("a") as file:
        file.write("# a remark\n")


@pytest.mark.parametrize(
    ("break_it", "said"),
    [
        (in_place(lambda data: damage(data, len(data) - 5)), "damaged"),
        (in_place(lambda data: damage(data, 200)), "damaged"),
        (in_place(lambda data: data[: len(data) // 2]), "damaged"),
        (in_place(lambda _: b""), "another format"),
        (in_place(lambda data: data.replace(b"checkpoint/1", b"checkpoint/9")), "another format"),
        (in_place(lambda data: data + bytes(2**23)), "no file of a checkpoint's size"),
        (other_events, "other events"),
        (longer_setup, "another session.yaml"),
        (refused_since, "refused since"),
        (fifo, "no file"),
        (link, "cannot be read"),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_left_aside(
    at_eighteen: Path, tmp_path: Path, break_it: Callable[[Path], None], said: str
) -> None:
    folder = Path(shutil.copytree(at_eighteen, tmp_path / "session"))
    with LiveSession.open(folder) as live:
        assert not live.checkpoints.note
    break_it(folder)
    session = read_session(folder)
    expected = recognise(session.events, session.model).measurements
    with LiveSession.open(folder) as live:
        assert said in live.checkpoints.note
        found = live.measurements()
        assert live.estimate is not None
        assert live.estimate.trus_T_camera is not None
    assert [aim.t for aim in found.aims] == [aim.t for aim in expected.aims]
    assert [(p.t, p.look.range_mm) for p in found.pairs] == [(p.t, p.look.range_mm) for p in expected.pairs]


def test_a_checkpoint_of_other_settings_is_left_aside(at_eighteen: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(at_eighteen, tmp_path / "session"))
    with LiveSession.open(folder, SolveConfig(limit_mm=2.0)) as live:
        assert "another program" in live.checkpoints.note
        assert live.estimate is not None


def test_numbers_that_cannot_be_are_left_aside_whatever_they_are(at_eighteen: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(at_eighteen, tmp_path / "session"))
    with LiveSession.open(folder) as live:
        estimate = live.estimate
    path = folder / CHECKPOINT_FILE
    whole = read_checkpoint(path, 10_000)
    rng = np.random.default_rng(1)
    aside = 0
    for _ in range(8):
        integers, floats = whole.integers.copy(), whole.floats.copy()
        kind = rng.integers(4)
        if kind == 0:
            integers[rng.integers(len(integers))] = rng.choice([-1, 2, 10**9, -(2**63), 2**63 - 1])
        elif kind == 1:
            floats[rng.integers(len(floats))] = rng.choice([np.nan, np.inf, 1e300])
        elif kind == 2:
            floats = floats[: rng.integers(len(floats))]
        else:
            integers = np.append(integers, 0)
        write_checkpoint(path, Checkpoint(whole.of, integers, floats, whole.texts))
        with LiveSession.open(folder) as live:  # whatever it makes of them: a session, not a crash
            assert live.estimate is not None
            if live.checkpoints.note:
                aside += 1
                same(live.estimate, estimate)
    assert aside >= 4


def test_a_source_is_used_up_to_the_last_number_and_no_further() -> None:
    sink = Sink()
    sink.integers(1, 7)
    sink.floats(0.5)
    source = Source(sink.numbers())
    assert source.flag()
    with pytest.raises(ValueError, match="7, expected 0 to 6"):
        source.integer(0, 6)
    with pytest.raises(ValueError, match="too many"):
        source.finish()
    assert source.number() == 0.5
    for method in (source.number, source.text, source.flag):
        with pytest.raises(ValueError, match="too few"):
            method()
    with pytest.raises(ValueError, match="not finite"):
        Source(Numbers(np.zeros(0, dtype=np.int64), np.array([np.nan]), ()))


def test_a_disk_that_takes_no_checkpoint_takes_events(pose_session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    folder, events = emptied(pose_session)
    monkeypatch.setattr("fgreg.session.checkpoint_file.os.fsync", refuse)
    monkeypatch.setattr("fgreg.session.append_file._sync", lambda _: None)
    with LiveSession.open(folder) as live:
        for event in events[:18]:
            live.add(event)
        live.checkpoints.close()
        assert "No space left" in live.checkpoints.trouble
        estimate = live.estimate
    assert sorted(path.name for path in folder.iterdir() if path.name.startswith(".")) == []
    monkeypatch.undo()
    with LiveSession.open(folder) as live:
        same(live.estimate, estimate)


def test_a_checkpoint_is_only_for_who_holds_the_session(at_eighteen: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(at_eighteen, tmp_path / "session"))
    before = (folder / CHECKPOINT_FILE).read_bytes()
    with LiveSession.open(folder), pytest.raises(JournalError, match="another program is recording"):
        LiveSession.open(folder)
    assert (folder / CHECKPOINT_FILE).read_bytes() == before
