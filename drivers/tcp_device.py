"""What all devices at the end of a TcpLink have in common: address, losses, counts."""

from __future__ import annotations

from typing import Generic

from fgreg.drivers.base import DeviceLost
from fgreg.drivers.tcp_link import Endpoint, Item, TcpLink


class LinkedDevice(Generic[Item]):
    """A device that is a link; its roles add ``poll`` or ``send``."""

    _role = ""

    def __init__(self, link: TcpLink[Item]) -> None:
        self._link = link

    @property
    def name(self) -> str:
        """Its address."""
        return str(self._link.endpoint)

    @property
    def endpoint(self) -> Endpoint:
        """Its address, with the port that was taken."""
        return self._link.endpoint

    @property
    def connected(self) -> bool:
        """Whether anybody is at the other end, and not silent."""
        return self._link.connected

    @property
    def dropped(self) -> int:
        """Messages dropped because nobody fetched or took them in time."""
        return self._link.dropped

    @property
    def rejected(self) -> int:
        """Messages left out: cut off, wrong checksum, broken content, not usable in this role."""
        return self._link.rejections.count

    @property
    def last_rejection(self) -> str:
        """Why the last one was left out."""
        return self._link.rejections.last

    def close(self) -> None:
        """End the connection."""
        self._link.close()

    def _messages(self) -> list[Item]:
        """What came; a loss is raised once what came before it is fetched."""
        messages = self._link.poll()
        if not messages:
            self._raise_loss()
        return messages

    def _raise_loss(self) -> None:
        loss = self._link.take_loss()
        if loss is not None:
            raise DeviceLost(f"{self._role}: {loss}")
