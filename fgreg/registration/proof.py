"""What is proved of a registration, as sentences and for the result; other minima that the proof's search comes upon.

The certificate (fgreg.certificate) says where registrations may be that explain the pairs about as well. From those far
from the estimate a local search starts, on the whole graph. A better minimum, or another one within the threshold of
ambiguity, refuses the registration; a proof that fails leaves the verdict as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.certificate.certify import Certificate, WithoutPairs, certify
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.contributions import contributions
from fgreg.graph.reduced_graph import evaluate
from fgreg.graph.reduced_solver import optimize
from fgreg.graph.reduced_system import private_at, refine
from fgreg.graph.scaled_inverse import inverse_hessian
from fgreg.model.estimate import CertificateEstimate, Verdict
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.epochs import has_registration
from fgreg.registration.multistart import SAME_MINIMUM_MM, targets_moved
from fgreg.registration.register import SAME_CHI2, Registration
from fgreg.registration.verdict import Condition

STEPS = 40
"""Of each local search."""
NEWTON_STEPS = 4
KNOWN_SLOPE = 0.15
"""Standard deviation (rad) of the beam's direction, without the pairs, up to which the aims determine it."""


@dataclass(frozen=True, slots=True, eq=False)
class Proof:
    """Of one epoch: what the result says of it, and conditions of the verdict."""

    estimate: CertificateEstimate
    conditions: tuple[Condition, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Other:
    """Another minimum: the registration (4, 4), chi square of the whole graph less that of the estimate."""

    trus_T_camera: FloatArray
    gap: float
    moved_mm: float


def prove(registration: Registration, epoch: int, config: SolveConfig) -> Proof | None:
    """The proof of one of the session's epochs; None where none is wanted, or the epoch is ambiguous anyway."""
    if not config.certificate_budget or epoch in registration.ambiguous:
        return None
    place, optimum = registration.epochs.index(epoch), registration.optimum
    problem, search = registration.problem, registration.searches[epoch]
    if any(place in (link.old, link.new) for link in problem.links) or (
        problem.anchor is not None and has_registration(problem.anchor)
    ):
        return _not_certified("it also rests on a measured camera motion")
    if len(problem.spots.beam) or len(problem.points):
        return _not_certified("the bounds do not cover visible spots of pairs, nor points known to both devices")
    if len(search.minima) > 1 and search.minima[1].cost - search.minima[0].cost < config.second_minimum_chi2:
        return _not_certified("initial.trus_T_camera decides between two registrations that explain the pairs")
    found = certify(
        problem,
        optimum.state,
        optimum.evaluation.private,
        place,
        without_pairs(registration, place),
        within_chi2=config.second_minimum_chi2,
        budget=config.certificate_budget,
    )
    if found is None:
        return _not_certified(
            "a spot is nearer to the array than the array is to its axis, which the bounds do not cover"
        )
    others = other_minima(registration, place, found.starts, config)
    pms = len(np.unique(problem.beam_pm[problem.beam_epoch == place]))
    return proof_of(found, others, pms, float(optimum.evaluation.cost[0]))


def without_pairs(registration: Registration, place: int) -> WithoutPairs | None:
    """The optimum of an epoch's registration with the beam as aims and priors have it, all else as estimated.

    None where these do not determine the beam.
    """
    problem, optimum = registration.problem, registration.optimum
    state, private = optimum.state, optimum.evaluation.private
    parts, beam = contributions(problem, state, private), slice(problem.columns.beam, problem.columns.beam + 4)
    hessian = (parts.aim.total() + parts.prior_hessian)[0, beam, beam]
    gradient = (parts.aim.gradient[0].sum(axis=0) + parts.prior_gradient[0])[beam]
    covariance = inverse_hessian(hessian)
    if covariance is None or np.sqrt(np.diag(covariance)[2:]).max() > KNOWN_SLOPE:
        return None
    step = np.zeros((1, problem.columns.size))
    step[0, beam] = -covariance @ gradient
    state, pose = state.retract(step, problem.columns), slice(6 * place, 6 * place + 6)
    private = private_at(problem, state)
    for _ in range(NEWTON_STEPS):
        at = evaluate(problem, state, private)
        step = np.zeros((1, problem.columns.size))
        step[0, pose] = -np.linalg.solve(at.hessian[0, pose, pose], at.gradient[0, pose])
        state, private = state.retract(step, problem.columns), at.private
    lambdas = [optimum.evaluation.aim_lambda_mm[0], optimum.evaluation.lambda_mm[0]]
    distance_mm = float(np.median(np.abs(lambdas[0] if len(lambdas[0]) else lambdas[1])))
    return WithoutPairs(state, refine(problem, state, private), distance_mm)


def other_minima(registration: Registration, place: int, starts: FloatArray, config: SolveConfig) -> tuple[Other, ...]:
    """Minima of the whole graph within the threshold, other than the estimate, best first.

    Args:
        registration: the estimate. place: of the epoch.
        starts: (n, 4, 4) registrations of the epoch.
    """
    if not len(starts):
        return ()
    problem, optimum = registration.problem, registration.optimum
    states = optimum.state.take(np.zeros(len(starts), dtype=np.int64))
    rotation, translation = states.rotation.copy(), states.translation_mm.copy()
    rotation[:, place], translation[:, place] = starts[:, :3, :3], starts[:, :3, 3]
    states = replace(states, rotation=rotation, translation_mm=translation)
    found = optimize(problem, states, max_iterations=STEPS)
    here, targets = optimum.state.trus_T_camera(place)[0], registration.model.targets_mm
    out: list[Other] = []
    gaps = found.evaluation.cost - optimum.evaluation.cost[0]
    for index in np.argsort(gaps):
        there = found.state.trus_T_camera(place)[index]
        if not gaps[index] < config.second_minimum_chi2:
            break
        moved = targets_moved(here, there, targets)
        if moved > SAME_MINIMUM_MM or gaps[index] < -SAME_CHI2:
            out.append(Other(there, float(gaps[index]), moved))
    return tuple(out)


def proof_of(found: Certificate, others: Sequence[Other], pms: int, cost: float) -> Proof:
    """The proof from a certificate and the minima that were found; ``cost``: of the whole graph."""
    within = found.within_chi2
    estimate = CertificateEstimate(
        proved=found.is_least and found.is_alone and found.holds_without_pairs and not others,
        gap=found.gap,
        within_chi2=within,
        within_rad=found.within_rad if found.is_alone else None,
        within_mm=found.within_mm if found.is_alone else None,
    )
    if others:
        best = others[0]
        figures, away = f"chi square {cost + best.gap:.1f} against {cost:.1f}", f"up to {best.moved_mm:.0f} mm away"
        if best.gap < -SAME_CHI2:
            text = (
                f"a better registration explains the {pms} pairs ({figures}; {away} at a target): give it as "
                "initial.trus_T_camera and solve again"
            )
        else:
            text = (
                f"another registration explains the {pms} pairs as well ({figures}, {within:.1f} apart needed; {away} "
                "at a target): take more pairs at other spots and beam directions"
            )
        estimate = replace(estimate, other_trus_T_camera=best.trus_T_camera, reason=text)
        return Proof(estimate, (Condition(Verdict.REFUSED, text),))
    if not found.is_least:
        shown = f"the search for a better one stopped with a gap of {100.0 * min(found.gap, 1.0):.1f} %"
        return _not_certified(f"{shown}; more pairs, found by sweeps (first hits), make the proof easier", estimate)
    if not found.is_alone:
        shown = "another one is not excluded" if found.finished else "the search for others stopped before its end"
        text = f"no registration is better, proved, but {shown} within {within:.1f} of chi square; take more pairs"
        return _not_certified(text, estimate)
    if not found.holds_without_pairs:
        why = "the aims leave a beam open with which another registration may fit as well; take more aims, at short and"
        return _not_certified(f"{why} long distances", estimate)
    degrees, mm = (math.ceil(10.0 * value) / 10.0 for value in (math.degrees(found.within_rad), found.within_mm))
    text = (
        f"no other registration explains these pairs within {within:.1f} of its chi square, proved: all that do are "
        f"turned by at most {degrees:.1f} deg from it and move the middle of the pairs by at most {mm:.1f} mm (beam "
        "and the rig's constants, windows and inliers as estimated)"
    )
    return Proof(estimate, (Condition(Verdict.OK, text),))


def _not_certified(why: str, estimate: CertificateEstimate | None = None) -> Proof:
    text = f"not certified: {why}"
    found = estimate or CertificateEstimate(False, None, None, None, None)
    return Proof(replace(found, reason=text), (Condition(Verdict.OK, text),))
