"""Corners of boards as a stereo endoscope sees them, by the simulator's own lens formulas."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fgreg.calibration.views import BoardView, CornerTable, SeenCorners
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform
from fgreg.model.camera_model import StereoRig
from fgreg.model.session_model import BoardModel, CharucoModel
from fgreg.simulation.lens import project_points

BOARD = BoardModel(9, 6, 9.0, CharucoModel("DICT_5X5_100", 6.5))
NOISE_PX = 0.05
MIDDLE_MM = np.array([36.0, 22.5, 0.0])


def board_poses(rng: np.random.Generator, tilt_deg: float, spread_mm: float = 30.0) -> Iterator[FloatArray]:
    """``left_T_board`` of boards 80 to 150 mm away, whose middles lie about the axis."""
    tilt = math.radians(tilt_deg)
    while True:
        lean = exp_so3(np.append(rng.uniform(-tilt, tilt, 2), 0.0))
        turn = lean @ exp_so3(np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)]))
        middle = np.array([*rng.uniform(-1.0, 1.0, 2) * [spread_mm, 0.6 * spread_mm], rng.uniform(80.0, 150.0)])
        yield make_transform(turn, middle - turn @ MIDDLE_MM)


def simulated_views(rig: StereoRig, seed: int, count: int, tilt_deg: float = 35.0) -> list[BoardView]:
    """Views of the board in both pictures, with Gaussian noise of ``NOISE_PX`` on each coordinate."""
    assert rig.right is not None
    assert rig.right_T_left is not None
    rng = np.random.default_rng(seed)
    ids = np.arange(BOARD.columns * BOARD.rows)
    board_p = np.column_stack([ids % BOARD.columns, ids // BOARD.columns, 0 * ids]) * BOARD.square_mm
    out: list[BoardView] = []
    for pose in board_poses(rng, tilt_deg):
        seen = []
        for camera, camera_T_board in ((rig.left, pose), (rig.right, rig.right_T_left @ pose)):
            pixels = project_points(camera, board_p @ camera_T_board[:3, :3].T + camera_T_board[:3, 3])
            inside = ((pixels > 5.0) & (pixels < np.array(camera.image_size) - 6.0)).all(axis=1)
            noisy = pixels + NOISE_PX * rng.standard_normal(pixels.shape)
            seen.append(SeenCorners(noisy[inside], ids[inside]))
        if min(len(one.ids) for one in seen) >= 12:
            out.append(BoardView(f"{len(out)}", *seen))
        if len(out) == count:
            return out
    raise AssertionError


def table_of(views: list[BoardView]) -> CornerTable:
    """Their corners."""
    return CornerTable.of(views, BOARD)
