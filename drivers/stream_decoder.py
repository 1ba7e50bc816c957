"""Base of the decoders of byte streams: bytes of one connection to messages, with a count of what is left out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from fgreg.errors import one_line


class StreamBroken(Exception):  # noqa: N818
    """The stream cannot be decoded any further, and the connection has to be closed. The text says why."""


class Sized(Protocol):
    """An object that knows the memory it holds."""

    @property
    def nbytes(self) -> int:
        """Bytes held."""


Item = TypeVar("Item", bound=Sized)


@dataclass(slots=True)
class Rejections:
    """Count of the messages left out, and the reason of the last one.

    Attributes:
        peer: the sender; empty for all of a link.
        link: those of the whole link, which are counted there, too, with the peer's name.
    """

    count: int = 0
    last: str = ""
    peer: str = ""
    link: Rejections | None = None

    def add(self, reason: str) -> None:
        """Count one more."""
        self.count += 1
        self.last = one_line(f"{self.peer}: {reason}" if self.peer else reason, 200)
        if self.link is not None:
            self.link.add(self.last)


class Decoder(ABC, Generic[Item]):
    """Bytes of one connection to messages.

    Args:
        rejections: counts the messages that are left out.

    Attributes:
        completed: number of messages that have ended up to now, whatever became of them.
        instead: what the peer sends that is not taken, as the end of a sentence; empty if nothing is.
        replies: to be sent back to this peer; emptied by who sends them.
    """

    def __init__(self, rejections: Rejections) -> None:
        self.rejections = rejections
        self.completed = 0
        self.instead = ""
        self.replies: list[bytes] = []

    @property
    @abstractmethod
    def partial(self) -> bool:
        """Whether a message has begun and is not complete."""

    @abstractmethod
    def feed(self, data: bytes, host_s: float) -> list[Item]:
        """Messages completed by ``data``, which arrived at ``host_s``. Raises StreamBroken."""
