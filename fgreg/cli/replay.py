"""The command ``fgreg replay``."""

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fgreg.cli.options import LimitOption, OnlineEstimateOption, progress_columns, solve_config, warn, warn_of_leftovers
from fgreg.errors import InputError

if TYPE_CHECKING:
    from rich.text import Text

    from fgreg.pipeline.replay import OnStep, ReplayStep
    from fgreg.pipeline.solve import SolveReport

Progress = Callable[[str, int, int], None]
MakeExtras = Callable[["SolveReport"], Any]
EXIT_REFUSED = 1

HEADING = f"{'t, s':>9}  {'event':<30} {'epoch':>5} {'pairs':>5} {'NIS':>6} {'95 % mm':>7}  {'verdict':<8}"
"""``95 % mm``: the bound of the predicted error at the worst target."""


def add_replay(app: typer.Typer, make_extras: MakeExtras) -> None:
    """Register the command; ``make_extras`` gives what a summary has besides the estimate."""

    @app.command()
    def replay(
        session: Annotated[Path, typer.Argument(metavar="SESSION", help="Folder of the session.")],
        out: Annotated[
            Path | None, typer.Option("--out", metavar="FILE", help="Result file. Default: SESSION/result.yaml.")
        ] = None,
        speed: Annotated[
            str,
            typer.Option("--speed", metavar="N", help="1: as recorded; 10: ten times that; max: as fast as possible."),
        ] = "max",
        rrd: Annotated[
            Path | None,
            typer.Option("--rrd", metavar="FILE", help="Also write a Rerun recording; open it with: rerun FILE."),
        ] = None,
        live: Annotated[
            bool, typer.Option("--live", help="Open a Rerun viewer and show the session in it while it is replayed.")
        ] = False,
        limit_mm: LimitOption = 3.0,
        estimate: OnlineEstimateOption = "",
        redetect: Annotated[
            bool, typer.Option("--redetect", help="Detect in the frames even where events have poses.")
        ] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no lines, no summary.")] = False,
    ) -> None:
        """Run a recorded session through the online engine, as in the operating room.

        Each aim, pair and camera move is added in order, and a line shows the estimate after it: camera epoch,
        pairs used in it, the new pair's NIS (squared misfit over its predicted covariance, by the estimate without it:
        above 6 is one in twenty), the 95 % bound of the predicted error at the worst target in mm, and the verdict.
        Tracking queries are answered from the estimate at their time. At the end there is a full solve: the
        registration is that of fgreg solve. Writes result.yaml with timing_ms added. Exit status 1 where the verdict is
        refused.

        Watch it in real time: fgreg replay SESSION --speed 1 --live. Or record it: --rrd FILE.
        """
        from fgreg.cli.report import print_summary
        from fgreg.cli.report_document import summary_dict
        from fgreg.model.estimate import Verdict
        from fgreg.pipeline.replay import ReplayRequest, replay_session

        pace = _speed(speed)
        config = solve_config(limit_mm, estimate, ("sound_speed",))
        warn_of_leftovers(session, out, rrd)
        with _display(quiet or as_json) as (progress, on_step):
            request = ReplayRequest(session, out, rrd, live, pace, redetect)
            report = replay_session(request, config, progress, on_step)
        solved = report.solved
        extras = make_extras(solved)
        if as_json:
            typer.echo(json.dumps(summary_dict(solved.session.model, solved.estimate, extras), indent=2))
        elif not quiet:
            for warning in solved.session.warnings:
                warn(warning)
            typer.echo()
            print_summary(solved.session.model, solved.estimate, extras)
        if solved.estimate.verdict is Verdict.REFUSED:
            raise typer.Exit(EXIT_REFUSED)


def _speed(text: str) -> float | None:
    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = math.nan
    if not 0 < speed < math.inf:
        raise InputError("--speed", text, "1, 10 or another number > 0, or max")
    return speed


@contextmanager
def _display(quiet: bool) -> "Iterator[tuple[Progress | None, OnStep | None]]":
    """Lines on standard output; below them, on a terminal, a bar."""
    if quiet:
        yield None, None
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    console = Console(highlight=False, emoji=False, soft_wrap=True)
    with Bar(*progress_columns(), console=console, transient=True, disable=not console.is_terminal) as bar:
        tasks: dict[str, Any] = {}

        def progress(step: str, done: int, total: int) -> None:
            if step not in tasks:
                tasks[step] = bar.add_task(step, total=total)
            bar.update(tasks[step], completed=done, total=total, visible=done < total)

        def on_step(step: "ReplayStep") -> None:
            if step.done == 1:
                console.print(HEADING, style="bold")
            console.print(step_line(step))
            progress("replaying", step.done, step.total)

        yield progress, on_step


def step_line(step: "ReplayStep") -> "Text":
    """The estimate after an event, on one line of at most 80 columns (reasons may be longer)."""
    from rich.text import Text

    from fgreg.cli.report import STYLES
    from fgreg.model.events import CameraMovedEvent, PairEvent
    from fgreg.pipeline.replay import describe

    known, answer = step.estimate, step.answer
    line = Text(f"{step.event.t:9.2f}  ")
    if answer is not None and answer.stage_rad is not None and answer.sigma_rad is not None:
        turn, sigma = math.degrees(answer.stage_rad), math.degrees(answer.sigma_rad)
        return line.append(f"{f'track: stage to {turn:.1f} +- {sigma:.1f} deg (1 sigma)':<30}", style="cyan")
    if answer is not None or step.refused:
        return line.append("".join(c if c.isprintable() else "?" for c in describe(step)), style="dim")
    line.append(f"{describe(step):<30.30}", style="bold" if isinstance(step.event, CameraMovedEvent) else "")
    if known is not None:
        nis = known.nis if isinstance(step.event, PairEvent) else None
        worst = None if known.predicted_tre is None else known.predicted_tre.worst_mm
        line.append(f" {known.epoch:5d} {known.pairs:5d} {_figure(nis, 1)}  {_figure(worst, 2)}  ")
        if known.trus_T_camera is None:
            line.append("none yet", style="dim")
        else:
            line.append(known.verdict.value, style=STYLES[known.verdict])
        if step.noticed:
            line.append("\n           the camera has moved: a new epoch begins", style="bold")
    return line


def _figure(value: float | None, decimals: int) -> str:
    if value is None:
        return f"{'-':>6}"
    return f"{value:6.{decimals}f}" if value < 1000 else f"{'>999':>6}"
