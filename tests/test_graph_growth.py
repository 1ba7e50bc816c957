"""One linearisation takes a fixed number of callbacks per pair, and a deleted graph leaves no memory behind."""

from __future__ import annotations

import gc
import types
from typing import Any

import gtsam
import numpy as np
import pytest

from fgreg.factors import marker_pose, point_on_arc, point_on_line, sensitivity_prior
from fgreg.factors.adapter import Residual, custom_factor
from graph_covariance import GraphCovariance
from graph_optimum import initial_values, optimize
from tests.forward import make_session, with_noise
from tests.graph_cases import make_case


def test_callbacks_of_a_linearisation_grow_linearly(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = 0

    def count(module: types.ModuleType, name: str) -> None:
        original = getattr(module, name)

        def counted(*args: Any, **kwargs: Any) -> Residual:
            nonlocal calls
            calls += 1
            result: Residual = original(*args, **kwargs)
            return result

        monkeypatch.setattr(module, name, counted)

    for module in (marker_pose, point_on_arc, point_on_line, sensitivity_prior):
        count(module, "residual")
    count(point_on_line, "aim_residual")
    session = with_noise(make_session(), marker_bias_mm=0.5)
    for aims, pairs in ((0, 10), (0, 20), (0, 40), (7, 10)):
        explicit, shared, _ = make_case(101, noise=True, aims=aims, pairs=pairs, session=session)
        values = initial_values(explicit, shared)
        calls = 0
        explicit.graph.linearize(values)
        # Per pair: marker pose (with its bias), point on line, point on arc, sensitivity. Per aim: the first two.
        assert calls == 4 * pairs + 2 * aims


def test_callbacks_get_the_callers_values_and_no_copy_of_them() -> None:
    # What makes the solver's own loop linear: GTSAM hands Python the very object, where Python holds it.
    seen: list[gtsam.Values] = []

    def evaluate(values: gtsam.Values, _: bool) -> Residual:
        seen.append(values)
        return (0.0,), (((1.0,),),)

    graph = gtsam.NonlinearFactorGraph()
    graph.add(custom_factor("probe", gtsam.noiseModel.Unit.Create(1), [0], 1, (1,), evaluate))
    values = gtsam.Values()
    values.insert(0, 1.0)
    graph.linearize(values)
    graph.error(values)
    retracted = values.retract(values.zeroVectors())
    graph.linearize(retracted)
    assert [one is values for one in seen] == [True, True, False]
    assert seen[2] is retracted


def live_callbacks() -> int:
    return sum(
        isinstance(one, types.FunctionType) and one.__qualname__.startswith("custom_factor") for one in gc.get_objects()
    )


def test_a_dropped_graph_is_freed_without_the_cycle_collector() -> None:
    gc.collect()
    before = live_callbacks()
    gc.disable()
    try:
        for seed in range(3):
            explicit, shared, _ = make_case(seed, noise=True, looks_per_pm=2)
            optimum = optimize(explicit, initial_values(explicit, shared))
            covariance = GraphCovariance(explicit, optimum.values)
            assert np.isfinite(covariance.of(explicit.keys.theta[0])).all()
            assert live_callbacks() > before
            del explicit, shared, optimum, covariance
            assert live_callbacks() == before
    finally:
        gc.enable()
