"""The query process: answers while another process is busy, and ends with it."""

from __future__ import annotations

import math
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing import AuthenticationError
from pathlib import Path

import numpy as np
import pytest

from fgreg.model.estimate import TrackEstimate
from fgreg.model.measurements import Track
from fgreg.online.shared_snapshot import SharedSnapshot
from fgreg.online.snapshot_record import Layout
from fgreg.tracking.query import track
from fgreg.tracking.snapshot import Snapshot
from query_codec import (
    QueryError,
    decode_answer,
    decode_query,
    encode_answer,
    encode_error,
    encode_query,
)
from query_server import QueryClient, QueryServer
from tests.forward import make_measurements, make_session
from tests.track_cases import held_out, plain_snapshot, query_of, solved


@dataclass
class _Running:
    shared: SharedSnapshot
    server: QueryServer
    snapshot: Snapshot
    queries: list[Track]


@pytest.fixture(scope="module")
def running() -> Iterator[_Running]:
    model, measurements, _ = make_measurements(np.random.default_rng(1), pairs=24, looks_per_pm=2, share_marker=False)
    used, out = held_out(measurements, 3)
    snapshot = solved(used, model).snapshot
    queries = [query_of(pairs, looks=looks) for pairs in out for looks in (1, 2)]
    queries += [replace(query, looks=(), look_markers=(), scan_rad=0.1) for query in queries]
    with SharedSnapshot(Layout.of(model)) as shared, QueryServer(shared.name) as server:
        yield _Running(shared, server, snapshot, queries)


def test_results_are_those_of_the_snapshot(running: _Running) -> None:
    running.shared.publish(running.snapshot)
    with running.server.client() as client:
        for query in running.queries:
            assert client.track(query) == track(query, running.snapshot)
            assert 0.0 <= client.age_s < 60.0


def test_a_newer_snapshot_is_answered_from_at_once(running: _Running) -> None:
    query = running.queries[0]
    with running.server.client() as client:
        for reason in ("first", "second"):
            epoch = replace(
                running.snapshot.epochs[0], verdict=running.snapshot.epochs[0].verdict.REFUSED, reason=reason
            )
            running.shared.publish(replace(running.snapshot, epochs=(epoch,)))
            assert client.track(query).reason.endswith(f"is refused: {reason}")
        running.shared.publish(running.snapshot)
        assert client.track(query).stage_rad is not None


def test_many_threads_get_their_own_answers(running: _Running) -> None:
    running.shared.publish(running.snapshot)
    expected = [track(query, running.snapshot) for query in running.queries]
    wrong: list[int] = []

    def ask(shared: QueryClient | None) -> None:
        client = shared or running.server.client()
        for turn in range(60):
            index = turn % len(expected)
            if client.track(running.queries[index]) != expected[index]:
                wrong.append(index)

    with running.server.client() as common:
        threads = [threading.Thread(target=ask, args=(common if k % 2 else None,)) for k in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert wrong == []


def test_an_invalid_query_is_reported_and_the_next_one_answered(running: _Running) -> None:
    running.shared.publish(running.snapshot)
    query = running.queries[0]
    bad = replace(query, marker=replace(query.marker, camera_T_marker=np.full((4, 4), np.nan)))
    with running.server.client() as client:
        with pytest.raises(QueryError, match="not finite"):
            client.track(bad)
        client._connection.send_bytes(b"no query")
        with pytest.raises(QueryError, match="8 bytes"):
            decode_answer(client._connection.recv_bytes())
        assert client.track(query) == track(query, running.snapshot)


def test_a_wrong_key_gets_no_answers(running: _Running) -> None:
    with pytest.raises(AuthenticationError):
        QueryClient(replace(running.server.address, key=b"guess"))
    assert repr(running.server.address.key) not in repr(running.server.address)
    with running.server.client() as client:
        running.shared.publish(running.snapshot)
        assert client.track(running.queries[0]).stage_rad is not None


def test_before_the_first_estimate_clients_get_a_reason() -> None:
    model = make_session()
    query = Track(0.0, 0, make_measurements(np.random.default_rng(0), pairs=1)[1].pairs[0].marker)
    with SharedSnapshot(Layout.of(model)) as shared, QueryServer(shared.name) as server:
        with server.client() as client, pytest.raises(QueryError, match="no estimate has been published yet"):
            client.track(query)
        folder = Path(server.address.path).parent
        assert folder.stat().st_mode & 0o077 == 0
        with server.client() as client:
            server.close()
            with pytest.raises((EOFError, OSError)):
                client.track(query)
    assert not server.alive
    assert not folder.exists()


def test_the_process_ends_with_the_one_that_started_it() -> None:
    code = (
        "import time; from tests.test_query_server import *\n"
        "if __name__ == '__main__':\n"
        " s = SharedSnapshot(Layout.of(make_session())); q = QueryServer(s.name)\n"
        " print(q.pid, q.address.path, flush=True); time.sleep(60)\n"
    )
    command, environment = [sys.executable, "-c", code], {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        pid, path = process.stdout.readline().split()
        process.send_signal(signal.SIGKILL)
    end = time.monotonic() + 10.0
    while time.monotonic() < end and Path(path).parent.exists():
        time.sleep(0.05)
    assert not Path(path).parent.exists()
    assert _ended(int(pid), end)


def _ended(pid: int, latest: float) -> bool:
    while time.monotonic() < latest:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def test_a_server_of_no_memory_does_not_start() -> None:
    with pytest.raises(RuntimeError, match="has ended"):
        QueryServer("fgreg-none")


def test_queries_come_through_bytes_as_they_are() -> None:
    _, measurements, _ = make_measurements(np.random.default_rng(2), pairs=2, looks_per_pm=3, amplitude_noise=0.05)
    query = replace(query_of(list(measurements.pairs[:3]), looks=3), scan_rad=0.25, t=1.5e9)
    back = decode_query(encode_query(query))
    assert (back.t, back.epoch, back.scan_rad) == (query.t, query.epoch, query.scan_rad)
    np.testing.assert_array_equal(back.marker.camera_T_marker, query.marker.camera_T_marker)
    np.testing.assert_array_equal(back.marker.covariance, query.marker.covariance)
    same = [[a.id == b.id for a in query.look_markers] for b in query.look_markers]
    assert [[a.id == b.id for a in back.look_markers] for b in back.look_markers] == same
    for mine, theirs in zip(query.looks, back.looks, strict=True):
        assert replace(mine, covariance=theirs.covariance).__repr__() == repr(theirs)
        np.testing.assert_array_equal(mine.covariance, theirs.covariance)
    without = decode_query(encode_query(replace(query, looks=(), look_markers=(), scan_rad=None)))
    assert without.scan_rad is None
    assert without.looks == ()


def test_answers_come_through_bytes_as_they_are() -> None:
    for answer in (
        TrackEstimate(1.0, 0.1, 0.02, 55.0, True),
        TrackEstimate(2.0, None, None, None, False, "the stage would have to turn"),
    ):
        assert decode_answer(encode_answer(answer, 0.5)) == (answer, 0.5)
    with pytest.raises(QueryError, match="out of order"):
        decode_answer(encode_error("out of order"))
    with pytest.raises(QueryError, match="that is none"):
        decode_answer(b"?")


def test_bytes_that_are_no_query_are_refused() -> None:
    _, measurements, _ = make_measurements(np.random.default_rng(3), pairs=1)
    data = encode_query(query_of(list(measurements.pairs), looks=1))
    for broken in (data[:-8], data + b"12345678", b"", struct.pack("<dqddqq", 0.0, 0, 0.0, 0.0, -1, 0)):
        with pytest.raises(QueryError):
            decode_query(broken)
    huge = struct.pack("<dqddqq", 0.0, 0, 0.0, math.nan, 2**62, 2**62)
    with pytest.raises(QueryError, match="looks"):
        decode_query(huge)


def test_plain_snapshots_serve_without_a_surface() -> None:
    _, measurements, _ = make_measurements(np.random.default_rng(4), pairs=1)
    query = replace(query_of(list(measurements.pairs), looks=1), looks=(), look_markers=())
    assert "trace no surface yet" in track(query, plain_snapshot(make_session())).reason
