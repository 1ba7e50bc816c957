"""PMs as whitened linear equations on the shared variables, and the Gaussian of those variables.

With the private variables eliminated (fgreg.graph.reduced_graph) a PM adds ``cost + 2 g' d + d' H d`` at a step d from
the linearisation point. The rank of H is the PM's degrees of freedom (two for one look). So the sum equals
``|residual + jacobian d|^2 + rest`` with few rows, which a Kalman filter takes one by one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.graph.columns import Columns
from fgreg.graph.contributions import Contributions, contributions
from fgreg.graph.packing import PackedProblem, edge_sigma_rad
from fgreg.graph.reduced_blocks import PrivateState, initial_private, look_block, times
from fgreg.graph.reduced_graph import evaluate
from fgreg.graph.reduced_system import refine
from fgreg.graph.shared_state import SharedState, step_between
from fgreg.graph.window_likelihood import LEAST_PRECISION
from fgreg.model.systematic import TEXTS
from fgreg.registration.outliers import pm_degrees_of_freedom

POSE = slice(0, 6)
"""Columns of the registration: problems here are of one epoch."""
TYPICAL_RAD, TYPICAL_MM = 1e-2, 1.0
"""Rotations and lengths of equal importance: scale of the pivots."""
LEAST_PIVOT = 1e-14
PRIVATE_ROUNDS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Gaussian:
    """Gaussian of the shared variables' step from the linearisation point: mean (D,), covariance (D, D)."""

    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class WindowRows:
    """Rotations of PMs without their sensitivity windows: a Gaussian given a step; and the windows' intervals.

    The rotation is ``mean + gain step``, with ``variance``; its window is (low, high), softened by ``soft``.

    Attributes:
        there: (n,) which PMs have an interval: those with one look that is no first hit.
        mean, variance: (S, n) rad and rad^2. gain: (S, n, D).
        low, high, soft: (n,) rad.
        site: (n,) sigma of the window's Gaussian site: densities are in its units.
    """

    there: BoolArray
    mean: FloatArray
    variance: FloatArray
    gain: FloatArray
    low: FloatArray
    high: FloatArray
    soft: FloatArray
    site: FloatArray

    def take(self, index: IntArray) -> WindowRows:
        """Some of the PMs."""
        return WindowRows(
            self.there[index],
            self.mean[:, index],
            self.variance[:, index],
            self.gain[:, index],
            self.low[index],
            self.high[index],
            self.soft[index],
            self.site[index],
        )


@dataclass(frozen=True, slots=True, eq=False)
class WhitenedPms:
    """n PMs, linearised at S states; all steps are counted from one base state.

    Attributes:
        residual: (S, n, q), zero in rows that a PM does not have.
        jacobian: (S, n, q, D).
        rest: (S, n) chi square that no step reduces (looks that contradict each other).
        equations: (n,) degrees of freedom of each PM.
        windows: where the rotations of some PMs have an interval instead of a row; None: all have rows.
    """

    residual: FloatArray
    jacobian: FloatArray
    rest: FloatArray
    equations: IntArray
    windows: WindowRows | None = None

    @property
    def count(self) -> int:
        return int(self.residual.shape[1])


def pivot_scale(columns: Columns) -> FloatArray:
    """(D,) typical size of each shared variable's step."""
    scale = np.full(columns.size, TYPICAL_RAD)
    scale[3:6] = TYPICAL_MM
    scale[columns.beam : columns.beam + 2] = TYPICAL_MM
    for place, constant in enumerate(columns.constants, columns.first_constant):
        if TEXTS[constant].unit in ("mm", "px"):
            scale[place] = TYPICAL_MM
    return scale


def whiten(part: Contributions, equations: IntArray, scale: FloatArray, at: FloatArray | None = None) -> WhitenedPms:
    """Whitened equations of PMs by pivoted Cholesky, with one row per equation.

    Args:
        part: cost (S, n), gradient (S, n, D) and Hessians of n PMs.
        equations: (n,).
        scale: (D,) typical steps.
        at: (S, D) steps from the base to the linearisation point of ``part``; None: it is the base.
    """
    hessian, gradient = part.hessian(), part.gradient.copy()
    count, n, size = gradient.shape
    rows = int(equations.max()) if n else 0
    residual, jacobian = np.zeros((count, n, rows)), np.zeros((count, n, rows, size))
    first = np.diagonal(hessian, axis1=-2, axis2=-1) * scale**2
    least = LEAST_PIVOT * np.maximum(first.max(axis=-1, initial=0.0), 1e-30)
    for row in range(rows):
        diagonal = np.diagonal(hessian, axis1=-2, axis2=-1) * scale**2
        pivot = np.argmax(diagonal, axis=-1)[..., None]
        value = np.take_along_axis(diagonal / scale**2, pivot, axis=-1)[..., 0]
        good = (np.take_along_axis(diagonal, pivot, axis=-1)[..., 0] > least) & (row < equations)
        root = np.sqrt(np.where(good, value, 1.0))
        line = np.take_along_axis(hessian, pivot[..., None], axis=-2)[..., 0, :] / root[..., None]
        line = np.where(good[..., None], line, 0.0)
        r = np.where(good, np.take_along_axis(gradient, pivot, axis=-1)[..., 0] / root, 0.0)
        jacobian[:, :, row], residual[:, :, row] = line, r
        hessian -= line[..., :, None] * line[..., None, :]
        gradient -= line * r[..., None]
    rest = np.maximum(part.cost - np.sum(residual**2, axis=-1), 0.0)
    if at is not None:
        residual = residual - times(jacobian, at[:, None, :])
    return WhitenedPms(residual, jacobian, rest, equations)


def linearise(problem: PackedProblem, state: SharedState, base: SharedState | None = None) -> WhitenedPms:
    """The problem's PMs, whitened at S states; steps are counted from ``base`` (one hypothesis; ``state`` where None).

    PMs with one look that is no first hit have their window as an interval, where the problem has shapes.
    """
    private = settled_private(problem, state)
    at = None if base is None else step_between(_repeated(base, state.count), state, problem.columns)
    equations, scale = pm_degrees_of_freedom(problem), pivot_scale(problem.columns)
    there = window_pms(problem)
    if there is None:
        return whiten(contributions(problem, state, private).pm, equations, scale, at)
    look = first_looks(problem)
    weight = problem.looks.weight.copy()
    weight[look[there], 2, 2] = LEAST_PRECISION
    free = replace(problem, looks=replace(problem.looks, weight=weight))
    terms = whiten(contributions(free, state, private).pm, equations - there, scale, at)
    return replace(terms, equations=equations, windows=_window_rows(free, problem, state, private, there, look, at))


def settled_private(problem: PackedProblem, state: SharedState) -> PrivateState:
    """The private variables of S states, optimised from the arcs."""
    private = initial_private(problem, state)
    for _ in range(PRIVATE_ROUNDS):
        private = refine(problem, state, private)
    return private


def first_looks(problem: PackedProblem) -> IntArray:
    """(J,) the first look of each PM."""
    first = np.zeros(len(problem.pms), dtype=np.int64)
    first[problem.look_pm[::-1]] = np.arange(len(problem.look_pm))[::-1]
    return first


def window_pms(problem: PackedProblem) -> BoolArray | None:
    """(J,) PMs with a single look that is no first hit; None where there are none, or the problem has no shapes."""
    if problem.shapes is None or not len(problem.pms):
        return None
    single = np.bincount(problem.look_pm, minlength=len(problem.pms)) == 1
    look = first_looks(problem)
    there = single & (problem.looks.edge_gain[look] == 0.0) & (problem.shapes.amplitude_look < 0)
    return np.asarray(there) if there.any() else None


def _window_rows(
    free: PackedProblem,
    problem: PackedProblem,
    state: SharedState,
    private: PrivateState,
    there: BoolArray,
    look: IntArray,
    at: FloatArray | None,
) -> WindowRows:
    assert problem.shapes is not None  # window_pms
    found = evaluate(free, state, private)
    block = look_block(free, state, private.trus_p_pm[:, problem.look_pm])
    by_point = block.by_point[:, look, 2]
    step = found.private.trus_p_pm - private.trus_p_pm
    mean = block.residual[:, look, 2] + free.looks.centre_rad[look] + np.sum(by_point * step, axis=-1)
    gain = np.einsum("sja,sjad->sjd", by_point, found.point_gain) + block.by_shared[:, look, 2]
    variance = np.sum(by_point * times(found.point_covariance, by_point), axis=-1)
    if at is not None:
        mean = mean - np.sum(gain * at[:, None, :], axis=-1)
    windows = problem.shapes.windows
    edge = edge_sigma_rad(problem)
    return WindowRows(
        there=there,
        mean=mean,
        variance=variance,
        gain=gain,
        low=windows.low_rad[look],
        high=windows.high_rad[look],
        # The edge's error moves both ends. Its effect on one pair is small, so it is added to the softness.
        soft=np.hypot(windows.soft_rad[look], edge),
        site=problem.looks.weight[look, 2, 2] ** -0.5,
    )


def _repeated(state: SharedState, count: int) -> SharedState:
    return state.take(np.zeros(count, dtype=np.int64)) if state.count != count else state


def gaussian_of(hessian: FloatArray, gradient: FloatArray, columns: Columns) -> Gaussian | None:
    """The Gaussian ``exp(-(d' H d) / 2 - g' d)``; None where H does not determine a direction."""
    scale = pivot_scale(columns)
    scaled = hessian * scale * scale[:, None]
    root = np.sqrt(np.maximum(np.diag(scaled), 1e-300))
    try:
        lower = np.linalg.cholesky(scaled / root / root[:, None])
    except np.linalg.LinAlgError:
        return None
    inverse_lower = np.linalg.inv(lower) / root
    covariance = np.asarray(inverse_lower.T @ inverse_lower * scale * scale[:, None])
    return Gaussian(-covariance @ gradient, covariance)
