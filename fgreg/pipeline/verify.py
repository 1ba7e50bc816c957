"""Verifies a finished registration with new shots: the steps of ``fgreg verify``.

read the result -> solve its session again, for the joint covariance of registration and beam -> read the new shots,
detect in their frames -> compare. Nothing is added to the registration, and nothing is written.
"""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgreg.camera_moves.recorded_session import find_epochs
from fgreg.camera_moves.recorded_tags import with_tag_moves
from fgreg.camera_moves.validity import Validity, Verification, verify
from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.errors import InputError
from fgreg.geometry.target_error import tre_mm
from fgreg.model.estimate import EpochEstimate, Verdict
from fgreg.model.events import CameraMovedEvent, Event, HandChoice, PairEvent, refused_lines
from fgreg.model.measurements import Pair
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.pipeline.exclude import without_lines
from fgreg.pipeline.solve import Progress, detection_conditions, with_moves
from fgreg.registration.solve import solve
from fgreg.session.result_file import RESULT_FILE, read_result
from fgreg.session.rig_file import sections
from fgreg.session.session_reader import Session, read_more_events, read_session
from fgreg.tracking.snapshot import Snapshot

SAME_MM = 0.2
"""Distance at the targets between the result and what its session gives now up to which they are the same."""
SAME_RIG = ("probe", "stage", "camera", "marker")
"""Sections of session.yaml that a new session shares with the registered one."""


@dataclass(frozen=True, slots=True)
class UnusedShot:
    """A new pair that is not usable, and why."""

    t: float
    pm: int
    reason: str


@dataclass(frozen=True, slots=True)
class VerifyReport:
    """Result of a verification.

    Attributes:
        session: name of the registered session. new: as given.
        registered: verdict of the registration itself, which new shots do not change.
        verification: verdict, odds and shots.
        unused: new pairs in whose frames marker or PM was not found.
        elapsed_s: time of it all.
    """

    session: str
    registered: Verdict
    new: Path
    verification: Verification
    unused: tuple[UnusedShot, ...]
    elapsed_s: float


def verify_session(
    folder: Path, new: Path, config: SolveConfig | None = None, progress: Progress | None = None
) -> VerifyReport:
    """Verify a session's registration, of its last camera epoch, with new shots.

    Args:
        folder: the session, with its ``result.yaml``.
        new: a session's folder, or a file of JSON lines with one or more ``pair`` events.
        config: as it was solved with.
        progress: called after each frame.

    Raises:
        InputError: bad input, or no registration that may be used.
    """
    start = time.perf_counter()
    config = config or SolveConfig()
    result_path = folder / RESULT_FILE
    session = read_session(folder)
    if not result_path.exists():
        raise InputError(
            str(result_path), "nothing", f"a finished registration: run fgreg solve {shlex.quote(str(folder))}"
        )
    result = read_result(result_path)
    if result.verdict is Verdict.REFUSED or not result.epochs:
        raise InputError(str(result_path), "a refused registration", "one that may be used")
    events, model = _new_events(new, session)
    snapshot = _solved_again(without_lines(session, result.excluded), result.epochs, config, progress)
    epoch = snapshot.epoch(result.epochs[-1].index)
    if epoch is None:
        raise AssertionError("the registration of the last epoch was compared")
    known = {_content(event) for event in session.events if isinstance(event, PairEvent)}
    for event in events:
        if isinstance(event, PairEvent) and _content(event) in known:
            where = f"{new}: line {event.line}"
            raise InputError(
                where, "a shot of the registration itself", "new ones: of its own shots it is always valid"
            )
    pairs, unused = _new_pairs(events, model, progress)
    moved = next((event for event in events if isinstance(event, CameraMovedEvent)), None)
    if moved is not None:
        text = f"{new} reports a camera move at {moved.t:.1f} s: register again"
        found = Verification(Validity.MOVED, text, np.inf, 0.0, ())
    else:
        found = verify(pairs, snapshot, epoch, session.model, config)
    return VerifyReport(session.model.name, result.verdict, new, found, unused, time.perf_counter() - start)


def _new_events(new: Path, session: Session) -> tuple[tuple[Event, ...], SessionModel]:
    """The new events that were not refused (those left out by hand are among them), and the set-up to measure by."""
    model = session.model
    if new.is_dir():
        other = read_session(new)
        ours, theirs = sections(model), sections(other.model)
        for section in SAME_RIG:
            if ours.get(section) != theirs.get(section):
                where = f"{new / 'session.yaml'}: {section}"
                raise InputError(
                    where, "other values", f"those of {session.folder / 'session.yaml'}: one and the same rig"
                )
        events, model = other.events, other.model
    else:
        events = read_more_events(new, session.folder)
    refused = refused_lines(events)
    events = tuple(event for event in events if event.line not in refused)
    if not any(isinstance(event, PairEvent | CameraMovedEvent) for event in events):
        raise InputError(str(new), "no pair event", "at least one pair: a shot with its look")
    return events, model


def _content(shot: PairEvent) -> tuple[object, ...]:
    """What tells a recorded shot from all others."""
    marker, look = shot.marker, shot.trus
    pose = None if marker.camera_T_marker is None else marker.camera_T_marker.tobytes()
    return shot.t, shot.pm, pose, marker.left, look.scan_deg, look.x_mm, look.range_mm, look.frame


def _new_pairs(
    events: Sequence[Event], model: SessionModel, progress: Progress | None
) -> tuple[tuple[Pair, ...], tuple[UnusedShot, ...]]:
    shots = [event for event in events if isinstance(event, PairEvent | HandChoice)]
    extracted = extract_measurements(
        shots, model, progress=None if progress is None else lambda done, total: progress("new frames", done, total)
    )
    unused = tuple(
        UnusedShot(shot.t, shot.pm, reason)
        for i, reason in sorted(extracted.unused.items())
        if isinstance(shot := shots[i], PairEvent)
    )
    return extracted.measurements.pairs, unused


def _solved_again(
    session: Session, epochs: Sequence[EpochEstimate], config: SolveConfig, progress: Progress | None
) -> Snapshot:
    """The snapshot of the session solved again; its last registration is that of the result.

    Raises:
        InputError: it is not.
    """
    tagged = with_tag_moves(session)
    if sum(isinstance(event, CameraMovedEvent) for event in tagged.events) < len(epochs):
        session = tagged  # else solved without looking for moves
    extracted = extract_measurements(
        session.events,
        session.model,
        progress=None if progress is None else lambda done, total: progress("looking at frames", done, total),
    )
    found = find_epochs(extracted.measurements, session.model, config)
    if len(epochs) == len(extracted.measurements.epochs) + len(found.moves):  # else solved without looking for moves
        extracted = with_moves(extracted, found)
    conditions = detection_conditions(extracted)
    solution = solve(extracted.measurements, (), session.model, config, conditions)
    wanted = "that of the session as it is now: solve it again (with the same options here and there)"
    there, now = epochs[-1].trus_T_camera, solution.epochs[-1].trus_T_camera
    if there is None or now is None or solution.snapshot is None or len(epochs) != len(solution.epochs):
        raise InputError(str(session.folder / RESULT_FILE), "another registration", wanted)
    apart_mm = float(tre_mm(now, there, session.model.targets_mm).max())
    if apart_mm > SAME_MM:
        raise InputError(str(session.folder / RESULT_FILE), f"a registration {apart_mm:.2f} mm away", wanted)
    return solution.snapshot
