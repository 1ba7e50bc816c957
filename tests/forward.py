"""Simulated measurements for tests: scenes, shots and noise, with geometry of its own.

No code of fgreg's factors, sensitivity, graph or simulation is used: a PM's place on the arc and the stage rotation to
it are computed from the points themselves, so a test that agrees rests on two derivations.

Millimetres and radians. ``camera`` OpenCV axes, ``trus`` x along the rotation axis, plane along (0, sin t, cos t).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.rig import CAMERA, COUNT, Constant
from fgreg.geometry.transforms import (
    FloatArray,
    as_float_array,
    exp_so3,
    inverse,
    make_transform,
    rotation_to_direction,
)
from fgreg.model.measurements import (
    Aim,
    CameraDependence,
    EpochStart,
    KnownPoint,
    Look,
    MarkerObservation,
    Measurements,
    Pair,
    VisibleSpot,
    default_marker_covariance,
)
from fgreg.model.probe_model import ProbeModel, SensitivityModel
from fgreg.model.session_model import NoiseModel, SessionModel, StageModel, default_targets_mm
from fgreg.model.systematic import EXACT, Systematic

MOTION_SIGMA = (0.002, 0.002, 0.002, 0.3, 0.3, 0.3)
"""Of a known camera motion (rad, mm), right tangent of ``camera_new_T_camera_old``."""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """The simulated truth; tuples are in the order of ``Measurements.aims`` and ``.pairs``.

    Attributes:
        trus_T_camera: one (4, 4) per epoch.
        marker_T_laser: (4, 4), +z along the beam.
        marker_bias_mm: (3,) camera axes; observed translation = true + bias + noise.
        window_edge_rad: true half width less the half width of the session's table.
        sound_speed_ratio: true over assumed sound speed; true distance = ratio * range.
        trus_p_pm_mm: (3,) of each pm.
        aim_camera_T_marker, pair_camera_T_marker: true (4, 4).
        aim_lambda_mm, pair_lambda_mm: distance of the spot or PM from the laser frame's origin.
        camera_p_spot_mm: true (3,) of each aim.
        scan_rad: true stage angle of each pair.
        theta_rad: true arc angle of each pair.
        rotation_rad: true stage rotation that brings the PM into the plane, of each pair.
    """

    trus_T_camera: tuple[FloatArray, ...]
    marker_T_laser: FloatArray
    marker_bias_mm: FloatArray
    window_edge_rad: float
    sound_speed_ratio: float
    trus_p_pm_mm: dict[int, FloatArray]
    aim_camera_T_marker: tuple[FloatArray, ...]
    pair_camera_T_marker: tuple[FloatArray, ...]
    aim_lambda_mm: tuple[float, ...]
    pair_lambda_mm: tuple[float, ...]
    camera_p_spot_mm: tuple[FloatArray, ...]
    scan_rad: tuple[float, ...]
    theta_rad: tuple[float, ...]
    rotation_rad: tuple[float, ...]


def make_session(
    *,
    noise_model: NoiseModel | None = None,
    radius_mm: float = 10.0,
    depth_mm: tuple[float, ...] = (20.0, 30.0, 45.0),
    half_width_deg: tuple[float, ...] = (6.0, 6.0, 6.0),
    edge_sigma_deg: float = 0.3,
    step_deg: float = 2.0,
    curve: bool = False,
    systematic: Systematic = EXACT,
) -> SessionModel:
    """A session with the defaults of the session format, and no camera, marker or board models.

    ``curve``: with amplitudes against rotation, halved at the (first) half width.
    """
    rotation = np.linspace(-1.5, 1.5, 61) * math.radians(half_width_deg[0])
    sensitivity = SensitivityModel(
        depth_mm=as_float_array(depth_mm, -1),
        half_width_rad=as_float_array(np.radians(half_width_deg), -1),
        edge_sigma_rad=math.radians(edge_sigma_deg),
        curve_rotation_rad=as_float_array(rotation) if curve else None,
        curve_amplitude=as_float_array(_loudness(rotation, math.radians(half_width_deg[0]))) if curve else None,
    )
    return SessionModel(
        name="test",
        probe=ProbeModel(
            elements=128,
            pitch_mm=0.43,
            flip=False,
            radius_mm=radius_mm,
            sound_speed_m_s=1540.0,
            sensitivity=sensitivity,
        ),
        stage=StageModel(step_rad=math.radians(step_deg), limits_device_rad=(math.radians(-60), math.radians(60))),
        noise=noise_model or NoiseModel(),
        targets_mm=default_targets_mm(radius_mm),
        systematic=systematic,
    )


def true_constants(truth: Truth) -> FloatArray:
    """(COUNT,) the rig's constants of a simulated session, true less declared."""
    constants = np.zeros(COUNT)
    constants[Constant.WINDOW_EDGE] = truth.window_edge_rad
    constants[Constant.SOUND_SPEED] = truth.sound_speed_ratio - 1.0
    constants[Constant.MARKER_BIAS_X : Constant.MARKER_BIAS_Z + 1] = truth.marker_bias_mm
    return constants


def off_by(**constants: float) -> list[float]:
    """(COUNT,) all constants as declared but for those named."""
    out = [0.0] * COUNT
    for name, value in constants.items():
        out[Constant[name]] = value
    return out


def with_dependences(measurements: Measurements, seed: int) -> Measurements:
    """The measurements with markers and spots that depend on the camera's constants, at random, as pictures' do."""
    rng = np.random.default_rng(seed)

    def dependence(size: int) -> CameraDependence:
        count = CAMERA.stop - CAMERA.start
        # 1 % or 1 px moves some hundredths of a radian, or a millimetre.
        gain = rng.normal(size=(size, count))
        if size == 6:
            gain[:3] *= 0.02
        gain[:, : Constant.CAMERA_SCALE - CAMERA.start] = 0.0
        root = rng.normal(size=(2, count)) * 20.0
        return CameraDependence(gain, root.T @ root, root.T @ rng.normal(size=2))

    seen: dict[int, MarkerObservation] = {}

    def marker(of: MarkerObservation) -> MarkerObservation:
        return seen.setdefault(of.id, replace(of, dependence=dependence(6)))

    return replace(
        measurements,
        aims=tuple(replace(aim, marker=marker(aim.marker), dependence=dependence(3)) for aim in measurements.aims),
        pairs=tuple(
            replace(
                pair,
                marker=marker(pair.marker),
                spot=None if pair.spot is None else replace(pair.spot, dependence=dependence(3)),
            )
            for pair in measurements.pairs
        ),
    )


def _loudness(rotation_rad: FloatArray | float, half_width_rad: float) -> FloatArray:
    """Amplitude of a PM of peak 1 at rotation offsets: a bell that is down to a half at the half width."""
    return np.asarray(np.exp(-math.log(2.0) * np.square(rotation_rad) / half_width_rad**2))


def random_trus_T_camera(rng: np.random.Generator) -> FloatArray:
    """A camera some 100 mm above the tissue, looking down at it (TRUS -z), turned and tilted at random."""
    down = np.diag([1.0, -1.0, -1.0])
    spin = exp_so3(np.array([0.0, 0.0, rng.uniform(-math.pi, math.pi)]))
    tilt = exp_so3(np.array([*rng.uniform(-0.5, 0.5, 2), 0.0]))
    trus_R_camera = down @ tilt @ spin
    centre = np.array([0.0, 0.0, 42.0]) + rng.uniform(-8.0, 8.0, 3)
    return make_transform(trus_R_camera, centre - trus_R_camera @ np.array([0.0, 0.0, rng.uniform(90.0, 120.0)]))


def random_marker_T_laser(rng: np.random.Generator) -> FloatArray:
    """A fibre about 12 mm off the marker's origin, its beam 0.1 to 0.5 rad off the marker's z axis."""
    slant, around = rng.uniform(0.1, 0.5), rng.uniform(-math.pi, math.pi)
    direction = np.array(
        [math.sin(slant) * math.cos(around), math.sin(slant) * math.sin(around), math.cos(slant)],
    )
    return make_transform(rotation_to_direction(direction), np.array([8.0, -5.0, 7.0]) + rng.uniform(-3.0, 3.0, 3))


def _place_marker(
    rng: np.random.Generator, camera_p: FloatArray, marker_T_laser: FloatArray, spread_rad: float, roll_rad: float
) -> tuple[FloatArray, float]:
    """A marker whose beam hits ``camera_p``: (camera_T_marker, lambda)."""
    lambda_mm = rng.uniform(25.0, 60.0)
    # The beam is tilted from the camera's line of sight, in a random direction.
    sight = rotation_to_direction(camera_p / np.linalg.norm(camera_p))
    around, lean = rng.uniform(-math.pi, math.pi), spread_rad * math.sqrt(rng.uniform())
    off = exp_so3(lean * np.array([math.cos(around), math.sin(around), 0.0]))
    roll = exp_so3(np.array([0.0, 0.0, rng.uniform(-roll_rad, roll_rad)]))
    camera_R_laser = sight @ off @ roll
    camera_T_laser = make_transform(camera_R_laser, camera_p - lambda_mm * camera_R_laser[:, 2])
    return camera_T_laser @ inverse(marker_T_laser), lambda_mm


def _observe_marker(
    rng: np.random.Generator,
    camera_T_marker: FloatArray,
    bias_mm: FloatArray,
    model: NoiseModel,
    noise: bool,
    observation_id: int,
) -> MarkerObservation:
    """Noise about the camera's axes through the marker's origin: observed = [Exp(w) R, t + bias + n]."""
    w, n = np.zeros(3), np.zeros(3)
    if noise:
        w = rng.normal(size=3) * np.array(model.marker_rotation_rad)
        n = rng.normal(size=3) * np.array(model.marker_translation_mm)
    observed = make_transform(exp_so3(w) @ camera_T_marker[:3, :3], camera_T_marker[:3, 3] + bias_mm + n)
    return MarkerObservation(
        camera_T_marker=as_float_array(observed, 4, 4),
        covariance=as_float_array(default_marker_covariance(observed, model), 6, 6),
        id=observation_id,
    )


def hear(trus_p_pm: FloatArray, scan_rad: float, radius_mm: float) -> tuple[float, float, float]:
    """(distance from the element, arc angle theta', stage rotation into the plane) of a point at a stage angle."""
    dy = float(trus_p_pm[1]) - radius_mm * math.sin(scan_rad)
    dz = float(trus_p_pm[2]) - radius_mm * math.cos(scan_rad)
    rotation = math.atan2(float(trus_p_pm[1]), float(trus_p_pm[2])) - scan_rad
    return math.hypot(dy, dz), math.atan2(dy, dz), math.remainder(rotation, 2.0 * math.pi)


def _stage_angle(
    rng: np.random.Generator,
    trus_p_pm: FloatArray,
    session: SessionModel,
    sweep: int,
    edge_rad: float,
    ratio: float,
    centred: bool,
) -> float:
    """Stage angle at which the PM was detected: the first step inside the window, or anywhere in it."""
    probe, step = session.probe, session.stage.step_rad
    bearing = math.atan2(float(trus_p_pm[1]), float(trus_p_pm[2]))
    fraction = 0.5 if centred else float(rng.uniform())
    scan = bearing
    for _ in range(50):  # the window depends on the range, the range (a little) on the angle
        distance, _, _ = hear(trus_p_pm, scan, probe.radius_mm)
        half_width = float(probe.sensitivity.half_width_at(distance / ratio)) + edge_rad
        ahead = sweep * (half_width - fraction * step) if sweep else half_width * (2.0 * fraction - 1.0)
        scan = bearing - ahead
    return scan


def make_measurements(
    rng: np.random.Generator,
    *,
    aims: int = 12,
    pairs: int = 10,
    first_hit: bool = True,
    one_way: bool = False,
    noise: bool = True,
    looks_per_pm: int = 1,
    share_marker: bool = False,
    look_spacing_deg: float | None = None,
    amplitude_noise: float | None = None,
    epochs: int = 1,
    known_motion: bool = False,
    spread_deg: float = 20.0,
    roll_deg: float = 180.0,
    sound_speed_ratio: float = 1.0,
    spot_sigma_mm: tuple[float, float, float] | None = None,
    points: int = 0,
    session: SessionModel | None = None,
    marker_T_laser: FloatArray | None = None,
    trus_T_camera: FloatArray | None = None,
) -> tuple[SessionModel, Measurements, Truth]:
    """One simulated session.

    Args:
        rng: source of everything random; the same seed and arguments give the same session.
        aims: calibration shots.
        pairs: PMs (each has ``looks_per_pm`` pairs), divided evenly among the epochs.
        first_hit: the stage stopped at its first hit, sweeping alternately either way; else only the window is known.
        one_way: first-hit sweeps all go towards larger angles.
        noise: False makes every measurement exact, with the stage rotation at the centre of its prior (and no bias,
            no edge error), so that the cost of the truth is zero.
        looks_per_pm: looks at each PM, at stage angles of their own.
        share_marker: the looks of one PM share one marker observation; else the marker moves between them.
        look_spacing_deg: looks after the first are so far on each, in the sweep's direction (towards the middle of the
            window where there is none), with ``sweep`` 0; None: each is a sweep, or a place in the window, of its own.
        amplitude_noise: looks have amplitudes with this relative noise, of a peak that differs from PM to PM.
        epochs: camera epochs.
        known_motion: epochs start with a measured camera motion (sigmas ``MOTION_SIGMA``).
        spread_deg: largest angle between beam and line of sight.
        roll_deg: largest roll of the marker about its beam.
        sound_speed_ratio: true over assumed.
        spot_sigma_mm: the camera sees the spot of each look with these sigmas along its axes; None: it does not.
        points: known points, divided evenly among the epochs, located to 0.4 mm by each device.
        session: noise and probe to use; ``make_session()`` where absent.
        marker_T_laser, trus_T_camera: (4, 4) truth (of the first epoch), random where absent.

    Returns:
        the session's model, its measurements and the truth behind them.
    """
    session = session or make_session()
    model, probe = session.noise, session.probe
    beam = random_marker_T_laser(rng) if marker_T_laser is None else np.asarray(marker_T_laser)
    registrations = [random_trus_T_camera(rng) if trus_T_camera is None else np.asarray(trus_T_camera)]
    starts = [EpochStart(t=0.0)]
    spread, roll = math.radians(spread_deg), math.radians(roll_deg)
    edge = float(rng.normal() * probe.sensitivity.edge_sigma_rad) if noise else 0.0
    bias = rng.normal(size=3) * model.marker_bias_mm if noise else np.zeros(3)
    observation_id, t = 0, 0.0

    aim_list, aim_poses, aim_lambdas, spots = [], [], [], []
    for _ in range(aims):
        t += 1.0
        spot = np.array([*rng.uniform(-30.0, 30.0, 2), rng.uniform(90.0, 130.0)])
        pose, lambda_mm = _place_marker(rng, spot, beam, spread, roll)
        observed_spot = spot + (rng.normal(size=3) * np.array(model.aim_mm) if noise else 0.0)
        marker = _observe_marker(rng, pose, bias, model, noise, observation_id)
        observation_id += 1
        covariance = as_float_array(np.diag(np.square(model.aim_mm)), 3, 3)
        aim_list.append(Aim(t, marker, as_float_array(observed_spot, 3), covariance))
        aim_poses.append(pose)
        aim_lambdas.append(lambda_mm)
        spots.append(spot)

    look_covariance = as_float_array(np.diag([model.lateral_mm**2, model.range_mm**2]), 2, 2)
    pms: dict[int, FloatArray] = {}
    pair_list, pair_poses, pair_lambdas, scans, thetas, rotations = [], [], [], [], [], []
    epoch = 0
    for pm in range(pairs):
        while epoch < pm * epochs // pairs:
            epoch += 1
            t += 5.0
            new_T_old = make_transform(exp_so3(rng.uniform(-0.15, 0.15, 3)), rng.uniform(-15.0, 15.0, 3))
            registrations.append(registrations[-1] @ inverse(new_T_old))
            if known_motion:
                xi = rng.normal(size=6) * MOTION_SIGMA if noise else np.zeros(6)
                measured = new_T_old @ make_transform(exp_so3(xi[:3]), xi[3:])  # first order is enough for small ones
                covariance = as_float_array(np.diag(np.square(MOTION_SIGMA)), 6, 6)
                starts.append(EpochStart(t, as_float_array(measured, 4, 4), covariance))
            else:
                starts.append(EpochStart(t))
        bearing, depth = math.radians(rng.uniform(-30.0, 30.0)), rng.uniform(22.0, 42.0)
        reach = probe.radius_mm + depth
        trus_p_pm = np.array([rng.uniform(-20.0, 20.0), reach * math.sin(bearing), reach * math.cos(bearing)])
        pms[pm] = trus_p_pm
        loudest = math.exp(rng.uniform(-0.7, 0.7)) if amplitude_noise is not None else 1.0
        first_scan, onward = 0.0, 1.0
        camera_p_pm = (inverse(registrations[epoch]) @ np.array([*trus_p_pm, 1.0]))[:3]
        for look_index in range(looks_per_pm):
            t += 1.0
            if look_index == 0 or not share_marker:
                pose, lambda_mm = _place_marker(rng, camera_p_pm, beam, spread, roll)
                marker = _observe_marker(rng, pose, bias, model, noise, observation_id)
                observation_id += 1
            sweep = 0
            if first_hit:
                sweep = 1 if one_way or (pm + look_index) % 2 == 0 else -1
            if look_index == 0 or look_spacing_deg is None:
                scan = _stage_angle(rng, trus_p_pm, session, sweep, edge, sound_speed_ratio, centred=not noise)
                first_scan = scan
                onward = float(sweep or math.copysign(1.0, hear(trus_p_pm, scan, probe.radius_mm)[2]))
            else:
                scan, sweep = first_scan + onward * look_index * math.radians(look_spacing_deg), 0
            distance, theta, rotation = hear(trus_p_pm, scan, probe.radius_mm)
            amplitude = None
            if amplitude_noise is not None:
                loudness = float(_loudness(rotation, float(probe.sensitivity.half_width_rad[0])))
                amplitude = loudest * loudness * math.exp(amplitude_noise * float(rng.normal()))
            scatter = rng.normal(size=3) * (model.lateral_mm, model.range_mm, model.scan_rad) if noise else np.zeros(3)
            look = Look(
                scan_rad=scan + float(scatter[2]),
                scan_sigma_rad=model.scan_rad,
                x_mm=float(trus_p_pm[0] + scatter[0]),
                range_mm=float(distance / sound_speed_ratio + scatter[1]),
                covariance=look_covariance,
                sweep=sweep,
                amplitude=amplitude,
            )
            spot_seen = None
            if spot_sigma_mm is not None:
                away = rng.normal(size=3) * spot_sigma_mm if noise else np.zeros(3)
                around = as_float_array(np.diag(np.square(spot_sigma_mm)), 3, 3)
                spot_seen = VisibleSpot(as_float_array(camera_p_pm + away, 3), around)
            pair_list.append(Pair(t, pm, epoch, marker, look, spot=spot_seen))
            pair_poses.append(pose)
            pair_lambdas.append(lambda_mm)
            scans.append(scan)
            thetas.append(theta)
            rotations.append(rotation)

    truth = Truth(
        trus_T_camera=tuple(registrations),
        marker_T_laser=beam,
        marker_bias_mm=bias,
        window_edge_rad=edge,
        sound_speed_ratio=sound_speed_ratio,
        trus_p_pm_mm=pms,
        aim_camera_T_marker=tuple(aim_poses),
        pair_camera_T_marker=tuple(pair_poses),
        aim_lambda_mm=tuple(aim_lambdas),
        pair_lambda_mm=tuple(pair_lambdas),
        camera_p_spot_mm=tuple(spots),
        scan_rad=tuple(scans),
        theta_rad=tuple(thetas),
        rotation_rad=tuple(rotations),
    )
    around, point_list = as_float_array(np.diag([0.16] * 3), 3, 3), []
    for place in range(points):
        of = place * epochs // points
        bearing, reach = rng.uniform(-0.5, 0.5), probe.radius_mm + rng.uniform(22.0, 42.0)
        trus_p = np.array([rng.uniform(-20.0, 20.0), reach * math.sin(bearing), reach * math.cos(bearing)])
        camera_p = (inverse(registrations[of]) @ np.array([*trus_p, 1.0]))[:3]
        off = rng.normal(size=(2, 3)) * 0.4 if noise else np.zeros((2, 3))
        mine = [pair.t for pair in pair_list if pair.epoch == of]
        at = mine[len(mine) // 3]
        seen, shown = as_float_array(camera_p + off[0], 3), as_float_array(trus_p + off[1], 3)
        point_list.append(KnownPoint(at, of, seen, around, shown, around))
    return session, Measurements(tuple(aim_list), tuple(pair_list), tuple(starts), tuple(point_list)), truth


def with_noise(session: SessionModel, **changes: float | tuple[float, float, float]) -> SessionModel:
    """The session with some of its noise model changed, e.g. ``with_noise(s, marker_bias_mm=0.5)``."""
    return replace(session, noise=replace(session.noise, **changes))  # type: ignore[arg-type]
