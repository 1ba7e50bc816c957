"""The executor that a command's ``--executor`` names. Clusters' libraries (extra ``cluster``) are loaded when used."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fgreg.errors import InputError, MissingExtraError
from fgreg.workers.tasks import Executor

EXTRA = "cluster"
WANTED = "local, dask:ADDRESS, slurm[:KEY=VALUE,...] or submitit-local"
LOGS = Path("fgreg-jobs")
"""Submitit's folder of tasks and logs, in the working directory: all nodes must see it."""
TIMEOUT_MIN = 60
DASK_ANSWER_S = 10.0


@contextmanager
def open_executor(named: str, label: str = "--executor") -> Iterator[Executor | None]:
    """The executor ``named``; None is this machine.

    ``local``: the cores of this machine. ``dask:ADDRESS``: the scheduler of a running Dask cluster
    (``dask:tcp://host:8786``). ``slurm``: SLURM, by submitit, with parameters as submitit names them
    (``slurm:partition=cpu,timeout_min=120``). ``submitit-local``: the same call, as processes of this machine.

    Raises:
        InputError: no such executor, nothing answers, or its workers were lost again and again.
        MissingExtraError: its library is not installed.
    """
    kind, _, rest = named.partition(":")
    try:
        if kind == "local" and not rest:
            yield None
        elif kind == "dask" and rest.rpartition(":")[2].isdigit():  # else Dask fails, and hangs for 20 s at the end
            with _dask_client(rest, label) as client:
                yield client.get_executor()
        elif kind == "slurm" or (kind == "submitit-local" and not rest):
            with _search_path_for_workers():
                yield _submitit(kind, rest, label)
        else:
            raise InputError(label, named, WANTED)
    except BrokenExecutor as error:
        raise InputError(
            f"{label} {named}", str(error), "workers that take tasks and have memory and time enough"
        ) from error


@contextmanager
def _search_path_for_workers() -> Iterator[None]:
    """Let processes started from here import what this program imports, as those of ``multiprocessing`` do."""
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join(os.fspath(Path(folder).resolve()) for folder in sys.path)
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before


@contextmanager
def _dask_client(address: str, label: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingExtraError("distributed (Dask)", EXTRA) from error
    try:
        client: Any = Client(address, timeout=DASK_ANSWER_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TypeError) as error:
        raise InputError(label, f"no Dask scheduler at {address}", "the address of a running one") from error
    with client:
        yield client


def _submitit(kind: str, rest: str, label: str) -> Executor:
    try:
        import submitit
    except ImportError as error:
        raise MissingExtraError("submitit", EXTRA) from error
    parameters: dict[str, str | int] = {"timeout_min": TIMEOUT_MIN}
    for part in filter(None, rest.split(",")):
        key, equals, value = part.partition("=")
        if not equals:
            raise InputError(label, part, "KEY=VALUE as submitit names them (partition, timeout_min, mem_gb ...)")
        parameters[key] = int(value) if value.isdigit() else value
    try:
        made = submitit.AutoExecutor(LOGS, cluster="local" if kind == "submitit-local" else "slurm")
        made.update_parameters(**parameters)
    except (RuntimeError, NameError, TypeError, AssertionError, OSError) as error:
        raise InputError(label, f"{kind}: {error}", "SLURM on this machine, and submitit's parameters") from error
    executor: Executor = made
    return executor
