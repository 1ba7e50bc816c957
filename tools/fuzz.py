"""Fuzzers of everything that reads what others wrote: files, messages of the network, the serial line.

Each target has valid inputs and reads a changed one, in process: bytes are changed, numbers of a text are replaced by
extreme ones, keys and lines are removed, doubled and exchanged, brackets are nested, two inputs are joined; documents
also get other values, keys and trees of both at places of their structure. What reads may succeed or raise fgreg's own
errors, whose text is one short line. Anything else is a finding: another exception, a warning (numpy's too), a line on
standard error, the end of the process, more than 10 s, more memory than 2 GB.

Input k of a target is the same whatever else is run. Each target runs in a process of its own, with limits of memory
and time; after a process that ended, the next one goes on behind the input at which it ended.

    python tools/fuzz.py                              # a million inputs
    python tools/fuzz.py --quick                      # 20,000
    python tools/fuzz.py --targets igtl --inputs 5000 --seed 3 --jobs 1
    python tools/fuzz.py --targets events --only 4711 # one input again, with its traceback

Findings are printed once per kind, and the inputs written to ``--findings FOLDER`` as TARGET-INPUT.bin. Exit status 1
where there are any.
"""

from __future__ import annotations

import argparse
import io
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from fgreg.errors import FgregError
from fuzz_inputs import changed
from fuzz_targets import TARGETS, Target

ALL, QUICK = 1_000_000, 20_000
LONGEST_S = 10.0
MEMORY_BYTES = 2_000_000_000
LONGEST_TEXT = 2000
"""Characters of an error's text."""


@dataclass(slots=True)
class Result:
    """What became of a target's inputs.

    Attributes:
        done: inputs read. accepted: of them, those without an error.
        findings: input and what happened, once per kind. counts: how often each kind.
        slowest_s: of one input.
    """

    done: int = 0
    accepted: int = 0
    findings: dict[str, tuple[int, str]] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    slowest_s: float = 0.0


class TooSlowError(Exception):
    """An input took longer than allowed."""


@cache
def _valid(name: str) -> Sequence[bytes]:
    return TARGETS[name].valid()


def make_input(target: Target, seed: int, index: int) -> bytes:
    """Input ``index`` of a target."""
    rng = np.random.default_rng([seed, index, *target.name.encode()])
    return changed(_valid(target.name), target.form, rng)


def read(target: Target, data: bytes, folder: Path) -> bool:
    """Read one input; True where it was accepted.

    Raises:
        Exception: a finding.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with np.errstate(all="warn", under="ignore"):
            try:
                target.read(data, folder)
            except FgregError as error:
                text = str(error)
                if not text.isprintable() or len(text) > LONGEST_TEXT:
                    raise AssertionError(f"an error whose text is not one short line: {text[:200]!r}") from error
                return False
            except target.raises:
                return False
    return True


def _too_slow(_signal: int, _frame: object) -> None:
    raise TooSlowError(f"more than {LONGEST_S:g} s")


def _kind(error: BaseException) -> str:
    """The error's type and the innermost line of the project: findings are told apart by it."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if f"{os.sep}fgreg{os.sep}" in frame.filename] or frames
    where = f"{Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else "?"
    return f"{type(error).__name__} at {where}"


def _work(name: str, seed: int, first: int, count: int, at: Any, connection: Any) -> None:
    """Read inputs in this process, and send the result."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    signal.signal(signal.SIGALRM, _too_slow)
    target, result = TARGETS[name], Result()
    with tempfile.TemporaryDirectory() as folder, _silenced() as said:
        for index in range(first, first + count):
            at.value = index
            data = make_input(target, seed, index)
            start = time.monotonic()
            signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
            try:
                result.accepted += read(target, data, Path(folder))
                if text := said.getvalue():
                    raise AssertionError(f"on standard error: {text[:200]!r}")
            except Exception as error:
                kind = _kind(error)
                result.counts[kind] += 1
                result.findings.setdefault(kind, (index, "".join(traceback.format_exception(error))))
            finally:
                said.truncate(0)
                signal.setitimer(signal.ITIMER_REAL, 0.0)
            result.slowest_s = max(result.slowest_s, time.monotonic() - start)
            result.done += 1
    connection.send(result)


@contextmanager
def _silenced() -> Iterator[io.StringIO]:
    """What Python writes on standard error; what C libraries write goes nowhere, as in the commands."""
    before = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    said = io.StringIO()
    try:
        with redirect_stderr(said):
            yield said
    finally:
        os.dup2(before, 2)
        os.close(before)
        os.close(nowhere)


def run(name: str, count: int, seed: int) -> Result:
    """Read ``count`` inputs of a target, in processes of their own."""
    context = multiprocessing.get_context("fork")
    whole, first = Result(), 0
    _valid(name)  # here, so that the processes share them
    while first < count:
        at = context.Value("q", first)
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(name, seed, first, min(count - first, 20_000), at, theirs))
        process.start()
        theirs.close()
        try:
            part: Result | None = ours.recv()
        except EOFError:
            part = None
        process.join()
        if part is None and process.exitcode is not None and process.exitcode > 0:
            raise RuntimeError(f"the fuzzer itself failed at {name}, input {at.value}")
        if part is None:
            index = int(at.value)
            kind = f"the process ended ({process.exitcode})"
            part = Result(index + 1 - first, 0, {kind: (index, kind)}, Counter([kind]))
        whole.done += part.done
        whole.accepted += part.accepted
        whole.counts += part.counts
        whole.slowest_s = max(whole.slowest_s, part.slowest_s)
        for kind, found in part.findings.items():
            whole.findings.setdefault(kind, found)
        first += part.done
    return whole


def shares(names: list[str], total: int) -> dict[str, int]:
    """Inputs of each target: in proportion to how fast it is, at least a few."""
    weights = {name: TARGETS[name].share for name in names}
    return {name: max(10, round(total * weight / sum(weights.values()))) for name, weight in weights.items()}


def _in_parallel(counts: dict[str, int], seed: int, jobs: int) -> Iterator[tuple[str, Result]]:
    from concurrent.futures import ThreadPoolExecutor, as_completed

    with ThreadPoolExecutor(jobs) as pool:
        futures = {pool.submit(run, name, count, seed): name for name, count in counts.items()}
        for future in as_completed(futures):
            yield futures[future], future.result()


def main() -> None:
    """Fuzz and report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, usage="%(prog)s [options]"
    )
    parser.add_argument("--targets", nargs="*", default=list(TARGETS), choices=list(TARGETS), metavar="TARGET")
    parser.add_argument("--list", action="store_true", help="name the targets")
    parser.add_argument("--inputs", type=int, default=ALL, help="in all")
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} inputs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", type=int, metavar="INPUT", help="one input of each target, with its traceback")
    parser.add_argument("--findings", type=Path, metavar="FOLDER", help="where inputs that found something are kept")
    options = parser.parse_args()
    if options.list:
        for target in TARGETS.values():
            print(f"{target.name:14} {target.what}")
        return
    if options.only is not None:
        for name in options.targets:
            data = make_input(TARGETS[name], options.seed, options.only)
            print(f"{name}: {data[:2000]!r}")
            with tempfile.TemporaryDirectory() as folder:
                print("accepted" if read(TARGETS[name], data, Path(folder)) else "refused")
        return
    start, found = time.monotonic(), 0
    counts = shares(options.targets, QUICK if options.quick else options.inputs)
    print(f"{'target':14} {'inputs':>8} {'accepted':>8} {'slowest s':>9}  findings")
    done = 0
    for name, result in _in_parallel(counts, options.seed, options.jobs):
        done += result.done
        found += len(result.findings)
        print(
            f"{name:14} {result.done:8} {result.accepted:8} {result.slowest_s:9.2f}  {len(result.findings)}", flush=True
        )
        for kind, (index, text) in result.findings.items():
            print(f"    {result.counts[kind]} times {kind}, first at input {index}\n{_indented(text)}", flush=True)
            if options.findings is not None:
                options.findings.mkdir(parents=True, exist_ok=True)
                data = make_input(TARGETS[name], options.seed, index)
                (options.findings / f"{name}-{index}.bin").write_bytes(data)
    print(f"{done} inputs in {time.monotonic() - start:.0f} s, {found} findings")
    sys.exit(1 if found else 0)


def _indented(text: str) -> str:
    return "\n".join(f"        {line}" for line in text.strip().splitlines()[-6:])


if __name__ == "__main__":
    main()
