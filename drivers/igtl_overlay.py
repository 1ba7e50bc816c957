"""The overlay over OpenIGTLink: IMAGE messages, RGB, first row first, one per frame; GET_IMAGE and STT_IMAGE answered.

Their time stamp is that of the exposure, so that a receiver on this machine can tell the latency.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import cv2

from fgreg.drivers.base import OverlayPicture, host_now
from fgreg.drivers.igtl import IgtlDevice, endpoint
from fgreg.drivers.igtl_decoder import Offers
from fgreg.drivers.igtl_messages import check_name, check_version, pack_image
from fgreg.drivers.tcp_link import Endpoint

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext, PictureSink
    from fgreg.drivers.options import IgtlOverlayOptions


class IgtlPictureSink(IgtlDevice):
    """PictureSink: for a slow receiver only the newest picture is kept.

    Args:
        endpoint: ``Endpoint.listening(18946)`` for receivers that connect (several may), or a receiver's address.
        device: name of the images.
        header_version: as of IgtlTransformSink.
    """

    _role = "overlay"

    def __init__(self, endpoint: Endpoint, device: str = "Overlay", header_version: int = 2) -> None:
        self._device, self._version = check_name(device), check_version(header_version)
        self._offers = Offers({"IMAGE": (device,)}, why="there is no new picture")
        super().__init__(endpoint, offers=self._offers)

    def send(self, picture: OverlayPicture) -> None:
        """Send a picture. Raises DeviceLost."""
        sent_s = max(time.time() - (host_now() - picture.stamp.host_s), 0.0)
        message = pack_image(self._device, cv2.cvtColor(picture.image, cv2.COLOR_BGR2RGB)[None], sent_s, self._version)
        self._offers.offer({("IMAGE", self._device): message})
        self._link.offer(
            message, latest=b""
        )  # a later receiver waits for the next: this one's lines may be refused then
        self._raise_loss()


def open_overlay(_context: DriverContext, options: IgtlOverlayOptions) -> PictureSink:
    """Receiver of the overlay over OpenIGTLink."""
    return IgtlPictureSink(endpoint(options), options.device, options.header_version)
