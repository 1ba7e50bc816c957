"""Base of all devices on a TcpLink: address, losses, counts."""

from __future__ import annotations

from typing import Generic

from fgreg.drivers.base import DeviceLost
from fgreg.drivers.stream_decoder import Item
from fgreg.drivers.tcp_link import Endpoint, TcpLink


class LinkedDevice(Generic[Item]):
    """A device on a TcpLink; subclasses add ``poll`` or ``send``."""

    _role = ""

    def __init__(self, link: TcpLink[Item]) -> None:
        self._link = link

    @property
    def name(self) -> str:
        """Its address."""
        return str(self._link.endpoint)

    @property
    def endpoint(self) -> Endpoint:
        """Its address, with the actual port."""
        return self._link.endpoint

    @property
    def connected(self) -> bool:
        """Whether the other end is connected and not silent."""
        return self._link.connected

    @property
    def dropped(self) -> int:
        """Number of messages dropped because they were not fetched or taken in time."""
        return self._link.dropped

    @property
    def rejected(self) -> int:
        """Number of messages left out: cut off, wrong checksum, invalid content, not usable in this role."""
        return self._link.rejections.count

    @property
    def last_rejection(self) -> str:
        """Why the last one was left out."""
        return self._link.rejections.last

    def close(self) -> None:
        """End the connection."""
        self._link.close()

    def _messages(self) -> list[Item]:
        """New messages; a loss is raised once the messages before it have been fetched."""
        messages = self._link.poll()
        if not messages:
            self._raise_loss()
        return messages

    def _raise_loss(self) -> None:
        loss = self._link.take_loss()
        if loss is not None:
            raise DeviceLost(f"{self._role}: {loss}")
