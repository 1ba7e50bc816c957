"""Times tracking queries: alone, and under a continuous stream of updates.

Alone: one look at the PM, several with amplitudes, none (from the tissue surface): percentiles of wall time and of CPU
time. A busy machine does not inflate the CPU time.

Under updates: this process adds pair after pair to an OnlineRegistration, without a pause, and publishes a snapshot
after each. Meanwhile queries come at camera rate from
  - a camera loop in a process of its own, which reads the shared snapshot and answers its queries itself;
  - a client in another process, by a round trip to the query process;
  - a thread of the updating process, by a round trip to the query process;
  - a thread of the updating process, which answers its queries itself.
Printed are the time from the call to the result, and from when the query was due (a frame's arrival): a thread may
have to wait before it can call. Each client also times a fixed piece of arithmetic: its excess over the time in
isolation is the cost of the machine's other work.

    python tools/bench_queries.py
    python tools/bench_queries.py --seconds 10 --full-solve worker
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from fgreg.geometry.transforms import FloatArray
from fgreg.model.measurements import Measurements, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.shared_snapshot import NoSnapshotError, SharedSnapshot, SnapshotReader
from fgreg.online.snapshot_record import Layout
from fgreg.online.solver import Where
from fgreg.tracking.query import track
from fgreg.tracking.snapshot import Snapshot
from query_codec import QueryError
from query_server import QueryAddress, QueryClient, QueryServer
from tests.forward import make_measurements, make_session
from tests.test_tracking import surface_case
from tests.track_cases import held_out, query_of, solved, solved_of

LIMIT_MS = {50.0: 5.0}
PERCENTILES = (50.0, 99.0, 99.9, 100.0)
Ask = Callable[[Track], object]


def spin() -> int:
    """Some 0.15 ms of arithmetic."""
    total = 0
    for k in range(2500):
        total += k * k
    return total


def line(name: str, times_s: FloatArray, targets: dict[float, float]) -> str:
    """Percentiles in ms, beside their targets."""
    parts = []
    for share in PERCENTILES:
        label = "max" if share == 100.0 else f"p{share:g}"
        target = f" (<= {targets[share]:g})" if share in targets else ""
        parts.append(f"{label} {1e3 * float(np.percentile(times_s, share)):.3f}{target}")
    return f"  {name:<44s} {len(times_s):6d}  " + "  ".join(parts)


def alone(repeats: int) -> None:
    """Queries of each kind, one after the other."""
    print("alone (ms)")
    for name, queries, snapshot in _kinds():
        for query in queries:
            track(query, snapshot)
        wall, cpu = np.empty(repeats), np.empty(repeats)
        for k in range(repeats):
            query = queries[k % len(queries)]
            start, cpu_start = time.perf_counter(), time.thread_time()
            track(query, snapshot)
            wall[k], cpu[k] = time.perf_counter() - start, time.thread_time() - cpu_start
        print(line(name, wall, LIMIT_MS))
        print(line("    CPU time", cpu, LIMIT_MS))


def _kinds() -> list[tuple[str, list[Track], Snapshot]]:
    model, measurements, _ = make_measurements(np.random.default_rng(1), pairs=35)
    used, out = held_out(measurements, 10)
    snapshot = solved(used, model).snapshot
    kinds = [
        ("one look, first hit", [query_of(pairs, looks=1) for pairs in out], snapshot),
        ("one look, window only", [query_of(pairs, looks=1, sweeps=False) for pairs in out], snapshot),
    ]
    options: dict[str, Any] = {"looks_per_pm": 3, "look_spacing_deg": 2.0, "amplitude_noise": 0.05}
    for share, name in ((True, "one marker"), (False, "a marker each")):
        model, measurements, _ = make_measurements(
            np.random.default_rng(2), session=make_session(curve=True), pairs=20, share_marker=share, **options
        )
        used, out = held_out(measurements, 5)
        snapshot = solved(used, model).snapshot
        kinds.append((f"three looks with amplitudes, {name}", [query_of(pairs, looks=3) for pairs in out], snapshot))
    case = surface_case(1, heard=False, count=10)
    snapshot = solved_of(case.solution, case.model, SolveConfig()).snapshot
    kinds.append(("no look, from the surface", case.queries, snapshot))
    return kinds


@dataclass(frozen=True, slots=True)
class Client:
    """How a client sends queries, how long and how often; plain values for another process."""

    memory: str
    address: QueryAddress
    by_round_trip: bool
    queries: list[Track]
    seconds: float
    period_s: float


def _ask_of(client: Client) -> Ask:
    if client.by_round_trip:
        return QueryClient(client.address).track
    reader = SnapshotReader(client.memory)
    return lambda query: track(query, reader.snapshot())


@dataclass(frozen=True, slots=True, eq=False)
class Times:
    """Wall times (s) of queries from call and from when they were due, and of :func:`spin`; how many had an answer."""

    call: FloatArray
    due: FloatArray
    spin: FloatArray
    answered: int


def run_client(client: Client) -> Times:
    """Ask until the time is up."""
    ask = _ask_of(client)
    ready = time.monotonic() + 60.0
    while time.monotonic() < ready:
        try:
            ask(client.queries[0])
            break
        except (NoSnapshotError, QueryError):
            time.sleep(0.01)
    times, from_due, spins, answered = [], [], [], 0
    end, due, k = time.perf_counter() + client.seconds, time.perf_counter(), 0
    while time.perf_counter() < end:
        start = time.perf_counter()
        answer = ask(client.queries[k % len(client.queries)])
        between = time.perf_counter()
        spin()
        spins.append(time.perf_counter() - between)
        times.append(between - start)
        from_due.append(between - due)
        answered += getattr(answer, "stage_rad", None) is not None
        k += 1
        due += client.period_s * max(1, math.ceil((time.perf_counter() - due) / client.period_s))
        time.sleep(max(due - time.perf_counter(), 0.0))
    return Times(np.array(times), np.array(from_due), np.array(spins), answered)


def _client_process(client: Client, back: Connection[Any, Any]) -> None:
    back.send(run_client(client))


def _session(pairs: int) -> tuple[SessionModel, Measurements, list[Track]]:
    model, measurements, _ = make_measurements(np.random.default_rng(3), pairs=pairs)
    used, out = held_out(measurements, 10)
    return model, used, [query_of(looks, looks=1) for looks in out]


class Updates:
    """The stream: pair after pair, from the start again when a session is through."""

    def __init__(self, model: SessionModel, used: Measurements, full_solve: Where | None) -> None:
        self._model, self._used, self._where = model, used, full_solve
        self.add_s: list[float] = []
        self.publish_s: list[float] = []

    def run(self, shared: SharedSnapshot, going: Callable[[], bool]) -> None:
        """Add and publish while ``going``."""
        while going():
            with OnlineRegistration(
                self._model,
                SolveConfig(),
                full_solve=self._where or "in_process",
                verdicts=self._where is not None,
                find_moves=False,
            ) as engine:
                for aim in self._used.aims:
                    engine.add(aim)
                for k, pair in enumerate(self._used.pairs):
                    if not going():
                        return
                    start = time.perf_counter()
                    engine.add(pair)
                    between = time.perf_counter()
                    if k > 8:  # each of the pairs before is a registration from scratch, not an update
                        shared.publish(engine.snapshot())
                        self.add_s.append(between - start)
                        self.publish_s.append(time.perf_counter() - between)


def under_updates(options: argparse.Namespace) -> None:
    """Each kind of client during the stream."""
    model, used, queries = _session(options.pairs)
    where = None if options.full_solve == "none" else options.full_solve
    print(f"under a stream of updates, {options.seconds:g} s each, a query every {options.period_ms:g} ms (ms)")
    for name, in_process, round_trip in (
        ("own process, shared snapshot", False, False),
        ("own process, round trip", False, True),
        ("thread of the updating process, round trip", True, True),
        ("thread of the updating process, answers itself", True, False),
    ):
        with SharedSnapshot(Layout.of(model)) as shared, QueryServer(shared.name) as server:
            client = Client(shared.name, server.address, round_trip, queries, options.seconds, 1e-3 * options.period_ms)
            updates = Updates(model, used, where)
            if in_process:
                found: list[Times] = []
                thread = threading.Thread(target=_collect, args=(client, found))
                thread.start()
                updates.run(shared, thread.is_alive)
                thread.join()
                times = found[0]
            else:
                context = multiprocessing.get_context("spawn")
                mine, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_client_process, args=(client, theirs))
                process.start()
                theirs.close()
                updates.run(shared, lambda at=mine: not at.poll())  # type: ignore[misc]
                times = mine.recv()
                process.join()
        print(line(name, times.call, LIMIT_MS))
        print(line("    from when it was due", times.due, LIMIT_MS))
        print(line("    fixed arithmetic in its place", times.spin, {}))
        print(line("    updates", np.array(updates.add_s), {}))
        print(line("    snapshot and publishing", np.array(updates.publish_s), {}))
        if times.answered < len(times.call):
            print(f"    {len(times.call) - times.answered} queries had no answer")


def _collect(client: Client, found: list[Times]) -> None:
    found.append(run_client(client))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each kind of client (default 60)")
    parser.add_argument("--period-ms", type=float, default=10.0, help="between queries (default 10)")
    parser.add_argument("--repeats", type=int, default=3000, help="queries of each kind alone (default 3000)")
    parser.add_argument("--pairs", type=int, default=1000, help="of the session that is streamed (default 1000)")
    parser.add_argument(
        "--full-solve",
        choices=("none", "in_process", "worker"),
        default="none",
        help="where posterior and verdict are computed meanwhile (default none)",
    )
    parser.add_argument("--switch-ms", type=float, help="interpreter's switch interval in the updating process")
    parser.add_argument("--only", choices=("alone", "under"))
    options = parser.parse_args()
    if options.switch_ms is not None:
        sys.setswitchinterval(1e-3 * options.switch_ms)
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    print(f"{os.cpu_count()} cores, load {load}, switch interval {1e3 * sys.getswitchinterval():g} ms")
    if options.only != "under":
        alone(options.repeats)
    if options.only != "alone":
        under_updates(options)


if __name__ == "__main__":
    main()
