"""Whether the estimate may be used: conditions, each a sentence with its figure and what to do about it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import bdtrc, chdtrc, chdtri

from fgreg.errors import one_line
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import BoolArray, FloatArray, hat, inverse, transform_points
from fgreg.graph.split_points import ALARM
from fgreg.model.estimate import ExcludedShot, PredictedTre, Verdict, worst_verdict
from fgreg.model.measurements import Pair
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.move_doubt import MoveDoubt
from fgreg.registration.multistart import EpochSearch
from fgreg.registration.outliers import OUTLIER_P
from fgreg.registration.register import Registration
from fgreg.schema.problems import numbers_text

SUSPICIOUS_P = 1e-3
IMPOSSIBLE_P = 1e-9
WARN_LEFT_OUT = 0.25
REFUSE_LEFT_OUT = 0.5
"""Shares of outliers beyond which there is a warning, and a refusal."""
SURE_OF_PAIRS = 9
SURE_OF_AIMS = 6
"""Inliers needed to be sure which shots are outliers: one and a half times what a solution needs."""
OUTLIER_CAUTION = 2
"""Factor on the gap in chi square that is needed where shots were left out: other hypotheses then fit more easily by
chance."""
CERTAIN_NIS = 30.0
"""Innovation of one shot that neither noise nor a poor estimate from few other shots explains."""
MIRROR_CHANCE = 2.0
"""Chi square by which a mirrored session may fit better by chance: a wrong decision here costs centimetres."""
MILD_NIS = 60.0
MILD_OUTLIERS = 0.1
"""Most outliers have a larger innovation than the first; this share of them has not."""
TELLING_PMS = 6
"""Fewer PMs do not determine one registration, so they cannot show a second one."""
FEW_PMS = 21
"""Up to this number of PMs, those before an unreported camera move are enough to spoil the registration."""
ABOUT_EVEN = 0.6
"""Bayes factor, among few PMs, of a move at any split point (all equally likely) against none from which there is a
warning. One in twelve sessions of 10 to 20 PMs without a move reaches it, and so does a move of 2 deg between 5 PMs and
6."""
CLEARLY_MOVED = 2.0
"""The same Bayes factor from which there is a warning among any number of PMs. One in fifty registrations from 6 to 21
PMs without a move reaches it, mostly for one PM or two (first-hit pairs; none in 160 with windows only)."""
MOST_WRONG = 0.02
"""Probability of an error beyond twice the limit, for a camera move, from which the registration is refused, where a
move is about as likely as none: reached in 1 of 120 steady sessions of 15 and 25 pairs."""
DOMINANT = 0.5
"""Share of the error's variance above which a cause is named."""
LEAST_EFFECTIVE = 60.0
"""Effective samples of the posterior below which its 95 % quantiles are rough."""
SUSPICIOUS_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class Condition:
    """One missed condition: its severity, and the sentence for ``reasons``.

    ``effect_mm``: error at the worst target of what the sentence names, which the posterior does not include.
    ``is_error``: it is the predicted error itself, which others may cause.
    """

    verdict: Verdict
    text: str
    effect_mm: float = 0.0
    is_error: bool = False


def verdict_of(conditions: Iterable[Condition]) -> Verdict:
    """The most severe verdict of the missed conditions."""
    return worst_verdict(*(condition.verdict for condition in conditions))


def worst_first(reasons: Iterable[tuple[Condition, str]]) -> tuple[str, ...]:
    """The sentences of conditions, in the order to look at them: refusals, known causes of the error, the error."""

    def place(condition: Condition) -> int:
        refused = condition.verdict is Verdict.REFUSED
        if refused and not condition.is_error:
            return 0
        return 1 if condition.effect_mm else 2 if refused else 4 - condition.verdict.severity

    return tuple(text for _, text in sorted(reasons, key=lambda reason: place(reason[0])))


def ambiguity(
    search: EpochSearch, pairs: int, *, is_open: bool, has_initial: bool, config: SolveConfig
) -> list[Condition]:
    """Second minima, too few pairs, and the mirrored hypothesis, of one epoch."""
    found = []
    if is_open and not search.minima:
        text = "the measured motion starts from an ambiguous registration: take more pairs"
        found.append(Condition(Verdict.REFUSED, text))
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
    return [*found, *mirrored(search, config)]


def mirrored(search: EpochSearch, config: SolveConfig) -> list[Condition]:
    """The mirrored hypothesis: a stage or probe wired the other way round.

    A mirror image whose beams come from the probe's side counts only where it fits far better. Where the beams of the
    session as recorded come from there, the mirror image is preferred already where it fits as well.
    """
    if search.mirrored_cost is None or not search.minima:
        return []
    cost, rival = search.minima[0].cost, search.mirrored_cost
    caution = 1 if search.clean else OUTLIER_CAUTION
    needed = MIRROR_CHANCE * caution if search.outside else -config.second_minimum_chi2
    if search.mirrored_outside_cost is not None and search.mirrored_outside_cost < cost - needed:
        rival = search.mirrored_outside_cost
    elif rival >= cost - config.second_minimum_chi2 * caution:
        if search.outside:
            return []
        text = (
            "the beams run away from the probe, as if the fibre were on its side of the tissue: check stage.direction, "
            "probe.flip and the marker's tags"
        )
        return [Condition(Verdict.WARNING, text)]
    text = (
        f"the mirrored hypothesis fits {'better' if rival < cost else 'as well'} (chi square {rival:.1f} against "
        f"{cost:.1f}): the stage turns the other way (stage.direction) or the elements are counted from the other end "
        "(probe.flip); check the wiring and correct session.yaml"
    )
    return [Condition(Verdict.REFUSED, text)]


def hypotheses(search: EpochSearch, config: SolveConfig) -> list[Condition]:
    """Reversed sweep signs, and another beam in the pairs than in the aims; tried where some shot does not fit."""
    found = []
    if not search.minima:
        return []
    cost = search.minima[0].cost
    # Where all sweeps go one way the data do not determine the sign, and a small gap is chance.
    if (
        search.other_way_cost is not None
        and search.other_way_cost < cost - OUTLIER_CAUTION * config.second_minimum_chi2
    ):
        text = (
            f"the sweeps fit better with their signs reversed (chi square {search.other_way_cost:.1f} against "
            f"{cost:.1f}): sweep in events.jsonl is +1 where the device's angle was increasing; correct it"
        )
        found.append(Condition(Verdict.REFUSED, text))
    if search.own_beam_cost is not None and search.own_beam_cost < cost - chdtri(4, IMPOSSIBLE_P):
        found.append(
            Condition(
                Verdict.REFUSED,
                f"the pairs have another beam than the aims (chi square {search.own_beam_cost:.1f} with a beam of "
                f"their own, {cost:.1f} with that of the aims): the marker was swapped, or moved on the fibre, after "
                "calibration; take the aims again",
            )
        )
    return found


def left_out(kept: BoolArray, nis: FloatArray, what: str, sure: int) -> list[Condition]:
    """Too large a share of outliers, or fewer inliers than the ``sure`` that are needed to be certain of them."""
    out = int(np.sum(~kept))
    if out and out <= WARN_LEFT_OUT * len(kept) and kept.sum() < sure:
        text = (
            f"{out} of {len(kept)} {what} do not fit the others and are left out; {kept.sum()} inliers are few to be "
            f"sure which are wrong ({sure} needed): take more {what}"
        )
        return [Condition(Verdict.WARNING, text)]
    if out <= WARN_LEFT_OUT * len(kept):
        return []
    refuse = out > REFUSE_LEFT_OUT * len(kept)
    return [
        Condition(
            Verdict.REFUSED if refuse else Verdict.WARNING,
            f"{out} of {len(kept)} {what} do not fit the others and are left out (nis {nis[~kept].min():.0f} to "
            f"{nis[~kept].max():.0f}, at most {100 * WARN_LEFT_OUT:.0f} % accepted): look at what was detected there, "
            f"check noise, probe and marker in session.yaml, and take {out} {what} again",
        )
    ]


def by_hand(excluded: Sequence[ExcludedShot], used: int) -> list[Condition]:
    """Shots left out by hand: evidence that no test has seen.

    Predicted errors are those of the shots that are left. They hold where a shot was left out for a cause that was seen
    when it was taken, such as a bumped fibre. Where shots are chosen by how they fit, the tests of residuals, outliers
    and camera moves pass more easily, and no covariance says so.

    Args:
        excluded: all that were left out.
        used: aims, looks and known points that were not, and that were measured.
    """
    if not excluded:
        return []
    pms = {shot.pm for shot in excluded if shot.pm is not None}
    aims = {shot.aim for shot in excluded if shot.aim is not None}
    points = {shot.point for shot in excluded if shot.point is not None}
    numbers = (("PM", pms), ("aim", aims), ("known point", points))
    names = [f"{what} {numbers_text(some)}" for what, some in numbers if some]
    count = len(excluded)
    text = (
        f"{count} of {count + used} shots {'was' if count == 1 else 'were'} left out by hand ({'; '.join(names)}): no "
        "test has seen what is left out, and the predicted error holds only if that was for a cause seen at the shot, "
        "not for how it fits; solve with all shots too and compare, or have check points"
    )
    return [Condition(Verdict.WARNING, text)]


def refused_shots(reasons: Sequence[str]) -> list[Condition]:
    """Recorded aims, looks, checks or camera moves that ``refused`` events take out: evidence that no test has seen.

    Args:
        reasons: why each was refused.
    """
    if not reasons:
        return []
    text = (
        f"`refused` events take out recorded shots, checks or camera moves ({len(reasons)}; the first: "
        f"{one_line(reasons[0], 100)}): no test has seen them; take them again"
    )
    return [Condition(Verdict.WARNING, text)]


def side_of_a_move(first: int, last: int, out: int) -> list[Condition]:
    """Outliers in a row, which one other registration may fit."""
    text = (
        f"{out} pairs nearly in a row, PM {first} to {last}, do not fit the others and are left out: they may be one "
        "side of a camera move; if the camera was moved there, report it (camera_moved), else take them again"
    )
    return [Condition(Verdict.REFUSED, text)]


def understated_noise(beyond_limit: BoolArray, nis: FloatArray) -> list[Condition]:
    """Several shots slightly beyond their limit: noise that is larger than stated, rather than outliers."""
    mild = beyond_limit & (nis < MILD_NIS)
    share_of_outliers = float(np.mean(beyond_limit & ~mild))
    expected = min(OUTLIER_P + MILD_OUTLIERS * share_of_outliers, 1.0)
    if float(bdtrc(int(mild.sum()) - 1, len(nis), expected)) >= SUSPICIOUS_P:
        return []
    return [
        Condition(
            Verdict.WARNING,
            f"the residuals of {int(mild.sum())} of {len(nis)} shots are larger than the stated noise explains, though "
            f"not by far (nis {nis[mild].min():.0f} to {nis[mild].max():.0f}): that is noise rather than outliers; "
            "correct noise in session.yaml, or the covariances of the detections",
        )
    ]


def too_few_to_tell(beyond_limit: BoolArray, kept: BoolArray, nis: FloatArray, names: Sequence[str]) -> list[Condition]:
    """Shots that do not fit, where there are too few shots to leave one out."""
    suspects = np.flatnonzero(beyond_limit & kept)
    if not len(suspects):
        return []
    worst = int(suspects[np.argmax(nis[suspects])])
    return [
        Condition(
            Verdict.REFUSED if nis[worst] > CERTAIN_NIS else Verdict.WARNING,
            f"{names[worst]} does not fit the others (nis {nis[worst]:.1f}), and {int(kept.sum())} are too few to tell "
            "which is wrong: take more, and look at what was detected there",
        )
    ]


def possible_camera_move(doubt: MoveDoubt, limit_mm: float) -> list[Condition]:
    """A camera move among the inliers of an epoch: a refusal where the registration could be far off for it.

    One registration cannot fit both sides of a move, and the predicted error does not include that. Few PMs do not show
    a move clearly, so among them there is a warning already where a move, at any split point, is about as likely as
    none.
    """
    few, alarm = doubt.pms <= FEW_PMS, doubt.log_odds > ALARM
    somewhere = math.exp(min(doubt.log_odds, 50.0)) / max(doubt.pms - 1, 1) if doubt.pms >= TELLING_PMS else 0.0
    far = doubt.wrong > MOST_WRONG and (alarm or somewhere > ABOUT_EVEN)
    if not (far or alarm or somewhere > (ABOUT_EVEN if few else CLEARLY_MOVED)):
        return []
    text = (
        f"the pairs up to PM {doubt.before} and those from PM {doubt.after} "
        f"{'do' if alarm or somewhere > CLEARLY_MOVED else 'may'} not fit one registration (odds "
        f"{math.exp(min(doubt.log_odds, 20.0)):.0f} to 1)"
    )
    if far:
        text += f", which could be off by more than {2.0 * limit_mm:.1f} mm"
    advice = "if the camera was moved between them, report it (camera_moved); where it was not, take more pairs"
    return [Condition(Verdict.REFUSED if far else Verdict.WARNING, f"{text}: {advice}")]


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
    """Sweeps from one side only, which cannot show a wrong window edge or sweep sign."""
    sides = [pair.look.sweep for pair in pairs if pair.look.sweep]
    up, down = sides.count(1), sides.count(-1)
    if not sides or min(up, down) >= config.min_sweeps_per_side:
        return []
    missing = config.min_sweeps_per_side - min(up, down)
    return [
        Condition(
            Verdict.WARNING,
            f"{max(up, down)} of {up + down} sweeps went one way, where a wrong window edge or sweep sign does not "
            f"show: look at the next PMs from both sides (at least {missing})",
        )
    ]


def untested_motion() -> list[Condition]:
    """A measured camera motion that no pair has tested."""
    text = "no pair was taken since the camera moved, and so none has tested the motion as it was measured: take a pair"
    return [Condition(Verdict.WARNING, text)]


def two_sided(pairs: Iterable[Pair]) -> bool:
    """Whether most PMs have looks from both sides."""
    sides: dict[int, set[int]] = {}
    for pair in pairs:
        sides.setdefault(pair.pm, set()).add(pair.look.sweep)
    return 2 * sum({1, -1} <= swept for swept in sides.values()) > len(sides)


def repeated_markers(pairs: Iterable[Pair]) -> list[Condition]:
    """One marker observation under several PM numbers: the looks would count as independent but are not."""
    pms: dict[int, set[int]] = {}
    for pair in pairs:
        pms.setdefault(pair.marker.id, set()).add(pair.pm)
    shared = [sorted(names) for names in pms.values() if len(names) > 1]
    if not shared:
        return []
    text = (
        f"{len(shared)} marker observations serve several PMs (PM {', '.join(str(pm) for pm in shared[0])}): looks at "
        "one spot have one pm; where the spots differ, the fibre moved and each needs a marker of its own"
    )
    return [Condition(Verdict.WARNING, text)]


def consistency(cost: float, degrees_of_freedom: int) -> list[Condition]:
    """Chi square of the residuals against the stated noise."""
    if degrees_of_freedom <= 0:
        return []
    p = float(chdtrc(degrees_of_freedom, cost))
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


def estimated(name: str, value: float, sigma: float, prior: float, prior_sigma: float, unit: str) -> Condition:
    """The estimate of a session-wide variable; a warning where it is outside its prior."""
    far = abs(value - prior) > SUSPICIOUS_SIGMAS * prior_sigma
    text = f"estimated {name} {value:.4g} +- {sigma:.2g}{unit} (given {prior:.4g} +- {prior_sigma:.2g}{unit}; 1 sigma)"
    if far:
        return Condition(Verdict.WARNING, f"{text}: farther than its prior allows; correct it in session.yaml")
    return Condition(Verdict.OK, text)


def sampling(effective: float) -> list[Condition]:
    """Too few effective samples of the posterior for the predicted errors."""
    if effective >= LEAST_EFFECTIVE:
        return []
    text = (
        f"the posterior is hard to sample (worth {effective:.0f} independent samples, {LEAST_EFFECTIVE:.0f} needed), "
        "so predicted errors are rough: take more pairs"
    )
    return [Condition(Verdict.WARNING, text)]


@dataclass(frozen=True, slots=True)
class Causes:
    """Share of the variance at the worst target that would vanish if the beam, or the window edge, were known."""

    beam: float
    edge: float


def accuracy(
    tre: PredictedTre,
    config: SolveConfig,
    causes: Causes | None = None,
    largest: str = "",
    *,
    both_sides: bool = False,
    named_mm: float = 0.0,
) -> list[Condition]:
    """Predicted error at the worst target against the limit, with the advice that would lower it most.

    ``largest``: the systematic causes with the largest part in it, as text. ``both_sides``: most PMs have looks from
    both sides already. ``named_mm``: the part that is named by other conditions.
    """
    if tre.worst_mm <= config.limit_mm:
        return []
    far = tre.worst_mm > 2.0 * config.limit_mm
    advice = "take more pairs, spread over the field, with looks from both sides at each PM"
    if named_mm > DOMINANT * tre.worst_mm:
        advice = f"{named_mm:.1f} mm of it by what is named above: correct that"
    elif largest and tre.systematic is not None and tre.systematic.worst_mm > math.sqrt(DOMINANT) * tre.worst_mm:
        also = "" if both_sides else ", and take looks from both sides at each PM"
        advice = f"most of it is systematic ({largest}): measure these{also}"
    elif causes is not None and causes.beam > DOMINANT and causes.beam >= causes.edge:
        advice = (
            f"{100 * causes.beam:.0f} % of its variance is the beam's: take more aims, at short and long distances, "
            "and roll the fibre about its beam during calibration"
        )
    elif causes is not None and causes.edge > DOMINANT:
        what = "measure the window's half width" if both_sides else "take looks from both sides at each PM"
        advice = f"{100 * causes.edge:.0f} % of its variance is the window edge's: {what}"
    return [
        Condition(
            Verdict.REFUSED if far else Verdict.WARNING,
            f"the predicted error at the worst target is {tre.worst_mm:.1f} mm (95 % bound), the limit "
            f"{config.limit_mm:.1f} mm: {advice}",
            is_error=True,
        )
    ]


def causes_of_error(registration: Registration, place: int, targets_mm: FloatArray) -> Causes:
    """Causes of the error of an epoch (``place`` in ``registration.epochs``), by the Gaussian at the optimum."""
    columns, covariance = registration.problem.columns, registration.covariance
    camera_p = transform_points(inverse(registration.optimum.state.trus_T_camera(place)[0]), targets_mm)
    # A right perturbation (omega, v) moves the camera point p by omega x p + v.
    move = np.concatenate([-hat(camera_p), np.broadcast_to(np.eye(3), (len(camera_p), 3, 3))], axis=-1)
    pose = slice(6 * place, 6 * place + 6)
    total = np.einsum("nij,jk,nik->n", move, covariance[pose, pose], move)
    worst = int(np.argmax(total))
    shares = []
    edge = columns.at(Constant.WINDOW_EDGE)
    assert edge is not None
    for known in (slice(columns.beam, columns.beam + 4), slice(edge, edge + 1)):
        cross, own = covariance[pose, known], covariance[known, known]
        explained = cross @ np.linalg.solve(own, cross.T)
        shares.append(float(np.trace(move[worst] @ explained @ move[worst].T) / total[worst]))
    return Causes(beam=shares[0], edge=shares[1])


def beam_sides(lambda_mm: FloatArray) -> list[Condition]:
    """Spots behind the laser's origin: the beam does not go there."""
    behind = int(np.sum(lambda_mm < 0))
    if behind == 0:
        return []
    return [
        Condition(
            Verdict.WARNING,
            f"{behind} of {len(lambda_mm)} spots lie behind the beam's origin: check marker and initial.marker_T_laser",
        )
    ]
