"""What to print, from session.yaml or from the options of a command; errors name the key or the option."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fgreg.detection.tags import tag_cells
from fgreg.errors import InputError
from fgreg.model.session_model import DICTIONARY, DICTIONARY_SIZES, BoardModel, MarkerModel
from fgreg.printing.bodies import FEWEST_SIDES, apothem_for, check_printable, plate, prism, side_mm
from fgreg.printing.pieces import quiet_zone
from fgreg.schema.kinds import NOISE_MM, POSITIVE_MM, Kind
from fgreg.schema.problems import FieldError, input_error
from fgreg.schema.record import record
from fgreg.session.yaml_loader import load_yaml

SECTIONS = {"marker": record(MarkerModel), "board": record(BoardModel)}
"""Sections of session.yaml that can be printed."""
PAPER_MM = 0.1
"""Thickness of paper of 80 g/m2."""


def section_of(setup: Path, name: str) -> Any:
    """The section ``marker`` or ``board`` of a session.yaml, or of that in a folder; its others may be absent.

    Raises:
        InputError: it is absent or wrong.
    """
    file = setup / "session.yaml" if setup.is_dir() else setup
    data = load_yaml(file, str(file))
    if name not in data:
        raise InputError(f"{file}: {name}", "nothing", f"the {name} to print")
    try:
        part = SECTIONS[name].read(data[name])
        if isinstance(part, MarkerModel):
            check_printable(part)
    except FieldError as error:
        raise input_error(error.below(name)[0], str(file), data) from None
    return part


def checked(option: str, kind: Kind, value: object) -> Any:
    """An option's value, by the kind of the key that it stands for.

    Raises:
        InputError: not one of these.
    """
    try:
        return kind.read(value)
    except FieldError as error:
        raise InputError(option, error.problems[0].found, error.problems[0].expected) from None


def tag_ids(text: str, dictionary: str) -> list[int]:
    """Ids of ``0,2,4-6``, each once.

    Raises:
        InputError: not so, or not in the dictionary.
    """
    last = DICTIONARY_SIZES[dictionary] - 1
    ids: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"\s*(\d{1,4})\s*(?:-\s*(\d{1,4})\s*)?", part, re.ASCII)
        first, end = (int(found[1]), int(found[2] or found[1])) if found else (0, -1)
        if not first <= end <= last:
            raise InputError("--id", f"'{text[:40]}'", f"ids of {dictionary}, 0 to {last}, such as 0 or 0,2,4-6")
        ids += range(first, end + 1)
    if len(set(ids)) < len(ids):
        raise InputError("--id", f"'{text[:40]}'", "each id once")
    return ids


def flat_marker(dictionary: str, ids: Sequence[int], size_mm: float, quiet_mm: float | None) -> MarkerModel:
    """A body of one tag, or of several side by side on a plate."""
    return plate(dictionary, ids, size_mm, size_mm + 2 * quiet_zone(dictionary, size_mm, quiet_mm))


def rod_marker(
    dictionary: str,
    ids: Sequence[int],
    size_mm: float | None,
    quiet_mm: float | None,
    rod_mm: float,
    thickness_mm: float,
) -> MarkerModel:
    """A prism around a rod, a tag on each side.

    Args:
        size_mm: of the tags; None: the largest that fits, to 0.1 mm.
        rod_mm: diameter of the rod, which the sides' middles touch.
        thickness_mm: of the paper with its glue.

    Raises:
        InputError: too few tags, or tags that do not fit.
    """
    sides = len(ids)
    if sides < FEWEST_SIDES:
        raise InputError("--id", f"{sides} of them around a rod", f"{FEWEST_SIDES} or more, one for each side")
    apothem = rod_mm / 2 + thickness_mm
    side = side_mm(apothem, sides)
    if size_mm is None:
        most = side - 2 * quiet_mm if quiet_mm is not None else side / (1 + 2 / tag_cells(dictionary))
        size_mm = math.floor(10 * most + 1e-6) / 10
        if size_mm <= 0:
            raise InputError("--rod-mm", f"{rod_mm:g}, whose {sides} sides are {side:.2f} mm wide", "a thicker one")
    quiet = quiet_zone(dictionary, size_mm, quiet_mm)
    if side < size_mm + 2 * quiet - 1e-9:
        least = math.ceil(10 * 2 * (apothem_for(size_mm + 2 * quiet, sides) - thickness_mm)) / 10
        found = f"{rod_mm:g}, whose {sides} sides are {side:.2f} mm wide"
        raise InputError(
            "--rod-mm", found, f"at least {least:g} for tags of {size_mm:g} mm with {quiet:.2f} mm of white"
        )
    return prism(dictionary, ids, size_mm, apothem)


def marker_of(dictionary: str | None, given: Mapping[str, object], quiet_mm: float | None) -> MarkerModel:
    """A marker body by the values of options; None where an option is not given.

    Raises:
        InputError: a value is absent or wrong.
    """
    if dictionary is None:
        raise InputError("--dictionary", "nothing", DICTIONARY.expected)
    name = checked("--dictionary", DICTIONARY, dictionary)
    values = {
        option: None if given[option] is None else checked(option, kind, given[option])
        for option, kind in (("--size-mm", POSITIVE_MM), ("--rod-mm", POSITIVE_MM), ("--thickness-mm", NOISE_MM))
    }
    size, rod, thickness = values.values()
    if given["--id"] is None:
        raise InputError("--id", "nothing", "the tag's id, such as 0, or several, such as 0-5")
    ids = tag_ids(str(given["--id"]), name)
    if rod is not None:
        return rod_marker(name, ids, size, quiet_mm, rod, PAPER_MM if thickness is None else thickness)
    if thickness is not None:
        raise InputError("--thickness-mm", "it alone", "it with --rod-mm")
    if size is None:
        raise InputError("--size-mm", "nothing", f"{POSITIVE_MM.expected}: the outer edge of a tag's black border")
    return flat_marker(name, ids, size, quiet_mm)


def board_of(dictionary: str | None, given: Mapping[str, object]) -> BoardModel:
    """A board by the values of options; None where an option is not given. Without dictionary: a plain chessboard.

    Raises:
        InputError: a value is absent or wrong.
    """
    options = {**given, "--dictionary": dictionary}
    keys = {option.removeprefix("--").replace("-", "_"): option for option, value in options.items()}
    values = {key: options[option] for key, option in keys.items() if options[option] is not None}
    charuco = {key: values.pop(key) for key in ("dictionary", "marker_mm", "legacy") if key in values}
    try:
        board: BoardModel = SECTIONS["board"].read({**values, "charuco": charuco} if charuco else values)
    except FieldError as error:
        problem = error.problems[0]
        names = [keys[step] for step in problem.path if step in keys]
        raise InputError(names[-1] if names else "the board", problem.found, problem.expected) from None
    return board
