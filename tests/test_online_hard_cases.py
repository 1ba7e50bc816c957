"""Events that come when little is known, or late: none is refused or lost, and none counts in part."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgreg.model.measurements import Pair
from fgreg.online.engine import OnlineRegistration
from fgreg.online.events import CameraMoved
from tests.forward import make_measurements
from tests.online_streams import first, restored, run


def test_a_reported_move_is_taken_in_where_the_registration_before_it_is_undetermined() -> None:
    for seed, aims in ((1, 3), (3, 4)):
        model, measurements, _ = make_measurements(np.random.default_rng(seed), aims=aims, pairs=3)
        engine = OnlineRegistration(model, verdicts=False)
        run(engine, measurements)
        t = measurements.pairs[-1].t + 1.0
        assert engine.add(CameraMoved(t, np.eye(4), np.diag([1e-4] * 3 + [1.0] * 3))).epoch == 1


def test_a_second_look_that_does_not_fit_leaves_the_looks_of_a_marginalised_pm_counting() -> None:
    model, measurements, _ = make_measurements(np.random.default_rng(15), pairs=40)
    engine = OnlineRegistration(model, verdicts=False, find_moves=False)
    restored(engine, first(measurements, 40))
    before = engine.state
    label = min(before.marginalised)
    old: Pair = next(shot.pair for shot in before.shots if shot.label == label)
    look = replace(old.look, range_mm=old.look.range_mm + 15.0)
    marker = replace(old.marker, id=10_000)
    assert not engine.add(replace(old, t=measurements.pairs[-1].t + 1.0, look=look, marker=marker)).used
    assert [shot.inlier for shot in engine.state.shots if shot.pair.pm == old.pm] == [True, False]
    assert engine.state.counts() == (before.counts()[0], before.counts()[1] + 1)
    counting = {group.label for group in engine.state.active_window.groups} if engine.state.active_window else set()
    assert label in counting | engine.state.marginalised
