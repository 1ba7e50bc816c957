"""The adapter refuses what GTSAM would take silently, and leaves nothing behind."""

from __future__ import annotations

import gc
import math
import weakref
from collections.abc import Sequence

import gtsam
import numpy as np
import pytest

from fgreg.factors.adapter import FactorError, Residual, custom_factor

GOOD: tuple[Sequence[float], Sequence[Sequence[Sequence[float]]]] = (
    (1.0, 2.0),
    (((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)), ((7.0,), (8.0,))),
)


def make(residual: Residual, dims: Sequence[int] = (3, 1)) -> gtsam.CustomFactor:
    noise_model = gtsam.noiseModel.Isotropic.Sigma(2, 0.5)
    return custom_factor("odd", noise_model, [0, 1], 2, dims, lambda *_: residual)


def values() -> gtsam.Values:
    out = gtsam.Values()
    out.insertPoint3(0, np.zeros(3))
    out.insert(1, 0.0)
    return out


def test_passes_error_and_jacobians_through() -> None:
    factor = make(GOOD)
    blocks, b = factor.linearize(values()).jacobian()
    np.testing.assert_allclose(blocks, 2.0 * np.array([[1, 2, 3, 7], [4, 5, 6, 8]]))
    np.testing.assert_allclose(b, [-2.0, -4.0])
    assert factor.error(values()) == pytest.approx(0.5 * (4.0 + 16.0))


@pytest.mark.parametrize(
    ("residual", "message"),
    [
        (((1.0, 2.0, 3.0), GOOD[1]), "error of length 3, expected 2"),
        (((1.0,), GOOD[1]), "error of length 1"),
        (((1.0, math.nan), GOOD[1]), "not finite"),
        (((math.inf, -math.inf), GOOD[1]), "not finite"),
        ((GOOD[0], GOOD[1][:1]), "1 Jacobians, expected 2"),
        ((GOOD[0], ()), "0 Jacobians"),
        ((GOOD[0], (*GOOD[1], ((1.0,), (1.0,)))), "3 Jacobians"),
        ((GOOD[0], (GOOD[1][0], ((7.0, 8.0),))), "Jacobian 1 has 1 rows, expected 2"),
        ((GOOD[0], (((1.0, 4.0), (2.0, 5.0), (3.0, 6.0)), GOOD[1][1])), "Jacobian 0 has 3 rows"),
        ((GOOD[0], (((1.0, 2.0, 3.0), (4.0, 5.0)), GOOD[1][1])), "Jacobian 0 has a row of 2, expected 3"),
        ((GOOD[0], (GOOD[1][0], ((7.0,), (math.nan,)))), "Jacobian has an entry that is not finite"),
        ((GOOD[0], (GOOD[1][0], ((math.inf,), (8.0,)))), "Jacobian has an entry that is not finite"),
    ],
)
def test_refuses_wrong_shapes_and_numbers_that_are_not_finite(residual: Residual, message: str) -> None:
    with pytest.raises(FactorError, match=message) as caught:
        make(residual).linearize(values())
    assert str(caught.value).startswith("odd: ")


def test_refuses_a_bad_error_where_no_jacobian_is_asked_for() -> None:
    with pytest.raises(FactorError, match="not finite"):
        make(((1.0, math.nan), ())).error(values())


def test_arithmetic_failures_name_the_factor() -> None:
    def fail(_: gtsam.Values, __: bool) -> Residual:
        return ((math.sin(math.inf), 0.0), ())

    factor = custom_factor("odd", gtsam.noiseModel.Unit.Create(2), [0, 1], 2, (3, 1), fail)
    with pytest.raises(FactorError, match="odd: the residual cannot be computed here"):
        factor.error(values())


def test_refuses_dimensions_that_do_not_fit_when_built() -> None:
    with pytest.raises(FactorError, match="2 keys but 1 variable dimensions"):
        make(GOOD, dims=(3,))
    with pytest.raises(FactorError, match="noise model of dimension 3, expected 2"):
        custom_factor("odd", gtsam.noiseModel.Unit.Create(3), [0], 2, (3,), lambda *_: GOOD)


def test_refuses_through_a_whole_graph() -> None:
    graph = gtsam.NonlinearFactorGraph()
    graph.add(make(GOOD))
    graph.add(make(((1.0, math.nan), GOOD[1])))
    with pytest.raises(FactorError):
        graph.linearize(values())


def test_factors_share_no_output() -> None:
    other = make(((5.0, 5.0), (((0.0,) * 3,) * 2, ((1.0,), (1.0,)))))
    factor = make(GOOD)
    first = factor.unwhitenedError(values())
    other.linearize(values())
    factor.linearize(values())
    np.testing.assert_array_equal(first, GOOD[0])


def test_asks_for_jacobians_only_where_gtsam_does() -> None:
    asked = []

    def evaluate(_: gtsam.Values, want: bool) -> Residual:
        asked.append(want)
        return GOOD

    factor = custom_factor("odd", gtsam.noiseModel.Unit.Create(2), [0, 1], 2, (3, 1), evaluate)
    factor.error(values())
    factor.linearize(values())
    assert asked == [False, True]


def test_a_dropped_factor_is_freed_without_the_cycle_collector() -> None:
    class Held:
        """Something the residual function holds on to."""

    def build() -> tuple[gtsam.CustomFactor, weakref.ref[Held]]:
        held = Held()

        def evaluate(_: gtsam.Values, __: bool) -> Residual:
            assert held is not None
            return GOOD

        return custom_factor("odd", gtsam.noiseModel.Unit.Create(2), [0, 1], 2, (3, 1), evaluate), weakref.ref(held)

    gc.collect()
    gc.disable()
    try:
        factor, reference = build()
        graph = gtsam.NonlinearFactorGraph()
        graph.add(factor)
        linear = graph.linearize(values())
        graph.error(values())
        del factor
        assert reference() is not None, "the graph keeps it"
        del graph, linear
        assert reference() is None
    finally:
        gc.enable()
