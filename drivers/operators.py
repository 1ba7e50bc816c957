"""Operators besides the keyboard: texts over OpenIGTLink, and several operators combined."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from fgreg.drivers.base import CommandKind, DeviceLost, Operator, OperatorCommand, RefusedWord
from fgreg.drivers.igtl import endpoint
from fgreg.drivers.igtl_contents import Text
from fgreg.drivers.igtl_decoder import MessageDecoder
from fgreg.drivers.igtl_messages import Message, check_name, pack_text, require_pyigtl
from fgreg.drivers.operator_words import asked
from fgreg.drivers.peer_words import PeerWords
from fgreg.drivers.stream_decoder import Rejections
from fgreg.drivers.tcp_device import LinkedDevice
from fgreg.drivers.tcp_link import Endpoint, TcpLink
from fgreg.drivers.word_queue import WordQueue

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext
    from fgreg.drivers.options import IgtlOperatorOptions


CHUNK_BYTES = 2048
"""Bytes of a peer's words that are taken in before another's turn: a stop does not wait for a burst of others."""


class _WordDecoder(MessageDecoder):
    """Hands over each message of a connection in the link's thread, before any queue."""

    def __init__(
        self,
        rejections: Rejections,
        wanted: frozenset[tuple[str, str]],
        counts: Counter[tuple[str, str]],
        take: Callable[[Message], None],
    ) -> None:
        super().__init__(rejections, wanted, counts)
        self._take = take

    def feed(self, data: bytes, host_s: float) -> list[Message]:
        """As of the base. Raises StreamBroken."""
        messages = super().feed(data, host_s)
        for message in messages:
            self._take(message)
        return messages


class IgtlOperator(LinkedDevice[Message]):
    """An Operator whose commands are STRING messages of a device: a foot switch, a button in 3D Slicer.

    Messages to the operator, and replies to commands that are not understood or refused, go back as STRING messages;
    for a slow receiver only the newest is kept. Words go past the link's queue into one in which a stop has a place of
    its own.

    Args:
        endpoint: the sender, or where it connects.
        device: name of the device that sends commands.
        answers: name of the device for messages to the operator.
        words: what it may say.
    """

    _role = "operator"

    def __init__(
        self,
        endpoint: Endpoint,
        device: str = "Operator",
        answers: str = "OperatorTold",
        words: PeerWords | None = None,
    ) -> None:
        require_pyigtl()
        wanted, counts = frozenset([("STRING", check_name(device))]), Counter[tuple[str, str]]()
        self._answers, self._words, self._queue = check_name(answers), words or PeerWords(), WordQueue()

        def decoder(rejections: Rejections) -> _WordDecoder:
            return _WordDecoder(rejections, wanted, counts, self._take)

        super().__init__(TcpLink(endpoint, decoder, chunk_bytes=CHUNK_BYTES))

    @property
    def dropped(self) -> int:
        """Number of words dropped because they were not fetched in time."""
        return self._queue.dropped

    def poll(self) -> list[OperatorCommand | RefusedWord]:
        """Words since the last call. Raises DeviceLost, after the words that came before the loss."""
        words = self._queue.take()
        self._link.poll()  # the same messages: the queue has their words
        if not words:
            self._raise_loss()
        return words

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:  # noqa: ARG002
        """Send a message."""
        self._offer(asked(text, wants))

    def _take(self, message: Message) -> None:
        """A message, in the link's thread."""
        if not isinstance(message.content, Text):
            return
        word = self._words.take(message.content.text, message.device, message.host_s, time.time())
        if isinstance(word, str):
            self._link.rejections.add(f"{message.peer}: {message.device}: {word}")
            self._offer(word)
            return
        if isinstance(word, RefusedWord):
            self._offer(word.text)
        self._queue.put(word)

    def _offer(self, text: str) -> None:
        self._link.offer(pack_text(self._answers, text, time.time(), {}, 2))


class Operators:
    """Several operators combined: commands come from any of them, messages go to all."""

    def __init__(self, operators: Sequence[Operator]) -> None:
        self._operators = tuple(operators)
        self._losses: list[DeviceLost] = []
        self._held: list[OperatorCommand | RefusedWord] = []

    @property
    def name(self) -> str:
        """Their names."""
        return " and ".join(operator.name for operator in self._operators)

    @property
    def connected(self) -> bool:
        """Whether all are there."""
        return all(operator.connected for operator in self._operators)

    @property
    def dropped(self) -> int:
        """Number of commands that were not fetched in time."""
        return sum(operator.dropped for operator in self._operators)

    @property
    def rejected(self) -> int:
        """Number of messages that were left out."""
        return sum(getattr(operator, "rejected", 0) for operator in self._operators)

    @property
    def last_rejection(self) -> str:
        """Why the last one of each was left out."""
        return "; ".join(filter(None, (getattr(operator, "last_rejection", "") for operator in self._operators)))

    def poll(self) -> list[OperatorCommand | RefusedWord]:
        """Commands of all operators since the last call; none is dropped when a loss is raised.

        Raises:
            DeviceLost: one of them is lost; once for each loss.
        """
        for operator in self._operators:
            try:
                self._held += operator.poll()
            except DeviceLost as error:
                self._losses.append(error)
        if self._held:  # commands first: a stop must not wait for a loss to be raised
            commands, self._held = self._held, []
            return commands
        if self._losses:
            raise self._losses.pop(0)
        return []

    def tell(self, text: str, *, done: bool = False, wants: CommandKind | None = None) -> None:
        """Send a message to all operators."""
        for operator in self._operators:
            operator.tell(text, done=done, wants=wants)

    def close(self) -> None:
        """Close all operators."""
        for operator in self._operators:
            operator.close()


def open_operator(context: DriverContext, options: IgtlOperatorOptions) -> Operator:
    """Texts over OpenIGTLink. Raises InputError for a key that cannot be used."""
    words = PeerWords.of(options.words, options.key, context.corners)
    return IgtlOperator(endpoint(options), options.device, options.answers, words)
