"""The operator's commands in words, for the keyboard and the network."""

from __future__ import annotations

import re

from fgreg.drivers.base import CommandKind, OperatorCommand
from fgreg.errors import one_line

LETTERS = {
    "h": CommandKind.HOME,
    "a": CommandKind.AIM,
    "r": CommandKind.REGISTER,
    "s": CommandKind.SEARCH,
    "f": CommandKind.FOLLOW,
    "n": CommandKind.NEXT,
    "m": CommandKind.MOVED,
    "c": CommandKind.CHECK,
    "x": CommandKind.STOP,
}
"""One-letter commands. ``s`` is search; an empty line and ``x`` stop. ``reset`` has no letter: a typing error must not
release a stage that has latched."""

EXPECTED = (
    "home (h), aim COLUMN ROW (a), register (r), search (s), follow (f), next (n), moved (m), "
    "check U V U V X RANGE (c), stop (x, or an empty line), reset"
)
LARGEST_CORNER = 199
"""Largest corner index of a board in session.yaml."""

_WORDS: dict[str, CommandKind] = {**{said.value: said for said in CommandKind}, **LETTERS}
_NUMBER = re.compile(r"[0-9]{1,3}")
_DECIMAL = re.compile(r"-?[0-9]{1,4}(\.[0-9]{1,6})?")
_STOP = re.compile(r"\bstop\b")


def understand(line: str, corners: tuple[int, int] | None = None) -> OperatorCommand | str:
    """Parse a line into a command; returns a message with what was expected if that fails.

    A line with the word ``stop`` anywhere is a stop, and so is an empty line: stopping needs no correct spelling.

    Args:
        line: as typed; case does not matter.
        corners: columns and rows of the board's inner corners, to check an aim against; None for no check.
    """
    words = line.lower().replace(",", " ").split()
    if not words or _STOP.search(line.lower()):
        return OperatorCommand(CommandKind.STOP)
    said = _WORDS.get(words[0])
    if said is None:
        return f"{one_line(repr(line.strip()), 40)} is not understood; say {EXPECTED}"
    if said is CommandKind.AIM:
        return _aim(words[1:], corners)
    if said is CommandKind.CHECK:
        return _check(words[1:])
    if len(words) > 1:
        return f"{one_line(repr(line.strip()), 40)} is not understood; {said} takes nothing after it"
    return OperatorCommand(said)


def _aim(words: list[str], corners: tuple[int, int] | None) -> OperatorCommand | str:
    expected = "aim COLUMN ROW: the inner corner of the board that the beam is on"
    if len(words) != 2 or not all(_NUMBER.fullmatch(word) for word in words):
        return f"an aim is said as {expected}, counted from 0"
    column, row = int(words[0]), int(words[1])
    columns, rows = corners or (LARGEST_CORNER + 1, LARGEST_CORNER + 1)
    if not (column < columns and row < rows):
        return f"there is no corner {column} {row}: expected columns 0 to {columns - 1}, rows 0 to {rows - 1}"
    return OperatorCommand(CommandKind.AIM, (column, row))


def _check(words: list[str]) -> OperatorCommand | str:
    if len(words) != 6 or not all(_DECIMAL.fullmatch(word) for word in words):
        return (
            "a check is said as check U V U V X RANGE: a point's pixel in the left and in the right frame, and its x "
            "and range (mm) in the image plane, turned to where it is brightest"
        )
    u, v, right_u, right_v, x_mm, range_mm = (float(word) for word in words)
    return OperatorCommand(CommandKind.CHECK, point=(u, v, right_u, right_v, x_mm, range_mm))


def asked(text: str, wants: CommandKind | None) -> str:
    """A message to the operator as one line, with the command that is asked for."""
    if wants is None:
        return one_line(text)
    letter = next((f" ({letter})" for letter, said in LETTERS.items() if said is wants), "")
    return f"{one_line(text)}: say {wants}{letter}"
