"""ROS recordings (1 and 2): looks, marker, stage angle and endoscope images, joined by time to a session's events.

The events:

- with a ``mark`` topic (std_msgs/String, each a JSON object with an event's fields, such as ``{"type": "pair", "pm": 3,
  "sweep": 1}`` or ``{"type": "aim", "corner": [4, 2]}``): each mark is one; a pair takes the nearest look, a track
  the look at its time, if any;
- without: each look (``look``: PointStamped, x lateral and z range; or ``frame``: the probe's data) is a pair.

The marker is the pose at the look's time, interpolated, or the nearest images. Where the recording has the endoscope
holder's pose, a ``camera_moved`` comes before the first event after a move.
"""

from __future__ import annotations

import bisect
import io
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from fgreg.convert.bag_claims import TopicClaims, check_metres, told_of_angles, told_of_frames, told_of_stamps
from fgreg.convert.drafts import Document, Draft, Imported, rows
from fgreg.convert.mapping import RecordingMapping
from fgreg.convert.transform_tree import TransformTree
from fgreg.detection.frame_files import png_bytes
from fgreg.drivers.calibration_parts import rig_of_infos
from fgreg.drivers.ros_messages import (
    ARRAY_TYPES,
    IMAGE_TYPES,
    INFO_TYPES,
    MM_PER_M,
    POINT_TYPES,
    POSE_TYPES,
    SCAN_TYPES,
    TEXT_TYPES,
    TF_TYPES,
    array_of,
    info_of,
    picture_of,
    pose_of,
    scan_deg_of,
    stamp_ns,
)
from fgreg.drivers.ros_recordings import Recording
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, inverse, log_so3
from fgreg.model.camera_model import StereoRig
from fgreg.model.time_sync import PairRefused, TimedPose, interpolate, pose_at

MARK_GAP_S = 1.0
"""Largest time between a mark and its look: the operator presses a key after the look."""
_DEFAULTS = {role: f"/fgreg/{role}" for role in ("marker", "scan", "look", "frame", "mark")}
_KINDS = {
    "left": IMAGE_TYPES,
    "right": IMAGE_TYPES,
    "left_info": INFO_TYPES,
    "right_info": INFO_TYPES,
    "marker": POSE_TYPES,
    "scan": SCAN_TYPES,
    "look": POINT_TYPES,
    "frame": ARRAY_TYPES,
    "mark": TEXT_TYPES,
    "ecm": POSE_TYPES,
}
_OF_LOOK = ("sweep", "amplitude")
Found = TypeVar("Found")


@dataclass(slots=True)
class _Streams:
    """Contents of a recording by role, in time order: (s after the recording's start, value)."""

    marker: list[tuple[float, tuple[FloatArray, FloatArray | None]]] = field(default_factory=list)
    scan: list[tuple[float, float]] = field(default_factory=list)
    looks: list[tuple[float, _Look]] = field(default_factory=list)
    marks: list[tuple[float, Document]] = field(default_factory=list)
    left: list[tuple[float, int]] = field(default_factory=list)
    right: list[tuple[float, int]] = field(default_factory=list)
    ecm: list[tuple[float, tuple[FloatArray, FloatArray | None]]] = field(default_factory=list)
    infos: dict[str, Any] = field(default_factory=dict)
    bad: dict[str, list[str]] = field(default_factory=dict)
    told: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Look:
    """A position (x, range) in mm, or the number of a frame on its topic."""

    position_mm: tuple[float, float] | None = None
    frame: int | None = None


def read_bag(path: Path, mapping: RecordingMapping) -> Imported:
    """Read a recording.

    Raises:
        InputError: a damaged file, topics missing or of another type, an invalid mark.
        MissingExtraError: ``rosbags`` is not installed.
    """
    with Recording(path) as recording:
        topics, told = _topics(recording, mapping)
        streams = _read_streams(recording, topics, mapping)
        rig = _rig(path, streams)
    joined = _Join(path.name, streams, mapping)
    drafts = joined.drafts()
    left_out = [
        f"{len(reasons)} messages on {topic} are not used: {reasons[0]}" for topic, reasons in streams.bad.items()
    ]
    source = f"recording {path.name}, t = 0 at {recording.start_ns / 1e9:.6f} s of its clock"

    def write(folder: Path) -> None:
        _write_frames(path, topics, joined.frames, folder)

    told += [*streams.told, *joined.told]
    return Imported(drafts, write, source, [*left_out, *joined.left_out], rig, told)


def _topics(recording: Recording, mapping: RecordingMapping) -> tuple[dict[str, str], list[str]]:
    """The topic of each role in the recording, from the mapping, else by its default name; sentences about that."""
    told: list[str] = []
    found: dict[str, str] = {}
    for role, kinds in _KINDS.items():
        if role in mapping.topics:
            found[role] = recording.topic(mapping.topics[role], kinds, f"topics.{role}")
        elif role in _DEFAULTS and _DEFAULTS[role] in recording.topics:
            found[role] = recording.topic(_DEFAULTS[role], kinds, f"topics.{role}")
    for side in ("left", "right"):
        if side not in mapping.topics and (name := recording.image_topic(side)) is not None:
            found[side] = name
        if side in found and f"{side}_info" not in found:
            beside = f"{found[side].removesuffix('/compressed').rpartition('/')[0]}/camera_info"
            if beside in recording.topics and recording.topics[beside].kind in INFO_TYPES:
                found[f"{side}_info"] = beside
    if {"look", "frame"} <= found.keys():
        mapped = {"look", "frame"} & mapping.topics.keys()
        if len(mapped) == 2:
            raise InputError("topics", "look and frame, both", "one of them: each would be a look at the same PM")
        # The probe's data have more information than a position computed from them.
        del found["frame" if mapped == {"look"} else "look"]
    for role in mapping.tf:
        if role in mapping.topics:
            raise InputError(f"tf.{role}", f"it, and topics.{role}", "one of the two")
        found.pop(role, None)
    if "ecm" not in found.keys() | mapping.tf.keys():
        name, remark = recording.endoscope_pose_topic()
        told += [remark] if remark else []
        found |= {"ecm": name} if name is not None else {}
    elif "SUJ" in found.get("ecm", "").split("/"):
        told.append(
            f"camera moves are taken from {found['ecm']}: a setup joint's pose does not have the arm's own motion"
        )
    where = recording.path.name
    there = ", ".join(f"{name} ({topic.kind.rpartition('/')[2]})" for name, topic in recording.topics.items())
    if not found.keys() & {"look", "frame", "mark"}:
        expected = "a topic of looks, frames or marks, named in the mapping (topics.look, topics.frame, topics.mark)"
        raise InputError(f"{where}: topics", there[:300] or "none", expected)
    roles = found.keys() | mapping.tf.keys()
    if not roles & {"marker", "left"}:
        raise InputError(f"{where}: topics", there[:300], "the marker's pose (topics.marker) or images (topics.left)")
    if found.keys() & {"look", "frame"} and "scan" not in roles:
        raise InputError(f"{where}: topics", there[:300], "the stage's angle (topics.scan)")
    return found, told


def _read_streams(recording: Recording, topics: dict[str, str], mapping: RecordingMapping) -> _Streams:
    """Read all messages except pixels, in one pass."""
    streams = _Streams()
    roles: dict[str, list[str]] = {}
    for role, name in topics.items():
        roles.setdefault(name, []).append(role)
    claims = {name: TopicClaims(name) for name in roles}
    trees = [name for name, topic in recording.topics.items() if mapping.tf and topic.kind in TF_TYPES]
    tree = TransformTree(recording.path.name)
    for recorded in recording.messages([*roles, *trees]):
        message = recording.decode(recorded)
        if recorded.topic in trees:
            if problems := tree.add_message(message, recorded, recording.start_ns, mapping.by_header):
                streams.bad.setdefault(recorded.topic, []).extend(problems)
            continue
        index = claims[recorded.topic].count
        strange = claims[recorded.topic].add(message, recorded.bag_ns)
        if strange and {"marker", "ecm"} & set(roles[recorded.topic]):
            streams.bad.setdefault(recorded.topic, []).append(strange)
            continue
        time_ns = stamp_ns(message, recorded.bag_ns) if mapping.by_header else recorded.bag_ns
        for role in roles[recorded.topic]:
            try:
                _take(streams, role, message, (time_ns - recording.start_ns) / 1e9, index, mapping)
            except ValueError as error:
                streams.bad.setdefault(recorded.topic, []).append(str(error))
            except InputError as error:
                where = f"{recording.path.name}: {recorded.topic}: message {index}"
                raise InputError(where, error.found, error.expected) from None
    for role, (target, source) in mapping.tf.items():
        if role == "scan":
            streams.scan = tree.angles_deg(target, source, mapping.max_gap_s)
        else:
            poses = tree.poses(target, source, mapping.max_gap_s)
            distances = [float(np.linalg.norm(pose[:3, 3])) for _, pose in poses]
            check_metres(role, f"{recording.path.name}: tf.{role}", distances)
            (streams.marker if role == "marker" else streams.ecm).extend((t, (pose, None)) for t, pose in poses)
    timed: tuple[list[Any], ...] = (streams.marker, streams.scan, streams.looks, streams.marks)
    for stream in (*timed, streams.left, streams.right, streams.ecm):
        stream.sort(key=lambda entry: entry[0])
    _hold_against(recording, streams, {role: claims[name] for role, name in topics.items()}, mapping)
    return streams


def _hold_against(
    recording: Recording, streams: _Streams, claims: dict[str, TopicClaims], mapping: RecordingMapping
) -> None:
    """Check what the topics of each role say of themselves; what is doubtful goes to ``streams.told``.

    Raises:
        InputError: what cannot be.
    """
    for claim in {claim.topic: claim for claim in claims.values()}.values():
        where, stated = f"{recording.path.name}: {claim.topic}", recording.topics[claim.topic].count
        if stated and not claim.count:
            expected = (
                f"{stated}, as its index says; a file without a message index for each chunk needs one (mcap recover)"
            )
            raise InputError(where, "no messages", expected)
        if claim.count != stated:
            streams.told.append(f"there are {claim.count} messages on {claim.topic}, not {stated} as the index says")
    distances: dict[str, list[float]] = {
        "marker": [float(np.linalg.norm(pose[:3, 3])) for _, (pose, _) in streams.marker],
        "ecm": [float(np.linalg.norm(pose[:3, 3])) for _, (pose, _) in streams.ecm],
        "look": [abs(look.position_mm[1]) for _, look in streams.looks if look.position_mm is not None],
    }
    for role, found in distances.items():
        if role in claims:
            check_metres(role, f"{recording.path.name}: {claims[role].topic}", found)
    if "scan" in claims:
        topic = claims["scan"].topic
        unit = mapping.angle_unit or ("deg" if recording.topics[topic].kind.startswith("std_msgs") else "rad")
        angles = [scan_deg for _, scan_deg in streams.scan]
        streams.told += told_of_angles(topic, angles, unit, mapping.angle_unit is not None)
    streams.told += told_of_frames(claims)
    if mapping.by_header:
        streams.told += told_of_stamps({claim.topic: claim for claim in claims.values()}.values())


def _take(streams: _Streams, role: str, message: Any, t: float, index: int, mapping: RecordingMapping) -> None:
    match role:
        case "marker":
            streams.marker.append((t, pose_of(message)))
        case "ecm":
            streams.ecm.append((t, pose_of(message)))
        case "scan":
            unit = mapping.angle_unit or ("deg" if hasattr(message, "data") else "rad")
            streams.scan.append((t, scan_deg_of(message, mapping.joint, unit)))
        case "look":
            position = MM_PER_M * message.point.x, MM_PER_M * message.point.z
            streams.looks.append((t, _Look(position_mm=position)))
        case "frame":
            streams.looks.append((t, _Look(frame=index)))
        case "mark":
            streams.marks.append((t, _mark(str(message.data))))
        case "left":
            streams.left.append((t, index))
        case "right":
            streams.right.append((t, index))
        case _:
            streams.infos.setdefault(role, message)


def _mark(text: str) -> Document:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict) or not isinstance(found.get("type"), str):
        raise InputError("", text[:60] or "nothing", 'a JSON object with a type, such as {"type": "pair", "pm": 3}')
    return found


def _rig(path: Path, streams: _Streams) -> StereoRig | None:
    """The endoscope's calibration for unrectified images, from the first camera_info of each side; None without."""
    infos = {side: streams.infos.get(f"{side}_info") for side in ("left", "right")}
    if infos["left"] is None:
        return None
    left = info_of(infos["left"], f"{path.name}: left camera_info")
    right = None if infos["right"] is None else info_of(infos["right"], f"{path.name}: right camera_info")
    if not left.matrix.any():
        return None  # an uncalibrated camera has a zero matrix
    return rig_of_infos(left, right, MM_PER_M)


class _Join:
    """Joins streams to events by time."""

    def __init__(self, file: str, streams: _Streams, mapping: RecordingMapping) -> None:
        self._file, self._streams, self._mapping = file, streams, mapping
        self.left_out: list[str] = []
        self.told: list[str] = []
        self.frames: dict[tuple[str, int], str] = {}

    def drafts(self) -> list[Draft]:
        made: list[Draft] = []
        if self._streams.marks:
            for t, mark in self._streams.marks:
                self._add(made, f"mark at {t:.3f} s", partial(self._marked, t, mark))
        else:
            pm, last_s = -1, -math.inf
            for t, look in self._streams.looks:
                together = self._mapping.same_pm_s is not None and t - last_s <= self._mapping.same_pm_s
                pm, last_s = pm + (not together), t
                self._add(made, f"look at {t:.3f} s", partial(self._pair, t, look, {"pm": pm}))
        made.sort(key=lambda draft: draft.t)
        return self._with_moves(made)

    def _add(self, made: list[Draft], what: str, make: Callable[[], Document]) -> None:
        try:
            made.append(Draft(make(), f"{self._file}: {what}"))
        except PairRefused as refused:
            self.left_out.append(f"{what} is left out: {refused}")

    def _marked(self, t: float, mark: Document) -> Document:
        match mark["type"]:
            case "pair":
                nearest = _nearest(self._streams.looks, t, MARK_GAP_S, "look")
                return self._pair(*nearest, mark)
            case "aim":
                # The board's corner is detected in images.
                marker = self._marker(t) | (self._images(t) if "corner" in mark else {})
                return {**mark, "t": t, "marker": marker}
            case "track":
                rest = {key: value for key, value in mark.items() if key not in _OF_LOOK}
                return {**rest, "t": t, "marker": self._marker(t), **self._look_fields(t, mark)}
            case _:
                return {**mark, "t": t}

    def _look_fields(self, t: float, mark: Document) -> Document:
        """The probe part of a query: the look at its time, else the stage's angle."""
        try:
            look_s, look = _nearest(self._streams.looks, t, self._mapping.max_gap_s, "look")
        except PairRefused:
            return {"scan_deg": self._scan(t)}
        return {"trus": self._trus(look_s, look, mark)}

    def _trus(self, t: float, look: _Look, mark: Document) -> Document:
        trus: Document = {"scan_deg": self._scan(t)}
        if look.position_mm is not None:
            trus |= {"x_mm": look.position_mm[0], "range_mm": look.position_mm[1]}
        if look.frame is not None:
            trus["frame"] = self._name("frame", look.frame, ".npy")
        return trus | {key: mark[key] for key in _OF_LOOK if key in mark}

    def _pair(self, t: float, look: _Look, mark: Document) -> Document:
        marker, trus = self._marker(t), self._trus(t, look, mark)
        rest = {key: value for key, value in mark.items() if key not in (*_OF_LOOK, "type", "t")}
        return {"type": "pair", "t": t, **rest, "marker": marker, "trus": trus}

    def _marker(self, t: float) -> Document:
        gap = self._mapping.max_gap_s
        if self._streams.marker:
            pose, covariance = _pose_between(self._streams.marker, t, gap)
            return {"camera_T_marker": rows(pose)} | ({} if covariance is None else {"covariance": rows(covariance)})
        return self._images(t)

    def _images(self, t: float) -> Document:
        gap = self._mapping.max_gap_s
        left_s, left = _nearest(self._streams.left, t, gap, "left image")
        marker = {"left": self._name("left", left, ".png")}
        try:
            _, right = _nearest(self._streams.right, left_s, min(gap, 0.02), "right image")
            marker["right"] = self._name("right", right, ".png")
        except PairRefused:
            pass  # one view is enough, with less accuracy
        return marker

    def _scan(self, t: float) -> float:
        """The stage's angle (deg): interpolated between two readings, or the nearest at either end."""
        readings, gap = self._streams.scan, self._mapping.max_gap_s
        after = bisect.bisect_left(readings, t, key=lambda entry: entry[0])
        if 0 < after < len(readings):
            (t0, a), (t1, b) = readings[after - 1], readings[after]
            if t1 - t0 <= 2.0 * gap:
                return a + (b - a) * (t - t0) / (t1 - t0)
        return _nearest(readings, t, gap, "stage angle")[1]

    def _name(self, role: str, index: int, suffix: str) -> str:
        return self.frames.setdefault((role, index), f"frames/{role}-{index:06d}{suffix}")

    def _with_moves(self, drafts: list[Draft]) -> list[Draft]:
        """Insert a ``camera_moved`` before each event at which the holder's pose has changed."""
        if not self._streams.ecm:
            return drafts
        moves = self._mapping.moves
        sigma = np.repeat([math.radians(moves.sigma_deg), moves.sigma_mm], 3)
        out: list[Draft] = []
        old: FloatArray | None = None
        unknown = 0
        for draft in drafts:
            try:
                now = _pose_between(self._streams.ecm, draft.t, 0.5)[0] @ moves.tip_T_camera
            except PairRefused:
                unknown += 1
                out.append(draft)
                continue
            if old is None:
                old = now
            new_T_old = inverse(now) @ old
            shift = float(np.linalg.norm(new_T_old[:3, 3]))
            turn = math.degrees(float(np.linalg.norm(log_so3(new_T_old[:3, :3]))))
            if shift > moves.mm or turn > moves.deg:
                document = {"type": "camera_moved", "t": draft.t, "camera_new_T_camera_old": rows(new_T_old)}
                out.append(Draft(document | {"covariance": rows(np.diag(sigma**2))}, draft.where))
                old = now
            out.append(draft)
        if unknown:
            self.told.append(
                f"{unknown} events have no pose of the endoscope's holder near them: no camera move is known there"
            )
        return out


def _nearest(stream: list[tuple[float, Found]], t: float, gap_s: float, what: str) -> tuple[float, Found]:
    after = bisect.bisect_left(stream, t, key=lambda entry: entry[0])
    near = min(stream[max(0, after - 1) : after + 1], key=lambda entry: abs(entry[0] - t), default=None)
    if near is None:
        raise PairRefused(f"there is no {what}")
    if abs(near[0] - t) > gap_s:
        raise PairRefused(f"the nearest {what} is {abs(near[0] - t):.3f} s away, at most {gap_s:g} s allowed")
    return near


def _pose_between(
    stream: list[tuple[float, tuple[FloatArray, FloatArray | None]]], t: float, gap_s: float
) -> tuple[FloatArray, FloatArray | None]:
    """The pose at a time, with a covariance where both neighbouring poses have one."""
    after = bisect.bisect_left(stream, t, key=lambda entry: entry[0])
    around = stream[max(0, after - 1) : after + 1]
    if all(covariance is not None for _, (_, covariance) in around):
        timed = [TimedPose(s, pose, covariance) for s, (pose, covariance) in around if covariance is not None]
        found = pose_at(timed, t, gap_s)
        return found.parent_T_child, found.covariance
    if len(around) == 2 and around[1][0] - around[0][0] <= gap_s:
        (t0, (a, _)), (t1, (b, _)) = around
        return (interpolate(a, b, (t - t0) / (t1 - t0))[0] if t1 > t0 else b), None
    return _nearest(stream, t, 0.5 * gap_s, "marker pose")[1][0], None


def _write_frames(path: Path, topics: dict[str, str], frames: dict[tuple[str, int], str], folder: Path) -> None:
    """Write the frames that events name, in a second pass."""
    if not frames:
        return
    (folder / "frames").mkdir(exist_ok=True)
    wanted = {(topics[role], index): (role, name) for (role, index), name in frames.items()}
    with Recording(path) as recording:
        counts = dict.fromkeys({topic for topic, _ in wanted}, 0)
        for recorded in recording.messages(counts):
            index = counts[recorded.topic]
            counts[recorded.topic] += 1
            if (recorded.topic, index) not in wanted:
                continue
            role, name = wanted[recorded.topic, index]
            message = recording.decode(recorded)
            try:
                data = _npy(array_of(message)) if role == "frame" else png_bytes(picture_of(message))
            except ValueError as error:
                raise InputError(f"{path.name}: {recorded.topic}: message {index}", str(error), f"a {role}") from None
            (folder / name).write_bytes(data)


def _npy(array: npt.NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()
