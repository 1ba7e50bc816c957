"""The overlay over ROS 2: an image topic, stamped with the time of the exposure."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import cv2

from fgreg.drivers import ros2_messages as ros
from fgreg.drivers.base import DeviceLost, OverlayPicture, host_now
from fgreg.drivers.ros2 import image_kind
from fgreg.drivers.ros2_transport import open_transport

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext, PictureSink
    from fgreg.drivers.options import Ros2OverlayOptions


class Ros2PictureSink:
    """PictureSink: JPEG where the topic ends in ``/compressed``, else ``bgr8``; nothing while no one listens."""

    def __init__(self, options: Ros2OverlayOptions) -> None:
        self._options, self._kind = options, image_kind(options.topic)
        self._transport = open_transport(options, ros.hash_of)
        self._send = self._transport.publisher(options.topic, self._kind)
        self._heard = False
        self.name = options.topic

    @property
    def connected(self) -> bool:
        """Whether someone listens."""
        return self._transport.subscribers(self.name) > 0

    @property
    def dropped(self) -> int:
        """0: what a receiver does not take is dropped on its way, and not counted."""
        return 0

    def send(self, picture: OverlayPicture) -> None:
        """Publish a picture. Raises DeviceLost once all receivers are gone."""
        was, self._heard = self._heard, self.connected
        if was and not self._heard:
            raise DeviceLost(f"overlay: {self.name}: no one listens any more")
        if not self._heard:
            return
        header = ros.header(max(time.time() - (host_now() - picture.stamp.host_s), 0.0), self._options.frame)
        if self._kind == ros.COMPRESSED:
            done, data = cv2.imencode(".jpg", picture.image, [cv2.IMWRITE_JPEG_QUALITY, self._options.quality])
            if done:
                self._send(
                    ros.encode(ros.make(self._kind, header=header, format="bgr8; jpeg compressed bgr8", data=data))
                )
            return
        height, width = picture.image.shape[:2]
        data = picture.image.reshape(-1)
        fields = {"height": height, "width": width, "encoding": "bgr8", "is_bigendian": 0, "step": 3 * width}
        self._send(ros.encode(ros.make(self._kind, header=header, data=data, **fields)))

    def close(self) -> None:
        """End the connection."""
        self._transport.close()


def open_overlay(_context: DriverContext, options: Ros2OverlayOptions) -> PictureSink:
    """Receivers of the overlay over ROS 2."""
    return Ros2PictureSink(options)
