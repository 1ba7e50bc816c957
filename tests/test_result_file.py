"""``result.yaml``: what is written reads back, to other programs too; nothing half-written or stale is ever there."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose

from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, exp_so3, make_transform
from fgreg.model.estimate import (
    AimEstimate,
    Assumption,
    CheckEstimate,
    EpochEstimate,
    LaserEstimate,
    PairEstimate,
    PredictedTre,
    Quantiles,
    SessionEstimate,
    SettingsUsed,
    TargetEstimate,
    Timing,
    TrackEstimate,
    Verdict,
)
from fgreg.model.session_model import SessionModel
from fgreg.output.atomic_file import check_output
from fgreg.session.result_file import RESULT_KIND, read_result, write_result
from fgreg.session.session_reader import read_session
from tests import session_files


@pytest.fixture
def model(tmp_path: Path) -> SessionModel:
    return read_session(session_files.write(tmp_path / "session")).model


def covariance(random: np.random.Generator, size: int, scale: float) -> FloatArray:
    root = random.normal(size=(size, size + 3)) * scale
    return np.asarray(root @ root.T)


def transform(random: np.random.Generator) -> FloatArray:
    return make_transform(exp_so3(random.normal(size=3)), random.normal(size=3) * 100)


def an_estimate(seed: int = 1) -> SessionEstimate:
    """An estimate with everything in it: epochs with and without registration, looks used and not, tracks likewise."""
    random = np.random.default_rng(seed)
    gauge_free = covariance(random, 6, 1e-3)
    gauge_free[[2, 5], :] = gauge_free[:, [2, 5]] = 0.0  # roll about the beam and shift along it
    used = PairEstimate(
        t=3.0,
        pm=0,
        epoch=0,
        used=True,
        lambda_mm=38.2,
        theta_rad=math.radians(-14.1),
        rotation_rad=math.radians(3.1),
        trus_p_pm_mm=np.array([3.1, -10.2, 38.0]),
        covariance=covariance(random, 3, 0.3),
        residual_mm=0.21,
        nis=0.9,
        nis_dof=2,
        influence_mm=0.25,
    )
    return SessionEstimate(
        session="phantom-01",
        settings=SettingsUsed(3.0, ("probe_radius",), detect_moves=False),
        verdict=Verdict.WARNING,
        reasons=(
            '3 of 15 pairs sweep one way: "take 3 more"\n',
            "Überprüfen: \u2028 \x00 \x85 \ufeff \U0001f600 # {x}",
            "no",
        ),
        laser=LaserEstimate(transform(random), gauge_free),
        epochs=(
            EpochEstimate(
                *(0, 0.1, transform(random), covariance(random, 6, 1e-3), 1, Verdict.OK),
                PredictedTre(0.71, 1.12, 1.4),
                (TargetEstimate("apex", np.array([1.0, -2.0, 40.5]), 0.7, 1.4, 1.1, 0.9),),
            ),
            EpochEstimate(1, 1e9 + 1 / 3, None, None, 0, Verdict.REFUSED, None),
        ),
        pairs=(
            used,
            PairEstimate(t=4.0, pm=7, epoch=0, used=False, reason="the marker was not found"),
            replace(used, pm=8, used=False, reason="an outlier", covariance=None, trus_p_pm_mm=None),
        ),
        tracks=(
            TrackEstimate(91.2, math.radians(12.4), math.radians(0.5), 40.1, causal=False),
            TrackEstimate(92.0, None, None, None, causal=True, reason="no registration yet"),
        ),
        aims=(AimEstimate(1.0, used=True, residual_mm=0.3, nis=0.5), AimEstimate(2.0, used=False, reason="dark")),
        checks=(
            CheckEstimate(80.5, np.array([0.1, -0.2, 2.5]), 1.2, 14.5, Verdict.WARNING),
            CheckEstimate(81.0, None, None, None, Verdict.WARNING, "far"),
        ),
        assumptions=(Assumption("one medium", (0,)), Assumption("a centred window")),
    )


def test_fields_are_those_of_the_format_as_another_reader_sees_them(tmp_path: Path, model: SessionModel) -> None:
    estimate = an_estimate()
    path = tmp_path / "result.yaml"
    write_result(estimate, model, path, "0.3.0")
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert list(data) == [
        *("format", "fgreg", "session", "settings", "verdict", "reasons", "assumptions", "checks"),
        *("aims", "laser", "epochs", "pairs", "tracks"),
    ]
    assert [data[key] for key in ("format", "fgreg", "session", "verdict")] == [
        *("fgreg-result/1", "0.3.0", "phantom-01", "warning"),
    ]
    assert tuple(data["reasons"]) == estimate.reasons
    assert data["assumptions"] == [{"text": "one medium", "checks": [0]}, {"text": "a centred window", "checks": []}]
    assert data["checks"] == [
        {"t": 80.5, "error_mm": [0.1, -0.2, 2.5], "predicted_95_mm": 1.2, "nis": 14.5, "verdict": "warning"},
        {"t": 81.0, "error_mm": None, "predicted_95_mm": None, "nis": None, "verdict": "warning", "reason": "far"},
    ]
    assert list(data["laser"]) == ["marker_T_laser", "covariance"]
    first, second = data["epochs"]
    assert list(first) == [
        *(
            "index",
            "start_s",
            "trus_T_camera",
            "covariance",
            "pairs",
            "verdict",
            "predicted_tre_mm",
            "target_errors_mm",
        ),
    ]
    assert first["target_errors_mm"] == [
        {
            **{"name": "apex", "trus_p_mm": [1.0, -2.0, 40.5]},
            **{"rms": 0.7, "p95": 1.4, "random_p95": 1.1, "systematic_p95": 0.9},
        }
    ]
    assert first["predicted_tre_mm"] == {"mean": 0.71, "p95": 1.12, "worst": 1.4}
    assert second == {
        "index": 1,
        "start_s": 1e9 + 1 / 3,
        "trus_T_camera": None,
        "covariance": None,
        "pairs": 0,
        "verdict": "refused",
        "predicted_tre_mm": None,
    }
    used, lost, outlier = data["pairs"]
    assert list(used) == [
        *("pm", "epoch", "used", "lambda_mm", "theta_deg", "rotation_deg"),
        *("trus_p_pm_mm", "covariance", "residual_mm", "nis", "nis_dof", "influence_mm"),
    ]
    assert (used["theta_deg"], used["rotation_deg"], used["lambda_mm"]) == (-14.1, 3.1, 38.2)
    assert lost == {"pm": 7, "epoch": 0, "used": False, "reason": "the marker was not found"}
    assert (outlier["used"], outlier["reason"], outlier["residual_mm"]) == (False, "an outlier", 0.21)
    assert data["tracks"] == [
        {"t": 91.2, "stage_deg": 12.4, "sigma_deg": 0.5, "lambda_mm": 40.1, "causal": False},
        {
            "t": 92.0,
            "stage_deg": None,
            "sigma_deg": None,
            "lambda_mm": None,
            "causal": True,
            "reason": "no registration yet",
        },
    ]


@pytest.mark.parametrize("seed", range(5))
def test_reads_back_as_it_was(tmp_path: Path, model: SessionModel, seed: int) -> None:
    estimate = an_estimate(seed)
    path = tmp_path / "result.yaml"
    write_result(estimate, model, path, "0.3.0")
    read = read_result(path)
    assert (read.session, read.verdict, read.reasons) == (estimate.session, estimate.verdict, estimate.reasons)
    assert read.laser is not None
    assert estimate.laser is not None
    assert_allclose(read.laser.marker_T_laser, estimate.laser.marker_T_laser, atol=1e-6)
    assert_allclose(read.laser.covariance, estimate.laser.covariance, rtol=1e-9)
    for got, epoch in zip(read.epochs, estimate.epochs, strict=True):
        assert (got.index, got.start_s, got.pairs) == (epoch.index, epoch.start_s, epoch.pairs)
        assert (got.verdict, got.predicted_tre) == (epoch.verdict, epoch.predicted_tre)
        if epoch.trus_T_camera is not None:
            assert got.trus_T_camera is not None
            assert_allclose(got.trus_T_camera[:3, :3], epoch.trus_T_camera[:3, :3], atol=2e-9)
            assert_allclose(got.trus_T_camera[:3, 3], epoch.trus_T_camera[:3, 3], atol=1e-6)
    for look, pair in zip(read.pairs, estimate.pairs, strict=True):
        assert math.isnan(look.t)
        for name in ("pm", "epoch", "used", "reason", "lambda_mm", "residual_mm", "nis"):
            assert getattr(look, name) == getattr(pair, name)
    assert read.pairs[0].theta_rad == pytest.approx(math.radians(-14.1), abs=1e-8)
    assert [track.reason for track in read.tracks] == ["", "no registration yet"]
    assert read.tracks[0].stage_rad == pytest.approx(math.radians(12.4), abs=1e-8)
    assert read.tracks[1].stage_rad is None


@pytest.mark.parametrize("tracked", [Quantiles(0.125, 0.3, 1.0), None])
def test_how_long_things_took_is_written_where_they_came_one_by_one(
    tracked: Quantiles | None, tmp_path: Path, model: SessionModel
) -> None:
    path, timing = tmp_path / "result.yaml", Timing(Quantiles(0.75, 4.5, 20.0), tracked)
    write_result(replace(an_estimate(), timing=timing), model, path, "1.0")
    assert read_result(path).timing == timing
    other = yaml.safe_load(path.read_text())["timing_ms"]
    assert other["add"] == {"p50": 0.75, "p99": 4.5, "max": 20.0}
    path.write_text(path.read_text().replace("p99: 4.5", "p99: -4.5"))
    with pytest.raises(InputError, match=r"timing_ms\.add\.p99"):
        read_result(path)
    write_result(an_estimate(), model, path, "1.0")
    assert "timing" not in path.read_text()


def test_rotations_stay_rigid_to_1e_8_and_covariances_positive(tmp_path: Path, model: SessionModel) -> None:
    path = tmp_path / "result.yaml"
    for seed in range(30):
        write_result(an_estimate(seed), model, path, "0.3.0")
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
        for written in (data["epochs"][0]["trus_T_camera"], data["laser"]["marker_T_laser"]):
            rotation = np.array(written)[:3, :3]
            assert np.abs(rotation.T @ rotation - np.eye(3)).max() < 1e-8
            assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-8)
            assert written[3] == [0, 0, 0, 1]
        for written in (data["epochs"][0]["covariance"], data["pairs"][0]["covariance"]):
            assert np.linalg.eigvalsh(np.array(written))[0] > 0


def test_rows_of_transforms_are_lines(tmp_path: Path, model: SessionModel) -> None:
    estimate = replace(an_estimate(), laser=LaserEstimate(np.array(session_files.QUARTER), np.eye(6) * 1e-12))
    path = tmp_path / "result.yaml"
    write_result(estimate, model, path, "0.3.0")
    text = path.read_text(encoding="utf-8")
    assert (
        "laser:\n  marker_T_laser:\n    - [1.0, 0.0, 0.0, 10.0]\n    - [0.0, 0.0, -1.0, 20.0]\n"
        "    - [0.0, 1.0, 0.0, 150.0]\n    - [0.0, 0.0, 0.0, 1.0]\n"
        "  covariance:\n    - [1.0e-12, 0.0, 0.0, 0.0, 0.0, 0.0]\n"
    ) in text


def test_a_result_without_content_is_written_and_read_too(tmp_path: Path, model: SessionModel) -> None:
    nothing = SessionEstimate("phantom-01", Verdict.REFUSED, (), None, (), (), ())
    write_result(nothing, model, tmp_path / "result.yaml", "0.3.0")
    data = yaml.safe_load((tmp_path / "result.yaml").read_text())
    assert (data["laser"], data["epochs"], data["pairs"], data["tracks"], data["reasons"]) == (None, [], [], [], [])
    assert read_result(tmp_path / "result.yaml").laser is None


def test_figures_that_are_not_finite_become_null(tmp_path: Path, model: SessionModel) -> None:
    estimate = an_estimate()
    epoch = replace(estimate.epochs[0], predicted_tre=PredictedTre(2.0, math.inf, math.nan))
    pair = replace(estimate.pairs[0], nis=math.inf)
    write_result(
        replace(estimate, epochs=(epoch, estimate.epochs[1]), pairs=(pair,)), model, tmp_path / "result.yaml", "0.3.0"
    )
    data = yaml.safe_load((tmp_path / "result.yaml").read_text(encoding="utf-8"))
    assert data["epochs"][0]["predicted_tre_mm"] == {"mean": 2.0, "p95": None, "worst": None}
    assert data["pairs"][0]["nis"] is None
    assert read_result(tmp_path / "result.yaml").pairs[0].nis is None


@pytest.mark.parametrize("name", ["no", "null", "1e3", "a: b", "'", "naïve", "[x]", "# c", "a\u0301", "~", "0"])
def test_any_name_of_a_session_reads_back(tmp_path: Path, model: SessionModel, name: str) -> None:
    write_result(an_estimate(), replace(model, name=name), tmp_path / "result.yaml", "0.3.0")
    assert yaml.safe_load((tmp_path / "result.yaml").read_text(encoding="utf-8"))["session"] == name
    assert read_result(tmp_path / "result.yaml").session == name


def test_a_transform_that_is_not_rigid_or_finite_is_never_written(tmp_path: Path, model: SessionModel) -> None:
    estimate = an_estimate()
    for bad in (np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan), 1.01 * np.eye(4)):
        broken = replace(estimate, epochs=(replace(estimate.epochs[0], trus_T_camera=bad),))
        with pytest.raises(ValueError, match="trus_T_camera"):
            write_result(broken, model, tmp_path / "result.yaml", "0.3.0")
    assert [path.name for path in tmp_path.iterdir()] == ["session"]


def test_a_failure_on_the_way_leaves_the_older_file_and_no_other(
    tmp_path: Path, model: SessionModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "result.yaml"
    write_result(an_estimate(2), model, path, "0.2.0")
    older = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(InputError, match="No space left on device"):
            write_result(an_estimate(), model, path, "0.3.0")
    assert path.read_bytes() == older
    assert sorted(p.name for p in tmp_path.iterdir()) == ["result.yaml", "session"]
    write_result(an_estimate(), model, path, "0.3.0")
    assert read_result(path).session == "phantom-01"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["result.yaml", "session"]


def test_a_new_result_has_the_permissions_of_any_new_file(tmp_path: Path, model: SessionModel) -> None:
    (tmp_path / "other").write_text("")
    write_result(an_estimate(), model, tmp_path / "result.yaml", "0.3.0")
    assert (tmp_path / "result.yaml").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_only_an_older_result_is_replaced_told_by_its_content(tmp_path: Path, model: SessionModel) -> None:
    target = tmp_path / "target"
    write_result(an_estimate(), model, target, "0.3.0")
    link, named, other = tmp_path / "link.yaml", tmp_path / "result.yaml", tmp_path / "thesis.tex"
    link.symlink_to(target)
    named.write_text("name: mine")
    other.write_text("")
    for not_ours in (link, named, other):
        before = not_ours.read_bytes()
        with pytest.raises(InputError, match=r"a file that is not a result|found a link"):
            write_result(an_estimate(), model, not_ours, "0.3.0")
        assert not_ours.read_bytes() == before
    write_result(an_estimate(), model, target, "0.4.0")
    assert read_result(target).version == "0.4.0"
    assert link.is_symlink()


def test_places_where_no_result_can_be(tmp_path: Path) -> None:
    session = session_files.write(tmp_path / "session")
    (session / "ground_truth.yaml").unlink(missing_ok=True)
    for path, found in (
        (session / "session.yaml", "the name of a session's own file"),
        (session / "ground_truth.yaml", "the name of a session's own file"),
        (tmp_path / "none" / "result.yaml", "no such folder"),
        (session / "session.yaml" / "result.yaml", "no such folder"),
        (session, "a folder"),
        (session / ("x" * 300), "no access (File name too long)"),
    ):
        with pytest.raises(InputError) as caught:
            check_output(path, RESULT_KIND)
        assert caught.value.found == found
    assert len(read_session(session).events) == 20


def written(tmp_path: Path, model: SessionModel) -> dict[str, Any]:
    (tmp_path / "result.yaml").unlink(missing_ok=True)
    write_result(an_estimate(), model, tmp_path / "result.yaml", "0.3.0")
    data: dict[str, Any] = yaml.safe_load((tmp_path / "result.yaml").read_text(encoding="utf-8"))
    return data


@pytest.mark.parametrize(
    ("path", "value", "place", "found"),
    [
        ("format", "fgreg-session/1", "format", "'fgreg-session/1'"),
        ("fgreg", 0.3, "fgreg", "0.3"),
        ("verdict", "fine", "verdict", "'fine'"),
        ("reasons", [3], "reasons[0]", "3"),
        ("reasons", None, "reasons", "null"),
        ("laser.marker_T_laser.0.0", 5, "laser.marker_T_laser", "a matrix that is not rigid"),
        ("laser.covariance.0.0", -1, "laser.covariance", "the variance -1"),
        ("epochs.0.index", 1, "epochs[0].index", "1"),
        ("epochs.0.trus_T_camera", "none", "epochs[0].trus_T_camera", "'none'"),
        ("epochs.0.predicted_tre_mm.mean", -1, "epochs[0].predicted_tre_mm.mean", "-1"),
        ("epochs.0.predicted_tre_mm.median", 1, "epochs[0].predicted_tre_mm.median", "an unknown key"),
        ("pairs.0.epoch", 2, "pairs[0].epoch", "2"),
        ("pairs.0.used", "yes", "pairs[0].used", "'yes'"),
        ("pairs.0.trus_p_pm_mm", [1, 2], "pairs[0].trus_p_pm_mm", "[1, 2]"),
        ("pairs.0.lambda_mm", "38", "pairs[0].lambda_mm", "'38'"),
        ("pairs.1.note", "x", "pairs[1].note", "an unknown key"),
        ("tracks.0.stage_deg", None, "tracks[0].reason", "nothing"),
        ("tracks.0.t", None, "tracks[0].t", "null"),
    ],
)
def test_a_result_with_a_mistake_is_refused(
    tmp_path: Path, model: SessionModel, path: str, value: Any, place: str, found: str
) -> None:
    data = written(tmp_path, model)
    session_files.change(data, path, value)
    (tmp_path / "result.yaml").write_text(yaml.safe_dump(data, allow_unicode=True))
    with pytest.raises(InputError) as caught:
        read_result(tmp_path / "result.yaml")
    assert caught.value.where.startswith(f"result.yaml: {place}")
    assert caught.value.found.startswith(found)


def test_every_key_of_a_result_is_needed(tmp_path: Path, model: SessionModel) -> None:
    data = written(tmp_path, model)
    older_lack = ("assumptions", "checks", "settings", "aims", "target_errors_mm", "nis_dof", "influence_mm")
    keys = list(data)
    keys += [*(f"laser.{key}" for key in data["laser"]), *(f"epochs.0.{key}" for key in data["epochs"][0])]
    keys += [*(f"pairs.0.{key}" for key in data["pairs"][0]), *(f"tracks.0.{key}" for key in data["tracks"][0])]
    keys += ["pairs.1.reason", "tracks.1.reason", "epochs.0.predicted_tre_mm.worst"]
    for key in (key for key in keys if not key.endswith(older_lack)):
        data = written(tmp_path, model)
        session_files.change(data, key, session_files.ABSENT)
        (tmp_path / "result.yaml").write_text(yaml.safe_dump(data, allow_unicode=True))
        with pytest.raises(InputError):
            read_result(tmp_path / "result.yaml")


def test_a_result_cut_anywhere_is_refused(tmp_path: Path, model: SessionModel) -> None:
    written(tmp_path, model)
    path = tmp_path / "result.yaml"
    whole = path.read_bytes()
    for cut in range(0, len(whole) - 20, 41):
        path.write_bytes(whole[:cut])
        with pytest.raises(InputError):
            read_result(path)
