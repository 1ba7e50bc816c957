"""Options and executor of the studies: ``--jobs`` and ``--executor``, as `fgreg evaluate` has them.

On a cluster the workers need the same Python environment; those of Dask also this folder in PYTHONPATH. The numbers
are those of one process: each task has its own seed, and results come in the order of the tasks.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from fgreg.cli.executors import WANTED, open_executor
from fgreg.errors import FgregError
from fgreg.workers.tasks import Executor, run_tasks

TaskT = TypeVar("TaskT")
ResultT = TypeVar("ResultT")


@dataclass(frozen=True, slots=True)
class Pool:
    """Where the sessions of a study are solved."""

    jobs: int
    executor: Executor | None

    def map(self, function: Callable[[TaskT], ResultT], tasks: Iterable[TaskT]) -> Iterator[ResultT]:
        """Results in the order of the tasks."""
        return run_tasks(function, list(tasks), jobs=self.jobs, executor=self.executor)


def add_pool_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes (default: one per core)")
    parser.add_argument("--executor", default="local", metavar="WHERE", help=f"where to run: {WANTED}")


@contextmanager
def pool_of(args: argparse.Namespace) -> Iterator[Pool]:
    try:
        with open_executor(args.executor) as executor:
            yield Pool(args.jobs, executor)
    except FgregError as error:
        raise SystemExit(f"error: {error}") from error
