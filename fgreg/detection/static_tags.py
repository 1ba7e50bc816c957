"""Poses of static tags in one frame, from the tags that the marker's detector has found in it already."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgreg.detection.board import detect_board
from fgreg.detection.body_pose import choose_pose
from fgreg.detection.corner_noise import pool_corner_noise
from fgreg.detection.marker import tag_corners, view_corners
from fgreg.detection.pose_least_squares import CornerSet, join
from fgreg.detection.results import BoardFit, MarkerFit, RigidFit, board_covariance, marker_covariance
from fgreg.detection.tags import FoundTag
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.session_model import BoardModel, MarkerModel, TagModel
from fgreg.model.static_tags import StaticTag

Picture = npt.NDArray[np.generic]

CORNERS = 4
"""A tag of which a view shows fewer corners is partly covered: the edge of what covers it may pass for its own."""
BOARD = -1
"""Number of the calibration board among the static tags."""


def tags_beside(image: Picture, rig: StereoRig, view: int, marker: MarkerModel) -> tuple[FoundTag, ...]:
    """Tags of the marker's dictionary in a whole image, without the marker's own; ``view`` 0 (left) or 1 (right)."""
    camera, view_T_camera = _view(rig, view)
    return view_corners(image, camera, view, view_T_camera, marker).others or ()


def static_tag_fits(
    views: Sequence[tuple[Picture, Sequence[FoundTag]]], rig: StereoRig, dictionary: str, tags: Sequence[StaticTag]
) -> dict[int, MarkerFit]:
    """Fits of the static tags that all views show whole, by id; one whose pose is ambiguous is left out.

    Args:
        views: of the left and the right camera, or of the left one: the image, and the tags that were found in it.
        rig: the cameras.
        dictionary: of the tags, the marker's.
        tags: the session's static tags.
    """
    if not tags:
        return {}
    body = MarkerModel(dictionary, tuple(TagModel(tag.id, tag.size_mm) for tag in tags))
    by_view = [_corners(image, found, rig, view, body) for view, (image, found) in enumerate(views)]
    fits = {}
    for tag in tags:
        sides = [corners.get(tag.id) for corners in by_view]
        if any(corners is None or len(corners.view) < CORNERS for corners in sides):
            continue  # with a view less the same errors would look like a motion
        pose = choose_pose(join([corners for corners in sides if corners is not None]), "tag", [], Constant.TAG_SIZE)
        if isinstance(pose, RigidFit):
            fits[tag.id] = MarkerFit(pose, (tag.id,))
    return fits


def _corners(
    image: Picture, found: Sequence[FoundTag], rig: StereoRig, view: int, body: MarkerModel
) -> dict[int, CornerSet]:
    """Corners of each tag in one view, by id."""
    camera, view_T_camera = _view(rig, view)
    return tag_corners(image, camera, view, view_T_camera, body, found)


def _view(rig: StereoRig, view: int) -> tuple[CameraModel, FloatArray]:
    """One camera, and its frame's transform from that of the left one."""
    if view == 0:
        return rig.left, np.eye(4)
    if rig.right is None or rig.right_T_left is None:
        raise ValueError("a right frame, but the rig has no right camera")
    return rig.right, rig.right_T_left


@dataclass(frozen=True, slots=True, eq=False)
class StaticView:
    """What is needed to find static tags, and the board, in one frame: plain values for another process.

    Attributes:
        views: as of :func:`static_tag_fits`.
        rig, dictionary, tags: of the session.
        board: to be looked for as well; None: not now.
    """

    views: tuple[tuple[Picture, tuple[FoundTag, ...]], ...]
    rig: StereoRig
    dictionary: str
    tags: tuple[StaticTag, ...]
    board: BoardModel | None = None


def static_poses(view: StaticView) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Pose (4, 4) of each static tag found, and of the board (as :data:`BOARD`), with covariance (6, 6)."""
    fits = static_tag_fits(view.views, view.rig, view.dictionary, view.tags)
    poses = {
        number: (fit.camera_T_marker, marker_covariance(fit, pool_corner_noise([fit.pose])))
        for number, fit in fits.items()
    }
    if view.board is not None:
        pictures = [picture for picture, _ in view.views]
        board = detect_board(pictures[0], pictures[1] if len(pictures) > 1 else None, view.rig, view.board)
        if isinstance(board, BoardFit) and len(board.pose.views) == len(pictures):
            poses[BOARD] = board.camera_T_board, board_covariance(board, pool_corner_noise([board.pose]))
    return poses
