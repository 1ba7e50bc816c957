"""Calibrates the endoscope: the steps of ``fgreg calibrate-camera`` on one page.

read the pictures in pairs -> find the board in each -> a start -> all views in one least squares -> every other view
against the rest -> what the views do not determine -> write. New views are compared with a calibration instead.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.calibration import parameters
from fgreg.calibration.bundle import Bundle, fit
from fgreg.calibration.check import CameraCheck, check
from fgreg.calibration.quality import Halves, board_depths_mm, conditions, coverage, halves, view_residuals
from fgreg.calibration.views import MIN_CORNERS, SIDES, BoardView, CornerTable, SeenCorners, spread_views
from fgreg.convert.camera_file import CAMERA_FILE, CameraFile, systematic_sigmas, write_camera
from fgreg.detection.board import find_board_corners
from fgreg.detection.calibration_start import place_boards, start
from fgreg.detection.corners import grey
from fgreg.detection.frame_files import Picture
from fgreg.drivers.endoscope import Layout
from fgreg.drivers.stereo_recording import RecordedPair, recorded_pairs
from fgreg.errors import EstimationError, InputError
from fgreg.geometry.transforms import FloatArray, IntArray
from fgreg.model.camera_model import StereoRig
from fgreg.model.session_model import BoardModel
from fgreg.output.atomic_file import check_output
from fgreg.schema.record import record
from fgreg.version import __version__

LENSES = {"pinhole5": (5, False), "pinhole8": (8, False), "fisheye": (4, True)}
"""Lens models by name: number of coefficients, and whether it is a fisheye one."""
MIN_VIEWS = 3
WORST_PX = 3.0
"""Residual (1 sigma of a corner) from which these are not views of one board by one pair of cameras: good: 0.1."""
MOST_STRAYS = 0.3
"""Share of corners left out from which they are not, either."""

Progress = Callable[[str, int, int], None]
"""Called with (name of the step, items done, total items)."""


@dataclass(frozen=True, slots=True)
class Pictures:
    """Where the pictures are: ``left`` and ``right`` as fgreg.drivers.stereo_recording reads them."""

    left: Path
    right: Path | None
    layout: Layout = Layout.SEPARATE
    most_views: int = 60


@dataclass(frozen=True, slots=True, eq=False)
class FoundViews:
    """Views of the board in pictures.

    Attributes:
        table: of the views that are used. image_size: of all pictures.
        pictures: number of pairs that were looked at.
        not_found: names of pairs in which the board is in no picture. set_aside: number of views not used, being like
            others.
    """

    table: CornerTable
    image_size: tuple[int, int]
    pictures: int
    not_found: tuple[str, ...]
    set_aside: int


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationReport:
    """A calibration and how good it is.

    Attributes:
        out: the file written; None: none.
        views: of the board. bundle: the optimum, with the covariance by the residuals.
        covariance: (P, P), wider where two halves of the views differ.
        halves: against each other, or None.
        systematic: keys of ``systematic``, in the file's units.
        residuals_px: (V, 2) of each view, left and right. coverage: of each camera.
        conditions: what falls short.
    """

    out: Path | None
    views: FoundViews
    bundle: Bundle
    covariance: FloatArray
    halves: Halves | None
    systematic: dict[str, float]
    residuals_px: FloatArray
    coverage: tuple[IntArray, ...]
    conditions: tuple[str, ...]

    @property
    def rig(self) -> StereoRig:
        """The cameras."""
        return self.bundle.rig


def _no_progress(_step: str, _done: int, _total: int) -> None:
    """Ignore progress."""


def calibrate_camera(
    pictures: Pictures,
    board: BoardModel,
    out: Path | None,
    *,
    model: str = "pinhole5",
    scale_sigma: float = 0.002,
    progress: Progress = _no_progress,
) -> CalibrationReport:
    """Calibrate from pictures of a board.

    Args:
        out: file to write, or None.
        model: of both lenses, one of ``LENSES``.
        scale_sigma: relative sigma of the board's size, which no picture shows.

    Raises:
        InputError: bad input, too few views, or no calibration fits them; nothing is written.
    """
    if model not in LENSES:
        raise InputError("--model", model, "one of " + ", ".join(LENSES))
    if out is not None:
        check_output(out, CAMERA_FILE)
    views = find_views(pictures, board, progress)
    table = views.table
    if len(table.names) < MIN_VIEWS:
        raise InputError(str(pictures.left), _found(views), f"{MIN_VIEWS} or more; 20 to 40 are good")
    coefficients, fisheye = LENSES[model]
    try:
        rig, poses = start(table, views.image_size, coefficients, fisheye)
        bundle = fit(table, rig, poses)
        both = halves(table, bundle)
    except (EstimationError, np.linalg.LinAlgError) as error:
        raise InputError(
            str(pictures.left), f"views that no {model} lens explains ({error})", "views of this board"
        ) from None
    strays = float((~bundle.used).mean())
    if bundle.sigma_px > WORST_PX or strays > MOST_STRAYS:
        found = f"views that fit to {bundle.sigma_px:.2g} px only, {100 * strays:.0f} % of the corners left out"
        expected = "left and right pictures of one moment, of one board and one focus"
        raise InputError(str(pictures.left), found, expected)
    covariance = bundle.covariance * (1.0 if both is None else both.factor**2)
    systematic = systematic_sigmas(bundle.rig, covariance, scale_sigma)
    sides = range(len(parameters.cameras(bundle.rig)))
    report = CalibrationReport(
        out,
        views,
        bundle,
        covariance,
        both,
        systematic,
        view_residuals(table, bundle),
        tuple(coverage(table, views.image_size, side) for side in sides),
        tuple(conditions(table, bundle, covariance, both, views.image_size)),
    )
    if out is not None:
        write_camera(out, bundle.rig, systematic, _details(report, board, model))
    return report


def check_camera(
    pictures: Pictures,
    board: BoardModel,
    camera: CameraFile,
    *,
    limit_mm: float = 0.5,
    progress: Progress = _no_progress,
) -> tuple[CameraCheck, FoundViews]:
    """Compare new views with a calibration.

    Raises:
        InputError: bad input, pictures of another size, or no view of the board.
    """
    views = find_views(pictures, board, progress)
    table = views.table
    if views.image_size != camera.rig.left.image_size:
        size, expected = views.image_size, camera.rig.left.image_size
        raise InputError(
            str(pictures.left), f"{size[0]} x {size[1]} px", f"{expected[0]} x {expected[1]}, as calibrated"
        )
    if (pictures.right is None and pictures.layout in (Layout.MONO, Layout.SEPARATE)) is not (camera.rig.right is None):
        found = "left pictures only" if camera.rig.right is not None else "pictures of two cameras"
        raise InputError(str(pictures.left), found, "as many cameras as were calibrated")
    if not table.names:
        raise InputError(str(pictures.left), _found(views), "1 or more; 3 to 6 are good")
    try:
        placed = place_boards(table, camera.rig)
        depths = camera.depths_mm or board_depths_mm(table, placed)
        checked = check(table, camera.rig, camera.covariance, camera.sigma_px, placed, depths, limit_mm)
    except (EstimationError, np.linalg.LinAlgError) as error:
        raise InputError(
            str(pictures.left), f"views that the calibration cannot place ({error})", "its board"
        ) from None
    return checked, views


def find_views(pictures: Pictures, board: BoardModel, progress: Progress = _no_progress) -> FoundViews:
    """Find the board in all pictures.

    Raises:
        InputError: bad input, or pictures of several sizes.
    """
    views: list[BoardView] = []
    lost: list[str] = []
    size: tuple[int, int] | None = None
    count = 0
    total, pairs = recorded_pairs(pictures.left, pictures.right, pictures.layout)
    for pair in pairs:
        size = _same_size(pair, size)
        left, right = _corners(pair.left, board), None if pair.right is None else _corners(pair.right, board)
        if left is None and right is None:
            lost.append(pair.name)
        else:
            views.append(BoardView(pair.name, left, right))
        count += 1
        progress("board", count, max(total, count))
    if size is None:
        raise InputError(str(pictures.left), "no pictures", "pictures of the board")
    both = [one for one in views if one.left is not None and one.right is not None]
    alone = [one for one in views if one.left is None or one.right is None]
    chosen = spread_views(both, board, pictures.most_views)
    if len(chosen) < pictures.most_views:
        chosen += spread_views(alone, board, pictures.most_views - len(chosen))
    order = {one.name: i for i, one in enumerate(views)}
    chosen.sort(key=lambda one: order[one.name])
    return FoundViews(CornerTable.of(chosen, board), size, count, tuple(lost), len(views) - len(chosen))


def _same_size(pair: RecordedPair, size: tuple[int, int] | None) -> tuple[int, int]:
    for side, picture in zip(SIDES, (pair.left, pair.right), strict=True):
        if picture is None:
            continue
        found = (picture.shape[1], picture.shape[0])
        if size is not None and found != size:
            text = f"a {side} picture of {found[0]} x {found[1]} px"
            raise InputError(pair.name, text, f"{size[0]} x {size[1]}, as the first one")
        size = found
    assert size is not None
    return size


def _corners(picture: Picture, board: BoardModel) -> SeenCorners | None:
    found = find_board_corners(grey(picture), board)
    return None if found is None or len(found[1]) < MIN_CORNERS else SeenCorners(*found)


def _found(views: FoundViews) -> str:
    return f"the board in {len(views.table.names)} of {views.pictures} pictures"


def _details(report: CalibrationReport, board: BoardModel, model: str) -> dict[str, Any]:
    """What the file says of a calibration besides what sessions read."""
    unit = parameters.per_unit(report.rig)
    both = report.halves
    return {
        "fgreg": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "model": model,
        "board": record(BoardModel).write(board),
        "views": list(report.views.table.names),
        "sigma_px": report.bundle.sigma_px,
        "depth_mm": list(board_depths_mm(report.views.table, report.bundle.left_T_board)),
        "halves": None if both is None else halves_dict(both),
        "conditions": list(report.conditions),
        "names": list(parameters.names(report.rig)),
        "covariance": (report.covariance * np.outer(unit, unit)).tolist(),
    }


def halves_dict(both: Halves) -> dict[str, Any]:
    """Two halves against each other as plain data; None: not finite, or there is one camera."""
    apart = both.apart

    def plain(value: float) -> float | None:
        return value if np.isfinite(value) else None

    return {
        "points_rms_mm": plain(apart.points_rms_mm),
        "points_most_mm": plain(apart.points_most_mm),
        "rays_rms_px": [plain(value) for value in apart.rays_rms_px],
        "p": both.p,
        "factor": both.factor,
    }
