"""Screening for camera moves: odds that the PMs of one epoch have two registrations, by split point, in closed form.

A split point is the first PM after an unreported camera move. Here all densities are Gaussian, and moves are small
enough to be linear. Given all PMs, a move of prior covariance S at a split point has the Bayes factor, against none,

    |1 + S F|^(-1/2) exp(h' (1 + S F)^(-1) S h / 2),

with F the information of the PMs from there on about the move, shared variables free, and h their gradient. Neither
side of the move has to determine a registration by itself. Without a move the sum over all split points grows by one
per PM on average, so it seldom exceeds a threshold (Shiryaev, 1963; Roberts, 1966).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.geometry.transforms import FloatArray

GATE = 2.5
"""Log of that sum from which the full test (fgreg.camera_moves) runs."""
ALARM = 5.4
"""Log of that sum from which a move is certain: reached once in several thousand pairs without a move
(tools/study_moves.py), and never by one outlier."""

_SIX = np.arange(6)


def logsumexp(values: FloatArray, axis: int | None = None) -> FloatArray:
    """Log of the sum of exponentials, as scipy's, which is slower since it handles other kinds of arrays."""
    top = np.max(values, axis=axis, keepdims=True)
    top = np.where(np.isfinite(top), top, 0.0)
    with np.errstate(divide="ignore"):
        out = np.log(np.sum(np.exp(values - top), axis=axis, keepdims=True)) + top
    return np.asarray(out.reshape(()) if axis is None else np.squeeze(out, axis=axis))


@dataclass(frozen=True, slots=True, eq=False)
class MoveScales:
    """Prior of the move: a mixture of zero-mean Gaussians about the camera, sigmas (K,) rad and mm, shares (K,)."""

    rotation_rad: FloatArray
    translation_mm: FloatArray
    share: FloatArray

    def __post_init__(self) -> None:
        sizes = {len(self.rotation_rad), len(self.translation_mm), len(self.share)}
        if len(sizes) != 1 or not len(self.share):
            raise ValueError("scales need as many rotations as translations and shares, at least one")
        if not (self.share > 0).all() or abs(float(self.share.sum()) - 1.0) > 1e-9:
            raise ValueError("shares have to be positive and add up to 1")

    @property
    def covariance(self) -> FloatArray:
        """(K, 6, 6) of the move's right tangent."""
        sigma = np.concatenate(
            [np.repeat(self.rotation_rad[:, None], 3, axis=1), np.repeat(self.translation_mm[:, None], 3, axis=1)], 1
        )
        return np.asarray(sigma[:, :, None] ** 2 * np.eye(6))


def default_scales() -> MoveScales:
    """Scales of a nudge, a shift, a large move, and a camera put back anywhere."""
    degrees, mm = [0.5, 1.2, 4.0, 10.0, 40.0], [1.0, 2.5, 10.0, 30.0, 120.0]
    return MoveScales(np.radians(degrees), np.array(mm), np.array([0.25, 0.45, 0.15, 0.1, 0.05]))


def log_move_odds(
    gradient: FloatArray, hessian: FloatArray, covariance: FloatArray, pose: slice, scales: MoveScales | None = None
) -> FloatArray:
    """(n - 1,) log Bayes factor of a move before each of n PMs but the first, against none.

    Args:
        gradient, hessian: (n, D), (n, D, D) of half the chi square of each PM, in the order of time, at the optimum of
            all.
        covariance: (D, D) of the shared variables, given all.
        pose: columns of the registration.
        scales: prior of the move.
    """
    scales = scales or default_scales()
    across = np.cumsum(hessian[::-1, pose], axis=0)[-2::-1]
    pull = -np.cumsum(gradient[::-1, pose], axis=0)[-2::-1]
    information = across[:, :, pose] - across @ covariance @ np.swapaxes(across, -1, -2)
    return logsumexp(_log_factors(scales.covariance, information, pull) + np.log(scales.share), axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class MovedRegistrations:
    """The registration after a move, for each split point and scale of the prior.

    Attributes:
        log: (n - 1, K) log Bayes factors against no move; the shares of the scales are in them.
        mean: (n - 1, K, 6) step from the optimum of all PMs. covariance: (n - 1, K, 6, 6).
    """

    log: FloatArray
    mean: FloatArray
    covariance: FloatArray


def moved_registrations(
    gradient: FloatArray, hessian: FloatArray, covariance: FloatArray, pose: slice, scales: MoveScales | None = None
) -> MovedRegistrations:
    """The registration that the PMs from a split point on have, if the camera moved there.

    With F and h as above, ``C`` the covariance of the shared variables and ``B`` the rows of the registration in the
    PMs' Hessian, a move has the mean ``V h`` and the covariance ``V = (S^-1 + F)^-1``. The registration before it then
    changes by ``-C B'`` times the move.

    Args: as of :func:`log_move_odds`.
    """
    scales = scales or default_scales()
    prior = scales.covariance
    across = np.cumsum(hessian[::-1, pose], axis=0)[-2::-1]
    pull = -np.cumsum(gradient[::-1, pose], axis=0)[-2::-1]
    information = across[:, :, pose] - across @ covariance @ np.swapaxes(across, -1, -2)
    log = _log_factors(prior, information, pull) + np.log(scales.share)
    spread = np.linalg.inv(information[:, None] + np.linalg.inv(prior))
    rest = np.eye(6) - covariance[pose] @ np.swapaxes(across, -1, -2)
    along = rest[:, None] @ spread
    mean = (along @ pull[:, None, :, None])[..., 0]
    return MovedRegistrations(log, mean, covariance[pose, pose] + along @ np.swapaxes(rest, -1, -2)[:, None])


def _log_factors(prior: FloatArray, information: FloatArray, pull: FloatArray) -> FloatArray:
    """(n, K) log Bayes factors of moves of prior covariances (K, 6, 6, diagonal), F (n, 6, 6) and h (n, 6)."""
    root = np.sqrt(prior.diagonal(axis1=1, axis2=2))
    pulled = pull[:, None] * root
    bound = np.sum(pulled * pulled, axis=-1) + 1.0
    bordered = np.empty((len(pull), len(root), 7, 7))
    bordered[..., :6, :6] = information[:, None] * (root[:, :, None] * root[:, None, :])
    bordered[..., _SIX, _SIX] += 1.0
    bordered[..., 6, :6] = bordered[..., :6, 6] = pulled
    bordered[..., 6, 6] = bound
    try:  # a third of the time of solving; the last pivot gives the quadratic form
        pivot = np.linalg.cholesky(bordered).diagonal(axis1=-2, axis2=-1)
    except np.linalg.LinAlgError:  # where hardly anything is known, F is a small difference of large numbers
        spread = np.eye(6) + prior @ information[:, None]
        shrunk = np.linalg.solve(spread, prior @ pull[:, None, :, None])[..., 0]
        return np.asarray(0.5 * (np.sum(pull[:, None] * shrunk, axis=-1) - np.linalg.slogdet(spread)[1]))
    return np.asarray(0.5 * (bound - pivot[..., 6] ** 2) - np.log(pivot[..., :6]).sum(axis=-1))
