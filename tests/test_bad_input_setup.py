"""Each way to get ``session.yaml`` wrong gives one line that names the key, what was found and what was expected."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import yaml

from fgreg.session.session_reader import check_session, read_session
from tests import session_files
from tests.session_files import ABSENT, change, error_of

NAN, INF = float("nan"), float("inf")
NOT_RIGID = [[1, 0, 0, 0], [0, 1, 0.01, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRRORED = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
FAR = [[1, 0, 0, 1500], [0, 1, 0, 1500], [0, 0, 1, 0], [0, 0, 0, 1]]
BAD_ROW = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 2]]
ENORMOUS = [[1e308, 1e308, 0, 0], [0, 1e308, 0, 0], [0, 0, 1e308, 0], [0, 0, 0, 1]]

CASES: list[tuple[str, Any, str, str, str]] = [
    # path, value, place, found, expected (parts of them)
    ("format", ABSENT, "format", "nothing", "fgreg-session/1"),
    ("format", "fgreg-session/2", "format", "'fgreg-session/2'", "fgreg-session/1"),
    ("format", 1, "format", "1", "fgreg-session/1"),
    ("name", 12, "name", "12", "a text"),
    ("name", "", "name", "''", "a text"),
    ("name", "two\nlines", "name", "'two\\nlines'", "printable"),
    ("probe", ABSENT, "probe", "nothing", "a mapping with elements"),
    ("probe", [1], "probe", "[1]", "a mapping with elements"),
    ("probe", None, "probe", "null", "a mapping"),
    ("probe.elements", ABSENT, "probe.elements", "nothing", "an integer"),
    ("probe.elements", 128.0, "probe.elements", "128.0", "an integer"),
    ("probe.elements", True, "probe.elements", "true", "an integer"),
    ("probe.elements", 0, "probe.elements", "0", "an integer from 1"),
    ("probe.elements", 10**40, "probe.elements", "1e+40", "an integer from 1"),
    ("probe.pitch_mm", ABSENT, "probe.pitch_mm", "nothing", "a number >= 0.001"),
    ("probe.pitch_mm", 0, "probe.pitch_mm", "0", "a number >= 0.001"),
    ("probe.pitch_mm", -0.4, "probe.pitch_mm", "-0.4", "a number >= 0.001"),
    ("probe.pitch_mm", "0.43", "probe.pitch_mm", "'0.43'", "a number >= 0.001"),
    ("probe.pitch_mm", False, "probe.pitch_mm", "false", "a number >= 0.001"),
    ("probe.pitch_mm", NAN, "probe.pitch_mm", "nan", "a number >= 0.001"),
    ("probe.pitch_mm", INF, "probe.pitch_mm", "inf", "a number >= 0.001"),
    ("probe.pitch_mm", None, "probe.pitch_mm", "null", "a number >= 0.001"),
    ("probe.radius_mm", ABSENT, "probe.radius_mm", "nothing", "a number > 0"),
    ("probe.radius_mm", 0.0, "probe.radius_mm", "0.0", "a number > 0"),
    ("probe.flip", 1, "probe.flip", "1", "true or false"),
    ("probe.flip", "no", "probe.flip", "'no'", "true or false"),
    ("probe.sound_speed_m_s", ABSENT, "probe.sound_speed_m_s", "nothing", "a number > 0"),
    ("probe.sensitivity", ABSENT, "probe.sensitivity", "nothing", "depth_mm"),
    ("probe.sensitivity.depth_mm", ABSENT, "probe.sensitivity.depth_mm", "nothing", "a list of numbers"),
    ("probe.sensitivity.depth_mm", [], "probe.sensitivity.depth_mm", "[]", "a list of numbers"),
    ("probe.sensitivity.depth_mm", 30, "probe.sensitivity.depth_mm", "30", "a list of numbers"),
    ("probe.sensitivity.depth_mm", [30, 20, 45], "probe.sensitivity.depth_mm", "do not increase", "larger"),
    ("probe.sensitivity.half_width_deg", [6, 6], "probe.sensitivity.half_width_deg", "2 numbers", "3"),
    ("probe.sensitivity.half_width_deg", [6, 0, 6], "probe.sensitivity.half_width_deg[1]", "0", "> 0 and <= 45 deg"),
    ("probe.sensitivity.half_width_deg", [6, 6, 45.1], "probe.sensitivity.half_width_deg[2]", "45.1", "<= 45 deg"),
    ("probe.sensitivity.edge_sigma_deg", -0.1, "probe.sensitivity.edge_sigma_deg", "-0.1", ">= 0"),
    ("probe.sensitivity.curve.amplitude", [1, 2], "probe.sensitivity.curve.amplitude", "2 numbers", "3, one for"),
    ("probe.sensitivity.curve.amplitude", [0, 0, 0], "probe.sensitivity.curve.amplitude", "only zeros", "> 0"),
    ("probe.channels.sampling_mhz", ABSENT, "probe.channels.sampling_mhz", "nothing", "a number >= 0.1"),
    ("probe.channels.t0_us", "0", "probe.channels.t0_us", "'0'", "a number"),
    ("probe.image.pixel_mm", [0.1, 0], "probe.image.pixel_mm[1]", "0", "a number > 0"),
    ("probe.image.origin_mm", [0.1], "probe.image.origin_mm", "[0.1]", "a list of 2 numbers"),
    ("stage", ABSENT, "stage", "nothing", "step_deg"),
    ("stage.step_deg", ABSENT, "stage.step_deg", "nothing", "> 0"),
    ("stage.step_deg", 0, "stage.step_deg", "0", "> 0"),
    ("stage.limits_deg", [60, -60], "stage.limits_deg", "[60.0, -60.0]", "lower limit"),
    ("stage.limits_deg", [-181, 60], "stage.limits_deg[0]", "-181", "within +-180 deg"),
    ("stage.direction", 0, "stage.direction", "0", "1 or -1"),
    ("stage.direction", True, "stage.direction", "true", "1 or -1"),
    ("systematic", "exact", "systematic", "'exact'", "or none"),
    ("stage.zero_deg", 200, "stage.zero_deg", "200", "within +-180 deg"),
    ("camera.image_size", [640], "camera.image_size", "[640]", "[width, height]"),
    ("camera.image_size", [640, 480.0], "camera.image_size", "[640, 480.0]", "two integers from 1 to 32768"),
    ("camera.left", ABSENT, "camera.left", "nothing", "matrix"),
    ("camera.right", ABSENT, "camera.right", "nothing", "right and right_T_left together"),
    ("camera.right_T_left", ABSENT, "camera.right_T_left", "nothing", "right and right_T_left together"),
    ("camera.right_T_left", MIRRORED, "camera.right_T_left", "det R -1", "a rigid transform"),
    ("camera.left.matrix", [[900, 0, 1], [0, 900, 1]], "camera.left.matrix", "a list of 2", "3 lists of 3"),
    ("camera.left.matrix.0", [900, 0], "camera.left.matrix", "2 entries in row 0", "3 lists of 3"),
    ("camera.left.matrix.0.1", 3, "camera.left.matrix", "[900, 3, 320]", "[[fx, 0, cx]"),
    ("camera.left.matrix.1.1", -900, "camera.left.matrix", "-900", "fx, fy > 0"),
    ("camera.left.distortion", [0, 0, 0], "camera.left.distortion", "[0, 0, 0]", "a list of 4, 5, 8 or 12 numbers"),
    ("camera.left.model", "fisheye", "camera.left.distortion", "5 numbers", "4 numbers, for model: fisheye"),
    ("camera.left.model", "fishey", "camera.left.model", "'fishey'", "did you mean fisheye?"),
    ("marker.dictionary", "DICT_4x4_50", "marker.dictionary", "'DICT_4x4_50'", "(did you mean DICT_4X4_50?)"),
    ("marker.tags", [], "marker.tags", "[]", "a list of mappings with id"),
    ("marker.tags", [3], "marker.tags[0]", "3", "a mapping with id"),
    ("marker.tags.1.id", 0, "marker.tags[1].id", "0 again", "each id once"),
    ("marker.tags.1.id", 50, "marker.tags[1].id", "50", "from 0 to 49"),
    ("marker.tags.0.size_mm", ABSENT, "marker.tags[0].size_mm", "nothing", "> 0"),
    ("marker.tags.0.marker_T_tag", NOT_RIGID, "marker.tags[0].marker_T_tag", "not rigid", "a rigid transform"),
    ("board.columns", 1, "board.columns", "1", "an integer from 2"),
    ("board.square_mm", 7.0, "board.charuco.marker_mm", "7.0", "less than square_mm, 7 mm"),
    ("board.columns", 40, "board.charuco.dictionary", "DICT_5X5_100", "at least 143 markers"),
    ("board", {"columns": 9, "rows": 7, "square_mm": 5}, "board", "the same when turned", "columns + rows odd"),
    ("noise.lateral_mm", -1, "noise.lateral_mm", "-1", ">= 0"),
    ("noise.aim_mm", [1, 1, -1], "noise.aim_mm[2]", "-1", ">= 0"),
    ("noise.marker_rotation_rad", 0.01, "noise.marker_rotation_rad", "0.01", "a list of 3 numbers"),
    ("noise.marker_translation_mm", [0.1, 0.1, True], "noise.marker_translation_mm[2]", "true", ">= 0"),
    ("initial.trus_T_camera", NOT_RIGID, "initial.trus_T_camera", "not rigid (R'R - I up to 0.01", "a rigid"),
    ("initial.trus_T_camera", ENORMOUS, "initial.trus_T_camera", "1e+308 in row 0", "4 lists of 4"),
    ("initial.trus_T_camera", BAD_ROW, "initial.trus_T_camera", "the last row [0.0, 0.0, 0.0, 2.0]", "[0, 0, 0, 1]"),
    ("initial.trus_T_camera", FAR, "initial.trus_T_camera", "a translation of 2121.32 mm", "at most 2000 mm"),
    ("initial.marker_T_laser.0.0", NAN, "initial.marker_T_laser", "nan in row 0", "4 lists of 4"),
    ("initial.marker_T_laser.0.0", "1", "initial.marker_T_laser", "'1' in row 0", "4 lists of 4"),
    ("initial.marker_T_laser.0", 3, "initial.marker_T_laser", "3 as row 0", "4 lists of 4"),
    ("targets_mm", [], "targets_mm", "[]", "a list of points"),
    ("targets_mm.1", [1, 2], "targets_mm[1]", "[1, 2]", "a list of 3 numbers"),
    ("targets", [{"name": "a", "trus_p_mm": [0, 0, 40]}], "targets", "together with targets_mm", "one of the two"),
    ("targets_mm.1.2", 3000, "targets_mm[1][2]", "3000", "within +-2000 mm"),
    ("probe.pich_mm", 1, "probe.pich_mm", "an unknown key", "one of elements"),
    ("colour", "red", "colour", "an unknown key", "a name that starts with x_"),
    ("noise.Range_mm ", 1, "noise.Range_mm ", "an unknown key", "one of"),
]


@pytest.mark.parametrize(("path", "value", "place", "found", "expected"), CASES)
def test_one_mistake_in_the_setup(tmp_path: Path, path: str, value: Any, place: str, found: str, expected: str) -> None:
    setup = session_files.setup()
    change(setup, path, value)
    text = error_of(session_files.write(tmp_path, setup))
    assert text.startswith(f"session.yaml: {place}")
    assert text[len(f"session.yaml: {place}")] in " :"
    found_at, expected_at = text.index(": found "), text.index(", expected ")
    assert found in text[found_at:expected_at]
    assert expected in text[expected_at:]


def test_each_required_key_is_missed_once_and_nothing_else(tmp_path: Path) -> None:
    required = ["format", "probe", "stage", "stage.step_deg", "probe.elements", "probe.pitch_mm", "probe.radius_mm"]
    required += ["probe.sound_speed_m_s", "probe.sensitivity"]
    required += ["probe.sensitivity.depth_mm", "probe.sensitivity.half_width_deg"]
    for path in required:
        setup = session_files.setup()
        change(setup, path, ABSENT)
        problems, _ = check_session(session_files.write(tmp_path, setup, []))
        assert len(problems) == 1, path
        assert problems[0].where.startswith(f"session.yaml: {path}")
        assert problems[0].found == "nothing"


def test_a_misspelt_key_is_one_problem_with_its_line_and_a_suggestion(tmp_path: Path) -> None:
    setup = session_files.setup()
    setup["probe"] = {("pich_mm" if key == "pitch_mm" else key): value for key, value in setup["probe"].items()}
    folder = session_files.write(tmp_path, setup, [])
    problems, _ = check_session(folder)
    lines = (folder / "session.yaml").read_text().splitlines()
    line = next(i for i, text in enumerate(lines, start=1) if "pich_mm" in text)
    assert [str(problem) for problem in problems] == [
        f"session.yaml: probe.pich_mm (line {line}): found an unknown key, "
        "expected a known one (did you mean pitch_mm?)"
    ]


def test_a_misspelt_section_is_one_problem_not_one_for_each_event(tmp_path: Path) -> None:
    for section in ("camera", "marker", "board", "probe"):
        setup = session_files.setup()
        setup[section + "s"] = setup.pop(section)
        session_files.write_frames(session_files.write(tmp_path, setup))
        problems, _ = check_session(tmp_path)
        assert [problem.where.split(" (")[0] for problem in problems] == [f"session.yaml: {section}s"]


def test_all_problems_of_both_files_at_once(tmp_path: Path) -> None:
    setup, events = session_files.setup(), session_files.events()
    change(setup, "probe.pitch_mm", -1)
    change(setup, "stage.step_deg", "2")
    change(setup, "noise.range_mm", NAN)
    change(events, "3.trus.x_mm", 201)
    change(events, "3.pm", 0.5)
    change(events, "12.reason", None)
    problems, _ = check_session(session_files.write(tmp_path, setup, events))
    places = [problem.where.split(" (")[0] for problem in problems]
    assert places[:6] == [
        "session.yaml: probe.pitch_mm",
        "session.yaml: stage.step_deg",
        "session.yaml: noise.range_mm",
        "events.jsonl: line 4: pm",
        "events.jsonl: line 4: trus.x_mm",
        "events.jsonl: line 13: reason",
    ]
    # and the frames, of which none is there
    assert places[6:] == [
        "events.jsonl: line 3: marker.left",
        "events.jsonl: line 5: marker.right",
        "events.jsonl: line 5: trus.frame",
    ]


@pytest.mark.parametrize("section", ["channels", "image"])
def test_either_way_to_read_frames_is_enough(tmp_path: Path, section: str) -> None:
    setup = session_files.setup()
    del setup["probe"][section]
    probe = read_session(session_files.write(tmp_path, setup)).model.probe
    assert (probe.channels is None, probe.image is None) == (section == "channels", section == "image")


def test_a_plain_board_with_two_sides_alike_is_refused_and_others_are_not(tmp_path: Path) -> None:
    setup = session_files.setup()
    for columns, rows, fine in ((9, 6, True), (6, 9, True), (8, 6, False), (7, 7, False), (7, 5, False)):
        setup["board"] = {"columns": columns, "rows": rows, "square_mm": 5}
        problems, _ = check_session(session_files.write(tmp_path, setup, []))
        assert (not problems) == fine, (columns, rows)


def test_the_session_itself_may_be_absent_or_something_else(tmp_path: Path) -> None:
    assert error_of(tmp_path / "none") == f"{tmp_path}/none: found nothing, expected a session's folder"
    file = tmp_path / "file"
    file.write_text("")
    assert error_of(file) == f"{file}: found a file, expected a session's folder"
    assert error_of(file / "below") == f"{file}/below: found nothing, expected a session's folder"
    assert "found no access" in error_of(tmp_path / "a\0b")
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    assert "expected a session's folder" in error_of(loop)
    empty = tmp_path / "empty"
    empty.mkdir()
    problems, _ = check_session(empty)
    assert [str(problem) for problem in problems] == [
        "session.yaml: found nothing, expected a file",
        "events.jsonl: found nothing, expected a file",
    ]
    (session_files.write(tmp_path / "odd") / "session.yaml").unlink()
    (tmp_path / "odd" / "session.yaml").mkdir()
    assert error_of(tmp_path / "odd") == "session.yaml: found a folder, expected a file"


def test_a_pipe_instead_of_a_file_is_refused_without_waiting(tmp_path: Path) -> None:
    folder = session_files.write(tmp_path)
    for name in ("session.yaml", "events.jsonl"):
        (folder / name).unlink()
        os.mkfifo(folder / name)
    problems, _ = check_session(folder)
    assert [problem.found for problem in problems] == ["something that is not a regular file"] * 2


def test_files_that_may_not_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = session_files.write(tmp_path)

    def refuse(self: Path, *_: Any, **__: Any) -> Any:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", refuse)
    problems, _ = check_session(folder)
    assert [str(problem) for problem in problems] == [
        f"{name}: found no access (Permission denied), expected a file that can be read"
        for name in ("session.yaml", "events.jsonl")
    ]


def test_the_example_data_are_valid_as_plain_yaml_too(tmp_path: Path) -> None:
    """What the cases above start from is read by another reader as the same data."""
    folder = session_files.write(tmp_path)
    assert yaml.safe_load((folder / "session.yaml").read_text()) == session_files.setup()
