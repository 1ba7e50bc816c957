"""Tags fixed to the patient or the table: while the camera stands still they stay where they are in its pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

from fgreg.schema.kinds import POSITIVE_MM, Integer
from fgreg.schema.problems import FieldError
from fgreg.schema.record import Key

LARGEST_ID = 2319
"""Of any dictionary."""


@dataclass(frozen=True, slots=True)
class StaticTag:
    """One static tag; where it is is learnt from the pictures."""

    id: Annotated[int, Key("in the marker's dictionary", Integer(0, LARGEST_ID))]
    size_mm: Annotated[float, Key("outer edge of the black border", POSITIVE_MM)]


def check_static_tags(tags: Sequence[StaticTag], taken: Mapping[int, str], largest_id: int) -> None:
    """Raises FieldError where static tags cannot be told from each other, or from other tags.

    ``taken``: ids of other tags, with whose they are. ``largest_id``: of the dictionary.
    """
    taken = dict(taken)
    for place, tag in enumerate(tags):
        if tag.id > largest_id:
            raise FieldError.of(str(tag.id), f"an integer from 0 to {largest_id}", "static_tags", place, "id")
        if tag.id in taken:
            raise FieldError.of(f"{tag.id}, {taken[tag.id]}", "an id of its own", "static_tags", place, "id")
        taken[tag.id] = "a static tag before it"
