"""Accuracy, honesty and speed of marker and board detection, against rendered truth and on real frames.

Renders a marker (one square tag) and a calibration board in front of a stereo endoscope with lens distortion, blur,
uneven light and sensor noise, detects them, and prints the figures beside their targets:

  views      30 mm tag at 80 to 180 mm, stereo and left view alone: errors of rotation, across and along the axis,
             depth bias, mean squared Mahalanobis error (6 expected), milliseconds per shot; the same with OpenCV's
             sub-pixel corners for comparison
  border     tags whose nearest corner is at a given distance in pixels from the image's border (negative: cut off)
  ambiguity  single tags of several sizes, distances and tilts in one view: share reported as ambiguous, share wrong
  board      plain and ChArUco board, stereo and left view alone: error and covariance of a corner
  bard       real webcam frames of two many-tag bodies (../shared/data/bard_aruco, left out where absent)

Example:
  nice python tools/study_marker.py --views 500 --seed 1
  python tools/study_marker.py --only border,ambiguity --json marker.json
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fgreg.detection.board import detect_board
from fgreg.detection.corner_noise import CornerNoise, pool_corner_noise
from fgreg.detection.marker import detect_marker
from fgreg.detection.results import MarkerFit, NotFound, board_corner, board_covariance, marker_covariance
from fgreg.geometry.transforms import (
    FloatArray,
    as_float_array,
    exp_so3,
    inverse,
    log_so3,
    make_transform,
    rotation_to_direction,
    transform_points,
)
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.session_model import BoardModel, CharucoModel, MarkerModel, TagModel
from fgreg.simulation.lens import project_points
from fgreg.simulation.render import Optics, render_frame
from fgreg.simulation.surfaces import Background, BoardSurface, TagSurface

SIZE = (1280, 720)
BARD = Path(__file__).resolve().parents[2] / "shared" / "data" / "bard_aruco"
SECTIONS = ("views", "border", "ambiguity", "board", "bard")
Images = tuple[Any, Any]


def study_rig() -> StereoRig:
    """An endoscope with f about 1100 px, mild distortion and a 5 mm baseline."""
    left = CameraModel(
        SIZE,
        as_float_array([[1100.0, 0.0, 635.0], [0.0, 1102.0, 355.0], [0.0, 0.0, 1.0]], 3, 3),
        as_float_array([-0.18, 0.06, 0.0006, -0.0004, 0.0], 5),
    )
    right = CameraModel(
        SIZE,
        as_float_array([[1096.0, 0.0, 645.0], [0.0, 1098.0, 361.0], [0.0, 0.0, 1.0]], 3, 3),
        as_float_array([-0.17, 0.05, -0.0003, 0.0005, 0.0], 5),
    )
    right_T_left = make_transform(exp_so3(np.array([0.002, 0.006, -0.003])), np.array([-5.0, 0.05, 0.1]))
    return StereoRig(left, right, as_float_array(right_T_left, 4, 4))


def margin_px(rig: StereoRig, camera_T_body: FloatArray, body_p: FloatArray) -> float:
    """Distance of the nearest of some points from the border of either view, px; negative outside."""
    assert rig.right is not None
    assert rig.right_T_left is not None
    worst = np.inf
    for camera, view_T_body in ((rig.left, camera_T_body), (rig.right, rig.right_T_left @ camera_T_body)):
        px = project_points(camera, transform_points(view_T_body, body_p))
        worst = min(worst, float(np.minimum(px, np.array(SIZE) - 1.0 - px).min()))
    return worst


def tilted(rng: np.random.Generator, tilt_rad: float, sight: FloatArray, *, facing: bool) -> FloatArray:
    """A rotation with z tilted by ``tilt`` from the line of sight, in a random direction; ``facing``: to the camera."""
    around, roll = rng.uniform(-np.pi, np.pi, 2)
    lean = exp_so3(tilt_rad * np.array([np.cos(around), np.sin(around), 0.0]))
    turn = np.diag([1.0, -1.0, -1.0]) if facing else np.eye(3)
    return np.asarray(
        rotation_to_direction(sight / np.linalg.norm(sight)) @ lean @ turn @ exp_so3(np.array([0, 0, roll]))
    )


def render_pair(rig: StereoRig, surface: Any, rng: np.random.Generator, blur_px: float, far_mm: float) -> Images:
    """Left and right frames of a surface before a mottled background."""
    assert rig.right is not None
    assert rig.right_T_left is not None
    optics = Optics(blur_px=blur_px, reference_mm=0.6 * far_mm)
    back = Background(make_transform(np.eye(3), np.array([0.0, 0.0, far_mm])), seed=int(rng.integers(1 << 30)))
    left = render_frame(rig.left, [surface], rng, optics, back)
    seen = surface.seen_from(rig.right_T_left)
    return left, render_frame(rig.right, [seen], rng, optics, back.seen_from(rig.right_T_left))


def pose_error(true: FloatArray, found: FloatArray) -> FloatArray:
    """(6,) right tangent (first order in the translation)."""
    error = inverse(true) @ found
    return np.concatenate([log_so3(error[:3, :3]), error[:3, 3]])


def mahalanobis(error: FloatArray, covariance: FloatArray) -> float:
    """Squared."""
    return float(error @ np.linalg.solve(covariance, error))


def say(text: str) -> None:
    """Print at once, also into a pipe."""
    print(text, flush=True)


def progress(done: int, total: int) -> None:
    """On standard error, so that the figures can be piped."""
    if done % 50 == 0 or done == total:
        print(f"  {done}/{total}", file=sys.stderr, flush=True)


def summarise(errors: list[tuple[FloatArray, FloatArray]], squares: list[float]) -> dict[str, float]:
    """Figures of pose errors: (right tangent, translation error along camera axes)."""
    xi = np.array([e[0] for e in errors])
    dt = np.array([e[1] for e in errors])
    rotation = np.degrees(np.linalg.norm(xi[:, :3], axis=1))
    across = np.linalg.norm(dt[:, :2], axis=1)
    return {
        "views": len(errors),
        "rotation_median_deg": float(np.median(rotation)),
        "rotation_p95_deg": float(np.percentile(rotation, 95)),
        "across_median_mm": float(np.median(across)),
        "along_median_mm": float(np.median(np.abs(dt[:, 2]))),
        "along_p95_mm": float(np.percentile(np.abs(dt[:, 2]), 95)),
        "depth_bias_mm": float(dt[:, 2].mean()),
        "mahalanobis_mean": float(np.mean(squares)),
        "mahalanobis_median": float(np.median(squares)),
    }


def study_views(views: int, rng: np.random.Generator) -> dict[str, Any]:
    """Accuracy, NEES and time of the main section."""
    rig, marker = study_rig(), MarkerModel("DICT_4X4_50", (TagModel(0, 30.0),))
    kinds = ("stereo", "mono", "stereo subpixel", "mono subpixel")
    fits: dict[str, list[MarkerFit]] = {kind: [] for kind in kinds}
    errors: dict[str, list[tuple[FloatArray, FloatArray]]] = {kind: [] for kind in kinds}
    reasons: dict[str, list[str]] = {kind: [] for kind in kinds}
    seconds: dict[str, list[float]] = {kind: [] for kind in kinds}
    for i in range(views):
        while True:
            z, px = rng.uniform(80.0, 180.0), rng.uniform((0.0, 0.0), SIZE)
            t = np.array([(px[0] - 640.0) / 1100.0 * z, (px[1] - 360.0) / 1100.0 * z, z])
            true = make_transform(tilted(rng, np.radians(rng.uniform(0.0, 50.0)), t, facing=True), t)
            if margin_px(rig, true, marker.tags[0].marker_p_corners_mm) > 3.0:
                break
        pair = render_pair(rig, TagSurface(marker.dictionary, 0, 30.0, true), rng, rng.uniform(0.6, 1.4), z + 60.0)
        for kind in kinds:
            start = time.perf_counter()
            right = pair[1] if kind.startswith("stereo") else None
            fit = detect_marker(pair[0], right, rig, marker, edges="subpixel" not in kind)
            seconds[kind].append(time.perf_counter() - start)
            if isinstance(fit, NotFound):
                reasons[kind].append(fit.reason)
                continue
            fits[kind].append(fit)
            errors[kind].append((pose_error(true, fit.camera_T_marker), fit.camera_T_marker[:3, 3] - true[:3, 3]))
        progress(i + 1, views)
    out: dict[str, Any] = {}
    for kind in kinds:
        noise = pool_corner_noise(fit.pose for fit in fits[kind])
        squares = [
            mahalanobis(e[0], marker_covariance(fit, noise)) for e, fit in zip(errors[kind], fits[kind], strict=True)
        ]
        out[kind] = summarise(errors[kind], squares) | {
            "not_found": len(reasons[kind]),
            "noise_scale": noise.scale,
            "rms_px": float(np.median([fit.pose.rms_px for fit in fits[kind]])),
            "ms": 1e3 * float(np.median(seconds[kind])),
        }
        if "subpixel" not in kind:
            for reason in reasons[kind]:
                say(f"  {kind} not found: {reason}")
    names = {
        "rotation_median_deg": "rotation, median, deg (< 0.1)",
        "rotation_p95_deg": "rotation, 95 %, deg",
        "across_median_mm": "across the axis, median, mm (< 0.04)",
        "along_median_mm": "along the axis, median, mm (< 0.15)",
        "along_p95_mm": "along the axis, 95 %, mm",
        "depth_bias_mm": "depth bias, mm (< 0.1)",
        "mahalanobis_mean": "squared Mahalanobis, mean (5 to 8)",
        "mahalanobis_median": "squared Mahalanobis, median (5.3)",
        "noise_scale": "corner noise scale",
        "rms_px": "residual RMS, median, px",
        "not_found": "not found",
        "ms": "milliseconds per shot, median",
    }
    say(f"30 mm tag, {views} views" + "".join(f"{kind:>17}" for kind in kinds))
    for key, name in names.items():
        say(f"  {name:38}" + "".join(f"{out[kind][key]:17.4g}" for kind in kinds))
    return out


def study_border(views: int, rng: np.random.Generator) -> dict[str, Any]:
    """Tags pushed to the border; bad: a pose more than 0.1 deg or 0.1 mm off."""
    rig, marker = study_rig(), MarkerModel("DICT_4X4_50", (TagModel(0, 30.0),))
    corners = marker.tags[0].marker_p_corners_mm
    out: dict[str, Any] = {}
    say("tags at the border: corner's distance px, tried, found, bad, worst mm")
    for wanted in (-8, -4, -2, 0, 1, 2, 3, 5, 10):
        found = bad = 0
        worst = 0.0
        tries = max(8, views // 10)
        for _ in range(tries):
            z, along = rng.uniform(80.0, 180.0), rng.uniform(-0.04, 0.04)
            axis, sign = int(rng.integers(2)), int(rng.choice([-1, 1]))
            # Half of them parallel to the border, where a cut is hardest to detect.
            rotation = tilted(rng, np.radians(rng.uniform(0.0, 40.0)), np.array([0.0, 0.0, 1.0]), facing=True)
            if rng.random() < 0.5:
                rotation = np.diag([1.0, -1.0, -1.0]) @ exp_so3(rng.normal(size=3) * 0.02)
            low, high = 0.0, 0.8

            def placed(offset: float) -> FloatArray:
                t = np.array([along, along, 1.0]) * z  # noqa: B023
                t[axis] = sign * offset * z  # noqa: B023
                return make_transform(rotation, t)  # noqa: B023

            def left_margin(pose: FloatArray) -> float:
                px = project_points(rig.left, transform_points(pose, corners))
                return float(np.minimum(px, np.array(SIZE) - 1.0 - px).min())

            for _ in range(40):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if left_margin(placed(middle)) > wanted else (low, middle)
            true = placed(low)
            image, _ = render_pair(
                rig, TagSurface(marker.dictionary, 0, 30.0, true), rng, rng.uniform(0.6, 1.4), z + 60.0
            )
            fit = detect_marker(image, None, rig, marker)
            if isinstance(fit, NotFound):
                continue
            found += 1
            error = pose_error(true, fit.camera_T_marker)
            worst = max(worst, float(np.linalg.norm(error[3:])))
            bad += bool(np.degrees(np.linalg.norm(error[:3])) > 0.1 or np.linalg.norm(error[3:]) > 0.1)
        out[str(wanted)] = {"tried": tries, "found": found, "bad": bad, "worst_mm": worst}
        say(f"  {wanted:4d} {tries:5d} {found:5d} {bad:4d} {worst:8.3f}")
    return out


def study_ambiguity(views: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Wrong: rotation off by more than 2 deg and by more than five sigma."""
    rig = study_rig()
    out: list[dict[str, Any]] = []
    say("single tags: size mm, distance mm, tilt deg: ambiguous %, wrong % (left view alone; then stereo)")
    for size, z in ((30.0, 180.0), (30.0, 300.0), (30.0, 500.0), (14.5, 130.0), (14.5, 250.0), (8.0, 100.0)):
        marker = MarkerModel("DICT_4X4_50", (TagModel(0, size),))
        for tilt in (0.0, 4.0, 8.0, 12.0, 20.0, 40.0):
            counts = {"mono": [0, 0, 0], "stereo": [0, 0, 0]}
            tries = max(6, views // 25)
            for _ in range(tries):
                t = np.array([*rng.uniform(-0.2, 0.2, 2) * z, z])
                true = make_transform(tilted(rng, np.radians(tilt), t, facing=True), t)
                surface = TagSurface(marker.dictionary, 0, size, true)
                left, right = render_pair(rig, surface, rng, rng.uniform(0.6, 1.4), z + 60.0)
                for kind, second in (("mono", None), ("stereo", right)):
                    fit = detect_marker(left, second, rig, marker)
                    if isinstance(fit, NotFound):
                        counts[kind][0 if "ambiguous" in fit.reason else 2] += 1
                        continue
                    error = np.linalg.norm(pose_error(true, fit.camera_T_marker)[:3])
                    sigma = np.sqrt(np.trace(marker_covariance(fit, CornerNoise())[:3, :3]))
                    counts[kind][1] += bool(error > max(np.radians(2.0), 5.0 * sigma))
            row: dict[str, Any] = {"size_mm": size, "distance_mm": z, "tilt_deg": tilt, "tried": tries}
            for kind, (ambiguous, wrong, missed) in counts.items():
                row |= {f"{kind}_ambiguous": ambiguous, f"{kind}_wrong": wrong, f"{kind}_missed": missed}
            out.append(row)
            shares = "   ".join(
                f"{100 * c[0] / tries:4.0f} {100 * c[1] / tries:4.0f}" + (f" missed {c[2]}" if c[2] else "")
                for c in counts.values()
            )
            say(f"  {size:5.1f} {z:5.0f} {tilt:4.0f}: {shares}")
    wrong = sum(row["mono_wrong"] + row["stereo_wrong"] for row in out)
    say(f"  wrong in all: {wrong} of {2 * sum(row['tried'] for row in out)}")
    return out


def study_board(views: int, rng: np.random.Generator) -> dict[str, Any]:
    """A corner of the board: error along camera axes, covariance (3 expected), and the whole pose's (6 expected)."""
    rig = study_rig()
    out: dict[str, Any] = {}
    say("board, corner [column, row] at random: RMS mm along x, y, z; squared Mahalanobis of corner (3), pose (6); ms")
    charuco = CharucoModel("DICT_5X5_100", 7.0)
    for name, board in (("plain", BoardModel(9, 6, 10.0)), ("charuco", BoardModel(9, 6, 10.0, charuco))):
        found: dict[str, list[Any]] = {"stereo": [], "mono": []}
        missed = {"stereo": 0, "mono": 0}
        seconds: dict[str, list[float]] = {"stereo": [], "mono": []}
        outline = np.array([[c * 10.0, r * 10.0, 0.0] for c in (-1, 9) for r in (-1, 6)])
        tries = max(10, views // 5)
        for _ in range(tries):
            while True:
                z = rng.uniform(120.0, 200.0)
                rotation = tilted(rng, np.radians(rng.uniform(0.0, 45.0)), np.array([0.0, 0.0, 1.0]), facing=False)
                centre = np.array([rng.uniform(-20.0, 20.0), rng.uniform(-10.0, 10.0), z])
                true = make_transform(rotation, centre - rotation @ np.array([40.0, 25.0, 0.0]))
                if margin_px(rig, true, outline) > 3.0:
                    break
            left, right = render_pair(rig, BoardSurface(board, true), rng, rng.uniform(0.6, 1.4), z + 80.0)
            for kind, second in (("stereo", right), ("mono", None)):
                start = time.perf_counter()
                fit = detect_board(left, second, rig, board)
                seconds[kind].append(time.perf_counter() - start)
                if isinstance(fit, NotFound):
                    missed[kind] += 1
                    say(f"  {name} {kind} not found: {fit.reason}")
                else:
                    found[kind].append((true, fit))
        for kind, items in found.items():
            noise = pool_corner_noise(fit.pose for _, fit in items)
            errors, corner_squares, pose_squares = [], [], []
            for true, fit in items:
                column, row = int(rng.integers(board.columns)), int(rng.integers(board.rows))
                camera_p, covariance = board_corner(fit, column, row, noise)
                error = camera_p - transform_points(true, np.array([column, row, 0.0]) * board.square_mm)
                errors.append(error)
                corner_squares.append(mahalanobis(error, covariance))
                pose_squares.append(mahalanobis(pose_error(true, fit.camera_T_board), board_covariance(fit, noise)))
            rms = np.sqrt(np.mean(np.square(errors), axis=0))
            out[f"{name} {kind}"] = {
                "views": len(items),
                "not_found": missed[kind],
                "rms_mm": rms.tolist(),
                "bias_mm": np.mean(errors, axis=0).tolist(),
                "corner_mahalanobis_mean": float(np.mean(corner_squares)),
                "pose_mahalanobis_mean": float(np.mean(pose_squares)),
                "noise_scale": noise.scale,
                "ms": 1e3 * float(np.median(seconds[kind])),
            }
            figures = out[f"{name} {kind}"]
            say(
                f"  {name:8}{kind:8}{len(items):4d} of {tries}: {rms[0]:.4f} {rms[1]:.4f} {rms[2]:.4f}; "
                f"{figures['corner_mahalanobis_mean']:.1f}, {figures['pose_mahalanobis_mean']:.1f}; "
                f"{figures['ms']:.0f} ms"
            )
    return out


def read_bard(folder: Path) -> tuple[StereoRig, dict[str, MarkerModel], list[Any]]:
    """Camera, the two bodies and the frames of the real data."""
    calibration = folder / "calibration_640x480"
    camera = CameraModel(
        (640, 480),
        as_float_array(np.loadtxt(calibration / "calib.intrinsics.txt"), 3, 3),
        as_float_array(np.loadtxt(calibration / "calib.distortion.txt").ravel()[:5], 5),
    )
    bodies = {}
    for name in ("reference", "pointer"):
        tags = []
        for line in np.loadtxt(folder / f"{name}.txt"):
            corners = line[4:].reshape(4, 3)
            # The file's corners begin at the top left, with y down; a tag's y is up and its z points out of the page.
            right, down = corners[1] - corners[0], corners[3] - corners[0]
            size = float(np.linalg.norm(right))
            rotation = np.column_stack([right / size, -down / size, np.cross(right, -down) / size**2])
            marker_T_tag = as_float_array(make_transform(rotation, corners.mean(axis=0)), 4, 4)
            tags.append(TagModel(int(line[0]), size, marker_T_tag))
        bodies[name] = MarkerModel("DICT_ARUCO_ORIGINAL", tuple(tags))
    video = cv2.VideoCapture(str(folder / "multipattern.avi"))
    frames: list[Any] = []
    while True:
        ok, frame = video.read()
        if not ok:
            return StereoRig(camera), bodies, frames
        frames.append(frame)


def study_bard(folder: Path) -> dict[str, Any] | None:
    """Whole bodies in every frame; each tag by itself against the body's pose."""
    if not folder.is_dir():
        say("real frames: not here, left out")
        return None
    rig, bodies, frames = read_bard(folder)
    out: dict[str, Any] = {}
    say(
        "real frames: body, found, tags, worst RMS px (<= 1.4), repeatability of x, y, z mm and rotation deg, predicted"
    )
    for name, marker in bodies.items():
        fits = [detect_marker(frame, None, rig, marker) for frame in frames]
        found = [fit for fit in fits if isinstance(fit, MarkerFit)]
        noise = pool_corner_noise(fit.pose for fit in found)
        poses = np.array([fit.camera_T_marker for fit in found])
        turns = log_so3(np.swapaxes(poses[:1, :3, :3], 1, 2) @ poses[:, :3, :3])
        predicted = np.sqrt(np.mean([np.diag(marker_covariance(fit, noise)) for fit in found], axis=0))
        single = {"found": 0, "ambiguous": 0, "not_found": 0, "wrong": 0}
        for frame, body in zip(frames, fits, strict=True):
            if isinstance(body, NotFound):
                continue
            for tag in marker.tags:
                alone = detect_marker(frame, None, rig, MarkerModel(marker.dictionary, (tag,)))
                if isinstance(alone, NotFound):
                    single["ambiguous" if "ambiguous" in alone.reason else "not_found"] += 1
                    continue
                single["found"] += 1
                off = pose_error(body.camera_T_marker, alone.camera_T_marker)[:3]
                single["wrong"] += bool(np.degrees(np.linalg.norm(off)) > 10.0)
        out[name] = {
            "frames": len(frames),
            "found": len(found),
            "tags": [len(fit.tags) for fit in found],
            "rms_px": [fit.pose.rms_px for fit in found],
            "translation_std_mm": poses[:, :3, 3].std(axis=0, ddof=1).tolist(),
            "rotation_std_deg": np.degrees(turns.std(axis=0, ddof=1)).tolist(),
            "predicted_sigma_translation_mm": predicted[3:].tolist(),
            "predicted_sigma_rotation_deg": np.degrees(predicted[:3]).tolist(),
            "single_tags": single,
        }
        figures = out[name]
        say(
            f"  {name:10}{len(found)} of {len(frames)}, {min(figures['tags'])} to {max(figures['tags'])} tags, "
            f"{max(figures['rms_px']):.2f} px; "
            + " ".join(f"{v:.2f}" for v in figures["translation_std_mm"])
            + " mm, "
            + " ".join(f"{v:.2f}" for v in figures["rotation_std_deg"])
            + " deg; predicted "
            + " ".join(f"{v:.2f}" for v in figures["predicted_sigma_translation_mm"])
            + " mm"
        )
        say(f"    each tag alone: {single} (wrong: over 10 deg off the body's pose)")
    return out


def main() -> None:
    """Run the sections asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=500, help="rendered views of the main section (default 500)")
    parser.add_argument("--seed", type=int, default=1, help="of everything random (default 1)")
    parser.add_argument("--only", default=",".join(SECTIONS), help="sections to run, comma separated")
    parser.add_argument("--bard", type=Path, default=BARD, help="folder of the real frames")
    parser.add_argument("--json", type=Path, help="write all figures here")
    arguments = parser.parse_args()
    chosen = arguments.only.split(",")
    unknown = sorted(set(chosen) - set(SECTIONS))
    if unknown or arguments.views < 1:
        parser.error(f"no such section: {', '.join(unknown)}" if unknown else "--views has to be at least 1")
    figures: dict[str, Any] = {"seed": arguments.seed, "opencv": cv2.__version__}
    for index, name in enumerate(SECTIONS):
        if name not in chosen:
            continue
        rng = np.random.default_rng([arguments.seed, index])
        if name == "bard":
            figures[name] = study_bard(arguments.bard)
        else:
            study = {
                "views": study_views,
                "border": study_border,
                "ambiguity": study_ambiguity,
                "board": study_board,
            }[name]
            figures[name] = study(arguments.views, rng)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
