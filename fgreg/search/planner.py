"""The search for one PM: which position next, and when it is found, or given up.

Cold: sweep the field from its nearer end in steps that no window fits between, until something is heard; where nothing
was, once more half a step aside, for PMs that are heard less far than the session says. With a prediction: begin at the
predicted angle and stay about it; where nothing is heard there the search is over, and what to do next is the
caller's decision: it never becomes a sweep of the field by itself.

From the first hearing on each next position is the one after which the angle is expected to be known best, from a
distribution over angle and peak (fgreg.search.belief); of positions about as good, the nearest to where the stage is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.search.belief import Belief
from fgreg.search.hearing import HearingModel

CANDIDATE_RAD = math.radians(0.5)
"""Spacing of the positions among which the next one is chosen."""
AS_GOOD = 0.08
"""Positions whose expected sigma is larger than the best by no more than this share are as good."""
PREDICTION_REACH = 3.5
"""A search from a prediction stays within this many of its sigmas, and a window."""
PREDICTION_WRONG = 0.05
"""Share of predictions that are simply wrong: the PM may be anywhere in the field."""


class Phase(StrEnum):
    """What a position is for."""

    SWEEP = "sweep"
    PREDICTED = "predicted"
    REFINE = "refine"


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """When a search ends.

    Attributes:
        stop_sigma_rad: the PM is found once its angle is known to this.
        most_positions: the search is given up after this many.
        passes: sweeps of the field, each between the positions of those before.
    """

    stop_sigma_rad: float = math.radians(0.4)
    most_positions: int = 25
    passes: int = 2

    def __post_init__(self) -> None:
        if not (self.stop_sigma_rad > 0 and self.most_positions >= 1 and self.passes >= 1):
            raise ValueError("stop_sigma_rad has to be > 0, most_positions and passes at least 1")


@dataclass(frozen=True, slots=True)
class Prediction:
    """Where a registration says the PM is: plane angle and its sigma, rad."""

    scan_rad: float
    sigma_rad: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.scan_rad) and math.isfinite(self.sigma_rad) and self.sigma_rad > 0):
            raise ValueError(f"predicted {self.scan_rad} +- {self.sigma_rad}, expected numbers and a sigma > 0")


@dataclass(frozen=True, slots=True)
class Turn:
    """Go there and listen."""

    scan_rad: float
    phase: Phase
    reason: str


@dataclass(frozen=True, slots=True)
class Found:
    """The PM's plane angle, its standard deviation, and after how many positions."""

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
    """One search. Ask :meth:`next`, go there, tell :meth:`listened`, until it is :class:`Found` or :class:`NotFound`.

    Args:
        model: what is heard where.
        low_rad, high_rad: the field: plane angles between which the stage may search.
        stands_rad: where the stage stands now.
        prediction: where a registration says the PM is; None searches cold.

    Raises:
        ValueError: an empty field, or a prediction outside of it.
    """

    def __init__(
        self,
        model: HearingModel,
        low_rad: float,
        high_rad: float,
        stands_rad: float,
        prediction: Prediction | None = None,
        settings: SearchSettings | None = None,
    ) -> None:
        if not low_rad < high_rad:
            raise ValueError(f"the field reaches from {low_rad} to {high_rad} rad, expected an increasing range")
        self.settings = settings or SearchSettings()
        self._model, self._stands, self._prediction = model, stands_rad, prediction
        self._low, self._high = low_rad, high_rad
        self._looks: list[tuple[float, float | None]] = []
        if prediction is None:
            self._belief = Belief.flat(model, low_rad, high_rad)
            self._queue = sweep_positions(low_rad, high_rad, model.reach_rad, stands_rad, self.settings.passes)
            return
        if not low_rad <= prediction.scan_rad <= high_rad:
            raise ValueError(
                f"predicted {math.degrees(prediction.scan_rad):.1f} deg, outside the field "
                f"{math.degrees(low_rad):.1f} to {math.degrees(high_rad):.1f} deg"
            )
        # The belief covers the whole field: a PM that is heard from where no prediction expects it is not pressed into
        # the expected range. Only the positions stay there, and a window about it.
        flat = Belief.flat(model, low_rad, high_rad)
        bell = np.exp(-0.5 * ((flat.angle_rad - prediction.scan_rad) / prediction.sigma_rad) ** 2)
        self._belief = flat.times((1.0 - PREDICTION_WRONG) * bell / bell.sum() + PREDICTION_WRONG / bell.size)
        reach = PREDICTION_REACH * prediction.sigma_rad + model.reach_rad
        self._low, self._high = max(low_rad, prediction.scan_rad - reach), min(high_rad, prediction.scan_rad + reach)
        self._queue = [prediction.scan_rad, *_around(prediction, model.reach_rad, self._low, self._high)]

    @property
    def belief(self) -> Belief:
        """What is known by now."""
        return self._belief

    @property
    def heard(self) -> bool:
        """Whether anything was heard yet."""
        return any(amplitude is not None for _, amplitude in self._looks)

    def listened(self, scan_rad: float, amplitude: float | None) -> None:
        """What a look brought: the stage's angle as it was read, and the amplitude, None where nothing was heard."""
        if not math.isfinite(scan_rad):
            raise ValueError(f"the stage's angle is {scan_rad}, expected a number")
        self._belief = self._belief.after(scan_rad, amplitude)
        self._looks.append((scan_rad, amplitude))
        self._stands = scan_rad
        self._queue = [position for position in self._queue if abs(position - scan_rad) > 0.5 * CANDIDATE_RAD]

    def next(self) -> Step:
        """What to do now; asking twice without a look in between gives the same."""
        count = len(self._looks)
        sigma = self._belief.sigma_rad()
        if self.heard and sigma <= self.settings.stop_sigma_rad:
            return Found(self._belief.best_rad(), sigma, count)
        if count >= self.settings.most_positions:
            return NotFound(f"still not known better than {math.degrees(sigma):.1f} deg after {count} positions", count)
        if not self.heard or sigma > self._model.reach_rad:  # the PM may be anywhere, or anywhere again
            if self._queue:
                return self._listen(self._queue[0])
            if not self.heard:
                return NotFound(self._silence(), count)
        if self._beyond():
            at = math.degrees(self._belief.best_rad())
            return NotFound(
                f"what is heard lies near {at:.1f} deg, too far from the prediction: search the field", count
            )
        return self._refine(sigma)

    def _beyond(self) -> bool:
        """Whether the PM lies outside the positions that are allowed, so that no look can come near it."""
        return self._belief.quantile(0.05) > self._high or self._belief.quantile(0.95) < self._low

    def _listen(self, position: float) -> Turn:
        if self._prediction is not None:
            where = f"predicted {math.degrees(self._prediction.scan_rad):.1f} deg"
            reason = f"{where} +- {math.degrees(self._prediction.sigma_rad):.1f} deg"
            return Turn(position, Phase.PREDICTED, reason)
        return Turn(position, Phase.SWEEP, f"sweep, position {len(self._looks) + 1}: nothing heard yet")

    def _silence(self) -> str:
        low, high = math.degrees(self._low), math.degrees(self._high)
        if self._prediction is not None:
            return f"nothing heard about the predicted angle, between {low:.1f} and {high:.1f} deg: search the field"
        return f"nothing heard between {low:.1f} and {high:.1f} deg in {self.settings.passes} sweeps"

    def _refine(self, sigma: float) -> Turn:
        reach = 2.0 * self._model.reach_rad
        low = max(self._low, self._belief.quantile(0.02) - reach)
        high = min(self._high, self._belief.quantile(0.98) + reach)
        candidates = np.linspace(low, high, max(2, math.ceil((high - low) / CANDIDATE_RAD) + 1))
        position = best_position(candidates, self._belief.expected_sigma(candidates), self._stands)
        return Turn(position, Phase.REFINE, f"known to {math.degrees(sigma):.2f} deg: refine")


def best_position(candidates: FloatArray, expected_sigma: FloatArray, stands_rad: float) -> float:
    """Of the positions after which the angle is expected to be known about best, the nearest to the stage."""
    good = candidates[expected_sigma <= (1.0 + AS_GOOD) * float(expected_sigma.min())]
    return float(good[int(np.argmin(np.abs(good - stands_rad)))])


def sweep_positions(
    low_rad: float, high_rad: float, reach_rad: float, stands_rad: float, passes: int = 1
) -> list[float]:
    """Positions that together hear every PM of a field, which each hear ``reach_rad`` to either side.

    Even steps of at most twice the reach, from the end that is nearer to where the stage stands; a further pass goes
    back half a step aside, over both ends.
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


def _around(prediction: Prediction, reach_rad: float, low_rad: float, high_rad: float) -> list[float]:
    """Further positions about a predicted angle, nearest first, until all within its range would have been heard."""
    step, positions = 1.5 * reach_rad, []
    for number in range(1, math.ceil(PREDICTION_REACH * prediction.sigma_rad / step) + 1):
        for sign in (1.0, -1.0):
            position = prediction.scan_rad + sign * number * step
            if low_rad <= position <= high_rad:
                positions.append(position)
    return positions
