"""Starts Rerun's viewer on this machine, on the loopback interface only, to show a recording while it grows."""

from __future__ import annotations

import contextlib
import importlib.util
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from fgreg.errors import FgregError

START_S = 30.0
STABLE_S = 1.5
"""The viewer counts as started after listening for this long: without a screen it ends sooner."""
MEMORY = "2GB"
"""Memory limit above which the viewer drops the oldest data: a live session may take hours."""
_INSTEAD = "record with --rrd FILE instead and open that where there is a screen"


class ViewerError(FgregError):
    """The viewer could not be started; the message has the cause and an alternative."""


def viewer_executable() -> Path:
    """The viewer of the installed Rerun package, else one next to this interpreter, else one on PATH.

    Raises:
        ViewerError: there is none.
    """
    # The package's own binary comes first: the script next to the interpreter only starts it as a child process, which
    # keeps running when the script is ended.
    name = "rerun.exe" if sys.platform.startswith("win") else "rerun"
    candidates: list[Path] = []
    spec = importlib.util.find_spec("rerun_cli")
    if spec is not None and spec.origin is not None:
        folder = Path(spec.origin).parent
        candidates += [folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun", folder / name]
    candidates.append(Path(sys.executable).parent / name)
    if (on_path := shutil.which("rerun")) is not None:
        candidates.append(Path(on_path))
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise ViewerError("the rerun viewer was not found; install it with: pip install rerun-sdk")


def free_port() -> int:
    """A free TCP port of the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def spawn_viewer(executable: Path | None = None, instead: str = _INSTEAD) -> str:
    """Start a viewer and return the address to send a recording to; the viewer stays open when this program ends.

    Args:
        executable: of the viewer; None: the installed one.
        instead: advice for the message where it cannot be started.

    Raises:
        ViewerError: no viewer, no screen for it, or it did not start in time.
    """
    program = executable or viewer_executable()
    port = free_port()
    with tempfile.TemporaryFile() as log:
        try:
            child = subprocess.Popen(
                [
                    str(program),
                    "--bind=127.0.0.1",
                    f"--port={port}",
                    "--hide-welcome-screen",
                    f"--memory-limit={MEMORY}",
                ],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except OSError as error:
            raise ViewerError(f"the rerun viewer cannot be started ({error.strerror}); {instead}") from None
        deadline, heard = time.monotonic() + START_S, None
        while time.monotonic() < deadline:
            if child.poll() is not None:
                log.seek(0)
                raise ViewerError(f"the rerun viewer ended at once ({_why(log.read(), child.returncode)}); {instead}")
            if heard is None:
                with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=0.5):
                    heard = time.monotonic()
            elif time.monotonic() - heard > STABLE_S:
                return f"rerun+http://127.0.0.1:{port}/proxy"
            time.sleep(0.1)
    child.kill()
    child.wait()
    raise ViewerError(f"the rerun viewer did not start within {START_S:.0f} s; {instead}")


def _why(log: bytes, status: int) -> str:
    """The cause of a viewer's end, from its output (log) and exit status."""
    text = log.decode("utf-8", errors="replace")
    if "DISPLAY" in text:
        return "there is no screen: neither DISPLAY nor WAYLAND_DISPLAY is set"
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    telling = [line for line in lines if "error" in line.lower()]
    return (telling or lines or [f"status {status}"])[-1][-160:]
