"""Hypotheses that are the same, or whose numbers are not finite, among those of one search."""

from dataclasses import replace

import numpy as np

from fgreg.graph.packing import pack
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_graph import evaluate
from fgreg.graph.reduced_solver import distinct
from fgreg.graph.shared_state import make_state
from tests.forward import make_measurements


def test_equal_hypotheses_count_once_and_ones_that_are_not_finite_end_the_search() -> None:
    model, measurements, truth = make_measurements(np.random.default_rng(3), pairs=6)
    problem = pack(measurements, model)
    pose = np.asarray(truth.trus_T_camera[0])[None, None]
    state = make_state(np.repeat(pose, 4, axis=0), truth.marker_T_laser)
    state = replace(state, translation_mm=state.translation_mm + np.array([0.0, 0.0, 40.0, 0.0])[:, None, None])
    nominal = state.marker_T_nominal.copy()
    nominal[3] = np.nan
    state = replace(state, marker_T_nominal=nominal)
    with np.errstate(all="ignore"):
        at = evaluate(problem, state, initial_private(problem, state))
        found = distinct(problem, state, at)
    assert sorted(found.tolist()) in ([0, 2, 3], [1, 2, 3])
