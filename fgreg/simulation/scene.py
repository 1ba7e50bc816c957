"""Scene geometry: probe, tissue, camera, fibre, and a surgeon's shots. Ground truth only, no observation noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import (
    BoolArray,
    FloatArray,
    IntArray,
    exp_so3,
    inverse,
    make_transform,
    transform_points,
)
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.session_model import TagModel
from fgreg.simulation.config import SimulationConfig
from fgreg.simulation.lens import project_points

CANDIDATES = 8
"""Number of candidates for a shot drawn at once; the first visible to the camera is taken."""

ROUNDS = 40
PATIENCE = 12
"""Number of rounds of candidates before a shot is given up, and before its PM is moved."""
EDGE_PX = 12.0
_MARKER_BIAS = (Constant.MARKER_BIAS_X, Constant.MARKER_BIAS_Y, Constant.MARKER_BIAS_Z)


class UnseenError(ValueError):
    """No candidate of a shot has its marker visible to the camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Tissue:
    """The tissue's surface: depth (mm) beyond the probe's radius over x and stage angle, a quadric in both.

    Attributes:
        coefficients: (5,) of X, A, X^2, A^2 and X A, where X = x / x_mm and A = angle / angle_rad.
        low, high: smallest and largest value of the quadric for |X|, |A| <= 1, mapped to ``depth_mm``.
    """

    coefficients: FloatArray
    low: float
    high: float
    x_mm: float
    angle_rad: float
    depth_mm: tuple[float, float]
    radius_mm: float

    def point(self, x_mm: FloatArray, angle_rad: FloatArray) -> FloatArray:
        """TRUS points (..., 3) of the surface."""
        value = _quadric(self.coefficients, x_mm / self.x_mm, angle_rad / self.angle_rad)
        share = np.clip((value - self.low) / (self.high - self.low), 0.0, 1.0)
        rho = self.radius_mm + self.depth_mm[0] + share * (self.depth_mm[1] - self.depth_mm[0])
        return np.stack([x_mm + 0.0 * rho, rho * np.sin(angle_rad), rho * np.cos(angle_rad)], axis=-1)


def _quadric(c: FloatArray, x: FloatArray, a: FloatArray) -> FloatArray:
    return np.asarray(c[0] * x + c[1] * a + c[2] * x * x + c[3] * a * a + c[4] * x * a)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """One session's truth.

    Attributes:
        trus_T_camera: one (4, 4) per epoch.
        camera_moves: ``camera_new_T_camera_old``, one fewer.
        marker_T_laser: (4, 4); the laser frame's origin is the fibre's tip.
        tissue: the surface.
        trus_beam: (3,) mean direction of the beams. trus_side: (3,) unit vector across it that roll counts from.
        roll_rad: mean roll of the marker about the beam.
        window_edge_rad: error of the known half width.
        marker_bias_mm: (3,) constant offset of observed marker poses, camera axes.
    """

    trus_T_camera: tuple[FloatArray, ...]
    camera_moves: tuple[FloatArray, ...]
    marker_T_laser: FloatArray
    tissue: Tissue
    trus_beam: FloatArray
    trus_side: FloatArray
    roll_rad: float
    window_edge_rad: float
    marker_bias_mm: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Shots:
    """Shots: marker poses (n, 4, 4), distances along the beam (n,), and the beams' ends (n, 3).

    ``spot_mm`` is in the frame the shots were planned in: TRUS for PMs, the camera for aims.
    """

    camera_T_marker: FloatArray
    lambda_mm: FloatArray
    spot_mm: FloatArray


def draw_scene(config: SimulationConfig, rng: np.random.Generator) -> Scene:
    """Places tissue, camera and fibre."""
    tissue = _draw_tissue(config, rng)
    trus_p_middle = tissue.point(np.zeros(()), np.zeros(()))
    # The camera looks at the tissue from the side away from the probe, tilted by up to 15 deg.
    up = _normalised(np.array([*np.tan(rng.uniform(-0.25, 0.25, 2)), 1.0]))
    trus_p_camera = trus_p_middle + rng.uniform(*config.camera_distance_mm) * up
    # Beams come in beside the line of sight; the camera is pointed at where the markers will be.
    lean, azimuth = math.radians(rng.uniform(12.0, 32.0)), rng.uniform(-math.pi, math.pi)
    down_frame = _frame_along(-up, azimuth)
    trus_beam = math.cos(lean) * down_frame[:, 2] + math.sin(lean) * down_frame[:, 0]
    trus_p_markers = trus_p_middle - 0.5 * sum(config.lambda_mm) * trus_beam
    view = _normalised(trus_p_markers - trus_p_camera)
    # The image's long side lies across the probe's axis, either way round, where the spots spread most.
    across = np.array([0.0, rng.choice([-1.0, 1.0]), 0.0])
    roll = rng.uniform(-config.camera_roll_rad, config.camera_roll_rad)
    trus_T_camera = make_transform(_laser_rotation(view, across, np.asarray(roll)), trus_p_camera)
    transforms, moves = [trus_T_camera], []
    for _ in range(config.epochs - 1):
        camera_p_middle = transform_points(inverse(transforms[-1]), trus_p_middle)
        turn = exp_so3(rng.normal(0.0, math.radians(5.0), 3))
        shift = rng.normal(0.0, 3.0, 3)
        if config.camera_move_mm is not None:
            turn, shift = np.eye(3), config.camera_move_mm * _normalised(shift)
        move = make_transform(turn, camera_p_middle - turn @ camera_p_middle + shift)
        moves.append(move)
        transforms.append(transforms[-1] @ inverse(move))

    marker_T_laser = _draw_laser(config, rng) if config.marker_T_laser is None else config.marker_T_laser
    trus_side = _frame_along(trus_beam, 0.0)[:, 0]
    # Of all rolls about the beam, one near that which turns the printed face best to the camera.
    rolls = np.linspace(-math.pi, math.pi, 24, endpoint=False)
    laser_R_marker = marker_T_laser[:3, :3].T
    facing = -(_laser_rotation(np.tile(trus_beam, (24, 1)), trus_side, rolls) @ laser_R_marker)[..., 2] @ view
    roll_rad = float(rolls[int(np.argmax(facing))]) + rng.uniform(-1.0, 1.0)

    edge, bias = rng.standard_normal(), rng.standard_normal(3)
    fixed = config.deviations
    window_edge_rad = fixed.get(Constant.WINDOW_EDGE, config.probe.sensitivity.edge_sigma_rad * float(edge))
    marker_bias_mm = config.noise.marker_bias_mm * bias
    if not fixed.keys().isdisjoint(_MARKER_BIAS):
        marker_bias_mm = np.array([fixed.get(constant, 0.0) for constant in _MARKER_BIAS])
    return Scene(
        tuple(transforms),
        tuple(moves),
        marker_T_laser,
        tissue,
        trus_beam,
        trus_side,
        roll_rad,
        window_edge_rad,
        marker_bias_mm,
    )


def _draw_tissue(config: SimulationConfig, rng: np.random.Generator) -> Tissue:
    coefficients = rng.normal(0.0, [1.0, 1.0, 0.6, 0.6, 0.4])
    grid = np.linspace(-1.0, 1.0, 9)
    values = _quadric(coefficients, grid[:, None], grid)
    return Tissue(
        coefficients,
        float(values.min()),
        float(values.max()),
        config.pm_x_mm,
        config.pm_angle_rad,
        config.pm_depth_mm,
        config.probe.radius_mm,
    )


def _draw_laser(config: SimulationConfig, rng: np.random.Generator) -> FloatArray:
    tilt, azimuth = rng.uniform(*config.laser_tilt_rad), rng.uniform(-math.pi, math.pi)
    direction = np.array([math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), -math.cos(tilt)])
    offset, around = rng.uniform(*config.laser_offset_mm), rng.uniform(-math.pi, math.pi)
    tip = np.array([offset * math.cos(around), offset * math.sin(around), rng.uniform(-15.0, -5.0)])
    return make_transform(_frame_along(direction, rng.uniform(-math.pi, math.pi)), tip)


def draw_pm_shots(config: SimulationConfig, scene: Scene, epochs: IntArray, rng: np.random.Generator) -> Shots:
    """One shot on the tissue for each entry of ``epochs`` (n,), the camera epoch it is taken in."""
    line: FloatArray | None = None
    if config.collinear:  # along the probe's axis, through a point of the surface
        angle = np.asarray(rng.uniform(-config.pm_angle_rad, config.pm_angle_rad))
        line = scene.tissue.point(np.zeros(()), angle)

    def draw_pms(shape: tuple[int, int]) -> FloatArray:
        x = rng.uniform(-config.pm_x_mm, config.pm_x_mm, shape)
        if line is None:
            return scene.tissue.point(x, rng.uniform(-config.pm_angle_rad, config.pm_angle_rad, shape))
        return np.stack([x, np.full(shape, line[1]), np.full(shape, line[2])], axis=-1)

    wanted = draw_pms((epochs.size, 1))

    def draw(which: IntArray, attempt: int) -> _Targets:
        # The fibre is held in another way first; only a PM that no way can reach in sight is given up. Else the spots
        # would crowd where the camera looks.
        shape = (which.size, CANDIDATES)
        if attempt < PATIENCE:
            return _Targets(np.broadcast_to(wanted[which], (*shape, 3)))
        return _Targets(draw_pms(shape))

    camera_T_trus = inverse(np.stack(scene.trus_T_camera))[epochs]
    plan = _Plan(
        camera_T_trus, scene.trus_beam, scene.trus_side, config.lambda_mm, config.beam_roll_rad, config.water_mm
    )
    return _draw_shots(config, scene, plan, draw, rng)[0]


@dataclass(frozen=True, slots=True, eq=False)
class AimShots:
    """Calibration shots: markers, the corner [column, row] aimed at, its board's pose and the nominal spot."""

    shots: Shots
    corner: IntArray
    camera_T_board: FloatArray
    camera_p_spot_mm: FloatArray


def draw_aim_shots(config: SimulationConfig, scene: Scene, rng: np.random.Generator, miss: FloatArray) -> AimShots:
    """Shots at corners of a board that is held elsewhere in each.

    Args:
        miss: (aims, 3) standard normal numbers; times ``noise.aim_mm`` how far the beam passes the corner, along the
            board's axes where frames are recorded, along the camera's where spots are.
    """
    board = config.board
    miss_mm = miss * np.array(config.noise.aim_mm)
    half = np.array([board.columns - 1, board.rows - 1, 0.0]) * (board.square_mm / 2.0)
    cells = np.array([board.columns, board.rows])

    def draw(which: IntArray, attempt: int) -> _Targets:  # noqa: ARG001
        shape = (which.size, CANDIDATES)
        turn = rng.uniform(-1.0, 1.0, (*shape, 3)) * [0.35, 0.35, 0.4]
        middle = rng.uniform(-12.0, 12.0, (*shape, 3))
        middle[..., 2] = rng.uniform(*config.board_distance_mm, shape)
        camera_R_board = exp_so3(turn)
        camera_T_board = make_transform(camera_R_board, middle - camera_R_board @ half)
        corner = np.floor(rng.random((*shape, 2)) * cells).astype(np.int64)
        board_p = np.concatenate([corner * board.square_mm, np.zeros((*shape, 1))], axis=-1)
        nominal = transform_points(camera_T_board, board_p)
        past = np.broadcast_to(miss_mm[which][:, None], nominal.shape)
        if config.frames:
            past = np.einsum("...ij,...j->...i", camera_R_board, past)
        return _Targets(nominal + past, camera_T_board, corner, nominal)

    camera_R_trus = scene.trus_T_camera[0][:3, :3].T
    plan = _Plan(
        np.broadcast_to(np.eye(4), (config.aims, 4, 4)),
        camera_R_trus @ scene.trus_beam,
        camera_R_trus @ scene.trus_side,
        config.aim_lambda_mm,
        config.aim_roll_rad,
    )
    shots, chosen = _draw_shots(config, scene, plan, draw, rng)
    return AimShots(shots, chosen.corner, chosen.camera_T_board, chosen.nominal_mm)


@dataclass(frozen=True, slots=True, eq=False)
class _Targets:
    """Where beams are to end (..., 3); for aims the boards (..., 4, 4), their corners (..., 2) and nominal spots."""

    spot_mm: FloatArray
    camera_T_board: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    corner: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    nominal_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """Planned marker poses of n shots, in the TRUS frame for PMs and in the camera frame for aims."""

    camera_T_frame: FloatArray
    beam: FloatArray
    side: FloatArray
    lambda_mm: tuple[float, float]
    roll_rad: float
    water_mm: float = 0.0


def refraction_mm(direction: FloatArray, water_mm: float, index: float) -> FloatArray:
    """(..., 3) from the point in water that a beam hits to where it would go on in air as far as it goes in water.

    The water's surface is level (normal TRUS z), ``water_mm`` above the point; ``direction`` (..., 3) is the beam's in
    air, in TRUS axes, downwards. By Snell's law the part along the surface is that in air over ``index``.
    """
    if water_mm == 0.0:
        return np.zeros_like(direction)
    bent = direction / index
    bent[..., 2] = -np.sqrt(1.0 - np.sum(np.square(bent[..., :2]), axis=-1))
    way_mm = water_mm / -bent[..., 2:]
    return np.asarray(way_mm * (direction - bent))


def _draw_shots(
    config: SimulationConfig,
    scene: Scene,
    plan: _Plan,
    draw: Callable[[IntArray, int], _Targets],
    rng: np.random.Generator,
) -> tuple[Shots, _Targets]:
    """Draw each shot until the camera can see its marker (and, with a board, the corner aimed at)."""
    n = plan.camera_T_frame.shape[0]
    camera_T_marker, lambdas, spots = np.zeros((n, 4, 4)), np.zeros(n), np.zeros((n, 3))
    boards, corners, nominals = np.zeros((n, 4, 4)), np.zeros((n, 2), dtype=np.int64), np.zeros((n, 3))
    laser_T_marker = inverse(scene.marker_T_laser)
    across = _cross(plan.beam, plan.side)
    pending = np.arange(n)
    for attempt in range(ROUNDS):
        if pending.size == 0:
            break
        targets = draw(pending, attempt)
        shape = (pending.size, CANDIDATES)
        lean = np.tan(rng.uniform(-config.beam_tilt_rad, config.beam_tilt_rad, (*shape, 2)))
        direction = _normalised(plan.beam + lean[..., :1] * plan.side + lean[..., 1:] * across)
        lam = rng.uniform(*plan.lambda_mm, shape)
        roll = scene.roll_rad + rng.uniform(-plan.roll_rad, plan.roll_rad, shape)
        tip = targets.spot_mm - lam[..., None] * direction
        if plan.water_mm > 0.0:
            tip = tip + refraction_mm(direction, plan.water_mm, config.water_index)
        frame_T_laser = make_transform(_laser_rotation(direction, plan.side, roll), tip)
        pose = plan.camera_T_frame[pending][:, None] @ (frame_T_laser @ laser_T_marker)
        good = _visible(config, pose)
        if config.has_camera and targets.corner.size:
            shot, candidate = np.nonzero(good)
            good[shot, candidate] = _corner_visible(
                config, pose[shot, candidate], targets.camera_T_board[shot, candidate], targets.corner[shot, candidate]
            )
        first = np.argmax(good, axis=1)
        taken = good[np.arange(pending.size), first]
        index, first = pending[taken], first[taken]
        camera_T_marker[index], lambdas[index] = pose[taken, first], lam[taken, first]
        spots[index] = targets.spot_mm[taken, first]
        if targets.corner.size:
            boards[index], corners[index] = targets.camera_T_board[taken, first], targets.corner[taken, first]
            nominals[index] = targets.nominal_mm[taken, first]
        pending = pending[~taken]
    if pending.size:
        raise UnseenError("no shot whose marker the camera can see was found in this geometry: widen its spans")
    return Shots(camera_T_marker, lambdas, spots), _Targets(spots, boards, corners, nominals)


def _visible(config: SimulationConfig, camera_T_marker: FloatArray) -> BoolArray:
    """Whether the first tag, with its quiet zone, is wholly in all images, in reach and turned to the camera."""
    tag = config.marker.tags[0]
    camera_T_tag = camera_T_marker @ tag.marker_T_tag
    centre, normal = camera_T_tag[..., :3, 3], camera_T_tag[..., :3, 2]
    distance = np.linalg.norm(centre, axis=-1)
    good = (distance >= config.marker_distance_mm[0]) & (distance <= config.marker_distance_mm[1])
    good &= -np.sum(centre * normal, axis=-1) >= math.cos(config.tag_tilt_rad) * distance
    outline = _outline(camera_T_tag, tag, config.marker.dictionary)
    for camera, camera_T_left in _views(config.camera):
        good &= _inside(camera, transform_points(camera_T_left, outline), EDGE_PX).all(axis=-1)
    return np.asarray(good)


def _outline(camera_T_tag: FloatArray, tag: TagModel, dictionary: str, grow: float = 1.0) -> FloatArray:
    """Corners (..., 4, 3) of the tag with a quiet zone of one module (of at least 6: border and 4 bits)."""
    bits = int(dictionary.split("_")[1].split("X")[0]) if "X" in dictionary else 4
    half = grow * tag.size_mm / 2.0 * (1.0 + 2.0 / (bits + 2))
    tag_p = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    return transform_points(camera_T_tag[..., None, :, :], tag_p)


def _views(rig: StereoRig) -> list[tuple[CameraModel, FloatArray]]:
    views = [(rig.left, np.eye(4))]
    if rig.right is not None and rig.right_T_left is not None:
        views.append((rig.right, rig.right_T_left))
    return views


def _inside(camera: CameraModel, camera_p_mm: FloatArray, margin_px: float) -> BoolArray:
    """Whether points (..., 3) are in the image, ``margin_px`` from its edge."""
    # In front of the camera and within 50 deg: farther out the distortion polynomial is invalid.
    ahead = (camera_p_mm[..., 2] > 1.0) & (np.abs(camera_p_mm[..., :2]).max(axis=-1) < 1.2 * camera_p_mm[..., 2])
    pixel = project_points(camera, np.where(ahead[..., None], camera_p_mm, np.array([0.0, 0.0, 1.0])))
    size = np.array(camera.image_size) - 1.0
    return np.asarray(ahead & ((pixel >= margin_px) & (pixel <= size - margin_px)).all(axis=-1))


def _corner_visible(
    config: SimulationConfig, camera_T_marker: FloatArray, camera_T_board: FloatArray, corner: IntArray
) -> BoolArray:
    """Whether the four squares about the corner aimed at, and enough of the board, are in all images and not behind
    the tag; (n,)."""
    board, n = config.board, corner.shape[0]
    # All corners of squares, the outer ones too: index [row + 1, column + 1] of the inner corner [column, row].
    rows, columns = np.divmod(np.arange((board.rows + 2) * (board.columns + 2)), board.columns + 2)
    board_p = np.stack([columns - 1, rows - 1, 0 * rows], axis=-1) * board.square_mm
    left_p = transform_points(camera_T_board[:, None], board_p)
    tag = config.marker.tags[0]
    outline = _outline(camera_T_marker @ tag.marker_T_tag, tag, config.marker.dictionary, grow=1.1)
    # A plain chessboard is detected only as a whole, a ChArUco board also in part.
    enough = rows.size if board.charuco is None else min(20, rows.size)
    good = np.ones(n, dtype=bool)
    for camera, camera_T_left in _views(config.camera):
        camera_p = transform_points(camera_T_left, left_p)
        quad = project_points(camera, transform_points(camera_T_left, outline))
        seen = _inside(camera, camera_p, EDGE_PX) & ~_within(project_points(camera, camera_p), quad)
        grid = seen.reshape(n, board.rows + 2, board.columns + 2)
        about = [grid[np.arange(n), corner[:, 1] + i, corner[:, 0] + j] for i in range(3) for j in range(3)]
        good &= (seen.sum(axis=-1) >= enough) & np.all(about, axis=0)
    return np.asarray(good)


def _within(pixel: FloatArray, quad: FloatArray) -> BoolArray:
    """Whether points (..., m, 2) lie inside convex quadrilaterals (..., 4, 2)."""
    sides = []
    for k in range(4):
        a, b = quad[..., k, None, :], quad[..., (k + 1) % 4, None, :]
        sides.append(
            (b - a)[..., 0] * (pixel - a)[..., 1] - (b - a)[..., 1] * (pixel - a)[..., 0],
        )
    stacked = np.stack(sides)
    return np.asarray((stacked > 0).all(axis=0) | (stacked < 0).all(axis=0))


def _normalised(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.sqrt(np.sum(v * v, axis=-1, keepdims=True)))


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products (..., 3); np.cross costs four times as much on arrays as small as these."""
    ax, ay, az, bx, by, bz = a[..., 0], a[..., 1], a[..., 2], b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _laser_rotation(direction: FloatArray, side: FloatArray, roll_rad: FloatArray | float) -> FloatArray:
    """Rotations (..., 3, 3) whose z is ``direction`` and whose x is ``side``, made perpendicular and rolled about z."""
    x = _normalised(side - np.sum(direction * side, axis=-1, keepdims=True) * direction)
    y = _cross(direction, x)
    c, s = np.cos(roll_rad)[..., None], np.sin(roll_rad)[..., None]
    return np.stack([c * x + s * y, c * y - s * x, np.broadcast_to(direction, x.shape)], axis=-1)


def _frame_along(direction: FloatArray, roll_rad: float) -> FloatArray:
    """A rotation (3, 3) whose z is ``direction``, rolled about it by ``roll_rad`` from an arbitrary start."""
    start = np.eye(3)[int(np.argmin(np.abs(direction)))]
    return _laser_rotation(direction, start, np.asarray(roll_rad))
