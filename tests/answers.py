"""Estimates derived from a simulated truth, for tests of code that only shows estimates."""

from __future__ import annotations

import math

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import (
    AimEstimate,
    EpochEstimate,
    LaserEstimate,
    PairEstimate,
    PredictedTre,
    SessionEstimate,
    TrackEstimate,
    Verdict,
)
from fgreg.model.measurements import Measurements
from fgreg.model.session_model import SessionModel
from tests.forward import Truth

REGISTRATION_COVARIANCE = np.diag(np.square([0.004, 0.003, 0.008, 0.25, 0.2, 0.3]))
LASER_COVARIANCE = np.diag(np.square([0.01, 0.02, 0.0, 0.3, 0.2, 0.0]))


def random_covariance(rng: np.random.Generator, size: int, scale: float) -> FloatArray:
    """A covariance without special axes; sigmas about ``scale``."""
    root = rng.normal(size=(size, size)) * scale / math.sqrt(size)
    return np.asarray(root @ root.T + 0.01 * scale**2 * np.eye(size))


def answer_from_truth(
    rng: np.random.Generator,
    session: SessionModel,
    measurements: Measurements,
    truth: Truth,
    *,
    verdict: Verdict = Verdict.OK,
    reasons: tuple[str, ...] = (),
    unused: tuple[int, ...] = (),
    tracks: tuple[TrackEstimate, ...] = (),
) -> SessionEstimate:
    """The truth as an estimate, with invented covariances and misfits; looks at positions ``unused`` are left out."""
    epochs = tuple(
        EpochEstimate(
            index=index,
            start_s=start.t,
            trus_T_camera=truth.trus_T_camera[index],
            covariance=REGISTRATION_COVARIANCE,
            pairs=sum(pair.epoch == index for pair in measurements.pairs),
            verdict=verdict,
            predicted_tre=PredictedTre(0.71, 1.12, 1.4),
        )
        for index, start in enumerate(measurements.epochs)
    )
    pairs = tuple(
        PairEstimate(
            t=pair.t,
            pm=pair.pm,
            epoch=pair.epoch,
            used=i not in unused,
            reason="range is 4.1 sigma off" if i in unused else "",
            lambda_mm=truth.pair_lambda_mm[i],
            theta_rad=truth.theta_rad[i],
            rotation_rad=session.stage.direction * truth.rotation_rad[i],
            trus_p_pm_mm=truth.trus_p_pm_mm[pair.pm],
            covariance=random_covariance(rng, 3, 0.8),
            residual_mm=abs(float(rng.normal())),
            nis=float(rng.chisquare(2)),
        )
        for i, pair in enumerate(measurements.pairs)
    )
    aims = tuple(
        AimEstimate(aim.t, True, "", truth.aim_lambda_mm[i], abs(float(rng.normal())), float(rng.chisquare(2)))
        for i, aim in enumerate(measurements.aims)
    )
    laser = LaserEstimate(truth.marker_T_laser, LASER_COVARIANCE)
    return SessionEstimate(session.name, verdict, reasons, laser, epochs, pairs, tracks, aims=aims)
