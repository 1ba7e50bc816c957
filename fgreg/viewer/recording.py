"""The Rerun recording of a session; the null viewer is in null_viewer.py.

Entities, all in TRUS millimetres unless a parent's transform says otherwise:

- ``world/probe``, ``world/trus``: the housing and the axes of TRUS.
- ``world/stage``: rotated to the shot's plane; ``plane`` (with the shot's frame on it) and ``elements`` below.
- ``world/looks/N``: arc, beam, PM and its ellipsoid of shot N, from its time on; links in the summary select it.
- ``world/shot/{arc,beam,pm,sound}``: those of the shot at the cursor, bold; ``labels``: the words of the view.
- ``world/camera``: ``trus_T_camera`` of the epoch; ``left`` and ``right`` are pinholes with the endoscope's images,
  ``crossed`` marks it as refused, ``marker`` is ``camera_T_marker`` of the shot with the tags' outlines and ``laser``.
- ``world/camera/left/seen``: PMs, beam and image plane as the lens shows them, in pixels.
- ``world/targets``: spheres of the 95 % bound of the predicted error; ``scale``: their colours and the limit.
- ``world/truth``: PMs and camera where they are known.
- In a live session: ``world/goal``, the plane in which the PM will be detected; ``bmode``.
- ``pa``: the shot's photoacoustic frame with its detection; ``verdict``; ``legend``; ``plots/*``; ``summary``;
  ``log/N``.

Timelines: ``shot`` (number among all aims, pairs and tracks, from 0) and ``time`` (seconds, as in the events).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt
import rerun as rr

from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, exp_so3
from fgreg.model.estimate import SessionEstimate, Verdict
from fgreg.model.measurements import Measurements, Track
from fgreg.model.probe_model import ProbeModel
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.output.atomic_file import NewFile
from fgreg.viewer import legend, palette, scene, shapes, shot_labels, target_map
from fgreg.viewer.blueprint import WORLD_PX, Contents, Eyes, make_blueprint
from fgreg.viewer.live import LiveDrawing, ViewerUpdate
from fgreg.viewer.pa_frame import pa_picture, texture
from fgreg.viewer.recording_file import RECORDING, is_complete, recording_id
from fgreg.viewer.result import ResultDrawing, Truth
from fgreg.viewer.scene import ShotKind
from fgreg.viewer.shapes import Image8
from fgreg.viewer.status_line import BmodePicture

LARGEST_TEXTURE = 160
"""Larger side of a B-mode image on the image plane, px."""


def _not_written(rrd: Path, why: str) -> InputError:
    return InputError(str(rrd), f"a recording that cannot be written ({why})", "a writable place")


class Viewer:
    """Writes the recording of a session. Use as a context manager: the file appears at its end.

    It is written under a temporary name in the same folder and then renamed. After an exception there is no new file,
    and an older one is unchanged.

    Args:
        rrd: the file to write; its folder must exist. None: no file.
        session_name: the recording's name.
        url: of a running viewer that shows it too.
        made_from: hashes of the session's files, by which the recording is told from that of another session.

    Raises:
        InputError: ``rrd`` cannot be written, or is another file.
    """

    def __init__(
        self, rrd: Path | None, session_name: str, url: str | None = None, made_from: Mapping[str, str] | None = None
    ) -> None:
        self._file = None if rrd is None else NewFile(rrd, RECORDING)
        try:
            file = None if self._file is None else self._file.part
            self._rec = shapes.Recorder(file, session_name, url, recording_id(made_from or {}))
        except RuntimeError as error:
            self._drop_part()
            if rrd is None:
                raise
            raise _not_written(rrd, str(error)) from None
        except BaseException:
            self._drop_part()
            raise
        self._live: LiveDrawing | None = None
        self._model: SessionModel | None = None
        self._limit_mm = SolveConfig().limit_mm
        self._shown: set[str] = set()
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._pa_size: tuple[int, int] | None = None
        self._textured: set[int] = set()
        self._finished = False
        self._arranged: Contents | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish and rename the file, or remove it after an exception."""
        try:
            if not self._finished and self._live is None:
                self._rec.blueprint(make_blueprint(self._contents(result=False), None, Eyes()))
            failure = "its end is missing"
            try:
                self._rec.close()
            except RuntimeError as closing:  # also where the user has closed a viewer: the file alone tells
                failure = str(closing)
            if kind is None and self._file is not None:
                if not is_complete(self._file.part):
                    raise _not_written(self._file.path, failure)
                self._file.keep()
        finally:
            self._drop_part()

    def _drop_part(self) -> None:
        if self._file is not None:
            self._file.drop()

    def session(self, model: SessionModel, limit_mm: float) -> None:
        """Draw the static parts: probe, array, axes, cameras, the marker's outline, legend, scale, the plots' styles.

        ``limit_mm``: of the predicted 95 % error at the worst target.
        """
        self._model, self._limit_mm = model, limit_mm
        rec, probe = self._rec, model.probe
        length = scene.array_length_mm(probe)
        rec.static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        rec.static("world/trus", shapes.axes(shot_labels.axes_reach_mm(model)))
        rec.static("world/probe", shapes.probe(length + 8.0, probe.radius_mm * 0.98))
        face = np.array([[-length / 2.0, 0.0, probe.radius_mm], [length / 2.0, 0.0, probe.radius_mm]])
        rec.static("world/stage/elements", shapes.strips([face], palette.SOUND, 3.0))
        shapes.draw_cameras(rec, model)
        legend.draw(rec)
        target_map.draw_scale(rec, limit_mm)
        if model.marker is not None:
            outlines = scene.marker_outlines_mm(model.marker)
            rec.static("world/camera/marker/tags", shapes.strips(outlines, palette.MARKER, 1.5))
        rec.static("world/camera/marker/axes", shapes.axes(8.0))
        limit = rr.SeriesLines(colors=[palette.UNUSED], names=["95 % bound of an inlier"], widths=[1.0])
        rec.static("plots/nis/limit_95", limit)
        for name, color in (("plane", palette.SOUND), ("beam", palette.GOAL)):
            rec.static(f"online/stage_deg/{name}", rr.SeriesLines(colors=[color], names=[name], widths=[2.0]))
        for plot in ("residual_mm", "nis", "rotation_deg", "lambda_mm"):
            for name, color, shape in (
                ("pair", palette.PM, rr.components.MarkerShape.Circle),
                ("pair_not_used", palette.UNUSED, rr.components.MarkerShape.Cross),
                ("aim", palette.BEAM, rr.components.MarkerShape.Diamond),
                ("track", palette.SOUND, rr.components.MarkerShape.Up),
            ):
                name_shown = name.replace("_", " ")
                style = rr.SeriesPoints(colors=[color], names=[name_shown], markers=[shape], marker_sizes=[4.0])
                rec.static(f"plots/{plot}/{name}", style)

    def shot_images(
        self,
        t: float,
        kind: ShotKind,
        index: int,
        left: Image8 | None,
        right: Image8 | None = None,
        marker_outlines_px: Iterable[FloatArray] | None = None,
        corner_px: FloatArray | None = None,
        *,
        passing: bool = False,
    ) -> None:
        """Show the endoscope's images of a shot.

        Args:
            t: seconds.
            kind: of shot.
            index: its number among all aims, pairs and tracks of the session, from 0.
            left, right: (h, w) grey or (h, w, 3) BGR, uint8; None where there is none.
            marker_outlines_px: the tags' (4, 2) corners found in the left image.
            corner_px: (2,) the board corner aimed at, in the left image.
            passing: between the events of a live session: newer images make room in the file by dropping it.
        """
        rec = self._rec
        rec.at(t, index)
        for side, image in (("left", left), ("right", right)):
            if image is not None:
                self._shown.add(side)
                self._shapes[side] = image.shape
                log = rec.log_passing if passing else rec.log
                log(f"world/camera/{side}", shapes.picture(image))
        if left is None:
            return
        rec.clear("world/camera/left/marker", "world/camera/left/corner")
        outlines = [np.vstack([corners, corners[:1]]) for corners in marker_outlines_px or ()]
        if outlines:
            rec.log("world/camera/left/marker/outline", shapes.strips_2d(outlines, palette.BEAM, 1.5))
        if corner_px is not None:
            label = f"{kind}: laser on this corner"
            corner = np.asarray(corner_px).reshape(1, 2)
            rec.log("world/camera/left/corner/spot", shapes.points_2d(corner, palette.PM, 4.0, [label]))

    def pa_frame(
        self,
        t: float,
        index: int,
        frame: npt.NDArray[np.generic],
        x_mm: float | None,
        range_mm: float | None,
        covariance: FloatArray | None,
        probe: ProbeModel,
    ) -> None:
        """Show a photoacoustic frame with its detection, in the image view and on the image plane of the world.

        Args:
            t: seconds.
            index: number of the shot, as in :meth:`shot_images`.
            frame: (elements, samples) channel data or (depth, lateral) envelope.
            x_mm, range_mm: where the PM was found; None where it was not.
            covariance: (2, 2) over both, mm^2.
            probe: defines the sampling; a frame that does not fit it is left out.
        """
        picture = pa_picture(frame, probe)
        if picture is None:
            return
        rec = self._rec
        self._pa_size = picture.image.shape
        self._textured.add(index)
        rec.at(t, index)
        rec.log("pa", shapes.picture(picture.image))
        rec.log("pa/ruler", shapes.ruler(picture))
        low_x, high_x, low_range, high_range = picture.extent_mm
        near, far = probe.radius_mm + low_range, probe.radius_mm + high_range
        corners = np.array([[low_x, 0.0, near], [high_x, 0.0, near], [high_x, 0.0, far], [low_x, 0.0, far]])
        rec.log("world/stage/plane", shapes.plane_mesh(corners, texture(picture)))
        rec.log("world/stage/outline", shapes.plane_outline(corners))
        # The caption has the shot's number, because the frame stays at later shots without one.
        found = "no source found" if x_mm is None or range_mm is None else f"x {x_mm:.1f} mm, range {range_mm:.1f} mm"
        above = np.array([[0.5 * picture.image.shape[1], -0.1 * picture.image.shape[0]]])
        rec.log("pa/caption", shapes.points_2d(above, palette.PM, 0.5, [f"shot {index}: {found}"]))
        rec.clear("pa/detection")
        if x_mm is None or range_mm is None:
            return
        gap, arm = 0.5, 2.0
        ticks = [
            np.array([[gap, 0.0], [arm, 0.0]]) @ exp_so3(np.array([0.0, 0.0, k * np.pi / 2.0]))[:2, :2]
            for k in range(4)
        ]
        cross = [picture.pixels(x_mm + tick[:, 0], range_mm + tick[:, 1]) for tick in ticks]
        rec.log("pa/detection/spot", shapes.strips_2d(cross, palette.PM, 1.2))
        if covariance is not None:
            outline = scene.ellipse_95(np.array([x_mm, range_mm]), covariance)
            strip = picture.pixels(outline[:, 0], outline[:, 1])
            rec.log("pa/detection/ellipse", shapes.strips_2d([strip], palette.PM, 0.8))
        if picture.wavefront:
            # Dots, so that the wave is visible between them.
            x = np.sort(probe.element_x_mm)[::5]
            front = picture.pixels(x, np.hypot(x - x_mm, range_mm))
            front = front[front[:, 1] <= picture.image.shape[0]]
            rec.log("pa/detection/wavefront", shapes.points_2d(front, palette.PM, 1.3))

    def bmode(self, t: float, index: int, picture: BmodePicture | None) -> None:
        """Show a B-mode image in its view and, where its geometry is known, on the image plane.

        In the file newer images make room by dropping it.

        Args:
            t: seconds.
            index: number of the update that is drawn next.
            picture: None where the scanner is lost: then the last one is removed.
        """
        if self._model is None:
            raise AssertionError("the session comes first")
        rec = self._rec
        rec.at(t, index)
        caption = np.array([[0.5 * shapes.CANVAS, 0.03 * shapes.CANVAS]])
        if picture is None:
            if "bmode" in self._shown:
                rec.log("bmode", shapes.no_picture((shapes.CANVAS, shapes.CANVAS, 3)))
                rec.log("bmode/caption", shapes.points_2d(caption, palette.REFUSED, 0.5, ["no picture"]))
            return
        image, pixel_mm, origin_mm = picture.image, picture.pixel_mm, picture.origin_mm
        self._shown.add("bmode")
        rec.log_passing("bmode", shapes.picture(shapes.canvas(image)))
        text = f"t = {t:.1f} s" + ("" if pixel_mm and origin_mm else "; its position in the plane is not known")
        rec.log("bmode/caption", shapes.points_2d(caption, palette.SOUND, 0.5, [text]))
        if pixel_mm is None or origin_mm is None:
            return
        self._textured.add(index)
        rows, columns = image.shape[:2]
        corners = scene.picture_corners_mm(self._model.probe, (rows, columns), pixel_mm, origin_mm)
        step = -(-max(rows, columns) // LARGEST_TEXTURE)
        small = image[::step, ::step]
        rgb = np.repeat(small[..., None], 3, axis=2) if small.ndim == 2 else small[..., ::-1]
        rec.log_passing("world/stage/plane", shapes.plane_mesh(corners, np.ascontiguousarray(rgb)))
        rec.log("world/stage/outline", shapes.plane_outline(corners))

    def result(
        self,
        model: SessionModel,
        measurements: Measurements,
        estimate: SessionEstimate,
        truth: Truth | None = None,
        tracks: Sequence[Track] = (),
    ) -> None:
        """Draw the result: registration, beams, arcs, PMs, targets, tracks, plots and text.

        Where updates were drawn before, the shots stay unchanged, and only plots and text are added.

        Args:
            model: the session's set-up.
            measurements: those that entered the estimate.
            estimate: the result; its looks are matched to the measured pairs by time and PM.
            truth: where it is known.
            tracks: the queries of ``estimate.tracks``, matched by time; without one only the plane is shown.
        """
        drawing = ResultDrawing(
            rec=self._rec,
            model=model,
            measurements=measurements,
            estimate=estimate,
            truth=truth,
            tracks=tuple(tracks),
            textured=frozenset(self._textured),
            limit_mm=self._limit_mm,
            view=WORLD_PX,
        )
        if self._live is None:
            drawing.draw()
        else:
            self._live.to_end()
            drawing.draw_end(from_now=True)
        shots = 0 if self._live is not None else len(scene.shots_of(estimate))
        eyes = Eyes(drawing.eye(), target_map.eye(model))
        self._rec.blueprint(make_blueprint(self._contents(result=True, shots=shots), estimate.verdict, eyes))
        self._finished = True

    def _contents(self, *, result: bool, shots: int = 0) -> Contents:
        shown = self._shown
        return Contents(
            "left" in shown,
            "right" in shown,
            self._pa_size,
            result,
            shots,
            self._live is not None,
            "bmode" in shown,
            "now" in shown,
            "registered" in shown,
        )

    def update(self, update: ViewerUpdate) -> None:
        """Draw a shot with the estimate at its time, so that the recording shows how the registration changes.

        Call it after :meth:`session` and after drawing the shot's images.
        """
        if self._model is None:
            raise AssertionError("the session comes first")
        if self._live is None:
            self._live = LiveDrawing(self._rec, self._model, self._limit_mm)
        if update.now is not None:
            self._shown.add("now")
        if update.trus_T_camera is not None and update.verdict is not Verdict.REFUSED:
            self._shown.add("registered")
        contents = self._contents(result=True)
        if contents != self._arranged:  # rare, because it resets a view that the user may have rotated
            self._arranged = contents
            points = scene.live_points_mm(self._model.probe, self._model.targets_mm)
            if update.trus_T_camera is not None and contents.registered:
                points = np.vstack([points, update.trus_T_camera[:3, 3]])
            self._live.eye = scene.best_eye(points, WORLD_PX)
            eyes = Eyes(self._live.eye, target_map.eye(self._model))
            self._rec.blueprint(make_blueprint(contents, None, eyes))
        if update.now is not None and "camera" in update.now.lost:  # an old image would look like a new one
            self._rec.at(update.t, update.number)
            for side, shape in self._shapes.items():
                self._rec.log(f"world/camera/{side}", shapes.no_picture(shape))
        self._live.draw(update, textured=update.number in self._textured)
        self._textured.clear()  # they are needed no more: there is one a drawing, for hours
