"""A link to the stage that reconnects by itself after its watchdog was killed, hung or failed.

    stage = ReconnectingStage(lambda: StageLink.open(...))
    while running:
        reports = stage.poll()          # raises StageLost as long as there is no link
        if stage.link is not None: stage.link.beat(...)

The loop never waits: a thread ends the lost watchdog and starts a new one. The new watchdog's first order to the stage
is a stop, and it is latched before it is used, so that nothing moves until the operator's reset.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType

from fgreg.errors import one_line
from fgreg.stage.client import CLOSE_S, Report, StageLink, StageView
from fgreg.stage.interface import StageLost

RETRY_S = 1.0
"""Time between attempts to start a watchdog."""
GRACE_S = 0.15
"""Time before a lost watchdog is killed; one that still works has stopped its stage by then."""


class ReconnectingStage:
    """Keeps one link to a stage open. Use it as a context manager, or close it.

    Args:
        open_link: opens a link; may take long.

    Attributes:
        link: the current link; None while there is none.

    Raises:
        StageError: the first link could not be opened.
    """

    def __init__(self, open_link: Callable[[], StageLink]) -> None:
        self._open = open_link
        self.link: StageLink | None = open_link()
        self._reason = ""
        self._ending = threading.Event()
        self._fresh: StageLink | None = None
        self._renewal: threading.Thread | None = None

    @property
    def view(self) -> StageView | None:
        """The newest status; None while there is no link."""
        return None if self.link is None else self.link.view

    def poll(self) -> list[Report]:
        """As :meth:`StageLink.poll`.

        Raises:
            StageLost: there is no link, with the reason; a new one is being opened.
        """
        if self.link is None and self._renewal is not None and not self._renewal.is_alive():
            self.link, self._fresh, self._renewal = self._fresh, None, None
        if self.link is None:
            raise StageLost(self._reason)
        try:
            return self.link.poll()
        except StageLost as error:
            gone, self.link, self._reason = self.link, None, str(error)
            self._renewal = threading.Thread(target=self._renew, args=(gone, str(error)), name="stage", daemon=True)
            self._renewal.start()
            raise

    def _renew(self, gone: StageLink, reason: str) -> None:
        """End a lost watchdog, which may hold the device, and start a new one."""
        gone.abandon(GRACE_S)
        while not self._ending.is_set():
            try:
                fresh = self._open()
                fresh.latch(reason)
            except Exception as error:  # any error of driver, process or system: try again
                self._reason = one_line(str(error), 300)
                self._ending.wait(RETRY_S)
            else:
                self._fresh = fresh
                break
        if self._ending.is_set() and self._fresh is not None:
            self._fresh.close()

    def close(self) -> None:
        """Close the link, which stops the stage. May be called twice."""
        self._ending.set()
        link, self.link = self.link, None
        if link is not None:
            link.close()
        if self._renewal is not None:
            self._renewal.join(CLOSE_S)  # if it still waits for a driver, it closes the link itself
            self._renewal = None

    def __enter__(self) -> ReconnectingStage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.link is not None:
            self.link.__exit__(kind, error, trace)
        self.close()
