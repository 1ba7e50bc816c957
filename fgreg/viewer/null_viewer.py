"""The null viewer, which takes the same calls and does nothing, and the choice between the two.

A run without a recording does not import Rerun or the code that draws.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from fgreg.viewer.recording import Viewer


class NullViewer:
    """Takes every call of :class:`fgreg.viewer.recording.Viewer` and does nothing, for runs without a recording."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing to close."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        if name.startswith("_"):
            raise AttributeError(name)
        return _nothing


def _nothing(*_: Any, **__: Any) -> None:
    """Draw nothing."""


def open_viewer(
    rrd: Path | None, session_name: str, url: str | None = None, made_from: Mapping[str, str] | None = None
) -> Viewer | NullViewer:
    """A viewer that records to ``rrd`` and shows in the running viewer at ``url``; the null viewer where both are None.

    ``made_from``: hashes of the session's files.

    Raises:
        InputError: ``rrd`` cannot be written, or is another file.
    """
    if rrd is None and url is None:
        return NullViewer()
    from fgreg.viewer.recording import Viewer

    return Viewer(rrd, session_name, url, made_from)
