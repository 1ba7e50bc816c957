"""Camera moves that static tags show in the frames of a recorded session."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from fgreg.camera_moves.static_tags import (
    TagFrame,
    TagSettings,
    average_tags,
    move_covariance,
    observed,
    tag_motion,
    turn_rad,
)
from fgreg.camera_moves.view_shift import view_shift_mm
from fgreg.errors import InputError
from fgreg.model.events import CameraMovedEvent, Event, Shot
from fgreg.session.session_reader import Session

SETTINGS = TagSettings(windows=(1,), least_mm=0.3)
"""A recording has one frame for each shot."""


def with_tag_moves(session: Session) -> Session:
    """The session with a detected ``camera_moved`` event before each shot in whose frames the static tags have moved.

    The tags of a shot are compared with their means since the epoch's start. A session without static tags or frames is
    as it was, and so is one that was recorded with moves detected. A warning tells of each move.

    Raises:
        InputError: a frame is missing or invalid.
    """
    detected = any(isinstance(event, CameraMovedEvent) and event.detected for event in session.events)
    if not session.model.static_tags or detected:
        return session
    events: list[Event] = []
    warnings = list(session.warnings)
    epoch: list[TagFrame] = []
    frames = dict(_tags_of_frames(session))
    for index, event in enumerate(session.events):
        if isinstance(event, CameraMovedEvent):
            epoch = []
        frame = frames.get(index)
        if frame is not None:
            share = SETTINGS.constant_share
            motion = tag_motion(average_tags(epoch, share), average_tags([frame], share))
            if motion is not None and SETTINGS.is_move(motion):
                moved = motion.camera_new_T_camera_old
                covariance = move_covariance(moved, motion.covariance)
                events.append(CameraMovedEvent(event.t, 0, moved, covariance, detected=True, since_t=event.t))
                shift_mm, turn_deg = view_shift_mm(moved), math.degrees(turn_rad(moved))
                warnings.append(
                    f"the static tags show that the camera moved before line {event.line} ({event.t:.1f} s): "
                    f"{shift_mm:.1f} mm and {turn_deg:.1f} deg; a camera epoch of its own begins there"
                )
                epoch = []
            epoch = [*epoch, frame][-SETTINGS.reference_frames :]
        events.append(event)
    return replace(session, events=tuple(events), warnings=tuple(warnings))


def _tags_of_frames(session: Session) -> Iterator[tuple[int, TagFrame]]:
    """Indices of events, and the static tags in their frames; frames that several looks share count once."""
    seen = set()
    for index, event in enumerate(session.events):
        if not isinstance(event, Shot) or event.marker.left is None or event.marker.left in seen:
            continue
        seen.add(event.marker.left)
        # They load OpenCV, which sessions without frames do not need.
        from fgreg.detection.event_frames import marker_pictures
        from fgreg.detection.static_tags import StaticView, static_poses, tags_beside

        rig, marker = session.model.camera, session.model.marker
        if rig is None or marker is None:
            raise InputError("session.yaml: camera", "nothing", f"the cameras, for line {event.line} of events.jsonl")
        pictures = [picture for picture in marker_pictures(event.marker, event.line, rig) if picture is not None]
        views = tuple((picture, tags_beside(picture, rig, view, marker)) for view, picture in enumerate(pictures))
        poses = static_poses(StaticView(views, rig, marker.dictionary, session.model.static_tags))
        if poses:
            yield index, observed(poses)
