"""Problems of a document, each with its path, and their messages."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import NamedTuple, Self

from fgreg.errors import InputError, one_line

SHOWN_CHARACTERS = 60

Path = tuple[str | int, ...]
"""Keys and list indices from the top of a document."""


class Problem(NamedTuple):
    """One problem; ``meant`` is the known key that an unknown key probably stands for."""

    path: Path
    found: str
    expected: str
    meant: str | None = None

    def __str__(self) -> str:
        place = f"{path_text(self.path)}: " if self.path else ""
        return f"{place}found {self.found}, expected {self.expected}"


class FieldError(ValueError):
    """A value or mapping does not fit its description.

    Attributes:
        problems: all of them, at least one. Paths are relative to the value.
        values: of a mapping, what could be read, by attribute.
    """

    def __init__(self, problems: Iterable[Problem], values: Mapping[str, object] | None = None) -> None:
        self.problems = tuple(problems)
        self.values = dict(values or {})
        super().__init__(
            "; ".join(f"{path_text(p.path)}: found {p.found}, expected {p.expected}" for p in self.problems)
        )

    @classmethod
    def of(cls, found: str, expected: str, *path: str | int) -> Self:
        """One problem, at ``path`` below the value."""
        return cls([Problem(path, found, expected)])

    def below(self, *path: str | int) -> list[Problem]:
        """The problems with ``path``, the place of this value in its parent, put before their paths."""
        return [problem._replace(path=path + problem.path) for problem in self.problems]


def path_text(path: Path) -> str:
    """A path as text for messages: ``marker.tags[1].id``."""
    text = ""
    for step in path:
        if isinstance(step, int):
            text += f"[{step}]"
        else:
            text += ("." if text else "") + one_line(step, SHOWN_CHARACTERS)
    return text


def place_text(path: Path, file: str, root: object = None, line: int | None = None) -> str:
    """A place as text for messages: ``session.yaml: probe.pitch_mm (line 7)``.

    Args:
        path: from the top of the document.
        file: how messages name the file.
        root: the document, whose mappings and lists know their lines (fgreg.session.yaml_loader).
        line: of a file with one document per line, which line; shown first.
    """
    where = path_text(path)
    if line is not None:
        where = f"line {line}: {where}" if where else f"line {line}"
    elif where and (at := _line_of(root, path)) is not None:
        where += f" (line {at})"
    return f"{file}: {where}" if where else file


def input_error(problem: Problem, file: str, root: object = None, line: int | None = None) -> InputError:
    """A problem as an error that names the place as :func:`place_text` does."""
    return InputError(place_text(problem.path, file, root, line), problem.found, problem.expected)


def _line_of(node: object, path: Path) -> int | None:
    """The 1-based line of what a path names; of the nearest thing above it where that is absent."""
    line: int | None = None
    for step in path:
        if isinstance(node, Mapping):
            line = getattr(node, "lines", {}).get(step, line)
            node = node.get(step)
        elif isinstance(node, list) and isinstance(step, int) and step < len(node):
            lines = getattr(node, "lines", None)
            line = lines[step] if lines is not None else line
            node = node[step]
        else:
            break
    return line


def shown(value: object) -> str:
    """A value in at most about sixty characters on one line, as messages show it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return one_line(repr(value[: 2 * SHOWN_CHARACTERS]), SHOWN_CHARACTERS)
    if isinstance(value, Mapping):
        return f"a mapping with {len(value)} keys"
    if isinstance(value, list):
        if len(value) <= 8 and not any(isinstance(entry, list | Mapping) for entry in value):
            text = "[" + ", ".join(shown(entry) for entry in value) + "]"
            if len(text) <= SHOWN_CHARACTERS:
                return text
        return f"a list of {len(value)}"
    return one_line(repr(value), SHOWN_CHARACTERS)


def nearest(word: str, known: Iterable[str]) -> str | None:
    """The known word most similar to a misspelt one; None where none is similar."""
    by_lower = {name.lower(): name for name in known}
    matches = difflib.get_close_matches(word[:80].lower(), list(by_lower), n=1, cutoff=0.7)
    return by_lower[matches[0]] if matches else None


def numbers_text(numbers: Iterable[int]) -> str:
    """Numbers as text, runs of them shortened: ``0 to 4, 7``; ``none`` where there are none."""
    runs: list[list[int]] = []
    for number in sorted(set(numbers)):
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    texts = [str(run[0]) if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs]
    return ", ".join(texts) or "none"
