"""Shots that are left out by hand: ``exclude`` and ``include`` events to the shots that do not count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from fgreg.model.estimate import ExcludedShot
from fgreg.model.events import (
    AimEvent,
    Event,
    ExcludeEvent,
    HandChoice,
    IncludeEvent,
    PairEvent,
    PointEvent,
    refused_lines,
)


def excluded_shots(events: Sequence[Event]) -> dict[int, ExcludedShot]:
    """The aims, looks and known points that are left out after these events, by their lines, in the order of lines.

    A choice is of shots before it: a PM that is looked at again counts again. One that says neither why nor who takes
    nothing from an earlier one that does.
    """
    shots: dict[int, ExcludedShot] = {}
    looks: dict[int, list[int]] = {}
    out: dict[int, ExcludeEvent] = {}
    aims, points, refused = 0, 0, refused_lines(events)
    for event in events:
        if isinstance(event, AimEvent):
            shots[event.line] = ExcludedShot("aim", event.line, event.t, aim=aims)
            aims += 1
        elif isinstance(event, PairEvent):
            shots[event.line] = ExcludedShot("pair", event.line, event.t, pm=event.pm)
            looks.setdefault(event.pm, []).append(event.line)
        elif isinstance(event, PointEvent):
            shots[event.line] = ExcludedShot("point", event.line, event.t, point=points)
            points += 1
        elif isinstance(event, HandChoice) and event.line not in refused:
            for line in [event.shot_line] if event.pm is None else looks.get(event.pm, []):
                if line is None:
                    continue
                if isinstance(event, IncludeEvent):
                    out.pop(line, None)
                elif event.reason or event.by or line not in out:
                    out[line] = event
    chosen = sorted(out.keys() & shots.keys())
    return {line: replace(shots[line], reason=out[line].reason, by=out[line].by) for line in chosen}
