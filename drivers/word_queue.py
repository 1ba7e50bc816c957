"""Words between a driver's thread and ``poll``: bounded, and a stop has a place of its own."""

from __future__ import annotations

import threading
from collections import deque

from fgreg.drivers.base import CommandKind, OperatorCommand, RefusedWord
from fgreg.drivers.operator_words import CANCELLED, MOTIONS

MOST_WAITING = 64


class WordQueue:
    """Words in the order in which they were said.

    Of stops only the last is kept, so nothing can fill its place. It cancels the words before it that let the stage
    move. Of other words the oldest are dropped and counted beyond :data:`MOST_WAITING`.
    """

    def __init__(self) -> None:
        self._words: deque[OperatorCommand | RefusedWord] = deque()
        self._lock = threading.Lock()
        self.dropped = 0

    def put(self, word: OperatorCommand | RefusedWord) -> None:
        """Add a word; from any thread."""
        with self._lock:
            if _is_stop(word):
                waiting = [_cancelled(before) for before in self._words if not _is_stop(before)]
                self._words = deque(waiting)
            self._words.append(word)
            if len(self._words) > MOST_WAITING + any(map(_is_stop, self._words)):
                self._words.remove(next(before for before in self._words if not _is_stop(before)))
                self.dropped += 1

    def take(self) -> list[OperatorCommand | RefusedWord]:
        """All of them since the last call."""
        with self._lock:
            words, self._words = self._words, deque()
        return list(words)


def _is_stop(word: OperatorCommand | RefusedWord) -> bool:
    return isinstance(word, OperatorCommand) and word.kind is CommandKind.STOP


def _cancelled(word: OperatorCommand | RefusedWord) -> OperatorCommand | RefusedWord:
    if isinstance(word, OperatorCommand) and word.kind in MOTIONS:
        return RefusedWord(word.kind, word.peer, CANCELLED)
    return word
