"""One ROS 2 topic as a stream of items: decoded in a thread of its own, so that neither ``poll`` nor the link waits.

Items are of the class of pictures, ``Grabbed``, whatever a message was read to: ``picture`` may be a pose or a text.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

from fgreg.drivers.base import DeviceLost, host_now
from fgreg.drivers.ros2_messages import decode, prepare
from fgreg.drivers.ros2_transport import Transport
from fgreg.drivers.ros_messages import stamp_ns
from fgreg.drivers.stream_decoder import Rejections
from fgreg.drivers.video_input import Grabbed
from fgreg.errors import one_line
from fgreg.model.time_sync import Stamp

STEP_BACK_S = 0.5
"""A stamp that is older than the one before it by more than this comes from a clock that was set; by less, from a
message that was overtaken, which is left out."""
LEFT_S = 0.1
"""A topic without publishers is lost after this time without a message: those under way still arrive."""


MOST_LOSSES = 8
"""Largest number of losses that wait to be raised."""


class Topic:
    """A subscription.

    Args:
        transport: the connection.
        topic, kind: what is subscribed to.
        read: what a message holds: items, each with a message that has its header. Raises ValueError for a message
            that cannot be used.
        silent_s: without a message for this long it counts as lost; None: only once all of its publishers are gone.
        room: messages that the link holds, or that wait to be decoded, and items that wait to be fetched, at most; the
            newest are kept.
        delay_s: from the event to the message's stamp; subtracted.
        latched: whether the topic keeps its last message for later subscribers.
        at_once: read in the link's thread, so that no message waits for another; for small messages.
    """

    def __init__(
        self,
        transport: Transport,
        topic: str,
        kind: str,
        read: Callable[[Any], Iterable[tuple[Any, Any]]],
        silent_s: float | None,
        room: int = 256,
        delay_s: float = 0.0,
        latched: bool = False,
        at_once: bool = False,
    ) -> None:
        self.name, self._kind = topic, kind
        self._transport, self._read, self._silent_s, self._delay_s = transport, read, silent_s, delay_s
        self.rejections = Rejections()
        self._room, self._count, self._dropped, self._at_once = room, 0, 0, at_once
        self._raw: deque[tuple[bytes, str, float, int]] = deque()
        self._items: deque[Grabbed] = deque()
        self._state = threading.Condition()
        self._arrived_s = host_now()
        self._alive = self._reported = self._closed = self._counted = False
        self._losses: deque[str] = deque(maxlen=MOST_LOSSES)
        self._last_s = -float("inf")
        self.ended = False
        self._thread = threading.Thread(target=self._run, name=f"ROS 2 {topic}", daemon=True)
        prepare(kind)
        self._thread.start()
        transport.subscribe(topic, kind, self._take, latched, room)

    @property
    def connected(self) -> bool:
        """Whether messages come that can be used; of a topic that may be silent, whether someone publishes on it."""
        with self._state:
            return self._alive and self._gone() is None

    @property
    def dropped(self) -> int:
        """Number of messages that were not decoded or fetched in time."""
        return self._dropped

    def poll(self) -> list[Grabbed]:
        """Items since the last call, oldest first. Raises DeviceLost once for each loss."""
        with self._state:
            if self._losses:
                raise DeviceLost(self._losses.popleft())
            found = list(self._items)
            self._items.clear()
            if found:
                return found
            why = self._gone()
            if why is None or self._reported:
                return []
            self._alive, self._reported = False, True
        raise DeviceLost(why)

    def close(self) -> None:
        """End the thread; the connection is not this one's to end."""
        with self._state:
            self._closed, self._alive = True, False
            self._raw.clear()
            self._items.clear()
            self._state.notify()
        self._thread.join(2.0)

    def _gone(self) -> str | None:
        """Why the topic counts as lost; None if it does not."""
        silent = host_now() - self._arrived_s
        if self._alive and self._counted and silent > LEFT_S and not self._transport.publishers(self.name):
            return f"{self.name}: no one publishes on it any more"
        if self._silent_s is None or silent <= self._silent_s or (self._raw and self._alive):
            return None
        besides = f"; left out: {self.rejections.last}" if self.rejections.count else ""
        return f"{self.name}: no message for {self._silent_s:g} s{besides}"

    def _take(self, data: bytes, kind: str, host_s: float) -> None:
        """In the link's thread."""
        with self._state:
            self._count += 1
            if kind != self._kind:
                self.rejections.add(f"messages of {kind}, expected {self._kind}")
                return
            if not self._at_once:
                self._raw.append((data, kind, host_s, self._count))
                if len(self._raw) > self._room:
                    self._raw.popleft()
                    self._dropped += 1
                self._state.notify()
                return
            index = self._count
        self._decode(data, kind, host_s, index)

    def _run(self) -> None:
        while True:
            with self._state:
                while not self._raw and not self._closed:
                    self._state.wait()
                if self._closed:
                    return
                data, kind, host_s, index = self._raw.popleft()
            self._decode(data, kind, host_s, index)

    def _decode(self, data: bytes, kind: str, host_s: float, index: int) -> None:
        try:
            found = list(self._read(decode(data, kind)))
            items = [self._item(message, value, host_s, index) for message, value in found]
        except Exception as error:  # of a parser on foreign bytes; the next message may be good
            with self._state:
                self.rejections.add(one_line(str(error), 200))
            return
        with self._state:
            self._put(items)

    def _item(self, message: Any, value: Any, host_s: float, index: int) -> Grabbed:
        stated_ns = stamp_ns(message, 0)
        device_s = stated_ns / 1e9 - self._delay_s if stated_ns else host_s
        return Grabbed(Stamp(device_s, host_s), value, index)

    def _put(self, items: list[Grabbed]) -> None:
        for item in items:
            device_s = item.stamp.device_s
            if device_s < self._last_s - STEP_BACK_S:
                if self._alive:
                    self._losses.append(f"{self.name}: its clock went back by {self._last_s - device_s:.1f} s")
                self._dropped += len(self._items)
                self._items.clear()
            elif device_s < self._last_s:
                self.rejections.add("a message older than the one before it")
                continue
            self._last_s = device_s
            self._items.append(item)
            if len(self._items) > self._room:
                self._items.popleft()
                self._dropped += 1
            self._arrived_s = host_now()
            self._alive, self._reported = True, False
            self._counted = self._counted or self._transport.publishers(self.name) > 0
