"""Reads set-up recordings: one JSON object per line, described by fgreg.model.setup_recording."""

from __future__ import annotations

from pathlib import Path

from fgreg.errors import InputError
from fgreg.model.setup_recording import SETUP_LINES, SetupLine
from fgreg.schema.problems import FieldError, input_error
from fgreg.session.event_reader import CutShortError, lines_of, parse_line, time_of
from fgreg.session.yaml_loader import open_file


def read_recording(path: Path) -> tuple[SetupLine, ...]:
    """The lines of a recording; a last one that is cut short is dropped.

    Raises:
        InputError: the first problem, with its line.
    """
    out: list[SetupLine] = []
    problems: list[InputError] = []
    last: tuple[float, int] | None = None
    with open_file(path, str(path)) as stream:
        for number, line in lines_of(stream, str(path), problems):
            try:
                document = parse_line(line)
                t, late = time_of(document, last)
                if late:
                    raise FieldError(late)
                out.append(SETUP_LINES.read(document, None, line=number))
            except CutShortError:
                break
            except FieldError as error:
                raise input_error(error.problems[0], str(path), line=number) from None
            if t is not None:
                last = (t, number)
    if problems:
        raise problems[0]
    return tuple(out)
