"""The online estimate as a snapshot for tracking queries."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.graph.columns import Columns
from fgreg.graph.shared_state import SharedState
from fgreg.model.estimate import Verdict
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.tissue_surface import TissueSurface
from fgreg.online.estimate import OnlineEstimate
from fgreg.registration.posterior import pose_tangent, step_of_tangent
from fgreg.registration.readout import beam_origin_shift
from fgreg.tracking.snapshot import Snapshot, make_snapshot

POSE = slice(0, 6)


def reported_shared(
    estimate: OnlineEstimate, state: SharedState, covariance: FloatArray, columns: Columns
) -> tuple[SharedState, FloatArray]:
    """The reported shared variables and their covariance (D, D), from the graph's optimum and its Gaussian.

    The reported registration is the posterior mean, with a wider covariance than the Gaussian's. The other variables
    follow its shift by their regression on it in the Gaussian, and keep their correlations with it.

    Args:
        estimate: with a registration.
        state, covariance: of the optimum (one hypothesis, one epoch).
        columns: of the covariance.
    """
    if estimate.trus_T_camera is None or estimate.covariance is None:
        raise ValueError("an estimate without a registration")
    pose = covariance[POSE, POSE]
    shift = pose_tangent(state.trus_T_camera()[0], estimate.trus_T_camera)
    tangent = covariance[:, POSE] @ np.linalg.solve(pose, shift)
    tangent[POSE] = shift
    widen = np.eye(columns.size)
    widen[POSE, POSE] = np.linalg.solve(np.linalg.cholesky(pose).T, np.linalg.cholesky(estimate.covariance).T).T
    moved = state.retract(step_of_tangent(tangent[None], columns), columns)
    wide = widen @ covariance @ widen.T
    return moved, np.asarray(0.5 * (wide + wide.T))


def online_snapshot(
    model: SessionModel,
    config: SolveConfig,
    estimate: OnlineEstimate,
    optimum: tuple[SharedState, FloatArray, Columns] | None,
    surface: TissueSurface | None,
) -> Snapshot:
    """The snapshot for tracking queries after an event; it has the current epoch only.

    Args:
        model, config: of the session.
        estimate: after the event.
        optimum: the graph's shared variables, their covariance, its columns; None where there is no registration.
        surface: tissue surface of the last full solve.
    """
    epoch = estimate.epoch
    refused = {}
    if optimum is None or estimate.trus_T_camera is None or estimate.verdict is Verdict.REFUSED:
        refused[epoch] = "; ".join(estimate.reasons)
    if optimum is None or estimate.trus_T_camera is None:
        return _without_registration(model, config, estimate, refused)
    state, covariance = reported_shared(estimate, *optimum)
    snapshot = make_snapshot(
        model,
        config,
        state,
        covariance,
        optimum[2],
        (epoch,),
        origin_shift_mm=beam_origin_shift(state, model),
        surface=surface,
        t=estimate.t,
        pairs=estimate.pairs,
        causal=True,
        refused=refused,
    )
    return replace(snapshot, oldest=epoch)


def _without_registration(
    model: SessionModel, config: SolveConfig, estimate: OnlineEstimate, refused: dict[int, str]
) -> Snapshot:
    return replace(
        Snapshot.without_registration(model, config, refused),
        t=estimate.t,
        pairs=estimate.pairs,
        oldest=estimate.epoch,
    )
