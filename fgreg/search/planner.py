"""The search for one PM: the next position, and when the PM is found or the search is given up.

Without a prediction (cold), the search sweeps the field from its nearer end, in steps small enough that no sensitivity
window fits between, until something is detected. If nothing is, a second sweep half a step aside follows, for PMs with
a narrower window than the session says. With a prediction, the search starts at the predicted angle and stays near it.
If nothing is detected there, it ends and the caller decides: it never becomes a sweep of the field by itself.

After the first detection, each next position minimises the expected sigma of the angle, from a distribution over angle
and peak (fgreg.search.belief). Of positions that are about equal, the one nearest to the stage is taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.search.belief import Belief
from fgreg.search.detection_model import DetectionModel

CANDIDATE_RAD = math.radians(0.5)
"""Spacing of the positions among which the next one is chosen."""
AS_GOOD = 0.08
"""Positions count as equal if their expected sigma is larger than the best by at most this share."""
AT_ONCE = 16
"""Positions weighed in one part of :meth:`SearchPlanner.advance`, about 1 ms each."""
PREDICTION_REACH = 3.5
"""A search from a prediction stays within this many of its sigmas plus a sensitivity window."""
PREDICTION_WRONG = 0.05
"""Share of wrong predictions, for which the PM may be anywhere in the field."""


class Phase(StrEnum):
    """Purpose of a position."""

    SWEEP = "sweep"
    PREDICTED = "predicted"
    REFINE = "refine"
    EDGES = "edges"


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """When a search ends.

    Attributes:
        stop_sigma_rad: the PM is found once its angle is known to this.
        most_positions: the search is given up after this many.
        passes: number of sweeps of the field, each between the positions of the one before.
    """

    stop_sigma_rad: float = math.radians(0.4)
    most_positions: int = 25
    passes: int = 2

    def __post_init__(self) -> None:
        if not (self.stop_sigma_rad > 0 and self.most_positions >= 1 and self.passes >= 1):
            raise ValueError("stop_sigma_rad has to be > 0, most_positions and passes at least 1")


@dataclass(frozen=True, slots=True)
class Prediction:
    """Prediction of a PM by the registration: plane angle and its sigma, rad."""

    scan_rad: float
    sigma_rad: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scan_rad) and math.isfinite(self.sigma_rad) and self.sigma_rad > 0):
            raise ValueError(f"predicted {self.scan_rad} +- {self.sigma_rad}, expected numbers and a sigma > 0")


@dataclass(frozen=True, slots=True)
class Turn:
    """Turn to this plane angle and take a look."""

    scan_rad: float
    phase: Phase
    reason: str


@dataclass(frozen=True, slots=True)
class Found:
    """The PM's plane angle, its standard deviation, and the number of positions."""

    scan_rad: float
    sigma_rad: float
    positions: int


@dataclass(frozen=True, slots=True)
class NotFound:
    """The search is over without a result."""

    reason: str
    positions: int


Step = Turn | Found | NotFound


class SearchPlanner:
    """One search: turn to the position of :meth:`next` and pass the look to :meth:`add_look`, until ``next`` returns
    :class:`Found` or :class:`NotFound`.

    Args:
        model: detection model.
        low_rad, high_rad: the field: plane angles between which the stage may search.
        stands_rad: current plane angle of the stage.
        prediction: of the registration; None for a cold search.
        likely_rad: where other PMs were found, lowest and highest; a cold search begins with these positions.

    Raises:
        ValueError: an empty field, or a prediction outside of it.
    """

    def __init__(
        self,
        model: DetectionModel,
        low_rad: float,
        high_rad: float,
        stands_rad: float,
        prediction: Prediction | None = None,
        settings: SearchSettings | None = None,
        likely_rad: tuple[float, float] | None = None,
    ) -> None:
        if not low_rad < high_rad:
            raise ValueError(f"the field reaches from {low_rad} to {high_rad} rad, expected an increasing range")
        self.settings = settings or SearchSettings()
        self._model, self._stands, self._prediction = model, stands_rad, prediction
        self._low, self._high = low_rad, high_rad
        self._looks: list[tuple[float, float | None]] = []
        self._weighed: tuple[FloatArray, list[float]] | None = None  # candidates, expected sigmas of the first of them
        if prediction is None:
            self._belief = Belief.flat(model, low_rad, high_rad)
            self._queue = sweep_positions(low_rad, high_rad, model.reach_rad, stands_rad, self.settings.passes)
            if likely_rad is not None:
                self._queue = _likely_first(self._queue, likely_rad, model.reach_rad, stands_rad, self.settings.passes)
            return
        if not low_rad <= prediction.scan_rad <= high_rad:
            raise ValueError(
                f"predicted {math.degrees(prediction.scan_rad):.1f} deg, outside the field "
                f"{math.degrees(low_rad):.1f} to {math.degrees(high_rad):.1f} deg"
            )
        # The belief covers the whole field, so that a PM far from the prediction is not forced into its range. Only the
        # positions are limited to that range plus a sensitivity window.
        flat = Belief.flat(model, low_rad, high_rad)
        bell = np.exp(-0.5 * ((flat.angle_rad - prediction.scan_rad) / prediction.sigma_rad) ** 2)
        self._belief = flat.times((1.0 - PREDICTION_WRONG) * bell / bell.sum() + PREDICTION_WRONG / bell.size)
        reach = PREDICTION_REACH * prediction.sigma_rad + model.reach_rad
        self._low, self._high = max(low_rad, prediction.scan_rad - reach), min(high_rad, prediction.scan_rad + reach)
        self._queue = [prediction.scan_rad, *_around(prediction, model.reach_rad, self._low, self._high)]

    @property
    def detected(self) -> bool:
        """Whether anything was detected up to now."""
        return any(amplitude is not None for _, amplitude in self._looks)

    def add_look(self, scan_rad: float, amplitude: float | None) -> None:
        """Take in a look: the stage's reading (rad), and the amplitude or None if nothing was detected."""
        if not math.isfinite(scan_rad):
            raise ValueError(f"the stage's angle is {scan_rad}, expected a number")
        self._belief = self._belief.after(scan_rad, amplitude)
        self._looks.append((scan_rad, amplitude))
        self._weighed = None
        self._stands = scan_rad
        self._queue = [position for position in self._queue if abs(position - scan_rad) > 0.5 * CANDIDATE_RAD]

    def next(self) -> Step:
        """The next step; the same as before if no look came in between."""
        while True:
            if (step := self.advance()) is not None:
                return step

    def advance(self) -> Step | None:
        """As :meth:`next`, in parts of some hundredths of a second: None until the last, and a loop goes on between."""
        count = len(self._looks)
        sigma = self._belief.sigma_rad()
        if self.detected and sigma <= self.settings.stop_sigma_rad:
            return Found(self._belief.best_rad(), sigma, count)
        if count >= self.settings.most_positions:
            return NotFound(
                f"still not known better than {math.degrees(sigma):.1f} deg (1 sigma) after {count} positions", count
            )
        if not self.detected or sigma > self._model.reach_rad:  # the PM may (still or again) be anywhere
            if self._queue:
                return self._queued(self._queue[0])
            if not self.detected:
                return NotFound(self._nothing_detected(), count)
        if self._beyond():
            at = math.degrees(self._belief.best_rad())
            return NotFound(
                f"the detected source lies near {at:.1f} deg, too far from the prediction: search the field", count
            )
        return self._refine(sigma)

    def _beyond(self) -> bool:
        """Whether the PM lies outside the allowed positions, so that no look can come near it."""
        return self._belief.quantile(0.05) > self._high or self._belief.quantile(0.95) < self._low

    def _queued(self, position: float) -> Turn:
        if self._prediction is not None:
            where = f"predicted {math.degrees(self._prediction.scan_rad):.1f} deg"
            reason = f"{where} +- {math.degrees(self._prediction.sigma_rad):.1f} deg (1 sigma)"
            return Turn(position, Phase.PREDICTED, reason)
        return Turn(position, Phase.SWEEP, f"sweep, position {len(self._looks) + 1}: nothing detected yet")

    def _nothing_detected(self) -> str:
        low, high = math.degrees(self._low), math.degrees(self._high)
        if self._prediction is not None:
            return f"nothing detected about the predicted angle, between {low:.1f} and {high:.1f} deg: search the field"
        return f"nothing detected between {low:.1f} and {high:.1f} deg in {self.settings.passes} sweeps"

    def _refine(self, sigma: float) -> Turn | None:
        if self._weighed is None:
            reach = 2.0 * self._model.reach_rad
            low = max(self._low, self._belief.quantile(0.02) - reach)
            high = min(self._high, self._belief.quantile(0.98) + reach)
            self._weighed = np.linspace(low, high, max(2, math.ceil((high - low) / CANDIDATE_RAD) + 1)), []
        candidates, expected = self._weighed
        done = len(expected)
        if done < len(candidates):
            expected += self._belief.expected_sigma(candidates[done : done + AT_ONCE]).tolist()
        if len(expected) < len(candidates):
            return None
        position = best_position(candidates, np.array(expected), self._stands)
        return Turn(position, Phase.REFINE, f"known to {math.degrees(sigma):.2f} deg (1 sigma): refine")


def best_position(candidates: FloatArray, expected_sigma: FloatArray, stands_rad: float) -> float:
    """Of the positions with about the smallest expected sigma, the one nearest to the stage."""
    good = candidates[expected_sigma <= (1.0 + AS_GOOD) * float(expected_sigma.min())]
    return float(good[int(np.argmin(np.abs(good - stands_rad)))])


def sweep_positions(
    low_rad: float, high_rad: float, reach_rad: float, stands_rad: float, passes: int = 1
) -> list[float]:
    """Positions that together cover a field, if each covers ``reach_rad`` to either side.

    Equal steps of at most twice the reach, from the end nearer to the stage; each further pass goes back, half a step
    aside and beyond both ends of the pass before.
    """
    count = max(1, math.ceil((high_rad - low_rad) / (2.0 * reach_rad) - 1e-9))
    step = (high_rad - low_rad) / count
    first = [low_rad + step * (i + 0.5) for i in range(count)]
    between = [low_rad + step * i for i in range(count + 1)]
    if abs(stands_rad - high_rad) < abs(stands_rad - low_rad):
        first.reverse()
        between.reverse()
    positions: list[float] = []
    for number in range(passes):
        leg = (first, between)[number % 2]
        positions += leg if number % 2 == 0 else leg[::-1]
    return positions


def _likely_first(
    positions: list[float], likely_rad: tuple[float, float], reach_rad: float, stands_rad: float, passes: int
) -> list[float]:
    """The positions with those of the first pass in front that cover a range, from its end nearer to the stage."""
    low, high = likely_rad[0] - reach_rad, likely_rad[1] + reach_rad
    first = positions[: math.ceil((len(positions) - passes // 2) / passes)]
    inside = sorted(position for position in first if low <= position <= high)
    if inside and abs(stands_rad - inside[-1]) < abs(stands_rad - inside[0]):
        inside.reverse()
    return inside + [position for position in positions if position not in inside]


def _around(prediction: Prediction, reach_rad: float, low_rad: float, high_rad: float) -> list[float]:
    """Further positions around a predicted angle, nearest first, until its range is covered."""
    step, positions = 1.5 * reach_rad, []
    for number in range(1, math.ceil(PREDICTION_REACH * prediction.sigma_rad / step) + 1):
        for sign in (1.0, -1.0):
            position = prediction.scan_rad + sign * number * step
            if low_rad <= position <= high_rad:
                positions.append(position)
    return positions
