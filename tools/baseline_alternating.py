"""The published method: alternating gradient descent on the distances between beams and arcs.

The cost is the mean over pairs of ``|trus_T_camera q_i(lambda_i) - a_i(theta_i)|^2``: q the point at lambda on beam i,
a the point at arc angle theta' on arc i. In turn, until it no longer falls:

1. gradient steps on lambda and the registration (F_reg) with theta' fixed;
2. gradient steps on theta' with lambda and the registration fixed.

There is no noise model and no prior on theta': the cost hardly depends on rolls about the probe's axis, which theta'
absorbs. Where the out-of-plane angle is known to be bounded, theta' can be kept within the bound (projected gradient
steps). The method needs a first guess. Each block (rotation about the TRUS origin, translation, lambda, theta') has its
own step length along the negative gradient: doubled after a success, halved until the cost falls. The calibration of
the fibre enters as a fixed beam.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.transforms import FloatArray, exp_so3

INNER_STEPS = 10
"""Gradient steps on one set of variables before the other set."""


@dataclass(frozen=True, slots=True, eq=False)
class LinesAndArcs:
    """n beams and n arcs.

    Attributes:
        camera_p, camera_d: (n, 3) origin (mm) and unit direction of each beam, camera axes.
        scan_rad, x_mm, range_mm: (n,) of the looks.
        radius_mm: of the probe.
    """

    camera_p: FloatArray
    camera_d: FloatArray
    scan_rad: FloatArray
    x_mm: FloatArray
    range_mm: FloatArray
    radius_mm: float

    def arc_points(self, theta_rad: FloatArray) -> FloatArray:
        """(n, 3) TRUS points of the arcs at arc angles (n,)."""
        y = self.radius_mm * np.sin(self.scan_rad) + self.range_mm * np.sin(theta_rad)
        z = self.radius_mm * np.cos(self.scan_rad) + self.range_mm * np.cos(theta_rad)
        return np.stack([self.x_mm, y, z], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class AlternatingResult:
    """Result of the descent.

    Attributes:
        trus_T_camera: (4, 4). lambda_mm, theta_rad: (n,).
        cost_mm2: mean squared distance.
        rounds: of the alternation. converged: whether it ended before the limit.
    """

    trus_T_camera: FloatArray
    lambda_mm: FloatArray
    theta_rad: FloatArray
    cost_mm2: float
    rounds: int
    converged: bool


def cost_and_error(
    data: LinesAndArcs, rotation: FloatArray, translation: FloatArray, lambda_mm: FloatArray, theta_rad: FloatArray
) -> tuple[float, FloatArray]:
    """Mean squared distance (mm^2), and the differences (n, 3) behind it: beam point less arc point."""
    camera_q = data.camera_p + lambda_mm[:, None] * data.camera_d
    error = camera_q @ rotation.T + translation - data.arc_points(theta_rad)
    return float(np.einsum("ni,ni->", error, error)) / len(lambda_mm), error


class _Descent:
    """The state of one descent."""

    def __init__(self, data: LinesAndArcs, trus_T_camera: FloatArray, limit_rad: float) -> None:
        self.data, self.limit_rad = data, limit_rad
        self.rotation = np.array(trus_T_camera[:3, :3])
        self.translation = np.array(trus_T_camera[:3, 3])
        self.theta = np.array(data.scan_rad, dtype=np.float64)
        # lambda starts at the foot of the arc's middle on the beam.
        offset = (data.arc_points(self.theta) - self.translation) @ self.rotation - data.camera_p
        self.lam = np.sum(offset * data.camera_d, axis=1)
        self.cost, self.error = cost_and_error(data, self.rotation, self.translation, self.lam, self.theta)
        # Steps that would be exact for a well-posed problem of this size: 1 / curvature.
        self.length = {"rotation": 1e-4, "translation": 0.25, "lambda": 0.25, "theta": 1e-4}

    def _try(
        self, rotation: FloatArray, translation: FloatArray, lam: FloatArray, theta: FloatArray, block: str
    ) -> bool:
        cost, error = cost_and_error(self.data, rotation, translation, lam, theta)
        if cost < self.cost:
            self.rotation, self.translation, self.lam, self.theta = rotation, translation, lam, theta
            self.cost, self.error = cost, error
            self.length[block] *= 2.0
            return True
        self.length[block] *= 0.5
        return False

    def step_lambda(self) -> None:
        gradient = 2.0 * np.einsum("ni,ni->n", self.error, self.data.camera_d @ self.rotation.T)
        self._try(self.rotation, self.translation, self.lam - self.length["lambda"] * gradient, self.theta, "lambda")

    def step_registration(self) -> None:
        gradient = 2.0 * self.error.mean(axis=0)
        self._try(
            self.rotation, self.translation - self.length["translation"] * gradient, self.lam, self.theta, "translation"
        )
        trus_q = self.error + self.data.arc_points(self.theta)
        gradient = 2.0 * np.cross(trus_q, self.error).mean(axis=0)
        turn = exp_so3(-self.length["rotation"] * gradient)
        self._try(turn @ self.rotation, turn @ self.translation, self.lam, self.theta, "rotation")

    def step_theta(self) -> None:
        sine, cosine = np.sin(self.theta), np.cos(self.theta)
        gradient = -2.0 * self.data.range_mm * (self.error[:, 1] * cosine - self.error[:, 2] * sine)
        theta = self.theta - self.length["theta"] * gradient
        scan = self.data.scan_rad
        theta = np.minimum(np.maximum(theta, scan - self.limit_rad), scan + self.limit_rad)
        self._try(self.rotation, self.translation, self.lam, theta, "theta")


def register_alternating(
    data: LinesAndArcs,
    trus_T_camera: FloatArray,
    *,
    limit_rad: float = math.pi,
    tolerance: float = 1e-9,
    max_rounds: int = 200_000,
) -> AlternatingResult:
    """Descend from a first guess (4, 4).

    Args:
        data: lines and arcs.
        trus_T_camera: the guess.
        limit_rad: farthest that theta' may be off the image plane, as an arc angle; pi: no limit.
        tolerance: it has converged when a round lowers the cost by less than this share of it.
        max_rounds: largest number of rounds.
    """
    descent = _Descent(data, trus_T_camera, limit_rad)
    rounds, quiet = 0, 0
    while rounds < max_rounds and quiet < 3:
        before = descent.cost
        for _ in range(INNER_STEPS):
            descent.step_lambda()
            descent.step_registration()
        for _ in range(INNER_STEPS):
            descent.step_theta()
        rounds += 1
        quiet = quiet + 1 if before - descent.cost < tolerance * before else 0
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = descent.rotation, descent.translation
    if not math.isfinite(descent.cost):
        raise ValueError("the cost is not finite: check the lines and arcs")
    return AlternatingResult(transform, descent.lam, descent.theta, descent.cost, rounds, quiet >= 3)
