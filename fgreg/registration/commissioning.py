"""The rig's constants from several sessions, as one graph: the constants common, all else of each session its own.

With every session's own variables eliminated (Schur complement of its reduced graph) a session is a quadratic of the
common constants c, its *evidence*; the sum of all evidence and one prior gives c. Own and common variables step
together, by Gauss-Newton on the one graph, until they settle: its optimum.

    minimise  (c - m)' P (c - m) + sum over sessions of F_i(x_i, c)

What pooling needs and one session does not is how noise scales with the constants (:func:`noise_slope`).

The marker's bias stays each session's own: it comes from light, focus and window of the day. All other constants belong
to probe, stage, cameras and prints.

A new session is compared with a rig as on a control chart: its evidence alone, against the rig's mean m and covariance
C. With information S and score u = S (c - m) of the session (its estimate c need not be determined), and the matrix
M = S - S (S + C^-1)^-1 S, which is (S^-1 + C)^-1:

    whether it is the same rig        chi square of u' S^-1 M S^-1 u in the directions that the session sees
    whether constant k alone changed  z = v_k / sqrt(M_kk), v = M (c - m), by v_k / M_kk
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.special import chdtrc, ndtri

from fgreg.errors import EstimationError
from fgreg.geometry.rig import CAMERA, COUNT, Constant
from fgreg.geometry.transforms import BoolArray, FloatArray
from fgreg.graph.known_points import point_arrays
from fgreg.graph.packing import PackedProblem, constants_prior, least_sigmas
from fgreg.graph.reduced_blocks import PrivateState
from fgreg.graph.reduced_graph import Evaluation, evaluate
from fgreg.graph.reduced_system import refine
from fgreg.graph.scaled_inverse import scaled_inverse, scaled_solve
from fgreg.graph.shared_state import SharedState
from fgreg.model.camera_dependence import nominal_spot_gain
from fgreg.model.measurements import Check
from fgreg.model.session_model import SessionModel
from fgreg.registration.register import Registration

OWN = (Constant.WINDOW_EDGE, Constant.MARKER_BIAS_X, Constant.MARKER_BIAS_Y, Constant.MARKER_BIAS_Z)
"""Constants that each session has for itself: the window's width changes with tissue and gain, the marker's bias with
the light of the day."""
SETTLED = 1e-6
"""Newton decrement (chi square) of the whole graph below which it is at its optimum."""
ROUNDS, HALVINGS = 50, 12
OBSERVED = 0.5
"""Share of a constant's prior variance that is gone where the sessions alone know it as well as its prior does."""
NOTE_P, ALARM_P = 0.02, 0.002
"""False alarms of a control chart: of a session of the same rig, all tests together."""
STRETCH_MM = 1.0
"""Step of the differences that tell how a spot's gain changes with the spot."""
SEEN = 0.1
"""A direction counts in the chi square where the session's information is at least this share of the prior's."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What one session alone says about the common constants c: chi square ``c' information c - 2 pull' c``.

    ``information`` (K, K), which may be singular; ``pull`` (K,).
    """

    information: FloatArray
    pull: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Commissioned:
    """The common constants.

    Attributes:
        constants: those that are common and variables, K of them, in ascending order.
        value: (K,) true less declared. covariance: (K, K).
        prior_sigma: (K,).
        evidence: of each session at the optimum.
        rounds: Gauss-Newton steps.
    """

    constants: tuple[Constant, ...]
    value: FloatArray
    covariance: FloatArray
    prior_sigma: FloatArray
    evidence: tuple[Evidence, ...]
    rounds: int

    @property
    def sigma(self) -> FloatArray:
        """(K,)"""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def observed(self) -> FloatArray:
        """(K,) share of the prior variance that is gone."""
        return np.asarray(np.clip(1.0 - (self.sigma / self.prior_sigma) ** 2, 0.0, 1.0))

    @property
    def score(self) -> FloatArray:
        """(K,) by how many standard deviations the sessions contradict each prior."""
        known = np.maximum(self.prior_sigma**2 * self.observed, 1e-6 * self.prior_sigma**2)
        return np.asarray(self.value / np.sqrt(known))

    def without(self, place: int) -> tuple[FloatArray, FloatArray]:
        """Mean (K,) and covariance (K, K) without one of the sessions."""
        rest = scaled_inverse(self.covariance) - self.evidence[place].information
        covariance = scaled_inverse(rest)
        pull = np.sum([found.pull for found in self.evidence], axis=0) - self.evidence[place].pull
        return covariance @ pull, covariance


@dataclass(slots=True, eq=False)
class _Session:
    """One session's graph at its current variables: no prior on the common constants."""

    problem: PackedProblem
    common: BoolArray
    slope: FloatArray
    state: SharedState
    at: Evaluation

    def moved(self, step: FloatArray) -> _Session:
        """After a step (D,) of all its variables."""
        points = self.at.private.trus_p_pm + (self.at.point_gain @ step[:, None])[..., 0]
        state = self.state.retract(step[None], self.problem.columns)
        private = refine(self.problem, state, replace(self.at.private, trus_p_pm=points))
        return replace(self, state=state, at=_evaluated(self.problem, state, private, self.slope))

    @property
    def value(self) -> FloatArray:
        """(K,) the common constants."""
        return np.asarray(self.state.constants[0, list(self.problem.columns.constants)])[
            self.common[self.problem.columns.rig]
        ]

    @property
    def evidence(self) -> Evidence:
        """Its own variables eliminated."""
        hessian, gradient = self.at.hessian[0], self.at.gradient[0]
        own, common = ~self.common, self.common
        cross = hessian[np.ix_(own, common)]
        back = scaled_solve(hessian[np.ix_(own, own)], np.column_stack([cross, gradient[own]]))
        information = hessian[np.ix_(common, common)] - cross.T @ back[:, :-1]
        information = 0.5 * (information + information.T)
        return Evidence(information, information @ self.value - (gradient[common] - cross.T @ back[:, -1]))

    def step_to(self, value: FloatArray) -> FloatArray:
        """(D,) to common constants (K,), with all others at their optimum given these."""
        hessian, gradient = self.at.hessian[0], self.at.gradient[0]
        own, common = ~self.common, self.common
        step = np.zeros(len(gradient))
        step[common] = value - self.value
        pull = gradient[own] + hessian[np.ix_(own, common)] @ step[common]
        step[own] = -scaled_solve(hessian[np.ix_(own, own)], pull[:, None])[:, 0]
        return step


def noise_slope(registration: Registration) -> FloatArray:
    """(K,) by how much half the chi square falls per unit of each constant, since noise is the measurement's own.

    The graph compares a measurement m times (1 + c) with a residual of fixed noise s. But the noise of m (1 + c) is
    s (1 + c): the chi square r^2 / s^2 is r^2 / (s (1 + c))^2, which falls by 2 r^2 / s^2 per c. Left out, all such c
    would be too small: by 0.1 prior sigmas of the sound speed in one session, but by as much as the standard deviation
    once ten are pooled. It concerns x, range, and the spots of aims; poses have next to no residual.
    """
    problem, at, model = registration.problem, registration.optimum.evaluation, registration.model
    out = np.zeros(COUNT)
    residual = at.look_residual[0, :, :2]
    weighted = np.einsum("nij,nj->ni", problem.looks.weight[:, :2, :2], residual)
    out[[Constant.PITCH, Constant.SOUND_SPEED]] = np.sum(residual * weighted, axis=0)
    constants = registration.optimum.state.constants[0, CAMERA]
    shift = at.private.aim_shift[0] - problem.aim_spot_by_constants @ constants  # what the constants do is no residual
    weighted = np.linalg.solve(problem.aim_spot_covariance, shift[..., None])[..., 0]
    for axis in range(3):
        step = STRETCH_MM * np.eye(3)[axis]
        ends = [nominal_spot_gain(model, problem.aim_spot_mm + sign * step) for sign in (1.0, -1.0)]
        by_spot = (ends[0] - ends[1]) / (2.0 * STRETCH_MM)
        out[CAMERA] += np.einsum("ni,nik,n->k", weighted, by_spot, shift[:, axis])
    return out[list(problem.columns.constants)]


def _evaluated(problem: PackedProblem, state: SharedState, private: PrivateState, slope: FloatArray) -> Evaluation:
    at = evaluate(problem, state, private)
    gradient = at.gradient.copy()
    gradient[0, problem.columns.rig] -= slope
    cost = at.cost - 2.0 * slope @ state.constants[0, list(problem.columns.constants)]
    return replace(at, cost=cost, gradient=gradient)


def _session(registration: Registration, constants: Sequence[Constant], checks: Sequence[Check]) -> _Session:
    """A session's graph at its own optimum, without the prior on the common constants."""
    problem, model = registration.problem, registration.model
    columns = problem.columns
    sigmas = least_sigmas(model.constant_sigmas)
    sigmas[list(constants)] = np.inf
    prior = constants_prior(registration.measurements, columns, sigmas, model.constant_means)
    points = [*registration.measurements.points]
    places = [point.epoch for point in points]
    data = [check for check in checks if check.epoch in registration.epochs]
    places += [registration.epochs.index(check.epoch) for check in data]
    located = point_arrays([*points, *data], model, places)
    problem = replace(problem, prior=prior, shapes=None, points=located)
    common = np.zeros(columns.size, dtype=bool)
    common[columns.rig] = np.isin(columns.constants, constants)
    state = registration.optimum.state
    slope = noise_slope(registration)
    at = _evaluated(problem, state, registration.optimum.evaluation.private, slope)
    return _Session(problem, common, slope, state, at)


def session_evidence(
    registration: Registration, constants: Sequence[Constant], checks: Sequence[Check] = ()
) -> Evidence:
    """What one session says about some of the constants, at its own optimum.

    Args:
        registration: in which the constants are variables, with independent priors.
        constants: in ascending order.
        checks: points known to both devices, as data.
    """
    return _session(registration, constants, checks).evidence


def common_constants(model: SessionModel) -> tuple[Constant, ...]:
    """The constants that a session takes as uncertain and that are common to the sessions of a rig."""
    return tuple(c for c, sigma in zip(Constant, model.constant_sigmas, strict=True) if sigma > 0.0 and c not in OWN)


def commission(registrations: Sequence[Registration], checks: Sequence[Sequence[Check]] = ()) -> Commissioned:
    """The constants of the rig that sessions have in common.

    Args:
        registrations: at least one, each at its optimum; all with the same priors of the constants, and without a rig.
        checks: of each session, as data; none where absent.

    Raises:
        EstimationError: the graph does not settle.
    """
    given = [*checks] or [()] * len(registrations)
    constants = common_constants(registrations[0].model)
    sessions = [_session(found, constants, points) for found, points in zip(registrations, given, strict=True)]
    prior_sigma = registrations[0].model.constant_sigmas[list(constants)]
    prior = np.diag(prior_sigma**-2.0)

    def cost(of: Sequence[_Session], value: FloatArray) -> float:
        return float(value @ prior @ value + sum(one.at.cost[0] for one in of))

    value = None
    for rounds in range(1, ROUNDS + 1):
        evidence = [one.evidence for one in sessions]
        total = prior + np.sum([found.information for found in evidence], axis=0)
        wanted = scaled_solve(total, np.sum([found.pull for found in evidence], axis=0)[:, None])[:, 0]
        steps = [one.step_to(wanted) for one in sessions]
        if value is None:  # each is at its own optimum, with constants of its own
            sessions = [one.moved(step) for one, step in zip(sessions, steps, strict=True)]
            value = wanted
            continue
        decrement = -sum(float(step @ one.at.gradient[0]) for one, step in zip(sessions, steps, strict=True))
        decrement -= float((wanted - value) @ prior @ value)
        if decrement < SETTLED:
            return Commissioned(constants, value, scaled_inverse(total), prior_sigma, tuple(evidence), rounds)
        before = cost(sessions, value)
        for halving in range(HALVINGS):
            share = 0.5**halving
            trial = [one.moved(share * step) for one, step in zip(sessions, steps, strict=True)]
            there = value + share * (wanted - value)
            if cost(trial, there) <= before + SETTLED:
                sessions, value = trial, there
                break
        else:
            break
    raise EstimationError("the sessions' common constants do not settle: commission fewer of them, to find which")


class ChartVerdict(StrEnum):
    """Of a session against a rig."""

    PASS = "pass"
    NOTE = "note"
    ALARM = "alarm"


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """A session compared with a rig.

    Attributes:
        verdict: pass, or what the tests together have by chance at most in ``NOTE_P`` or ``ALARM_P`` of sessions.
        chi_square, degrees_of_freedom: of the session's evidence in the directions that it sees.
        z: (K,) whether each constant alone has changed.
        change: (K,) by how much, the rig's value left behind. change_sigma: (K,); infinite where nothing tells.
    """

    verdict: ChartVerdict
    chi_square: float
    degrees_of_freedom: int
    z: FloatArray
    change: FloatArray
    change_sigma: FloatArray


def control_chart(evidence: Evidence, mean: FloatArray, covariance: FloatArray, scale: FloatArray) -> Chart:
    """Compare a session's evidence with a rig.

    Args:
        evidence: of the session alone, over the same constants.
        mean: (K,) of the rig. covariance: (K, K).
        scale: (K,) size of a change that matters: the constants' prior standard deviations.
    """
    outer = np.outer(scale, scale)
    information, spread = outer * evidence.information, covariance / outer
    score = scale * (evidence.pull - evidence.information @ mean)
    gain = scaled_solve(information + scaled_inverse(spread), np.column_stack([information, score]))
    whole = information - information @ gain[:, :-1]
    tested = score - information @ gain[:, -1]
    values, vectors = np.linalg.eigh(information)
    seen = values >= SEEN
    chi_square, count = 0.0, int(seen.sum())
    if count:
        basis = vectors[:, seen]
        estimate = (basis.T @ score) / values[seen]
        off = np.diag(1.0 / values[seen]) + basis.T @ spread @ basis
        chi_square = float(estimate @ np.linalg.solve(off, estimate))
    told = np.diag(whole) > SEEN**2
    root = np.sqrt(np.where(told, np.diag(whole), 1.0))
    z = np.where(told, tested / root, 0.0)
    chance = float(chdtrc(count, max(chi_square, 0.0))) if count else 1.0
    beyond = float(np.abs(z).max(initial=0.0))
    verdict = ChartVerdict.PASS
    for limit, name in ((NOTE_P, ChartVerdict.NOTE), (ALARM_P, ChartVerdict.ALARM)):
        if chance < 0.5 * limit or beyond > z_limit(limit, int(told.sum())):
            verdict = name
    change_sigma = np.where(told, scale / root, np.inf)
    return Chart(verdict, chi_square, count, z, np.where(told, scale * tested / root**2, 0.0), change_sigma)


def z_limit(chance: float, count: int) -> float:
    """Of the z of one of ``count`` constants: half of the false alarms are the chi square's."""
    return float(-ndtri(0.25 * chance / max(count, 1)))
