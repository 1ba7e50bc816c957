"""Values of the shared variables, many hypotheses at once: leading dimension S everywhere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fgreg.geometry.rig import COUNT, Constant
from fgreg.geometry.transforms import FloatArray, exp_so3, log_so3, make_transform, rotation_to_direction
from fgreg.graph.columns import Columns
from fgreg.graph.scaled_inverse import UNKNOWN


@dataclass(frozen=True, slots=True, eq=False)
class SharedState:
    """S hypotheses of all shared variables.

    Attributes:
        rotation, translation_mm: ``trus_T_camera`` of each epoch, (S, E, 3, 3) and (S, E, 3).
        marker_T_nominal: (S, 4, 4) fixed frame of the beam chart.
        beam: (S, 4) chart (x, y, a, b): origin R0 (x, y, 0) + p0, direction R0 normalise(a, b, 1).
        constants: (S, COUNT) the rig's constants, deviations from the declared values (fgreg.model.systematic).
    """

    rotation: FloatArray
    translation_mm: FloatArray
    marker_T_nominal: FloatArray
    beam: FloatArray
    constants: FloatArray

    @property
    def count(self) -> int:
        return len(self.beam)

    def take(self, index: Any) -> SharedState:
        """The hypotheses at ``index`` (anything that indexes an array's first dimension)."""
        return SharedState(*(getattr(self, name)[index] for name in self.__slots__))

    def retract(self, step: FloatArray, columns: Columns) -> SharedState:
        """Move by ``step`` (S, D): ``rotation * Exp(omega)``, ``translation + rotation v``, additive otherwise."""
        poses = step[:, : 6 * columns.epochs].reshape(-1, columns.epochs, 6)
        constants = self.constants.copy()
        constants[:, columns.constants] += step[:, columns.rig]
        return replace(
            self,
            rotation=self.rotation @ exp_so3(poses[..., :3]),
            translation_mm=self.translation_mm + (self.rotation @ poses[..., 3:, None])[..., 0],
            beam=self.beam + step[:, columns.beam : columns.beam + 4],
            constants=constants,
        )

    def constant(self, which: Constant) -> FloatArray:
        """(S,) one of the constants."""
        return np.asarray(self.constants[:, which])

    def trus_T_camera(self, epoch: int = 0) -> FloatArray:
        """(S, 4, 4) registrations of one epoch."""
        return make_transform(self.rotation[:, epoch], self.translation_mm[:, epoch])

    def beam_direction(self) -> FloatArray:
        """(S, 3) unit direction of the beam in the marker frame."""
        chart = np.concatenate([self.beam[:, 2:], np.ones((self.count, 1))], axis=1)
        chart /= np.linalg.norm(chart, axis=1, keepdims=True)
        return np.asarray((self.marker_T_nominal[:, :3, :3] @ chart[..., None])[..., 0])

    def beam_origin(self) -> FloatArray:
        """(S, 3) the chart's point on the beam (lambda = 0), marker frame, mm."""
        r0 = self.marker_T_nominal[:, :3, :3]
        return np.asarray(
            r0[:, :, 0] * self.beam[:, :1] + r0[:, :, 1] * self.beam[:, 1:2] + self.marker_T_nominal[:, :3, 3]
        )


def stack_states(states: list[SharedState]) -> SharedState:
    """All hypotheses of several states in one."""
    return SharedState(*(np.concatenate([getattr(s, name) for s in states]) for name in SharedState.__slots__))


def nominal_frame(origin_mm: FloatArray, direction: FloatArray) -> FloatArray:
    """``marker_T_nominal`` with z along a direction (3,) and its origin at a point (3,) of the beam."""
    return make_transform(rotation_to_direction(direction), origin_mm)


def make_state(
    trus_T_camera: FloatArray,
    marker_T_nominal: FloatArray,
    beam: FloatArray | None = None,
    constants: FloatArray | None = None,
) -> SharedState:
    """Hypotheses from registrations (S, E, 4, 4) and beams (S, 4, 4).

    ``constants``: (COUNT,), as declared where None.
    """
    count = len(trus_T_camera)
    return SharedState(
        rotation=np.array(trus_T_camera[..., :3, :3], dtype=np.float64),
        translation_mm=np.array(trus_T_camera[..., :3, 3], dtype=np.float64),
        marker_T_nominal=np.array(np.broadcast_to(marker_T_nominal, (count, 4, 4)), dtype=np.float64),
        beam=np.zeros((count, 4)) if beam is None else np.array(beam, dtype=np.float64),
        constants=np.array(np.broadcast_to(0.0 if constants is None else constants, (count, COUNT)), dtype=np.float64),
    )


def step_between(first: SharedState, second: SharedState, columns: Columns) -> FloatArray:
    """(S, D) such that ``first.retract(step) = second``; both with the same beam chart."""
    out = np.zeros((second.count, columns.size))
    for k in range(columns.epochs):
        back = np.swapaxes(first.rotation[:, k], -1, -2)
        out[:, 6 * k : 6 * k + 3] = log_so3(back @ second.rotation[:, k])
        shift = second.translation_mm[:, k] - first.translation_mm[:, k]
        out[:, 6 * k + 3 : 6 * k + 6] = (back @ shift[..., None])[..., 0]
    out[:, columns.beam : columns.beam + 4] = second.beam - first.beam
    out[:, columns.rig] = (second.constants - first.constants)[:, columns.constants]
    return out


def chart_turn(step: FloatArray) -> FloatArray:
    """(D, D) derivative of ``step_between(a, b.retract(d))`` by d, where b is ``step`` (D,) from a, of one epoch."""
    turn = np.eye(len(step))
    x, y, z = (0.5 * step[:3]).tolist()
    turn[0, 1], turn[0, 2], turn[1, 2] = -z, y, -x
    turn[1, 0], turn[2, 0], turn[2, 1] = z, -y, x
    turn[3:6, 3:6] = exp_so3(step[:3])
    return turn


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """The cost ``c + 2 g' d + d' H d`` (chi square) of steps ``d`` from a state of one hypothesis.

    Attributes:
        state: where it is linearised. cost: c. gradient: (D,), hessian: (D, D), of half the cost.
    """

    state: SharedState
    cost: float
    gradient: FloatArray
    hessian: FloatArray

    def at(self, state: SharedState, columns: Columns) -> Quadratic:
        """The same quadratic about another state near by; of one epoch, or of no registration."""
        step = step_between(self.state, state, columns)[0]
        pull = self.hessian @ step
        turn = chart_turn(step)
        gradient = turn.T @ (self.gradient + pull)
        cost = self.cost + float(step @ (2.0 * self.gradient + pull))
        return Quadratic(state, cost, gradient, turn.T @ self.hessian @ turn)

    def plus(self, other: Quadratic) -> Quadratic:
        """Sum of two quadratics about the same state."""
        return Quadratic(
            self.state, self.cost + other.cost, self.gradient + other.gradient, self.hessian + other.hessian
        )

    def above_minimum(self) -> Quadratic:
        """The same less its smallest value, so that a test of residuals counts one equation per direction it knows."""
        scale = 1.0 / np.sqrt(np.maximum(np.diag(self.hessian), 1e-30))
        inverse = np.linalg.pinv(self.hessian * np.outer(scale, scale), rcond=UNKNOWN, hermitian=True)
        pull = scale * self.gradient
        return replace(self, cost=float(pull @ inverse @ pull))


def in_columns(quadratic: Quadratic, columns: Columns, other: Columns) -> Quadratic:
    """A quadratic over other columns of the same epochs: zero for constants that it does not have."""
    places = [
        *range(other.first_constant),
        *(other.first_constant + other.constants.index(c) for c in columns.constants),
    ]
    gradient, hessian = np.zeros(other.size), np.zeros((other.size, other.size))
    gradient[places] = quadratic.gradient
    hessian[np.ix_(places, places)] = quadratic.hessian
    return replace(quadratic, gradient=gradient, hessian=hessian)


def gaussian_prior(state: SharedState, covariance: FloatArray) -> Quadratic:
    """The prior of a Gaussian about a state (one hypothesis) with a covariance (D, D)."""
    return Quadratic(state, 0.0, np.zeros(len(covariance)), np.asarray(np.linalg.inv(covariance)))


def one_epoch(state: SharedState, place: int) -> SharedState:
    """The shared variables with one of the registrations."""
    index = [place % state.rotation.shape[1]]
    return replace(state, rotation=state.rotation[:, index], translation_mm=state.translation_mm[:, index])
