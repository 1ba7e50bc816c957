"""What part of the predicted error is systematic, which of the rig's constants cause it, and what the data say of them.

All by the Gaussian at the optimum of the graph (Hessian H of the shared variables, covariance H^-1), in which the
constants c are variables: exact for what enters linearly, as the constants do, and free of the sampling noise of the
posterior. With the covariance split into registration p and constants c:

    random part        S_pp - S_pc S_cc^-1 S_cp, the error if all constants were known
    systematic part    S_pc S_cc^-1 S_cp, what is left of them
    one constant k     S_pk S_kk^-1 S_kp, what would go if this one were known

A constant that the data bear out has ``value / sqrt(prior variance - variance)`` standard normal before the data are
seen: this is the score test of its prior mean (Rao, 1948), and its square what the chi square would fall by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.target_error import target_jacobians
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import PredictedPart, PredictedTre, SystematicEstimate, TargetEstimate, Verdict
from fgreg.model.scanner_dependence import scanner_gain
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.systematic import TEXTS
from fgreg.registration.posterior import QUANTILE, Posterior, predicted_tre
from fgreg.registration.register import Registration, constants_of
from fgreg.registration.verdict import Condition

DRAWS = 2000
"""Of a Gaussian in three dimensions, for the quantile of its length."""
CONFLICT_Z = 3.5
"""Score of a constant from which it is named: one session in 2,000 has it by chance, for each constant that its data
determine."""
ALIKE_CHI2 = 9.0
"""The squared score is what the chi square falls by: constants within this of the largest, three sigma, cannot be told
apart from it."""
UNOBSERVED = 1e-3
"""Share of a constant's prior variance that the data have to remove before a score means anything."""
_MEASURED = (TEXTS[Constant.SOUND_SPEED].name, TEXTS[Constant.RANGE_OFFSET].name)
NOTED_SIGMAS = 1.5
CERTAIN_SIGMAS = 4.0
"""A constant that the shots measure is noted where it is off by this many of its prior's sigmas, and of its own."""
FAR_SIGMAS = 30.0
"""Prior standard deviations beyond which no figure is given."""
Part = TypeVar("Part", PredictedPart, PredictedTre)


@dataclass(frozen=True, slots=True, eq=False)
class Budget:
    """The systematic part of a solve.

    Attributes:
        constants: one for each of the rig's constants that is a variable.
        predicted: the predicted error of each solved epoch with its parts, in the order of ``registration.epochs``.
        targets: the same at each target.
        conditions: of constants that the data contradict.
    """

    constants: tuple[SystematicEstimate, ...]
    predicted: tuple[PredictedTre, ...]
    targets: tuple[tuple[TargetEstimate, ...], ...]
    conditions: tuple[Condition, ...]


def error_budget(registration: Registration, posterior: Posterior, config: SolveConfig) -> Budget:
    """The budget of a registration at the optimum of the graph (before it is centred on the posterior's mean)."""
    model, columns = registration.model, registration.problem.columns
    sigmas, mean = constants_of(model, config)
    predicted = [_predicted(registration, posterior, place) for place in range(len(registration.epochs))]
    last = len(registration.epochs) - 1
    causes = _causes_mm(registration, last)
    covariance, value = registration.covariance, registration.optimum.state.constants[0]
    constants = []
    for place, constant in enumerate(columns.constants):
        at = columns.first_constant + place
        prior, sigma = float(sigmas[constant]), float(np.sqrt(covariance[at, at]))
        text = TEXTS[constant]
        if prior <= 0.0:
            continue
        observed = min(max(1.0 - (sigma / prior) ** 2, 0.0), 1.0)
        score = float(value[constant] - mean[constant]) / (prior * np.sqrt(observed)) if observed > UNOBSERVED else 0.0
        constants.append(
            SystematicEstimate(
                name=text.name,
                prior_sigma=prior * text.per_unit,
                value=float(value[constant]) * text.per_unit,
                sigma=sigma * text.per_unit,
                observed=observed,
                score=float(score),
                worst_target_mm=float(causes[place]),
            )
        )
    return Budget(
        constants=tuple(constants),
        predicted=tuple(whole for whole, _ in predicted),
        targets=tuple(each for _, each in predicted),
        conditions=tuple(conflicts(constants) or measured(constants)),
    )


def random_errors_only(model: SessionModel) -> list[Condition]:
    """A session that declares no systematic errors knows its random errors only."""
    if model.systematic.declared:
        return []
    text = (
        "systematic: none in session.yaml, so the predicted error is that of random errors only: state how well probe, "
        "stage, camera and prints are known"
    )
    return [Condition(Verdict.WARNING, text)]


def conflicts(constants: Sequence[SystematicEstimate]) -> list[Condition]:
    """Constants that the data contradict: the one with the largest score, and those that cannot be told apart."""
    beyond = sorted((c for c in constants if abs(c.score) >= CONFLICT_Z), key=lambda c: -abs(c.score))
    if not beyond:
        return []
    first = beyond[0]
    alike = [c for c in constants if c is not first and c.score**2 > first.score**2 - ALIKE_CHI2]
    named = [first, *sorted(alike, key=lambda c: -abs(c.score))]
    texts = {text.name: text for text in TEXTS}
    which = " or ".join(
        f"the {texts[c.name].what} ({_amount(c)} where it is declared to 1 sigma of {_sigma(c)}, "
        f"score {abs(c.score):.1f})"
        for c in named
    )
    remedies = "; ".join(dict.fromkeys(texts[c.name].remedy for c in named))
    effect = max(_remaining_mm(c) for c in named)
    return [Condition(Verdict.WARNING, f"the shots contradict {which}: {remedies}", effect)]


def with_effects(predicted: PredictedTre, conditions: Sequence[Condition]) -> PredictedTre:
    """The predicted error with that of constants which tests name, in its systematic part.

    An error of m mm beside one whose 95 % quantile is q has a quantile of at most q + m.
    """
    effect = sum(condition.effect_mm for condition in conditions)
    if not effect:
        return predicted

    def more(part: Part) -> Part:
        mean = float(np.hypot(part.mean_mm, effect))
        return replace(part, mean_mm=mean, p95_mm=part.p95_mm + effect, worst_mm=part.worst_mm + effect)

    return replace(
        more(predicted),
        systematic=None if predicted.systematic is None else more(predicted.systematic),
        seen=None if predicted.seen is None else more(predicted.seen),
    )


def targets_with_effects(
    targets: Sequence[TargetEstimate], conditions: Sequence[Condition]
) -> tuple[TargetEstimate, ...]:
    """:func:`with_effects` at each target."""
    effect = sum(condition.effect_mm for condition in conditions)
    return tuple(
        replace(
            target,
            rms_mm=float(np.hypot(target.rms_mm, effect)),
            p95_mm=target.p95_mm + effect,
            systematic_mm=target.systematic_mm + effect,
        )
        for target in targets
    )


def measured(constants: Sequence[SystematicEstimate]) -> list[Condition]:
    """Notes on what wavefronts measure: a sound speed or an offset well off, though within what is declared.

    Where a constant is contradicted, no other one is to be corrected before it.
    """
    found = []
    for constant in constants:
        pulled = abs(_pulled(constant)[0])
        off = pulled > NOTED_SIGMAS * constant.prior_sigma * constant.observed
        if constant.name in _MEASURED and off and pulled > CERTAIN_SIGMAS * constant.sigma:
            text = {text.name: text for text in TEXTS}[constant.name]
            found.append(
                Condition(
                    Verdict.OK,
                    f"the shots measure the {text.what}, and it is taken into account: {_amount(constant)} "
                    f"(declared to 1 sigma of {_sigma(constant)}); correct what is declared",
                )
            )
    return found


def _pulled(constant: SystematicEstimate) -> tuple[float, float]:
    """By how much the shots move a constant from what was expected, and how much more they would without its prior."""
    pulled = constant.score * constant.prior_sigma * float(np.sqrt(constant.observed))
    return pulled, pulled * (1.0 / max(constant.observed, 1e-6) - 1.0)


def _remaining_mm(constant: SystematicEstimate) -> float:
    """Error at the worst target where a constant is what the shots alone say, and not what its prior pulls it to."""
    more = min(abs(_pulled(constant)[1]), FAR_SIGMAS * constant.prior_sigma)
    return constant.worst_target_mm * more / constant.sigma


def _amount(constant: SystematicEstimate) -> str:
    """By how much a constant differs from the declared one."""
    value = constant.value + _pulled(constant)[1]
    if abs(value) > FAR_SIGMAS * constant.prior_sigma:
        return "far off"  # where it does not enter linearly, and its figure means nothing
    unit = {text.name: text for text in TEXTS}[constant.name].unit
    if not unit:
        return f"{100.0 * abs(value):.1f} % {'larger' if value > 0 else 'smaller'} than declared fits best"
    return f"{value:+.2g} {unit} fits best"


def _sigma(constant: SystematicEstimate) -> str:
    unit = {text.name: text for text in TEXTS}[constant.name].unit
    return f"{constant.prior_sigma:.2g} {unit}" if unit else f"{100.0 * constant.prior_sigma:.2g} %"


def _parts(registration: Registration, place: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Covariance blocks of an epoch's registration and the constants: (6, 6), (6, K), (K, K)."""
    pose, rig, covariance = slice(6 * place, 6 * place + 6), registration.problem.columns.rig, registration.covariance
    return covariance[pose, pose], covariance[pose, rig], covariance[rig, rig]


def _traces(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """(n,) expected squared error at the targets."""
    return np.asarray(np.einsum("nij,jk,nik->n", jacobian, covariance, jacobian))


def _predicted(
    registration: Registration, posterior: Posterior, place: int
) -> tuple[PredictedTre, tuple[TargetEstimate, ...]]:
    """Predicted error of one epoch, its random and systematic part, and that of targets which the scanner shows; and
    the error at each target.

    Total figures are those of the posterior's samples; the parts have the shares of the Gaussian at the optimum.
    """
    targets_mm = registration.model.targets_mm
    total, root, quantiles = predicted_tre(posterior, place, targets_mm)
    transform = registration.optimum.state.trus_T_camera(place)[0]
    jacobian = target_jacobians(transform, targets_mm)
    pose, cross, own = _parts(registration, place)
    explained = cross @ np.linalg.solve(own, cross.T)
    share = np.clip(_traces(jacobian, explained) / np.maximum(_traces(jacobian, pose), 1e-30), 0.0, 1.0)

    random, systematic = np.sqrt(1.0 - share), np.sqrt(share)

    def part(factor: FloatArray) -> PredictedPart:
        return PredictedPart(
            float((root * factor).mean()), float((quantiles * factor).mean()), float((quantiles * factor).max())
        )

    seen = _seen(registration, place, jacobian, targets_mm)
    whole = replace(total, random=part(random), systematic=part(systematic), seen=seen)
    return whole, tuple(
        TargetEstimate(name, point, *(float(figure) for figure in figures))
        for name, point, *figures in zip(
            registration.model.target_names,
            targets_mm,
            root,
            quantiles,
            quantiles * random,
            quantiles * systematic,
            strict=True,
        )
    )


def _causes_mm(registration: Registration, place: int) -> FloatArray:
    """(K,) RMS error at the epoch's worst target that would go if one constant were known."""
    transform = registration.optimum.state.trus_T_camera(place)[0]
    jacobian = target_jacobians(transform, registration.model.targets_mm)
    pose, cross, own = _parts(registration, place)
    worst = jacobian[int(np.argmax(_traces(jacobian, pose)))]
    moved = worst @ cross / np.sqrt(np.diag(own))
    return np.asarray(np.linalg.norm(moved, axis=0))


def _seen(registration: Registration, place: int, jacobian: FloatArray, targets_mm: FloatArray) -> PredictedPart:
    """Predicted distance between where the registration puts targets and where the scanner shows them."""
    state, columns = registration.optimum.state, registration.problem.columns
    transform = state.trus_T_camera(place)[0]
    shown = scanner_gain(registration.model.probe.radius_mm, targets_mm)[..., list(columns.constants)]
    shown = np.einsum("ji,njk->nik", transform[:3, :3], shown)  # to the camera's axes
    gain = np.concatenate([jacobian, -shown], axis=2)
    pose, cross, own = _parts(registration, place)
    covariance = np.block([[pose, cross], [cross.T, own]])
    mean = -shown @ state.constants[0, columns.constants]
    spread = gain @ covariance @ gain.swapaxes(1, 2)
    root = np.linalg.cholesky(spread + 1e-12 * np.eye(3))
    draws = np.random.default_rng(0).standard_normal((DRAWS, 3))
    moved = draws @ root.swapaxes(1, 2) + mean[:, None]
    length = np.sqrt(np.square(moved[..., 0]) + np.square(moved[..., 1]) + np.square(moved[..., 2]))
    quantiles = np.quantile(length, QUANTILE, axis=1)
    square = np.trace(spread, axis1=1, axis2=2) + np.sum(mean**2, axis=1)
    return PredictedPart(float(np.sqrt(square).mean()), float(quantiles.mean()), float(quantiles.max()))
