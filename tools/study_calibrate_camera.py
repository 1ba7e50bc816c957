"""How true the sigmas of a stereo calibration are, beside OpenCV's stereoCalibrate on the same corners.

    python tools/study_calibrate_camera.py [--seeds 40] [--views 20] [--rendered 2]

Simulated corners (0.05 px) of each lens model, and boards in rendered pictures. Per lens: mean square of the normalised
error of the rig's constants (NEES over their number; 1: the sigmas are true), share within 2 sigma, RMS error of
points located where there were corners, ours and OpenCV's (5 coefficients), and seconds for a calibration. Last: halves
called different, and alarms of --check on 4 unchanged views.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from fgreg.calibration import parameters
from fgreg.calibration.bundle import fit
from fgreg.calibration.check import Validity, check
from fgreg.calibration.comparison import compare
from fgreg.calibration.quality import board_depths_mm, halves, seen_pixels
from fgreg.calibration.views import BoardView, SeenCorners
from fgreg.detection.board import find_board_corners
from fgreg.detection.calibration_start import place_boards, start
from fgreg.geometry.transforms import make_transform
from fgreg.simulation.config import default_rig
from fgreg.simulation.render import Optics, render_frame
from fgreg.simulation.surfaces import Background, BoardSurface
from tests.calibration_views import BOARD, board_poses, simulated_views, table_of
from tests.test_calibrate_camera import RIGS, SIZE, opencv_rig


def rendered_views(seed: int, count: int) -> list[BoardView]:
    """Views of the default rig, found in rendered pictures."""
    rig = default_rig()
    assert rig.right is not None
    assert rig.right_T_left is not None
    rng = np.random.default_rng(seed)
    far = Background(make_transform(np.eye(3), np.array([0.0, 0.0, 250.0])))
    out = []
    for i, pose in zip(range(count), board_poses(rng, 35.0), strict=False):
        seen = []
        for camera, camera_T_left in ((rig.left, np.eye(4)), (rig.right, rig.right_T_left)):
            surface = BoardSurface(BOARD, camera_T_left @ pose)
            found = find_board_corners(
                render_frame(camera, [surface], rng, Optics(), far.seen_from(camera_T_left)), BOARD
            )
            seen.append(None if found is None else SeenCorners(*found))
        out.append(BoardView(f"{i}", *seen))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--rendered", type=int, default=2, help="calibrations from rendered pictures")
    options = parser.parse_args()
    different = alarms = tried = 0
    for model, count in (*((name, options.seeds) for name in RIGS), ("rendered", options.rendered)):
        rig = RIGS.get(model, RIGS["pinhole5"])
        nees, within, ours, theirs, seconds = [], [], [], [], []
        for seed in range(count):
            views = (
                rendered_views(seed, options.views)
                if model == "rendered"
                else simulated_views(rig, seed, options.views)
            )
            table, begin = table_of(views), time.perf_counter()
            bundle = fit(table, *start(table, SIZE, len(rig.left.distortion), rig.left.fisheye))
            seconds.append(time.perf_counter() - begin)
            _, by = parameters.constants(rig)
            off, spread = by @ parameters.difference(bundle.rig, rig), by @ bundle.covariance @ by.T
            nees.append(off @ np.linalg.solve(spread, off) / len(off))
            within.append(np.mean(np.abs(off) < 2.0 * np.sqrt(np.diag(spread))))
            depths = board_depths_mm(table, bundle.left_T_board)
            seen = seen_pixels(table, rig)
            ours.append(compare(rig, bundle.rig, depths, seen).points_rms_mm)
            if len(rig.left.distortion) == 5:
                theirs.append(compare(rig, opencv_rig(table, SIZE), depths, seen).points_rms_mm)
            if model == "pinhole5":
                tried += 1
                both = halves(table, bundle)
                different += both is not None and both.factor > 1.0
                new = table_of(simulated_views(rig, 1000 + seed, 4))
                placed = place_boards(new, bundle.rig)
                found = check(new, bundle.rig, bundle.covariance, bundle.sigma_px, placed, depths, 0.5)
                alarms += found.validity is Validity.CHANGED
        if count:
            error = f"{np.mean(nees):.2f} +- {np.std(nees) / np.sqrt(count):.2f}"
            other = f", OpenCV {np.sqrt(np.mean(np.square(theirs))):.3f}" if theirs else ""
            points = f"{np.sqrt(np.mean(np.square(ours))):.3f}{other} mm"
            print(
                f"{model:9s} {count:3d}: NEES {error}, within 2 sigma {100 * np.mean(within):.1f} %, points {points}, "
                f"{np.median(seconds):.2f} s, last sigma {bundle.sigma_px:.3f} px"
            )
    print(f"of {tried}: {different} with halves called different, {alarms} false alarms of --check")


if __name__ == "__main__":
    main()
