"""One stereo frame with a tag: detection and pose, by this package, OpenCV and the AprilTag library."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from bench.compare import Row, Section, Target, in_turn, rows_of, say
from fgreg.detection.marker import detect_marker, marker_from_views
from fgreg.detection.marker_roi import MarkerRoi
from fgreg.detection.results import MarkerFit, NotFound
from fgreg.geometry.transforms import FloatArray, make_transform
from fgreg.model.camera_model import StereoRig
from fgreg.model.session_model import MarkerModel, TagModel
from fgreg.simulation.surfaces import TagSurface
from study_marker import SIZE, margin_px, render_pair, study_rig, tilted

FRAMES = 10
TAG_MM = 30.0
OPENCV, OWN, TRACKED = "OpenCV ArUco, sub-pixel corners", "this package", "this package, tracked"


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    left: Any
    right: Any
    camera_T_marker: FloatArray


def make_frames(rig: StereoRig, marker: MarkerModel, count: int, seed: int) -> list[Frame]:
    """Rendered stereo frames of a tag at 80 to 180 mm, as tools/study_marker.py has them."""
    rng, frames = np.random.default_rng(seed), list[Frame]()
    while len(frames) < count:
        z, px = rng.uniform(80.0, 180.0), rng.uniform((0.0, 0.0), SIZE)
        t = np.array([(px[0] - 640.0) / 1100.0 * z, (px[1] - 360.0) / 1100.0 * z, z])
        pose = make_transform(tilted(rng, np.radians(rng.uniform(0.0, 50.0)), t, facing=True), t)
        if margin_px(rig, pose, marker.tags[0].marker_p_corners_mm) > 3.0:
            tag = TagSurface(marker.dictionary, 0, TAG_MM, pose)
            left, right = render_pair(rig, tag, rng, rng.uniform(0.6, 1.4), z + 60.0)
            frames.append(Frame(left, right, pose))
    return frames


def _pose_by_pnp(rig: StereoRig, marker: MarkerModel, corners: Any) -> FloatArray | None:
    """Marker position (3,) from the left view's corners, in the order of the model's."""
    found, _, t = cv2.solvePnP(
        marker.tags[0].marker_p_corners_mm,
        np.asarray(corners, dtype=np.float64).reshape(-1, 1, 2),
        rig.left.matrix,
        rig.left.distortion,
        flags=cv2.SOLVEPNP_IPPE_SQUARE,
    )
    return np.asarray(t, dtype=np.float64).ravel() if found else None


def bench_marker(repeats: int, seed: int) -> Section:
    """All detectors on the same frames; the time is that of a stereo frame."""
    cv2.setNumThreads(1)
    rig, marker = study_rig(), MarkerModel("DICT_APRILTAG_36h11", (TagModel(0, TAG_MM),))
    say("marker: rendering")
    frames = make_frames(rig, marker, FRAMES, seed)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    opencv = cv2.aruco.ArucoDetector(dictionary, parameters)
    assert rig.right is not None
    assert rig.right_T_left is not None
    right, right_T_left = rig.right, rig.right_T_left

    def own(frame: Frame) -> FloatArray | None:
        return _position(detect_marker(frame.left, frame.right, rig, marker))

    rois = {
        id(frame): (MarkerRoi(rig.left, 0, np.eye(4), marker), MarkerRoi(right, 1, right_T_left, marker))
        for frame in frames
    }

    compared: dict[int, MarkerFit] = {}

    def tracked(frame: Frame) -> FloatArray | None:
        views = [roi.detect(image) for roi, image in zip(rois[id(frame)], (frame.left, frame.right), strict=True)]
        found = marker_from_views(views[0], views[1], marker, compared.get(id(frame)))
        if isinstance(found, MarkerFit) and found.pose.clearance is not None:
            compared[id(frame)] = found
        return _position(found)

    def aruco(frame: Frame) -> FloatArray | None:
        corners, _, _ = opencv.detectMarkers(frame.left)
        opencv.detectMarkers(frame.right)
        return _pose_by_pnp(rig, marker, corners[0]) if len(corners) else None

    detectors: dict[str, Callable[[Frame], FloatArray | None]] = {
        OPENCV: aruco,
        OWN: own,
        TRACKED: tracked,
    }
    absent: list[Row] = []
    case = f"stereo frame of {SIZE[0]} x {SIZE[1]} px"
    if importlib.util.find_spec("pyapriltags") is None:
        absent.append(Row("marker", case, "AprilTag library", note="not installed"))
    else:
        import pyapriltags

        for name, decimate in (("AprilTag library, half resolution", 2.0), ("AprilTag library", 1.0)):
            library = pyapriltags.Detector("tag36h11", quad_decimate=decimate)

            def apriltag(frame: Frame, library: Any = library) -> FloatArray | None:
                found = library.detect(frame.left)
                library.detect(frame.right)
                # Its corners begin at the lower left; OpenCV draws these tags turned by half a turn.
                return _pose_by_pnp(rig, marker, np.roll(found[0].corners[::-1], 2, axis=0)) if found else None

            detectors[name] = apriltag
    notes = {name: _accuracy(detect, frames) for name, detect in detectors.items()}
    runs = {name: (lambda d=detect: [d(frame) for frame in frames]) for name, detect in detectors.items()}
    times = in_turn(runs, repeats)
    rows = [*rows_of("marker", case, times, notes, ms_of=FRAMES, own=(OWN, TRACKED)), *absent]
    ratio = {row.name: row.ratio or 0.0 for row in rows}
    targets = (
        Target("marker of a stereo frame, over OpenCV", ratio[OWN], 2.0),
        Target("the same tracked, over OpenCV", ratio[TRACKED], 0.5),
    )
    return Section(tuple(rows), targets)


def _position(found: MarkerFit | NotFound) -> FloatArray | None:
    return None if isinstance(found, NotFound) else found.camera_T_marker[:3, 3]


def _accuracy(detect: Callable[[Frame], FloatArray | None], frames: list[Frame]) -> str:
    """Found, and the median error of the position."""
    errors = []
    for frame in frames:
        position = detect(frame)
        if position is not None:
            errors.append(float(np.linalg.norm(position - frame.camera_T_marker[:3, 3])))
    median = f"{np.median(errors):.3f} mm" if errors else "none"
    return f"found {len(errors)} of {len(frames)}, position error {median}"
