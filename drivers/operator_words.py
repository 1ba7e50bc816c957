"""The operator's commands in words, for the keyboard and the network."""

from __future__ import annotations

import re
from collections.abc import Sequence

from fgreg.drivers.base import CommandKind, OperatorCommand, RefusedWord
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
    "p": CommandKind.POINT,
    "v": CommandKind.VERIFY,
    "e": CommandKind.EXCLUDE,
    "i": CommandKind.INCLUDE,
    "x": CommandKind.STOP,
}
"""One-letter commands. ``s`` is search; an empty line and ``x`` stop. ``reset`` has no letter: a typing error must not
release a stage that has latched."""

AFTER = {
    CommandKind.AIM: "COLUMN ROW",
    CommandKind.CHECK: "U V U V X RANGE",
    CommandKind.POINT: "U V U V X RANGE",
    CommandKind.EXCLUDE: "PM",
    CommandKind.INCLUDE: "PM",
}
"""What follows a word."""


def spelt(kind: CommandKind) -> str:
    """A word as it is said, with its letter: ``search (s)``, ``aim COLUMN ROW (a)``."""
    letter = next((letter for letter, said in LETTERS.items() if said is kind), "")
    after = f" {AFTER[kind]}" if kind in AFTER else ""
    if kind is CommandKind.STOP:
        letter += ", or an empty line"
    return f"{kind}{after}" + (f" ({letter})" if letter else "")


EXPECTED = ", ".join(spelt(kind) for kind in CommandKind)
MOTIONS = frozenset({CommandKind.HOME, CommandKind.SEARCH, CommandKind.FOLLOW, CommandKind.RESET})
"""Words after which the stage may move. A stop cancels those before it; a peer of the network needs a key for them."""
MOST_AGE_S = 0.5
"""A word that is older has no effect, as an order to the stage that is older. A stop has no limit."""
LARGEST_CORNER = 199
"""Largest corner index of a board in session.yaml."""

_WORDS: dict[str, CommandKind] = {**{said.value: said for said in CommandKind}, **LETTERS}
_NUMBER = re.compile(r"[0-9]{1,3}")
_DECIMAL = re.compile(r"-?[0-9]{1,4}(\.[0-9]{1,6})?")
_PM = re.compile(r"[0-9]{1,9}")
_EFFECT = {CommandKind.EXCLUDE: "no longer count", CommandKind.INCLUDE: "count again"}
CANCELLED = "a stop came after it: say it again"


def understand(line: str, corners: tuple[int, int] | None = None) -> OperatorCommand | str:
    """Parse a line into a command; returns a message with what was expected if that fails.

    A line with ``stop`` anywhere, also inside another word, is a stop, and so is an empty line: stopping needs no
    correct spelling.

    Args:
        line: as typed; case does not matter.
        corners: columns and rows of the board's inner corners, to check an aim against; None for no check.
    """
    words = line.lower().replace(",", " ").split()
    if not words or str(CommandKind.STOP) in line.lower():
        return OperatorCommand(CommandKind.STOP)
    said = _WORDS.get(words[0])
    if said is None:
        return f"{one_line(repr(line.strip()), 40)} is not understood; say {EXPECTED}"
    if said is CommandKind.AIM:
        return _aim(words[1:], corners)
    if said in (CommandKind.CHECK, CommandKind.POINT):
        return _located(said, words[1:])
    if said in (CommandKind.EXCLUDE, CommandKind.INCLUDE):
        return _choice(said, words[1:])
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


def _located(said: CommandKind, words: list[str]) -> OperatorCommand | str:
    if len(words) != 6 or not all(_DECIMAL.fullmatch(word) for word in words):
        return (
            f"a {said} is said as {said} U V U V X RANGE: a point's pixel in the left and in the right frame, and its "
            "x and range (mm) in the image plane, turned to where it is brightest"
        )
    u, v, right_u, right_v, x_mm, range_mm = (float(word) for word in words)
    return OperatorCommand(said, point=(u, v, right_u, right_v, x_mm, range_mm))


def _choice(said: CommandKind, words: list[str]) -> OperatorCommand | str:
    if len(words) != 1 or not _PM.fullmatch(words[0]):
        return f"it is said as {said} PM: the number of a PM whose looks {_EFFECT[said]}"
    return OperatorCommand(said, pm=int(words[0]))


def asked(text: str, wants: CommandKind | None) -> str:
    """A message to the operator as one line, with the command that is asked for."""
    return one_line(text) if wants is None else f"{one_line(text)}: say {spelt(wants)}"


def in_force(
    said: Sequence[OperatorCommand | RefusedWord], now_s: float, stopped_s: float = float("-inf")
) -> tuple[list[OperatorCommand], list[RefusedWord]]:
    """The words that count now, with a stop first, and those that are refused.

    Refused are words older than :data:`MOST_AGE_S`, and those that let the stage move if a stop came after them: one of
    these, or one before at ``stopped_s``.
    """
    commands = [word for word in said if isinstance(word, OperatorCommand)]
    refused = [word for word in said if isinstance(word, RefusedWord)]
    stops = [command for command in commands if command.kind is CommandKind.STOP]
    stopped_s = max([stopped_s, *(stop.said_s for stop in stops)])
    kept = stops[-1:]
    for command in commands:
        if command.kind is CommandKind.STOP:
            continue
        age_s = now_s - command.said_s
        if command.kind in MOTIONS and command.said_s < stopped_s:
            refused.append(RefusedWord(command.kind, command.peer, CANCELLED))
        elif age_s > MOST_AGE_S:
            why = f"it is {age_s:.1f} s old, and {MOST_AGE_S:g} s is the limit: say it again"
            refused.append(RefusedWord(command.kind, command.peer, why))
        else:
            kept.append(command)
    return kept, refused
