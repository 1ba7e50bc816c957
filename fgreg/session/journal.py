"""The journal of a session while it is recorded: every event is on disk before it is acknowledged.

:func:`fgreg.session.session_reader.read_session` reads back exactly what is written: each line is checked with the same
code before it is written, and :meth:`Journal.append` returns the event as it was read. Use that event, so that a
session that is opened again continues from the same numbers.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from itertools import chain, count
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Self

from fgreg.errors import InputError, JournalError
from fgreg.model.events import Event, StageEvent, TrackEvent
from fgreg.model.session_model import SessionModel
from fgreg.output.atomic_file import FileKind, write_file
from fgreg.output.session_folder import CUT_SUFFIX
from fgreg.session.append_only_file import AppendFile, sync_path
from fgreg.session.event_reader import ShotsSeen, frames_of, read_line
from fgreg.session.event_writer import event_document, event_line, type_of
from fgreg.session.frame_files import check_frames
from fgreg.session.session_reader import EVENTS_FILE, SETUP_FILE, Session, read_session, session_place
from fgreg.session.setup_reader import Setup, read_setup
from fgreg.session.yaml_loader import load_yaml

_CUT_OFF = FileKind("what was cut off", ())
"""Never replaced: each has a name of its own."""


@dataclass(frozen=True, slots=True, eq=False)
class Appended:
    """An event that is on disk: the offset of its line, and the event as read back."""

    offset: int
    event: Event


class Journal:
    """An open session, locked against other recorders. Use as a context manager, or close it.

    Attributes:
        folder: the session's, resolved.
        model: of the session.
        warnings: of reading, and about a truncated last line that was cut off.
    """

    def __init__(
        self, folder: Path, model: SessionModel, setup: Setup, file: AppendFile, recorded: Session, warnings: list[str]
    ) -> None:
        self.folder, self.model, self.warnings = folder, model, tuple(warnings)
        self._setup, self._file = setup, file
        self._events = [event for event in recorded.events if not isinstance(event, StageEvent | TrackEvent)]
        self._seen = ShotsSeen()
        for event in recorded.events:
            self._seen.add(event)
        self._lock = Lock()

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Open a session to record to it; an absent ``events.jsonl`` is created.

        A last line that is only the beginning of one (power was lost during the write) is moved to a file of its own
        with a warning: it was never acknowledged. A complete last line without line break gets one.

        Raises:
            InputError: the session's files are invalid, as the reader finds them; they are unchanged.
            JournalError: another program records to it, or the disk fails.
        """
        resolved = session_place(folder)
        setup = _setup(resolved)
        file = AppendFile.open(resolved / EVENTS_FILE, EVENTS_FILE)
        try:
            recorded = read_session(resolved)
            warnings = [text for text in recorded.warnings if text != recorded.cut_short]
            return cls(resolved, recorded.model, setup, file, recorded, [*_mend_tail(file, recorded), *warnings])
        except BaseException:
            file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def last_t(self) -> float | None:
        """Time of the last event, s; None where there is none."""
        return None if self._seen.last is None else self._seen.last[0]

    @property
    def lines(self) -> int:
        """Events on disk."""
        return 0 if self._seen.last is None else self._seen.last[1]

    @property
    def events(self) -> tuple[Event, ...]:
        """The recorded events, without the stage's and queries: they are many, and no estimate depends on them."""
        return tuple(self._events)

    def append(self, event: Event, *, durable: bool = True, late: bool = False) -> Appended:
        """Append an event to the file and flush it to disk; its ``line`` is set here.

        The frames that it names must exist: they are checked and flushed to disk first.

        Args:
            durable: on disk when this returns; False: with the next durable event (for events that no estimate uses).
            late: an event older than the last one gets the last one's time, since times must not decrease.

        Raises:
            InputError: its time decreases, a number is not finite, or it is otherwise invalid.
            JournalError: the disk fails; nothing is recorded, and the file is unchanged.
        """
        with self._lock:
            if late and self.last_t is not None and event.t < self.last_t:
                event = replace(event, t=self.last_t)
            number = self.lines + 1
            place = f"{type_of(event)} event"
            line = event_line(event_document(event, self.folder), place)
            read = read_line(line, number, place, self.folder, self._setup, self._seen)
            if read.event is None:
                raise read.problems[0]
            frames = [*frames_of(read.event, place, self.folder)]
            camera, probe = self._setup.camera, self._setup.probe
            size = None if camera is None else camera.left.image_size
            if problems := check_frames(frames, probe, size):
                raise problems[0]
            self._sync_frames({use.path for use in frames})
            offset = self._file.append(line, durable=durable)
            self._seen.add(read.event)
            if not isinstance(read.event, StageEvent | TrackEvent):
                self._events.append(read.event)
            return Appended(offset, read.event)

    def _sync_frames(self, frames: set[Path]) -> None:
        """Flush frames and their folders to disk: other programs may have written them without a flush."""
        try:
            for path in [*sorted(frames), *sorted({path.parent for path in frames})]:
                sync_path(path)
        except OSError as error:
            raise JournalError(path.name, f"the frame is not on disk ({error.strerror})", "mend that first") from None

    def close(self) -> None:
        """Unlock the session; may be called twice."""
        self._file.close()


def _setup(folder: Path) -> Setup:
    """The session's set-up, read before any file is created in its folder."""
    problems: list[InputError] = []
    data = load_yaml(folder / SETUP_FILE, SETUP_FILE)
    setup = read_setup(data, SETUP_FILE, folder.name or "session", problems, folder)
    if problems:
        raise problems[0]
    return setup


def _mend_tail(file: AppendFile, recorded: Session) -> list[str]:
    """Cut off a last line that is only the beginning of one, or end a whole one; returns warnings.

    The whole file was read: this changes nothing but the last line. What is cut off is kept in a file of its own.

    Raises:
        InputError, JournalError: the system refuses, and nothing is changed.
    """
    tail = file.tail()
    if not tail:
        return []
    if not recorded.cut_short:
        file.append(b"\n")
        return []
    place = recorded.folder / f"{EVENTS_FILE}{CUT_SUFFIX}"
    names = (place.with_name(f"{place.name}-{number}") for number in count(2))
    free = next(path for path in chain([place], names) if not os.path.lexists(path))
    write_file(free, tail, _CUT_OFF)
    file.cut(file.size - len(tail))
    return [f"{EVENTS_FILE}: the last line was cut short; its {len(tail)} bytes are kept in {free.name}"]
