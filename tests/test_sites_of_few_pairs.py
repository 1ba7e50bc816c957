"""Sites among few pairs that do not fit together: they settle near the optimum, or not at all, and warn of nothing."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from fgreg.config import SolveConfig
from fgreg.graph.sites import propagate
from fgreg.measurements import Pair
from fgreg.models import SessionModel
from fgreg.registration import Registration, register
from tests.forward import make_measurements


def mixed(seed: int, before: int, after: int) -> tuple[SessionModel, Registration]:
    """A registration of pairs from before and after a camera move that nobody told."""
    model, measurements, _ = make_measurements(
        np.random.default_rng(seed), aims=6, pairs=before + after, epochs=2, looks_per_pm=2
    )
    pairs: list[Pair] = [replace(pair, epoch=0) for pair in measurements.pairs]
    one = replace(measurements, pairs=tuple(pairs), epochs=measurements.epochs[:1])
    return model, register(one, model, SolveConfig())


@pytest.mark.parametrize("seed", range(8))
def test_pairs_of_two_camera_poses_in_one_epoch(seed: int) -> None:
    _, found = mixed(seed, 4, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sites = propagate(found.problem, found.optimum)
    if sites is not None:
        problem, optimum = sites
        cost = float(optimum.evaluation.cost[0])
        assert np.isfinite(problem.looks.centre_rad).all()
        # The sites cost what the data cost, within what windows of some degrees can add to each look.
        assert cost < float(found.optimum.evaluation.cost[0]) + 30.0 * len(problem.look_pm)
