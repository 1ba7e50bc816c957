"""OpenIGTLink devices in the roles of drivers.base: pulses and motion in, the registration out; transforms and texts.

PLUS and most scanners are servers: give their address as ``Endpoint("127.0.0.1", 18944)``. 3D Slicer can be either; for
a client there is ``Endpoint.listening(18944)``, on loopback unless another address is given. Messages come with the
sender's time stamp, which becomes ``Stamp.device_s``; a sender that gives none is stamped with the host's time.

pyigtl is needed: ``pip install 'fgreg[igtl]'``.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from fgreg.drivers.base import BmodeFrame, MotionSample, PaFrame, Registration, host_now
from fgreg.drivers.igtl_contents import Image, Transform
from fgreg.drivers.igtl_decoder import MessageDecoder, Offers, pack_start
from fgreg.drivers.igtl_messages import Message, check_name, check_version, require_pyigtl
from fgreg.drivers.igtl_registration import REFUSED_SAID_S, DeviceNames, registration_messages
from fgreg.drivers.stream_decoder import Rejections
from fgreg.drivers.tcp_device import LinkedDevice
from fgreg.drivers.tcp_link import Endpoint, TcpLink
from fgreg.geometry.transforms import inverse, is_rigid, make_transform, nearest_rotation
from fgreg.model.time_sync import Stamp

if TYPE_CHECKING:
    from fgreg.drivers.base import BmodeSource, DriverContext, MotionSource, PhotoacousticSource, TransformSink
    from fgreg.drivers.options import Connection, IgtlBmodeOptions, IgtlMotionOptions, IgtlProbeOptions, IgtlSinkOptions

SILENT_S = 0.8
"""Default time after which a silent stream counts as lost, so that the loss is reported within a second."""


class IgtlDevice(LinkedDevice[Message]):
    """A connection from which some messages are read."""

    _role = "OpenIGTLink"

    def __init__(
        self,
        endpoint: Endpoint,
        wanted: Iterable[tuple[str, str]] = (),
        silent_s: float | None = None,
        greeting: bytes = b"",
        offers: Offers | None = None,
    ) -> None:
        require_pyigtl()
        chosen = frozenset(wanted)
        for _, device in chosen:
            if device:
                check_name(device)

        counts: Counter[tuple[str, str]] = Counter()

        def decoder(rejections: Rejections) -> MessageDecoder:
            return MessageDecoder(rejections, chosen, counts, offers)

        link = TcpLink(endpoint, decoder, greeting=greeting, silent_s=silent_s, keep_latest=offers is not None)
        super().__init__(link)

    def _leave_out(self, message: Message, why: str) -> None:
        self._link.rejections.add(f"{message.peer}: {message.device}: {why}")


class IgtlReceiver(IgtlDevice):
    """All transforms, images, texts and states that arrive, or those of some devices, in order.

    Args:
        endpoint: the sender.
        wanted: pairs of type (``TRANSFORM``: also POSITION, and the instruments of TDATA and QTDATA; ``IMAGE``,
            ``STRING``, ``STATUS``) and device; an empty device takes all.
        silent_s: as for the sources below; None if the sender may be silent.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        wanted: Iterable[tuple[str, str]] = (("TRANSFORM", ""), ("STRING", ""), ("STATUS", "")),
        silent_s: float | None = None,
    ) -> None:
        super().__init__(endpoint, wanted, silent_s)

    def poll(self) -> Sequence[Message]:
        """Messages since the last call. Raises DeviceLost."""
        return self._messages()


class _Images(IgtlDevice):
    """Numbered two-dimensional images of one device."""

    def __init__(self, endpoint: Endpoint, device: str, silent_s: float | None) -> None:
        super().__init__(endpoint, [("IMAGE", check_name(device))], silent_s)

    def _pictures(self) -> list[tuple[Message, npt.NDArray[np.generic], Image]]:
        pictures = []
        for message in self._messages():
            content = message.content
            if not isinstance(content, Image) or content.pixels.shape[0] != 1:
                self._leave_out(message, "not a single slice")
                continue
            pictures.append((message, content.pixels[0], content))
        return pictures


class IgtlPhotoacoustic(_Images):
    """PhotoacousticSource: each IMAGE of a device holds the probe's data after one laser pulse.

    Args:
        endpoint: PLUS or the scanner.
        device: e.g. ``Image_Probe``.
        transposed: whether the sender's rows are the columns of the session's frames, which have one row per element
            (channel data) or per depth (envelope images).
        silent_s: None if the laser may pause.
    """

    _role = "photoacoustic source"

    def __init__(
        self, endpoint: Endpoint, device: str, transposed: bool = False, silent_s: float | None = SILENT_S
    ) -> None:
        super().__init__(endpoint, device, silent_s)
        self._transposed = transposed

    def poll(self) -> Sequence[PaFrame]:
        """Pulses since the last call. Raises DeviceLost."""
        frames = []
        for message, pixels, _ in self._pictures():
            if pixels.ndim != 2:
                self._leave_out(message, f"an image of {pixels.shape[-1]} components, expected 1")
                continue
            data = np.ascontiguousarray(pixels.T if self._transposed else pixels)
            frames.append(PaFrame(_stamp(message), data, message.index))
        return frames


class IgtlBmode(_Images):
    """BmodeSource: 8-bit B-mode images of a device, for overlay; rows are depths.

    Images carry the size of their pixels, but not their position in the image plane.

    Args:
        endpoint: PLUS or the scanner.
        device: e.g. ``Image_Reference``.
        silent_s: None if the picture may be frozen.
        origin_mm: depth and lateral position (TRUS x) of the centre of the upper left pixel as displayed; None if
            unknown.
        flip: whether the columns run against TRUS x.
    """

    _role = "B-mode source"

    def __init__(
        self,
        endpoint: Endpoint,
        device: str,
        silent_s: float | None = SILENT_S,
        origin_mm: tuple[float, float] | None = None,
        flip: bool = False,
    ) -> None:
        super().__init__(endpoint, device, silent_s)
        self._origin_mm, self._flip = origin_mm, flip

    def poll(self) -> Sequence[BmodeFrame]:
        """Images since the last call. Raises DeviceLost."""
        frames = []
        for message, pixels, image in self._pictures():
            if pixels.dtype != np.uint8 or pixels.shape[2:] not in ((), (3,)):
                self._leave_out(message, f"an image of {pixels.shape} {pixels.dtype}, expected uint8, grey or RGB")
                continue
            along_i, along_j = (float(np.linalg.norm(image.world_T_ijk[:3, axis])) for axis in (0, 1))
            bgr = pixels[..., ::-1] if pixels.ndim == 3 else pixels
            shown = np.array(bgr[:, ::-1] if self._flip else bgr, dtype=np.uint8)
            frames.append(BmodeFrame(_stamp(message), shown, message.index, (along_j, along_i), self._origin_mm))
        return frames


class IgtlMotion(IgtlDevice):
    """MotionSource: poses of the endoscope's holder, millimetres: TRANSFORM, POSITION, or in TDATA or QTDATA.

    Args:
        endpoint: the sender.
        device: e.g. ``CameraToBase``: the matrix maps camera points to the holder's base. Of TDATA and QTDATA the name
            of the instrument.
        inverted: whether the sender has the inverse, ``BaseToCamera``.
        start: ``TDATA`` or ``QTDATA``: ask for that stream (STT), for trackers that send it only when asked.

    Left out and counted: transforms that PLUS marks with a ``TransformStatus`` other than ``OK``, and matrices that are
    not rigid.
    """

    _role = "motion source"

    def __init__(
        self,
        endpoint: Endpoint,
        device: str,
        inverted: bool = False,
        silent_s: float | None = SILENT_S,
        start: str | None = None,
    ) -> None:
        require_pyigtl()
        greeting = b"" if start is None else pack_start(start)
        super().__init__(endpoint, [("TRANSFORM", check_name(device))], silent_s, greeting)
        self._inverted = inverted

    def poll(self) -> Sequence[MotionSample]:
        """Samples since the last call. Raises DeviceLost."""
        samples = []
        for message in self._messages():
            status = message.metadata.get("TransformStatus", "OK")
            if not isinstance(message.content, Transform) or status != "OK":
                self._leave_out(message, f"status {status}")
                continue
            matrix = message.content.to_T_from
            if not is_rigid(matrix):
                self._leave_out(message, "not a rigid transform")
                continue
            clean = make_transform(nearest_rotation(matrix[:3, :3]), matrix[:3, 3])  # single precision on the wire
            samples.append(MotionSample(_stamp(message), inverse(clean) if self._inverted else clean))
        return samples


class IgtlTransformSink(IgtlDevice):
    """TransformSink: ``igtl_registration`` describes the messages, also those of a refused registration.

    Receivers may also ask for them: GET_STATUS, GET_STRING, GET_TRANSFORM, GET_CAPABIL.

    Args:
        endpoint: ``Endpoint.listening(18944)`` for receivers that connect (several may), or a receiver's address. A
            receiver that connects later gets the newest registration at once.
        names: of the devices.
        header_version: 2 for 3D Slicer and PLUS of 2017 and later; 1, without metadata, for receivers of OpenIGTLink 1
            and 2, which lose the stream at a header they do not know.
    """

    _role = "transform sink"

    def __init__(self, endpoint: Endpoint, names: DeviceNames | None = None, header_version: int = 2) -> None:
        names = names or DeviceNames()
        self._names, self._version = names, check_version(header_version)
        self._usable: bool | None = None
        self._since_s = -math.inf
        transforms = (names.registration, names.plane)
        devices = {"STATUS": (names.status,), "STRING": (names.verdict,), "TRANSFORM": transforms}
        self._offers = Offers(devices, why="there is no usable registration")
        super().__init__(endpoint, offers=self._offers)

    def send(self, registration: Registration) -> None:
        """Send the registration; for a slow receiver only the newest is kept. Raises DeviceLost."""
        sent_s = time.time() - (host_now() - registration.stamp.host_s)
        messages = registration_messages(registration, max(sent_s, 0.0), self._names, self._version)
        self._offers.offer(messages)
        usable = ("TRANSFORM", self._names.registration) in messages
        if usable is not self._usable:
            self._usable, self._since_s = usable, host_now()
        whole = b"".join(messages.values())
        stale = not usable and host_now() - self._since_s > REFUSED_SAID_S
        told = [message for (kind, _), message in messages.items() if not (stale and kind == "STATUS")]
        self._link.offer(b"".join(told), latest=whole)
        self._raise_loss()


def _stamp(message: Message) -> Stamp:
    return Stamp(message.host_s if message.sent_s is None else message.sent_s, message.host_s)


def open_photoacoustic(_context: DriverContext, options: IgtlProbeOptions) -> PhotoacousticSource:
    """Images over OpenIGTLink, one for each laser pulse."""
    return IgtlPhotoacoustic(endpoint(options), options.device, options.transposed, options.silent_s)


def open_bmode(_context: DriverContext, options: IgtlBmodeOptions) -> BmodeSource:
    """B-mode images over OpenIGTLink."""
    origin_mm = None if options.x_mm is None else (options.depth_mm, options.x_mm)
    return IgtlBmode(endpoint(options), options.device, options.silent_s, origin_mm, options.flip)


def open_motion(_context: DriverContext, options: IgtlMotionOptions) -> MotionSource:
    """Transforms of the endoscope's holder."""
    return IgtlMotion(endpoint(options), options.device, options.inverted, options.silent_s, options.start)


def open_sink(_context: DriverContext, options: IgtlSinkOptions) -> TransformSink:
    """Receiver of the registration over OpenIGTLink."""
    names = DeviceNames(options.registration, options.plane, options.status, options.verdict)
    return IgtlTransformSink(endpoint(options), names, options.header_version)


def endpoint(options: Connection) -> Endpoint:
    """The peer's address, or the address to listen at."""
    return Endpoint(options.host, options.port, options.listen)
