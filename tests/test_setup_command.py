"""``fgreg setup`` from recordings, and of an ordinary session, as a user types it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from fgreg.cli.main import _exit_status
from fgreg.model.probe_model import ChannelModel
from fgreg.model.session_model import SESSION, SessionModel
from fgreg.schema.yaml_writer import yaml_text
from fgreg.simulation.config import default_probe, default_stage
from study_setup import SIGNS, DrawnRig, draw_rig, write_recordings
from tests import live_configs

NOTES = {"by": "A. N.", "rows": [[1.0, 2.0], [3.0, 4.0]]}


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, DrawnRig]:
    """A folder with the recordings of a rig and a session.yaml that declares another one."""
    folder = tmp_path_factory.mktemp("setup")
    rng = np.random.default_rng((1, 8))
    rig = draw_rig(rng)
    write_recordings(folder, rig.rig, rng)
    model = SessionModel("rig", default_probe(ChannelModel(40.0)), default_stage())
    text = yaml_text(SESSION.write(model)) + f"x_notes: {NOTES}\n"
    (folder / "session.yaml").write_text(text, encoding="utf-8")
    return folder, rig


@pytest.fixture
def here(drawn: tuple[Path, DrawnRig], monkeypatch: pytest.MonkeyPatch) -> DrawnRig:
    monkeypatch.chdir(drawn[0])
    return drawn[1]


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    status = _exit_status(["setup", *map(str, arguments)])
    said = capsys.readouterr()
    return status, said.out, said.err


def test_recordings_become_a_session_yaml(here: DrawnRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "session.yaml"
    files = ["points.jsonl", "sweep-1.jsonl", "sweep-2.jsonl", "moved.jsonl"]
    status, text, _ = run(capsys, "session.yaml", *files, "--out", out, "--json")
    assert status == 0
    constants = json.loads(text)["constants"]
    assert {one["name"] for one in constants} == here.truth.keys()
    for one in constants:
        true = here.truth[one["name"]]
        if one["name"] in SIGNS:
            assert one["value"] == true
            assert one["verdict"] == ("agrees" if one["declared"] == true else "differs")
            assert one["z"] > 20.0
        else:
            assert abs(one["value"] - true) < 4.0 * one["sigma"], one["name"]
    # What is written is what a session reads, and each line of it says where it is from.
    document = yaml.safe_load(out.read_text(encoding="utf-8"))
    found = {one["name"]: one["value"] for one in constants}
    assert document["probe"]["radius_mm"] == pytest.approx(found["probe.radius_mm"], abs=0.01)
    assert document["probe"]["flip"] is found["probe.flip"]
    assert document["stage"]["direction"] == found["stage.direction"]
    assert document["probe"]["sensitivity"]["depth_mm"] == pytest.approx([25.0, 38.0], abs=1.5)
    assert document["systematic"]["radius_mm"] == pytest.approx(0.14, abs=0.03)
    assert document["x_notes"] == NOTES
    written = out.read_text(encoding="utf-8").replace(yaml_text({"x_notes": NOTES}), "")
    lines = [line for line in written.splitlines() if ": " in line]
    assert all("#" in line for line in lines if "format:" not in line)
    assert any(line.startswith("#   hearing_threshold:") for line in lines)
    before = out.read_bytes()
    status, _, error = run(capsys, "session.yaml", "points.jsonl", "--out", out)
    assert (status, error) == (2, f"fgreg: error: {out}: found a file, expected a new name, or --force\n")
    assert out.read_bytes() == before
    status, text, _ = run(capsys, "session.yaml", "points.jsonl", "--out", out, "--force")
    assert status == 0
    assert "probe.radius_mm" in text
    assert yaml.safe_load(out.read_text(encoding="utf-8"))["probe"]["sensitivity"]["depth_mm"] == [20.0, 30.0, 45.0]


def test_without_recordings_it_says_what_to_record(here: DrawnRig, capsys: pytest.CaptureFixture[str]) -> None:
    status, text, _ = run(capsys, "session.yaml")
    assert status == 0
    for kind in ("target", "medium", "pulse", "stage", "marker"):
        assert f'"type": "{kind}"' in text


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"a.jsonl": ("sweep-1.jsonl", 0, 3)}, "in none of which anything was heard"),
        ({"a.jsonl": ("sweep-1.jsonl", 0, 300)}, "in one sense only: turn the stage past it both ways"),
        ({"a.jsonl": ("points.jsonl", 0, 40)}, "target: found 1, which no pulse heard"),
        ({"a.jsonl": ("moved.jsonl", 0, 100)}, "pulses with the PM heard"),
        ({"a.jsonl": ("session.yaml", 0, 3)}, "line 1: found bad JSON"),
        ({}, "a.jsonl: found nothing"),
    ],
)
def test_a_recording_that_cannot_be_used_is_one_line(
    files: dict[str, tuple[str, int, int]],
    said: str,
    here: DrawnRig,
    drawn: tuple[Path, DrawnRig],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name, (source, first, last) in files.items():
        lines = (drawn[0] / source).read_text(encoding="utf-8").splitlines(keepends=True)[first:last]
        (tmp_path / name).write_text("".join(lines), encoding="utf-8")
    status, _, error = run(capsys, "session.yaml", tmp_path / "a.jsonl", "--out", tmp_path / "session.yaml")
    assert status == 2
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "session.yaml").exists()


def test_a_session_says_what_it_contradicts(pose_session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, text, _ = run(capsys, pose_session)
    assert status == 0
    assert "contradicts nothing that is declared (verdict " in text
    assert "no session shows stage.zero_deg" in text
    setup = pose_session / "session.yaml"
    setup.write_text(setup.read_text(encoding="utf-8").replace("direction: 1", "direction: -1"), encoding="utf-8")
    status, text, _ = run(capsys, pose_session, "--json")
    assert status == 1
    (sign,) = json.loads(text)["sessions"][0]["contradicts"]
    assert "stage.direction" in sign
    assert not (pose_session / "result.yaml").exists()


def test_a_live_configuration_has_latency_and_threshold_to_compare_with(
    here: DrawnRig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    room = {**live_configs.room(), "settings": {"camera_latency_s": 0.5, "hearing_threshold": here.rig.threshold}}
    (tmp_path / "room.yaml").write_text(yaml.safe_dump(room), encoding="utf-8")
    files = ["sweep-1.jsonl", "moved.jsonl"]
    status, text, _ = run(capsys, tmp_path / "room.yaml", *files, "--out", tmp_path / "session.yaml", "--json")
    assert status == 0
    found = {one["name"]: one for one in json.loads(text)["constants"]}
    assert found["camera_less_pulse_latency_s"]["declared"] == 0.5
    assert found["camera_less_pulse_latency_s"]["verdict"] == "differs"
    assert found["settings.hearing_threshold"]["verdict"] == "agrees"
    # The room's session has channel data; its cameras and prints are kept.
    written = yaml.safe_load((tmp_path / "session.yaml").read_text(encoding="utf-8"))
    assert {"camera", "marker", "board"} <= written.keys()
    assert "_latency_s: " in (tmp_path / "session.yaml").read_text(encoding="utf-8").splitlines()[-1]
