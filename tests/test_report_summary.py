"""The summary for people and for programs: verdict first, every figure in its unit, readable in 80 columns."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from fgreg.cli.report import (
    DetectionFigures,
    SummaryExtras,
    TruthFigures,
    laser_sigmas,
    pm_rotation_sigma_rad,
    print_summary,
)
from fgreg.cli.report_document import summary_dict
from fgreg.geometry.transforms import exp_so3, make_transform
from fgreg.model.estimate import (
    AimEstimate,
    Assumption,
    CheckEstimate,
    LaserEstimate,
    PairEstimate,
    SessionEstimate,
    TrackEstimate,
    Verdict,
)
from fgreg.model.session_model import SessionModel, StageModel
from fgreg.viewer.result import measured_pairs
from tests.answers import answer_from_truth, random_covariance
from tests.forward import make_measurements, make_session


def make_answer(
    seed: int = 21, pairs: int = 8, epochs: int = 1, verdict: Verdict = Verdict.OK, reasons: tuple[str, ...] = ()
) -> tuple[SessionModel, SessionEstimate, SummaryExtras]:
    """A result with one look left out, one track answered and one not, on a stage that counts backwards from 5 deg."""
    rng = np.random.default_rng(seed)
    stage = StageModel(math.radians(2.0), (-1.5, 1.5), direction=-1, zero_device_rad=math.radians(5.0))
    model, measurements, truth = make_measurements(
        rng, aims=5, pairs=pairs, epochs=epochs, session=replace(make_session(), stage=stage, name="phantom-01")
    )
    tracks = (
        TrackEstimate(200.0, math.radians(-12.34), math.radians(0.56), 41.27, causal=False),
        TrackEstimate(201.5, None, None, None, causal=False, reason="no tissue surface is known yet"),
    )
    estimate = answer_from_truth(
        rng, model, measurements, truth, verdict=verdict, reasons=reasons, unused=(2,), tracks=tracks
    )
    looks = tuple(None if pair is None else pair.look for pair in measured_pairs(estimate.pairs, measurements))
    return model, estimate, SummaryExtras(looks=looks)


def plain(model: SessionModel, estimate: SessionEstimate, extra: SummaryExtras, width: int = 80) -> str:
    stream = io.StringIO()
    print_summary(model, estimate, extra, Console(file=stream, width=width, highlight=False, emoji=False))
    return stream.getvalue()


def row_of(text: str, start: str) -> list[str]:
    """The words of the only line that starts so."""
    (line,) = [line for line in text.splitlines() if line.split()[: len(start.split())] == start.split()]
    return line.split()


@pytest.mark.parametrize("verdict", list(Verdict))
def test_the_verdict_is_the_first_word_and_reasons_follow_each_on_its_own_line(verdict: Verdict) -> None:
    reasons = ("all sweeps go one way: take at least 3 pairs sweeping the other way", "short")
    lines = plain(*make_answer(verdict=verdict, reasons=reasons)).splitlines()
    assert lines[0].split()[:2] == [verdict.value.upper(), "phantom-01:"]
    assert lines[1].startswith("  - all sweeps go one way")
    assert lines[2] == "  - short"


def test_a_long_reason_is_wrapped_under_itself() -> None:
    reason = "word " * 40 + "end"
    lines = plain(*make_answer(reasons=(reason,))).splitlines()
    wrapped = lines[1 : 1 + next(i for i, line in enumerate(lines[1:]) if line.endswith("end")) + 1]
    assert len(wrapped) > 2
    assert all(line.startswith("    word") for line in wrapped[1:])
    assert " ".join(" ".join(wrapped).replace("  -", "", 1).split()) == reason


@pytest.mark.parametrize("epochs", [1, 2])
def test_no_line_is_longer_than_80_columns_and_none_ends_in_blanks(epochs: int) -> None:
    text = plain(*make_answer(epochs=epochs, reasons=("a reason",)))
    assert max(len(line) for line in text.splitlines()) <= 80
    assert all(line == line.rstrip() for line in text.splitlines())
    assert text.isascii()


def test_tables_are_not_torn_in_80_columns_even_with_large_figures() -> None:
    model, estimate, extra = make_answer(epochs=2)
    huge = replace(estimate.pairs[0], pm=123456, lambda_mm=1234.56, residual_mm=123.45, nis=98765.4, rotation_rad=-0.5)
    text = plain(model, replace(estimate, pairs=(huge, *estimate.pairs[1:])), extra)
    row = row_of(text, "123456")
    assert row[1:3] == ["0", "yes"]
    assert row[-4] == "1234.6"
    assert row[-2:] == ["123.450", "98765.4"]


def test_the_registration_is_given_as_translation_rotation_and_matrix() -> None:
    model, estimate, extra = make_answer()
    axis = np.array([0.0, 0.6, 0.8])
    trus_T_camera = make_transform(exp_so3(math.radians(30.0) * axis), np.array([1.25, -20.5, 150.0]))
    epoch = replace(estimate.epochs[0], trus_T_camera=trus_T_camera)
    text = plain(model, replace(estimate, epochs=(epoch,)), extra)
    assert "translation    (1.25, -20.50, 150.00) mm" in text
    assert "rotation       30.00 deg about (0.0000, 0.6000, 0.8000)" in text
    # sqrt of the covariance's diagonal, 0.004, 0.003, 0.008 rad in degrees.
    assert "(0.25, 0.20, 0.30) mm, (0.23, 0.17, 0.46) deg, camera x, y, z" in text
    assert "mean 0.71, 95 % bound 1.12 mm, over 27 targets" in text
    lines = text.splitlines()
    last = next(i for i, line in enumerate(lines) if line.split() == ["0.000000", "0.000000", "0.000000", "1.000000"])
    printed = np.array([[float(word) for word in line.split()] for line in lines[last - 3 : last + 1]])
    np.testing.assert_allclose(printed, trus_T_camera, atol=5e-7)


def test_a_refused_transform_is_marked_where_it_stands() -> None:
    text = plain(*make_answer(verdict=Verdict.REFUSED))
    assert "no transform below may be used" in text
    lines = text.splitlines()
    title = next(i for i, line in enumerate(lines) if line.startswith("Registration"))
    assert "not to be used" in lines[title + 1]
    assert "not to be used" not in plain(*make_answer())


def test_an_epoch_without_registration_says_so() -> None:
    model, estimate, extra = make_answer()
    epoch = replace(estimate.epochs[0], trus_T_camera=None, covariance=None, predicted_tre=None)
    assert "none could be computed" in plain(model, replace(estimate, epochs=(epoch,), laser=None), extra)


def test_pair_rows_hold_the_figures_in_degrees_of_the_device_and_millimetres() -> None:
    model, estimate, extra = make_answer()
    text = plain(model, estimate, extra)
    assert "Pairs: 7 of 8 looks used" in text
    for position in (0, 2, 7):
        pair, look = estimate.pairs[position], extra.looks[position]
        assert look is not None
        assert pair.rotation_rad is not None
        assert pair.lambda_mm is not None
        assert pair.residual_mm is not None
        assert pair.nis is not None
        word = "yes" if position != 2 else "NO"
        row = row_of(text, f"{pair.pm} {word}")
        assert row[2] == f"{5.0 - math.degrees(look.scan_rad):.1f}"
        assert row[3] == f"{math.degrees(pair.rotation_rad):.1f}"
        assert row[4] == "+-"
        assert row[6:] == [
            f"{pair.lambda_mm:.1f}",
            f"{look.range_mm:.1f}",
            f"{pair.residual_mm:.3f}",
            f"{pair.nis:.1f}",
        ]
    assert "PM 2, 8.0 s, not used: range is 4.1 sigma off" in text


def test_the_rotation_sigma_is_that_of_drawn_points() -> None:
    rng = np.random.default_rng(22)
    point, covariance = np.array([5.0, -14.0, 33.0]), random_covariance(rng, 3, 0.5)
    draws = rng.multivariate_normal(point, covariance, 50000)
    sampled = np.std(np.arctan2(draws[:, 1], draws[:, 2]))
    assert pm_rotation_sigma_rad(point, covariance) == pytest.approx(sampled, rel=0.02)


def test_laser_sigmas_are_the_largest_of_direction_and_place() -> None:
    laser = LaserEstimate(np.eye(4), np.diag(np.square([0.01, 0.02, 9.0, 0.3, 0.2, 9.0])))
    assert laser_sigmas(laser) == pytest.approx((0.02, 0.3))


def test_tracks_are_answered_or_have_a_reason() -> None:
    model, estimate, extra = make_answer()
    text = plain(model, estimate, extra)
    assert "Tracks: 1 of 2 answered" in text
    assert row_of(text, "200.0") == ["200.0", "-12.3", "0.6", "41.3"]
    assert "201.5 s: no tissue surface is known yet" in text


def test_checks_and_assumptions_are_listed_with_their_figures() -> None:
    model, estimate, extra = make_answer()
    checks = (
        CheckEstimate(80.5, np.array([0.1, -0.2, 2.5]), 1.2, 14.5, Verdict.WARNING),
        CheckEstimate(81.0, None, None, None, Verdict.WARNING, "its rays are parallel"),
    )
    assumptions = (Assumption("one medium", (0, 1)), Assumption("a centred window"))
    estimate = replace(estimate, checks=checks, assumptions=assumptions)
    text = plain(model, estimate, extra)
    assert "Checks: 1 of 2 compared" in text
    assert row_of(text, "80.5") == ["80.5", "0.10", "-0.20", "2.50", "2.51", "1.20", "14.5", "warning"]
    assert "81.0 s, not compared: its rays are parallel" in text
    assert "one medium (covered by 2 checks)" in text
    assert "a centred window (no check covers it)" in text
    assert max(len(line) for line in text.splitlines()) <= 80
    found = json.loads(json.dumps(summary_dict(model, estimate, extra), allow_nan=False))
    assert found["checks"][0]["error_mm"] == [0.1, -0.2, 2.5]
    assert found["checks"][1]["reason"] == "its rays are parallel"
    assert found["assumptions"][0] == {"text": "one medium", "checks": [0, 1]}


def test_errors_against_the_truth_are_shown_where_it_is_known() -> None:
    model, estimate, extra = make_answer()
    truth = TruthFigures((0.62,), (0.98,), (math.radians(-0.5), None))
    text = plain(model, estimate, replace(extra, truth=truth))
    assert "true TRE       mean 0.62, worst 0.98 mm" in text
    assert row_of(text, "200.0") == ["200.0", "-12.3", "0.6", "41.3", "-0.50"]
    assert "true TRE" not in plain(model, estimate, extra)


def test_calibration_shots_detection_time_and_files_close_the_summary() -> None:
    model, estimate, extra = make_answer()
    aims = (
        AimEstimate(1.0, True, "", 40.0, 0.3, 1.0),
        AimEstimate(2.0, True, "", 40.0, 0.4, 1.0),
        AimEstimate(3.0, False, "no marker was found"),
    )
    path = Path("/somewhere/" + "deep/" * 20 + "session.rrd")
    extra = replace(
        extra, rrd=path, result=Path("result.yaml"), elapsed_s=1.26, detections=DetectionFigures(9, 10, 7, 8)
    )
    lines = plain(model, replace(estimate, aims=aims), extra).splitlines()
    # sqrt((0.3^2 + 0.4^2) / 2) = 0.354
    assert "Calibration shots: 2 of 3 used, spot to beam 0.35 mm rms, 0.40 worst" in lines
    assert "  - aim 2, 3.0 s, not used: no marker was found" in lines
    assert "Detection: marker in 9 of 10 shots, source in 7 of 8 frames" in lines
    assert "Solved in 1.3 s" in lines
    assert "Result     result.yaml" in lines
    # A path is one piece however long, to be copied.
    assert f"Recording  {path}" in lines


def test_a_long_session_lists_what_was_left_out_and_the_largest_misfits() -> None:
    model, estimate, extra = make_answer(pairs=120)
    text = plain(model, estimate, extra)
    assert "119 of 120 looks used; the 40 not used or of largest NIS" in text
    nis = sorted((pair.nis or 0.0, pair.pm) for pair in estimate.pairs if pair.used)
    rows = [line.split()[0] for line in text.splitlines() if "+-" in line]
    assert len(rows) == 40
    assert set(rows) == {"2", *(str(pm) for _, pm in nis[-39:])}
    assert rows == sorted(rows, key=int)


def test_names_and_reasons_cannot_steer_the_terminal_or_the_markup() -> None:
    reasons = ("corner [red]x[/red] [1, 2] \x1b[2J cleared",)
    model, estimate, extra = make_answer(reasons=reasons)
    stream = io.StringIO()
    console = Console(file=stream, width=80, force_terminal=True, color_system="standard")
    print_summary(model, replace(estimate, session="na\x1b]0;me"), extra, console)
    text = stream.getvalue()
    assert "corner [red]x[/red] [1, 2] ?[2J cleared" in text
    assert "\x1b[2J" not in text
    assert "\x1b]0" not in text


def test_a_terminal_gets_colour_and_a_pipe_does_not() -> None:
    model, estimate, extra = make_answer(verdict=Verdict.REFUSED)
    stream = io.StringIO()
    print_summary(model, estimate, extra, Console(file=stream, width=80, force_terminal=True, color_system="standard"))
    assert "\x1b[1;7;31m REFUSED" in stream.getvalue()
    assert "\x1b" not in plain(model, estimate, extra)


def test_the_plain_data_have_the_names_and_units_of_the_result_file() -> None:
    model, estimate, extra = make_answer(verdict=Verdict.WARNING, reasons=("one",))
    found = json.loads(json.dumps(summary_dict(model, estimate, extra), allow_nan=False))
    assert found["session"] == "phantom-01"
    assert found["verdict"] == "warning"
    assert found["reasons"] == ["one"]
    epoch = found["epochs"][0]
    assert set(epoch) == {
        "index",
        "start_s",
        "trus_T_camera",
        "covariance",
        "pairs",
        "verdict",
        "predicted_tre_mm",
        "target_errors_mm",
    }
    np.testing.assert_array_equal(epoch["trus_T_camera"], estimate.epochs[0].trus_T_camera)
    assert epoch["predicted_tre_mm"] == {"mean": 0.71, "p95": 1.12, "worst": 1.4}
    assert estimate.laser is not None
    np.testing.assert_array_equal(found["laser"]["marker_T_laser"], estimate.laser.marker_T_laser)
    pair, look = estimate.pairs[0], extra.looks[0]
    assert look is not None
    assert pair.theta_rad is not None
    shown = found["pairs"][0]
    assert shown["theta_deg"] == pytest.approx(math.degrees(pair.theta_rad))
    assert shown["scan_deg"] == pytest.approx(5.0 - math.degrees(look.scan_rad))
    assert shown["range_mm"] == look.range_mm
    assert np.shape(shown["covariance"]) == (3, 3)
    assert [entry["used"] for entry in found["pairs"]].count(False) == 1
    assert found["pairs"][2]["reason"] == "range is 4.1 sigma off"
    assert found["tracks"][0]["stage_deg"] == pytest.approx(-12.34)
    assert found["tracks"][1] == {
        "t": 201.5,
        "stage_deg": None,
        "sigma_deg": None,
        "lambda_mm": None,
        "causal": False,
        "reason": "no tissue surface is known yet",
    }
    assert len(found["aims"]) == 5
    assert not {"truth", "detections", "elapsed_s", "files"} & set(found)


def test_figures_that_are_not_finite_are_none_in_data_and_words_in_text() -> None:
    model, estimate, extra = make_answer()
    endless = replace(estimate.pairs[0], nis=math.inf)
    estimate = replace(estimate, pairs=(endless, *estimate.pairs[1:]))
    assert summary_dict(model, estimate, extra)["pairs"][0]["nis"] is None
    assert row_of(plain(model, estimate, extra), "0 yes")[-1] == "inf"


def test_extras_are_part_of_the_data_where_they_are_known() -> None:
    model, estimate, extra = make_answer()
    full = replace(
        extra,
        rrd=Path("a.rrd"),
        result=Path("r.yaml"),
        elapsed_s=1.5,
        detections=DetectionFigures(1, 2, 3, 4),
        truth=TruthFigures((0.6,), (math.inf,), (math.radians(2.0),)),
    )
    found = summary_dict(model, estimate, full)
    assert found["files"] == {"result": "r.yaml", "rrd": "a.rrd"}
    assert found["elapsed_s"] == 1.5
    assert found["detections"] == {"markers_found": 1, "markers_total": 2, "sources_found": 3, "sources_total": 4}
    assert found["truth"]["tre_mean_mm"] == [0.6]
    assert found["truth"]["tre_worst_mm"] == [None]
    assert found["truth"]["track_error_deg"] == pytest.approx([2.0])


def test_an_answer_of_nothing_is_still_a_summary() -> None:
    empty = SessionEstimate("empty", Verdict.REFUSED, ("no pairs: take at least 6",), None, (), (), ())
    text = plain(make_session(), empty, SummaryExtras())
    assert text.split()[:2] == ["REFUSED", "empty:"]
    assert "no pairs: take at least 6" in text
    lone = PairEstimate(1.0, 4, 0, used=False, reason="no source was heard")
    text = plain(make_session(), replace(empty, pairs=(lone,)), SummaryExtras())
    assert row_of(text, "4 NO") == ["4", "NO", "-", "-", "-", "-", "-", "-"]
    assert "no source was heard" in text
