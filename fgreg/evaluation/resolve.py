"""Cross-validation: solve from some of the PMs and predict the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.errors import EstimationError
from fgreg.evaluation.case import Case, EvaluationConfig
from fgreg.evaluation.pair_residual import line_to_arc
from fgreg.geometry.rig import Constant
from fgreg.geometry.target_error import expected_tre_mm, tre_mm
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.contributions import contributions
from fgreg.graph.packing import pack_more
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_system import refine
from fgreg.graph.shared_state import SharedState
from fgreg.model.measurements import Pair
from fgreg.registration.outliers import pm_degrees_of_freedom, pm_innovations
from fgreg.registration.posterior_mean import posterior_mean
from fgreg.registration.register import Registration, register

REFINEMENTS = 5


@dataclass(frozen=True, slots=True)
class HeldOutPm:
    """Prediction error of a PM by a solve without it.

    Attributes:
        pm, epoch: which.
        pair_residual_mm: line to arc with lambda and theta' refitted (Eq. 12), root mean square over its looks.
        nis: squared misfit of beam and looks together over its predicted covariance; chi square of
            ``degrees_of_freedom`` where the stated noise is right.
    """

    pm: int
    epoch: int
    pair_residual_mm: float
    nis: float
    degrees_of_freedom: int


@dataclass(frozen=True, slots=True, eq=False)
class Resolved:
    """A solve from some of the PMs.

    Attributes:
        kept: their numbers.
        failure: why there is no registration; empty where there is one.
        trus_T_camera: (4, 4) of each of the session's epochs, None where not solved.
        ambiguous: a second registration explains the pairs about as well; this is the better one.
        expected_mm: predicted TRE (root of the expected square, mean over targets) of each epoch, from the Hessian.
        tre_mm: errors (n,) at the targets of each epoch against the truth, None where not known.
        held_out: the PMs left out, where their epoch was solved.
    """

    kept: tuple[int, ...]
    failure: str = ""
    trus_T_camera: tuple[FloatArray | None, ...] = ()
    ambiguous: bool = False
    expected_mm: tuple[float | None, ...] = ()
    tre_mm: tuple[FloatArray | None, ...] = ()
    held_out: tuple[HeldOutPm, ...] = ()


def resolve(case: Case, kept: Sequence[int], config: EvaluationConfig, held: Sequence[int] | None = None) -> Resolved:
    """Register from the kept PMs and all aims, without an initial guess, and predict the held-out PMs.

    Args:
        case: the session.
        kept: PMs to solve from.
        config: settings.
        held: PMs to predict; all others where None.
    """
    keep = set(kept)
    ask = set(case.pms) - keep if held is None else set(held)
    measurements = case.measurements
    pairs = tuple(pair for pair in measurements.pairs if pair.pm in keep)
    try:
        registration = register(replace(measurements, pairs=pairs), case.model, config.solve)
    except EstimationError as error:
        return Resolved(tuple(kept), failure=str(error))
    count = len(measurements.epochs)
    place = {epoch: index for index, epoch in enumerate(registration.epochs)}
    centred = posterior_mean(registration, config.solve).registration
    state = centred.optimum.state
    transforms = tuple(state.trus_T_camera(place[k])[0] if k in place else None for k in range(count))
    expected: list[float | None] = []
    errors: list[FloatArray | None] = []
    for k, transform in enumerate(transforms):
        if transform is None:
            expected.append(None)
            errors.append(None)
            continue
        block = slice(6 * place[k], 6 * place[k] + 6)
        covariance = centred.covariance[block, block]
        expected.append(float(expected_tre_mm(covariance, transform, case.model.targets_mm).mean()))
        known = case.truth is not None and k < len(case.truth.trus_T_camera)
        errors.append(
            tre_mm(transform, case.truth.trus_T_camera[k], case.model.targets_mm) if known and case.truth else None
        )
    return Resolved(
        kept=tuple(kept),
        trus_T_camera=transforms,
        ambiguous=bool(registration.ambiguous),
        expected_mm=tuple(expected),
        tre_mm=tuple(errors),
        held_out=predict(registration, [pair for pair in measurements.pairs if pair.pm in ask]),
    )


def pair_residuals(
    state: SharedState, epochs: Sequence[int], pairs: Sequence[Pair], declared_radius_mm: float
) -> FloatArray:
    """Eq. 12 for pairs (n,): distances (mm) between beam and arc, lambda and theta' refitted.

    Args:
        state: the estimate (one hypothesis).
        epochs: epoch numbers of the pairs, in the order of the state's epochs.
        pairs: of those epochs.
        declared_radius_mm: of the probe.
    """
    ratio, offset = 1.0 + state.constants[0, Constant.SOUND_SPEED], state.constants[0, Constant.RANGE_OFFSET]
    marker = np.stack([pair.marker.camera_T_marker for pair in pairs])
    camera_p = marker[:, :3, :3] @ state.beam_origin()[0] + marker[:, :3, 3]
    camera_p = camera_p - state.constants[0, Constant.MARKER_BIAS_X : Constant.MARKER_BIAS_Z + 1]
    camera_d = marker[:, :3, :3] @ state.beam_direction()[0]
    epoch = np.array([list(epochs).index(pair.epoch) for pair in pairs])
    rotation, translation = state.rotation[0, epoch], state.translation_mm[0, epoch]
    found = line_to_arc(
        np.einsum("nij,nj->ni", rotation, camera_p) + translation,
        np.einsum("nij,nj->ni", rotation, camera_d),
        np.array([pair.look.scan_rad for pair in pairs]),
        np.array([pair.look.x_mm for pair in pairs]),
        np.array([pair.look.range_mm for pair in pairs]) * ratio + offset,
        declared_radius_mm + float(state.constants[0, Constant.RADIUS]),
    )
    return found.distance_mm


def predict(registration: Registration, pairs: Sequence[Pair]) -> tuple[HeldOutPm, ...]:
    """Prediction errors of PMs that did not enter a registration; those of unsolved epochs are left out.

    NIS: with all private variables of the PM eliminated, its cost near the estimate is c + 2 g'd + d'Ad in the shared
    deviation d, which has information H from the others. The minimum of the sum with d'Hd is c - g'(H + A)^-1 g: the
    squared misfit over its predicted covariance. Degrees of freedom: two equations per beam and three per look, less
    the PM's three coordinates.
    """
    pairs = [pair for pair in pairs if pair.epoch in registration.epochs]
    if not pairs:
        return ()
    residual = pair_residuals(
        registration.optimum.state, registration.epochs, pairs, registration.model.probe.radius_mm
    )
    renumbered = tuple(replace(pair, epoch=registration.epochs.index(pair.epoch)) for pair in pairs)
    problem = pack_more(renumbered, registration.model, registration.problem.columns)
    state = registration.optimum.state
    private = initial_private(problem, state)
    for _ in range(REFINEMENTS):
        private = refine(problem, state, private)
    parts = contributions(problem, state, private).pm
    information = registration.optimum.evaluation.hessian[0]
    nis = pm_innovations(problem, parts, information, np.zeros(len(problem.pms), dtype=bool))
    freedom = pm_degrees_of_freedom(problem)
    out = []
    for index, pm in enumerate(problem.pms):
        mine = problem.look_pm == index
        out.append(
            HeldOutPm(
                pm=pm,
                epoch=next(pair.epoch for pair in pairs if pair.pm == pm),
                pair_residual_mm=float(np.sqrt(np.mean(residual[mine] ** 2))),
                nis=float(nis[index]),
                degrees_of_freedom=int(freedom[index]),
            )
        )
    return tuple(out)
