"""The command ``fgreg convert``."""

import os
import shlex
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgreg.cli.options import refuse_given, warn, warn_of_leftovers
from fgreg.errors import InputError
from fgreg.schema.limits import RECORDING_MEMORY, memory_at_most

if TYPE_CHECKING:
    from fgreg.convert.drafts import Imported
    from fgreg.convert.mapping import RecordingMapping

Progress = Callable[[str, int, int], None]
ProgressBar = Callable[[bool], AbstractContextManager[Progress]]

_HELP = """Convert recordings to sessions, and results to files for other programs.

\b
A recording, with the session.yaml of its set-up:
  fgreg convert shots.csv   OUT --setup session.yaml   CSV: one row, one event
  fgreg convert bag/        OUT --setup session.yaml   ROS: rosbag2 folder, .mcap, .db3, .bag (ROS 1)
  fgreg convert scan.mha    OUT --setup session.yaml   PLUS sequence (.mha, .mhd, .nrrd)
  fgreg convert shots.mat   OUT --setup session.yaml   MATLAB, HDF5, IPASC, UFF: variables
\b
A result (a session's folder, or its result.yaml), by the ending of OUT:
  fgreg convert SESSION registration.xml    PLUS: <Transform From="Camera" To="Trus">, mm
  fgreg convert SESSION registration.yaml   ROS 2: TransformStamped trus -> camera, m
  fgreg convert SESSION registration.tfm    3D Slicer: linear transform CameraToTrus
  fgreg convert SESSION registration.json   all of it: covariance, verdict, reasons
\b
Where session.yaml has no camera, --calibration FILE provides it: ROS camera_info or
ost.txt (left and right: give the option twice), OpenCV FileStorage, Kalibr camchain,
scikit-surgery's .l2r.txt, MATLAB's struct (.json, .mat). Files that do not state the size of
the images need --calibration-size. A ROS 2 recording with camera_info topics needs none.
\b
Columns, topics and fields have usual names: a CSV has t, type (pair where absent),
pm, scan_deg, x_mm, range_mm or frame, sweep, camera_T_marker (16 numbers) or
marker_x_mm ... marker_qw, or left and right (pictures); sessions/README.md lists all.
Others are named in a mapping (--map):
  format: fgreg-mapping/1
  columns: {t: time_s, scan_deg: {column: angle_rad, scale: 57.29577951}}
  topics: {marker: /marker/pose, scan: /stage/joint_states, frame: /probe/channels}
  fields: {marker: NeedleToCameraTransform, scan: StageAngle}
  images: envelope      (of PLUS; or log, or channels: data of the single elements)
\b
What lacks its marker or stage angle is left out with a warning. A result with the verdict
refused, or made from other files than those that are there now, is exported with --force
only, and the file says so.
"""


def add_convert(app: typer.Typer, progress_bar: ProgressBar) -> None:
    """Register the command; ``progress_bar(quiet)`` shows progress on standard error."""

    @app.command(help=_HELP)
    def convert(
        source: Annotated[Path, typer.Argument(metavar="SOURCE", help="A recording, or a result.")],
        out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder of the new session, or file to write.")],
        setup: Annotated[
            Path | None, typer.Option("--setup", metavar="FILE", help="session.yaml of a new session (or its folder).")
        ] = None,
        mapping: Annotated[
            Path | None, typer.Option("--map", metavar="FILE", help="Names of the columns, topics or fields.")
        ] = None,
        calibration: Annotated[
            list[Path] | None,
            typer.Option("--calibration", metavar="FILE", help="Of the endoscope, where session.yaml has no camera."),
        ] = None,
        unit: Annotated[
            str | None, typer.Option("--calibration-unit", metavar="m|mm", help="Of the calibration's lengths.")
        ] = None,
        size: Annotated[
            str | None, typer.Option("--calibration-size", metavar="WxH", help="Of the images, px, where no file says.")
        ] = None,
        rectified: Annotated[
            bool, typer.Option("--rectified", help="The images were rectified with this calibration.")
        ] = False,
        epoch: Annotated[int | None, typer.Option("--epoch", help="Of a result; default: the last one.")] = None,
        force: Annotated[
            bool, typer.Option("--force", help="Export a result that is refused or stale, marked as such.")
        ] = False,
        overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing OUT.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No summary.")] = False,
    ) -> None:
        warn_of_leftovers(source, out)
        result = _result_file(source)
        if result is not None:
            unused = {"--setup": setup, "--map": mapping, "--calibration": calibration or None}
            refuse_given(unused, "it with a result", "it with a recording only")
            line = _export(result, out, epoch, force, overwrite)
            if not quiet:
                typer.echo(line)
            return
        results_only = {"--epoch": epoch, "--force": force or None}
        refuse_given(results_only, "it with a recording", "it with a result only")
        if setup is None:
            raise InputError("--setup", "nothing", "the session.yaml of the set-up")
        _import(source, out, setup, mapping, calibration or [], unit, size, rectified, overwrite, quiet, progress_bar)


def _result_file(source: Path) -> Path | None:
    """The result file of a source, or None where the source is a recording.

    Raises:
        InputError: neither a result nor a recording.
    """
    from fgreg.drivers.ros_recordings import is_recording

    if source.is_dir():
        if is_recording(source):
            return None
        result = source / "result.yaml"
        if result.is_file():
            return result
        if (source / "session.yaml").is_file():
            raise InputError(str(source), "a session without result.yaml", "a solved one: fgreg solve first")
        raise InputError(str(source), "a folder of another kind", "a rosbag2 folder, or a session with its result")
    if not source.exists():
        raise InputError(
            str(source), "nothing", "a recording (.csv, .mcap, .bag, .mha, rosbag2 folder, ...) or a result"
        )
    return source if source.suffix.lower() in (".yaml", ".yml") else None


def _export(result: Path, out: Path, epoch: int | None, force: bool, overwrite: bool) -> str:
    from fgreg.convert.export import WRITERS, registration_of
    from fgreg.output.atomic_file import check_output, write_file
    from fgreg.session.input_hashes import stale
    from fgreg.session.result_file import read_result

    if out.suffix.lower() not in WRITERS:
        raise InputError(str(out), f"a name that ends in {out.suffix or 'nothing'}", "one in " + ", ".join(WRITERS))
    if os.path.lexists(out) and not out.is_dir() and not overwrite:
        raise InputError(str(out), "a file of this name", "a new name, or --overwrite")
    writer, kind = WRITERS[out.suffix.lower()]
    check_output(out, kind)
    estimate, changed = read_result(result), ""
    try:
        changed = stale(result, estimate)
    except InputError as error:
        warn(f"whether the result is stale cannot be told: {error}")
    registration = registration_of(estimate, result, epoch=epoch, force=force, stale=changed)
    write_file(out, writer(registration), kind)
    marked = ", REFUSED and marked as such" if registration.refused else ""
    marked += ", STALE and marked as such" if changed else ""
    return f"{out}: epoch {registration.epoch} of {registration.session}, verdict {registration.verdict}{marked}"


def _import(
    source: Path,
    out: Path,
    setup: Path,
    mapping: Path | None,
    calibration: list[Path],
    unit: str | None,
    size: str | None,
    rectified: bool,
    overwrite: bool,
    quiet: bool,
    progress_bar: ProgressBar,
) -> None:
    from fgreg.convert.mapping import RecordingMapping, read_mapping
    from fgreg.convert.write import MOST_SAID, write_session
    from fgreg.drivers.calibration_files import read_calibration
    from fgreg.output.session_folder import check_folder
    from fgreg.session.yaml_loader import load_yaml

    place = check_folder(out, overwrite=overwrite)
    if overwrite and source.resolve().is_relative_to(place):
        raise InputError(str(source), f"a recording inside of {out}, which is to be replaced", "another OUT")
    rig = None
    if calibration:
        file = setup / "session.yaml" if setup.is_dir() else setup
        if "camera" in load_yaml(file, str(file)):
            raise InputError("--calibration", f"it, and a camera in {file.name}", "one of the two")
        found = read_calibration(calibration, unit=unit, rectified=rectified, image_size=_size(size))
        rig = found.rig
        for warning in found.warnings:
            warn(warning)
    else:
        alone = {"--rectified": rectified or None, "--calibration-unit": unit, "--calibration-size": size}
        refuse_given(alone, "it alone", "it with --calibration")
    names = RecordingMapping() if mapping is None else read_mapping(mapping)
    with memory_at_most(RECORDING_MEMORY), progress_bar(quiet) as progress:
        written = write_session(
            _read(source, names),
            setup,
            out,
            rig=rig,
            overwrite=overwrite,
            progress=lambda done, total: progress("checking events and frames", done, total),
        )
    for warning in [*written.left_out[:MOST_SAID], *written.warnings]:
        warn(warning)
    if (more := len(written.left_out) - MOST_SAID) > 0:
        warn(f"{more} more reasons why data were left out")
    if not quiet:
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(written.events.items()))
        typer.echo(f"{out}: {counts}; {written.frames} frames; next: fgreg solve {shlex.quote(str(out))}")


def _size(text: str | None) -> tuple[int, int] | None:
    """Width and height of ``1280x720``."""
    if text is None:
        return None
    width, _, height = text.lower().partition("x")
    if not (width.isascii() and width.isdigit() and height.isascii() and height.isdigit()) or len(text) > 11:
        raise InputError("--calibration-size", f"'{text[:40]}'", "width x height of the images in px, such as 1280x720")
    return int(width), int(height)


def _read(source: Path, mapping: "RecordingMapping") -> "Imported":
    from fgreg.convert.array_files import ARRAY_SUFFIXES
    from fgreg.convert.array_table import read_arrays
    from fgreg.convert.bag import read_bag
    from fgreg.convert.plus import read_plus
    from fgreg.convert.table import read_table
    from fgreg.drivers.ros_recordings import is_recording

    suffix = source.suffix.lower()
    if is_recording(source):
        return read_bag(source, mapping)
    if suffix in (".csv", ".tsv", ".txt"):
        return read_table(source, mapping)
    if suffix in (".mha", ".mhd", ".nrrd", ".nhdr"):
        return read_plus(source, mapping)
    if suffix in ARRAY_SUFFIXES:
        return read_arrays(source, mapping)
    raise InputError(
        str(source), f"a file that ends in {suffix or 'nothing'}", ".csv, .mcap, .db3, .bag, .mha, .mhd or .nrrd"
    )
