"""The snapshot in shared memory: always complete, also if the writer fails, and no memory left behind."""

from __future__ import annotations

import contextlib
import multiprocessing.shared_memory
import os
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgreg.model.estimate import Verdict
from fgreg.model.measurements import MarkerObservation, Track
from fgreg.online.shared_snapshot import NoSnapshotError, SharedSnapshot, SnapshotReader
from fgreg.online.snapshot_record import EPOCHS_KEPT, Layout
from fgreg.tracking.query import track
from fgreg.tracking.snapshot import SHARED, EpochSnapshot
from tests.forward import make_measurements, make_session
from tests.test_track_surface import some_surface
from tests.track_cases import held_out, is_whole, marked_snapshot, plain_snapshot, query_of, solved

MODEL = make_session(curve=True)
WRITER = """
from tests.test_shared_snapshot import hammer
hammer()
"""


def hammer() -> None:
    """Publish marked snapshots without a pause; for a process of its own."""
    base = plain_snapshot(MODEL, some_surface(1, 12))
    with SharedSnapshot(Layout.of(MODEL)) as shared:
        shared.publish(marked_snapshot(base, 1))
        sys.stdout.write(f"{shared.name}\n")
        sys.stdout.flush()
        for version in range(2, 1_000_000):
            shared.publish(marked_snapshot(base, version))


@contextlib.contextmanager
def _writer() -> Iterator[tuple[subprocess.Popen[str], str]]:
    command = [sys.executable, "-c", WRITER]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def _gone(name: str) -> bool:
    try:
        SnapshotReader(name).close()
    except FileNotFoundError:
        return True
    return False


def _wait_until_gone(name: str) -> bool:
    end = time.monotonic() + 10.0
    while time.monotonic() < end:
        if _gone(name):
            return True
        time.sleep(0.05)
    return False


def test_no_reader_ever_sees_a_torn_snapshot() -> None:
    with _writer() as (_, name):
        found: list[tuple[int, int, bool]] = []

        def watch() -> None:
            reader, last, seen, whole = SnapshotReader(name), 0, 0, True
            end = time.monotonic() + 2.0
            while time.monotonic() < end:
                received = reader.read()
                whole = whole and is_whole(received.snapshot) and received.snapshot.pairs == received.version
                whole = whole and received.version >= last
                seen += received.version > last
                last = received.version
            found.append((seen, last, whole))

        threads = [threading.Thread(target=watch) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert len(found) == 2
    assert all(whole for _, _, whole in found)
    assert all(seen > 10 for seen, _, _ in found)  # a few a time slice where cores are scarce


def test_a_killed_writer_leaves_the_last_snapshot_with_its_age_and_no_memory() -> None:
    for delay in (0.05, 0.013, 0.037):
        with _writer() as (process, name):
            reader = SnapshotReader(name)
            late = SnapshotReader(name)  # has not read anything yet when the writer dies
            reader.read()
            time.sleep(delay)
            process.send_signal(signal.SIGKILL)
            process.wait()
            first = reader.read()
            time.sleep(0.05)
            second = reader.read()
            assert is_whole(second.snapshot)
            assert second.version == first.version == late.read().version
            assert second.age_s >= first.age_s + 0.05
            assert second.silent_s >= 0.05
            assert not second.closed
            assert _wait_until_gone(name)
            assert reader.clone().read().version == first.version  # the mapping outlives the name


@pytest.mark.parametrize("latest_moved", [False, True])
@pytest.mark.parametrize("ended", [False, True])
def test_a_version_written_by_half_is_not_taken(latest_moved: bool, ended: bool) -> None:
    base = plain_snapshot(MODEL, some_surface(1, 12))
    with SharedSnapshot(Layout.of(MODEL)) as shared:
        shared.publish(marked_snapshot(base, 1))
        reader, fresh = SnapshotReader(shared.name), SnapshotReader(shared.name)
        assert reader.snapshot().pairs == 1
        assert shared._slots is not None
        assert shared._header is not None
        slot = shared._slots[2]
        slot[:] = shared._slots[1]
        slot[len(slot) // 2 :] = 7
        slot[0] = 2
        slot[1] = 2 if ended else 1
        if latest_moved:  # as stores may become visible out of order
            shared._header[5] = 2
        assert reader.snapshot().pairs == 1
        if not latest_moved:
            assert fresh.snapshot().pairs == 1
        shared.publish(marked_snapshot(base, 2))
        assert reader.snapshot().pairs == 2
        assert is_whole(reader.snapshot())


def test_answers_from_shared_memory_are_the_same() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(1), pairs=22)
    used, out = held_out(measurements, 2)
    snapshot = replace(solved(used, model).snapshot, t=12.5, pairs=20)
    refused = replace(snapshot.epochs[0], number=3, verdict=Verdict.REFUSED, reason="too few pairs")
    snapshot = replace(snapshot, epochs=(*snapshot.epochs, refused))
    assert snapshot.surface is not None
    with SharedSnapshot(Layout.of(model)) as shared:
        shared.publish(snapshot)
        received = SnapshotReader(shared.name).snapshot()
    assert (received.t, received.pairs) == (12.5, 20)
    for pairs in out:
        for looks in (0, 1):
            query = query_of(pairs, looks=1)
            query = query if looks else replace(query, looks=(), look_markers=())
            for epoch in (0, 3, 5):
                assert track(replace(query, epoch=epoch), received) == track(replace(query, epoch=epoch), snapshot)


def test_memory_is_private_unguessable_and_removed() -> None:
    with SharedSnapshot(Layout.of(MODEL)) as shared, SharedSnapshot(Layout.of(MODEL)) as other:
        name = shared.name
        assert name != other.name
        assert len(name.rpartition("-")[2]) == 12
        path = Path("/dev/shm") / name
        if path.exists():
            assert stat.S_IMODE(path.stat().st_mode) == 0o600
        reader = SnapshotReader(name)
        with pytest.raises(NoSnapshotError):
            reader.snapshot()
    assert _gone(name)
    with pytest.raises(ValueError, match="closed"):
        shared.publish(plain_snapshot(MODEL))
    shared.close()  # once more is harmless


def test_readers_cannot_write_and_may_come_and_go() -> None:
    code = (
        "import sys; from fgreg.online.shared_snapshot import SnapshotReader as R; print(R(sys.argv[1]).read().version)"
    )
    with SharedSnapshot(Layout.of(MODEL)) as shared:
        shared.publish(plain_snapshot(MODEL))
        reader = SnapshotReader(shared.name)
        with pytest.raises(ValueError, match="read-only"):
            reader._header[0] = 1
        for _ in range(2):  # the exit of the first does not take the memory from the second
            run = subprocess.run(
                [sys.executable, "-c", code, shared.name], capture_output=True, text=True, check=True, timeout=60
            )
            assert run.stdout.strip() == "1"
            assert run.stderr == ""  # no complaints of a resource tracker
        assert not _gone(shared.name)


def test_a_forked_child_of_the_writer_does_not_remove_the_memory() -> None:
    with SharedSnapshot(Layout.of(MODEL)) as shared:
        shared.publish(plain_snapshot(MODEL))
        child = os.fork()
        if child == 0:
            shared.close()
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
        assert not _gone(shared.name)


def test_a_writer_that_ends_without_closing_leaves_nothing() -> None:
    code = (
        "from tests.test_shared_snapshot import *; s = SharedSnapshot(Layout.of(MODEL));"
        "s.publish(plain_snapshot(MODEL)); print(s.name)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert run.stderr == ""
    assert _gone(run.stdout.strip())


def test_memory_left_by_a_killed_group_of_processes_is_removed_by_the_next_writer() -> None:
    code = (
        "from tests.test_shared_snapshot import *; s = SharedSnapshot(Layout.of(MODEL)); print(s.name, flush=True);"
        "time.sleep(60)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as run:
        assert run.stdout is not None
        name = run.stdout.readline().strip()
        os.killpg(run.pid, signal.SIGKILL)  # with the tracker, which would remove it
    if not (Path("/dev/shm") / name).exists():
        pytest.skip("no /dev/shm here")
    with SharedSnapshot(Layout.of(MODEL)) as shared:
        assert _gone(name)
        with SharedSnapshot(Layout.of(MODEL)):
            assert not _gone(shared.name)


def test_of_many_epochs_the_newest_are_kept() -> None:
    base = plain_snapshot(MODEL)
    epochs = tuple(EpochSnapshot(k, Verdict.OK, np.eye(3), np.array([k, 0.0, 0.0]), np.eye(SHARED)) for k in range(20))
    query = Track(0.0, 3, MarkerObservation(np.eye(4), np.eye(6), 0))
    with SharedSnapshot(Layout.of(MODEL)) as shared:
        shared.publish(replace(base, epochs=epochs))
        received = SnapshotReader(shared.name).snapshot()
    assert [epoch.number for epoch in received.epochs] == list(range(20 - EPOCHS_KEPT, 20))
    assert received.epochs[-1].translation_mm[0] == 19.0
    assert track(query, received).reason == "camera epoch 3 is over: queries are answered from epoch 12 on"


def test_what_does_not_fit_or_is_not_finite_leaves_the_last_one() -> None:
    base = plain_snapshot(MODEL)
    broken = replace(base.epochs[0], covariance=np.full((SHARED, SHARED), np.nan))
    with SharedSnapshot(Layout.of(MODEL)) as shared:
        shared.publish(replace(base, pairs=5))
        with pytest.raises(ValueError, match="not finite"):
            shared.publish(replace(base, epochs=(broken,)))
        with pytest.raises(ValueError, match="another sensitivity table"):
            shared.publish(plain_snapshot(make_session(depth_mm=(30.0,), half_width_deg=(6.0,))))
        received = SnapshotReader(shared.name).read()
        assert received.snapshot.pairs == 5
        assert received.version == 1
        shared.publish(replace(base, pairs=6))
        assert SnapshotReader(shared.name).snapshot().pairs == 6


def test_memory_of_another_format_is_reported() -> None:
    memory = multiprocessing.shared_memory.SharedMemory(create=True, size=4096)
    try:
        with pytest.raises(ValueError, match="holds no snapshots"):
            SnapshotReader(memory.name)
    finally:
        memory.close()
        memory.unlink()
