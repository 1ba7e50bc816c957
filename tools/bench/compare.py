"""Contenders timed in turn: rows of a table, each the time of a contender over that of the first one."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

Clock = Callable[[], float]
BUDGET_S = 20.0
"""A contender whose run takes longer is run once."""


@dataclass(frozen=True, slots=True)
class Row:
    """A contender's line.

    Attributes:
        section, case, name: what was done, on what, and by whom.
        ms: median time, ms. None where it was not run.
        ratio, low, high: median and quartiles over the rounds of its time over that of the first contender's.
        runs: number of runs. note: what a reader has to know.
        worse: 1 where a larger ratio is a loss of this package, -1 where a smaller one is, 0 where it says nothing.
    """

    section: str
    case: str
    name: str
    ms: float | None = None
    ratio: float | None = None
    low: float | None = None
    high: float | None = None
    runs: int = 0
    note: str = ""
    worse: int = 0

    @property
    def key(self) -> str:
        """Of the stored ratios."""
        return f"{self.section} | {self.case} | {self.name}"


@dataclass(frozen=True, slots=True)
class Target:
    """A ratio and its limit; met where the ratio is at most the limit."""

    text: str
    ratio: float
    limit: float

    @property
    def met(self) -> bool:
        return self.ratio <= self.limit


@dataclass(frozen=True, slots=True)
class Section:
    """What one part of the benchmark found."""

    rows: tuple[Row, ...]
    targets: tuple[Target, ...] = ()


def say(text: str) -> None:
    """Progress, on standard error."""
    print(text, file=sys.stderr, flush=True)


def in_turn(
    runs: Mapping[str, Callable[[], Any]], repeats: int, clock: Clock = time.process_time, budget_s: float = BUDGET_S
) -> dict[str, list[float]]:
    """Seconds of each run: all in turn, ``repeats`` times, after one round that is not counted.

    A run that took longer than the budget in that round is not repeated, and its one time is what there is.
    """
    times: dict[str, list[float]] = {name: [] for name in runs}
    short = dict(runs)
    for number in range(repeats + 1):
        for name, run in list(short.items()):
            start = clock()
            run()
            took = clock() - start
            if number:
                times[name].append(took)
            elif took > budget_s:
                times[name].append(took)
                del short[name]
    return times


def rows_of(
    section: str,
    case: str,
    times: Mapping[str, list[float]],
    notes: Mapping[str, str],
    *,
    ms_of: float = 1.0,
    own: Collection[str] | None = None,
) -> list[Row]:
    """Rows from times in turn; ratios to the first contender, of the same round.

    Args:
        section, case, notes: of the rows.
        times: seconds of each.
        ms_of: runs that were timed together.
        own: names that are this package; None: the first.
    """
    base, first = next(iter(times.items()))
    ours = {base} if own is None else set(own)
    rows = []
    for name, taken in times.items():
        beside = first if len(taken) == len(first) else [statistics.median(first)] * len(taken)
        ratios = [mine / other for mine, other in zip(taken, beside, strict=True)]
        low, _, high = statistics.quantiles(ratios, n=4) if len(ratios) > 1 else ratios * 3
        rows.append(
            Row(
                section,
                case,
                name,
                1e3 * statistics.median(taken) / ms_of,
                statistics.median(ratios),
                low,
                high,
                len(taken),
                notes.get(name, ""),
                0 if name == base else 1 if name in ours else -1 if base in ours else 0,
            )
        )
    return rows


def print_rows(rows: list[Row]) -> None:
    """The table."""
    width = max(len(row.name) for row in rows)
    last = ""
    for row in rows:
        title = f"{row.section}, {row.case}"
        if title != last:
            print(f"\n{title}\n  {'':{width}s} {'ms':>9s} {'ratio':>9s}  quartiles")
            last = title
        if row.ms is None or row.ratio is None or row.low is None or row.high is None:
            print(f"  {row.name:{width}s} {row.note}")
            continue
        spread = f"{row.low:.3g} to {row.high:.3g}" if row.runs > 1 else "1 run"
        note = f"  {row.note}" if row.note else ""
        print(f"  {row.name:{width}s} {row.ms:9.4g} {row.ratio:9.3g}  {spread}{note}")


def print_targets(targets: list[Target]) -> None:
    print("\nTargets")
    for target in targets:
        print(f"  {target.text:84s} {target.ratio:7.3g} (limit {target.limit:g}){'' if target.met else '  MISSED'}")
