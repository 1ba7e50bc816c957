"""Each reason of a verdict leads to the shots that it is about."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from fgreg.model.estimate import SessionEstimate, Verdict
from fgreg.viewer.reason_links import linked
from tests.answers import answer_from_truth
from tests.forward import make_measurements

AIMS, PAIRS = 4, 8


@pytest.fixture(scope="module")
def estimate() -> SessionEstimate:
    rng = np.random.default_rng(8)
    model, measurements, truth = make_measurements(rng, aims=AIMS, pairs=PAIRS, epochs=2)
    found = answer_from_truth(rng, model, measurements, truth, unused=(2, 5))
    aims = (replace(found.aims[0], used=False, reason="off", nis=30.0), *found.aims[1:])
    pairs = tuple(replace(pair, nis=20.0 + i if i in (3, 4) else 1.0) for i, pair in enumerate(found.pairs))
    return replace(found, aims=aims, pairs=pairs)


def targets(reason: str, estimate: SessionEstimate) -> list[str]:
    return re.findall(r"\(recording://([^)]+)\)", linked(reason, estimate))


def test_a_reason_leads_to_the_shots_that_it_names(estimate: SessionEstimate) -> None:
    pms = [pair.pm for pair in estimate.pairs]
    at = estimate.aims[2].t
    for reason, expected in (
        (f"PM {pms[1]} does not fit the others (nis 9.1), and 7 are too few", ["world/looks/5"]),
        (f"the pairs up to PM {pms[1]} and those from PM {pms[2]} do not fit", ["world/looks/5", "world/looks/6"]),
        (f"2 pairs nearly in a row, PM {pms[0]} to {pms[0]}, do not fit", ["world/looks/4"]),
        ("2 of 8 pairs do not fit the others and are left out (nis 1 to 2)", ["world/looks/6", "world/looks/9"]),
        ("1 of 4 aims do not fit the others and are left out (nis 30 to 30)", ["log/0"]),
        (f"the aim at {at:.1f} s does not fit the others (nis 4.0)", ["log/2"]),
        ("the residuals of 2 of 12 shots are larger, (nis 23 to 24)", ["world/looks/7", "world/looks/8"]),
        ("the predicted error at the worst target is 4.0 mm", ["world/targets/worst"]),
        ("no shot is named here", ["world/looks/4", "world/looks/11"]),
        (f"the check at {at:.1f} s is off by 9.5 mm sideways: locate it again", []),
        ("the checks are off by 9.4 mm sideways, 1.2 mm expected at most", []),
        ("the mean error at the checks is 9.4 mm, at most 9.9 mm (95 % bound)", []),
    ):
        assert targets(reason, estimate) == expected, reason
    assert f"shot 2 (aim, {at:.1f} s)" in linked(f"the aim at {at:.1f} s does not fit", estimate)


def test_a_reason_of_one_epoch_leads_to_its_shots(estimate: SessionEstimate) -> None:
    mine = [AIMS + i for i, pair in enumerate(estimate.pairs) if pair.epoch == 1]
    assert targets("epoch 1: the beams are parallel", estimate) == [
        f"world/looks/{mine[0]}",
        f"world/looks/{mine[-1]}",
    ]


def test_a_session_without_shots_has_reasons_without_links() -> None:
    empty = SessionEstimate("empty", Verdict.REFUSED, ("no pairs",), None, (), (), ())
    assert linked("no pairs", empty) == "no pairs"
