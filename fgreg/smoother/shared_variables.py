"""The shared variables of one camera epoch: GTSAM's variables, the reduced problem's state, and quadratics on them.

Their steps are those of :meth:`fgreg.graph.shared_state.SharedState.retract`: 6 of ``trus_T_camera``, 4 of the beam's
chart, then the rig's constants that are variables.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from fgreg.factors.adapter import Residual, custom_factor
from fgreg.geometry.transforms import FloatArray, hat, log_so3
from fgreg.graph.columns import Columns
from fgreg.graph.gtsam_graph import Variable
from fgreg.graph.gtsam_values import laser_chart
from fgreg.graph.shared_state import Quadratic, SharedState, nominal_frame

POSE = slice(0, 6)
LEAST_PIVOT = 1e-4
"""Smallest pivot of a correlation matrix's Cholesky factor with which the factor is used."""
LEAST_CORRELATION = 1e-12
"""Eigenvalue of a correlation matrix below which a direction counts as not observed."""


def small_step(first: SharedState, second: SharedState, columns: Columns) -> FloatArray:
    """(D,) as :func:`step_between`, many times faster, for states so close that third order in rotation vanishes."""
    out = np.zeros(columns.size)
    back = first.rotation[0, 0].T
    turn = back @ second.rotation[0, 0]
    out[0], out[1], out[2] = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    out[:3] *= 0.5
    out[3:6] = back @ (second.translation_mm[0, 0] - first.translation_mm[0, 0])
    out[6:10] = second.beam[0] - first.beam[0]
    out[columns.rig] = (second.constants[0] - first.constants[0])[list(columns.constants)]
    return out


def square_root(hessian: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rows (m, D) and residual (m,) with ``rows' rows = hessian``, ``rows' residual = gradient``; m its rank."""
    scale = np.sqrt(np.maximum(np.diag(hessian), 1e-30))
    correlation = hessian / np.outer(scale, scale)
    try:  # where all directions are well observed: a tenth of the time of eigenvalues
        lower = np.linalg.cholesky(correlation)
    except np.linalg.LinAlgError:
        pass
    else:
        if lower.diagonal().min() > LEAST_PIVOT:
            return lower.T * scale, solve_triangular(lower, gradient / scale, lower=True, check_finite=False)
    value, vector = np.linalg.eigh(correlation)
    seen = value > LEAST_CORRELATION * value[-1]
    root = np.sqrt(value[seen])
    rows = (vector[:, seen] * root).T * scale
    return rows, (vector[:, seen] / root).T @ (gradient / scale)


@lru_cache(maxsize=4096)
def _zero_at(key: int) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(key, 0.0)
    return values


def number_at(key: int, value: float) -> gtsam.Values:
    """Values of one double, made by retraction: an insert goes through all of the wrapper's overloads (40 us)."""
    delta = gtsam.VectorValues()
    delta.insert(key, np.array([value]))
    return _zero_at(key).retract(delta)


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Places of an epoch's shared variables: columns of the reduced problem (one epoch) and GTSAM's keys.

    ``marker_T_nominal`` (4, 4): fixed frame of the beam's chart.
    """

    columns: Columns
    marker_T_nominal: FloatArray

    def keys(self, epoch: int) -> tuple[int, ...]:
        """GTSAM's keys in the order of the columns."""
        return Variable.trus_T_camera.key(epoch), Variable.marker_laser.key(), Variable.rig.key()

    @property
    def sizes(self) -> tuple[int, ...]:
        """Tangent dimensions of :meth:`keys`."""
        return 6, 4, len(self.columns.constants)

    def in_chart(self, state: SharedState) -> SharedState:
        """A state (one hypothesis) with its beam in this layout's chart."""
        marker_T_laser = nominal_frame(state.beam_origin()[0], state.beam_direction()[0])
        chart, _ = laser_chart(marker_T_laser, self.marker_T_nominal)
        return replace(state, beam=chart[None], marker_T_nominal=self.marker_T_nominal[None])

    def insert(self, values: gtsam.Values, state: SharedState, epoch: int) -> None:
        """Insert a state into values."""
        keys = self.keys(epoch)
        values.insert(keys[0], gtsam.Pose3(state.trus_T_camera()[0]))
        values.insert(keys[1], state.beam[0])
        values.insert(keys[2], state.constants[0, self.columns.constants])

    def read(self, isam: gtsam.ISAM2, epoch: int, like: SharedState) -> SharedState:
        """The estimate of the shared variables; quantities that are not variables are those of ``like``."""
        keys = self.keys(epoch)
        pose = isam.calculateEstimatePose3(keys[0]).matrix()
        # Copies in row-major order: the last digits of sums depend on the memory layout.
        constants = like.constants.copy()
        constants[0, self.columns.constants] = isam.calculateEstimateVector(keys[2])
        return replace(
            like,
            rotation=pose[None, None, :3, :3].copy(),
            translation_mm=pose[None, None, :3, 3].copy(),
            beam=isam.calculateEstimateVector(keys[1])[None],
            constants=constants,
        )


def finite(state: SharedState) -> bool:
    """Whether every number of a state is finite (a sum is finite only if its terms are)."""
    return math.isfinite(sum(float(getattr(state, name).sum()) for name in SharedState.__slots__))


def marginal_prior_factor(quadratic: Quadratic, layout: Layout, epoch: int) -> gtsam.CustomFactor:
    """A quadratic as a factor on the shared variables: ``rows * step + residual`` of unit noise.

    In Python GTSAM's own containers of linear factors hold at most three variables, and they treat the registration's
    chart as flat. Here the step from the linearisation point is that of the reduced problem everywhere.
    """
    rows, residual = square_root(quadratic.hessian, quadratic.gradient)
    keys, sizes = layout.keys(epoch), layout.sizes
    starts = np.cumsum((0, *sizes)).tolist()
    state = quadratic.state
    old_R_trus, old_t = state.rotation[0, 0].T.copy(), state.translation_mm[0, 0].copy()
    beam, constants = state.beam[0].copy(), state.constants[0, layout.columns.constants]

    def evaluate(values: gtsam.Values, want_jacobians: bool) -> Residual:
        pose = values.atPose3(keys[0]).matrix()
        turn = old_R_trus @ pose[:3, :3]
        step = np.empty(starts[-1])
        step[:3] = log_so3(turn)
        step[3:6] = old_R_trus @ (pose[:3, 3] - old_t)
        step[starts[1] : starts[2]] = values.atVector(keys[1]) - beam
        step[starts[2] :] = values.atVector(keys[2]) - constants
        error = (residual + rows @ step).tolist()
        if not want_jacobians:
            return error, ()
        by_pose = rows[:, :6].copy()
        by_pose[:, :3] = rows[:, :3] @ (np.eye(3) + 0.5 * hat(step[:3]))
        by_pose[:, 3:] = rows[:, 3:6] @ turn
        others = [rows[:, starts[i] : starts[i + 1]].tolist() for i in range(1, len(keys))]
        return error, [by_pose.tolist(), *others]

    noise = gtsam.noiseModel.Unit.Create(len(rows))
    return custom_factor("marginal prior", noise, keys, len(rows), sizes, evaluate)
