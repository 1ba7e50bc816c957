"""The overlay in a window of this machine.

OpenCV's windows belong to one thread, which makes, shows and closes this one. The headless OpenCV that fgreg installs
has no windows: an OpenCV with windows replaces it (``pip install opencv-contrib-python`` after
``pip uninstall opencv-contrib-python-headless``).
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from typing import TYPE_CHECKING

import cv2

from fgreg.drivers.base import DeviceLost, OverlayPicture
from fgreg.errors import InputError, one_line

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext, PictureSink
    from fgreg.drivers.options import WindowOptions

TRIAL = "import cv2; cv2.namedWindow('fgreg'); cv2.waitKey(1); cv2.destroyAllWindows()"
TRIAL_S = 20.0
TICK_MS = 10
"""Time that the window's thread waits for keys and events between two looks at what to show."""


def check_window(_options: WindowOptions) -> None:
    """Raises InputError where no window can be shown."""
    gui = re.search(r"GUI:\s*(\S+)", cv2.getBuildInformation())
    if gui is None or gui.group(1) == "NONE":
        expected = "one with windows: opencv-contrib-python instead of opencv-contrib-python-headless"
        raise InputError("overlay window", "an OpenCV without windows", expected)
    if not sys.platform.startswith("linux"):  # windows belong to a program's main thread there
        raise InputError("overlay window", f"the system {sys.platform}", "Linux, or the driver igtl")
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise InputError("overlay window", "no display (DISPLAY is not set)", "a screen, or the driver igtl")


def try_display() -> None:
    """Raises InputError where no window opens. Tried in another process: the windows' library ends one that fails."""
    try:
        done = subprocess.run([sys.executable, "-P", "-c", TRIAL], timeout=TRIAL_S, check=False, capture_output=True)
        opened = done.returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        opened = False
    if not opened:
        display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        raise InputError(
            "overlay window", f"a display, {display}, on which no window opens", "a screen, or the driver igtl"
        )


class OverlayWindow:
    """PictureSink: a window. Closed by the user, it is lost, and stays closed.

    Raises:
        InputError: there is no OpenCV with windows, or no display.
    """

    def __init__(self, options: WindowOptions) -> None:
        check_window(options)
        try_display()
        self._title, self._full_screen = options.title, options.full_screen
        self._newest: OverlayPicture | None = None
        self._loss = ""
        self.connected, self.dropped = True, 0
        self._lock, self._end = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="overlay window", daemon=True)
        self._thread.start()

    @property
    def name(self) -> str:
        """Its title."""
        return f"window {self._title}"

    def send(self, picture: OverlayPicture) -> None:
        """Show a picture. Raises DeviceLost, once, after the window was closed."""
        with self._lock:
            loss, self._loss = self._loss, ""
            self.dropped += self._newest is not None and self.connected
            self._newest = picture
        if loss:
            raise DeviceLost(f"overlay: {loss}")

    def close(self) -> None:
        """Close the window."""
        self._end.set()
        self._thread.join(2.0)

    def _run(self) -> None:
        try:
            self._show()
        except cv2.error as error:
            self._lose(f"the window cannot be shown: {one_line(str(error), 100)}")
        finally:
            self.connected = False

    def _show(self) -> None:
        shown = False
        while not self._end.is_set():
            with self._lock:
                picture, self._newest = self._newest, None
            if picture is not None:
                if not shown:
                    cv2.namedWindow(self._title, cv2.WINDOW_NORMAL | cv2.WINDOW_KEEPRATIO | cv2.WINDOW_GUI_NORMAL)
                    cv2.resizeWindow(self._title, picture.image.shape[1], picture.image.shape[0])
                    if self._full_screen:
                        cv2.setWindowProperty(self._title, cv2.WND_PROP_FULLSCREEN, cv2.WINDOW_FULLSCREEN)
                cv2.imshow(self._title, picture.image)
            if not shown and picture is None:
                self._end.wait(TICK_MS / 1e3)
                continue
            cv2.waitKey(TICK_MS)
            if shown and cv2.getWindowProperty(self._title, cv2.WND_PROP_VISIBLE) < 1:
                self._lose("its window was closed")
                return
            shown = True
        if shown:
            cv2.destroyWindow(self._title)

    def _lose(self, why: str) -> None:
        with self._lock:
            self._loss, self.connected = why, False


def open_window(_context: DriverContext, options: WindowOptions) -> PictureSink:
    """The overlay in a window."""
    return OverlayWindow(options)
