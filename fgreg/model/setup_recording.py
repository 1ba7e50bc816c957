"""Lines of a set-up recording: what ``fgreg setup`` finds the signs and constants of probe and stage from.

A recording is a file of JSON lines: ``t`` is the time at which each came to the host, one clock for all. What a line
means is as in ``events.jsonl``; angles are those of the *device*, in degrees.
"""

from dataclasses import dataclass
from typing import Annotated

from fgreg.geometry.transforms import FloatArray
from fgreg.model.events import LATERAL_MM, RANGE_MM, Seconds
from fgreg.schema.kinds import NOT_NEGATIVE, SCAN_DEG, Integer, ListOf, Number, Text
from fgreg.schema.matrices import Transform
from fgreg.schema.problems import FieldError
from fgreg.schema.record import Key, Tagged

_TARGET = Integer(0, 2**31 - 1)
_LENGTH_MM = Number(0.0, 300.0, above=True, unit="mm")
_SIGMA_MM = Number(0.0, 10.0, above=True, unit="mm")
_TOWARDS = ListOf(Text("a direction", ("+x", "-x", "+y", "-y")))


@dataclass(frozen=True, slots=True)
class TargetLine:
    """A target that stands still: a wire parallel to the probe's axis, a bead, or the fibre's tip; what is known of it.

    Without a line of its own a target is one of which nothing is known.
    """

    t: Seconds
    line: int
    target: Annotated[int, Key("its number", _TARGET)]
    depth_mm: Annotated[float | None, Key("measured from the element faces, where that was done", _LENGTH_MM)] = None
    depth_sigma_mm: Annotated[float, Key("how well, 1 sigma", _SIGMA_MM)] = 0.1
    of: Annotated[int | None, Key("another target, which the following compare it with", _TARGET, name="from")] = None
    apart_mm: Annotated[float | None, Key("distance from that one, measured", _LENGTH_MM, requires="from")] = None
    apart_sigma_mm: Annotated[float, Key("how well, 1 sigma", _SIGMA_MM)] = 0.1
    towards: Annotated[
        tuple[str, ...], Key("directions of TRUS in which it lies from that one", _TOWARDS, requires="from")
    ] = ()

    def __post_init__(self) -> None:
        if self.of is None:
            return
        if self.of == self.target:
            raise FieldError.of("the target itself", "another one", "from")
        if len({axis[1] for axis in self.towards}) < len(self.towards):
            raise FieldError.of(", ".join(self.towards), "at most one direction of each axis", "towards")


@dataclass(frozen=True, slots=True)
class MediumLine:
    """The medium of this recording, where it is not what ``probe.sound_speed_m_s`` says: water."""

    t: Seconds
    line: int
    sound_speed_m_s: Annotated[
        float, Key("of the medium: 1482 in water of 20 deg C", Number(500.0, 5000.0, unit="m/s"))
    ]
    sigma_m_s: Annotated[float, Key("how well, 1 sigma", Number(0.0, 500.0, above=True, unit="m/s"))] = 3.0


@dataclass(frozen=True, slots=True)
class PulseLine:
    """A pulse, and where the target was heard; without x and range nothing was."""

    t: Seconds
    line: int
    target: Annotated[int, Key("which target", _TARGET)] = 0
    scan_deg: Annotated[float | None, Key("what the stage reads, where it stands still", SCAN_DEG)] = None
    x_mm: Annotated[float | None, Key("along the axis of rotation", LATERAL_MM)] = None
    range_mm: Annotated[float | None, Key("from the element", RANGE_MM)] = None
    amplitude: Annotated[float | None, Key("in the source's unit", NOT_NEGATIVE)] = None

    def __post_init__(self) -> None:
        if (self.x_mm is None) != (self.range_mm is None):
            raise FieldError.of(
                "nothing", "both x_mm and range_mm, or neither", "x_mm" if self.x_mm is None else "range_mm"
            )


@dataclass(frozen=True, slots=True)
class ReadingLine:
    """A reading of the stage while it turns."""

    t: Seconds
    line: int
    scan_deg: Annotated[float, Key("what the device reads", SCAN_DEG)]


@dataclass(frozen=True, slots=True, eq=False)
class MarkerLine:
    """The marker in a frame of the camera."""

    t: Seconds
    line: int
    camera_T_marker: Annotated[FloatArray, Key("the pose", Transform())]


SetupLine = TargetLine | MediumLine | PulseLine | ReadingLine | MarkerLine
SETUP_LINES = Tagged(
    "type",
    {
        "target": TargetLine,
        "medium": MediumLine,
        "pulse": PulseLine,
        "stage": ReadingLine,
        "marker": MarkerLine,
    },
)
"""A line of a set-up recording."""
