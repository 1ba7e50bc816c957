"""Which words a peer of the network may say. The protocols have no passwords: what lets the stage move needs a key.

``stop`` counts from anyone, signed or not. Without a key a peer may say the words of its configuration that do not let
the stage move. With a key every word but ``stop`` has to be signed (fgreg.drivers.word_keys).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fgreg.drivers.base import CommandKind, OperatorCommand, RefusedWord
from fgreg.drivers.operator_words import MOST_AGE_S, MOTIONS, understand
from fgreg.drivers.word_keys import read_key, signed_word, why_not
from fgreg.schema.problems import FieldError

if TYPE_CHECKING:
    from fgreg.drivers.options import IgtlOperatorOptions


class PeerWords:
    """The words of one operator of a configuration; for one thread.

    Args:
        words: what it may say beside ``stop``; None for all.
        key: that its words are signed with; None for no key.
        corners: columns and rows of the board's inner corners.
        began_s: words signed before this time (s since 1970) are refused (``word_keys.why_not``).
    """

    def __init__(
        self,
        words: Sequence[CommandKind] | None = None,
        key: bytes | None = None,
        corners: tuple[int, int] | None = None,
        began_s: float = 0.0,
    ) -> None:
        self._words = frozenset(CommandKind) if words is None else frozenset(words)
        self._key, self._corners, self._counter, self._began_s = key, corners, -1, began_s

    @classmethod
    def of(cls, words: Sequence[str] | None, key: Path | None, corners: tuple[int, int] | None) -> PeerWords:
        """As a configuration has them. Raises InputError for a key that cannot be used."""
        kinds = None if words is None else [CommandKind(word) for word in words]
        return cls(kinds, None if key is None else read_key(key), corners, time.time() + MOST_AGE_S)

    def take(self, line: str, peer: str, arrived_s: float, now_s: float) -> OperatorCommand | RefusedWord | str:
        """A line as a command, as one that is refused, or what to answer where it is not understood.

        Args:
            line: as it was sent.
            peer: who sent it.
            arrived_s: host time at which it arrived.
            now_s: seconds since 1970.
        """
        signed = signed_word(line)
        command = understand(line if signed is None else signed.word, self._corners)
        if isinstance(command, str):
            return command
        command = replace(command, said_s=arrived_s, peer=peer)
        if command.kind is CommandKind.STOP:
            return command
        why = ""
        if command.kind not in self._words:
            why = "it is not among the words of this operator in the configuration"
        elif self._key is None:
            if command.kind in MOTIONS:
                why = "only the keyboard may say it, or a peer with a key (operator.key in the configuration)"
        elif signed is None:
            why = "it is not signed"
        else:
            why = why_not(signed, self._key, self._counter, now_s, self._began_s)
            if not why:
                self._counter = signed.counter
                command = replace(command, said_s=arrived_s - max(0.0, now_s - signed.time_s))
        return RefusedWord(command.kind, peer, why) if why else command


def check_operator(options: IgtlOperatorOptions) -> None:
    """Raises FieldError, InputError: as :func:`check_words`."""
    check_words(options.words, options.key)


def check_words(words: Sequence[str] | None, key: Path | None) -> None:
    """Raises FieldError for words that need a key where there is none, InputError for a key that cannot be used."""
    if key is not None:
        read_key(key)
        return
    needy = [word for word in words or () if word in MOTIONS]
    if needy:
        raise FieldError.of(f"{needy[0]} without a key", "a key beside it, or words that need none", "words")
