"""Sessions of every shape that the explicit graph supports, for its tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from fgreg.geometry.transforms import FloatArray, exp_so3, log_so3, make_transform
from fgreg.graph.gtsam_graph import ExplicitGraph, GraphOptions, build_graph
from fgreg.graph.gtsam_values import SharedValues, laser_chart
from tests.forward import Truth, make_measurements, make_session, true_constants

CASES: dict[str, dict[str, Any]] = {
    "first hit": {},
    "window only": {"first_hit": False, "pairs": 15},
    "three looks, own shots": {"looks_per_pm": 3, "pairs": 6},
    "three looks, one shot": {"looks_per_pm": 3, "share_marker": True, "pairs": 8},
    "two epochs, known motion": {"epochs": 2, "known_motion": True, "pairs": 14},
    "two epochs, unknown motion": {"epochs": 2, "pairs": 20},
    "no aims": {"aims": 0, "pairs": 20},
    "depth-dependent window": {"session": make_session(half_width_deg=(4.0, 6.0, 9.0))},
}


def off_nominal(truth: Truth) -> FloatArray:
    """A nominal frame some 10 deg and 4 mm off the true beam."""
    nominal = np.array(truth.marker_T_laser)
    nominal[:3, :3] = nominal[:3, :3] @ exp_so3(np.array([0.1, -0.15, 0.3]))
    nominal[:3, 3] += (1.0, 2.0, 3.0)
    return nominal


def make_case(
    seed: int, noise: bool, options: dict[str, Any] | None = None, **arguments: Any
) -> tuple[ExplicitGraph, SharedValues, Truth]:
    """A session's graph, the true shared variables, and the whole truth."""
    session, measurements, truth = make_measurements(np.random.default_rng(seed), noise=noise, **arguments)
    nominal = off_nominal(truth)
    explicit = build_graph(measurements, session, GraphOptions(marker_T_nominal=nominal, **(options or {})))
    shared = SharedValues(
        trus_T_camera=truth.trus_T_camera,
        marker_laser=laser_chart(truth.marker_T_laser, nominal)[0],
        constants=true_constants(truth),
    )
    return explicit, shared, truth


def perturbed(shared: SharedValues, rng: np.random.Generator, rad: float, mm: float) -> SharedValues:
    """The shared variables with registrations and beam off by random normal amounts of these sigmas."""
    return SharedValues(
        trus_T_camera=tuple(
            trus_T_camera @ make_transform(exp_so3(rng.normal(size=3) * rad), rng.normal(size=3) * mm)
            for trus_T_camera in shared.trus_T_camera
        ),
        marker_laser=shared.marker_laser + rng.normal(size=4) * (0.3 * mm, 0.3 * mm, 0.3 * rad, 0.3 * rad),
    )


def pose_error(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """(6,) right tangent (rotation rad, translation mm) of the truth, seen from the estimate; to first order."""
    turn = estimate[:3, :3].T
    return np.concatenate([log_so3(turn @ truth[:3, :3]), turn @ (truth[:3, 3] - estimate[:3, 3])])
