"""The size of printed tag and board as rendered stereo views measure it, with everything else exact: bias and scatter.

Per blur and noise: mean of measured less true size with its standard error, standard deviation from shot to shot, and
the standard deviation that a detection states (fgreg.model.camera_dependence, which has a floor for errors of real
lenses and prints that rendered views lack).

Example:
  nice python tools/study_print_size.py --views 20
"""

from __future__ import annotations

import argparse

import numpy as np

from fgreg.detection.board import detect_board
from fgreg.detection.marker import detect_marker
from fgreg.detection.results import BoardFit, MarkerFit
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, make_transform
from fgreg.model.camera_dependence import column
from fgreg.model.session_model import BoardModel, CharucoModel, MarkerModel, TagModel
from fgreg.simulation.render import Optics, render_frame
from fgreg.simulation.surfaces import Background, BoardSurface, Surface, TagSurface
from study_marker import Images, margin_px, say, study_rig, tilted

OPTICS = {
    "sharp, 0.6 px": Optics(blur_px=0.6),
    "blur 0.9 px": Optics(blur_px=0.9),
    "blur 1.5 px": Optics(blur_px=1.5),
    "blur 3 px": Optics(blur_px=3.0),
    "noise 5 levels": Optics(blur_px=0.9, read_noise=5.0, shot_noise=0.05),
    "dim, light falls off": Optics(blur_px=0.9, white_level=70.0, distance_exponent=2.0, vignetting=0.6),
}


def pictures(surface: Surface, optics: Optics, rng: np.random.Generator) -> Images:
    """Left and right view of a sheet before a mottled background."""
    rig = study_rig()
    assert rig.right is not None
    assert rig.right_T_left is not None
    back = Background(make_transform(np.eye(3), np.array([0.0, 0.0, 220.0])), seed=int(rng.integers(1 << 30)))
    return (
        render_frame(rig.left, [surface], rng, optics, back),
        render_frame(rig.right, [surface.seen_from(rig.right_T_left)], rng, optics, back.seen_from(rig.right_T_left)),
    )


def pose(rng: np.random.Generator, middle_mm: FloatArray, corners_mm: FloatArray, *, facing: bool) -> FloatArray:
    """``camera_T_body`` with the body's middle at 90 to 150 mm and all corners in both views."""
    while True:
        z = rng.uniform(90.0, 150.0)
        t = np.array([rng.uniform(-0.25, 0.25) * z, rng.uniform(-0.15, 0.15) * z, z])
        rotation = tilted(rng, np.radians(rng.uniform(5.0, 45.0)), t, facing=facing)
        found = make_transform(rotation, t - rotation @ middle_mm)
        if margin_px(study_rig(), found, corners_mm) > 10.0:
            return found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=20, help="per row (default 20)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rig, marker = study_rig(), MarkerModel("DICT_4X4_50", (TagModel(0, 25.0),))
    board = BoardModel(9, 6, 9.0, CharucoModel("DICT_5X5_100", 6.5))
    ends = np.array([[x, y, 0.0] for x in (0.0, 72.0) for y in (0.0, 45.0)])
    say(f"{'':22}{'print':>7}{'found':>7}{'bias %':>10}{'+-':>8}{'scatter %':>11}{'stated %':>10}")
    for name, optics in OPTICS.items():
        for constant, what in ((Constant.TAG_SIZE, "tag"), (Constant.BOARD_SIZE, "board")):
            rng = np.random.default_rng(options.seed)
            measured, stated = [], []
            for _ in range(options.views):
                fit: object
                if constant is Constant.TAG_SIZE:
                    true = pose(rng, np.zeros(3), marker.tags[0].marker_p_corners_mm, facing=True)
                    fit = detect_marker(
                        *pictures(TagSurface(marker.dictionary, 0, 25.0, true), optics, rng), rig, marker
                    )
                else:
                    true = pose(rng, ends.mean(axis=0), ends, facing=False)
                    fit = detect_board(*pictures(BoardSurface(board, true), optics, rng), rig, board)
                if isinstance(fit, MarkerFit | BoardFit):
                    k, told = column(constant), fit.pose.dependence
                    measured.append(100.0 * told.pull[k] / told.information[k, k])
                    stated.append(100.0 * told.information[k, k] ** -0.5)
            if len(measured) < 2:
                say(f"{name:22}{what:>7}{len(measured):>7}")
                continue
            scatter = float(np.std(measured, ddof=1))
            error = scatter / len(measured) ** 0.5
            say(
                f"{name:22}{what:>7}{len(measured):>7}{np.mean(measured):>10.4f}{error:>8.4f}{scatter:>11.4f}"
                f"{np.sqrt(np.mean(np.square(stated))):>10.3f}"
            )


if __name__ == "__main__":
    main()
