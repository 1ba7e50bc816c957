"""Draws a session's result into its recording: shots, plots, summary, and the points that the view must contain."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeGuard

import numpy as np
import rerun as rr

from fgreg.geometry.transforms import FloatArray, inverse, log_so3, transform_points
from fgreg.model.estimate import PairEstimate, SessionEstimate, TrackEstimate, Verdict
from fgreg.model.measurements import Look, MarkerObservation, Measurements, Pair, Track
from fgreg.model.session_model import SessionModel
from fgreg.viewer import banner, endoscope_view, palette, scene, shapes, shot_labels, target_map
from fgreg.viewer.endoscope_lines import Seen
from fgreg.viewer.scene import Eye
from fgreg.viewer.summary_page import HEADINGS, summary_markdown

PICTURE_AT = 0.25
"""Where the camera's picture is drawn: this part of the way to the markers."""
FAR_MM = 1000.0
"""A camera farther from the probe than this is not included in the initial view."""


class Truth(Protocol):
    """The known part of the ground truth: ``trus_T_camera`` per epoch, and the PMs (3,) mm by number."""

    @property
    def trus_T_camera(self) -> Sequence[FloatArray]: ...
    @property
    def trus_p_pm_mm(self) -> Mapping[int, FloatArray]: ...


@dataclass(frozen=True, slots=True, eq=False)
class ResultDrawing:
    """Draws one result into one recording.

    Attributes:
        rec: where to draw.
        model, measurements, estimate, truth: of the session.
        tracks: the queries of ``estimate.tracks`` whose marker was found.
        textured: numbers of the shots whose frame is already on the image plane.
        limit_mm: of the predicted error.
        view: size of the 3D view for which labels are placed, px.
    """

    rec: shapes.Recorder
    model: SessionModel
    measurements: Measurements
    estimate: SessionEstimate
    truth: Truth | None
    tracks: tuple[Track, ...]
    textured: frozenset[int]
    limit_mm: float
    view: tuple[int, int]

    def draw(self) -> None:
        """Draw everything."""
        looks = measured_pairs(self.estimate.pairs, self.measurements)
        eye = self.eye()
        markers_of_aims = {aim.t: aim.marker for aim in self.measurements.aims}
        epoch, plane_is_plain = -1, False
        for shot in scene.shots_of(self.estimate):
            self.rec.at(shot.t, shot.number)
            if (now := self._epoch_of(shot)) != epoch:
                epoch = now
                self._epoch(epoch)
            if shot.kind == "aim":
                self._aim(shot, markers_of_aims.get(shot.t), epoch, eye)
                continue
            # A frame stays on the plane until the next shot, which has its own or none.
            if shot.number in self.textured:
                plane_is_plain = False
            elif not plane_is_plain:
                corners = scene.plane_corners_mm(self.model.probe, self._depth_mm())
                self.rec.log("world/stage/plane", shapes.plane_mesh(corners, None))
                self.rec.log("world/stage/outline", shapes.plane_outline(corners))
                plane_is_plain = True
            if shot.kind == "pair":
                self._pair(shot, looks[shot.position], eye)
            else:
                self._track(shot, epoch, eye)
        self.draw_end()

    def draw_end(self, *, from_now: bool = False) -> None:
        """Draw what does not belong to a shot: verdict, plots, summary, the true PMs.

        ``from_now``: the verdict holds from the present moment on, not for all times.
        """
        verdict = self.estimate.verdict
        words = HEADINGS[verdict].removeprefix("# ")
        banner.draw(self.rec, verdict, words, palette.VERDICTS[verdict], static=not from_now)
        self._plots()
        self._static(self.rec.log if from_now else self.rec.static)

    def eye(self) -> Eye:
        """The eye of the 3D view."""
        lens = None if self.model.camera is None else self.model.camera.left
        picture = None
        for epoch in self.estimate.epochs:
            if _is_near(epoch.trus_T_camera):
                corners = scene.frustum_strips_mm(lens, self._picture_mm())[0][:4]
                picture = transform_points(epoch.trus_T_camera, corners)
        return scene.best_eye(self.eye_points(), self.view, picture)

    def eye_points(self) -> FloatArray:
        """(n, 3) points that the initial view must contain: probe, planes, cameras and markers."""
        probe = self.model.probe
        corners = scene.plane_corners_mm(probe, self._depth_mm())
        scans = [pair.look.scan_rad for pair in self.measurements.pairs] or [0.0]
        points = [scene.probe_points_mm(probe)]
        points += [transform_points(scene.trus_T_plane(scan), corners) for scan in (min(scans), max(scans))]
        for epoch in self.estimate.epochs:
            if _is_near(epoch.trus_T_camera):
                mine = [pair.marker.camera_T_marker for pair in self.measurements.pairs if pair.epoch == epoch.index]
                origins = [camera_T_marker[:3, 3] for camera_T_marker in mine]
                points.append(transform_points(epoch.trus_T_camera, np.array([np.zeros(3), *origins])))
        if self.truth is not None:
            points += [true[:3, 3][None] for true in self.truth.trus_T_camera if _is_near(true)]
        return np.concatenate(points)

    def _picture_mm(self) -> float:
        """Distance from the camera at which its picture is drawn."""
        depths = [pair.marker.camera_T_marker[2, 3] for pair in self.measurements.pairs]
        return PICTURE_AT * float(np.median(depths)) if depths else shapes.IMAGE_DISTANCE_MM

    # ---- one shot ----

    def _epoch(self, epoch: int) -> None:
        trus_T_camera = self._trus_T_camera(epoch)
        self.rec.log("world/camera", shapes.transform(trus_T_camera))
        shapes.color_cameras(self.rec, self.model, self._picture_mm(), refused=self._refused(epoch))
        known = self.estimate.epochs[epoch] if epoch < len(self.estimate.epochs) else None
        if known is None or not known.targets:
            target_map.clear(self.rec)
        else:
            bounds = np.array([target.p95_mm for target in known.targets])
            names = [target.name for target in known.targets]
            target_map.draw(self.rec, self.model.targets_mm, bounds, self.limit_mm, names)
        if self.truth is not None and epoch < len(self.truth.trus_T_camera):
            camera = None if self.model.camera is None else self.model.camera.left
            outline = scene.frustum_strips_mm(camera, self._picture_mm() / 3.0)
            outline = [transform_points(self.truth.trus_T_camera[epoch], strip) for strip in outline]
            self.rec.log("world/truth/camera", shapes.strips(outline, palette.TRUTH, 1.2))

    def _pair(self, shot: scene.Shot, measured: Pair | None, eye: Eye) -> None:
        pair = self.estimate.pairs[shot.position]
        color = palette.PM if pair.used else palette.UNUSED
        marker = None if measured is None else measured.marker
        self._marker(marker)
        beam = self._beam(marker, pair.lambda_mm if pair.used else None, pair.epoch)
        look = None if measured is None else measured.look
        plane = self._sound(pair, look)
        spot = None
        if pair.trus_p_pm_mm is None:
            self.rec.clear("world/shot/pm")
        else:
            spot = f"PM {pair.pm}" + ("" if pair.used else ", not used"), pair.trus_p_pm_mm
            self.rec.log("world/shot/pm", shapes.point(pair.trus_p_pm_mm, color, 5.0))
        arc = None if look is None else scene.arc_strip_mm(look, self.model.probe)
        entity, parts = shapes.look(shot.number, arc=arc, beam=beam, pm=pair.trus_p_pm_mm, used=pair.used)
        if pair.trus_p_pm_mm is not None and pair.covariance is not None:
            parts.append(shapes.ellipsoids(pair.trus_p_pm_mm[None], pair.covariance[None], color))
        if parts:
            self.rec.log(entity, *parts)
        self._words(eye, pair.epoch, marker, spot, plane)
        self._see(shot, pair.epoch, beam, None if plane is None else plane[1])
        self._say(shot, f"pair, PM {pair.pm}", pair.used, pair.reason, pair.residual_mm)

    def _sound(self, pair: PairEstimate, look: Look | None) -> tuple[str, FloatArray] | None:
        """Draw the arc, the sound path, and the image plane of a look; returns the plane's words and corners."""
        if look is None:
            self.rec.clear("world/shot/arc", "world/shot/sound")
            return None
        probe, color = self.model.probe, palette.SOUND if pair.used else palette.UNUSED
        strip = scene.arc_strip_mm(look, probe)
        self.rec.log("world/shot/arc", shapes.strips([strip], color, 3.0))
        theta = look.scan_rad if pair.theta_rad is None else pair.theta_rad
        way = np.stack([scene.element_centre_mm(look, probe), scene.arc_point_mm(look, probe, theta)])
        self.rec.log("world/shot/sound", shapes.strips([way], color, 1.5))
        device_deg = math.degrees(self.model.stage.device_from_scan(look.scan_rad))
        return self._stage(look.scan_rad, f"image plane, stage {device_deg:.1f}°")

    def _aim(self, shot: scene.Shot, marker: MarkerObservation | None, epoch: int, eye: Eye) -> None:
        aim = self.estimate.aims[shot.position]
        self.rec.clear("world/shot/arc", "world/shot/sound", "world/shot/pm")
        self._marker(marker)
        beam = self._beam(marker, aim.lambda_mm, epoch)
        self._words(eye, epoch, marker, None, None)
        self._see(shot, epoch, beam, None)
        self._say(shot, "calibration shot", aim.used, aim.reason, aim.residual_mm)

    def _track(self, shot: scene.Shot, epoch: int, eye: Eye) -> None:
        answer = self.estimate.tracks[shot.position]
        query = self._query_of(answer)
        marker = None if query is None else query.marker
        self.rec.clear("world/shot/arc", "world/shot/sound")
        self._marker(marker)
        beam = self._beam(marker, answer.lambda_mm, epoch)
        spot = plane = None
        if beam is None:
            self.rec.clear("world/shot/pm")
        else:
            spot = "predicted spot", beam[1]
            self.rec.log("world/shot/pm", shapes.point(beam[1], palette.PM, 5.0))
        if answer.stage_rad is None:
            self._say(shot, "track", False, answer.reason, None)
        else:
            sigma = "" if answer.sigma_rad is None else f" ± {math.degrees(answer.sigma_rad):.1f}° (1 sigma)"
            turn = f"turn the stage to {math.degrees(answer.stage_rad):.1f}°{sigma}"
            plane = self._stage(self.model.stage.scan_from_device(answer.stage_rad), turn)
            self._say(shot, f"track: {turn}", True, "", None)
        self._words(eye, epoch, marker, spot, plane)
        self._see(shot, epoch, beam, None if plane is None else plane[1])

    def _stage(self, scan_rad: float, words: str) -> tuple[str, FloatArray]:
        """Turn the image plane; returns its words and its corners (4, 3), TRUS mm."""
        trus_T_plane = scene.trus_T_plane(scan_rad)
        self.rec.log("world/stage", shapes.transform(trus_T_plane))
        return words, transform_points(trus_T_plane, scene.plane_corners_mm(self.model.probe, self._depth_mm()))

    def _marker(self, marker: MarkerObservation | None) -> None:
        self.rec.log("world/camera/marker", shapes.transform(None if marker is None else marker.camera_T_marker))

    def _words(
        self,
        eye: Eye,
        epoch: int,
        marker: MarkerObservation | None,
        spot: tuple[str, FloatArray] | None,
        plane: tuple[str, FloatArray] | None,
    ) -> None:
        shot_labels.draw(
            self.rec,
            self.model,
            (eye, self.view),
            trus_T_camera=self._trus_T_camera(epoch),
            refused=self._refused(epoch),
            camera_T_marker=None if marker is None else marker.camera_T_marker,
            marker_T_laser=None if self.estimate.laser is None else self.estimate.laser.marker_T_laser,
            spot=spot,
            plane=plane,
        )

    def _see(self, shot: scene.Shot, epoch: int, beam: FloatArray | None, plane: FloatArray | None) -> None:
        """Draw into the endoscope's picture what the surgeon would see there."""
        if self.model.camera is None:
            return
        if self._refused(epoch):
            endoscope_view.say_refused(self.rec, self.model.camera.left)
            return
        spots: dict[bool, list[FloatArray]] = {True: [], False: []}
        for pair in self.estimate.pairs:
            if pair.t <= shot.t and pair.trus_p_pm_mm is not None:
                spots[pair.used].append(pair.trus_p_pm_mm)
        seen = Seen(plane, beam, np.reshape(spots[True], (-1, 3)), np.reshape(spots[False], (-1, 3)))
        endoscope_view.draw(self.rec, self.model.camera.left, self._trus_T_camera(epoch), seen)

    def _beam(self, marker: MarkerObservation | None, lambda_mm: float | None, epoch: int) -> FloatArray | None:
        """Draw the beam; returns the laser frame's origin and the spot (2, 3)."""
        trus_T_camera, laser = self._trus_T_camera(epoch), self.estimate.laser
        if marker is None or lambda_mm is None or trus_T_camera is None or laser is None:
            self.rec.clear("world/shot/beam")
            return None
        trus_T_laser = trus_T_camera @ marker.camera_T_marker @ laser.marker_T_laser
        origin, tip = scene.laser_origin_and_tip(trus_T_laser, lambda_mm)
        self.rec.log("world/shot/beam", shapes.arrow(origin, tip, palette.BEAM, 2.5))
        return np.stack([origin, tip])

    def _say(self, shot: scene.Shot, what: str, used: bool, reason: str, residual_mm: float | None) -> None:
        words = [f"shot {shot.number}: {what}"] if used else [f"shot {shot.number}: {what}", f"not used: {reason}"]
        if residual_mm is not None:
            words.append(f"residual {residual_mm:.3f} mm")
        self.rec.log(f"log/{shot.number}", rr.TextLog(", ".join(words), level="INFO" if used else "WARN"))

    # ---- once ----

    def _plots(self) -> None:
        series: dict[str, list[tuple[int, float, float]]] = {}
        for shot in scene.shots_of(self.estimate):
            values: dict[str, float | None]
            if shot.kind == "pair":
                pair = self.estimate.pairs[shot.position]
                name = "pair" if pair.used else "pair_not_used"
                turn = None if pair.rotation_rad is None else math.degrees(pair.rotation_rad)
                values = {f"residual_mm/{name}": pair.residual_mm, f"nis/{name}": pair.nis}
                values |= {f"rotation_deg/{name}": turn, f"lambda_mm/{name}": pair.lambda_mm}
            elif shot.kind == "aim":
                aim = self.estimate.aims[shot.position]
                values = {"residual_mm/aim": aim.residual_mm, "nis/aim": aim.nis, "lambda_mm/aim": aim.lambda_mm}
            else:
                values = {"lambda_mm/track": self.estimate.tracks[shot.position].lambda_mm}
            for path, value in values.items():
                if value is not None and math.isfinite(value):
                    series.setdefault(path, []).append((shot.number, shot.t, value))
        for path, rows in series.items():
            numbers, seconds, scalars = zip(*rows, strict=True)
            self.rec.series(f"plots/{path}", numbers, seconds, scalars)
        ends = [row for path, rows in series.items() if path.startswith("nis/") for row in rows]
        if ends:
            first, last = min(ends), max(ends)
            limits = [scene.CHI2_95_2] * 2
            self.rec.series("plots/nis/limit_95", (first[0], last[0]), (first[1], last[1]), limits)

    def _static(self, log: Callable[..., None]) -> None:
        if self.truth is not None and self.truth.trus_p_pm_mm:
            known = np.array(list(self.truth.trus_p_pm_mm.values()))
            self.rec.static("world/truth/pms", shapes.small_points(known, palette.TRUTH, 2.5))
        page = summary_markdown(self.model, self.estimate, self._camera_errors(), self.limit_mm)
        if self.estimate.laser is not None:
            fibre = np.array([np.zeros(3), self.estimate.laser.marker_T_laser[:3, 3]])
            self.rec.static("world/camera/marker/fibre", shapes.strips([fibre], palette.MARKER, 1.0))
            laser = shapes.transform(self.estimate.laser.marker_T_laser)
            self.rec.static("world/camera/marker/laser", laser, shapes.axes(6.0))
        log("summary", rr.TextDocument(page, media_type="text/markdown"))

    def _camera_errors(self) -> list[tuple[float, float]]:
        """Per epoch with a known truth: error of the camera, mm and rad."""
        true = () if self.truth is None else self.truth.trus_T_camera
        errors = []
        for epoch, true_trus_T_camera in zip(self.estimate.epochs, true, strict=False):
            if epoch.trus_T_camera is not None:
                error = inverse(true_trus_T_camera) @ epoch.trus_T_camera
                turn = float(np.linalg.norm(log_so3(error[:3, :3])))
                errors.append((float(np.linalg.norm(error[:3, 3])), turn))
        return errors

    def _trus_T_camera(self, epoch: int) -> FloatArray | None:
        return self.estimate.epochs[epoch].trus_T_camera if epoch < len(self.estimate.epochs) else None

    def _refused(self, epoch: int) -> bool:
        """Whether an epoch's registration, or that of the session, is not to be used."""
        refused = self.estimate.verdict is Verdict.REFUSED
        return refused or (epoch < len(self.estimate.epochs) and self.estimate.epochs[epoch].verdict is Verdict.REFUSED)

    def _epoch_of(self, shot: scene.Shot) -> int:
        if shot.kind == "pair":
            return self.estimate.pairs[shot.position].epoch
        if shot.kind == "track" and (query := self._query_of(self.estimate.tracks[shot.position])) is not None:
            return query.epoch
        return max(0, sum(epoch.start_s <= shot.t for epoch in self.estimate.epochs) - 1)

    def _query_of(self, answer: TrackEstimate) -> Track | None:
        """The query of a track's result; None where its marker was not found."""
        return next((track for track in self.tracks if track.t == answer.t), None)

    def _depth_mm(self) -> float:
        """Depth of the drawn image plane: beyond the farthest PM and the farthest target."""
        ranges = [pair.look.range_mm for pair in self.measurements.pairs]
        beyond = float(np.linalg.norm(self.model.targets_mm[:, 1:], axis=1).max()) - self.model.probe.radius_mm
        return max([*ranges, beyond]) + 5.0


def _is_near(trus_T_camera: FloatArray | None) -> TypeGuard[FloatArray]:
    """Whether a camera is included in the initial view."""
    return trus_T_camera is not None and float(np.linalg.norm(trus_T_camera[:3, 3])) <= FAR_MM


def measured_pairs(pairs: Sequence[PairEstimate], measurements: Measurements) -> tuple[Pair | None, ...]:
    """The measured pair of each estimated look; None where nothing was measured (no marker, no sound).

    Estimates list every look of the session, measurements only the detected ones. Both are in event order and are
    matched by ``t`` and ``pm``. Where several looks share both, used looks are matched first.
    """
    waiting: dict[tuple[float, int], list[Pair]] = {}
    for pair in measurements.pairs:
        waiting.setdefault((pair.t, pair.pm), []).append(pair)
    found: list[Pair | None] = [None] * len(pairs)
    for position in sorted(range(len(pairs)), key=lambda i: not pairs[i].used):
        queue = waiting.get((pairs[position].t, pairs[position].pm))
        if queue:
            found[position] = queue.pop(0)
    return tuple(found)
