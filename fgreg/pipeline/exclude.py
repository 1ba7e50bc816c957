"""Leaves shots of a recorded session out by hand, for one solve or for good: ``fgreg exclude``, ``fgreg include``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from pathlib import Path

from fgreg.errors import InputError
from fgreg.model.estimate import ExcludedShot
from fgreg.model.events import AimEvent, Event, ExcludeEvent, IncludeEvent, PairEvent, PointEvent
from fgreg.model.excluded_shots import excluded_shots
from fgreg.schema.problems import numbers_text
from fgreg.session.journal import Journal
from fgreg.session.session_reader import Session, read_session


@dataclass(frozen=True, slots=True)
class ShotNames:
    """Shots as a user names them: PMs by number, aims and known points by their place among the session's, from 0."""

    pms: tuple[int, ...] = ()
    aims: tuple[int, ...] = ()
    points: tuple[int, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.pms or self.aims or self.points)


def without_shots(session: Session, names: ShotNames, prefix: str) -> Session:
    """The session as if it ended with ``exclude`` events for these shots; its files stay as they are.

    Shots that its own events leave out keep the reason of those.

    ``prefix``: of the options that named them, for messages and reasons.

    Raises:
        InputError: a shot that is not there.
    """
    out = excluded_shots(session.events)
    lines = [
        (event.line, option)
        for pm, of_line, option in _chosen(session.events, names, prefix)
        for event in session.events
        if event.line not in out and (event.line == of_line or (isinstance(event, PairEvent) and event.pm == pm))
    ]
    t, line = (session.events[-1].t, session.events[-1].line) if session.events else (0.0, 0)
    events = [
        ExcludeEvent(t, line + number, shot_line=of_line, reason=f"option {option}")
        for number, (of_line, option) in enumerate(lines, 1)
    ]
    return replace(session, events=(*session.events, *events)) if events else session


def without_lines(session: Session, excluded: Sequence[ExcludedShot]) -> Session:
    """The session as a result has it that leaves out these shots, be it by its events or by options."""
    t, line = (session.events[-1].t, session.events[-1].line) if session.events else (0.0, 0)
    events = [
        ExcludeEvent(t, line + number, shot_line=shot.line, reason=shot.reason, by=shot.by)
        for number, shot in enumerate(excluded, 1)
    ]
    return replace(session, events=(*session.events, *events)) if events else session


def record_choice(
    folder: Path,
    names: ShotNames,
    *,
    reason: str = "",
    by: str = "",
    include: bool = False,
    warn: Callable[[str], None] = lambda _: None,
) -> tuple[ExcludedShot, ...]:
    """Append ``exclude`` events for these shots to a session, or ``include`` events; returns all that it leaves out.

    ``warn``: told what was wrong with the file, such as a last line that was cut short.

    Raises:
        InputError: a shot that is not there, or (``include``) not left out; nothing is recorded.
        JournalError: another program records to the session, or the disk fails.
    """
    read_session(folder)  # a session without events gets no file
    with Journal.open(folder) as journal:
        for text in journal.warnings:
            warn(text)
        events = journal.events
        out = excluded_shots(events).values()
        if include:
            _present("--pm", names.pms, {shot.pm for shot in out}, "a PM that is left out")
            _present("--aim", names.aims, {shot.aim for shot in out}, "an aim that is left out")
            _present("--point", names.points, {shot.point for shot in out}, "a known point that is left out")
        kind, t = IncludeEvent if include else ExcludeEvent, journal.last_t or 0.0
        chosen = [kind(t, 0, pm, line, reason, by) for pm, line, _ in _chosen(events, names, "--")]
        for event in chosen:
            journal.append(event)
        return tuple(excluded_shots(journal.events).values())


def _chosen(events: Sequence[Event], names: ShotNames, prefix: str) -> list[tuple[int | None, int | None, str]]:
    """PM or line of each shot that is named, and the option that names it."""
    aims = [event.line for event in events if isinstance(event, AimEvent)]
    points = [event.line for event in events if isinstance(event, PointEvent)]
    pms = {event.pm for event in events if isinstance(event, PairEvent)}
    _present(f"{prefix}pm", names.pms, pms, "a PM of the session")
    _present(f"{prefix}aim", names.aims, {*range(len(aims))}, "an aim of the session, counted from 0")
    _present(f"{prefix}point", names.points, {*range(len(points))}, "a known point of the session, counted from 0")
    return [
        *((pm, None, f"{prefix}pm") for pm in dict.fromkeys(names.pms)),
        *((None, aims[aim], f"{prefix}aim") for aim in dict.fromkeys(names.aims)),
        *((None, points[point], f"{prefix}point") for point in dict.fromkeys(names.points)),
    ]


def _present(option: str, named: Sequence[int], there: AbstractSet[int | None], expected: str) -> None:
    for number in named:
        if number not in there:
            there_text = numbers_text(one for one in there if one is not None)
            raise InputError(option, str(number), f"{expected}: {there_text}")
