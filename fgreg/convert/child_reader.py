"""MATLAB and HDF5 files read in a child process, with limits of time and memory.

A damaged file makes the C code of scipy's and HDF5's readers end the process (scipy pull request 25349) or fill the
memory; here that is one more file that cannot be read.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from fgreg.convert import array_files
from fgreg.convert.array_files import ArrayFile
from fgreg.convert.mapping import RecordingMapping
from fgreg.errors import FgregError, InputError, MissingExtraError
from fgreg.schema.limits import ARRAY_MEMORY, ARRAY_SECONDS
from fgreg.workers.worker_process import START_S, WorkerProcess

_Question = tuple[str, tuple[Any, ...]]


def open_array_file(path: Path, mapping: RecordingMapping) -> ArrayFile:
    """As :func:`fgreg.convert.array_files.open_array_file`, read in a child process, which ends with what is returned.

    Raises:
        InputError: as there, or what reads the file has ended, needs too much memory, or takes too long.
        MissingExtraError: what reads it is not installed.
    """
    child = _Child(path, mapping)
    opened: ArrayFile = child.ask("open")
    variables = {
        name: replace(
            variable,
            load=partial(child.ask, "load", name),
            part=partial(child.ask, "part", name) if variable.part is not None else None,
        )
        for name, variable in opened.variables.items()
    }
    frames = opened.frames
    return ArrayFile(variables, None if frames is None else replace(frames, read=partial(child.ask, "frame")))


class _Child:
    """The process; it ends when nothing refers to this object."""

    def __init__(self, path: Path, mapping: RecordingMapping) -> None:
        self._name = path.name
        self._worker: WorkerProcess[_Question, Any] = WorkerProcess(
            _reader,
            path,
            mapping,
            name="fgreg reader",
            what="its reader",
            niceness=0,
            answer_s=ARRAY_SECONDS,
            restart=False,
        )
        weakref.finalize(self, self._worker.close)

    def ask(self, what: str, *arguments: Any) -> Any:
        """The answer to a question. Raises what reading raised."""
        self._worker.send((what, arguments))
        reply = self._worker.fetch(START_S + ARRAY_SECONDS)
        if reply is None or reply[0] is None:
            words = (self._worker.failure or "no answer")[:160]
            raise InputError(self._name, f"a file that cannot be read ({words})", "a whole one")
        answer = reply[0][0]
        if isinstance(answer, FgregError):
            raise answer
        return answer


def _reader(path: Path, mapping: RecordingMapping) -> Callable[[_Question], tuple[Any]]:
    """In the child: limits its memory, keeps what libraries say off standard error, and gives what answers."""
    import resource
    import warnings

    resource.setrlimit(resource.RLIMIT_AS, (ARRAY_MEMORY, ARRAY_MEMORY))
    warnings.simplefilter("ignore")
    with Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    opened: list[ArrayFile] = []

    def answer(question: _Question) -> tuple[Any]:
        what, arguments = question
        try:
            if what == "open":
                opened.append(array_files.open_array_file(path, mapping))
                return (_described(opened[0]),)
            if what == "frame":
                frames = opened[0].frames
                return (None if frames is None else frames.read(*arguments),)
            variable = opened[0].variables[arguments[0]]
            return (variable.load() if what == "load" or variable.part is None else variable.part(*arguments[1:]),)
        except (InputError, MissingExtraError) as error:
            return (error,)

    return answer


def _described(opened: ArrayFile) -> ArrayFile:
    """Without what can only be called in the child."""
    variables = {
        name: replace(variable, load=_in_the_child, part=None if variable.part is None else _in_the_child)
        for name, variable in opened.variables.items()
    }
    frames = opened.frames
    return ArrayFile(variables, None if frames is None else replace(frames, read=_in_the_child))


def _in_the_child(*_: Any) -> Any:
    raise AssertionError("read in the child")
