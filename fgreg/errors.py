"""Errors that a user can cause and mend; everything else is a defect and keeps its traceback."""

from __future__ import annotations

LONGEST_PART = 600
"""Characters of the place of an error, of what was found, and of what was expected: more is not read."""


def one_line(text: str, limit: int | None = None) -> str:
    """``text`` with line breaks, control characters and lone surrogates escaped, cut to ``limit`` characters."""
    if limit is not None:
        text = text[: limit + 1]
    if not text.isprintable():
        text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return text if limit is None or len(text) <= limit else text[: limit - 3] + "..."


class FgregError(Exception):
    """Base of all known errors; the command line prints it as one line and exits with 2."""


class InputError(FgregError):
    """Bad input: names the place, what was found there and what was expected. Its text is always one line.

    Args:
        where: file and key or line, e.g. ``session.yaml: probe.radius_mm`` or ``events.jsonl: line 7: trus.x_mm``.
        found: what was found, in a few words.
        expected: what would have been right.
    """

    def __init__(self, where: str, found: str, expected: str) -> None:
        self.where = one_line(where, LONGEST_PART)
        self.found = one_line(found, LONGEST_PART)
        self.expected = one_line(expected, LONGEST_PART)
        super().__init__(f"{self.where}: found {self.found}, expected {self.expected}")

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        return InputError, (self.where, self.found, self.expected)


class MissingExtraError(FgregError):
    """An optional dependency is not installed; names the extra that brings it."""

    def __init__(self, package: str, extra: str) -> None:
        self.package, self.extra = package, extra
        super().__init__(f"{package} is not installed; install it with: pip install 'fgreg[{extra}]'")

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str]]:
        return MissingExtraError, (self.package, self.extra)


class EstimationError(FgregError):
    """The estimate could not be formed from these measurements (not a defect of the file)."""


class EventRefused(FgregError):  # noqa: N818
    """An event that was not taken in; the state is what it was before, and later events work.

    Args:
        reason: in one line, what was wrong with it or what failed.
    """

    def __init__(self, reason: str) -> None:
        self.reason = one_line(reason, 500)
        super().__init__(f"event refused: {self.reason}")


class JournalError(FgregError):
    """An event or a frame could not be put on disk: it is not recorded, and what was recorded before is whole.

    Args:
        where: the file.
        found: what happened.
        remedy: what to do about it.
    """

    def __init__(self, where: str, found: str, remedy: str) -> None:
        self.where = one_line(where)
        self.found = one_line(found)
        self.remedy = one_line(remedy)
        super().__init__(f"{self.where}: {self.found}; {self.remedy}")
