"""What the operator has said: the words in force, and those that were refused."""

from __future__ import annotations

import math
from collections.abc import Sequence

from fgreg.drivers.base import CommandKind, OperatorCommand, RefusedWord
from fgreg.drivers.operator_words import in_force

NOTE_S = 1.0
"""Time between two notes of refused words: a peer that sends many fills neither the page nor the disk."""


class HeardWords:
    """Words on their way from the operator to the workflow.

    Attributes:
        last: the last word in force, and who said it; empty if there was none.
        refused: the last refused one, with the reason.
    """

    def __init__(self) -> None:
        self._waiting: list[OperatorCommand | RefusedWord] = []
        self._noted_s, self._more, self._unnoted = -math.inf, 0, ""
        self._stopped_s = -math.inf
        self.last, self.refused = "", ""

    def add(self, words: Sequence[OperatorCommand | RefusedWord]) -> None:
        """Take in what a driver gave."""
        self._waiting += words

    def take(self, now_s: float) -> tuple[OperatorCommand, ...]:
        """The words in force now (host time), a stop first."""
        kept, refused = in_force(self._waiting, now_s, self._stopped_s)
        self._waiting = []
        for command in kept:
            if command.kind is CommandKind.STOP:  # a word that was said before it may still be on its way
                self._stopped_s = max(self._stopped_s, command.said_s)
            self.refused = ""
            self.last = f"{command.kind} from {command.peer or 'the operator'}"
        for word in refused:
            self.refused = self._unnoted = word.text
        self._more += len(refused)
        return tuple(kept)

    def news(self, now_s: float) -> str:
        """What is to be told and noted of refused words; empty if nothing is, or it is too soon."""
        if not self._unnoted or now_s - self._noted_s < NOTE_S:
            return ""
        text, more = self._unnoted, self._more - 1
        self._noted_s, self._unnoted, self._more = now_s, "", 0
        return text + (f" (and {more} words more)" if more else "")
