"""The command ``fgreg report``."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Annotated

import typer

from fgreg.cli.options import warn_of_leftovers

Progress = Callable[[str, int, int], None]
ProgressBar = Callable[[bool], AbstractContextManager[Progress]]
EXIT_REFUSED = 1


def add_report(app: typer.Typer, progress_bar: ProgressBar) -> None:
    """Register the command; ``progress_bar(quiet)`` shows progress on standard error."""

    @app.command()
    def report(
        session: Annotated[Path, typer.Argument(metavar="SESSION", help="Folder of the solved session.")],
        out: Annotated[
            Path | None, typer.Option("--out", metavar="FILE", help="The report. Default: SESSION/report.html.")
        ] = None,
        result: Annotated[
            Path | None, typer.Option("--result", metavar="FILE", help="Its result. Default: SESSION/result.yaml.")
        ] = None,
        pdf: Annotated[
            Path | None, typer.Option("--pdf", metavar="FILE", help="Also print it to PDF, by this machine's Chromium.")
        ] = None,
        with_3d: Annotated[
            Path | None,
            typer.Option(
                "--with-3d",
                metavar="RRD",
                help="Put this recording (fgreg solve --rrd RRD) and its viewer into the file, some 27 MB.",
            ),
        ] = None,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, and no text.")] = False,
    ) -> None:
        """A solved session as one HTML file to hand on: verdict, errors at the targets, every shot, what to do next.

        The file needs no network, and opens in any browser. All figures are those of SESSION/result.yaml (fgreg solve
        SESSION), which has to be of the session as it is. The same session and version give the same file, byte by
        byte. Exit status 1 where the verdict is refused.

        Try: fgreg solve SESSION && fgreg report SESSION --pdf report.pdf
        """
        from fgreg.errors import InputError
        from fgreg.html_report.words import ANSWER
        from fgreg.model.estimate import Verdict
        from fgreg.pipeline.html_report import ReportRequest, report_session

        warn_of_leftovers(session, out, pdf)
        for option, path, ending in (("--out", out, ".html"), ("--pdf", pdf, ".pdf")):
            if path is not None and path.suffix.lower() != ending:
                raise InputError(option, f"a name that ends in {path.suffix or 'nothing'}", f"one in {ending}")
        with progress_bar(quiet) as progress:
            written = report_session(ReportRequest(session, out, result, pdf, with_3d), progress)
        if not quiet:
            verdict = ANSWER[written.estimate.verdict].lower()
            typer.echo(f"{written.out}: {1e-6 * written.size:.1f} MB; turn the probe by this registration: {verdict}")
            if pdf is not None:
                typer.echo(f"{pdf}: printed")
        if written.estimate.verdict is Verdict.REFUSED:
            raise typer.Exit(EXIT_REFUSED)
