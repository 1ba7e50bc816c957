"""``fgreg commission`` as a user types it."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner, Result

from fgreg.cli.main import app
from fgreg.errors import InputError
from fgreg.geometry.rig import Constant
from fgreg.session.rig_file import read_rig
from tests import rigs

RUNNER = CliRunner()


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders 0, 1, 2 of one rig."""
    root = tmp_path_factory.mktemp("rig")
    for k in range(3):
        rigs.write(root / str(k), k + 1)
    return root


@pytest.fixture
def root(written: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written, tmp_path / "root"))


def commission(*words: object) -> Result:
    return RUNNER.invoke(app, ["commission", "--jobs", "1", *map(str, words)])


def changed(folder: Path, *path: str, to: object) -> None:
    document = yaml.safe_load((folder / "session.yaml").read_text())
    part = document
    for key in path[:-1]:
        part = part.setdefault(key, {})
    part[path[-1]] = to
    (folder / "session.yaml").write_text(yaml.safe_dump(document))


def test_sessions_become_a_rig_that_a_session_takes_up(root: Path) -> None:
    done = commission(root / "0", root / "1", "--out", root / "rig.yaml")
    assert done.exit_code == 0, done.output
    observed, held = done.stdout.split("Held by their prior")
    assert "tag_size" in observed
    assert "radius_mm" in held.split("Each session")[0]
    assert done.stdout.count("pass") == 2
    rig = read_rig(root / "rig.yaml")
    assert len(rig.names) == len(rig.stored_covariance) == 26
    assert [set(hashes) >= {"session.yaml", "events.jsonl", "probe"} for hashes in rig.sessions] == [True, True]
    (root / "2" / "rig.yaml").write_bytes((root / "rig.yaml").read_bytes())
    bounds = []
    for name in ("", "rig.yaml"):
        if name:
            changed(root / "2", "rig", to=name)
        solved = json.loads(RUNNER.invoke(app, ["solve", str(root / "2"), "--json"]).stdout)
        bounds.append(solved["epochs"][0]["predicted_tre_mm"]["worst"])
    assert bounds[1] < bounds[0]
    # A rig that is taken up already is not counted again.
    again = commission(root / "2", "--out", root / "again.yaml", "--json")
    assert json.loads(again.stdout)["constants"][0]["prior_sigma"] == pytest.approx(0.2)


def test_the_json_report_says_which_constants_the_prior_holds(root: Path) -> None:
    done = commission(root / "0", root / "1", "--out", root / "rig.yaml", "--json")
    report = json.loads(done.stdout)
    held = {constant["name"]: constant["held_by"] for constant in report["constants"]}
    assert held["tag_size"] == "sessions"
    assert held["radius_mm"] == held["array_tilt_deg[2]"] == "prior"
    for constant in report["constants"]:
        assert (constant["observed"] >= 0.5) is (constant["held_by"] == "sessions")
        assert constant["sigma"] <= constant["prior_sigma"]
    assert [session["verdict"] for session in report["sessions"]] == ["pass", "pass"]


def test_a_new_session_is_compared_with_the_rig(root: Path) -> None:
    assert commission(root / "0", root / "1", "--out", root / "rig.yaml", "--quiet").stdout == ""
    off = {**rigs.OFF, Constant.TAG_SIZE: rigs.OFF[Constant.TAG_SIZE] - 0.015}
    rigs.write(root / "printed-again", 9, replace(rigs.RIG, deviations=off))
    same = commission("--check", root / "rig.yaml", root / "2")
    assert same.exit_code == 0
    assert ": pass, chi square" in same.stdout
    other = commission("--check", root / "rig.yaml", root / "printed-again")
    assert other.exit_code == 1
    assert ": alarm, chi square" in other.stdout
    assert "tag_size changed by" in other.stdout
    both = commission("--check", root / "rig.yaml", root / "2", root / "printed-again", "--json")
    assert [one["verdict"] for one in json.loads(both.stdout)["sessions"]] == ["pass", "alarm"]
    assert not (root / "2" / "result.yaml").exists()


def test_a_refused_session_is_left_out(root: Path) -> None:
    lines = (root / "1" / "events.jsonl").read_text().splitlines(keepends=True)
    pairs = [line for line in lines if json.loads(line)["type"] == "pair"]
    (root / "1" / "events.jsonl").write_text("".join(line for line in lines if line not in pairs[4:]))
    done = commission(root / "0", root / "1", "--out", root / "rig.yaml")
    assert done.exit_code == 0
    assert "left out, refused:" in done.stdout
    assert len(read_rig(root / "rig.yaml").sessions) == 1
    with pytest.raises(InputError, match="no registration"):
        raise _error(commission(root / "1", "--out", root / "other.yaml"))
    assert not (root / "other.yaml").exists()
    assert commission("--check", root / "rig.yaml", root / "1").exit_code == 1


def _error(done: Result) -> BaseException:
    assert done.exception is not None
    return done.exception


@pytest.mark.parametrize(
    ("path", "to", "message"),
    [
        (("probe", "radius_mm"), 10.5, "session.yaml: probe: found another one"),
        (("probe", "sound_speed_m_s"), 1500.0, "session.yaml: probe: found another one"),
        (("marker",), {"dictionary": "DICT_4X4_50", "tags": [{"id": 0, "size_mm": 30.0}]}, "marker: found another"),
        (("systematic", "tag_size"), 0.01, "systematic: found other values"),
        (("systematic",), "none", "systematic: found none"),
    ],
)
def test_sessions_of_different_rigs_are_one_error(root: Path, path: tuple[str, ...], to: object, message: str) -> None:
    changed(root / "1", *path, to=to)
    with pytest.raises(InputError, match=message):
        raise _error(commission(root / "0", root / "1", "--out", root / "rig.yaml"))
    assert not (root / "rig.yaml").exists()


def test_bad_usage_is_one_error(root: Path) -> None:
    for words, message in (
        ((root / "0",), "--out, --check: found nothing"),
        ((root / "0", "--out", root / "a", "--check", root / "b"), "--out, --check: found both"),
        ((root / "0", root / "0", "--out", root / "a"), "each session once"),
        ((root / "0", "--out", root / "absent" / "rig.yaml"), "no such folder"),
        ((root / "0", "--check", root / "absent.yaml"), "absent.yaml"),
    ):
        with pytest.raises(InputError, match=message):
            raise _error(commission(*words))


def test_check_points_may_be_data(tmp_path: Path) -> None:
    folder = rigs.write(tmp_path / "s", 5, replace(rigs.RIG, checks=6))
    sigmas = []
    for option in ((), ("--checks",)):
        done = commission(folder, "--out", tmp_path / "rig.yaml", "--json", *option)
        sigmas.append([constant["sigma"] for constant in json.loads(done.stdout)["constants"]])
    assert all(with_checks <= without * (1.0 + 1e-6) for without, with_checks in zip(*sigmas, strict=True))
    assert sigmas[0] != sigmas[1]
