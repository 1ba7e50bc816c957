"""What kept a live session from taking pairs, by its record: stops of the stage, and a machine that was too slow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from fgreg.model.estimate import SessionEstimate
from fgreg.model.events import Event, NoteEvent, PairEvent, StageEvent

MACHINE, CAMERA = "this machine", "the camera sends"
"""How notes about what they can do begin (fgreg.live.pace): each takes the place of the one before."""
TOO_SLOW, TOO_FEW = "this machine is too slow to register", "the camera sends too few frames to register"
"""How those begin that keep a session from taking pairs."""
MEANT = ("the operator", "tracking held", "connected", "the registration is refused")
"""How the reasons of stops begin that hinder nothing."""
MOTIONS = ("home", "search", "track")


def hindrances(events: Sequence[Event]) -> tuple[str, ...]:
    """Why the stage did not do what it was asked to, most frequent first; then what was too slow in the end."""
    stops: Counter[tuple[str, str]] = Counter()
    motion, slow = "", ""
    for event in events:
        if isinstance(event, StageEvent) and event.command in MOTIONS:
            motion = event.command
        elif isinstance(event, StageEvent) and event.command == "stop" and not event.reason.startswith(MEANT):
            stops[{"home": "homing", "search": "a search"}.get(motion, "the stage"), event.reason] += 1
        elif isinstance(event, NoteEvent) and event.text.startswith((MACHINE, CAMERA)):
            slow = event.text if event.text.startswith((TOO_SLOW, TOO_FEW)) else ""
    texts = []
    for (what, reason), count in stops.most_common():
        often = "once" if count == 1 else f"{count} times"
        texts.append(f"{what} was stopped on the way {often}: {reason}")
    return (*texts, slow) if slow else tuple(texts)


def with_hindrances(estimate: SessionEstimate, events: Sequence[Event]) -> SessionEstimate:
    """The estimate; one without a registration says first what kept the session from taking pairs, if anything did.

    Without a single pair that is the cause, and "take more pairs" would be no advice.
    """
    if not estimate.epochs or estimate.epochs[-1].trus_T_camera is not None:
        return estimate
    causes = hindrances(events)
    if not causes:
        return estimate
    none = not any(isinstance(event, PairEvent) for event in events)
    rest = [reason for reason in estimate.reasons if not (none and "at least " in reason and "aim" not in reason)]
    return replace(estimate, reasons=(*causes, *rest))
