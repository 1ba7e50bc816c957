"""The endoscope through OpenCV: V4L2 devices, streams and files by FFMPEG, folders of pictures; two inputs or one.

Sources, as the user writes them:

- ``0`` or ``/dev/video0``: a V4L2 device. Times are the driver's (Linux' monotonic clock).
- ``scheme://...``: a stream, by FFMPEG. Times are arrival times.
- a file: a video, by FFMPEG, played at its own pace.
- a folder, or a pattern such as ``left/*.png``: pictures, played at ``fps`` (fgreg.drivers.image_folder).
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np

from fgreg.detection.frame_files import Picture
from fgreg.drivers.base import DeviceLost, StereoFrame
from fgreg.drivers.image_folder import FolderCapture
from fgreg.drivers.interlacing import Fields, split
from fgreg.drivers.rectification import Rectification
from fgreg.drivers.stereo_matching import StereoMatcher
from fgreg.drivers.video_input import SILENCE_S, Capture, Grabbed, Origin, Timing, VideoInput
from fgreg.errors import InputError
from fgreg.model.time_sync import Stamp
from fgreg.schema.limits import PICTURE_PIXELS

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext, StereoCamera
    from fgreg.drivers.options import EndoscopeOptions

_VIDEO_DEVICE = re.compile(r"/dev/video[0-9]+")
_STREAM = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*://")
_FIELD_SHARE = 0.5  # the second field is half a frame period after the first
_MAX_GAP_S = 0.017


class Layout(StrEnum):
    """Where left and right are."""

    MONO = "mono"
    SEPARATE = "separate"
    SIDE_BY_SIDE = "side-by-side"
    """Left half of each frame, right half; or the other way with ``swap``."""
    TOP_BOTTOM = "top-bottom"


@dataclass(frozen=True, slots=True)
class InputConfig:
    """One input.

    Attributes:
        source: see the module.
        width, height, fps, fourcc: asked of a device; ``fps`` of a folder is its pace.
        loop: whether files and folders start again at their end.
        delay_s: from the middle of the exposure to the device's stamp; subtracted from its time.
        silence_s: an input without a frame for this long counts as lost.
    """

    source: str | int
    width: int | None = None
    height: int | None = None
    fps: float | None = None
    fourcc: str | None = None
    loop: bool = False
    delay_s: float = 0.0
    silence_s: float = SILENCE_S

    def __post_init__(self) -> None:
        if self.fps is not None and not 0.0 < self.fps <= 1000.0:
            raise ValueError(f"fps is {self.fps}, expected a number > 0 and <= 1000")
        if self.fourcc is not None and len(self.fourcc) != 4:
            raise ValueError(f"fourcc is {self.fourcc!r}, expected four characters such as MJPG")


@dataclass(frozen=True, slots=True)
class EndoscopeConfig:
    """The endoscope.

    Attributes:
        left: the left input, or the only one.
        right: the right input, where there are two.
        layout: where left and right are.
        swap: whether left and right are exchanged in each frame.
        fields: how interlaced frames are split; the session's camera is then that of the fields
            (fgreg.drivers.interlacing.field_rig).
        max_gap_s: longest time between left and right of two inputs. Default: half a frame period at 30 frames/s.
        by_arrival: match two inputs by arrival time even if both have device times on one clock.
        queue: largest number of waiting frames.
    """

    left: InputConfig
    right: InputConfig | None = None
    layout: Layout = Layout.MONO
    swap: bool = False
    fields: Fields = Fields.WHOLE
    max_gap_s: float = _MAX_GAP_S
    by_arrival: bool = False
    queue: int = 8

    def __post_init__(self) -> None:
        if (self.right is not None) != (self.layout is Layout.SEPARATE):
            raise ValueError(f"layout is {self.layout} with {'two inputs' if self.right else 'one input'}")
        if not self.max_gap_s > 0:
            raise ValueError(f"max_gap_s is {self.max_gap_s}, expected a number > 0")


@dataclass(slots=True)
class _Cadence:
    """Time between the last two frames, for the second field's stamp."""

    last_s: float | None = None
    period_s: float = field(default=1.0 / 30.0)

    def after(self, device_s: float) -> float:
        if self.last_s is not None and 0.0 < device_s - self.last_s < 1.0:
            self.period_s = device_s - self.last_s
        self.last_s = device_s
        return self.period_s


class Input(Protocol):
    """A source of numbered pictures; fgreg.drivers.video_input.VideoInput says more."""

    @property
    def name(self) -> str: ...
    @property
    def connected(self) -> bool: ...
    @property
    def ended(self) -> bool: ...
    @property
    def dropped(self) -> int: ...
    def poll(self) -> Sequence[Grabbed]: ...
    def close(self) -> None: ...


class Endoscope:
    """A StereoCamera (fgreg.drivers.base) of one or two video inputs.

    If the right one of two inputs is lost, left frames continue alone (``right`` None) until it is back.

    Args:
        config: inputs and their layout.
        rectified: rectification of the pictures, or None; the session's camera is then ``rectified.rig``.
        inputs: one or two in place of the configuration's sources, stamped by one clock.

    Raises:
        InputError: an invalid source. An absent device is no error: it counts as lost, and the driver tries again.
    """

    def __init__(
        self,
        config: EndoscopeConfig,
        rectified: Rectification | None = None,
        inputs: Sequence[Input] = (),
    ) -> None:
        self._config, self._rectified = config, rectified
        sources = [] if inputs else [_Source.of(entry) for entry in (config.left, config.right) if entry is not None]
        origin = Origin()
        self._inputs: list[Input] = [*inputs]
        self._inputs += [VideoInput(s.name, s.open, s.timing, config.queue, origin) for s in sources]
        one_clock = len({source.clock for source in sources}) <= 1 and all(s.clock != "host" for s in sources)
        self._matcher = StereoMatcher(
            config.max_gap_s,
            (lambda g: g.stamp.device_s) if one_clock and not config.by_arrival else (lambda g: g.stamp.host_s),
            2 * config.queue,
        )
        self._losses: list[DeviceLost] = []
        self._held: list[StereoFrame] = []
        self._told_right = False
        self._cadence = _Cadence()
        self._misfits, self._left_out = False, 0  # whether the last frame did not fit; number of those

    @property
    def name(self) -> str:
        """The inputs' names."""
        return " and ".join(entry.name for entry in self._inputs)

    @property
    def connected(self) -> bool:
        """Whether all inputs deliver, and what fits."""
        return not self._misfits and all(entry.connected for entry in self._inputs)

    @property
    def ended(self) -> bool:
        """Whether files were played to their end."""
        return any(entry.ended for entry in self._inputs)

    @property
    def dropped(self) -> int:
        """Number of frames that were not fetched in time, had no partner, or did not fit."""
        return sum(entry.dropped for entry in self._inputs) + self._matcher.dropped + self._left_out

    def poll(self) -> list[StereoFrame]:
        """Frames since the last call, oldest first.

        Raises:
            DeviceLost: an input is lost; once for each loss, with what continues without it. Or frames do not fit the
                layout or the rectification; it is connected again with the first one that does.
        """
        grabbed: list[Sequence[Grabbed]] = []
        for i, entry in enumerate(self._inputs):
            try:
                grabbed.append(entry.poll())
            except DeviceLost as error:
                grabbed.append([])
                if i == 1:
                    self._told_right = True
                self._losses.append(DeviceLost(f"endoscope: {error}{self._remaining(i)}"))
        if len(self._inputs) == 2:
            if self._inputs[1].connected:
                self._told_right = False
            pairs = self._matcher.take(grabbed[0], grabbed[1], right_expected=not self._told_right)
        else:
            pairs = [(entry, None) for entry in grabbed[0]]
        for left, right in pairs:
            misfitted, self._misfits = self._misfits, False
            try:
                self._held += self._frames(left, right)
            except InputError as error:
                self._misfits, self._left_out = True, self._left_out + 1
                self._losses += [] if misfitted else [DeviceLost(str(error))]
        if self._losses:
            raise self._losses.pop(0)  # the frames are returned by the next call
        frames, self._held = self._held, []
        return frames

    def _remaining(self, lost: int) -> str:
        if len(self._inputs) == 1:
            return ""
        return "; the left camera goes on alone" if lost == 1 else "; no frames until it is back"

    def close(self) -> None:
        """Release all inputs."""
        for entry in self._inputs:
            entry.close()

    def _frames(self, left: Grabbed, right: Grabbed | None) -> list[StereoFrame]:
        views = self._views(left.picture) if right is None else (left.picture, right.picture)
        lefts = split(views[0], self._config.fields)
        rights: list[Picture] | list[None] = [None] * len(lefts)
        if views[1] is not None:
            rights = split(views[1], self._config.fields)
        period_s = self._cadence.after(left.stamp.device_s)
        out = []
        for k, (first, second) in enumerate(zip(lefts, rights, strict=True)):
            later_s = k * _FIELD_SHARE * period_s
            stamp = Stamp(left.stamp.device_s + later_s, left.stamp.host_s)
            if self._rectified is not None:
                first = self._rectified.left(first)
                second = None if second is None else self._rectified.right(second)
            out.append(StereoFrame(stamp, first, second, len(lefts) * left.index + k))
        return out

    def _views(self, picture: Picture) -> tuple[Picture, Picture | None]:
        """Left and right of one input's frame."""
        layout = self._config.layout
        if layout in (Layout.MONO, Layout.SEPARATE):
            return picture, None
        first, second = halves_of(picture, layout, f"endoscope {self.name}")
        return (second, first) if self._config.swap else (first, second)


@dataclass(frozen=True, slots=True)
class _Source:
    """A source of one kind: how it is opened, and which clock stamps its frames."""

    name: str
    open: Callable[[], Capture | None]
    timing: Timing
    clock: str

    @classmethod
    def of(cls, config: InputConfig) -> _Source:
        text = str(config.source).strip()
        timing = Timing(delay_s=config.delay_s, silence_s=config.silence_s)
        if text.isdecimal():
            text = f"/dev/video{int(text)}"
        if _VIDEO_DEVICE.fullmatch(text):
            return cls(text, lambda: _open_device(text, config), timing, "v4l2")
        if _STREAM.match(text):
            by_arrival = replace(timing, device_clock=False)
            return cls(text, lambda: _open_stream(text, config.silence_s), by_arrival, "host")
        played = replace(timing, paced=True, loop=config.loop)
        path = Path(text)
        if path.is_dir() or "*" in path.name:
            folder = FolderCapture.of(path, config.fps or 30.0)  # so that errors are raised here, not later
            return cls(text, folder.again, played, "file")
        if not path.is_file():
            raise InputError(text, "nothing", "a video device, a stream, a video file, or a folder of pictures")
        open_video(path).release()  # so that errors are raised here, not later
        return cls(text, lambda: _capture(text, cv2.CAP_FFMPEG), played, "file")


def open_video(path: Path) -> cv2.VideoCapture:
    """A video file, by FFMPEG.

    Raises:
        InputError: it cannot be read, or its frames are too large.
    """
    text = str(path)
    try:
        capture = _capture(text, cv2.CAP_FFMPEG)
    except OSError as error:
        raise InputError(text, str(error), "a video") from None
    if not capture.isOpened():
        capture.release()
        raise InputError(text, "a file that FFMPEG cannot read", "a video")
    return capture


def halves_of(picture: Picture, layout: Layout, name: str) -> tuple[Picture, Picture]:
    """The first and the second view of a picture that holds both.

    Raises:
        InputError: its size is odd.
    """
    axis = 1 if layout is Layout.SIDE_BY_SIDE else 0
    half, odd = divmod(picture.shape[axis], 2)
    if odd or not half:
        found = f"frames of {picture.shape[1]} x {picture.shape[0]} px"
        raise InputError(name, found, f"frames that can be halved, as the layout is {layout}")
    first, second = (np.ascontiguousarray(part) for part in np.split(picture, [half], axis=axis))
    return first, second


def _capture(*arguments: Any) -> cv2.VideoCapture:
    """A capture whose frames, where their size is known, are not too large. Raises OSError."""
    capture = cv2.VideoCapture(*arguments)
    width, height = (round(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if width * height > PICTURE_PIXELS:
        capture.release()
        raise OSError(f"frames of {width} x {height} px, more than {PICTURE_PIXELS}")
    return capture


def _open_device(path: str, config: InputConfig) -> Capture | None:
    if not os.path.exists(path):  # noqa: PTH110  (OpenCV would complain on standard error at each attempt)
        return None
    backend = cv2.CAP_V4L2 if sys.platform == "linux" else cv2.CAP_ANY
    capture = _capture(int(path.removeprefix("/dev/video")), backend)
    # The pixel format first: available sizes and rates depend on it.
    if config.fourcc is not None:
        capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.fourcc))
    for key, value in (
        (cv2.CAP_PROP_FRAME_WIDTH, config.width),
        (cv2.CAP_PROP_FRAME_HEIGHT, config.height),
        (cv2.CAP_PROP_FPS, config.fps),
    ):
        if value is not None:
            capture.set(key, value)
    width, height = (round(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if capture.isOpened() and (config.width or width, config.height or height) != (width, height):
        capture.release()
        raise OSError(f"it delivers {width} x {height} px, not {config.width} x {config.height}")
    return capture


def _open_stream(url: str, silence_s: float) -> Capture | None:
    patience_ms = max(1, round(1000.0 * silence_s))
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, patience_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC, patience_ms]
    return _capture(url, cv2.CAP_FFMPEG, limits)


def video_devices(known: Path = Path("/sys/class/video4linux")) -> list[tuple[str, str]]:
    """The V4L2 devices of this machine: path, and the driver's name for it."""
    out = []
    for entry in sorted(known.glob("video*"), key=lambda p: (len(p.name), p.name)):
        try:
            label = (entry / "name").read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            label = ""
        out.append((f"/dev/{entry.name}", label))
    return out


def endoscope_config(options: EndoscopeOptions) -> EndoscopeConfig:
    """The endoscope's configuration. Raises ValueError: values that do not fit together."""

    def one(source: str) -> InputConfig:
        return InputConfig(
            source,
            options.width,
            options.height,
            options.fps,
            options.fourcc,
            options.loop,
            options.delay_s,
            options.silence_s,
        )

    right = None if options.right is None else one(options.right)
    layout = Layout(options.layout) if options.layout else (Layout.MONO if right is None else Layout.SEPARATE)
    if options.swap and layout in (Layout.MONO, Layout.SEPARATE):
        raise ValueError(f"swap is for frames that hold both views; layout is {layout}")
    fields = Fields(options.fields)
    return EndoscopeConfig(
        one(options.left), right, layout, options.swap, fields, options.max_gap_s, options.by_arrival
    )


def open_endoscope(context: DriverContext, options: EndoscopeOptions) -> StereoCamera:
    """One or two video inputs."""
    return Endoscope(endoscope_config(options), context.rectified)
