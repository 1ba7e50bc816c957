"""The study of labs that are not as declared: its figures on outcomes made by hand, and some sessions."""

from __future__ import annotations

import json
import math
import runpy
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgreg.geometry.rig import COUNT, Constant
from fgreg.model.systematic import Systematic

STUDY = runpy.run_path(str(Path(__file__).parents[1] / "tools" / "study_systematics.py"))
CONFIGURATION, PARSED = STUDY["configuration"], STUDY["parsed"]


def made(**changes: Any) -> Any:
    usual = STUDY["Outcome"]("tag-1%/frames/15", 0, "ok", 1, 1, 1.0, 1.5, 1.0, 5.0, 0.5, 0.4, 0.4, 1.0, 0.1, ())
    return replace(usual, **changes)


def test_figures_count_what_they_say() -> None:
    outcomes = [
        made(),
        made(seed=1, worst=2.0, targets_in=0.5, nees=13.0),
        made(seed=2, worst=4.0, epochs=2, verdict="warning", true2=1.5),
        made(seed=3, worst=4.0, places=2, predicted2=0.8),
    ]
    found = STUDY["figures"](outcomes, 3.0)
    share = {name: found[name].value for name in STUDY["HOLDING"] + STUDY["VERDICTS"] + STUDY["FAILING"]}
    assert share == {
        "holds": 0.25,
        "targets": 0.875,
        "region": 0.75,
        "ok": 0.75,
        "warning": 0.25,
        "refused": 0.0,
        "split": 0.25,
        "unseen": 0.25,
        "ok_beyond": 0.5,
        "ok_twice": 0.25,
        "ok_far": 0.25,
        "denied": 0.25,
    }
    assert found["holds"].error == pytest.approx(math.sqrt(0.25 * 0.75 / 4.0))
    assert found["true_rms"].value == pytest.approx(math.sqrt((1.0 + 4.0 + 16.0 + 16.0) / 4.0))
    assert found["predicted_over_true"].value == pytest.approx(math.sqrt(2.0 / 3.0))
    assert found["true_over_least"].value == pytest.approx(
        math.sqrt(2.0 / 1.6)
    )  # of those with as many epochs as there were
    assert found["nees"].value == pytest.approx(7.0)
    assert found["bound"].value == pytest.approx(1.5)


def test_cells_that_miss_their_aims_say_so() -> None:
    good, bad = [made(seed=k) for k in range(8)], [made(seed=k, worst=2.0, places=2) for k in range(8)]
    for outcomes, expected in ((good, []), (bad, ["ok_beyond at most 20 %", "unseen moves"])):
        figures = STUDY["figures"](outcomes, 3.0)
        assert STUDY["missed"](PARSED("tag-1%/frames/15"), figures, []) == expected


def test_constants_are_off_as_the_cell_says() -> None:
    def off(name: str, seed: int = 0) -> dict[Constant, float]:
        return dict(CONFIGURATION(PARSED(name), seed, Systematic()).deviations)

    assert off("as-declared/frames/15") == {}
    assert {abs(off("radius-1mm/frames/15", seed)[Constant.RADIUS]) for seed in range(5)} == {1.0}
    assert {off("3s-sound_speed/published/10", seed)[Constant.SOUND_SPEED] for seed in range(9)} == {-0.03, 0.03}
    assert off("print-3%/frames/15") == {Constant.TAG_SIZE: -0.03, Constant.BOARD_SIZE: -0.03}
    drawn = np.array([list(off("drawn/frames/15", seed).values()) for seed in range(300)])
    assert drawn.shape == (300, COUNT)
    np.testing.assert_allclose(drawn[:, Constant.RADIUS].std(), 0.2, rtol=0.15)
    assert CONFIGURATION(PARSED("drawn/frames/15"), 0, Systematic()).camera_declared
    assert CONFIGURATION(PARSED("print-3%/raw/15"), 0, Systematic()).frames
    for bad in ("radius/frames/15", "drawn/frames", "drawn/loud/15", "drawn/frames/15/three-sided"):
        with pytest.raises(SystemExit, match="no cell"):
            PARSED(bad)
    for name in STUDY["TABLE"]:
        assert name in STUDY["all_cells"]()


def test_sessions_are_solved_and_compared_with_their_truth() -> None:
    as_declared = STUDY["run"]((PARSED("as-declared/frames/15"), 3, Systematic()))
    assert as_declared.worst < 2.0 * as_declared.bound
    assert as_declared.seen == pytest.approx(as_declared.worst)
    assert as_declared.epochs == as_declared.places == 1
    # One session's own Gaussian hardly differs from that of the exact measurements.
    assert as_declared.least2 == pytest.approx(as_declared.predicted2, rel=0.15)
    assert STUDY["run"]((PARSED("print-3%/frames/15"), 3, Systematic())).worst > 3.0
    # Where the radius is wrong the scanner's own map is too: against what it shows, the registration is less off.
    radius = [STUDY["run"]((PARSED("radius-1mm/frames/15"), seed, Systematic())) for seed in range(4)]
    assert np.mean([o.seen for o in radius]) < np.mean([o.worst for o in radius])


def test_outcomes_are_taken_up_again(tmp_path: Path) -> None:
    path = tmp_path / "out.jsonl"
    assert STUDY["earlier"](path) == {}
    one = made(reasons=("because",), bound=math.inf)
    path.write_text(json.dumps(asdict(one)) + "\n" + json.dumps(asdict(made(seed=1)))[:40])
    assert STUDY["earlier"](path) == {(one.cell, 0): one}
