"""Draws shots with the estimate at their time: the registration changes as pairs come in."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import rerun as rr

from fgreg.geometry.target_error import target_bounds_mm
from fgreg.geometry.transforms import FloatArray, transform_points
from fgreg.model.estimate import PredictedTre, TrackEstimate, Verdict, worst_verdict
from fgreg.model.measurements import Aim, Look, Pair, Track
from fgreg.model.session_model import SessionModel
from fgreg.viewer import banner, endoscope_view, palette, scene, shapes, shot_labels, target_map
from fgreg.viewer.blueprint import WORLD_PX
from fgreg.viewer.endoscope_lines import Seen
from fgreg.viewer.palette import Color
from fgreg.viewer.scene import Eye, Reach, nearest_on
from fgreg.viewer.status_line import Now, goal_line, now_markdown

LARGEST_PLOTTED_MM = 30.0
"""Larger predicted errors are plotted at this value."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewerUpdate:
    """One shot, and the estimate right after it.

    Attributes:
        t: seconds. number: of the shot among all aims, pairs and tracks, from 0.
        shot: the measurement; None where nothing was detected, and for a camera move.
        note: a line for the log.
        trus_T_camera: (4, 4), None where there is none yet. covariance: (6, 6) over its right tangent.
        marker_T_laser: (4, 4), None where there is none yet.
        tre, verdict, reasons, pairs, nis, used: as in an online estimate.
        answer: result of a track.
        now: status of a live session; None in a replay.
        epoch: of the camera.
    """

    t: float
    number: int
    shot: Aim | Pair | Track | None
    note: str
    trus_T_camera: FloatArray | None
    covariance: FloatArray | None
    marker_T_laser: FloatArray | None
    tre: PredictedTre | None
    verdict: Verdict
    reasons: tuple[str, ...]
    pairs: int
    nis: float | None
    used: bool
    answer: TrackEstimate | None = None
    now: Now | None = None
    epoch: int = 0


class LiveDrawing:
    """Draws updates in order into a recording that :meth:`fgreg.viewer.recording.Viewer.session` started.

    Attributes:
        eye: of the scene, for its labels.
    """

    def __init__(self, rec: shapes.Recorder, model: SessionModel, limit_mm: float) -> None:
        self._rec, self._model, self._limit_mm = rec, model, limit_mm
        self.eye: Eye | None = None
        self._refused: bool | None = None
        self._banner: tuple[str, Color, Verdict | None] | None = None
        self._pms: list[FloatArray] = []
        self._unused: list[FloatArray] = []
        self._plane_words: tuple[str, FloatArray] | None = None
        self._plane_is_plain = False
        self._last = (0.0, 0)
        self._depth_mm = scene.image_depth_mm(model.probe, model.targets_mm)

    def draw(self, update: ViewerUpdate, *, textured: bool) -> None:
        """Draw one update; ``textured``: its frame is already on the image plane."""
        self._last = (update.t, update.number)
        self._rec.at(*self._last)
        self._registration(update)
        shot = update.shot
        if update.now is not None and "camera" in update.now.lost:
            self._rec.log("world/camera/marker", shapes.transform(None))
        elif shot is not None:
            self._rec.log("world/camera/marker", shapes.transform(shot.marker.camera_T_marker))
        if not isinstance(shot, Pair | Track) or not (isinstance(shot, Pair) or shot.looks):
            self._rec.clear("world/shot/arc", "world/shot/sound")
        if not isinstance(shot, Aim):
            self._plane(textured)
        beam = spot = None
        match shot:
            case Pair():
                beam, spot = self._pair(update, shot)
            case Track():
                beam, spot = self._track(update, shot)
            case _:
                self._rec.clear("world/shot/pm", "world/shot/beam")
        if update.now is not None:
            self._now(update.now)
        if (shown := verdict_shown(update)) != self._banner:
            self._banner = shown
            word, color, verdict = shown
            banner.draw(self._rec, verdict, word, color)
        lost = update.now is not None and "camera" in update.now.lost
        self._words(update, None if lost else spot)
        self._see(update, None if lost else beam)
        self._figures(update)

    def _words(self, update: ViewerUpdate, spot: tuple[str, FloatArray] | None) -> None:
        shot_labels.draw(
            self._rec,
            self._model,
            (self.eye, WORLD_PX),
            trus_T_camera=update.trus_T_camera,
            refused=update.verdict is Verdict.REFUSED,
            camera_T_marker=None if update.shot is None else update.shot.marker.camera_T_marker,
            marker_T_laser=update.marker_T_laser,
            spot=spot,
            plane=self._plane_words,
        )

    def _see(self, update: ViewerUpdate, beam: FloatArray | None) -> None:
        """Draw into the endoscope's picture what the surgeon would see there."""
        if self._model.camera is None:
            return
        left = self._model.camera.left
        if update.trus_T_camera is not None and update.verdict is Verdict.REFUSED:
            endoscope_view.say_refused(self._rec, left)
            return
        plane = None if self._plane_words is None else self._plane_words[1]
        seen = Seen(plane, beam, np.reshape(self._pms, (-1, 3)), np.reshape(self._unused, (-1, 3)))
        endoscope_view.draw(self._rec, left, update.trus_T_camera, seen)

    def _now(self, now: Now) -> None:
        """Draw the current and the desired stage angle."""
        rec, stage = self._rec, self._model.stage
        if now.scan_rad is None:
            rec.log("world/stage", shapes.transform(None))
            self._plane_words = None
        else:
            device_deg = math.degrees(stage.device_from_scan(now.scan_rad))
            self._stage(now.scan_rad, f"image plane, stage {device_deg:.1f}°")
            rec.log("online/stage_deg/plane", rr.Scalars(device_deg))
        if now.goal_rad is None:
            rec.clear("world/goal")
        else:
            goal_deg = math.degrees(stage.device_from_scan(now.goal_rad))
            corners = scene.plane_corners_mm(self._model.probe, self._depth_mm)
            rec.log("world/goal", shapes.transform(scene.trus_T_plane(now.goal_rad)))
            rec.log("world/goal/outline", shapes.plane_outline(corners, palette.GOAL))
            label = f"beam at {goal_line(now, stage)}"
            rec.log("world/goal/label", shapes.point(corners[3], palette.GOAL, 1.0, label))
            rec.log("online/stage_deg/beam", rr.Scalars(goal_deg))

    def _registration(self, update: ViewerUpdate) -> None:
        transform, covariance = update.trus_T_camera, update.covariance
        self._rec.log("world/camera", shapes.transform(transform))
        refused = update.verdict is Verdict.REFUSED
        if transform is not None and refused is not self._refused:
            self._refused = refused
            shapes.color_cameras(self._rec, self._model, shapes.IMAGE_DISTANCE_MM, refused=refused)
        worst_mm = math.inf if update.tre is None else update.tre.worst_mm
        if transform is None or covariance is None or not math.isfinite(worst_mm):
            target_map.clear(self._rec)
            return
        bounds = target_bounds_mm(covariance, transform, self._model.targets_mm, worst_mm)
        target_map.draw(self._rec, self._model.targets_mm, bounds, self._limit_mm)

    def _plane(self, textured: bool) -> None:
        if textured:
            self._plane_is_plain = False
        elif not self._plane_is_plain:
            corners = scene.plane_corners_mm(self._model.probe, self._depth_mm)
            self._rec.log("world/stage/plane", shapes.plane_mesh(corners, None))
            self._rec.log("world/stage/outline", shapes.plane_outline(corners))
            self._plane_is_plain = True

    def _pair(self, update: ViewerUpdate, pair: Pair) -> tuple[FloatArray | None, tuple[str, FloatArray] | None]:
        strip = self._arc(pair.look)
        used = update.used
        beam = self._beam(update, pair, nearest_on(strip))
        spot = None if beam is None else beam[1]
        entity, parts = shapes.look(update.number, arc=strip, beam=beam if used else None, pm=spot, used=used)
        self._rec.log(entity, *parts)
        if beam is None:
            self._rec.clear("world/shot/pm")
            return None, None
        spot = beam[1]
        color = palette.PM if used else palette.UNUSED
        (self._pms if used else self._unused).append(spot)
        self._rec.log("world/shot/pm", shapes.point(spot, color, 5.0))
        return beam, (f"PM {pair.pm}" + ("" if used else ", not used"), spot)

    def _track(self, update: ViewerUpdate, query: Track) -> tuple[FloatArray | None, tuple[str, FloatArray] | None]:
        answer = update.answer
        if query.looks:
            self._arc(query.looks[-1])
        lambda_mm = None if answer is None else answer.lambda_mm
        beam = self._beam(update, query, lambda _origin, _direction: lambda_mm)
        if beam is None:
            self._rec.clear("world/shot/pm")
        else:
            self._rec.log("world/shot/pm", shapes.point(beam[1], palette.PM, 5.0))
        if update.now is None and answer is not None and answer.stage_rad is not None:
            label = f"turn the stage to {math.degrees(answer.stage_rad):.1f}°"
            self._stage(self._model.stage.scan_from_device(answer.stage_rad), label)
        return beam, None if beam is None else ("predicted spot", beam[1])

    def _arc(self, look: Look) -> FloatArray:
        strip = scene.arc_strip_mm(look, self._model.probe)
        self._rec.log("world/shot/arc", shapes.strips([strip], palette.SOUND, 3.0))
        device_deg = math.degrees(self._model.stage.device_from_scan(look.scan_rad))
        self._stage(look.scan_rad, f"image plane, stage {device_deg:.1f}°")
        return strip

    def _stage(self, scan_rad: float, label: str) -> None:
        trus_T_plane = scene.trus_T_plane(scan_rad)
        self._rec.log("world/stage", shapes.transform(trus_T_plane))
        corners = scene.plane_corners_mm(self._model.probe, self._depth_mm)
        self._plane_words = label, transform_points(trus_T_plane, corners)

    def _beam(self, update: ViewerUpdate, shot: Pair | Track, reach: Reach) -> FloatArray | None:
        """Draw the shot's beam; returns the origin and its end (2, 3), TRUS mm; ``reach`` gives its length."""
        transform, laser = update.trus_T_camera, update.marker_T_laser
        if transform is None or laser is None:
            self._rec.clear("world/shot/beam")
            return None
        trus_T_laser = transform @ shot.marker.camera_T_marker @ laser
        lambda_mm = reach(trus_T_laser[:3, 3], trus_T_laser[:3, 2])
        if lambda_mm is None:
            self._rec.clear("world/shot/beam")
            return None
        origin, tip = scene.laser_origin_and_tip(trus_T_laser, lambda_mm)
        self._rec.log("world/shot/beam", shapes.arrow(origin, tip, palette.BEAM, 2.5))
        return np.stack([origin, tip])

    def _figures(self, update: ViewerUpdate) -> None:
        rec = self._rec
        if update.tre is not None and math.isfinite(update.tre.worst_mm):
            rec.log("online/predicted_worst_mm/worst", rr.Scalars(min(update.tre.worst_mm, LARGEST_PLOTTED_MM)))
        rec.log("online/pairs/used", rr.Scalars(float(update.pairs)))
        if update.nis is not None and math.isfinite(update.nis):
            rec.log("online/nis/pair", rr.Scalars(update.nis))
        if update.note:
            level = {Verdict.OK: "INFO", Verdict.WARNING: "WARN", Verdict.REFUSED: "ERROR"}[update.verdict]
            state = update.verdict.value
            if update.trus_T_camera is None:
                level, state = "INFO", "no registration yet"
            rec.log(f"log/{update.number}", rr.TextLog(f"{update.note} [{state}]", level=level))
        rec.log("summary", rr.TextDocument(self._page(update), media_type="text/markdown"))

    def _page(self, update: ViewerUpdate) -> str:
        if update.now is None:
            return update_markdown(update)
        verdict = None if update.trus_T_camera is None else update.verdict
        return now_markdown(
            update.now, self._model.stage, verdict, update.tre, update.pairs, update.epoch, update.reasons
        )

    def to_end(self) -> None:
        """Set the time to that of the last update for what is logged next."""
        self._rec.at(*self._last)


def verdict_shown(update: ViewerUpdate) -> tuple[str, Color, Verdict | None]:
    """The verdict as a word, a colour and a sign; a lost device overrides those of a good registration."""
    lost = () if update.now is None else update.now.lost
    gone = f"; LOST: {', '.join(lost)}" if lost else ""
    if update.trus_T_camera is None:
        return f"no registration yet{gone}", palette.VERDICTS[Verdict.WARNING] if lost else palette.UNUSED, None
    shown = worst_verdict(update.verdict, Verdict.WARNING if lost else Verdict.OK)
    return f"{update.verdict.value.upper()}{gone}", palette.VERDICTS[shown], shown


def update_markdown(update: ViewerUpdate) -> str:
    """The summary page of an update, with the estimate at that time."""
    tre = update.tre
    worst = "not known" if tre is None else f"{tre.worst_mm:.2f} mm"
    state = "No registration yet" if update.trus_T_camera is None else f"At {update.t:.1f} s: {update.verdict.value}"
    lines = [f"# {state}", "", f"After {update.note}.", "", f"Pairs used in this camera epoch: {update.pairs}.", ""]
    lines += [f"Predicted error at the worst target, 95 % bound: {worst}.", ""]
    return "\n".join([*lines, *(f"- {reason}" for reason in update.reasons)])
