"""Standard output and error of a command: a reader that has gone away is no error, and libraries do not write there.

C libraries write to file descriptor 2 at any time and from any thread: libpng and libjpeg about a picture, OpenCV and
FFMPEG their logs. So Python's standard error gets a descriptor of its own, and descriptor 2 leads nowhere from then on,
also in the processes that the command starts (their errors reach the command over their connections). What matters of
such messages is found out where the library is called. ``FGREG_DEBUG=1`` leaves everything visible.
"""

from __future__ import annotations

import faulthandler
import io
import os
import sys
import traceback
import warnings
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

DEBUG = "FGREG_DEBUG"


class _Output(io.FileIO):
    """A file descriptor for writing; once its reader has gone away, what is written is dropped.

    Raises:
        OSError: another failure of standard output, once; after it, too, what is written is dropped. One of standard
            error cannot be told anywhere.
    """

    def write(self, data: ReadableBuffer, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            _lead_nowhere(self.fileno())
            if self.fileno() == 1 and not isinstance(error, BrokenPipeError):
                raise OSError(error.errno, error.strerror, "standard output") from None
            return memoryview(data).nbytes


def take_streams() -> None:
    """Prepare the streams of a command's process. Streams that another program has put in place are left alone."""
    for descriptor, stream in ((1, sys.stdout), (2, sys.stderr)):
        if stream is None:  # the caller has closed it: a file that is opened later must not take its place
            _lead_nowhere(descriptor)
    if sys.stdout is sys.__stdout__:
        sys.stdout = _text(1, sys.stdout)
    if sys.stderr is not sys.__stderr__:
        return
    debug = bool(os.environ.get(DEBUG))
    sys.stderr = _text(2 if debug else os.dup(2), sys.stderr)
    faulthandler.enable(sys.stderr)  # a library that ends the process by a signal leaves at least its caller's place
    if debug:
        return
    _lead_nowhere(2)
    if not sys.warnoptions:
        # Numbers that overflow are found where they are used. Processes started from here read the variable.
        warnings.simplefilter("ignore")
        os.environ["PYTHONWARNINGS"] = "ignore"


def _lead_nowhere(descriptor: int) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    if nowhere != descriptor:
        os.dup2(nowhere, descriptor)
        os.close(nowhere)


def _text(descriptor: int, like: TextIO | None) -> TextIO:
    """A text stream on a descriptor, with the encoding of another one, or to nowhere."""
    output = io.BufferedWriter(_Output(descriptor, "w", closefd=False))
    if like is None:
        return io.TextIOWrapper(output, encoding="utf-8")
    like.flush()
    lines = descriptor != 1 or like.isatty()
    return io.TextIOWrapper(output, encoding=like.encoding, errors=like.errors, line_buffering=lines)


def print_crash(error: BaseException) -> None:
    """The traceback of a defect, then one line about it."""
    traceback.print_exception(error)
    words = " ".join(f"{type(error).__name__}: {error}".split())[:300].rstrip(":")
    sys.stderr.write(
        f"fgreg: crash: {words}; this is a defect of fgreg: please report it with the lines above"
        f" ({DEBUG}=1 shows also what libraries print)\n"
    )
