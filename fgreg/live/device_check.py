"""Lists the devices and checks whether they answer. Each is polled for two seconds at most, and no stage moves."""

from __future__ import annotations

import importlib.metadata
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fgreg.drivers import plugins
from fgreg.drivers.base import BmodeFrame, DeviceLost, DriverContext, PaFrame, StereoFrame
from fgreg.drivers.options import EndoscopeOptions
from fgreg.drivers.registry import EXTRAS, SEVERAL, Role, distribution, drivers_of, installed
from fgreg.errors import FgregError, MissingExtraError, one_line
from fgreg.live.config import Chosen, LiveConfig
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import Stamp
from fgreg.schema.problems import FieldError

LISTEN_S = 2.0
ENOUGH, ENOUGH_S = 20, 1.0
"""Polling ends early after this many items and this many seconds."""
_POLL_S = 0.005


@dataclass(frozen=True, slots=True)
class DeviceReport:
    """State of one device or library.

    Attributes:
        what: its role, or its kind.
        driver: the driver's name in a configuration; else empty.
        name: name shown to the user.
        answers: whether it is present and works.
        says: one line on its data, or on why there are none.
    """

    what: str
    driver: str
    name: str
    answers: bool
    says: str


def extras() -> Iterator[DeviceReport]:
    """The libraries that drivers need."""
    for extra, (_, purpose) in EXTRAS.items():
        package = distribution(extra)
        if not installed(extra):
            yield DeviceReport(
                "extra", "", extra, False, f"{package} is missing ({purpose}): pip install 'fgreg[{extra}]'"
            )
            continue
        try:
            version = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            version = "of unknown version"
        yield DeviceReport("extra", "", extra, True, f"{package} {version} ({purpose})")


def other_drivers(folder: Path | None = None) -> Iterator[DeviceReport]:
    """The drivers that other packages bring, each with its keys in CONFIG.yaml; ``folder`` is that file's."""
    for role in Role:
        for name, found in plugins.installed(role, folder).items():
            usable = False
            try:
                keys = [key for key in found.driver(folder).record.names if key != "driver"]
                usable = name not in drivers_of(role)
                why = f"keys {', '.join(keys) or 'none'}" if usable else "fgreg has one of this name, so name its class"
            except FieldError as error:
                why = f"found {error.problems[0].found}"
            yield DeviceReport("driver", "", f"{role}.{name}", usable, f"{found.place} of {found.package}; {why}")


def video(listen_s: float = LISTEN_S) -> Iterator[DeviceReport]:
    """The video devices of this machine; each is opened unless ``listen_s`` is 0."""
    from fgreg.drivers.endoscope import open_endoscope, video_devices

    for path, label in video_devices():
        if listen_s == 0:
            yield DeviceReport("video", "", path, True, label)
            continue
        with ExitStack() as stack:
            device = open_endoscope(_alone(), EndoscopeOptions(left=path))
            stack.callback(device.close)
            found = _listened(device, None, listen_s)
        yield DeviceReport("video", "", path, found.answers, f"{label}: {found.says}" if label else found.says)


def cubes() -> Iterator[DeviceReport]:
    """The Thorlabs cubes found on USB; none is moved."""
    from fgreg.drivers.thorlabs_identify import identify
    from fgreg.drivers.thorlabs_stage import find_ports

    try:
        ports = find_ports()
    except MissingExtraError:
        return
    for port in ports:
        try:
            yield DeviceReport("cube", "", port, True, str(identify(port)))
        except FgregError as error:
            yield DeviceReport("cube", "", port, False, str(error))


def configured(config: LiveConfig, listen_s: float = LISTEN_S) -> Iterator[DeviceReport]:
    """Check each device of a configuration, one after the other.

    Raises:
        FgregError: the simulated room is used and does not start.
    """
    with ExitStack() as stack:
        context = config.context(stack, lambda _: None)
        for role, several in config.devices.items():
            for number, chosen in enumerate(several, 1):
                what = str(role) if len(several) == 1 and role not in (Role.SINKS, Role.OVERLAY) else f"{role} {number}"
                name, found = _asked(role, chosen, context, config.model, listen_s)
                yield DeviceReport(what, chosen.entry.name, name, found.answers, one_line(found.says, 300))


@dataclass(frozen=True, slots=True)
class _Reply:
    answers: bool
    says: str


def _asked(
    role: Role, chosen: Chosen, context: DriverContext, model: SessionModel, listen_s: float
) -> tuple[str, _Reply]:
    name = _name(chosen)
    try:
        if (said := chosen.entry.described(context, chosen.options, model.stage)) is not None:
            return name, _Reply(True, said)
        device = chosen.open(context)
        try:
            name = device.name
            if role in SEVERAL:
                return name, _connected(device, bool(getattr(chosen.options, "listen", False)), listen_s)
            return name, _listened(device, model, listen_s)
        finally:
            device.close()
    except FgregError as error:
        return name, _Reply(False, str(error))


def _name(chosen: Chosen) -> str:
    """Name of a device before it is opened."""
    known = (getattr(chosen.options, name, None) for name in ("port", "left", "path"))
    return str(next((value for value in known if value), chosen.entry.help))


def _connected(device: Any, listens: bool, listen_s: float) -> _Reply:
    """State of a device that sends nothing by itself."""
    end = time.monotonic() + listen_s
    while not device.connected and time.monotonic() < end:
        time.sleep(_POLL_S)
    if device.connected:
        return _Reply(True, "connected")
    if listens:
        return _Reply(True, f"no one connected within {listen_s:g} s; it goes on waiting")
    return _Reply(False, f"no connection within {listen_s:g} s")


def _listened(device: Any, model: SessionModel | None, listen_s: float) -> _Reply:
    """State of a device that sends by itself."""
    begin = time.monotonic()
    items: list[Any] = []
    loss = ""
    while (now := time.monotonic() - begin) < listen_s and not (len(items) >= ENOUGH and now > ENOUGH_S):
        try:
            items += device.poll()
        except DeviceLost as error:
            loss = str(error)
        time.sleep(_POLL_S)
    if not items:
        why = f": {loss}" if loss else ", but it is connected" if device.connected else ""
        return _Reply(False, f"nothing came within {listen_s:g} s{why}")
    wrong = "" if model is None else _misfit(items[-1], model)
    says = ", ".join(part for part in (_rate(items), _shape(items[-1]), _clock(items)) if part)
    line = "; ".join(part for part in (says, wrong, loss) if part)
    return _Reply(not wrong and (device.connected or "played to its end" in loss), line)


def _rate(items: Sequence[Any]) -> str:
    """Items per second by the device's clock; dropped items count if items are numbered."""
    first, last = items[0], items[-1]
    span_s = last.stamp.device_s - first.stamp.device_s
    count = last.index - first.index if hasattr(last, "index") else len(items) - 1
    return f"{count / span_s:.1f} a second" if span_s > 0 and count > 0 else f"{len(items)} came"


def _shape(item: Any) -> str:
    match item:
        case StereoFrame(left=left, right=right):
            colour = "colour" if left.ndim == 3 else "grey"
            return f"{left.shape[1]} x {left.shape[0]} px, {colour}, {'one view' if right is None else 'stereo'}"
        case PaFrame(data=data):
            return f"{' x '.join(str(side) for side in data.shape)} {data.dtype}"
        case BmodeFrame(image=image, pixel_mm=pixel_mm, origin_mm=origin_mm):
            size = "of unknown size" if pixel_mm is None else f"of {pixel_mm[1]:.3g} x {pixel_mm[0]:.3g} mm"
            placed = "shown in the image plane" if pixel_mm and origin_mm else "its place in the image plane not known"
            return f"{image.shape[1]} x {image.shape[0]} px {size}, {placed}"
    return ""


def _misfit(item: Any, model: SessionModel) -> str:
    """How session.yaml differs from the item; empty if they agree."""
    match item:
        case StereoFrame(left=left) if model.camera is not None:
            width, height = model.camera.left.image_size
            if left.shape[:2] != (height, width):
                return f"session.yaml has {width} x {height} px"
        case PaFrame(data=data) if not model.probe.is_channel_data(data) and model.probe.image is None:
            return f"session.yaml has channel data: {model.probe.elements} x samples, float32 or int16"
    return ""


def _clock(items: Sequence[Any]) -> str:
    stamps: list[Stamp] = [item.stamp for item in items]
    return "the host's clock" if all(s.device_s == s.host_s for s in stamps) else "its own clock"


def _alone() -> DriverContext:
    return DriverContext(lambda _: None)
