"""The command ``fgreg print``."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from fgreg.cli.options import refuse_given, warn, warn_of_leftovers
from fgreg.errors import InputError
from fgreg.printing.paper import Paper

_HELP = """Print the fibre's marker or the calibration board: a PDF, true to size, and its lines of session.yaml.

\b
What a session.yaml describes:
  fgreg print marker marker.pdf --setup session.yaml
  fgreg print board board.pdf --setup session.yaml --paper letter
\b
One tag of 25 mm; four on a plate; six around a rod of 20 mm (a strip to fold, the
largest tags that fit):
  fgreg print marker tag.pdf --dictionary DICT_4X4_50 --id 0 --size-mm 25
  fgreg print marker plate.pdf --dictionary DICT_4X4_50 --id 0-3 --size-mm 12
  fgreg print marker rod.pdf --dictionary DICT_4X4_50 --id 0-5 --rod-mm 20
\b
A ChArUco board of 10 x 7 squares, which has 9 x 6 inner corners; without --dictionary
a plain chessboard:
  fgreg print board board.pdf --columns 9 --rows 6 --square-mm 10 \\
    --dictionary DICT_5X5_100 --marker-mm 7
\b
Print at 100 % ("actual size"), never fitted to the page, and measure the two bars of
100 mm on the page: they say whether the printer is true to size both ways. 0.3 mm off puts
a tag 0.3 % too near or too far; print again, or correct the sizes in session.yaml. The
lines for session.yaml are on the page and on standard output.
\b
A tag should be 40 px wide or more in the camera's picture. Where marker and board are of
one dictionary, give the marker an id that the board does not have.
"""


class What(StrEnum):
    """What is printed."""

    MARKER = "marker"
    BOARD = "board"


def add_print(app: typer.Typer) -> None:
    """Register the command."""

    @app.command(name="print", help=_HELP)
    def print_(
        what: Annotated[What, typer.Argument(metavar="marker|board", help="What to print.")],
        out: Annotated[Path, typer.Argument(metavar="OUT.pdf", help="File to write.")],
        setup: Annotated[
            Path | None,
            typer.Option("--setup", metavar="FILE", help="session.yaml (or its folder) that describes it."),
        ] = None,
        dictionary: Annotated[
            str | None, typer.Option("--dictionary", metavar="NAME", help="OpenCV's name, such as DICT_4X4_50.")
        ] = None,
        ids: Annotated[str | None, typer.Option("--id", metavar="IDS", help="Of the tags: 0, or 0,2,4-6.")] = None,
        size_mm: Annotated[
            float | None, typer.Option("--size-mm", help="Of a tag: outer edge of its black border.")
        ] = None,
        rod_mm: Annotated[
            float | None, typer.Option("--rod-mm", help="Diameter of a rod that the tags go around, one on each side.")
        ] = None,
        thickness_mm: Annotated[
            float | None, typer.Option("--thickness-mm", help="Of the paper around a rod, with its glue. Default: 0.1.")
        ] = None,
        columns: Annotated[
            int | None, typer.Option("--columns", help="Inner corners along a row of the board.")
        ] = None,
        rows: Annotated[int | None, typer.Option("--rows", help="Rows of inner corners.")] = None,
        square_mm: Annotated[float | None, typer.Option("--square-mm", help="Edge of a square of the board.")] = None,
        marker_mm: Annotated[
            float | None, typer.Option("--marker-mm", help="Outer edge of a marker of a ChArUco board.")
        ] = None,
        legacy: Annotated[
            bool, typer.Option("--legacy", help="The ChArUco pattern of OpenCV before 4.6 (board.charuco.legacy).")
        ] = False,
        quiet_mm: Annotated[
            float | None,
            typer.Option(
                "--quiet-mm",
                help="White around each tag (default: one of its cells) or around the board (half a square; one of a "
                "plain chessboard).",
            ),
        ] = None,
        paper: Annotated[Paper, typer.Option("--paper", help="a4 or letter.")] = Paper.A4,
        cut_marks: Annotated[
            bool, typer.Option("--cut-marks/--no-cut-marks", help="Marks at the corners to cut along.")
        ] = True,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Write the file only.")] = False,
    ) -> None:
        from fgreg.model.plausible import implausible
        from fgreg.output.atomic_file import check_output, write_file
        from fgreg.printing.compose import board_sheet, marker_sheet
        from fgreg.printing.options import board_of, checked, marker_of, section_of
        from fgreg.printing.sheets import PRINT_FILE, pdf_of
        from fgreg.schema.kinds import NOISE_MM

        warn_of_leftovers(out)
        if out.suffix.lower() != ".pdf":
            raise InputError(str(out), f"a name that ends in {out.suffix or 'nothing'}", "one in .pdf")
        check_output(out, PRINT_FILE)
        of_marker = {"--id": ids, "--size-mm": size_mm, "--rod-mm": rod_mm, "--thickness-mm": thickness_mm}
        of_board = {"--columns": columns, "--rows": rows, "--square-mm": square_mm, "--marker-mm": marker_mm}
        of_board["--legacy"] = legacy or None
        if what is What.MARKER:
            refuse_given(of_board, "it with a marker", "it with a board only")
        else:
            refuse_given(of_marker, "it with a board", "it with a marker only")
        if setup is not None:
            both = {"--dictionary": dictionary, **of_marker, **of_board}
            refuse_given(both, f"it, and a {what} in {setup.name}", "one of the two")
        margin = None if quiet_mm is None else checked("--quiet-mm", NOISE_MM, quiet_mm)
        if what is What.BOARD:
            board = section_of(setup, "board") if setup else board_of(dictionary, of_board)
            doubts, sheet = implausible(board), board_sheet(board, margin, paper, cut_marks)
        else:
            marker = section_of(setup, "marker") if setup else marker_of(dictionary, of_marker, margin)
            doubts, sheet = implausible(marker), marker_sheet(marker, margin, paper, cut_marks)
        data, pages = pdf_of(sheet)
        write_file(out, data, PRINT_FILE)
        for doubt in doubts:
            warn(doubt)
        if not quiet:
            size = f"{pages} page{'s' if pages > 1 else ''} of {'A4' if paper is Paper.A4 else 'Letter'}"
            typer.echo(f"# {out}: {size}; print at 100 %, measure both bars of 100 mm. In session.yaml:")
            typer.echo("\n".join(sheet.yaml))
