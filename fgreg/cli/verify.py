"""The command ``fgreg verify``."""

import json
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fgreg.cli.options import EstimateOption, LimitOption, solve_config

if TYPE_CHECKING:
    from rich.console import RenderableType

    from fgreg.pipeline.verify import VerifyReport

Progress = Callable[[str, int, int], None]
ProgressBar = Callable[[bool], AbstractContextManager[Progress]]
EXIT_REFUSED = 1


def add_verify(app: typer.Typer, progress_bar: ProgressBar) -> None:
    """Register the command; ``progress_bar(quiet)`` shows progress on standard error."""

    @app.command()
    def verify(
        session: Annotated[Path, typer.Argument(metavar="SESSION", help="Folder of the registered session.")],
        new: Annotated[
            Path,
            typer.Argument(
                metavar="NEW",
                help="New shots: a session's folder of the same rig, or a file of JSON lines with one or more pair "
                "events as in events.jsonl.",
            ),
        ],
        limit_mm: LimitOption = 3.0,
        estimate: EstimateOption = "",
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, and no text.")] = False,
    ) -> None:
        """Is a finished registration still valid? Compare new shots with it; nothing is added to it.

        Needs SESSION/result.yaml (fgreg solve SESSION). Says valid, moved (the camera moved: register again), degraded
        (the shots do not fit, and a camera move does not explain it better than wrong detections: look at fibre, marker
        and probe) or cannot tell, with the odds. False alarms: 1 %.

        One first-hit shot shows a shift of 5 mm, but never a turn about its own spot: alone it finds what has changed,
        but cannot tell that nothing has. Three to six shots, at other spots and from other sides, can.

        Exit status 0 for valid and for cannot tell, 1 for moved and degraded, 2 for bad input.

        Try: fgreg verify SESSION shots.jsonl --json
        """
        from fgreg.camera_moves.validity import Validity
        from fgreg.pipeline.verify import verify_session

        config = solve_config(limit_mm, estimate)
        with progress_bar(quiet or as_json) as progress:
            report = verify_session(session, new, config, progress)
        if as_json:
            typer.echo(json.dumps(report_dict(report), indent=2))
        elif not quiet:
            _print(report)
        if report.verification.validity in (Validity.MOVED, Validity.DEGRADED):
            raise typer.Exit(EXIT_REFUSED)


def report_dict(report: "VerifyReport") -> dict[str, Any]:
    """The report as plain types; figures that are not finite are None."""
    found = report.verification

    def plain(value: float) -> float | None:
        return value if math.isfinite(value) else None

    return {
        "session": report.session,
        "registration": report.registered.value,
        "new": str(report.new),
        "verdict": found.validity.value,
        "reason": found.reason,
        "log_odds_moved": plain(found.log_odds),
        "p": found.p,
        "shots": [
            {"pm": shot.pm, "nis": shot.nis, "degrees_of_freedom": shot.equations, "p": shot.p, "used": shot.used}
            for shot in found.shots
        ],
        "unused": [{"t": shot.t, "pm": shot.pm, "reason": shot.reason} for shot in report.unused],
        "shown": {"shift_mm": plain(found.shift_mm), "turn_deg": plain(math.degrees(found.turn_rad))},
        "elapsed_s": report.elapsed_s,
    }


def _print(report: "VerifyReport") -> None:
    """The verdict, its reason and the shots."""
    from rich.console import Console, Group
    from rich.text import Text

    from fgreg.camera_moves.validity import Validity
    from fgreg.cli.report import MEANINGS, bullet, clean, print_plain
    from fgreg.model.estimate import Verdict

    styles = {Validity.VALID: "bold green", Validity.CANNOT_TELL: "bold yellow"}
    found = report.verification
    word = Text(f" {found.validity.value.upper()} ", style=f"{styles.get(found.validity, 'bold red')} reverse")
    parts: list[RenderableType] = [Text.assemble(word, " ", (clean(report.session), "bold"))]
    parts.append(bullet(found.reason))
    if report.registered is not Verdict.OK:
        parts.append(
            bullet(f"the registration's own verdict is {report.registered.value}: {MEANINGS[report.registered]}")
        )
    for shot in found.shots:
        left = "" if shot.used else ", left out"
        parts.append(
            Text(f"  PM {shot.pm}: NIS {shot.nis:.1f} for {shot.equations} degrees of freedom, p {shot.p:.2g}{left}")
        )
    parts += [bullet(f"PM {shot.pm}, {shot.t:.1f} s, not used: {shot.reason}") for shot in report.unused]
    print_plain(Group(*parts), Console(highlight=False, emoji=False))
