"""Contenders of the solve: each minimises one session's cost from the same start. ``None``: not installed.

A contender is prepared once (problem built, nothing solved) and then run several times. What each library does best
from Python is used: vectorised residuals and sparse analytic Jacobians for scipy, a Schur complement for Ceres,
generated linearisations for symforce, private variables first for GTSAM.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix

from baseline_alternating import AlternatingResult, LinesAndArcs, register_alternating
from bench.scene import (
    OF_AIM,
    OF_PAIR,
    SHARED,
    Blocks,
    Scene,
    aim_blocks,
    cost_at,
    make_scene,
    pair_blocks,
    shared_from,
)
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.gtsam_graph import ExplicitGraph, GraphOptions, build_graph, make_ordering
from fgreg.graph.gtsam_values import SharedValues, beam_of_chart
from fgreg.graph.packing import pack
from fgreg.graph.reduced_solver import Optimum, optimize
from fgreg.graph.shared_state import make_state
from fgreg.model.measurements import Measurements
from fgreg.model.session_model import SessionModel
from graph_optimum import initial_values
from graph_optimum import optimize as optimize_graph

COST_TOLERANCE = 1e-7
"""At which an optimiser stops, as a share of the cost; all are within 1e-6 of the least cost with it."""


@dataclass(frozen=True, slots=True, eq=False)
class Solver:
    """A problem that was built: ``run`` solves it, ``cost`` reads the chi square of what it returned.

    ``note``: why the cost is not that of the others, if so.
    """

    run: Callable[[], Any]
    cost: Callable[[Any], float] | None
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """A session of one epoch and the start (4, 4), (4, 4) of its registration and beam."""

    model: SessionModel
    measurements: Measurements
    trus_T_camera: FloatArray
    marker_T_laser: FloatArray

    def scene(self) -> Scene:
        return make_scene(self.measurements, self.model, self.trus_T_camera, self.marker_T_laser)

    def explicit(self) -> tuple[ExplicitGraph, gtsam.Values]:
        """The explicit graph and its start."""
        explicit = build_graph(self.measurements, self.model, GraphOptions(marker_T_nominal=self.marker_T_laser))
        return explicit, initial_values(explicit, SharedValues((self.trus_T_camera,), np.zeros(4)))


def installed(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


def reduced(case: Case) -> Solver:
    """This package: private variables eliminated in closed form, all pairs at once.

    Its cost is read in the form that the others minimise: its own has the markers' errors to second order.
    """
    problem, scene = pack(case.measurements, case.model), case.scene()
    start = make_state(case.trus_T_camera[None, None], case.marker_T_laser)

    def cost(found: Optimum) -> float:
        state = found.state
        edge_rad = float(state.constant(Constant.WINDOW_EDGE)[0])
        return cost_at(scene, shared_from(scene, state.trus_T_camera()[0], state.beam[0], edge_rad))

    return Solver(lambda: optimize(problem, start), cost)


def explicit_own(case: Case) -> Solver:
    """The explicit graph of custom factors with the reference solver of this repository (values that Python holds)."""
    explicit, values = case.explicit()
    return Solver(
        lambda: optimize_graph(explicit, values, tolerance=COST_TOLERANCE), lambda found: 2.0 * float(found.cost)
    )


def _lm_params(ordering: gtsam.Ordering) -> gtsam.LevenbergMarquardtParams:
    params = gtsam.LevenbergMarquardtParams()
    params.setOrdering(ordering)
    params.setLinearSolverType("MULTIFRONTAL_QR")
    params.setRelativeErrorTol(COST_TOLERANCE)
    params.setAbsoluteErrorTol(0.0)
    params.setMaxIterations(200)
    params.setlambdaUpperBound(1e12)
    return params


def gtsam_lm(case: Case) -> Solver:
    """GTSAM's own Levenberg-Marquardt on the explicit graph of custom factors."""
    explicit, values = case.explicit()
    params = _lm_params(explicit.ordering)

    return Solver(
        lambda: gtsam.LevenbergMarquardtOptimizer(explicit.graph, values, params).optimize(),
        lambda found: 2.0 * float(explicit.graph.error(found)),
    )


def linear_rows(
    rng: np.random.Generator, values: gtsam.Values, rows: list[list[tuple[int, int]]]
) -> gtsam.NonlinearFactor:
    """A native factor on keys of these dimensions, with at most three keys in a row, as the wrapper allows."""
    graph = gtsam.GaussianFactorGraph()
    for row_keys in rows:
        blocks = [x for key, size in row_keys for x in (key, rng.normal(size=(1, size)))]
        graph.add(gtsam.JacobianFactor(*blocks, np.zeros(1), gtsam.noiseModel.Unit.Create(1)))  # type: ignore[call-overload]
    return gtsam.LinearContainerFactor(gtsam.JacobianFactor(graph), values)


def native(case: Case) -> Solver:
    """A graph of native factors in the shape of the explicit one, as many iterations as that needs.

    Keys and dimensions of variables and residuals are those of the explicit graph. Point on line and point on arc are
    native linear factors, because the wrapper has no nonlinear ones on such keys; markers have native pose priors.
    """
    explicit, values = case.explicit()
    count = optimize_graph(explicit, values, tolerance=COST_TOLERANCE).iterations
    run = _iterate(native_graph(explicit, values), values, explicit.ordering, count)
    return Solver(run, None, f"another cost; {count} iterations, as the explicit graph needs")


STAR_ITERATIONS = 5


def native_star(case: Case) -> Solver:
    """The smallest graph of native factors: one pose, and for each pair lambda and theta with a factor of three rows.

    No marker poses, no PMs, no beam: what a solve would take if these were known. ``STAR_ITERATIONS`` iterations.
    """
    rng, unit = np.random.default_rng(0), gtsam.noiseModel.Unit.Create
    graph, values, pose = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.symbol("T", 0)
    values.insert(pose, gtsam.Pose3())
    graph.add(gtsam.PriorFactorPose3(pose, gtsam.Pose3(), unit(6)))
    keys = [(gtsam.symbol("L", i), gtsam.symbol("H", i)) for i in range(len(case.measurements.pairs))]
    for own in keys:
        for key in own:
            values.insert(key, 0.0)
    for distance, theta in keys:
        graph.add(linear_rows(rng, values, [[(pose, 6), (distance, 1), (theta, 1)]] * 3))
        graph.add(gtsam.PriorFactorDouble(theta, 0.1, unit(1)))
    ordering = make_ordering([*(key for own in keys for key in own), pose])
    return Solver(
        _iterate(graph, values, ordering, STAR_ITERATIONS), None, f"another cost; {STAR_ITERATIONS} iterations"
    )


def _iterate(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering, count: int
) -> Callable[[], float]:
    params = gtsam.LevenbergMarquardtParams()
    params.setOrdering(ordering)

    def run() -> float:
        optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
        for _ in range(count):
            optimizer.iterate()
        return float(optimizer.error())

    return run


def native_graph(explicit: ExplicitGraph, values: gtsam.Values) -> gtsam.NonlinearFactorGraph:
    """Native factors on the keys of an explicit graph."""
    rng, keys, graph = np.random.default_rng(0), explicit.keys, gtsam.NonlinearFactorGraph()
    unit = {n: gtsam.noiseModel.Unit.Create(n) for n in (1, 3, 4, 6)}
    pose, beam = keys.trus_T_camera[0], keys.marker_laser
    rig = keys.rig.key if keys.rig is not None else None
    graph.add(gtsam.PriorFactorPose3(pose, gtsam.Pose3(), unit[6]))
    graph.add(gtsam.PriorFactorVector(beam, np.zeros(4), unit[4]))
    if rig is not None:
        graph.add(gtsam.PriorFactorVector(rig, np.zeros(1), unit[1]))
    for aim in keys.aims:
        graph.add(gtsam.PriorFactorPose3(aim.camera_T_marker, gtsam.Pose3(), unit[6]))
        graph.add(gtsam.PriorFactorPoint3(aim.camera_p_spot, np.zeros(3), unit[3]))
        marker, spot = (aim.camera_T_marker, 6), (aim.camera_p_spot, 3)
        rows = [[marker, (beam, 4), spot], [marker, (aim.lam, 1), spot], [(beam, 4), (aim.lam, 1), spot]]
        graph.add(linear_rows(rng, values, rows))
    for place, shot in enumerate(keys.shots):
        marker, point, distance = (shot.camera_T_marker, 6), (shot.trus_p_pm, 3), (shot.lam, 1)
        graph.add(gtsam.PriorFactorPose3(shot.camera_T_marker, gtsam.Pose3(), unit[6]))
        rows = [[(pose, 6), marker, point], [(beam, 4), distance, point], [(pose, 6), (beam, 4), distance]]
        graph.add(linear_rows(rng, values, rows))
        theta = (keys.theta[place], 1)
        graph.add(linear_rows(rng, values, [[point, theta]] * 3))
        graph.add(linear_rows(rng, values, [[theta] if rig is None else [theta, (rig, 1)]]))
    return graph


class SparseProblem:
    """The scene as one residual vector with a sparse Jacobian; columns: shared, aims, pairs."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        _, aims, pairs = scene.start()
        self.first = SHARED, SHARED + aims.size
        self.size = SHARED + aims.size + pairs.size
        columns, starts = [], [0]
        for first, private, rows in ((self.first[0], aims, 12), (self.first[1], pairs, 13)):
            count, width = private.shape
            own = first + width * np.arange(count)[:, None] + np.arange(width)
            both = np.concatenate([np.tile(np.arange(SHARED), (count, 1)), own], axis=1)
            columns.append(np.repeat(both, rows, axis=0).ravel())
            starts += list(starts[-1] + (SHARED + width) * np.arange(1, count * rows + 1))
        columns.append(np.array([SHARED - 1]))
        starts.append(starts[-1] + 1)
        self.columns, self.starts = np.concatenate(columns), np.array(starts)

    def start(self) -> FloatArray:
        shared, aims, pairs = self.scene.start()
        return np.concatenate([shared, aims.ravel(), pairs.ravel()])

    def blocks(self, x: FloatArray) -> tuple[Blocks, Blocks]:
        aims, pairs = x[self.first[0] : self.first[1]], x[self.first[1] :]
        return (
            aim_blocks(self.scene, x[:SHARED], aims.reshape(-1, OF_AIM)),
            pair_blocks(self.scene, x[:SHARED], pairs.reshape(-1, OF_PAIR)),
        )

    def residual(self, x: FloatArray) -> FloatArray:
        parts = [block.residual.ravel() for block in self.blocks(x)]
        return np.concatenate([*parts, x[SHARED - 1 : SHARED] / self.scene.edge_sigma_rad])

    def jacobian(self, x: FloatArray) -> csr_matrix:
        parts = [np.concatenate([b.by_shared, b.by_private], axis=2).ravel() for b in self.blocks(x)]
        data = np.concatenate([*parts, np.array([1.0 / self.scene.edge_sigma_rad])])
        return csr_matrix((data, self.columns, self.starts), shape=(len(self.starts) - 1, self.size))


def scipy_least_squares(case: Case) -> Solver:
    """``scipy.optimize.least_squares``, trust region with sparse analytic Jacobians (its steps are by LSMR)."""
    problem = SparseProblem(case.scene())
    start = problem.start()

    def run() -> Any:
        return least_squares(
            problem.residual,
            start,
            problem.jacobian,
            x_scale="jac",
            ftol=COST_TOLERANCE,
            xtol=1e-12,
            gtol=1e-12,
            tr_solver="lsmr",
            max_nfev=500,
        )

    return Solver(run, lambda found: 2.0 * float(found.cost))


def ceres(case: Case) -> Solver | None:
    """Ceres by pyceres: one Python cost function a shot, with analytic Jacobians; SPARSE_SCHUR."""
    if not installed("pyceres"):
        return None
    import pyceres

    scene = case.scene()

    class Shot(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self, of: Callable[..., Blocks], index: int, rows: int, width: int) -> None:
            super().__init__()
            self._of, self._index, self._rows = of, index, rows
            self.set_num_residuals(rows)
            self.set_parameter_block_sizes([SHARED, width])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
            found = self._of(scene, parameters[0], parameters[1][None], self._index)
            residuals[:] = found.residual[0]
            if jacobians is not None:
                if jacobians[0] is not None:
                    jacobians[0][:] = found.by_shared[0].ravel()
                if jacobians[1] is not None:
                    jacobians[1][:] = found.by_private[0].ravel()
            return True

    class Edge(pyceres.CostFunction):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.set_num_residuals(1)
            self.set_parameter_block_sizes([SHARED])

        def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
            residuals[0] = parameters[0][SHARED - 1] / scene.edge_sigma_rad
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = 0.0
                jacobians[0][SHARED - 1] = 1.0 / scene.edge_sigma_rad
            return True

    shots = [Shot(aim_blocks, i, 12, OF_AIM) for i in range(scene.aims)]
    shots += [Shot(pair_blocks, i, 13, OF_PAIR) for i in range(scene.pairs)]
    edge = Edge()

    def run() -> float:
        shared, aims, pairs = scene.start()
        problem, options, summary = pyceres.Problem(), pyceres.SolverOptions(), pyceres.SolverSummary()
        for cost, own in zip(shots, [*aims, *pairs], strict=True):
            problem.add_residual_block(cost, None, [shared, own])
        problem.add_residual_block(edge, None, [shared])
        options.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
        options.function_tolerance, options.parameter_tolerance = COST_TOLERANCE, 1e-12
        options.num_threads, options.minimizer_progress_to_stdout = 1, False
        options.logging_type = pyceres.LoggingType.SILENT
        options.max_num_iterations = 200
        pyceres.solve(options, problem, summary)
        return 2.0 * float(summary.final_cost)

    return Solver(run, lambda found: float(found))


def alternating(case: Case) -> Solver:
    """The published method, until a round lowers its cost by less than 1e-9 of it."""
    scene = case.scene()
    origin, direction = beam_of_chart(np.zeros(4), case.marker_T_laser)
    markers = slice(scene.aims, None)
    data = LinesAndArcs(
        scene.rotation[markers] @ origin + scene.translation_mm[markers],
        scene.rotation[markers] @ direction,
        scene.scan_rad,
        scene.x_mm,
        scene.range_mm,
        scene.radius_mm,
    )

    def cost(found: AlternatingResult) -> float:
        return cost_at(scene, shared_from(scene, found.trus_T_camera, np.zeros(4), 0.0))

    return Solver(lambda: register_alternating(data, case.trus_T_camera), cost, "another cost; beam given")


def symforce(case: Case) -> Solver | None:
    """symforce's optimiser, from Python: its C++ Levenberg-Marquardt with linearisations that it generates."""
    if not installed("symforce"):
        return None
    from bench.symforce_problem import make_run

    return Solver(make_run(case.scene(), COST_TOLERANCE), lambda found: float(found))


CONTENDERS: dict[str, Callable[[Case], Solver | None]] = {
    "this package": reduced,
    "native factors, star": native_star,
    "native factors, whole shape": native,
    "explicit graph, values held by Python": explicit_own,
    "explicit graph, GTSAM's LM": gtsam_lm,
    "scipy least_squares": scipy_least_squares,
    "Ceres (pyceres)": ceres,
    "symforce": symforce,
    "alternating (published)": alternating,
}
"""The first is what the others are compared with."""
