"""Times the factors and the explicit graph: microseconds per callback, and solve time against the number of pairs.

Prints medians of CPU time; there is no limit to pass. The explicit graph is the reference. A factor should stay cheap
(some 10 us per linearisation), and everything should grow linearly.

    python tools/bench_graph.py
    python tools/bench_graph.py --pairs 100 1000 --repeats 9
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import gtsam
import numpy as np

from fgreg.factors.rig import RigKey
from fgreg.geometry.rig import COUNT, Constant

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from fgreg.factors.epoch_change import epoch_change_factor
from fgreg.factors.marker_pose import marker_pose_factor
from fgreg.factors.point_on_arc import point_on_arc_factor
from fgreg.factors.point_on_line import aim_point_on_line_factor, point_on_line_factor
from fgreg.factors.sensitivity_prior import sensitivity_prior_factor
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.graph.gtsam_graph import GraphOptions, build_graph
from fgreg.graph.gtsam_values import SharedValues
from graph_covariance import GraphCovariance
from graph_optimum import initial_values, optimize
from tests.forward import make_measurements


def median_time(run: Callable[[], object], repeats: int, number: int = 1) -> float:
    """Median over ``repeats`` of the CPU seconds that one ``run`` takes, each measured over ``number`` of them."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        for _ in range(number):
            run()
        times.append((time.process_time() - start) / number)
    return statistics.median(times)


def bench_factors(repeats: int) -> None:
    """One factor at a time, error and linearize, with all its variables."""
    values = gtsam.Values()
    pose = make_transform(exp_so3(np.array([0.3, -0.2, 0.5])), np.array([5.0, -8.0, 90.0]))
    for key in (0, 1):
        values.insert(key, gtsam.Pose3(pose))
    values.insert(2, np.array([1.0, -2.0, 0.1, 0.2]))
    values.insert(3, 40.0)
    values.insertPoint3(4, np.array([3.0, 10.0, 35.0]))
    values.insert(5, 0.3)
    values.insert(6, np.array([0.001, 0.0, 0.0, 0.0]))
    nominal = np.eye(4)
    bias = (Constant.MARKER_BIAS_X, Constant.MARKER_BIAS_Y, Constant.MARKER_BIAS_Z)
    rig = RigKey(6, (Constant.WINDOW_EDGE, *bias))
    gain = np.zeros((6, COUNT))
    gain[3:, bias] = -np.eye(3)
    factors: dict[str, gtsam.NonlinearFactor] = {
        "point on line (pair)": point_on_line_factor(0, 1, 2, 3, 4, nominal),
        "point on line (aim)": aim_point_on_line_factor(1, 2, 3, 4, nominal),
        "point on arc": point_on_arc_factor(4, 5, 0.2, 3.0, 30.0, np.diag([0.09, 0.04]), 10.0),
        "sensitivity prior": sensitivity_prior_factor(5, 0.2, 30.0, 10.0, math.radians(5.0), 1.0, 0.01, rig, 1),
        "marker pose (native)": marker_pose_factor(1, pose, np.eye(6)),
        "marker pose with bias": marker_pose_factor(1, pose, np.eye(6), gain, rig),
        "epoch change (native)": epoch_change_factor(0, 1, np.eye(4), np.eye(6)),
    }
    print(f"{'factor':<24}{'error us':>10}{'linearize us':>14}")
    for name, factor in factors.items():
        # A thousand in one graph, so that the call from Python is negligible.
        graph = gtsam.NonlinearFactorGraph()
        for _ in range(1000):
            graph.add(factor)
        error = median_time(lambda graph=graph: graph.error(values), repeats)  # type: ignore[misc]
        linearize = median_time(lambda graph=graph: graph.linearize(values), repeats)  # type: ignore[misc]
        print(f"{name:<24}{error * 1e3:>10.1f}{linearize * 1e3:>14.1f}")


def bench_graph(pairs: int, repeats: int, seed: int) -> None:
    """One session: time to build, linearise once, eliminate once, solve, and to get the covariances."""
    session, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=pairs)
    options = GraphOptions(marker_T_nominal=truth.marker_T_laser)
    build = median_time(lambda: build_graph(measurements, session, options), repeats)
    explicit = build_graph(measurements, session, options)
    shake = make_transform(exp_so3(np.array([0.05, -0.05, 0.05])), np.array([3.0, 3.0, -3.0]))
    start = SharedValues(tuple(trus_T_camera @ shake for trus_T_camera in truth.trus_T_camera), np.zeros(4))
    values = initial_values(explicit, start)
    linearize = median_time(lambda: explicit.graph.linearize(values), repeats)
    linear, ordering = explicit.graph.linearize(values), explicit.ordering
    eliminate = median_time(lambda: linear.optimize(ordering, gtsam.EliminateQR), repeats)
    solve = median_time(lambda: optimize(explicit, values), repeats)
    optimum = optimize(explicit, values)
    covariance = median_time(lambda: GraphCovariance(explicit, optimum.values), repeats)
    marginals = GraphCovariance(explicit, optimum.values)
    one = median_time(lambda: marginals.of(explicit.keys.theta[0]), repeats, number=20)
    print(
        f"{pairs:>6}{build * 1e3:>10.1f}{linearize * 1e3:>14.1f}{eliminate * 1e3:>14.1f}{solve * 1e3:>10.1f}"
        f"{optimum.iterations:>12}{covariance * 1e3:>14.1f}{one * 1e6:>14.0f}   {optimum.cost:.6f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, nargs="+", default=[100, 300, 1000], help="numbers of pairs to solve with")
    parser.add_argument("--repeats", type=int, default=5, help="of each measurement; the median counts")
    parser.add_argument("--seed", type=int, default=0, help="of the simulated sessions")
    arguments = parser.parse_args()
    bench_factors(arguments.repeats)
    print()
    print(
        f"{'pairs':>6}{'build ms':>10}{'linearize ms':>14}{'eliminate ms':>14}{'solve ms':>10}{'iterations':>12}"
        f"{'covariance ms':>14}{'marginal us':>14}   cost"
    )
    for pairs in arguments.pairs:
        bench_graph(pairs, arguments.repeats, arguments.seed)


if __name__ == "__main__":
    main()
