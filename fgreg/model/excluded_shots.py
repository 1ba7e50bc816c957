"""Shots that are left out by hand: ``exclude`` and ``include`` events to the aims and looks that do not count."""

from __future__ import annotations

from collections.abc import Sequence

from fgreg.model.estimate import ExcludedShot
from fgreg.model.events import AimEvent, Event, ExcludeEvent, HandChoice, IncludeEvent, PairEvent, refused_lines


def excluded_shots(events: Sequence[Event]) -> dict[int, ExcludedShot]:
    """The aims and looks that are left out after these events, by their lines, in the order of lines.

    A choice is of shots before it: a PM that is looked at again counts again. One that says neither why nor who takes
    nothing from an earlier one that does.
    """
    shots: dict[int, tuple[AimEvent | PairEvent, int]] = {}
    looks: dict[int, list[int]] = {}
    out: dict[int, ExcludeEvent] = {}
    aims, refused = 0, refused_lines(events)
    for event in events:
        if isinstance(event, AimEvent):
            shots[event.line] = event, aims
            aims += 1
        elif isinstance(event, PairEvent):
            shots[event.line] = event, 0
            looks.setdefault(event.pm, []).append(event.line)
        elif isinstance(event, HandChoice) and event.line not in refused:
            for line in [event.shot_line] if event.pm is None else looks.get(event.pm, []):
                if line is None:
                    continue
                if isinstance(event, IncludeEvent):
                    out.pop(line, None)
                elif event.reason or event.by or line not in out:
                    out[line] = event
    return {line: _excluded(*shots[line], out[line]) for line in sorted(out.keys() & shots.keys())}


def _excluded(shot: AimEvent | PairEvent, number: int, event: ExcludeEvent) -> ExcludedShot:
    if isinstance(shot, AimEvent):
        return ExcludedShot("aim", shot.line, shot.t, aim=number, reason=event.reason, by=event.by)
    return ExcludedShot("pair", shot.line, shot.t, pm=shot.pm, reason=event.reason, by=event.by)
