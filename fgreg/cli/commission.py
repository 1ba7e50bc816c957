"""The command ``fgreg commission``."""

import json
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fgreg.cli.options import ExecutorOption, JobsOption, processes, warn, warn_of_leftovers
from fgreg.errors import InputError

if TYPE_CHECKING:
    from fgreg.model.systematic import ConstantText
    from fgreg.pipeline.commission import CommissionedSession, CommissionReport
    from fgreg.registration.commissioning import Chart

Progress = Callable[[str, int, int], None]
ProgressBar = Callable[[bool], AbstractContextManager[Progress]]
EXIT_ALARM = 1
NAMED_Z = 2.0
"""Constants that the line of a note or an alarm names: those beyond this, and the farthest one."""


def add_commission(app: typer.Typer, progress_bar: ProgressBar) -> None:
    """Register the command; ``progress_bar(quiet)`` shows progress on standard error."""

    @app.command()
    def commission(
        sessions: Annotated[list[Path], typer.Argument(metavar="SESSION", help="Folders of sessions of one rig.")],
        out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="The rig's file to write.")] = None,
        check: Annotated[
            Path | None,
            typer.Option("--check", metavar="RIG", help="Compare the sessions with this rig; nothing is written."),
        ] = None,
        checks: Annotated[bool, typer.Option("--checks", help="Use the check points of the sessions as data.")] = False,
        jobs: JobsOption = None,
        executor: ExecutorOption = "local",
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, and no summary.")] = False,
    ) -> None:
        """Find the constants of a rig from several of its sessions, or compare a session with a rig.

        All sessions are solved together: one graph, in which radius, sound speed, tilts, print sizes and the other
        constants are common. Writes them with their covariance to FILE, which a session.yaml takes up by rig: FILE.
        With --check: pass, note or alarm for each session, as on a control chart. Exit status 1 where there is an
        alarm, or where a session to compare is refused.
        """
        from fgreg.cli.executors import open_executor
        from fgreg.model.plausible import implausible_rig
        from fgreg.pipeline.commission import STEP, check_session_against, commission_sessions
        from fgreg.registration.commissioning import ChartVerdict
        from fgreg.session.rig_file import read_rig
        from fgreg.workers.tasks import run_tasks

        workers = processes(jobs)
        if (out is None) == (check is None):
            found = "nothing" if out is None else "both"
            raise InputError("--out, --check", found, "one of the two")
        if out is not None:
            warn_of_leftovers(out)
            with progress_bar(quiet or as_json) as progress, open_executor(executor) as where:
                report = commission_sessions(
                    sessions, out, use_checks=checks, jobs=workers, executor=where, progress=progress
                )
            _warn(report.sessions, implausible_rig(report.rig, str(out)))
            if as_json:
                typer.echo(json.dumps(report_dict(report), indent=2))
            elif not quiet:
                print_report(report)
            if any(one.chart is not None and one.chart.verdict is ChartVerdict.ALARM for one in report.sessions):
                raise typer.Exit(EXIT_ALARM)
            return
        assert check is not None
        rig = read_rig(check)
        compare = partial(check_session_against, rig, use_checks=checks)
        with progress_bar(quiet or as_json) as progress, open_executor(executor) as where:
            step = partial(progress, STEP)
            compared = list(run_tasks(compare, sessions, jobs=workers, executor=where, progress=step))
        _warn(compared, implausible_rig(rig, str(check)))
        names = list(rig.names)
        if as_json:
            typer.echo(json.dumps({"sessions": [session_dict(one, names) for one in compared]}, indent=2))
        elif not quiet:
            for one in compared:
                typer.echo(session_line(one, names))
        if any(one.chart is None or one.chart.verdict is ChartVerdict.ALARM for one in compared):
            raise typer.Exit(EXIT_ALARM)


def _warn(sessions: "Iterable[CommissionedSession]", of_rig: Iterable[str]) -> None:
    for warning in of_rig:
        warn(warning)
    for session in sessions:
        for warning in session.warnings:
            warn(f"{session.folder}: {warning}")


def print_report(report: "CommissionReport") -> None:
    """The report for a terminal."""
    used = sum(not one.reason for one in report.sessions)
    typer.echo(f"{report.out}: {len(report.constants)} constants of the rig from {used} sessions")
    for condition in report.conditions:
        typer.echo(f"  - {condition}")
    width = max(len(c.name) for c in report.constants) + 3
    for title, by_sessions in (("Observed by the sessions", True), ("Held by their prior", False)):
        mine = [c for c in report.constants if c.by_sessions is by_sessions]
        if mine:
            heads = ("value", "1 sigma", "prior 1 s.", "observed")
            typer.echo(f"\n{title:<{width}}" + "".join(f"{head:>10}" for head in heads))
        for c in sorted(mine, key=lambda c: -c.observed):
            factor, name = (1.0, c.name) if _unit(c.name) else (100.0, f"{c.name}, %")
            figures = "".join(f"{factor * figure:10.3f}" for figure in (c.value, c.sigma, c.prior_sigma))
            line = f"  {name:<{width - 2}}{figures}{100 * c.observed:8.0f} %"
            typer.echo(line + (f"  (against {c.together})" if c.together else ""))
    names = [c.name for c in report.constants]
    typer.echo("\nEach session against the others")
    for one in report.sessions:
        typer.echo(f"  {session_line(one, names)}")


def session_line(session: "CommissionedSession", names: list[str]) -> str:
    """One line on a session against a rig."""
    head = f"{session.name} ({session.folder}):"
    if session.reason:
        return f"{head} left out, refused: {session.reason}"
    chart = session.chart
    if chart is None:
        return f"{head} the only one"
    text = f"{head} {chart.verdict.value}, chi square {chart.chi_square:.1f} of {chart.degrees_of_freedom}"
    if chart.verdict.value == "pass":
        return text
    largest = max(abs(float(z)) for z in chart.z)
    order = sorted(range(len(names)), key=lambda k: -abs(float(chart.z[k])))
    named = [k for k in order if abs(float(chart.z[k])) >= min(max(NAMED_Z, 0.8 * largest), largest)][:3]
    said = []
    for k in named:
        factor = _text(names[k]).per_unit if _unit(names[k]) else 100.0
        change, sigma = (f"{factor * size:.2g}" for size in (chart.change[k], chart.change_sigma[k]))
        said.append(f"{names[k]} changed by {change} +- {sigma} {_unit(names[k]) or '%'} (1 sigma; z {chart.z[k]:.1f})")
    return f"{text}: {' or '.join(said)}"


def _text(name: str) -> "ConstantText":
    from fgreg.model.systematic import TEXTS

    return next(text for text in TEXTS if text.name == name)


def _unit(name: str) -> str:
    return _text(name).unit


def report_dict(report: "CommissionReport") -> dict[str, Any]:
    """The report as plain data."""
    constants = [
        {
            "name": c.name,
            "value": c.value,
            "sigma": c.sigma,
            "prior_sigma": c.prior_sigma,
            "observed": round(c.observed, 4),
            "held_by": "sessions" if c.by_sessions else "prior",
            "score": c.score,
            "together": c.together or None,
        }
        for c in report.constants
    ]
    names = [c.name for c in report.constants]
    return {
        "rig": str(report.out),
        "constants": constants,
        "conditions": list(report.conditions),
        "sessions": [session_dict(one, names) for one in report.sessions],
    }


def session_dict(session: "CommissionedSession", names: list[str]) -> dict[str, Any]:
    """A session against a rig as plain data."""
    out: dict[str, Any] = {"session": session.name, "folder": str(session.folder), "used": not session.reason}
    if session.reason:
        return {**out, "reason": session.reason}
    return out if session.chart is None else {**out, **_chart_dict(session.chart, names)}


def _chart_dict(chart: "Chart", names: list[str]) -> dict[str, Any]:
    constants = []
    for k, name in enumerate(names):
        unit = _text(name).per_unit
        seen = bool(chart.change_sigma[k] < float("inf"))
        constants.append(
            {
                "name": name,
                "z": float(chart.z[k]),
                "change": float(chart.change[k] * unit) if seen else None,
                "change_sigma": float(chart.change_sigma[k] * unit) if seen else None,
            }
        )
    return {
        "verdict": chart.verdict.value,
        "chi_square": chart.chi_square,
        "degrees_of_freedom": chart.degrees_of_freedom,
        "constants": constants,
    }
