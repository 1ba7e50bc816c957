"""Whether the answer may be used: conditions, each a sentence with its figure and what to do about it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from fgreg.config import SolveConfig
from fgreg.estimate import PredictedTre, Verdict, worst_verdict
from fgreg.frames import FloatArray
from fgreg.measurements import Pair
from fgreg.registration import EpochSearch

SUSPICIOUS_P = 1e-3
IMPOSSIBLE_P = 1e-9
SUSPICIOUS_SIGMAS = 3.0
LEAST_EFFECTIVE = 60.0
"""Independent samples of the posterior below which its 95 % quantiles are not worth much."""


@dataclass(frozen=True, slots=True)
class Condition:
    """One condition missed: how bad that is, and the sentence for ``reasons``."""

    verdict: Verdict
    text: str


def verdict_of(conditions: Iterable[Condition]) -> Verdict:
    """The most severe verdict of the conditions missed."""
    return worst_verdict(*(condition.verdict for condition in conditions))


def ambiguity(
    search: EpochSearch, pairs: int, *, is_open: bool, has_initial: bool, config: SolveConfig
) -> list[Condition]:
    """Second minima, too few pairs, and the mirrored hypothesis, of one epoch."""
    found = []
    if is_open and len(search.minima) > 1:
        gap = search.minima[1].cost - search.minima[0].cost
        found.append(
            Condition(
                Verdict.REFUSED,
                f"two registrations explain the {pairs} pairs (chi square {search.minima[0].cost:.1f} and "
                f"{search.minima[1].cost:.1f}, {gap:.1f} apart, {config.second_minimum_chi2:.1f} needed): take more "
                "pairs at other spots and beam directions, or give initial.trus_T_camera",
            )
        )
    if pairs < config.min_pairs and not has_initial:
        found.append(
            Condition(
                Verdict.REFUSED,
                f"{pairs} pairs leave the registration open ({config.min_pairs} needed without an initial one): "
                f"take {config.min_pairs - pairs} more",
            )
        )
    if search.mirrored_cost is not None and search.minima and search.mirrored_cost < search.minima[0].cost:
        gap = search.minima[0].cost - search.mirrored_cost
        found.append(
            Condition(
                Verdict.REFUSED if gap > config.second_minimum_chi2 else Verdict.WARNING,
                f"the mirrored hypothesis fits better (chi square {search.mirrored_cost:.1f} against "
                f"{search.minima[0].cost:.1f}): the stage turns the other way (stage.direction) or the elements are "
                "counted from the other end (probe.flip); check the wiring and correct session.yaml",
            )
        )
    return found


def spread(directions: FloatArray, points: FloatArray, config: SolveConfig) -> list[Condition]:
    """Parallel beams and collinear spots, from beam directions (n, 3) and PMs (n, 3) of one epoch."""
    found = []
    mean = directions.mean(axis=0)
    cosine = np.clip(directions @ mean / max(float(np.linalg.norm(mean)), 1e-9), -1.0, 1.0)
    angle = float(np.sqrt(np.mean(np.arccos(cosine) ** 2)))
    if angle < config.warn_beam_spread_rad:
        refuse = angle < config.refuse_beam_spread_rad
        least = config.refuse_beam_spread_rad if refuse else config.warn_beam_spread_rad
        found.append(
            Condition(
                Verdict.REFUSED if refuse else Verdict.WARNING,
                f"the beams are {'' if refuse else 'nearly '}parallel ({math.degrees(angle):.1f} deg about their mean, "
                f"{math.degrees(least):.0f} needed): add pairs with the fibre tilted left, right, up and down",
            )
        )
    away = float(np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[1] / math.sqrt(len(points)))
    if away < config.warn_spot_spread_mm:
        refuse = away < config.refuse_spot_spread_mm
        least = config.refuse_spot_spread_mm if refuse else config.warn_spot_spread_mm
        found.append(
            Condition(
                Verdict.REFUSED if refuse else Verdict.WARNING,
                f"the spots lie {'' if refuse else 'nearly '}on one line ({away:.1f} mm about it, {least:.0f} needed): "
                "add pairs at spots to either side of it",
            )
        )
    return found


def sweeps(pairs: Iterable[Pair], config: SolveConfig) -> list[Condition]:
    """Sweeps from one side only: a wrong window edge or sweep sign would not show."""
    sides = [pair.look.sweep for pair in pairs if pair.look.sweep]
    up, down = sides.count(1), sides.count(-1)
    if not sides or min(up, down) >= config.min_sweeps_per_side:
        return []
    missing = config.min_sweeps_per_side - min(up, down)
    return [
        Condition(
            Verdict.WARNING,
            f"{max(up, down)} of {up + down} sweeps went one way, where a wrong window edge or sweep sign does not "
            f"show: take {missing} pairs sweeping the other way",
        )
    ]


def consistency(cost: float, degrees_of_freedom: int) -> list[Condition]:
    """Residuals against the noise that was stated."""
    if degrees_of_freedom <= 0:
        return []
    p = float(chi2.sf(cost, degrees_of_freedom))
    if p >= SUSPICIOUS_P:
        return []
    return [
        Condition(
            Verdict.REFUSED if p < IMPOSSIBLE_P else Verdict.WARNING,
            f"the residuals are larger than the stated noise explains (chi square {cost:.0f} for "
            f"{degrees_of_freedom} degrees of freedom): look at the pairs with the largest nis, and check noise, "
            "probe and marker in session.yaml",
        )
    ]


def sound_speed(ratio: float, sigma: float, config: SolveConfig) -> list[Condition]:
    """A sound speed that the pairs contradict, from the ratio of true to assumed speed that they ask for."""
    off = abs(ratio - 1.0)
    if off <= SUSPICIOUS_SIGMAS * sigma or off <= 0.5 * config.sound_speed_sigma:
        return []
    text = (
        f"the pairs fit better with sound at {ratio:.3f} +- {sigma:.3f} of probe.sound_speed_m_s: correct it in "
        "session.yaml, or solve with --estimate sound_speed"
    )
    return [Condition(Verdict.WARNING, text)]


def estimated(name: str, value: float, sigma: float, prior: float, prior_sigma: float, unit: str) -> Condition:
    """What a session-wide variable came out as; a warning where it left its prior."""
    far = abs(value - prior) > SUSPICIOUS_SIGMAS * prior_sigma
    text = f"estimated {name} {value:.4g} +- {sigma:.2g}{unit} (given {prior:.4g} +- {prior_sigma:.2g}{unit})"
    if far:
        return Condition(Verdict.WARNING, f"{text}: farther than its prior allows; correct it in session.yaml")
    return Condition(Verdict.OK, text)


def sampling(effective: float) -> list[Condition]:
    """Too few independent samples of the posterior for the figures that rest on them."""
    if effective >= LEAST_EFFECTIVE:
        return []
    text = (
        f"the posterior is hard to sample (worth {effective:.0f} independent samples, {LEAST_EFFECTIVE:.0f} needed), "
        "so predicted errors are rough: take more pairs"
    )
    return [Condition(Verdict.WARNING, text)]


def accuracy(tre: PredictedTre, config: SolveConfig) -> list[Condition]:
    """Predicted error at the worst target against the limit."""
    if tre.worst_mm <= config.limit_mm:
        return []
    far = tre.worst_mm > 2.0 * config.limit_mm
    return [
        Condition(
            Verdict.REFUSED if far else Verdict.WARNING,
            f"the predicted error at the worst target is {tre.worst_mm:.1f} mm (95 %), the limit {config.limit_mm:.1f} "
            "mm: take more pairs, spread over the field and with sweeps from both sides",
        )
    ]


def beam_sides(lambda_mm: FloatArray) -> list[Condition]:
    """Spots before and behind the laser's origin: the beam cannot point both ways."""
    behind = int(np.sum(lambda_mm < 0))
    if behind == 0:
        return []
    return [
        Condition(
            Verdict.WARNING,
            f"{behind} of {len(lambda_mm)} spots lie behind the beam's origin: check marker and initial.marker_T_laser",
        )
    ]
