"""What ``fgreg live`` shows: on a terminal one page that owns it, else a line for every new message."""

from __future__ import annotations

import textwrap
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from fgreg.cli.terminal_mode import UneditedTerminal
from fgreg.drivers.operator_words import spelt
from fgreg.errors import one_line

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from fgreg.live.status import Figures, Status
    from fgreg.model.session_model import StageModel

SHOW_S = 0.25
SLOW_MS = 250.0
"""Latency from a frame to its angle above which the stage lags behind and its watchdog may miss the heartbeat."""
MOST_REASONS, REASON_WIDTH = 2, 170
"""Limits of the verdict's reasons on the page, which must fit a small terminal."""
MOST_MESSAGES = 4
EVERY_ROW = 0
"""Rank of the rows that are always shown. Where the terminal is too small those of the highest rank go first."""


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the page."""

    title: str
    text: str
    style: str = ""
    rank: int = EVERY_ROW


class LiveDisplay:
    """Shows a live session. Enter it before the session starts; what is said before and after is printed as a line.

    Args:
        silent: show nothing.
        console: to print to; default: standard output.
    """

    def __init__(self, silent: bool = False, console: Console | None = None) -> None:
        from rich.console import Console

        self._console = console or Console(highlight=False, emoji=False)
        self._silent, self._paged = silent, not silent and self._console.is_terminal
        self._lock = threading.Lock()
        self._messages: deque[tuple[str, str]] = deque(maxlen=MOST_MESSAGES)  # clock, text
        self._status: tuple[Figures, StageModel, Status] | None = None
        self._told, self._shown_s = "", float("-inf")
        self._typed: str | None = None
        self._live: Any = None
        self._stack = ExitStack()
        self._terminal = UneditedTerminal()

    @property
    def typing(self) -> Callable[[str], None] | None:
        """Shows what is being typed; None where the terminal does that itself."""
        return self._type if self._paged else None

    def say(self, text: str, *, lasting: bool = False) -> None:
        """Show one line; from any thread. ``lasting``: it stays on the terminal after the session."""
        if self._silent:
            return
        if self._live is None or lasting:
            self._console.print(text, style="dim", markup=False, soft_wrap=True)
        else:
            with self._lock:
                self._messages.append((time.strftime("%H:%M:%S"), text))

    def show(self, figures: Figures, stage: StageModel, status: Status) -> None:
        """Show the session's status."""
        if self._silent:
            return
        if self._live is None:
            if status.text != self._told:
                self._told = status.text
                self._console.print(status_line(status), soft_wrap=True, markup=False)
            return
        with self._lock:
            if status.text and status.text != self._told:
                self._told = status.text
                if all(text != status.text for _, text in self._messages):  # else the keyboard's driver has said it
                    self._messages.append((time.strftime("%H:%M:%S"), status.text))
            if status.now_s - self._shown_s > SHOW_S:
                self._shown_s, self._status = status.now_s, (figures, stage, status)

    def _type(self, text: str) -> None:
        with self._lock:
            self._typed = text
        if self._live is not None:
            self._live.refresh()

    def _page(self) -> RenderableType:
        self._terminal.keep()
        with self._lock:
            status, messages, typed = self._status, tuple(self._messages), self._typed
        rows = [] if status is None else status_rows(*status)
        return page([*rows, *word_rows(None if status is None else status[2], messages, typed)], self._console)

    def __enter__(self) -> Self:
        if self._paged:
            from rich.live import Live

            self._stack.enter_context(self._terminal)
            live = Live(
                get_renderable=self._page,
                console=self._console,
                refresh_per_second=1.0 / SHOW_S,
                transient=True,
                vertical_overflow="crop",
            )
            self._stack.callback(setattr, self, "_live", None)
            self._live = self._stack.enter_context(live)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()


def status_line(status: Status) -> str:
    """One line: phase, estimate, last message."""
    known = status.recorder.registration
    lost = f"  lost: {', '.join(status.lost)}" if status.lost else ""
    verdict = status.verdict.value if known.registered else "no registration"
    state = f"epoch {known.epoch}, {known.pairs} inlier looks, {verdict}"
    return f"{status.stage:<11} {state:<36} {status.text}{lost}"


def status_rows(figures: Figures, stage: StageModel, status: Status) -> list[Row]:
    """The session's status, with the most important rows first, as in the viewer."""
    from fgreg.cli.report import STYLES
    from fgreg.live.viewer_feed import now_of
    from fgreg.viewer.status_line import error_line, next_line, stage_line

    state, now = status.recorder, now_of(status, stage)
    known, estimate = state.registration, state.estimate
    rows = []
    if known.registered:
        rows.append(Row("registration", status.verdict.value.upper(), STYLES[status.verdict]))
        tre = None if estimate is None or status.invalid else estimate.predicted_tre
        rows.append(Row("predicted error", f"{error_line(tre)} (95 % bound, worst target)", rank=1))
    else:
        rows.append(Row("registration", "none yet"))
    rows += [
        Row("", textwrap.shorten(reason, REASON_WIDTH, placeholder=" ..."), rank=4)
        for reason in status.reasons[:MOST_REASONS]
    ]
    if status.lost:
        rows.append(Row("LOST", ", ".join(status.lost), "bold white on red"))
    if state.trouble:
        rows.append(Row("trouble", state.trouble, "red", 2))
    rows.append(Row("next", next_line(now), "bold"))
    rows.append(Row("stage", stage_line(now, stage), rank=1))
    rows.append(Row("session", f"{status.stage}, camera epoch {known.epoch}, {known.pairs} inlier looks in it", rank=5))
    latency = f", {figures.latency_ms[-1]:.0f} ms" if figures.latency_ms else ""
    slow = bool(figures.latency_ms) and figures.latency_ms[-1] > SLOW_MS
    seen = f"{figures.frames} frames, {figures.skipped} skipped, marker in {figures.found}{latency}"
    if slow:
        rows.append(Row("camera", f"{seen}: this machine cannot keep up", "yellow", 2))
    else:
        rows.append(Row("camera", seen, rank=6))
    if figures.pictures:
        rows.append(Row("B-mode", f"{figures.pictures} pictures, {figures.unshown} left out for newer ones", rank=8))
    recorded = f"{state.aims} aims, {state.pairs} looks, {state.refused} refused, {state.waiting} waiting"
    rows.append(Row("recorded", recorded, rank=7))
    return rows


def word_rows(status: Status | None, messages: tuple[tuple[str, str], ...], typed: str | None) -> list[Row]:
    """What was said to the operator and by the operator; ``typed``: None without a keyboard."""
    rows = [
        Row(clock, one_line(text, 300), "dim" if age > 1 else "", age)
        for age, (clock, text) in zip(range(len(messages), 0, -1), messages, strict=True)
    ]
    if status is not None and status.heard:
        rows.append(Row("heard", status.heard, rank=3))
    if status is not None and status.refused:
        rows.append(Row("refused", status.refused, "yellow", 1))
    if typed is not None:
        if status is not None:
            rows.append(Row("you can say", ", ".join(map(spelt, status.words))))
        rows.append(Row("your word", f"{typed}_", "bold"))
    return rows


def page(rows: list[Row], console: Console) -> RenderableType:
    """The rows in a frame, as many as fit the terminal."""
    from rich.panel import Panel
    from rich.table import Table
    from rich.text import Text

    shown = list(rows)
    while True:
        table = Table.grid(padding=(0, 2))
        table.add_column(no_wrap=True)
        table.add_column(overflow="fold")
        for row in shown:
            table.add_row(row.title, Text(row.text, style=row.style))  # messages of devices are not markup
        framed = Panel(table, title="fgreg live", subtitle="Ctrl-C ends the session", expand=True)
        last = max((row.rank for row in shown), default=EVERY_ROW)
        if last == EVERY_ROW or len(console.render_lines(framed)) < console.height:
            return framed
        shown.remove(next(row for row in reversed(shown) if row.rank == last))
