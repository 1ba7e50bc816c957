"""Elements of a recording: colours, a stream with two timelines, Rerun archetypes from arrays.

This module imports Rerun, which takes more than half a second; see :mod:`fgreg.viewer.null_viewer`.
"""

from __future__ import annotations

import io
import math
import pickle
import uuid
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from fgreg.geometry.transforms import FloatArray, inverse
from fgreg.model.camera_model import CameraModel
from fgreg.model.session_model import SessionModel
from fgreg.viewer.pa_frame import PaPicture
from fgreg.viewer.palette import AXES, BEAM, CAMERA, PLANE, PM, PROBE, REFUSED, SOUND, UNUSED, Color
from fgreg.viewer.picture_ring import PictureRing
from fgreg.viewer.scene import Label, ellipsoid_95, frustum_strips_mm, quaternion_xyzw

Image8 = npt.NDArray[np.uint8]

IMAGE_DISTANCE_MM = 28.0
"""Distance from the camera at which its image is drawn, where no shot tells how far away the marker is."""
LARGEST_ELLIPSOID_MM = 50.0
"""Larger ellipsoids (half size) are not drawn."""
CANVAS = 512
"""Side of the canvas for images of changing size, px."""
NOWHERE = "not known"
"""Name of a frame that nothing else is connected to."""
JPEG_QUALITY = 80


FLUSH_S = 600.0
GATHER_S, GATHER_BYTES = 60.0, 8_000_000
"""Rows of a file are gathered for this long, or up to this size. Each write keeps some 4 kB an entity in memory until
the end, for the file's index: 2 MB a minute at 5 s. A program that is killed loses what was gathered."""
PASSING_BYTES = 100_000_000
"""Of pictures between the events of a live session: a quarter of an hour of them."""


class Recorder:
    """A recording stream into a file, a running viewer, or both, with the timelines ``shot`` and ``time``.

    The file's rows are gathered for :data:`GATHER_S`; a viewer gets them at once.

    Args:
        path: of the file. name: of the recording. url: of the viewer. own_id: of the recording; None: a random one.
    """

    def __init__(self, path: Path | None, name: str, url: str | None = None, own_id: str | None = None) -> None:
        own_id = own_id or uuid.uuid4().hex
        self._at = (0.0, 0)
        self._file: rr.RecordingStream | None = None
        self._viewer: rr.RecordingStream | None = None
        self._passing: PictureRing | None = None
        if path is not None:
            gather = rr.ChunkBatcherConfig(flush_tick=GATHER_S, flush_num_bytes=GATHER_BYTES)
            self._file = rr.RecordingStream("fgreg", recording_id=own_id, batcher_config=gather)
            self._file.set_sinks(rr.FileSink(path))
            self._folder = path.parent
        if url is not None:
            self._viewer = rr.RecordingStream("fgreg", recording_id=own_id)
            self._viewer.set_sinks(rr.GrpcSink(url))
        self._streams = [stream for stream in (self._file, self._viewer) if stream is not None]
        for stream in self._streams:
            stream.send_recording_name(name)

    def at(self, t: float, shot: int) -> None:
        """Set shot number and time (s) of what is logged next."""
        self._at = (t, shot)
        for stream in self._streams:
            _set_time(stream, t, shot)

    def log(self, path: str, *what: rr.AsComponents) -> None:
        """Log at the current time."""
        for stream in self._streams:
            stream.log(path, *what)

    def log_passing(self, path: str, *what: rr.AsComponents) -> None:
        """Log a picture at the current time, of which the file keeps the newest :data:`PASSING_BYTES` only."""
        if self._viewer is not None:
            self._viewer.log(path, *what)
        if self._file is not None:
            self._passing = self._passing or PictureRing(PASSING_BYTES, self._folder)
            self._passing.add(pickle.dumps((*self._at, path, what)))

    def static(self, path: str, *what: rr.AsComponents) -> None:
        """Log for all times."""
        for stream in self._streams:
            stream.log(path, *what, static=True)

    def clear(self, *paths: str) -> None:
        """Clear these paths and all below them from the current time on."""
        for path in paths:
            self.log(path, rr.Clear(recursive=True))

    def series(self, path: str, shots: Sequence[int], seconds: Sequence[float], values: Sequence[float]) -> None:
        """Log all values of a plot at once; three sequences of the same length."""
        indexes = [rr.TimeColumn("shot", sequence=shots), rr.TimeColumn("time", duration=seconds)]
        for stream in self._streams:
            stream.send_columns(path, indexes=indexes, columns=rr.Scalars.columns(scalars=values))

    def blueprint(self, blueprint: rrb.Blueprint) -> None:
        """Send the blueprint with which the recording opens."""
        for stream in self._streams:
            stream.send_blueprint(blueprint)

    def close(self) -> None:
        """Write the pictures that are kept, flush and end the recording.

        Raises:
            RuntimeError: it is not written, for example on a full disk.
        """
        if self._passing is not None and self._file is not None:
            with self._passing as kept:
                for entry in kept:
                    t, shot, path, what = pickle.loads(entry)  # noqa: S301 - this process wrote it, to a nameless file
                    _set_time(self._file, t, shot)
                    self._file.log(path, *what)
        failure: RuntimeError | None = None
        for stream in self._streams:
            try:
                stream.flush(timeout_sec=FLUSH_S)  # its default waits forever where the file's thread has ended
            except RuntimeError as error:
                failure = failure or error
            stream.disconnect()
        if failure is not None:
            raise failure


def _set_time(stream: rr.RecordingStream, t: float, shot: int) -> None:
    stream.set_time("shot", sequence=shot)
    stream.set_time("time", duration=t)


def ui(points: float) -> float:
    """A radius in screen points, independent of zoom: Rerun reads negative radii that way."""
    return -points


def transform(a_T_b: FloatArray | None) -> rr.Transform3D:
    """A transform; None becomes one to an unconnected frame, so that Rerun hides what is below.

    A scale of 0 does not work: Rerun treats it as an error and shows everything at the parent's origin.
    """
    if a_T_b is None:
        return rr.Transform3D(parent_frame=NOWHERE)
    return rr.Transform3D(translation=a_T_b[:3, 3], mat3x3=a_T_b[:3, :3])


def axes(lengths_mm: FloatArray | float) -> rr.Arrows3D:
    """Red, green, blue arrows along x, y, z; one length, or (3,)."""
    vectors = np.diag(np.broadcast_to(lengths_mm, 3))
    return rr.Arrows3D(origins=np.zeros((3, 3)), vectors=vectors, colors=AXES, radii=[ui(1.5)])


def labels(placed: Sequence[Label]) -> rr.Points3D:
    """Words at points, always shown."""
    return rr.Points3D(
        [label.places_mm[0] for label in placed],
        colors=[label.color for label in placed],
        radii=[ui(0.5)],
        labels=[label.text for label in placed],
        show_labels=True,
    )


def spheres(centres_mm: FloatArray, radii_mm: FloatArray, colors: Sequence[Color]) -> rr.Points3D:
    """Solid spheres (n, 3) of radii (n,), each with its colour."""
    return rr.Points3D(centres_mm, radii=radii_mm, colors=colors)


def point(p_mm: FloatArray | Sequence[float], color: Color, size: float, label: str | None = None) -> rr.Points3D:
    """One point, ``size`` screen points in radius, with its label shown."""
    return rr.Points3D([p_mm], colors=[color], radii=[ui(size)], labels=None if label is None else [label])


def strips(strips_mm: Sequence[FloatArray], color: Color, size: float, label: str | None = None) -> rr.LineStrips3D:
    """Lines through (n, 3) points each, ``size`` screen points in radius."""
    return rr.LineStrips3D(strips_mm, colors=[color], radii=[ui(size)], labels=None if label is None else [label])


def arrow(
    origin_mm: FloatArray, tip_mm: FloatArray, color: Color, size: float, label: str | None = None
) -> rr.Arrows3D:
    """One arrow, ``size`` screen points in radius."""
    labels = None if label is None else [label]
    return rr.Arrows3D(
        origins=[origin_mm], vectors=[tip_mm - origin_mm], colors=[color], radii=[ui(size)], labels=labels
    )


def ellipsoids(centres_mm: FloatArray, covariances: FloatArray, color: Color) -> rr.Ellipsoids3D:
    """95 % ellipsoids of (n, 3, 3) covariances about (n, 3) points.

    Those longer than LARGEST_ELLIPSOID_MM are left out: they would hide the scene and mean only "unknown".
    """
    shapes = [ellipsoid_95(covariance) for covariance in covariances]
    drawn = [i for i, shape in enumerate(shapes) if shape.half_sizes_mm.max() <= LARGEST_ELLIPSOID_MM]
    shapes = [shapes[i] for i in drawn]
    return rr.Ellipsoids3D(
        centers=centres_mm[drawn],
        half_sizes=[shape.half_sizes_mm for shape in shapes],
        quaternions=[rr.Quaternion(xyzw=quaternion_xyzw(shape.rotation)) for shape in shapes],
        colors=[color],
        line_radii=[ui(0.5)],
    )


def small_points(points_mm: FloatArray, color: Color, size: float) -> rr.Points3D:
    """Points (n, 3) without labels, ``size`` screen points in radius."""
    return rr.Points3D(points_mm, colors=[color], radii=[ui(size)])


def cross_mm(p_mm: FloatArray, half_mm: float = 1.5) -> list[FloatArray]:
    """Three short lines (2, 3) through a point: a shot that was not used."""
    ends = half_mm * np.array([[1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return [np.stack([p_mm - end, p_mm + end]) for end in ends]


def look(
    number: int, *, arc: FloatArray | None, beam: FloatArray | None, pm: FloatArray | None, used: bool
) -> tuple[str, list[rr.AsComponents]]:
    """The entity of a look and what stays drawn of it: one entity, so that a link selects all of it.

    Args:
        number: of the shot.
        arc: (n, 3) mm. beam: (2, 3) mm. pm: (3,) mm. None where there is none.
        used: the PM is a point, else a cross.
    """
    parts: list[rr.AsComponents] = []
    lines = [] if arc is None else [arc]
    if pm is not None and used:
        # The point has the same size at every zoom, for ellipsoids that are too small to see.
        parts.append(small_points(pm[None], PM, 3.5))
    elif pm is not None:
        lines += cross_mm(pm)
    if lines:
        parts.append(strips(lines, SOUND if used else UNUSED, 1.0))
    if beam is not None:
        parts.append(arrow(beam[0], beam[1], BEAM, 0.7))
    return f"world/looks/{number}", parts


def plane_mesh(corners_mm: FloatArray, picture: npt.NDArray[np.uint8] | None) -> rr.Mesh3D:
    """The image plane: transparent, with an optional image (rows, columns, 3) on it.

    Args:
        corners_mm: (4, 3), the picture's first row first, each row from its first column; then back along the last.
        picture: RGB.
    """
    triangles = [[0, 1, 2], [0, 2, 3]]
    return rr.Mesh3D(
        vertex_positions=corners_mm,
        triangle_indices=triangles,
        vertex_texcoords=[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]],
        # Without a texture, the previous one would stay.
        albedo_texture=np.full((1, 1, 3), 255, dtype=np.uint8) if picture is None else picture,
        albedo_factor=(*PLANE, 110) if picture is None else (255, 255, 255, 160),
    )


def plane_outline(corners_mm: FloatArray, color: Color = PLANE) -> rr.LineStrips3D:
    """The outline of the image plane; the plane itself is hardly visible without light."""
    return strips([np.vstack([corners_mm, corners_mm[:1]])], color, 0.8)


def probe(length_mm: float, radius_mm: float) -> rr.Capsules3D:
    """The housing: a cylinder about the x axis with round ends, just inside the array's face."""
    return rr.Capsules3D(
        lengths=[length_mm],
        radii=[radius_mm],
        translations=[[-length_mm / 2.0, 0.0, 0.0]],
        rotation_axis_angles=[rr.RotationAxisAngle([0.0, 1.0, 0.0], degrees=90.0)],
        colors=[PROBE],
        fill_mode="solid",
    )


def draw_cameras(rec: Recorder, model: SessionModel) -> None:
    """Draw the endoscope under ``world/camera``, for all times but for its colour (:func:`color_cameras`)."""
    rec.static("world/camera/axes", axes(10.0))
    if model.camera is None:
        return
    rec.static("world/camera/left", _pinhole(model.camera.left))
    if model.camera.right is not None and model.camera.right_T_left is not None:
        left_T_right = transform(inverse(model.camera.right_T_left))
        rec.static("world/camera/right", left_T_right, _pinhole(model.camera.right))


def _pinhole(camera: CameraModel) -> rr.Pinhole:
    """A camera without its distortion, colour and picture's distance."""
    return rr.Pinhole.from_fields(
        image_from_camera=camera.matrix,
        resolution=camera.image_size,
        camera_xyz=rr.ViewCoordinates.RDF,
        line_width=ui(1.5),
    )


def color_cameras(rec: Recorder, model: SessionModel, distance_mm: float, *, refused: bool) -> None:
    """Draw the endoscope as usable or as refused, its picture at ``distance_mm``, from the present time on.

    A refused one has another colour and its picture is crossed out.
    """
    color = REFUSED if refused else CAMERA
    rec.log("world/camera/origin", point([0.0, 0.0, 0.0], color, 4.0))
    camera = None if model.camera is None else model.camera.left
    frustum = frustum_strips_mm(camera, distance_mm)
    if model.camera is None:
        rec.log("world/camera/outline", strips(frustum, color, 1.5))
    else:
        sides = ("left",) if model.camera.right is None else ("left", "right")
        for side in sides:
            fields = rr.Pinhole.from_fields(color=color, image_plane_distance=distance_mm)
            rec.log(f"world/camera/{side}", fields)
    if refused:
        corners = frustum[0]
        rec.log("world/camera/crossed", strips([corners[[0, 2]], corners[[1, 3]]], color, 3.0))
    else:
        rec.clear("world/camera/crossed")


def picture(image: Image8) -> rr.EncodedImage | rr.Image:
    """A (h, w) grey or (h, w, 3) BGR image as JPEG."""
    image = np.ascontiguousarray(image)
    return rr.Image(image, color_model="BGR" if image.ndim == 3 else "L").compress(jpeg_quality=JPEG_QUALITY)


def exact(image: Image8) -> rr.EncodedImage:
    """A (h, w, 3) RGB image as PNG: small where it is plain, and its colours stay as they are."""
    from PIL import Image  # comes with rerun-sdk

    png = io.BytesIO()
    Image.fromarray(image).save(png, format="PNG", optimize=True)
    return rr.EncodedImage(contents=png.getvalue(), media_type="image/png")


def no_picture(shape: tuple[int, ...]) -> rr.EncodedImage | rr.Image:
    """A black image of this shape to replace an old one: Rerun's 2D view still shows an image after it is cleared."""
    return picture(np.zeros(shape, dtype=np.uint8))


def canvas(image: Image8) -> Image8:
    """(CANVAS, CANVAS, 3) BGR with a (h, w) grey or (h, w, 3) BGR image, scaled by a whole factor to fit.

    Rerun treats JPEG images of one entity as a video, and drops it where their size or kind changes.
    """
    larger = max(image.shape[:2])
    step, times = -(-larger // CANVAS), max(1, CANVAS // larger)
    shown = image[::step, ::step].repeat(times, axis=0).repeat(times, axis=1)
    out = np.zeros((CANVAS, CANVAS, 3), dtype=np.uint8)
    out[: shown.shape[0], : shown.shape[1]] = shown[..., None] if shown.ndim == 2 else shown
    return out


def points_2d(pixels: FloatArray, color: Color, size: float, labels: Sequence[str] | None = None) -> rr.Points2D:
    """Points (n, 2) on an image, with their labels shown."""
    return rr.Points2D(pixels, colors=[color], radii=[ui(size)], labels=labels, show_labels=labels is not None)


def coloured_points_2d(pixels: FloatArray, colors: Sequence[Color], size: float) -> rr.Points2D:
    """Points (n, 2) on an image, each with its colour."""
    return rr.Points2D(pixels, colors=colors, radii=[ui(size)])


def strips_2d(strips_px: Sequence[FloatArray], color: Color, size: float) -> rr.LineStrips2D:
    """Lines on an image."""
    return rr.LineStrips2D(strips_px, colors=[color], radii=[ui(size)])


def coloured_strips_2d(strips_px: Sequence[FloatArray], colors: Sequence[Color], size: float) -> rr.LineStrips2D:
    """Lines on an image, each with its colour."""
    return rr.LineStrips2D(strips_px, colors=colors, radii=[ui(size)])


def ruler(frame: PaPicture) -> rr.Points2D:
    """Labelled marks every 10 mm along the left (range) and upper (x) edges of a photoacoustic image."""
    low_x, high_x, low_range, high_range = frame.extent_mm
    ranges = np.arange(math.ceil(low_range / 10.0) * 10.0, high_range, 10.0)
    across = np.arange(math.ceil(low_x / 10.0) * 10.0, high_x, 10.0)
    marks = np.vstack([frame.pixels(low_x, ranges), frame.pixels(across, low_range)])
    return points_2d(marks, UNUSED, 1.5, [f"{value:.0f}" for value in (*ranges, *across)])
