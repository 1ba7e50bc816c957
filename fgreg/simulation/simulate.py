"""A whole session from a configuration and a seed: content of its files, ground truth, and frames on demand.

Forward only: beams are drawn in space, PMs are at their ends, the stage is turned until the probe detects them, and
the looks are measured there, with noise as ``session.yaml``'s ``noise`` block describes it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import (
    BoolArray,
    FloatArray,
    IntArray,
    exp_so3,
    inverse,
    make_transform,
    transform_points,
)
from fgreg.model.events import (
    EVENTS,
    AimEvent,
    CameraMovedEvent,
    Event,
    MarkerRecord,
    PairEvent,
    SpotRecord,
    TrackEvent,
    TrusRecord,
)
from fgreg.simulation import sweeps
from fgreg.simulation.array import map_by_declared
from fgreg.simulation.config import SimulationConfig, Sweep
from fgreg.simulation.deviations import named
from fgreg.simulation.disturbances import Disturbances
from fgreg.simulation.documents import degrees, round_array, rows, session_document
from fgreg.simulation.misreading import marker_poses_read, pixels_seen, points_read, spots_read
from fgreg.simulation.pictures import LookPicture, ShotPicture
from fgreg.simulation.scene import AimShots, Scene, Shots, UnseenError, draw_aim_shots, draw_pm_shots, draw_scene

Frame = npt.NDArray[np.uint8] | npt.NDArray[np.int16] | npt.NDArray[np.float32]
Document = dict[str, Any]

SCENES = 6
"""Largest number of scenes drawn until one is found in which the camera sees the marker."""


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedSession:
    """A session in memory.

    Attributes:
        config, seed: its input.
        session, events, truth: the contents of ``session.yaml``, ``events.jsonl`` and ``ground_truth.yaml``.
        frames: by the name that events use; each is rendered when called, the same every time.
        scene: the truth behind it.
        true_camera_T_marker: true marker poses by index into ``events``.
        checks: ``check`` events, to be appended to ``events``: points of the last epoch that camera and scanner see.
        check_points_mm: (checks, 3) where they truly are, TRUS.
    """

    config: SimulationConfig
    seed: int
    session: Document
    events: list[Document]
    truth: Document
    frames: Mapping[str, Callable[[], Frame]]
    scene: Scene
    true_camera_T_marker: Mapping[int, FloatArray]
    checks: list[Document]
    check_points_mm: FloatArray


def simulate(config: SimulationConfig, seed: int) -> SimulatedSession:
    """One session. The same configuration and seed give the same session.

    Geometry, observation noise, stage and frames draw from streams of their own: changing the noise leaves the
    geometry as it was.

    Raises:
        ValueError: the configuration cannot be realised (no visible marker, a PM out of the stage's reach).
    """
    return _Recorder(config, seed).record()


@dataclass(frozen=True, slots=True, eq=False)
class _Looks:
    """Recorded looks at n PMs, all (n, looks); ``source_mm`` (n, looks, 3) is the true source."""

    scan_deg: FloatArray
    sweep: IntArray
    x_mm: FloatArray
    range_mm: FloatArray
    amplitude: FloatArray
    source_mm: FloatArray
    scan_rad: FloatArray
    half_width_rad: FloatArray


class _Recorder:
    """Collects the events of one session in the order in which they happen."""

    def __init__(self, config: SimulationConfig, seed: int) -> None:
        streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(12)]
        self.config, self.seed = config, seed
        self.scene_rng, self.aim_rng, self.shot_rng, self.miss_rng = streams[:4]
        self.marker_rng, self.stage_rng, self.look_rng, self.misc_rng = streams[4:8]
        self.beside_rng, self.check_rng, self.spot_rng, self.point_rng = streams[8:]
        self.events: list[Document] = []
        self.frames: dict[str, Callable[[], Frame]] = {}
        self.true_markers: dict[int, FloatArray] = {}
        self.spoilt: dict[str, Disturbances] = {}
        self.time_s = 0.0

    def record(self) -> SimulatedSession:
        config = self.config
        kinds = _interleaved(config.tracks_heard, config.tracks_silent)
        pair_epochs = np.arange(config.pairs) * config.epochs // max(config.pairs, 1)
        track_epochs = np.arange(kinds.size) * config.epochs // max(kinds.size, 1)
        scene, aims, shots = self._plan(np.concatenate([pair_epochs, track_epochs]))
        if config.beam_offset_mm:
            shots = self._beside_their_beams(shots, np.concatenate([pair_epochs, track_epochs]))
        pms, tracks = _part(shots, slice(0, config.pairs)), _part(shots, slice(config.pairs, None))
        outlier = np.zeros(config.pairs, dtype=bool)
        outlier[self.misc_rng.permutation(config.pairs)[: config.outlier_pairs]] = True
        slipped = (np.arange(config.pairs) >= config.stage_slip_at * config.pairs).astype(np.float64)
        pm_looks = self._looks(config, pms.spot_mm, config.looks_per_pm, 1, outlier, config.stage_slip_rad * slipped)
        once = replace(config, sweep=Sweep.ALTERNATING) if config.sweep is Sweep.TWO_SIDED else config
        clean = np.zeros(kinds.size, dtype=bool)
        after = np.full(kinds.size, config.stage_slip_rad)
        track_looks = self._looks(once, tracks.spot_mm, config.track_looks, -1, clean, after)
        idle_deg = np.degrees(self.misc_rng.uniform(-config.pm_angle_rad, config.pm_angle_rad, kinds.size))

        self._aims(aims)
        answers: list[Document] = []
        pm_markers, track_markers = self._observed(pms), self._observed(tracks)
        for epoch in range(config.epochs):
            if epoch > 0:
                self._camera_moved(scene.camera_moves[epoch - 1])
            for i in np.flatnonzero(pair_epochs == epoch):
                self._pair(int(i), epoch, pms, pm_markers, pm_looks)
            for j in np.flatnonzero(track_epochs == epoch):
                looks = track_looks if kinds[j] else None
                self._track(int(j), epoch, tracks, track_markers, looks, float(idle_deg[j]))
                angle = sweeps.true_stage(config).device_from_scan(
                    float(config.array.plane_angle_rad(tracks.spot_mm[j]))
                )
                answers.append({"t": self.events[-1]["t"], "stage_deg": degrees(angle + config.stage_slip_rad)})
        self.events += self._seen_by_both("point", config.points, self.point_rng)[0]
        checks, check_points = self._seen_by_both("check", config.checks, self.check_rng)
        return SimulatedSession(
            config,
            self.seed,
            session_document(config, self._rough_laser() if config.initial_laser else None),
            self.events,
            self._truth(pms, answers, outlier),
            self.frames,
            scene,
            self.true_markers,
            checks,
            check_points,
        )

    def _plan(self, epochs: IntArray) -> tuple[Scene, AimShots, Shots]:
        """Draw scene and shots, again if the camera cannot see the marker."""
        miss = self.miss_rng.standard_normal((self.config.aims, 3))
        for attempt in range(SCENES):
            self.scene = draw_scene(self.config, self.scene_rng)
            try:
                aims = draw_aim_shots(self.config, self.scene, self.aim_rng, miss)
                return self.scene, aims, draw_pm_shots(self.config, self.scene, epochs, self.shot_rng)
            except UnseenError:
                if attempt == SCENES - 1:
                    raise
        raise AssertionError

    def _truth(self, pms: Shots, answers: list[Document], outlier: BoolArray) -> Document:
        config, scene = self.config, self.scene
        truth = {
            "trus_T_camera": [rows(transform) for transform in scene.trus_T_camera],
            "marker_T_laser": rows(scene.marker_T_laser),
            "pms": {i: rows(spot) for i, spot in enumerate(pms.spot_mm)},
            "tracks": answers,
            "x_seed": self.seed,
            "x_window_edge_deg": degrees(scene.window_edge_rad),
            "x_marker_bias_mm": [0.0, 0.0, 0.0] if config.frames else rows(scene.marker_bias_mm),
            "x_sound_speed_ratio": config.array.sound_speed_ratio,
            "x_reversed_stage": config.reversed_stage,
            "x_reversed_elements": config.reversed_elements,
            "x_outlier_pms": [int(i) for i in np.flatnonzero(outlier)],
            "x_lambda_mm": rows(pms.lambda_mm),
        }
        if config.frames and config.disturbances != Disturbances():
            truth["x_disturbances"] = {shot: what.named() for shot, what in self.spoilt.items()}
        if config.deviations:
            truth["x_deviations"] = {name: round(value, 9) for name, value in named(config.deviations).items()}
        return truth

    def _beside_their_beams(self, shots: Shots, epochs: IntArray) -> Shots:
        """The shots with their PMs a little beside the beam, across it."""
        trus_T_camera = np.stack(self.scene.trus_T_camera)[epochs]
        trus_beam = (trus_T_camera @ shots.camera_T_marker @ self.scene.marker_T_laser)[:, :3, 2]
        away = self.config.beam_offset_mm * self.beside_rng.standard_normal(shots.spot_mm.shape)
        away -= np.sum(away * trus_beam, axis=1, keepdims=True) * trus_beam
        return replace(shots, spot_mm=shots.spot_mm + away)

    def _seen_by_both(self, kind: str, n: int, rng: np.random.Generator) -> tuple[list[Document], FloatArray]:
        """Points of the tissue as the camera (in its last place) and the scanner, turned to them, read them."""
        config = self.config
        x = rng.uniform(-config.pm_x_mm, config.pm_x_mm, n)
        trus_p = self.scene.tissue.point(x, rng.uniform(-config.pm_angle_rad, config.pm_angle_rad, n))
        camera_p = transform_points(inverse(self.scene.trus_T_camera[-1]), trus_p)
        scan = config.array.plane_angle_rad(trus_p)
        measured = config.array.x_mm(trus_p, scan), config.array.range_mm(trus_p, scan)
        by_scanner = map_by_declared(config.probe, scan + config.stage_slip_rad, *measured)
        sigma = np.array(config.check_sigma_mm)
        noise = sigma[:, None, None] * rng.standard_normal((2, n, 3))
        by_camera = rows(points_read(config, camera_p) + noise[0])
        covariances = [rows(s**2 * np.eye(3)) for s in sigma]
        events: list[Document] = [
            {
                "type": kind,
                "t": self._now(),
                "camera_p_mm": by_camera[i],
                "covariance": covariances[0],
                "trus_p_mm": rows(by_scanner[i] + noise[1, i]),
                "trus_covariance": covariances[1],
            }
            for i in range(n)
        ]
        return events, trus_p

    def _looks(
        self,
        config: SimulationConfig,
        trus_p_pm_mm: FloatArray,
        looks: int,
        first_sign: int,
        outlier: BoolArray,
        slip_rad: FloatArray,
    ) -> _Looks:
        rng, noise, array = self.look_rng, config.noise, config.array
        n = trus_p_pm_mm.shape[0]
        edge_rad = self.scene.window_edge_rad
        stops = sweeps.look(config, trus_p_pm_mm, looks, first_sign, edge_rad, self.stage_rng, slip_rad)
        looks = stops.scan_rad.shape[1]
        device = stops.device_rad + noise.scan_rad * self.stage_rng.standard_normal((n, looks))
        source = np.repeat(trus_p_pm_mm[:, None], looks, axis=1)
        outlier_x: FloatArray = rng.uniform(-config.pm_x_mm, config.pm_x_mm, (n, 1))
        outlier_rho: FloatArray = config.probe.radius_mm + rng.uniform(*config.pm_depth_mm, (n, 1))
        strength = np.exp(rng.uniform(-0.7, 0.7, n))[:, None]
        if outlier.any():
            scan = stops.scan_rad[outlier]
            rho = outlier_rho[outlier]
            x = np.broadcast_to(outlier_x[outlier], scan.shape)
            source[outlier] = np.stack([x, rho * np.sin(scan), rho * np.cos(scan)], axis=-1)
        mirror = -1.0 if config.reversed_elements else 1.0
        offset = array.rotation_rad(source, stops.scan_rad)
        amplitude = strength * config.elevation.amplitude(offset, stops.half_width_rad)
        return _Looks(
            np.degrees(device),
            stops.device_sweep,
            mirror * array.x_mm(source, stops.scan_rad) + noise.lateral_mm * rng.standard_normal((n, looks)),
            array.range_mm(source, stops.scan_rad) + noise.range_mm * rng.standard_normal((n, looks)),
            amplitude * np.exp(config.amplitude_noise * rng.standard_normal((n, looks))),
            source,
            stops.scan_rad,
            stops.half_width_rad,
        )

    def _observed(self, shots: Shots) -> list[MarkerRecord | None]:
        """A marker pose each: [Exp(w) R, t + n + bias], w and n along the camera's axes. None: frames are recorded."""
        if self.config.frames:
            return [None for _ in shots.lambda_mm]
        noise, n = self.config.noise, shots.lambda_mm.size
        w = self.marker_rng.standard_normal((n, 3)) * noise.marker_rotation_rad
        shift = self.marker_rng.standard_normal((n, 3)) * noise.marker_translation_mm + self.scene.marker_bias_mm
        read = marker_poses_read(self.config, shots.camera_T_marker)
        poses = make_transform(exp_so3(w) @ read[:, :3, :3], read[:, :3, 3] + shift)
        return [MarkerRecord(pose) for pose in round_array(poses)]

    def _aims(self, aims: AimShots) -> None:
        markers = self._observed(aims.shots)
        spots = round_array(spots_read(self.config, aims.camera_p_spot_mm, aims.camera_T_board, aims.corner))
        for i, marker in enumerate(markers):
            pose = aims.shots.camera_T_marker[i]
            if marker is None:
                marker = self._pictures(f"aim-{i:02d}", pose, aims.shots.spot_mm[i], aims.camera_T_board[i], None)
                column, row = aims.corner[i].tolist()
                event = AimEvent(self._now(), 0, marker, corner=(column, row))
            else:
                event = AimEvent(self._now(), 0, marker, spots[i])
            self._add(event, pose)

    def _pair(self, i: int, epoch: int, pms: Shots, markers: list[MarkerRecord | None], looks: _Looks) -> None:
        name = f"pm-{i:02d}"
        marker = self._pm_marker(name, i, epoch, pms, markers)
        spot = self._spot(pms.spot_mm[i], epoch) if self.config.spots else None
        for k in range(looks.scan_deg.shape[1]):
            trus = self._look(name if k == 0 else f"{name}-look-{k}", looks, i, k)
            self._add(PairEvent(self._now(), 0, i, marker, trus, spot), pms.camera_T_marker[i])

    def _spot(self, trus_p_mm: FloatArray, epoch: int) -> SpotRecord:
        """Where the true cameras see the spot whose sound comes from a point (3,)."""
        camera_p = transform_points(inverse(self.scene.trus_T_camera[epoch]), trus_p_mm)
        seen = camera_p + self.config.noise.spot_mm * self.spot_rng.standard_normal(3)
        noise = self.config.spot_px * self.spot_rng.standard_normal((2, 2))
        left, right = round_array(pixels_seen(self.config, seen) + noise)
        return SpotRecord(left=left, right=right)

    def _track(
        self,
        j: int,
        epoch: int,
        tracks: Shots,
        markers: list[MarkerRecord | None],
        looks: _Looks | None,
        idle_deg: float,
    ) -> None:
        name, t = f"track-{j:02d}", self._now()
        marker = self._pm_marker(name, j, epoch, tracks, markers)
        if looks is None:
            event = TrackEvent(t, 0, marker, scan_deg=round(idle_deg, 4))
        else:
            records = tuple(self._look(f"{name}-look-{k}", looks, j, k) for k in range(looks.scan_deg.shape[1]))
            event = TrackEvent(
                t, 0, marker, records[0] if len(records) == 1 else None, records if len(records) > 1 else ()
            )
        self._add(event, tracks.camera_T_marker[j])

    def _pm_marker(
        self, name: str, i: int, epoch: int, shots: Shots, markers: list[MarkerRecord | None]
    ) -> MarkerRecord:
        observed = markers[i]
        if observed is not None:
            return observed
        camera_T_trus = inverse(self.scene.trus_T_camera[epoch])
        spot = camera_T_trus[:3, :3] @ shots.spot_mm[i] + camera_T_trus[:3, 3]
        return self._pictures(name, shots.camera_T_marker[i], spot, None, camera_T_trus)

    def _pictures(
        self,
        name: str,
        camera_T_marker: FloatArray,
        camera_p_spot_mm: FloatArray,
        camera_T_board: FloatArray | None,
        camera_T_trus: FloatArray | None,
    ) -> MarkerRecord:
        picture = ShotPicture(
            camera_T_marker,
            camera_T_marker @ self.scene.marker_T_laser,
            camera_p_spot_mm,
            self.seed,
            (self.seed, len(self.frames)),
            camera_T_board,
            camera_T_trus,
        )
        self.spoilt[name] = self.config.disturbances.of_shot(picture.noise_seed)
        frames = {side: Path(f"frames/{name}-{side}.png") for side in ("left", "right")}
        if self.config.camera.right is None:
            del frames["right"]
        for side, frame in frames.items():
            self.frames[frame.as_posix()] = partial(picture.render, self.config, side == "right")
        return MarkerRecord(left=frames["left"], right=frames.get("right"))

    def _look(self, name: str, looks: _Looks, i: int, k: int) -> TrusRecord:
        scan_deg, sweep = round(float(looks.scan_deg[i, k]), 4), int(looks.sweep[i, k])
        if self.config.frames:
            picture = LookPicture(
                looks.source_mm[i, k],
                float(looks.scan_rad[i, k]),
                float(looks.half_width_rad[i, k]),
                (self.seed, len(self.frames), 2),
            )
            frame = f"frames/{name}.npy"
            self.frames[frame] = partial(picture.record, self.config)
            return TrusRecord(scan_deg, frame=Path(frame), sweep=sweep)
        return TrusRecord(
            scan_deg,
            round(float(looks.x_mm[i, k]), 5),
            round(float(looks.range_mm[i, k]), 5),
            amplitude=round(float(looks.amplitude[i, k]), 5) if self.config.amplitudes else None,
            sweep=sweep,
        )

    def _camera_moved(self, move: FloatArray) -> None:
        if not self.config.camera_moves_reported:
            return
        t = self._now()
        if not self.config.camera_move_known:
            self._add(CameraMovedEvent(t, 0), None)
            return
        sigma = np.repeat(self.config.camera_move_sigma, 3)
        xi = sigma * self.misc_rng.standard_normal(6)
        # Right perturbation; for errors this small Expmap's translation is xi's to second order.
        known = round_array(move @ make_transform(exp_so3(xi[:3]), xi[3:]))
        self._add(CameraMovedEvent(t, 0, known, np.diag(sigma**2)), None)

    def _rough_laser(self) -> FloatArray:
        error = self.misc_rng.standard_normal(6) * np.repeat([np.radians(3.0), 2.0], 3)
        return self.scene.marker_T_laser @ make_transform(exp_so3(error[:3]), error[3:])

    def _now(self) -> float:
        self.time_s += 2.0 + 3.0 * float(self.misc_rng.random())
        return round(self.time_s, 2)

    def _add(self, event: Event, camera_T_marker: FloatArray | None) -> None:
        if camera_T_marker is not None:
            self.true_markers[len(self.events)] = camera_T_marker
        self.events.append(EVENTS.write(event))


def _part(shots: Shots, which: slice) -> Shots:
    return Shots(shots.camera_T_marker[which], shots.lambda_mm[which], shots.spot_mm[which])


def _interleaved(detected: int, silent: int) -> BoolArray:
    """``detected`` times True and ``silent`` times False, evenly mixed."""
    order = [((i + 0.5) / detected, True) for i in range(detected)] + [
        ((i + 0.6) / silent, False) for i in range(silent)
    ]
    return np.array([kind for _, kind in sorted(order)], dtype=bool)
