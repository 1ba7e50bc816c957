"""What a verdict permits, what to do next, and how figures are written."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Sequence

from fgreg.model.estimate import SessionEstimate, Verdict

ANSWER = {Verdict.OK: "Yes", Verdict.WARNING: "Look first", Verdict.REFUSED: "No"}
"""To: may the probe be turned by this registration?"""
PERMITS = {
    Verdict.OK: "The registration may be used: turn the probe to the angles of this report.",
    Verdict.WARNING: "The registration may be used only after each reason below has been looked at. Who is responsible "
    "for the procedure decides.",
    Verdict.REFUSED: "Do not turn the probe. No angle and no transform of this report may be used.",
}
SIGNS = {Verdict.OK: "\u2713", Verdict.WARNING: "!", Verdict.REFUSED: "\u2715"}
NOTHING = "\u2013"
RESEARCH = (
    "For research use only. fgreg is not a medical device, and this report is not a basis for treating a patient. "
    "Predicted errors hold as far as the assumptions in section 2 do."
)


def number(value: float | None, decimals: int = 2) -> str:
    """A figure for a table: a dash where there is none, a word where it is not finite."""
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "no bound"
    text = f"{value:.{decimals}f}"
    return text.replace("-", "", 1) if float(text) == 0.0 else text


def degrees(value_rad: float | None, decimals: int = 1) -> str:
    """An angle in degrees, without its unit."""
    return number(None if value_rad is None else math.degrees(value_rad), decimals)


def percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def vector(values: Sequence[float], decimals: int = 2) -> str:
    return "(" + ", ".join(number(float(value), decimals) for value in values) + ")"


def next_steps(estimate: SessionEstimate, session: str) -> Iterator[str]:
    """What to do next, in order, as plain sentences."""
    if estimate.verdict is Verdict.REFUSED:
        yield "Do what each reason at the top says, take the shots again, and solve the session again."
    elif estimate.reasons:
        yield "Look at each reason at the top, and decide whether it matters here; mend it where it does."
    unused = sorted({pair.pm for pair in estimate.pairs if not pair.used})
    if unused:
        named = ", ".join(map(str, unused[:10])) + (" and others" if len(unused) > 10 else "")
        yield f"Look at the pairs that were not used (PM {named}, section 5) and at why."
    open_ones = sum(not assumption.checks for assumption in estimate.assumptions)
    if open_ones:
        what = "an assumption" if open_ones == 1 else f"{open_ones} assumptions"
        yield (
            f"No check covers {what} of section 2. Record at least three check points that both devices see (check "
            "events), at the depth of the targets, and solve again."
        )
    if any(track.stage_rad is None for track in estimate.tracks):
        yield "Some tracking queries have no answer: section 4 says why."
    if estimate.verdict is not Verdict.REFUSED:
        yield (
            "Before the probe is turned, compare three to six new shots at other spots with this registration: "
            f"fgreg verify {shlex.quote(session)} NEW."
        )
        yield "Register again after every move of the endoscope that was not recorded, and of the marker on the fibre."
