"""The relaxation that the certificate is compared with: its constraints hold, and its bound is one."""

from __future__ import annotations

import numpy as np
import pytest

from fgreg.certificate.conditional import conditional
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.register import register
from tests.forward import make_measurements

pytest.importorskip("clarabel", reason="clarabel is not installed (dependency group bench)")


@pytest.mark.parametrize("first_hit", [True, False])
def test_its_bounds_are_below_the_minimum_and_reach_it_with_first_hits(*, first_hit: bool) -> None:
    from study_relaxation import constraints, local_minimum, problem_of, relaxed

    rng = np.random.default_rng(1)
    model, measurements, _ = make_measurements(rng, pairs=6, first_hit=first_hit)
    found = register(measurements, model, SolveConfig())
    problem = problem_of(conditional(found.problem, found.optimum.state, found.optimum.evaluation.private))
    anywhere = problem.at(rng.normal(size=len(problem.start)))
    for terms, value in constraints(6, "chordal"):
        assert sum(f * anywhere[i] * anywhere[j] for i, j, f in terms) == pytest.approx(value, abs=1e-12)
    cost, dense, chordal = local_minimum(problem), relaxed(problem, "dense"), relaxed(problem, "chordal")
    assert dense < chordal + 1e-3 * cost < 1.001 * cost
    if first_hit:
        assert dense > 0.999 * cost
