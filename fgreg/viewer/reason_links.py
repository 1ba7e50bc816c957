"""Links from a reason of the verdict to what it is about: shots with their times, or the worst target.

A reason is a sentence, which names its shots by PM, by time, by being left out, or by their NIS. One that names none is
about all looks of its camera epoch; one about check points has no link, since they are no shots. A viewer can go to an
entity by a link, not to a time: the link's words have that.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from fgreg.model.estimate import AimEstimate, PairEstimate, SessionEstimate
from fgreg.viewer.scene import Shot, shots_of

MOST = 6
"""Shots that are listed; the worst ones where there are more."""
WORST_TARGET = "world/targets/worst"
_EPOCH = re.compile(r"^epoch (\d+): ")
_PM = re.compile(r"\bPM (\d+)(?: to (\d+)|((?:, \d+)+))?")
_AT = re.compile(r"\bat (\d+(?:\.\d+)?) s\b")
_LEFT_OUT = re.compile(r"\b(aims?|pairs?)\b.*?(?:are left out|could not be used)")
_CHECKS = re.compile(r"\bthe checks? (?:at|is|are|to)\b|\bat the checks?\b")
_NIS = re.compile(r"\bnis (\d+(?:\.\d+)?)(?: to (\d+(?:\.\d+)?))?")


@dataclass(frozen=True, slots=True)
class _Facts:
    """A shot with what a sentence can name it by."""

    shot: Shot
    epoch: int | None
    pm: int | None
    used: bool
    nis: float | None


def entity_of(shot: Shot) -> str:
    """The entity that a link to a shot selects: its look in the scene, or its line in the log."""
    return f"world/looks/{shot.number}" if shot.kind == "pair" else f"log/{shot.number}"


def linked(reason: str, estimate: SessionEstimate) -> str:
    """A reason as Markdown, with its links behind it."""
    links = []
    if "worst target" in reason and estimate.epochs and any(epoch.predicted_tre for epoch in estimate.epochs):
        links.append(f"[worst target](recording://{WORST_TARGET})")
    found, named = _about(reason, _facts(estimate))
    if not named and links:
        found = []
    if found and not named:
        links.append(_link(found[0], "from "))
        if len(found) > 1:
            links[-1] += " " + _link(found[-1], "to ")
    elif found:
        listed = sorted(found, key=lambda facts: -(facts.nis or 0.0))[:MOST]
        links += [_link(facts) for facts in sorted(listed, key=lambda facts: facts.shot.number)]
        if len(found) > MOST:
            links.append(f"and {len(found) - MOST} more")
    return f"{reason} → {', '.join(links)}" if links else reason


def _link(facts: _Facts, before: str = "") -> str:
    shot = facts.shot
    what = shot.kind if facts.pm is None else f"PM {facts.pm}"
    return f"[{before}shot {shot.number} ({what}, {shot.t:.1f} s)](recording://{entity_of(shot)})"


def _facts(estimate: SessionEstimate) -> list[_Facts]:
    out = []
    for shot in shots_of(estimate):
        if shot.kind == "track":
            continue
        one: PairEstimate | AimEstimate
        one = estimate.pairs[shot.position] if shot.kind == "pair" else estimate.aims[shot.position]
        nis = one.nis if one.nis is not None and math.isfinite(one.nis) else None
        epoch, pm = (one.epoch, one.pm) if isinstance(one, PairEstimate) else (None, None)
        out.append(_Facts(shot, epoch, pm, one.used, nis))
    return out


def _about(reason: str, shots: list[_Facts]) -> tuple[list[_Facts], bool]:
    """The shots that a reason is about, and whether it names them."""
    if epoch := _EPOCH.match(reason):
        shots = [s for s in shots if s.epoch == int(epoch[1])]
        reason = reason[epoch.end() :]
    if _CHECKS.search(reason):
        return [], True
    times = [float(found[1]) for found in _AT.finditer(reason)]
    if at := [s for s in shots if any(abs(s.shot.t - t) <= 0.051 for t in times)]:
        return at, True
    if out := _LEFT_OUT.search(reason):
        kind = out[1].removesuffix("s")
        if left := [s for s in shots if s.shot.kind == kind and not s.used]:
            return left, True
    pms: set[int] = set()
    for found in _PM.finditer(reason):
        first, last, more = found.groups()
        pms |= set(range(int(first), int(last or first) + 1))
        pms |= {int(pm) for pm in (more or "").split(",") if pm.strip()}
    if by_pm := [s for s in shots if s.pm in pms]:
        return by_pm, True
    if nis := _NIS.search(reason):
        low, high = float(nis[1]) - 0.5, float(nis[2] or nis[1]) + 0.5
        if mild := [s for s in shots if s.nis is not None and low <= s.nis <= high]:
            return mild, True
    return [s for s in shots if s.shot.kind == "pair"] or shots, False
