"""From the optimum to the posterior mean, which is the session's estimate.

The search ends at the optimum of the graph with Gaussian windows (fgreg.registration.register). There the explicit
graph is compared, and residuals are evaluated. The reported estimate is the mean of the posterior, which has the
windows' own shapes and the nonlinear geometry: its expected error is smaller, and the posterior's moments are about it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.expectation_propagation import propagate
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import PrivateState, initial_private
from fgreg.graph.reduced_graph import evaluate
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.reduced_system import refine
from fgreg.graph.scaled_inverse import inverse_hessian
from fgreg.graph.shared_state import SharedState, make_state, stack_states
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.joint_solve import Shots
from fgreg.registration.multistart import targets_moved
from fgreg.registration.outliers import log_outlier
from fgreg.registration.posterior import (
    MOST_TRANSLATION_MM,
    Mode,
    OutlierMixture,
    Posterior,
    gaussian_posterior,
    sample_posterior,
)
from fgreg.registration.register import Registration

RIVALS = 3
"""Largest number of other minima that enter the posterior."""
RIVAL_CHI2 = 14.0
"""Minima whose chi square is larger by more than this have too small a share of the posterior to matter."""
OPEN_PMS = 5
"""With fewer PMs the registration is undetermined, however many samples there are: a third of the draws is enough."""


@dataclass(frozen=True, slots=True, eq=False)
class PosteriorMean:
    """The session's estimate: ``registration`` with its optimum moved to the posterior mean, and the posterior.

    ``registration.problem`` has the windows' expectation propagation sites where these converged.
    ``registration.covariance`` is the posterior's second moment about the estimate. The posterior was sampled about
    ``modes``.
    """

    registration: Registration
    posterior: Posterior
    modes: tuple[Mode, ...]


def posterior_mean(registration: Registration, config: SolveConfig) -> PosteriorMean:
    """Sample the posterior of a registration and centre the estimate on it."""
    modes = _modes(registration)
    if len(registration.problem.look_pm) > config.posterior_looks:
        posterior = gaussian_posterior(modes[0], count=round(config.posterior_effective), seed=config.seed)
    else:
        few = len(registration.problem.pms) < OPEN_PMS
        most = config.posterior_samples // 3 if few else config.posterior_samples
        posterior = sample_posterior(modes, goal=config.posterior_effective, most=most, seed=config.seed)
    problem = modes[0].problem
    moved = _evaluated(problem, posterior.mean, modes[0].optimum)
    shots = _moved_shots(registration.shots, problem, moved)
    return PosteriorMean(
        replace(registration, problem=problem, optimum=moved, covariance=posterior.covariance, shots=shots),
        posterior,
        modes,
    )


def _moved_shots(shots: Shots, problem: PackedProblem, moved: Optimum) -> Shots:
    """All shots at the moved estimate, inliers with the sites of ``problem``; innovations stay those of the optimum."""
    if shots.pm_inlier.all() and shots.aim_inlier.all():
        return replace(shots, problem=problem, evaluation=moved.evaluation)
    whole = _with_all_pms(shots, problem)
    return replace(shots, problem=whole, evaluation=evaluate(whole, moved.state, _settled(whole, moved.state)))


def _with_all_pms(shots: Shots, problem: PackedProblem) -> PackedProblem:
    """All shots, inliers with the sites of ``problem``."""
    looks, kept = shots.problem.looks, shots.pm_inlier[shots.problem.look_pm]
    weight, centre = looks.weight.copy(), looks.centre_rad.copy()
    weight[kept], centre[kept] = problem.looks.weight, problem.looks.centre_rad
    return replace(shots.problem, looks=replace(looks, weight=weight, centre_rad=centre))


def _settled(problem: PackedProblem, state: SharedState) -> PrivateState:
    private = initial_private(problem, state)
    for _ in range(4):
        private = refine(problem, state, private)
    return private


def _with_outlier_mixture(shots: Shots, mode: Mode) -> Mode:
    """The mode with all PMs in its density, each either inlier or outlier: which of them is not certain."""
    if shots.pm_inlier.all():
        return mode
    problem, state = mode.problem, mode.optimum.state
    whole = replace(
        _with_all_pms(shots, problem),
        aims=problem.aims,
        aim_spot_mm=problem.aim_spot_mm,
        aim_spot_covariance=problem.aim_spot_covariance,
        aim_spot_by_constants=problem.aim_spot_by_constants,
    )
    whole = replace(whole, log_outlier=log_outlier(whole, shots.pm_inlier))
    at = evaluate(whole, state, _settled(whole, state))
    return replace(mode, mixture=OutlierMixture(whole, at.private, at.point_gain))


@dataclass(frozen=True, slots=True)
class Estimated:
    """A session-wide variable: value and standard deviation."""

    value: float
    sigma: float


def estimated_sound_speed(found: Registration) -> Estimated | None:
    """The ratio of true to assumed sound speed where it is a variable."""
    at = found.problem.columns.at(Constant.SOUND_SPEED)
    value = 1.0 + float(found.optimum.state.constant(Constant.SOUND_SPEED)[0])
    return None if at is None else Estimated(value, float(np.sqrt(found.covariance[at, at])))


def estimated_radius(found: Registration) -> Estimated | None:
    """The probe's radius (mm) where it is a variable."""
    at = found.problem.columns.at(Constant.RADIUS)
    value = found.problem.radius_mm + float(found.optimum.state.constant(Constant.RADIUS)[0])
    return None if at is None else Estimated(value, float(np.sqrt(found.covariance[at, at])))


def _with_sites(problem: PackedProblem, optimum: Optimum, covariance: FloatArray) -> Mode:
    """A mode of the posterior: with the windows' sites where they converge, else with Gaussian windows."""
    found = propagate(problem, optimum)
    if found is None:
        return Mode(problem, optimum, covariance)
    sites, there = found
    inverse = inverse_hessian(there.evaluation.hessian[0])
    away = np.linalg.norm(there.state.translation_mm, axis=-1).max()
    if inverse is None or not away <= MOST_TRANSLATION_MM:  # at few pairs the sites may let the optimum diverge
        return Mode(problem, optimum, covariance)
    return Mode(sites, there, inverse)


def _modes(registration: Registration) -> tuple[Mode, ...]:
    """The optimum's mode first, then those of other minima that have a share of the posterior."""
    problem, best = registration.problem, registration.optimum
    modes = [_with_sites(problem, best, registration.covariance)]
    targets, inliers = registration.model.targets_mm, registration.shots.pm_inlier.all()
    starts, places = list[SharedState](), list[int]()
    for place, epoch in enumerate(registration.epochs):
        minima = registration.searches[epoch].minima
        for minimum in minima:
            transform = minimum.state.trus_T_camera()[0]
            if minimum.cost > minima[0].cost + RIVAL_CHI2:
                break
            if inliers and np.array_equal(registration.starts[place], transform):
                continue  # it leads to the optimum
            if targets_moved(best.state.trus_T_camera(place)[0], transform, targets) < 1.0:
                continue
            transforms = np.stack([best.state.trus_T_camera(k) for k in range(problem.columns.epochs)], axis=1)
            transforms[0, place] = transform
            start = make_state(transforms, best.state.marker_T_nominal[0], best.state.beam)
            starts.append(replace(start, constants=best.state.constants))
            places.append(place)
    if not starts:
        return (_with_outlier_mixture(registration.shots, modes[0]),)
    found = optimize(problem, stack_states(starts))
    for index, place in enumerate(places):
        one = found.take(index)
        inverse = inverse_hessian(one.evaluation.hessian[0])
        cost = float(one.evaluation.cost[0])
        if len(modes) > RIVALS or inverse is None or not cost < float(best.evaluation.cost[0]) + RIVAL_CHI2:
            continue
        others = [mode.optimum.state.trus_T_camera(place)[0] for mode in modes]
        if all(targets_moved(o, one.state.trus_T_camera(place)[0], targets) > 1.0 for o in others):
            modes.append(_with_sites(problem, one, inverse))
    return tuple(_with_outlier_mixture(registration.shots, mode) for mode in modes)


def _evaluated(problem: PackedProblem, state: SharedState, near: Optimum) -> Optimum:
    """The problem evaluated at a state, with the private variables at their optimum."""
    private = near.evaluation.private
    for start in (private, initial_private(problem, state)):
        private = start
        for _ in range(4):
            private = refine(problem, state, private)
        if np.isfinite(private.trus_p_pm).all() and np.isfinite(private.beam_error).all():
            break
    return Optimum(state, evaluate(problem, state, private), near.converged, near.iterations)
