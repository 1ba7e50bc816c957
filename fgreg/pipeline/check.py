"""Checks a session as ``fgreg check`` does: its files, and which shots a solve would leave out and why."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgreg.detection.events_to_measurements import ExtractedMeasurements, extract_measurements
from fgreg.detection.results import MarkerFit, marker_covariance
from fgreg.errors import InputError
from fgreg.output.leftovers import leftovers
from fgreg.session.event_writer import type_of
from fgreg.session.input_hashes import stale
from fgreg.session.result_file import RESULT_FILE, read_result
from fgreg.session.session_reader import EVENTS_FILE, check_session, read_session


@dataclass(frozen=True, slots=True)
class UnusedShot:
    """A shot that a solve would leave out.

    Attributes:
        line: in events.jsonl. kind: its type there. reason: as in the result.
    """

    line: int
    kind: str
    reason: str

    @property
    def text(self) -> str:
        return f"{EVENTS_FILE}: line {self.line}: this {self.kind} is not used: {self.reason}"


@dataclass(frozen=True, slots=True)
class SessionCheck:
    """What is wrong with a session.

    Attributes:
        problems: for which a solve ends with one line. warnings: sentences.
        unused: shots that a solve leaves out, by the numbers and the frames alone.
        markers: how many markers were found in the frames, and how well; empty where no frame was looked at.
    """

    problems: tuple[InputError, ...]
    warnings: tuple[str, ...]
    unused: tuple[UnusedShot, ...] = ()
    markers: str = ""


def check(
    folder: Path, *, frames: bool = True, progress: Callable[[str, int, int], None] | None = None
) -> SessionCheck:
    """Check a session's files and, with ``frames``, detect in its frames as a solve does.

    A session with problems is not looked at further.
    """
    problems, warnings = check_session(folder)
    warnings = [*leftovers(folder), *warnings, *_about_result(folder)]
    if problems or not frames:
        return SessionCheck(tuple(problems), tuple(warnings))
    session = read_session(folder)
    try:
        extracted = extract_measurements(
            session.events,
            session.model,
            progress=None if progress is None else lambda done, total: progress("looking at frames", done, total),
        )
    except InputError as error:
        return SessionCheck((error,), tuple(warnings))
    unused = tuple(
        UnusedShot(session.events[index].line, type_of(session.events[index]), reason)
        for index, reason in sorted(extracted.unused.items())
    )
    return SessionCheck((), tuple(warnings), unused, _about_markers(extracted))


def _about_markers(extracted: ExtractedMeasurements) -> str:
    """The yield of the pictures in a sentence."""
    fits = [fit for fit in extracted.markers.values() if isinstance(fit, MarkerFit)]
    if not extracted.markers:
        return ""
    text = f"markers: found in {len(fits)} of {len(extracted.markers)} shots with pictures"
    if not fits:
        return text
    variances = [np.diag(marker_covariance(fit, extracted.marker_noise)) for fit in fits]
    turn, shift = np.median([[np.sqrt(v[:3].sum()), np.sqrt(v[3:].sum())] for v in variances], axis=0)
    return f"{text}; median 1 sigma {np.degrees(turn):.3f} deg, {shift:.3f} mm"


def _about_result(folder: Path) -> list[str]:
    """What is wrong with a session's result: stale, not readable, or not known what it was made from."""
    result = folder / RESULT_FILE
    if not os.path.lexists(result):
        return []
    try:
        found = stale(result, read_result(result))
    except InputError as error:
        return [str(error)]
    return [f"{result}: {found}; solve the session again"] if found else []
