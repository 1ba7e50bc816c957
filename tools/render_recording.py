"""Make a PNG picture of a Rerun recording without a screen.

The picture shows the recording as it opens, with its own blueprint, or one of its views alone, at the end of the
recording or at a moment of one of its timelines:

    python tools/render_recording.py session.rrd picture.png
    python tools/render_recording.py session.rrd shot5.png --timeline shot --at 5
    python tools/render_recording.py session.rrd scene.png --view "Scene"

It starts Rerun's own viewer in its headless mode on a free local port and ends it again. That needs a Vulkan driver;
where there is no graphics card a software one will do (on Debian and Ubuntu the package mesa-vulkan-drivers).
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fgreg.viewer.spawn import ViewerError, free_port, viewer_executable

NO_DRIVER = "no Vulkan driver was found; install one (Debian, Ubuntu: apt-get install mesa-vulkan-drivers)"


MENU_HEIGHT_PX = 36


class RenderError(Exception):
    """The picture could not be made; the message says why and what to do."""


def ended(child: subprocess.Popen[bytes], log: Path) -> RenderError:
    """Why a viewer that has ended did so."""
    text = log.read_text(errors="replace")
    if "graphics adapter" in text or "wgpu" in text:
        return RenderError(NO_DRIVER)
    return RenderError(f"the viewer ended at once, status {child.returncode}: {text.strip()[-400:]}")


def wait_for_port(child: subprocess.Popen[bytes], port: int, log: Path, deadline: float) -> None:
    """Return once ``child`` listens; raise RenderError where it ended or the deadline passed."""
    while time.monotonic() < deadline:
        if child.poll() is not None:
            raise ended(child, log)
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=0.5):
            return
        time.sleep(0.1)
    raise RenderError("the viewer did not start in time; see --timeout")


@contextlib.contextmanager
def headless_viewer(width: int, height: int, deadline: float) -> Iterator[Any]:
    """A client of a headless viewer that is ended, with everything it started, on the way out."""
    from rerun.experimental import ViewerClient

    port = free_port()
    with tempfile.TemporaryDirectory() as scratch:
        log = Path(scratch) / "viewer.log"
        with log.open("wb") as sink:
            child = subprocess.Popen(
                [
                    str(viewer_executable()),
                    "--headless",
                    "--bind=127.0.0.1",
                    f"--port={port}",
                    f"--window-size={width}x{height}",
                    "--hide-welcome-screen",
                ],
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        try:
            wait_for_port(child, port, log, deadline)
            yield ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        except ConnectionError as error:  # it may listen before it looks for a driver
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(timeout=5.0)
            raise ended(child, log) if child.poll() is not None else RenderError(str(error)) from error
        finally:
            end(child)


def end(child: subprocess.Popen[bytes]) -> None:
    """End a child and its process group: by SIGTERM, then by SIGKILL."""
    for how in (signal.SIGTERM, signal.SIGKILL):
        if child.poll() is not None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child.pid, how)
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(timeout=5.0)


def wait_until_loaded(client: Any, deadline: float) -> Any:
    """The viewer's state once nothing is loading any more and a recording is shown."""
    while time.monotonic() < deadline:
        state = client.get_state()
        if state.active_recording is not None and not state.loading and state.views:
            return state
        time.sleep(0.2)
    raise RenderError("the recording did not load in time; see --timeout")


def render(
    recording: Path,
    picture: Path,
    *,
    size: tuple[int, int] = (1600, 1000),
    timeline: str | None = None,
    at: float | None = None,
    view: str | None = None,
    menu: bool = True,
    settle_s: float = 12.0,
    timeout_s: float = 60.0,
) -> None:
    """Write the picture of a recording as PNG.

    Args:
        recording: the ``.rrd`` file.
        picture: where to write the PNG.
        size: width and height of the viewer's window, px.
        timeline, at: the moment shown, in shots on ``shot`` and in seconds on ``time``; as it opens where None.
        view: start of the name of the one view to show; the whole window where None.
        menu: whether to show the viewer's menu bar (of a whole window).
        settle_s: time for the viewer to decode images, and for its start-up messages to fade.
        timeout_s: for all of it.

    Raises:
        RenderError: no viewer, no driver, no such view, or out of time.
    """
    deadline = time.monotonic() + timeout_s
    with headless_viewer(*size, deadline) as client:
        client.open(str(recording.resolve()))
        state = wait_until_loaded(client, deadline)
        if at is not None and timeline in (None, "shot"):
            client.set_time("shot", sequence=round(at), play_state="paused")
        elif at is not None:
            client.set_time(timeline, duration=at, play_state="paused")
        time.sleep(settle_s)
        view_id = None
        if view is not None:
            found = [v for v in state.views if v.name.lower().startswith(view.lower())]
            if not found:
                names = ", ".join(sorted(v.name for v in state.views))
                raise RenderError(f"no view is called {view!r}; there are: {names}")
            view_id = found[0].view_id
        data = client.take_screenshot(view_id)
    if view is None and not menu:
        data = without_menu(data)
    part = picture.with_name(picture.name + ".part")
    part.write_bytes(data)
    part.replace(picture)


def without_menu(png: bytes) -> bytes:
    """The picture of a whole window without its menu bar."""
    from PIL import Image  # comes with rerun-sdk

    picture = Image.open(io.BytesIO(png))
    out = io.BytesIO()
    picture.crop((0, MENU_HEIGHT_PX, picture.width, picture.height)).save(out, format="PNG", optimize=True)
    return out.getvalue()


def parse_size(text: str) -> tuple[int, int]:
    """``1600x1000`` as (1600, 1000)."""
    try:
        width, height = (int(number) for number in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected WIDTHxHEIGHT, e.g. 1600x1000") from None
    if not (100 <= width <= 8192 and 100 <= height <= 8192):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected sides between 100 and 8192")
    return width, height


def main(arguments: list[str] | None = None) -> int:
    """Command line; 0 done, 2 not done (with one line that says why)."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, help="the .rrd file")
    parser.add_argument("picture", type=Path, help="the PNG file to write")
    parser.add_argument("--size", type=parse_size, default=(1600, 1000), help="window, WIDTHxHEIGHT (1600x1000)")
    parser.add_argument("--timeline", help="timeline of --at: shot (default) or time")
    parser.add_argument("--at", type=float, help="moment to show: a shot number, or seconds; default: the end")
    parser.add_argument("--view", help="only the view whose name starts with this")
    parser.add_argument("--no-menu", action="store_true", help="cut off the viewer's menu bar")
    parser.add_argument(
        "--settle",
        type=float,
        default=12.0,
        help="seconds until the picture is taken: images decode, messages of the viewer fade (12)",
    )
    parser.add_argument("--timeout", type=float, default=60.0, help="seconds after which to give up (60)")
    options = parser.parse_args(arguments)
    for folder in (options.recording, options.picture.parent):
        if not folder.exists():
            print(f"render_recording: error: {folder} does not exist", file=sys.stderr)
            return 2
    try:
        render(
            options.recording,
            options.picture,
            size=options.size,
            timeline=options.timeline,
            at=options.at,
            view=options.view,
            menu=not options.no_menu,
            settle_s=options.settle,
            timeout_s=options.timeout,
        )
    except (RenderError, ViewerError) as error:
        print(f"render_recording: error: {error}", file=sys.stderr)
        return 2
    print(f"{options.picture}: {options.picture.stat().st_size / 1024:.0f} kB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
