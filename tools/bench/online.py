"""One event of a session that runs: what each way of keeping the estimate takes for the next pair.

The full solve, which runs in a worker process while a session runs, is left out here: the part full-solve times it.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from typing import Protocol

import gtsam
import numpy as np

from bench.compare import Row, Section, Target, say
from bench.contenders import linear_rows
from fgreg.graph.columns import make_columns
from fgreg.graph.gtsam_graph import GraphOptions, build_graph
from fgreg.graph.gtsam_values import SharedValues
from fgreg.graph.packing import least_sigmas, pack
from fgreg.graph.reduced_solver import optimize
from fgreg.graph.shared_state import make_state
from fgreg.model.measurements import Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.full_solve import FullSolveCase
from fgreg.online.solver import InProcessSolver
from fgreg.smoother.isam_window import empty_isam
from fgreg.smoother.updates import LEAVE, MOST
from graph_optimum import initial_values, read_shared
from graph_optimum import optimize as optimize_graph
from tests.forward import Truth, make_measurements
from tests.online_streams import first

STAGES = ((11, 40), (131, 160))
"""Pairs that are timed: first and last."""


class Keeper(Protocol):
    """Takes in the pair of a number; returns the seconds that count."""

    def take(self, index: int) -> float: ...


class _TimedSolver(InProcessSolver):
    """The full solve, with its time."""

    spent = 0.0

    def submit(self, case: FullSolveCase) -> None:
        start = time.process_time()
        super().submit(case)
        self.spent += time.process_time() - start


class Engine:
    """This package's engine, without its full solves."""

    def __init__(self, model: SessionModel, measurements: Measurements) -> None:
        self._engine = OnlineRegistration(model)
        self._engine._solver = self._solver = _TimedSolver(model, SolveConfig(), verdicts=True)
        self._pairs = measurements.pairs
        for aim in measurements.aims:
            self._engine.add(aim)

    def take(self, index: int) -> float:
        self._solver.spent = 0.0
        start = time.process_time()
        self._engine.add(self._pairs[index])
        return time.process_time() - start - self._solver.spent


class RebuiltReduced:
    """The reduced problem of all pairs, packed and solved again from the optimum before."""

    def __init__(self, model: SessionModel, measurements: Measurements, truth: Truth) -> None:
        self._model, self._measurements = model, measurements
        self._state = make_state(np.stack(truth.trus_T_camera)[None], truth.marker_T_laser)

    def take(self, index: int) -> float:
        start = time.process_time()
        found = optimize(pack(first(self._measurements, index + 1), self._model), self._state)
        np.linalg.inv(found.evaluation.hessian[0])
        took = time.process_time() - start
        self._state = found.state
        return took


class RebuiltExplicit:
    """The explicit graph of all pairs, built and solved again from the optimum before."""

    def __init__(self, model: SessionModel, measurements: Measurements, truth: Truth) -> None:
        self._model, self._measurements = model, measurements
        self._options = GraphOptions(marker_T_nominal=truth.marker_T_laser)
        self._shared = SharedValues(truth.trus_T_camera, np.zeros(4))

    def take(self, index: int) -> float:
        start = time.process_time()
        explicit = build_graph(first(self._measurements, index + 1), self._model, self._options)
        found = optimize_graph(explicit, initial_values(explicit, self._shared), tolerance=1e-7)
        self._shared = read_shared(explicit, found.values, self._shared)
        return time.process_time() - start


class IsamAll:
    """iSAM2 with custom factors, every pair kept."""

    def __init__(self, model: SessionModel, measurements: Measurements, truth: Truth) -> None:
        options = GraphOptions(marker_T_nominal=truth.marker_T_laser)
        self._explicit = build_graph(measurements, model, options)
        self._values = initial_values(self._explicit, SharedValues(truth.trus_T_camera, np.zeros(4)))
        self._isam = empty_isam(make_columns(1, least_sigmas(model.constant_sigmas)), spots=True)
        keys, count = self._explicit.keys, len(measurements.pairs)
        self._looks = self._explicit.graph.size() - 2 * count
        self._shots = self._looks - 2 * count
        self._shared = list(keys.shared)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for index in range(self._shots):
            graph.add(self._explicit.graph.at(index))
        own = {key for index in range(self._shots) for key in self._explicit.graph.at(index).keys()}  # noqa: SIM118
        for key in own:
            self._insert(values, key)
        # Before the first pair the registration has nothing that holds it.
        pose = keys.trus_T_camera[0]
        self._insert(values, pose)
        graph.add(gtsam.PriorFactorPose3(pose, self._values.atPose3(pose), gtsam.noiseModel.Isotropic.Sigma(6, 1e3)))
        self._theta = self._isam.getLinearizationPoint()  # held, or each callback copies all values
        self._isam.update(graph, values)

    def _insert(self, values: gtsam.Values, key: int) -> None:
        letter = chr(gtsam.Symbol(key).chr())
        if letter in "TM":
            values.insert(key, self._values.atPose3(key))
        elif letter in "PS":
            values.insert(key, self._values.atPoint3(key))
        elif letter in "LH":
            values.insert(key, self._values.atDouble(key))
        else:
            values.insert(key, self._values.atVector(key))

    def take(self, index: int) -> float:
        keys = self._explicit.keys
        shot = keys.shots[index]
        values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
        for key in (shot.camera_T_marker, shot.lam, shot.trus_p_pm, keys.theta[index]):
            self._insert(values, key)
        places = [self._shots + 2 * index, self._shots + 2 * index + 1]
        for place in (*places, self._looks + 2 * index, self._looks + 2 * index + 1):
            graph.add(self._explicit.graph.at(place))
        start = time.process_time()
        self._isam.update(graph, values)
        self._isam.calculateEstimatePose3(keys.trus_T_camera[0])
        self._isam.jointMarginalCovariance(self._shared)
        return time.process_time() - start


class Native:
    """Updates of iSAM2 with native factors: what ``add`` would take if GTSAM did everything.

    Each pair's factors are on the same keys, with the same dimensions, as in fgreg.smoother.isam_window: a prior of the
    marker pose (6), point on line (3) on registration, marker pose, beam, lambda and PM, point on arc (3) on PM and
    theta, sensitivity (1) on theta and the rig's constants. As many pairs stay in the active window. Not matched: all
    but the marker's prior are linear (the wrapper has no native factor on those keys), there is no marginal prior, and
    no pair is prepared, tested or reported.
    """

    def __init__(self, model: SessionModel) -> None:
        columns = make_columns(1, least_sigmas(model.constant_sigmas))
        self._rng, self._isam, self._constants = np.random.default_rng(0), empty_isam(columns), len(columns.constants)
        self._pose, self._beam, self._edge = (gtsam.symbol(name, 0) for name in "TBC")
        self._unit = {n: gtsam.noiseModel.Unit.Create(n) for n in (self._constants, 4, 6)}
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(gtsam.PriorFactorPose3(self._pose, gtsam.Pose3(), self._unit[6]))
        graph.add(gtsam.PriorFactorVector(self._beam, np.zeros(4), self._unit[4]))
        graph.add(gtsam.PriorFactorVector(self._edge, np.zeros(self._constants), self._unit[self._constants]))
        values.insert(self._pose, gtsam.Pose3())
        values.insert(self._beam, np.zeros(4))
        values.insert(self._edge, np.zeros(self._constants))
        self._isam.update(graph, values)
        self._shared, self._slots = gtsam.Values(values), list[list[int]]()

    def take(self, index: int) -> float:
        pose, beam, edge = (self._pose, 6), (self._beam, 4), self._edge
        marker, point, lam, arc = (gtsam.symbol(name, index) for name in "MPLH")
        values = gtsam.Values()
        values.insert(marker, gtsam.Pose3())
        values.insert(point, np.zeros(3))
        values.insert(lam, 0.0)
        values.insert(arc, 0.0)
        every = gtsam.Values(self._shared)
        every.insert(values)
        line = [[pose, (marker, 6), (point, 3)], [beam, (lam, 1), (point, 3)], [pose, beam, (lam, 1)]]
        graph = gtsam.NonlinearFactorGraph()
        graph.add(gtsam.PriorFactorPose3(marker, gtsam.Pose3(), self._unit[6]))
        graph.add(linear_rows(self._rng, every, line))
        graph.add(linear_rows(self._rng, every, [[(point, 3), (arc, 1)]] * 3))
        graph.add(linear_rows(self._rng, every, [[(edge, self._constants), (arc, 1)]]))
        oldest = self._slots[:LEAVE] if len(self._slots) == MOST else []
        self._slots = self._slots[len(oldest) :]
        start = time.process_time()
        self._isam = gtsam.ISAM2(self._isam)
        theta = self._isam.getLinearizationPoint()  # has to outlive the update
        result = self._isam.update(graph, values, [slot for group in oldest for slot in group])
        self._isam.calculateEstimatePose3(self._pose)
        self._isam.jointMarginalCovariance([self._pose, self._beam, edge])
        took = time.process_time() - start
        self._slots.append(list(result.getNewFactorsIndices()))
        del theta
        return took


def bench_online(_repeats: int, seed: int) -> Section:
    """Each pair of one long epoch goes to all in turn; the pairs of a stage are its rounds."""
    model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=STAGES[-1][1])
    keepers: dict[str, Callable[[], Keeper]] = {
        "this package": lambda: Engine(model, measurements),
        "iSAM2, native factors, active window": lambda: Native(model),
        "rebuilding, reduced graph": lambda: RebuiltReduced(model, measurements, truth),
        "rebuilding, explicit graph": lambda: RebuiltExplicit(model, measurements, truth),
        "iSAM2, everything kept": lambda: IsamAll(model, measurements, truth),
    }
    made = {name: make() for name, make in keepers.items()}
    took: dict[str, list[float]] = {name: [] for name in made}
    for index in range(len(measurements.pairs)):
        if index % 40 == 0:
            say(f"online: pair {index + 1}")
        for name, keeper in made.items():
            took[name].append(keeper.take(index))
    rows: list[Row] = []
    targets: list[Target] = []
    for low, high in STAGES:
        base = took["this package"][low - 1 : high]
        others: dict[str, float] = {}
        for name, times in took.items():
            own = times[low - 1 : high]
            ratios = [mine / other for mine, other in zip(own, base, strict=True)]
            first_quarter, _, last_quarter = statistics.quantiles(ratios, n=4)
            ms, ratio = 1e3 * statistics.median(own), statistics.median(ratios)
            case = f"pairs {low} to {high} of an epoch, without the full solve"
            worse = 0 if name == "this package" else -1
            rows.append(Row("online", case, name, ms, ratio, first_quarter, last_quarter, len(own), worse=worse))
            if name != "this package" and "native" not in name:
                others[name] = ratio
        fastest = min(others, key=lambda name: others[name])
        text = f"an event at {low} to {high} pairs over the fastest of the others ({fastest})"
        targets.append(Target(text, 1.0 / others[fastest], 1.0))
    return Section(tuple(rows), tuple(targets))
