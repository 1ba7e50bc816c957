"""What the simulated room knows and no estimator may: a session's ``ground_truth.yaml``, written at its end."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.detection.events_to_measurements import recognise
from fgreg.errors import FgregError, InputError
from fgreg.model.measurements import Measurements
from fgreg.session.ground_truth import GroundTruth
from fgreg.session.session_reader import TRUTH_FILE, read_ground_truth, read_session
from fgreg.simulation.documents import rows
from fgreg.simulation.write import yaml_text

Ask = Callable[[Sequence[float], Sequence[float]], dict[str, Any]]
"""As :meth:`fgreg.simulation.room.Room.truth_at`."""


def write_room_truth(ask: Ask, folder: Path, start_s: float, begin_t: float) -> None:
    """Write the truth about a session that was recorded in a room that still runs.

    Epochs are the session's own. Each gets the pose in which the camera stood at the epoch's last pair: if it was moved
    within an epoch and nobody noticed, the registration that was told at the epoch's end is wrong, and is found to be.
    ``x_moved_s`` are the times at which the camera truly began to move in this room, ``x_stood`` where it stood at the
    start and after each.

    Args:
        ask: tells the truth.
        folder: of the session, complete.
        start_s: of session time 0, on the clock of who tells it.
        begin_t: session time after which this room's events are; those before are another room's, and what the file
            says of them stays.

    Raises:
        FgregError: the room does not answer, or nobody knows the truth about the epochs before.
    """
    session = read_session(folder)
    measured = recognise(session.events, session.model).measurements
    last_t = session.events[-1].t if session.events else 0.0
    at_t = _epoch_ends(measured, last_t)
    earlier = read_ground_truth(folder)
    old = sum(t <= begin_t for t in at_t)
    first = {pair.pm: pair.t for pair in reversed(measured.pairs)}
    fresh = {pm: t for pm, t in sorted(first.items()) if t > begin_t}
    told = ask([start_s + t for t in at_t[old:]], [start_s + t for t in fresh.values()])
    text = yaml_text(_document(told, earlier, old, list(fresh), start_s))
    path = folder / TRUTH_FILE
    part = path.with_name(f".{TRUTH_FILE}.tmp")
    try:
        part.write_text(text, encoding="utf-8")
        part.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise InputError(str(path), f"a place that refuses files ({error.strerror})", "a writable one") from None


def _epoch_ends(measured: Measurements, last_t: float) -> list[float]:
    """Session times of each epoch's last pair; of its end where it has none."""
    ends = [start.t for start in measured.epochs[1:]] + [last_t]
    for pair in measured.pairs:  # in the order of time
        ends[pair.epoch] = pair.t
    return ends


def _document(
    told: dict[str, Any], earlier: GroundTruth | None, old: int, fresh: list[int], start_s: float
) -> dict[str, Any]:
    known = () if earlier is None else earlier.trus_T_camera[:old]
    if len(known) < old:
        raise FgregError(f"nobody knows the truth about the session's first {old} camera epochs")
    spots = {} if earlier is None else {pm: rows(spot) for pm, spot in earlier.trus_p_pm_mm.items()}
    spots |= {pm: rows(np.array(spot)) for pm, spot in zip(fresh, told["spots_mm"], strict=True)}
    return {
        "trus_T_camera": [rows(np.array(pose)) for pose in [*known, *told["trus_T_camera"]]],
        "marker_T_laser": rows(np.array(told["marker_T_laser"])),
        "pms": spots,
        "tracks": [],
        "x_seed": told["seed"],
        "x_moved_s": [round(t - start_s, 3) for t in told["moved_s"]],
        "x_stood": [rows(np.array(pose)) for pose in told["stood"]],
    }
