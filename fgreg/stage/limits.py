"""Kinds of motion and their limits, from the session and the configuration."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Annotated, Any, Self

from fgreg.model.session_model import StageModel
from fgreg.schema.kinds import SCAN_DEG, Number, NumberTuple, in_radians
from fgreg.schema.problems import FieldError, shown
from fgreg.schema.record import Key, Section, record
from fgreg.stage.interface import MAX_CALL_S

_SPEED = Number(0.0, 30.0, above=True, unit="deg/s", degrees=True)


class MotionKind(StrEnum):
    """Purpose of a motion. Each kind needs its own request by the operator; none ever becomes another.

    ``home``: to the zero position. Needs limits, speed, heartbeat, request.
    ``search``: a step of a sweep or its refinement. Also needs: homed, inside the sweep range.
    ``track``: follows the beam. Also needs (besides homed): a recent marker, a current registration that is not
    refused, sigma below its limit; for as long as the stage turns.
    """

    HOME = "home"
    SEARCH = "search"
    TRACK = "track"


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Limits of motion. Angles rad, speeds rad/s, times s; ``sweep_rad`` is in plane angles.

    Attributes:
        stage: direction, zero, and the limits that no motion may leave (device angles).
        home_travel_rad: homing is stopped after this much travel; None for the span of the limits. The angle is unknown
            until the zero position is found; from inside the limits, homing takes no more than their span.
        heartbeat_s: longest time between heartbeats of the main program while the stage follows the beam; after that it
            stops. step_heartbeat_s: the same while it homes, searches or stands: it then goes to one target that was
            checked (homing: to the switch, within ``home_travel_rad``), and the heartbeat only shows that a stop would
            come through. A busy machine may take that long.
        command_age_s: an older command is refused, since it comes from before a stall.
        status_age_s: longest time between statuses of a moving stage.
        clock_gap_s: longest time between two clock readings of the watchdog; a longer gap means that it did not run.
        tolerance_rad: of positions: reading, settling, overshoot.
        deceleration_rad_s2: least deceleration of a stage that is stopped or reversed, rad/s^2.
        overspeed: factor above the commanded speed that counts as a fault.
        stop_s: time in which a stopped stage has to come to rest, unless its deceleration needs more.
        slack_s: time that a motion may take beyond its distance divided by its speed.
    """

    stage: StageModel
    sweep_rad: Annotated[
        tuple[float, float],
        Key(
            "plane angles that a search may use",
            NumberTuple(2, in_radians(SCAN_DEG)),
            default="all that session.yaml allows",
            example="[-60, 60]",
        ),
    ]
    home_speed_rad_s: Annotated[float, Key("highest speed to the zero position", _SPEED, name="home_speed_deg_s")] = (
        math.radians(10.0)
    )
    search_speed_rad_s: Annotated[float, Key("highest speed of a search", _SPEED, name="search_speed_deg_s")] = (
        math.radians(10.0)
    )
    track_speed_rad_s: Annotated[float, Key("highest speed after the beam", _SPEED, name="track_speed_deg_s")] = (
        math.radians(10.0)
    )
    home_travel_rad: float | None = None
    track_sigma_rad: Annotated[
        float,
        Key(
            "largest standard deviation of an answer that is followed",
            Number(0.0, 10.0, above=True, unit="deg", degrees=True),
        ),
    ] = math.radians(2.0)
    marker_age_s: Annotated[
        float, Key("oldest marker that is followed, from its exposure", Number(0.0, 0.2, above=True, unit="s"))
    ] = 0.2
    heartbeat_s: float = 0.25
    step_heartbeat_s: float = 1.0
    command_age_s: float = 0.2
    status_age_s: float = 0.3
    clock_gap_s: float = 0.5
    request_s: Annotated[float, Key("an operator's request ends by itself after", Number(1.0, 3600.0, unit="s"))] = (
        600.0
    )
    tolerance_rad: float = math.radians(0.5)
    deceleration_rad_s2: float = math.radians(20.0)
    overspeed: float = 1.25
    stop_s: float = 1.5
    slack_s: float = 3.0

    def __post_init__(self) -> None:
        for name in (
            *(
                "home_speed_rad_s",
                "search_speed_rad_s",
                "track_speed_rad_s",
                "track_sigma_rad",
                "marker_age_s",
                "heartbeat_s",
            ),
            *(
                "step_heartbeat_s",
                "command_age_s",
                "status_age_s",
                "clock_gap_s",
                "request_s",
                "tolerance_rad",
                "stop_s",
                "slack_s",
            ),
            "deceleration_rad_s2",
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}, expected a number > 0")
        if not 1.0 < self.overspeed <= 2.0:
            raise ValueError(f"overspeed is {self.overspeed}, expected a factor in (1, 2]")
        low, high = self.sweep_rad
        if not low < high:
            found = shown([round(math.degrees(angle), 9) for angle in (low, high)])
            raise FieldError.of(found, "the lower end, then the upper one", "sweep_deg")
        if not (self.inside(low) and self.inside(high)):
            raise ValueError(
                f"the sweep range {math.degrees(low):.1f} to {math.degrees(high):.1f} deg leaves the stage's limits"
            )
        if not self.inside(self.stage.scan_from_device(0.0)):
            raise ValueError("the stage's zero position, where homing ends, lies outside its limits")
        if self.home_travel_rad is not None and not self.home_travel_rad > 0:
            raise ValueError(f"home_travel_rad is {self.home_travel_rad}, expected a number > 0")

    @classmethod
    def of_session(cls, stage: StageModel, **changes: Any) -> Self:
        """Defaults for a session's stage: searches may use all of its limits."""
        low, high = sorted(stage.scan_from_device(limit) for limit in stage.limits_device_rad)
        return cls(stage, **{"sweep_rad": (low, high), **changes})

    def inside(self, scan_rad: float, tolerance_rad: float = 0.0) -> bool:
        """Whether a plane angle is inside the stage's limits; False for NaN."""
        device = self.stage.device_from_scan(scan_rad)
        low, high = self.stage.limits_device_rad
        return low - tolerance_rad - 1e-12 <= device <= high + tolerance_rad + 1e-12

    def in_sweep(self, scan_rad: float, tolerance_rad: float = 0.0) -> bool:
        """Whether a plane angle is inside the sweep range."""
        return self.sweep_rad[0] - tolerance_rad <= scan_rad <= self.sweep_rad[1] + tolerance_rad

    def speed(self, kind: MotionKind) -> float:
        """Highest speed of a kind."""
        speeds = {
            MotionKind.HOME: self.home_speed_rad_s,
            MotionKind.SEARCH: self.search_speed_rad_s,
            MotionKind.TRACK: self.track_speed_rad_s,
        }
        return speeds[kind]

    def heartbeat(self, kind: MotionKind | None) -> float:
        """Longest time between heartbeats in a motion of a kind, or while it is requested; None: neither."""
        return self.heartbeat_s if kind is MotionKind.TRACK else self.step_heartbeat_s

    def reach_rad(self, speed: float, age_s: float) -> float:
        """How far a stage can get from its reported angle, ``age_s`` old, before an order given now has reversed it.

        It continues at its speed until the order reaches it, at most one driver call from now, and then brakes:
        ``speed (age + call) + speed^2 / (2 deceleration)``.
        """
        return speed * (age_s + MAX_CALL_S) + speed * speed / (2.0 * self.deceleration_rad_s2)

    def standing_s(self) -> float:
        """Time after a stop by which the stage has to report that it is at rest."""
        fastest = max(self.speed(kind) for kind in MotionKind)
        return max(self.stop_s, MAX_CALL_S + fastest / self.deceleration_rad_s2 + self.status_age_s)

    def homing_travel(self) -> float:
        """Largest travel of homing; by default the span of the limits."""
        low, high = self.stage.limits_device_rad
        return high - low if self.home_travel_rad is None else self.home_travel_rad

    def document(self) -> dict[str, Any]:
        """As a JSON document."""
        return asdict(self)

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Self:
        """Inverse of :meth:`document`. Raises ValueError, TypeError, KeyError on an invalid document."""
        fields = dict(document)
        stage = dict(fields.pop("stage"))
        low, high = stage.pop("limits_device_rad")
        sweep_low, sweep_high = fields.pop("sweep_rad")
        return cls(StageModel(limits_device_rad=(low, high), **stage), (sweep_low, sweep_high), **fields)


LIMITS = Section("MotionLimits", record(MotionLimits).fields)
"""``limits`` of a stage in a configuration: reads to arguments of :meth:`MotionLimits.of_session`."""
