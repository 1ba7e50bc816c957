"""Ground truth of a session, from simulation or a measured phantom."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from fgreg.geometry.transforms import FloatArray
from fgreg.schema.kinds import POINT_MM, SCAN_DEG, SECONDS, JsonSchema, Kind, ListOf, in_radians
from fgreg.schema.matrices import Transform
from fgreg.schema.problems import FieldError, Problem, shown
from fgreg.schema.record import Key, record

_NUMBER = re.compile(r"0|[1-9][0-9]{0,9}")


@dataclass(frozen=True, slots=True)
class ByPm(Kind):
    """A mapping from PMs' numbers, texts in YAML, to values of one kind."""

    each: Kind

    def read(self, value: object, folder: Path | None = None, /) -> dict[int, Any]:
        if not isinstance(value, Mapping):
            raise FieldError.of(shown(value), self.expected)
        out: dict[int, Any] = {}
        problems: list[Problem] = []
        for key, entry in value.items():
            if key.startswith("x_"):
                continue
            if not _NUMBER.fullmatch(key):
                problems.append(Problem((key,), f"the PM {shown(key)}", "its number, an integer >= 0"))
                continue
            try:
                out[int(key)] = self.each.read(entry, folder)
            except FieldError as error:
                problems += error.below(key)
        if problems:
            raise FieldError(problems)
        return out

    def write(self, value: Mapping[int, Any], folder: Path | None = None, /) -> dict[int, Any]:
        return {pm: self.each.write(entry, folder) for pm, entry in value.items()}

    @property
    def expected(self) -> str:
        return f"a mapping from PMs' numbers to {self.each.expected}"

    def json_schema(self, definitions: dict[str, JsonSchema], /) -> JsonSchema:
        numbers = {f"^({_NUMBER.pattern})$": self.each.json_schema(definitions), "^x_": {}}
        return {"type": "object", "patternProperties": numbers, "additionalProperties": False}


@dataclass(frozen=True, slots=True)
class TrackTruth:
    """True stage angle of a track event."""

    t: Annotated[float, Key("of the track event, s", SECONDS)]
    stage_rad: Annotated[
        float, Key("device angle at which the image plane passes through the beam's PM", in_radians(SCAN_DEG))
    ]


@dataclass(frozen=True, slots=True, eq=False)
class GroundTruth:
    """Contents of ``ground_truth.yaml``; absent values are empty or None."""

    trus_T_camera: Annotated[
        tuple[FloatArray, ...],
        Key("one for each camera epoch", ListOf(Transform(), "a list of 4x4 transforms, one for each epoch")),
    ] = ()
    marker_T_laser: Annotated[FloatArray | None, Key("the beam on the marker", Transform())] = None
    trus_p_pm_mm: Annotated[Mapping[int, FloatArray], Key("TRUS points, by `pm`", ByPm(POINT_MM), name="pms")] = field(
        default_factory=dict
    )
    tracks: Annotated[
        tuple[TrackTruth, ...], Key("answers to track events", ListOf(record(TrackTruth), empty=True))
    ] = ()


GROUND_TRUTH = record(GroundTruth)
"""``ground_truth.yaml``."""
