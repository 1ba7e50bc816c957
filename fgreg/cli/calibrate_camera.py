"""The command ``fgreg calibrate-camera``."""

import json
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fgreg.cli.options import warn, warn_of_leftovers
from fgreg.errors import InputError

if TYPE_CHECKING:
    from fgreg.calibration.check import CameraCheck, Change
    from fgreg.geometry.transforms import IntArray
    from fgreg.model.session_model import BoardModel
    from fgreg.pipeline.calibrate_camera import CalibrationReport, FoundViews

Progress = Callable[[str, int, int], None]
ProgressBar = Callable[[bool], AbstractContextManager[Progress]]
EXIT_CHANGED = 1
MOST_VIEWS = 8
"""Views that the text lists: those with the largest residuals."""

_HELP = """Calibrate the endoscope from pictures or video of the ChArUco board, or check a calibration.

\b
Pictures: a folder with left/ and right/, two folders, two patterns or two videos
(pictures with one number belong together), or one with both views in each frame:
  fgreg calibrate-camera pictures/ --setup session.yaml --out camera.yaml
  fgreg calibrate-camera left.mp4 right.mp4 --setup session.yaml --out camera.yaml
  fgreg calibrate-camera both.mp4 --layout side-by-side --setup session.yaml --out camera.yaml
The board is that of session.yaml, or of options:
  ... --columns 9 --rows 6 --square-mm 10 --dictionary DICT_5X5_100 --marker-mm 7
Then: cat camera.yaml >> session.yaml   (one without camera: and systematic:)
Before a session, 3 to 6 new views:
  fgreg calibrate-camera new/ --check camera.yaml --setup session.yaml
\b
How to take the views: 20 to 40 pairs. Glue the board to something flat. Fix zoom and
focus as in the session and let the endoscope warm up. Hold the board still for each
picture. Fill the picture with it, and go into each corner; tilt it by 20 to 40 degrees
to the left, right, up and down, and turn it about the line of sight; from the nearest
distance of use to the farthest. Frontal views alone do not tell the focal length.
\b
What it says: coverage (a map of where corners were seen), the residual of each view,
and every other view against the views between: the same pixels, located by both
halves. That figure counts, not the residual, which is small for poor views too.
Parameters that the views do not determine are named. The sigmas under systematic: are
those of these views. Heat, focus and shocks come on top: that is what --check is for.
The board's size is taken as true (--scale-sigma): measure the print.
\b
Exit status 0 done, 1 --check says changed, 2 bad input.
"""


def add_calibrate_camera(app: typer.Typer, progress_bar: ProgressBar) -> None:
    """Register the command; ``progress_bar(quiet)`` shows progress on standard error."""

    @app.command(name="calibrate-camera", help=_HELP)
    def calibrate_camera_(
        pictures: Annotated[
            list[Path],
            typer.Argument(
                metavar="PICTURES", help="Of the left camera, then of the right: folders, 'left/*.png', videos."
            ),
        ],
        out: Annotated[
            Path | None, typer.Option("--out", metavar="FILE", help="The camera's lines of session.yaml to write.")
        ] = None,
        check: Annotated[
            Path | None,
            typer.Option(
                "--check",
                metavar="FILE",
                help="Compare the views with this calibration: a file of --out, a session.yaml, or a calibration of "
                "OpenCV, ROS, Kalibr, MATLAB; nothing is written.",
            ),
        ] = None,
        setup: Annotated[
            Path | None,
            typer.Option("--setup", metavar="FILE", help="session.yaml (or its folder, or a file with board:)."),
        ] = None,
        columns: Annotated[int | None, typer.Option("--columns", help="Inner corners of the board along x.")] = None,
        rows: Annotated[int | None, typer.Option("--rows", help="Inner corners along y.")] = None,
        square_mm: Annotated[float | None, typer.Option("--square-mm", help="Edge of a square, measured.")] = None,
        dictionary: Annotated[
            str | None, typer.Option("--dictionary", metavar="NAME", help="Of a ChArUco board: DICT_5X5_100.")
        ] = None,
        marker_mm: Annotated[float | None, typer.Option("--marker-mm", help="Edge of its markers.")] = None,
        legacy: Annotated[bool, typer.Option("--legacy", help="The pattern of OpenCV before 4.6.")] = False,
        model: Annotated[
            str, typer.Option("--model", help="Lens: pinhole5, pinhole8 (rational) or fisheye, as OpenCV has them.")
        ] = "pinhole5",
        layout: Annotated[
            str | None, typer.Option("--layout", help="Of one source: side-by-side, top-bottom, or mono (one camera).")
        ] = None,
        most_views: Annotated[int, typer.Option("--most-views", help="Of more, those least alike are used.")] = 60,
        scale_sigma: Annotated[
            float, typer.Option("--scale-sigma", help="1 sigma of the board's size, relative.")
        ] = 0.002,
        limit_mm: Annotated[
            float, typer.Option("--limit-mm", help="With --check: error of located points (RMS) that matters.")
        ] = 0.5,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, and no text.")] = False,
    ) -> None:
        from fgreg.calibration.check import Validity
        from fgreg.convert.camera_file import read_board, read_camera
        from fgreg.drivers.endoscope import Layout
        from fgreg.drivers.stereo_recording import sources
        from fgreg.model.plausible import implausible
        from fgreg.pipeline.calibrate_camera import Pictures, calibrate_camera, check_camera

        if (out is None) == (check is None):
            raise InputError("--out, --check", "nothing" if out is None else "both", "one of the two")
        for option, value, least in (("--most-views", most_views, 3), ("--limit-mm", limit_mm, 1e-6)):
            if not (math.isfinite(value) and value >= least):
                raise InputError(option, str(value), f"a number >= {least}")
        if not 0.0 <= scale_sigma <= 1.0:
            raise InputError("--scale-sigma", str(scale_sigma), "a number from 0 to 1")
        left, right = sources(pictures)
        where = _layout(layout, right is not None)
        camera = None if check is None else read_camera(check)
        described = {
            "columns": columns,
            "rows": rows,
            "square_mm": square_mm,
            "charuco": _charuco(dictionary, marker_mm, legacy),
        }
        given = {key: value for key, value in described.items() if value is not None}
        if given and setup is not None:
            raise InputError("--setup", "it, and options of a board", "one of the two")
        if given:
            board = _board(given)
        elif setup is not None:
            board = read_board(setup)
        elif camera is not None and camera.board is not None:
            board = camera.board
        else:
            raise InputError(
                "--setup", "nothing", "a session.yaml with the board, or --columns, --rows and --square-mm"
            )
        for doubt in implausible(board):
            warn(doubt)
        chosen = Pictures(left, right, Layout(where), most_views)
        if camera is not None:
            with progress_bar(quiet or as_json) as progress:
                checked, views = check_camera(chosen, board, camera, limit_mm=limit_mm, progress=progress)
            if as_json:
                typer.echo(json.dumps(check_dict(checked, views), indent=2))
            elif not quiet:
                _print_check(checked, views)
            if checked.validity is Validity.CHANGED:
                raise typer.Exit(EXIT_CHANGED)
            return
        warn_of_leftovers(out)
        with progress_bar(quiet or as_json) as progress:
            report = calibrate_camera(chosen, board, out, model=model, scale_sigma=scale_sigma, progress=progress)
        for sentence in report.conditions:
            warn(sentence)
        if as_json:
            typer.echo(json.dumps(report_dict(report), indent=2))
        elif not quiet:
            _print_report(report)


def _layout(text: str | None, two: bool) -> str:
    known = ("side-by-side", "top-bottom", "mono")
    if text is None and not two:
        raise InputError("RIGHT", "nothing", "the right pictures, a folder with left/ and right/, or --layout")
    if text is None:
        return "separate"
    if text not in known or two:
        raise InputError(
            "--layout", f"{text} with two sources" if two else text, "one of " + ", ".join(known) + ", of one source"
        )
    return text


def _charuco(dictionary: str | None, marker_mm: float | None, legacy: bool) -> dict[str, Any] | None:
    if dictionary is None and marker_mm is None and not legacy:
        return None
    given = {"dictionary": dictionary, "marker_mm": marker_mm}
    return {key: value for key, value in given.items() if value is not None} | ({"legacy": True} if legacy else {})


def _board(given: dict[str, Any]) -> "BoardModel":
    from fgreg.model.session_model import BoardModel
    from fgreg.schema.problems import FieldError
    from fgreg.schema.record import record

    options = {"charuco": "dictionary"}
    try:
        board: BoardModel = record(BoardModel).read(given)
    except FieldError as error:
        problem = error.problems[0]
        key = str(problem.path[-1]) if problem.path else "columns"
        where = "--" + options.get(key, key).replace("_", "-")
        raise InputError(where, problem.found, problem.expected) from None
    return board


def report_dict(report: "CalibrationReport") -> dict[str, Any]:
    """The calibration as plain data; covariances and names are in the file."""
    from fgreg.calibration import parameters
    from fgreg.model.camera_model import STEREO_RIG
    from fgreg.pipeline.calibrate_camera import halves_dict

    unit = parameters.per_unit(report.rig)
    sigma = (report.covariance.diagonal() ** 0.5) * unit
    used = report.bundle.used
    return {
        "out": None if report.out is None else str(report.out),
        "camera": STEREO_RIG.write(report.rig),
        "systematic": report.systematic,
        "sigma": dict(zip(parameters.names(report.rig), map(float, sigma), strict=True)),
        "pictures": report.views.pictures,
        "not_found": list(report.views.not_found),
        "set_aside": report.views.set_aside,
        "corners": {"used": int(used.sum()), "left_out": int((~used).sum()), "sigma_px": report.bundle.sigma_px},
        "views": [
            {"name": name, "rms_px": {"left": _plain(pair[0]), "right": _plain(pair[1])}}
            for name, pair in zip(report.views.table.names, report.residuals_px, strict=True)
        ],
        "coverage": [counts.tolist() for counts in report.coverage],
        "halves": None if report.halves is None else halves_dict(report.halves),
        "conditions": list(report.conditions),
    }


def _plain(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _print_report(report: "CalibrationReport") -> None:
    from fgreg.calibration import parameters
    from fgreg.calibration.views import SIDES

    views, bundle = report.views, report.bundle
    typer.echo(
        f"{report.out}: {len(views.table.names)} views of {views.pictures}, {int(bundle.used.sum())} corners "
        f"({int((~bundle.used).sum())} left out), {bundle.sigma_px:.3f} px (1 sigma, each axis)"
    )
    sigma = report.covariance.diagonal() ** 0.5
    columns = parameters.lens_columns(report.rig)
    for side, camera, own in zip(SIDES, parameters.cameras(report.rig), columns, strict=False):
        typer.echo(f"\n{side:<24}{'value':>12}{'1 sigma':>12}")
        names = parameters.names(report.rig)[own]
        for name, value, one in zip(names, parameters.lens_vector(camera), sigma[own], strict=True):
            typer.echo(f"  {name.partition('.')[2]:<22}{value:12.4f}{one:12.4f}")
    if report.rig.right_T_left is not None:
        pose = report.rig.right_T_left
        turn, shift = (sigma[-6:-3] * math.degrees(1.0), sigma[-3:])
        typer.echo("\nright_T_left")
        typer.echo(f"  translation             {_row(pose[:3, 3])} mm, 1 sigma {_row(shift)}")
        typer.echo(f"  rotation, 1 sigma       {_row(turn)} deg")
    both = report.halves
    if both is not None:
        pixels = " and ".join(f"{value:.2f} px" for value in both.apart.rays_rms_px)
        where = (
            f"{both.apart.points_rms_mm:.2f} mm RMS, {both.apart.points_most_mm:.2f} mm at most; "
            if math.isfinite(both.apart.points_rms_mm)
            else ""
        )
        typer.echo(
            f"\nHalves of the views locate the same pixels apart by: {where}{pixels} in the pictures (p {both.p:.2g})"
        )
    for side, counts in zip(SIDES, report.coverage, strict=False):
        typer.echo(f"\nCorners in the {side} pictures (. none, + up to 9, # more)")
        for line in _map(counts):
            typer.echo(f"  {line}")
    order = sorted(range(len(views.table.names)), key=lambda v: -_largest(report.residuals_px[v]))
    typer.echo("\nResiduals, RMS px" + (f", the {MOST_VIEWS} largest" if len(order) > MOST_VIEWS else ""))
    for v in order[:MOST_VIEWS]:
        pair = ", ".join(
            f"{side} {value:.3f}"
            for side, value in zip(SIDES, report.residuals_px[v], strict=True)
            if math.isfinite(value)
        )
        typer.echo(f"  {views.table.names[v]}: {pair}")
    if views.not_found:
        typer.echo(f"\nThe board was not found in {len(views.not_found)}: {_some(views.not_found)}")
    lines = ", ".join(f"{key} {value:g}" for key, value in report.systematic.items())
    typer.echo(f"\nsystematic, 1 sigma: {lines}\nnext: append {report.out} to session.yaml, then fgreg check")


def _row(values: Any) -> str:
    return "  ".join(f"{value:.4f}" for value in values)


def _largest(pair: Any) -> float:
    return max((float(value) for value in pair if math.isfinite(value)), default=0.0)


def _some(names: tuple[str, ...], most: int = 5) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _map(counts: "IntArray") -> list[str]:
    return ["".join("." if n == 0 else "+" if n < 10 else "#" for n in row) for row in counts.tolist()]


def check_dict(checked: "CameraCheck", views: "FoundViews") -> dict[str, Any]:
    """A check as plain data."""
    from fgreg.model.systematic import TEXTS

    return {
        "verdict": checked.validity.value,
        "p": checked.p,
        "views": list(views.table.names),
        "not_found": list(views.not_found),
        "rms_px": checked.rms_px,
        "best_px": checked.best_px,
        "points_rms_mm": _plain(checked.apart.points_rms_mm),
        "points_most_mm": _plain(checked.apart.points_most_mm),
        "rays_rms_px": [_plain(value) for value in checked.apart.rays_rms_px],
        "noise": _plain(checked.noise_mm),
        "changes": [
            {
                "name": TEXTS[one.constant].name,
                "change": one.change * TEXTS[one.constant].per_unit,
                "sigma": one.sigma * TEXTS[one.constant].per_unit,
            }
            for one in checked.changes
        ],
    }


def _print_check(checked: "CameraCheck", views: "FoundViews") -> None:
    from fgreg.calibration.check import Validity

    meaning = {
        Validity.HOLDS: "the calibration may be used",
        Validity.CHANGED: "calibrate again, or find out what has moved: focus, zoom, heat, a shock",
        Validity.CANNOT_TELL: "these views say too little: take more, tilted and into the corners",
    }
    typer.echo(f"{checked.validity.value.upper()}: {meaning[checked.validity]}")
    apart, noise = checked.apart, checked.noise_mm
    if math.isfinite(apart.points_rms_mm):
        typer.echo(
            f"  located points would move by {apart.points_rms_mm:.2f} mm RMS ({apart.points_most_mm:.2f} at most); "
            f"noise alone: {noise:.2f} mm RMS"
        )
    typer.echo(
        f"  {len(views.table.names)} views: residual {checked.rms_px:.3f} px RMS as calibrated, {checked.best_px:.3f} "
        f"with cameras fitted to them; p {checked.p:.2g} that nothing has changed"
    )
    changes = sorted(checked.changes, key=lambda one: -abs(one.change / one.sigma))
    if checked.validity is Validity.CHANGED:
        for one in changes[:3]:
            typer.echo(f"  {_change(one)}")


def _change(one: "Change") -> str:
    from fgreg.model.systematic import TEXTS

    text = TEXTS[one.constant]
    unit, name = (text.per_unit, text.unit) if text.unit else (100.0, "%")
    return f"{text.what} by {one.change * unit:.2g} +- {one.sigma * unit:.2g} {name} (1 sigma)"
