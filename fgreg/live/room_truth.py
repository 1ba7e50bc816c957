"""Writes the ``ground_truth.yaml`` of a session in the simulated room, at the session's end."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.errors import FgregError
from fgreg.model.measurements import Measurements
from fgreg.output.atomic_file import FileKind, write_file
from fgreg.schema.yaml_writer import yaml_text
from fgreg.session.ground_truth import GroundTruth
from fgreg.session.session_reader import TRUTH_FILE, read_ground_truth, read_session
from fgreg.simulation.documents import rows

ROOM_TRUTH = FileKind(
    "the ground truth of a simulated room", (b"trus_T_camera:",), (b"\nx_moved_s:",), file_name=TRUTH_FILE
)

TruthAt = Callable[[Sequence[float], Sequence[float]], dict[str, Any]]
"""As :meth:`fgreg.simulation.room.Room.truth_at`."""


def write_room_truth(truth_at: TruthAt, folder: Path, start_s: float, begin_t: float) -> None:
    """Write the ground truth of a session that was recorded in a room that is still running.

    The epochs are those of the session. Each gets the camera's true pose at the epoch's last pair: after an undetected
    camera move within an epoch, the registration at the epoch's end is wrong, and is evaluated as wrong. ``x_moved_s``
    are the times at which the camera truly began to move in this room; ``x_stood`` are its poses at the start and after
    each of these moves.

    Args:
        truth_at: asks the room for the truth.
        folder: of the complete session.
        start_s: session time 0 on the room's clock.
        begin_t: session time after which the events come from this room. Earlier events come from another room, and
            their entries in the file stay.

    Raises:
        FgregError: the room does not answer, the truth of the earlier epochs is unknown, or the folder has a ground
            truth that is not a room's.
    """
    session = read_session(folder)
    measured = extract_measurements(session.events, session.model).measurements
    last_t = session.events[-1].t if session.events else 0.0
    at_t = _epoch_ends(measured, last_t)
    earlier = read_ground_truth(folder)
    old = sum(t <= begin_t for t in at_t)
    first = {pair.pm: pair.t for pair in reversed(measured.pairs)}
    fresh = {pm: t for pm, t in sorted(first.items()) if t > begin_t}
    truth = truth_at([start_s + t for t in at_t[old:]], [start_s + t for t in fresh.values()])
    text = yaml_text(_document(truth, earlier, old, list(fresh), start_s))
    write_file(folder / TRUTH_FILE, text, ROOM_TRUTH)


def _epoch_ends(measured: Measurements, last_t: float) -> list[float]:
    """Session time of each epoch's last pair; the epoch's end if it has none."""
    ends = [start.t for start in measured.epochs[1:]] + [last_t]
    for pair in measured.pairs:  # in the order of time
        ends[pair.epoch] = pair.t
    return ends


def _document(
    truth: dict[str, Any], earlier: GroundTruth | None, old: int, fresh: list[int], start_s: float
) -> dict[str, Any]:
    known = () if earlier is None else earlier.trus_T_camera[:old]
    if len(known) < old:
        raise FgregError(f"the ground truth of the session's first {old} camera epochs is unknown")
    spots = {} if earlier is None else {pm: rows(spot) for pm, spot in earlier.trus_p_pm_mm.items()}
    spots |= {pm: rows(np.array(spot)) for pm, spot in zip(fresh, truth["spots_mm"], strict=True)}
    return {
        "trus_T_camera": [rows(np.array(pose)) for pose in [*known, *truth["trus_T_camera"]]],
        "marker_T_laser": rows(np.array(truth["marker_T_laser"])),
        "pms": spots,
        "tracks": [],
        "x_seed": truth["seed"],
        "x_moved_s": [round(t - start_s, 3) for t in truth["moved_s"]],
        "x_stood": [rows(np.array(pose)) for pose in truth["stood"]],
    }
