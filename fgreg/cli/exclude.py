"""The commands ``fgreg exclude`` and ``fgreg include``."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgreg.cli.options import warn
from fgreg.errors import InputError

if TYPE_CHECKING:
    from fgreg.pipeline.exclude import ShotNames

SessionArgument = Annotated[Path, typer.Argument(metavar="SESSION", help="Folder of the session.")]
PmOption = Annotated[str | None, typer.Option("--pm", metavar="N,N", help="All looks at these PMs up to now.")]
AimOption = Annotated[
    str | None,
    typer.Option("--aim", metavar="N,N", help="These aims, by their place among the session's aims, from 0."),
]
PointOption = Annotated[
    str | None,
    typer.Option("--point", metavar="N,N", help="These known points, by their place among the session's, from 0."),
]
ReasonOption = Annotated[str, typer.Option("--reason", metavar="TEXT", help="Why; it is recorded.")]
ByOption = Annotated[str, typer.Option("--by", metavar="NAME", help="Who decides it; it is recorded.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="No text.")]


def shot_names(pms: str | None, aims: str | None, points: str | None, prefix: str = "--") -> "ShotNames":
    """Shots as options name them; ``prefix`` of these. Raises InputError."""
    from fgreg.pipeline.exclude import ShotNames

    named = (("pm", pms), ("aim", aims), ("point", points))
    return ShotNames(*(_numbers(f"{prefix}{what}", text) for what, text in named))


def _numbers(option: str, text: str | None) -> tuple[int, ...]:
    """The numbers of ``3,7``; none where the option is not given."""
    parts = [] if text is None else [part.strip() for part in text.split(",")]
    for part in parts:
        if not (part.isascii() and part.isdigit() and len(part) < 10):
            raise InputError(option, text or "nothing", "numbers with commas between, such as 3,7")
    return tuple(int(part) for part in parts)


def add_exclude(app: typer.Typer) -> None:
    """Register the commands."""

    @app.command()
    def exclude(
        session: SessionArgument,
        pm: PmOption = None,
        aim: AimOption = None,
        point: PointOption = None,
        reason: ReasonOption = "",
        by: ByOption = "",
        quiet: QuietOption = False,
    ) -> None:
        """Leave shots of a session out by hand. That is recorded as an event; nothing is deleted.

        They take no part in solves and replays from then on. The result lists them with the reason, and its verdict is
        a warning at best, since no test sees what they say against the registration. For one solve only: fgreg solve
        SESSION --without-pm 3,7.

        Try: fgreg exclude SESSION --pm 3 --reason "the fibre was bumped"
        """
        _record(session, shot_names(pm, aim, point), reason, by, include=False, quiet=quiet)

    @app.command()
    def include(
        session: SessionArgument,
        pm: PmOption = None,
        aim: AimOption = None,
        point: PointOption = None,
        reason: ReasonOption = "",
        by: ByOption = "",
        quiet: QuietOption = False,
    ) -> None:
        """Take back that shots of a session are left out by hand (fgreg exclude). That is recorded, too."""
        _record(session, shot_names(pm, aim, point), reason, by, include=True, quiet=quiet)


def _record(session: Path, names: "ShotNames", reason: str, by: str, *, include: bool, quiet: bool) -> None:
    from fgreg.cli.report import clean
    from fgreg.pipeline.exclude import record_choice

    if not names:
        raise InputError("--pm, --aim and --point", "nothing", "the shots that are meant, such as --pm 3,7")
    left = record_choice(session, names, reason=reason, by=by, include=include, warn=warn)
    if quiet:
        return
    if not left:
        typer.echo(f"{session}: no shot is left out by hand")
    for shot in left:
        typer.echo(f"{session}: {shot.name} at {shot.t:.1f} s: {clean(shot.text)}")
    typer.echo(f"Now solve it again: fgreg solve {shlex.quote(str(session))}")
