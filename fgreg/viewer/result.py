"""Draws a session's result into its recording: shots, plots, summary, and the points that the view must contain."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import rerun as rr

from fgreg.geometry.transforms import FloatArray, inverse, log_so3, transform_points
from fgreg.model.estimate import PairEstimate, SessionEstimate, TrackEstimate, Verdict
from fgreg.model.measurements import Look, MarkerObservation, Measurements, Pair, Track
from fgreg.model.session_model import SessionModel
from fgreg.viewer import scene as scene
from fgreg.viewer import shapes as shapes
from fgreg.viewer.summary_page import summary_markdown

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
    """

    rec: shapes.Recorder
    model: SessionModel
    measurements: Measurements
    estimate: SessionEstimate
    truth: Truth | None
    tracks: tuple[Track, ...]
    textured: frozenset[int]

    def draw(self) -> None:
        """Draw everything."""
        looks = measured_pairs(self.estimate.pairs, self.measurements)
        markers_of_aims = {aim.t: aim.marker for aim in self.measurements.aims}
        epoch, plane_is_plain = -1, False
        for shot in scene.shots_of(self.estimate):
            self.rec.at(shot.t, shot.number)
            if (now := self._epoch_of(shot)) != epoch:
                epoch = now
                self._epoch(epoch)
            if shot.kind == "aim":
                self._aim(shot.position, markers_of_aims.get(shot.t), epoch)
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
                self._pair(self.estimate.pairs[shot.position], looks[shot.position])
            else:
                self._track(shot.position, epoch)
        self.draw_end()

    def draw_end(self, *, from_now: bool = False) -> None:
        """Draw what does not belong to a shot: plots, summary, the true PMs.

        ``from_now``: the verdict holds from the present moment on, not for all times.
        """
        if self.estimate.verdict is Verdict.REFUSED:
            shapes.draw_cameras(self.rec, self.model, shapes.REFUSED)
        self._plots()
        self._static(self.rec.log if from_now else self.rec.static)

    def eye_points(self) -> FloatArray:
        """(n, 3) points that the initial view must contain: probe, planes, cameras and markers."""
        probe = self.model.probe
        half = scene.array_length_mm(probe) / 2.0 + 10.0
        corners = scene.plane_corners_mm(probe, self._depth_mm())
        scans = [pair.look.scan_rad for pair in self.measurements.pairs] or [0.0]
        points = [np.array([[-half, 0.0, -probe.radius_mm], [half, 0.0, -probe.radius_mm]])]
        points += [transform_points(scene.trus_T_plane(scan), corners) for scan in (min(scans), max(scans))]
        for epoch in range(len(self.estimate.epochs)):
            trus_T_camera = self._trus_T_camera(epoch)
            if trus_T_camera is None or np.linalg.norm(trus_T_camera[:3, 3]) > FAR_MM:
                continue
            origins = [pair.marker.camera_T_marker[:3, 3] for pair in self.measurements.pairs if pair.epoch == epoch]
            points.append(transform_points(trus_T_camera, np.array([np.zeros(3), *origins])))
        return np.concatenate(points)

    def trus_view(self) -> FloatArray | None:
        """(3,) the direction in which the last camera looks."""
        for epoch in reversed(self.estimate.epochs):
            if epoch.trus_T_camera is not None:
                return np.asarray(epoch.trus_T_camera[:3, 2])
        return None

    # ---- one shot ----

    def _epoch(self, epoch: int) -> None:
        trus_T_camera = self._trus_T_camera(epoch)
        covariance = self.estimate.epochs[epoch].covariance if epoch < len(self.estimate.epochs) else None
        self.rec.log("world/camera", shapes.transform(trus_T_camera))
        if trus_T_camera is None or covariance is None:
            self.rec.clear("world/targets")
        else:
            targets = self.model.targets_mm
            covariances = scene.target_covariances(trus_T_camera, covariance, targets)
            centres = shapes.small_points(targets, shapes.TARGET, 1.2)
            self.rec.log("world/targets", shapes.ellipsoids(targets, covariances, shapes.TARGET), centres)
        if self.truth is not None and epoch < len(self.truth.trus_T_camera):
            camera = None if self.model.camera is None else self.model.camera.left
            outline = scene.frustum_strips_mm(camera, shapes.IMAGE_DISTANCE_MM / 3.0)
            outline = [transform_points(self.truth.trus_T_camera[epoch], strip) for strip in outline]
            self.rec.log("world/truth/camera", shapes.strips(outline, shapes.TRUTH, 1.2))

    def _pair(self, pair: PairEstimate, measured: Pair | None) -> None:
        color = shapes.PM if pair.used else shapes.UNUSED
        marker = None if measured is None else measured.marker
        self._marker(marker)
        self._beam(marker, pair.lambda_mm if pair.used else None, pair.epoch, keep=True)
        self._sound(pair, None if measured is None else measured.look)
        if pair.trus_p_pm_mm is None:
            self.rec.clear("world/shot/pm")
        else:
            label = f"PM {pair.pm}" + ("" if pair.used else " (not used)")
            self.rec.log("world/shot/pm", shapes.point(pair.trus_p_pm_mm, color, 5.0, label))
            # The point has the same size at every zoom, for ellipsoids that are too small to see.
            centre = shapes.small_points(pair.trus_p_pm_mm[None], color, 3.5)
            self.rec.log("world/looks/pm", centre)
            if pair.covariance is not None:
                one = shapes.ellipsoids(pair.trus_p_pm_mm[None], pair.covariance[None], color)
                self.rec.log("world/looks/pm_95", one)
        self._say(f"pair, PM {pair.pm}", pair.used, pair.reason, pair.residual_mm)

    def _sound(self, pair: PairEstimate, look: Look | None) -> None:
        """Draw the arc, the sound path, and the image plane of a look."""
        if look is None:
            self.rec.clear("world/shot/arc", "world/shot/sound")
            return
        probe, color = self.model.probe, shapes.SOUND if pair.used else shapes.UNUSED
        strip = scene.arc_strip_mm(look, probe)
        self.rec.log("world/looks/arc", shapes.strips([strip], color, 1.0))
        self.rec.log("world/shot/arc", shapes.strips([strip], color, 3.0))
        theta = look.scan_rad if pair.theta_rad is None else pair.theta_rad
        way = np.stack([scene.element_centre_mm(look, probe), scene.arc_point_mm(look, probe, theta)])
        self.rec.log("world/shot/sound", shapes.strips([way], color, 1.5, f"sound, {look.range_mm:.1f} mm"))
        device_deg = math.degrees(self.model.stage.device_from_scan(look.scan_rad))
        self._stage(look.scan_rad, f"image plane, stage {device_deg:.1f}°")

    def _aim(self, position: int, marker: MarkerObservation | None, epoch: int) -> None:
        aim = self.estimate.aims[position]
        self.rec.clear("world/shot/arc", "world/shot/sound", "world/shot/pm")
        self._marker(marker)
        self._beam(marker, aim.lambda_mm, epoch, keep=False)
        self._say("calibration shot", aim.used, aim.reason, aim.residual_mm)

    def _track(self, position: int, epoch: int) -> None:
        answer = self.estimate.tracks[position]
        query = self._query_of(answer)
        marker = None if query is None else query.marker
        self.rec.clear("world/shot/arc", "world/shot/sound")
        self._marker(marker)
        spot = self._beam(marker, answer.lambda_mm, epoch, keep=False)
        if spot is None:
            self.rec.clear("world/shot/pm")
        else:
            self.rec.log("world/shot/pm", shapes.point(spot, shapes.PM, 5.0, "predicted spot"))
        if answer.stage_rad is None:
            self._say("track", False, answer.reason, None)
            return
        sigma = "" if answer.sigma_rad is None else f" ± {math.degrees(answer.sigma_rad):.1f}° (1 sigma)"
        turn = f"turn the stage to {math.degrees(answer.stage_rad):.1f}°{sigma}"
        self._stage(self.model.stage.scan_from_device(answer.stage_rad), turn)
        self._say(f"track: {turn}", True, "", None)

    def _stage(self, scan_rad: float, label: str) -> None:
        probe = self.model.probe
        self.rec.log("world/stage", shapes.transform(scene.trus_T_plane(scan_rad)))
        corner = scene.plane_corners_mm(probe, self._depth_mm())[2]
        self.rec.log("world/stage/label", shapes.point(corner, shapes.SOUND, 1.0, label))

    def _marker(self, marker: MarkerObservation | None) -> None:
        self.rec.log("world/camera/marker", shapes.transform(None if marker is None else marker.camera_T_marker))

    def _beam(
        self, marker: MarkerObservation | None, lambda_mm: float | None, epoch: int, *, keep: bool
    ) -> FloatArray | None:
        """Draw the beam from the laser frame's origin to its spot (3,), which is returned; ``keep`` keeps it drawn."""
        trus_T_camera, laser = self._trus_T_camera(epoch), self.estimate.laser
        if marker is None or lambda_mm is None or trus_T_camera is None or laser is None:
            self.rec.clear("world/shot/beam")
            return None
        trus_T_laser = trus_T_camera @ marker.camera_T_marker @ laser.marker_T_laser
        origin, tip = scene.laser_origin_and_tip(trus_T_laser, lambda_mm)
        if keep:
            self.rec.log("world/looks/beam", shapes.arrow(origin, tip, shapes.BEAM, 0.7))
        self.rec.log("world/shot/beam", shapes.arrow(origin, tip, shapes.BEAM, 2.5, "laser beam"))
        return tip

    def _say(self, what: str, used: bool, reason: str, residual_mm: float | None) -> None:
        words = [what] if used else [what, f"not used: {reason}"]
        if residual_mm is not None:
            words.append(f"residual {residual_mm:.3f} mm")
        self.rec.log("log", rr.TextLog(", ".join(words), level="INFO" if used else "WARN"))

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
            self.rec.static("world/truth/pms", shapes.small_points(known, shapes.TRUTH, 2.5))
        page = summary_markdown(self.model, self.estimate, self._camera_errors())
        if self.estimate.laser is not None:
            fibre = np.array([np.zeros(3), self.estimate.laser.marker_T_laser[:3, 3]])
            self.rec.static("world/camera/marker/fibre", shapes.strips([fibre], shapes.MARKER, 1.0))
        log("summary", rr.TextDocument(page, media_type="text/markdown"))
        if self.estimate.verdict is Verdict.REFUSED:
            points = self.eye_points()
            above = (points.min(axis=0) + points.max(axis=0)) / 2.0
            above[2] = points[:, 2].max() + 5.0
            log("world/verdict", shapes.point(above, shapes.REFUSED, 9.0, "REFUSED: do not use"))

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
