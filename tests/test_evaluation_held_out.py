"""Solves from parts of a session: held-out shots, their prediction, and figures that do not depend on the run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgreg.evaluation.case import Case, EvaluationConfig, Truth, curve_sizes, folds_of, left_out_one_by_one, subsets_of
from fgreg.evaluation.export import as_csv, as_dict
from fgreg.evaluation.resolve import resolve
from fgreg.evaluation.run import evaluate
from fgreg.evaluation.summary import curve_of, prediction_of
from fgreg.geometry.target_error import beam_error
from fgreg.geometry.transforms import exp_so3, make_transform
from tests.forward import make_measurements


def _case(seed: int, pairs: int = 9, **arguments: object) -> Case:
    model, measurements, truth = make_measurements(np.random.default_rng(seed), pairs=pairs, **arguments)  # type: ignore[arg-type]
    return Case(f"case-{seed}", model, measurements, (), Truth(truth.trus_T_camera, truth.marker_T_laser))


def test_folds_hold_every_pm_once_and_all_looks_of_it() -> None:
    case = _case(0, pairs=11, looks_per_pm=2)
    folds = folds_of(case, 4, seed=1)
    assert sorted(pm for fold in folds for pm in fold) == list(range(11))
    assert max(map(len, folds)) - min(map(len, folds)) <= 1
    assert folds == folds_of(case, 4, seed=1)
    assert folds != folds_of(case, 4, seed=2)


def test_folds_are_even_over_camera_epochs() -> None:
    case = _case(0, pairs=12, epochs=2)
    for fold in folds_of(case, 3, seed=1):
        assert len([pm for pm in fold if pm in case.pms_of_epoch(0)]) == 2


def test_all_subsets_where_few_else_distinct_ones_by_seed() -> None:
    pms = tuple(range(10, 17))
    assert len(subsets_of(pms, 6, 20, seed=1)) == 7
    some = subsets_of(pms, 4, 20, seed=1)
    assert len(set(some)) == 20
    assert all(len(set(subset)) == 4 and set(subset) <= set(pms) for subset in some)
    assert some == subsets_of(pms, 4, 20, seed=1)
    assert some != subsets_of(pms, 4, 20, seed=2)


def test_long_sessions_are_thinned() -> None:
    case = _case(0, pairs=30)
    left = left_out_one_by_one(case, 10)
    assert len(left) == 10
    assert (left[0], left[-1]) == ((0,), (29,))
    sizes = curve_sizes(30, EvaluationConfig(most_sizes=6))
    assert sizes[0] == 4
    assert sizes[-1] == 30
    assert len(sizes) <= 6
    assert curve_sizes(3, EvaluationConfig()) == ()


def test_exact_measurements_predict_what_is_held_out_exactly() -> None:
    case = _case(1, noise=False)
    found = resolve(case, [pm for pm in case.pms if pm not in (2, 5)], EvaluationConfig())
    assert [pm.pm for pm in found.held_out] == [2, 5]
    for pm in found.held_out:
        assert pm.pair_residual_mm < 1e-4
        assert pm.nis < 1e-6
        assert pm.degrees_of_freedom == 2
    errors = found.tre_mm[0]
    assert errors is not None
    # The posterior's mean, which noise stated but not there leaves a little off the optimum.
    assert errors.max() < 0.1


def test_nis_of_held_out_pms_is_chi_square_where_the_noise_is_as_stated() -> None:
    nis, freedom = [], []
    for seed in range(14):
        case = _case(seed, pairs=16, looks_per_pm=1 + seed % 2)
        found = resolve(case, case.pms[:11], EvaluationConfig())
        nis += [pm.nis for pm in found.held_out]
        freedom += [pm.degrees_of_freedom for pm in found.held_out]
    assert set(freedom) == {2, 7}
    ratio = sum(nis) / sum(freedom)
    # 70 PMs of 315 degrees of freedom in all: 1 +- 0.08, and first hits are flat where the model is Gaussian.
    assert 0.75 < ratio < 1.3


def test_nis_shows_noise_larger_than_stated() -> None:
    case = _case(4, pairs=14)
    boastful = tuple(
        replace(pair, marker=replace(pair.marker, covariance=pair.marker.covariance / 25.0))
        for pair in case.measurements.pairs
    )
    boast = replace(case, measurements=replace(case.measurements, pairs=boastful))
    config = EvaluationConfig()
    plain, proud = (
        prediction_of([resolve(c, [pm for pm in c.pms if pm not in fold], config) for fold in folds_of(c, 2, seed=1)])
        for c in (case, boast)
    )
    assert plain is not None
    assert proud is not None
    assert proud.nis_per_degree > 3.0 * plain.nis_per_degree


def test_too_few_pairs_are_a_failure_and_not_an_error() -> None:
    case = _case(2)
    found = resolve(case, case.pms[:2], EvaluationConfig())
    assert "3 photoacoustic markers" in found.failure
    assert found.held_out == ()


def test_figures_do_not_depend_on_the_number_of_processes() -> None:
    # Enough pairs in every fold and subset: with three or four, rounding decides between minima, and that depends on
    # where arrays lie in memory.
    cases = [_case(5, pairs=14), _case(6, pairs=14)]
    config = EvaluationConfig(folds=2, subsets=2, sizes=(10,), leave_one_out=False)
    calls: list[tuple[int, int]] = []
    alone = evaluate(cases, config, jobs=1, progress=lambda _, done, total: calls.append((done, total)))
    together = evaluate(cases, config, jobs=2)
    assert as_csv(alone) == as_csv(together)
    assert calls[-1] == (len(calls), len(calls))
    assert [item.name for item in together] == ["case-5", "case-6"]


def test_curve_falls_with_pairs_and_ends_at_the_whole_solve() -> None:
    case = _case(7, pairs=14)
    (found,) = evaluate([case], EvaluationConfig(folds=0, leave_one_out=False, sizes=(5, 9, 14), subsets=6))
    points = curve_of(found)
    assert [point.pairs for point in points] == [5, 9, 14]
    assert [point.subsets for point in points] == [6, 6, 1]
    expected = [point.expected_mm for point in points]
    assert expected[0] is not None
    assert expected[1] is not None
    assert expected[2] is not None
    assert expected[0] > expected[1] > expected[2]
    assert points[-1].pair_residual_mm is None
    whole, last = found.whole.tre_mm[0], points[-1].tre_mm
    assert whole is not None
    assert last is not None
    assert last.mean == pytest.approx(float(whole.mean()), rel=1e-6)


def test_without_truth_there_are_residuals_but_no_tre() -> None:
    case = replace(_case(8, pairs=6), truth=None)
    found = evaluate([case], EvaluationConfig(folds=3, leave_one_out=False, subsets=1, sizes=(5,)))
    document = as_dict(found)
    assert document["together"]["tre_mm"] is None
    assert document["sessions"][0]["beam_error"] is None
    assert document["together"]["k_fold"]["pair_residual_mm"]["count"] == 6
    assert ",tre_mean_mm," not in as_csv(found)
    assert ",predicted_tre_mean_mm," in as_csv(found)


def test_beam_error_of_a_known_shift_and_turn() -> None:
    true = make_transform(np.eye(3), np.array([1.0, 2.0, 3.0]))
    off = make_transform(exp_so3(np.array([0.0, 0.1, 0.0])), np.array([1.0, 2.5, 3.0]))
    angle, offset = beam_error(off, true)
    assert angle == pytest.approx(0.1)
    assert offset == pytest.approx(0.5)


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="folds"):
        EvaluationConfig(folds=1)
    with pytest.raises(ValueError, match="3 pairs"):
        EvaluationConfig(sizes=(2, 8))
