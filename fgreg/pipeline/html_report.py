"""A solved session as one HTML file: the steps of ``fgreg report`` on one page.

read the session and its result -> make its frames small -> fill in the template -> write (and print to PDF).
"""

from __future__ import annotations

import base64
import math
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray
from fgreg.html_report import figures
from fgreg.html_report.browser_pdf import PDF_REPORT, find_browser, print_pdf
from fgreg.html_report.contents import Source, contents, shown_pairs
from fgreg.html_report.render import HTML_REPORT, render
from fgreg.html_report.viewer_3d import viewer_of
from fgreg.model.estimate import PairEstimate, SessionEstimate
from fgreg.model.events import PairEvent
from fgreg.model.lens import in_view, project
from fgreg.model.session_model import SessionModel
from fgreg.output.atomic_file import check_outputs, write_file
from fgreg.session.file_hash import file_hash
from fgreg.session.input_hashes import changed_inputs
from fgreg.session.result_file import RESULT_FILE, read_result
from fgreg.session.session_reader import Session, read_session, session_place
from fgreg.version import __version__
from fgreg.viewer.pa_frame import pa_picture

REPORT_FILE = "report.html"
MOST_PICTURES = 60
"""Looks with thumbnails; of more the unused ones and those with the largest NIS."""
WIDTH, PA_SIDE = 320, 200
"""Of a thumbnail of the endoscope, and the larger side of one of the probe, px."""

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class ReportRequest:
    """Options of a report.

    Attributes:
        folder: the session. out: the report; None: ``report.html`` in the session's folder.
        result: its result; None: ``result.yaml`` in the session's folder.
        pdf: where to print it to, if anywhere. rrd: the recording to put into it, if any.
    """

    folder: Path
    out: Path | None = None
    result: Path | None = None
    pdf: Path | None = None
    rrd: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class WrittenReport:
    """A report that was written, its size, and the result that it shows."""

    out: Path
    size: int
    estimate: SessionEstimate


def report_session(request: ReportRequest, progress: Progress | None = None) -> WrittenReport:
    """Write the report of a solved session.

    Raises:
        InputError: bad input, no result, or one of other files; an older report stays.
        MissingExtraError: the 3D viewer is not installed.
    """
    folder = session_place(request.folder)
    out = request.folder / REPORT_FILE if request.out is None else request.out
    check_outputs([("the report", out, HTML_REPORT), ("--pdf", request.pdf, PDF_REPORT)])
    browser = None if request.pdf is None else find_browser()
    result = request.folder / RESULT_FILE if request.result is None else request.result
    estimate = read_solved(folder, result)
    viewer = None if request.rrd is None else viewer_of(request.rrd, estimate.inputs)
    session = read_session(request.folder)
    looks = sum(isinstance(event, PairEvent) for event in session.events)
    if looks != len(estimate.pairs):
        raise InputError(f"{result}: pairs", f"{len(estimate.pairs)}", f"{looks}, one per pair event of the session")
    if estimate.settings is None:
        raise InputError(f"{result}: settings", "nothing", "those of the solve: solve the session again (fgreg solve)")
    source = Source(
        session=folder.name,
        model=session.model,
        events=session.events,
        estimate=estimate,
        settings=estimate.settings,
        pictures=pictures_of(session, estimate, progress),
        hashes={RESULT_FILE: file_hash(result)}
        | ({} if request.rrd is None else {"recording": file_hash(request.rrd)}),
        version=__version__,
    )
    text = render(contents(source), viewer)
    write_file(out, text, HTML_REPORT)
    if request.pdf is not None and browser is not None:
        write_file(request.pdf, print_pdf(render(contents(source)), browser), PDF_REPORT)
    return WrittenReport(out, len(text.encode()), estimate)


def read_solved(folder: Path, result: Path) -> SessionEstimate:
    """The result of a session as it is.

    Raises:
        InputError: there is none, it is invalid, or it was made from other files.
    """
    if not result.is_file():
        raise InputError(str(result), "nothing", f"the result of the session: fgreg solve {shlex.quote(folder.name)}")
    estimate = read_result(result)
    if changed := changed_inputs(folder, estimate.inputs) if estimate.inputs else ["all of the session"]:
        found = f"a result of other files: {' and '.join(changed)} changed"
        raise InputError(str(result), found, "that of the session as it is: solve it again (fgreg solve)")
    return estimate


def pictures_of(
    session: Session, estimate: SessionEstimate, progress: Progress | None = None
) -> dict[int, tuple[Markup, ...]]:
    """Thumbnails of the looks with frames, by their place: left camera and probe, a ring where the PM is.

    Raises:
        InputError: a frame is missing or invalid.
    """
    events = [event for event in session.events if isinstance(event, PairEvent)]
    places = shown_pairs(estimate.pairs, MOST_PICTURES)
    found = {}
    for done, place in enumerate(places, 1):
        pair, event = estimate.pairs[place], events[place]
        made = [_left(pair, event, estimate, session.model), _probe(pair, event, session.model)]
        if shown := tuple(picture for picture in made if picture is not None):
            found[place] = shown
        if progress is not None:
            progress("making pictures small", done, len(places))
    return found


def _url(jpeg: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode("ascii")


def _left(pair: PairEstimate, event: PairEvent, estimate: SessionEstimate, model: SessionModel) -> Markup | None:
    """The left camera's picture, with a ring where the estimate has the PM."""
    if event.marker.left is None:
        return None
    from fgreg.detection.event_frames import load_picture  # loads OpenCV
    from fgreg.detection.thumbnails import thumbnail

    picture = load_picture(event.marker.left, event.line, "marker.left", model.camera)
    jpeg, width, height = thumbnail(picture, WIDTH)
    mark = None
    epoch = estimate.epochs[pair.epoch] if estimate.epochs else None
    if pair.trus_p_pm_mm is not None and epoch is not None and epoch.trus_T_camera is not None and model.camera:
        point = figures.camera_point_mm(epoch, pair.trus_p_pm_mm)[None]
        if in_view(model.camera.left, point)[0]:
            mark = project(model.camera.left, point)[0] * width / picture.shape[1]
    return figures.marked_picture(_url(jpeg), width, height, mark, f"Left camera, PM {pair.pm}")


def _probe(pair: PairEstimate, event: PairEvent, model: SessionModel) -> Markup | None:
    """The probe's frame, with a ring where the estimate has the PM, turned into its plane."""
    if event.trus.frame is None:
        return None
    from fgreg.detection.event_frames import load_trus_frame  # loads OpenCV
    from fgreg.detection.thumbnails import thumbnail

    shown = pa_picture(load_trus_frame(event.trus.frame, event.line, "trus.frame", model), model.probe, PA_SIDE)
    if shown is None:
        return None
    jpeg, width, height = thumbnail(shown.image, PA_SIDE)
    mark: FloatArray | None = None
    if pair.trus_p_pm_mm is not None:
        scan, radius = model.stage.scan_from_device(math.radians(event.trus.scan_deg)), model.probe.radius_mm
        face = radius * np.array([math.sin(scan), math.cos(scan)])
        range_mm = float(np.linalg.norm(pair.trus_p_pm_mm[1:] - face))
        mark = shown.pixels(float(pair.trus_p_pm_mm[0]), range_mm)
    return figures.marked_picture(_url(jpeg), width, height, mark, f"Probe, PM {pair.pm}")
