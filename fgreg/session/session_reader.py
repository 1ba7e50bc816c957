"""Reads and checks a session's folder: ``session.yaml``, ``events.jsonl``, ``ground_truth.yaml``, frames.

Every problem becomes an :class:`InputError` that names the file, the key or line, what was found and what was
expected. :func:`read_session` raises the first, :func:`check_session` returns all of them.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path

from fgreg.errors import InputError
from fgreg.model.events import AimEvent, Event, PairEvent, TrackEvent
from fgreg.model.plausible import implausible_distances
from fgreg.model.session_model import SessionModel
from fgreg.output.atomic_file import SESSION_FILES
from fgreg.output.leftovers import leftovers
from fgreg.schema.limits import TRUTH_BYTES, TRUTH_NODES
from fgreg.schema.problems import FieldError, input_error
from fgreg.session.event_reader import EventLog, frames_of, read_events
from fgreg.session.frame_files import check_frames
from fgreg.session.ground_truth import GROUND_TRUTH, GroundTruth
from fgreg.session.rig_file import not_made_from
from fgreg.session.setup_reader import Setup, read_setup
from fgreg.session.yaml_loader import load_yaml

SETUP_FILE, EVENTS_FILE, TRUTH_FILE, _ = SESSION_FILES


@dataclass(frozen=True, slots=True, eq=False)
class Session:
    """A session as recorded.

    Attributes:
        folder: as given.
        model: its set-up.
        events: in order.
        warnings: sentences about values that are allowed but implausible, and about a truncated last line.
        cut_short: the one about the last line, where that is the beginning of an event's line and was left out.
    """

    folder: Path
    model: SessionModel
    events: tuple[Event, ...]
    warnings: tuple[str, ...]
    cut_short: str = ""


def session_place(folder: Path) -> Path:
    """A session's folder, without links.

    Raises:
        InputError: there is none; where an interrupted run has left it under another name, how to restore it.
    """
    try:
        resolved = folder.resolve(strict=True)
    except (OSError, RuntimeError, ValueError) as error:
        absent = isinstance(error, FileNotFoundError | NotADirectoryError)
        found = "nothing" if absent else f"no access ({getattr(error, 'strerror', None) or error})"
        left = leftovers(folder) if absent else []
        raise InputError(str(folder), found, "; ".join(["a session's folder", *left])) from None
    if not resolved.is_dir():
        raise InputError(str(folder), "a file", "a session's folder")
    return resolved


def read_session(folder: str | Path) -> Session:
    """Read a session's folder. The paths of frames are checked to be inside it; that the files exist is not checked.

    Raises:
        InputError: the first problem of the folder, of ``session.yaml`` or of ``events.jsonl``.
    """
    folder = Path(folder)
    problems: list[InputError] = []
    setup, log = _read(folder, problems)
    if problems:
        raise problems[0]
    if setup is None or setup.model is None:
        raise AssertionError("no model and no problem")
    return Session(folder, setup.model, tuple(log.events), tuple(_warnings(setup, log)), log.cut_short)


def read_more_events(path: Path, session_folder: Path) -> tuple[Event, ...]:
    """Events in a file of their own, JSON lines as ``events.jsonl``, for the set-up of a session.

    Frames are named relative to the file's folder.

    Raises:
        InputError: the first problem of the session's set-up or of the file.
    """
    problems: list[InputError] = []
    setup = read_setup(load_yaml(session_folder / SETUP_FILE, SETUP_FILE), SETUP_FILE, session_folder.name, problems)
    log = read_events(path, path.name, path.resolve().parent, setup, problems)
    if problems:
        raise problems[0]
    return tuple(log.events)


def check_session(folder: Path) -> tuple[list[InputError], list[str]]:
    """Check a session, its ground truth where there is one, and the headers of all frames that events name.

    Returns:
        All problems and all warnings.
    """
    problems: list[InputError] = []
    setup, log = _read(folder, problems)
    try:
        _read_truth(folder, problems)
    except InputError as error:
        problems.append(error)
    camera = None if setup is None else setup.camera
    probe = None if setup is None else setup.probe
    frames = [use for event in log.events for use in frames_of(event, EVENTS_FILE, folder.resolve())]
    problems.extend(check_frames(frames, probe, None if camera is None else camera.left.image_size))
    return problems, _warnings(setup, log)


def read_ground_truth(folder: Path) -> GroundTruth | None:
    """The ground truth of a session, or None where there is no ``ground_truth.yaml``.

    Raises:
        InputError: the first problem of the file.
    """
    problems: list[InputError] = []
    truth = _read_truth(folder, problems)
    if problems:
        raise problems[0]
    return truth


def _read(folder: Path, problems: list[InputError]) -> tuple[Setup | None, EventLog]:
    """Read both files of a session; appends problems to ``problems`` and reads the rest."""
    try:
        resolved = session_place(folder)
    except InputError as error:
        problems.append(error)
        return None, EventLog()
    setup: Setup | None = None
    try:
        data = load_yaml(folder / SETUP_FILE, SETUP_FILE)
        setup = read_setup(data, SETUP_FILE, resolved.name or "session", problems, resolved)
        if setup.model is not None and setup.model.rig is not None:
            not_made_from(setup.model.rig, resolved / EVENTS_FILE, f"{SETUP_FILE}: rig")
    except InputError as error:
        problems.append(error)
    return setup, read_events(folder / EVENTS_FILE, EVENTS_FILE, resolved, setup, problems)


def _warnings(setup: Setup | None, log: EventLog) -> list[str]:
    """Warnings about implausible values in both files."""
    cut = [log.cut_short] if log.cut_short else []
    if setup is None:
        return cut
    beyond = []
    if setup.model is not None:
        lower, upper = (math.degrees(limit) for limit in setup.model.stage.limits_device_rad)
        for event in log.events:
            looks = (
                (event.trus,) if isinstance(event, PairEvent) else event.looks if isinstance(event, TrackEvent) else ()
            )
            if any(not lower - 1e-6 <= look.scan_deg <= upper + 1e-6 for look in looks):
                beyond.append(event.line)
    out = [*setup.warnings, *cut]
    out += [f"{EVENTS_FILE}: {text}" for text in _distances(log)]
    if beyond:
        where = f"{EVENTS_FILE}: line {beyond[0]}" + (f" and {len(beyond) - 1} more" if beyond[1:] else "")
        out.append(f"{where}: scan_deg is outside stage.limits_deg, [{lower:g}, {upper:g}]")
    return out


def _distances(log: EventLog) -> tuple[str, ...]:
    """Doubts about the unit of poses, spots and ranges."""
    shots = [event for event in log.events if isinstance(event, AimEvent | PairEvent)]
    spots = [event.camera_p_spot_mm for event in shots if isinstance(event, AimEvent)]
    ranges = [event.trus.range_mm for event in shots if isinstance(event, PairEvent)]
    return implausible_distances(
        [pose for event in shots if (pose := event.marker.camera_T_marker) is not None],
        [spot for spot in spots if spot is not None],
        [value for value in ranges if value is not None],
    )


def _read_truth(folder: Path, problems: list[InputError]) -> GroundTruth | None:
    path = folder / TRUTH_FILE
    if not os.path.lexists(path):
        return None
    data = load_yaml(path, TRUTH_FILE, max_bytes=TRUTH_BYTES, max_nodes=TRUTH_NODES)
    try:
        truth: GroundTruth = GROUND_TRUTH.read(data)
    except FieldError as error:
        problems += [input_error(problem, TRUTH_FILE, data) for problem in error.problems]
        return None
    return truth
