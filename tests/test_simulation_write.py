"""Simulated sessions on disk: contents, determinism, and what is done with a folder that is already there."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from fgreg.errors import InputError
from fgreg.model.session_model import MarkerModel, TagModel
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import encoded, write_session

EXAMPLES = Path(__file__).resolve().parent.parent / "sessions"
SMALL = replace(PRESETS["raw-small"], aims=1, pairs=1, tracks_heard=1, tracks_silent=0)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_files_hold_what_the_session_in_memory_holds(tmp_path: Path) -> None:
    simulated = simulate(SMALL, 1)
    seen: list[tuple[int, int]] = []
    write_session(simulated, tmp_path / "s", progress=lambda done, total: seen.append((done, total)))
    folder = tmp_path / "s"
    assert yaml.safe_load((folder / "session.yaml").read_text()) == simulated.session
    assert yaml.safe_load((folder / "ground_truth.yaml").read_text()) == simulated.truth
    lines = (folder / "events.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == simulated.events
    assert seen == [(k + 1, 8) for k in range(8)]
    for name, frame in simulated.frames.items():
        if name.endswith(".png"):
            stored = cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
            assert stored is not None
            assert stored.shape == (450, 800)
        else:
            stored = np.load(folder / name)
            assert stored.dtype == np.int16
        np.testing.assert_array_equal(stored, frame())


def test_written_twice_the_bytes_are_the_same(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_session(simulate(SMALL, 2), tmp_path / name)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert len(contents(tmp_path / "a")) == 3 + 8


def test_session_has_the_keys_of_the_format_and_no_others() -> None:
    session = simulate(PRESETS["phantom"], 1).session
    assert set(session) == {"format", "name", "probe", "stage", "camera", "marker", "board", "noise"}
    assert session["format"] == "fgreg-session/1"
    assert set(session["probe"]) == {
        "elements", "pitch_mm", "flip", "radius_mm", "sound_speed_m_s", "sensitivity", "channels",
    }  # fmt: skip
    assert set(session["probe"]["sensitivity"]) == {"depth_mm", "half_width_deg", "edge_sigma_deg"}
    assert set(session["probe"]["channels"]) == {"sampling_mhz", "t0_us", "pulse_delay_us"}
    assert set(session["stage"]) == {"step_deg", "limits_deg", "direction", "zero_deg"}
    assert set(session["camera"]) == {"image_size", "left", "right", "right_T_left"}
    assert session["marker"] == {"dictionary": "DICT_4X4_50", "tags": [{"id": 0, "size_mm": 25.0}]}
    assert set(session["board"]) == {"columns", "rows", "square_mm", "charuco"}
    assert set(session["noise"]) == {
        "marker_translation_mm", "marker_rotation_rad", "marker_bias_mm", "aim_mm", "lateral_mm", "range_mm",
        "scan_deg",
    }  # fmt: skip
    pose_level = simulate(replace(PRESETS["paper"], initial_laser=True, targets_mm=np.zeros((2, 3))), 1).session
    assert set(pose_level) == {"format", "name", "probe", "stage", "noise", "initial", "targets_mm"}
    assert pose_level["noise"]["scan_deg"] == pytest.approx(0.1)
    assert pose_level["stage"]["step_deg"] == pytest.approx(2.0)


def test_tags_elsewhere_on_the_marker_body_are_declared() -> None:
    away = np.eye(4)
    away[:3, 3] = [30.0, 0.0, 0.0]
    marker = MarkerModel("DICT_4X4_50", (TagModel(0, 20.0), TagModel(5, 12.0, away)))
    tags = simulate(replace(SMALL, marker=marker), 1).session["marker"]["tags"]
    assert tags[1] == {"id": 5, "size_mm": 12.0, "marker_T_tag": away.tolist()}


def test_a_folder_that_is_not_empty_is_left_alone(tmp_path: Path) -> None:
    session = simulate(PRESETS["paper"], 1)
    other = simulate(PRESETS["first-hit"], 1)
    folder = tmp_path / "s"
    folder.mkdir()
    write_session(session, folder)  # empty: fine
    before = contents(folder)
    with pytest.raises(InputError, match="not empty"):
        write_session(other, folder)
    assert contents(folder) == before
    write_session(other, folder, overwrite=True)
    assert yaml.safe_load((folder / "session.yaml").read_text())["name"] == "first-hit"


def test_overwriting_is_for_sessions_only(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("precious")
    with pytest.raises(InputError, match="no session"):
        write_session(simulate(PRESETS["paper"], 1), tmp_path, overwrite=True)
    assert (tmp_path / "notes.txt").read_text() == "precious"


def test_a_write_that_fails_leaves_the_old_session_and_no_rest(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    write_session(simulate(PRESETS["paper"], 1), folder)
    before = contents(folder)

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_session(simulate(SMALL, 1), folder, overwrite=True, progress=stop)
    assert contents(folder) == before
    assert [p.name for p in tmp_path.iterdir()] == ["s"]


def test_frames_of_other_kinds_are_refused() -> None:
    with pytest.raises(ValueError, match=r"neither \.png nor \.npy"):
        encoded("frames/a.gif", np.zeros((2, 2), dtype=np.uint8))


@pytest.mark.parametrize("name", ["phantom", "paper"])
def test_example_sessions_are_what_their_preset_makes(name: str) -> None:
    truth = yaml.safe_load((EXAMPLES / name / "ground_truth.yaml").read_text())
    simulated = simulate(PRESETS[name], truth["x_seed"])
    assert yaml.safe_load((EXAMPLES / name / "session.yaml").read_text()) == simulated.session
    for key in ("trus_T_camera", "marker_T_laser"):
        np.testing.assert_allclose(truth[key], simulated.truth[key], atol=1e-6)
    np.testing.assert_allclose(list(truth["pms"].values()), list(simulated.truth["pms"].values()), atol=1e-6)
    events = [json.loads(line) for line in (EXAMPLES / name / "events.jsonl").read_text().splitlines()]
    assert [e["type"] for e in events] == [e["type"] for e in simulated.events]
    assert [e.get("corner") for e in events] == [e.get("corner") for e in simulated.events]


def test_phantom_frames_are_all_there_and_small_enough() -> None:
    simulated = simulate(PRESETS["phantom"], 1)
    files = contents(EXAMPLES / "phantom")
    assert set(files) - {"result.yaml"} == {"session.yaml", "events.jsonl", "ground_truth.yaml", *simulated.frames}
    assert sum(map(len, files.values())) < 45e6
    for name in ("frames/aim-04-right.png", "frames/pm-09-left.png"):
        stored = cv2.imread(str(EXAMPLES / "phantom" / name), cv2.IMREAD_UNCHANGED)
        assert stored is not None
        difference = np.abs(stored.astype(int) - simulated.frames[name]().astype(int))
        # Rounding may differ between machines at a few pixels, nothing else.
        assert (difference > 0).mean() < 1e-3
        assert difference.max() <= 3
    stored_channels = np.load(EXAMPLES / "phantom" / "frames" / "pm-09.npy")
    assert np.abs(stored_channels.astype(int) - simulated.frames["frames/pm-09.npy"]()).max() <= 1
