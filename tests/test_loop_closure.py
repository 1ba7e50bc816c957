"""Loop closure: an earlier epoch's registration is used again only where the current epoch's PMs say that it fits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.camera_moves.detector import CameraMove, LoopClosure, MoveCase, find_camera_move
from fgreg.camera_moves.loop_closure import LoopClosureSettings, back_to
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform
from fgreg.model.measurements import EpochStart
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.register import pack_session, register
from tests.camera_move_cases import everything_about, move_case, moved_session

CONFIG = SolveConfig()
BEFORE = 20
ANY = LoopClosureSettings(accept=1e-9)
"""Accepts any evidence for the same place."""


def _case(seed: int, motion: FloatArray, pairs: int, *, spoil: bool = False) -> tuple[MoveCase, SessionModel]:
    """A number of pairs of a second epoch, with an earlier one of 20."""
    model, whole, _ = moved_session(seed, motion, BEFORE, pairs)
    later = list(whole.pairs[BEFORE:])
    if spoil:
        later[1] = replace(later[1], look=replace(later[1].look, x_mm=later[1].look.x_mm - 15.0))
    first = replace(whole, pairs=whole.pairs[:BEFORE])
    found = register(first, model, CONFIG)
    state = found.optimum.state
    known = everything_about(pack_session(found.measurements, model, replace(CONFIG, window_shape=False)), state)
    here = move_case(replace(whole, pairs=tuple(later)), model)
    return replace(here, epoch=1, earlier={0: known}), model


def _closure(
    seed: int, motion: FloatArray, pairs: int, *, spoil: bool = False, settings: LoopClosureSettings | None = None
) -> LoopClosure | CameraMove | None:
    case, model = _case(seed, motion, pairs, spoil=spoil)
    return find_camera_move(case, model, CONFIG, closure=settings)


def test_a_camera_put_back_has_evidence_for_it_and_closes_the_loop_where_that_suffices() -> None:
    for seed in (1, 2, 3):
        evidence, found = (_closure(seed, np.eye(4), 15, settings=settings) for settings in (ANY, None))
        assert isinstance(evidence, LoopClosure)
        assert (evidence.epoch, evidence.to) == (1, 0)
        assert evidence.log_bayes > 3.0
        assert (found is not None) == (evidence.log_bayes >= LoopClosureSettings().accept)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(
    "motion",
    [
        make_transform(np.eye(3), np.array([0.0, 6.0, 0.0])),
        make_transform(exp_so3(np.array([0.2, -0.3, 0.1])), np.array([20.0, -10.0, 15.0])),
    ],
    ids=["near", "far"],
)
def test_a_camera_elsewhere_closes_no_loop(seed: int, motion: FloatArray) -> None:
    assert _closure(seed, motion, 12, settings=ANY) is None


def test_one_outlier_costs_little_of_the_evidence_for_being_back() -> None:
    clean, spoiled = (_closure(1, np.eye(4), 12, spoil=spoil, settings=ANY) for spoil in (False, True))
    assert isinstance(clean, LoopClosure)
    assert isinstance(spoiled, LoopClosure)
    assert spoiled.log_bayes > 2.0
    assert clean.log_bayes - spoiled.log_bayes < 2.0


def test_few_pairs_close_no_loop() -> None:
    assert _closure(1, np.eye(4), 7, settings=ANY) is None


def test_of_several_epochs_that_fit_the_best_known_is_used() -> None:
    case, model = _case(1, np.eye(4), 15)
    known = case.earlier[0]
    vague = replace(known, hessian=0.1 * known.hessian)
    several = replace(case, epoch=3, earlier={0: vague, 1: known, 2: vague})
    found = find_camera_move(several, model, CONFIG, closure=ANY)
    assert isinstance(found, LoopClosure)
    assert (found.epoch, found.to) == (3, 1)


def test_an_epoch_tied_by_a_loop_closure_is_where_the_earlier_one_was_within_the_tolerance() -> None:
    settings = LoopClosureSettings()
    start = back_to(EpochStart(7.0), 2, settings)
    assert start.t == 7.0
    assert start.old(5) == 2
    np.testing.assert_array_equal(start.camera_new_T_camera_old, np.eye(4))
    assert start.covariance is not None
    np.testing.assert_allclose(np.sqrt(np.diag(start.covariance)), np.repeat(settings.tolerance, 3))


def test_limits_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="accept is -1"):
        LoopClosureSettings(accept=-1.0)
