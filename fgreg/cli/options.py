"""Options that several commands share, and their settings."""

import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgreg.errors import InputError, one_line

if TYPE_CHECKING:
    from rich.progress import ProgressColumn

    from fgreg.model.solve_config import SolveConfig

LimitOption = Annotated[
    float,
    typer.Option(
        "--limit-mm", help="95 % bound of the predicted error at the worst target up to which the verdict is ok."
    ),
]
EstimateOption = Annotated[
    str,
    typer.Option(
        "--estimate",
        metavar="NAMES",
        help="Estimate these too, with the values in session.yaml as priors: sound_speed, probe_radius, or both with a "
        "comma between.",
    ),
]
JobsOption = Annotated[int | None, typer.Option("--jobs", "-j", help="Processes. Default: one per core.")]
ExecutorOption = Annotated[
    str,
    typer.Option(
        "--executor",
        metavar="WHERE",
        help="Where the solves run: local (this machine), dask:ADDRESS (a running Dask cluster), "
        "slurm[:KEY=VALUE,...] (by submitit) or submitit-local. Same seeds give the same figures on each.",
    ),
]
OnlineEstimateOption = Annotated[
    str,
    typer.Option(
        "--estimate", metavar="NAMES", help="Estimate this too, with the value in session.yaml as prior: sound_speed."
    ),
]


CERTIFICATE_BUDGET = 3_000_000
"""Of ``--certify``: some seconds at most."""


def processes(jobs: int | None) -> int:
    """Number of processes: that of ``--jobs``, or the cores that this process may use.

    Raises:
        InputError: less than 1.
    """
    if jobs is not None and jobs < 1:
        raise InputError("--jobs", str(jobs), "a number >= 1")
    return jobs or (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def solve_config(
    limit_mm: float,
    estimate: str,
    known: tuple[str, ...] = ("sound_speed", "probe_radius"),
    *,
    certify: bool = False,
) -> "SolveConfig":
    """The settings from the options; ``known``: extra variables that this command can estimate.

    Raises:
        InputError: an unknown variable, or an invalid limit.
    """
    from fgreg.model.solve_config import SolveConfig

    wanted = {name.strip() for name in estimate.split(",") if name.strip()}
    if not wanted <= set(known):
        expected = known[0] if len(known) == 1 else f"{', '.join(known)}, or both with a comma between"
        raise InputError("--estimate", estimate, expected)
    try:
        return SolveConfig(
            limit_mm=limit_mm,
            estimate_sound_speed="sound_speed" in wanted,
            estimate_radius="probe_radius" in wanted,
            certificate_budget=CERTIFICATE_BUDGET if certify else 0,
        )
    except ValueError as error:
        raise InputError("--limit-mm", str(limit_mm), "a number of millimetres > 0") from error


def progress_columns() -> "tuple[ProgressColumn, ...]":
    """Of a progress bar: step, bar, items done, time left."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    left = TimeRemainingColumn(compact=True, elapsed_when_finished=True)
    return TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), left, TextColumn("left")


def refuse_stale(session: Path) -> None:
    """Refuse a session whose ``result.yaml`` was made from other files; one that cannot be told is none.

    Raises:
        InputError: the result is stale.
    """
    from fgreg.session.input_hashes import stale
    from fgreg.session.result_file import RESULT_FILE, read_result

    result, found = session / RESULT_FILE, ""
    with suppress(InputError):
        found = stale(result, read_result(result))
    if found:
        raise InputError(str(result), found, "that of the session as it is (fgreg solve), or --force")


def refuse_given(options: Mapping[str, object], found: str, expected: str) -> None:
    """Refuse options, by name, that go with something else.

    Raises:
        InputError: one of them is given, that is, not None.
    """
    for name, value in options.items():
        if value is not None:
            raise InputError(name, found, expected)


def warn(text: str) -> None:
    """Write a warning as one line on standard error, with control characters escaped: files and devices name things."""
    sys.stderr.write(f"fgreg: warning: {one_line(text)}\n")


def warn_of_leftovers(*paths: Path | None) -> None:
    """Name on standard error what interrupted runs left beside these outputs, and how to take it back."""
    from fgreg.output.leftovers import leftovers

    for text in dict.fromkeys(text for path in paths if path is not None for text in leftovers(path)):
        warn(text)
