"""Each way to get an event wrong gives one line that names the line, the key, what was found and what was expected."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fgreg.errors import InputError
from fgreg.session.session_reader import check_session, read_session
from tests import session_files
from tests.session_files import ABSENT, change, error_of

NOT_RIGID = [[1, 0, 0, 0], [0, 1, 0.01, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
MIRRORED = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
ASYMMETRIC = [[1.0, 0.5], [0.4, 1.0]]
INDEFINITE = [[1.0, 1.1], [1.1, 1.0]]
SINGULAR = [[1.0, 1.0], [1.0, 1.0]]
HUGE = [[1e-300, 1e99], [1e99, 1e-300]]
POSE_COVARIANCE = session_files.diagonal(1, 1, 1, 1, 1, 1)
ZERO_VARIANCE = session_files.diagonal(1, 1, 1, 1, 1, 0)

CASES: list[tuple[str, Any, str, str, str]] = [
    # path (index of the event first), value, place, found, expected (parts of them)
    ("3.type", ABSENT, "line 4: type", "nothing", "one of aim, pair, track"),
    ("3.type", "pairs", "line 4: type", "'pairs'", "(did you mean pair?)"),
    ("3.type", ["pair"], "line 4: type", "['pair']", "one of aim"),
    ("3.t", ABSENT, "line 4: t", "nothing", "a finite number"),
    ("3.t", "3", "line 4: t", "'3'", "a finite number"),
    ("3.t", 1.5, "line 4: t", "1.5", "at least 2, the time on line 3"),
    ("3.tt", 1, "line 4: tt", "an unknown key", "one of type, t, pm"),
    ("3.pm", ABSENT, "line 4: pm", "nothing", "an integer from 0"),
    ("3.pm", -1, "line 4: pm", "-1", "an integer from 0"),
    ("3.pm", 1.0, "line 4: pm", "1.0", "an integer from 0"),
    ("3.pm", "1", "line 4: pm", "'1'", "an integer from 0"),
    ("3.pm", True, "line 4: pm", "true", "an integer from 0"),
    ("3.marker", ABSENT, "line 4: marker", "nothing", "camera_T_marker"),
    ("3.marker", [], "line 4: marker", "[]", "camera_T_marker"),
    ("3.marker", {}, "line 4: marker", "neither camera_T_marker nor left", "the frames"),
    ("3.marker", {"right": "frames/b.png"}, "line 4: marker.left", "nothing", "a frame of the left camera"),
    ("3.marker.camera_T_marker", NOT_RIGID, "line 4: marker.camera_T_marker", "not rigid", "a rigid transform"),
    ("3.marker.camera_T_marker", MIRRORED, "line 4: marker.camera_T_marker", "det R -1", "a rigid transform"),
    ("3.marker.camera_T_marker.0.3", None, "line 4: marker.camera_T_marker", "null in row 0", "4 lists of 4"),
    ("3.marker.camera_T_marker.0.3", 2001, "line 4: marker.camera_T_marker", "2006.71 mm", "at most 2000 mm"),
    ("3.marker.camera_T_marker", ABSENT, "line 4: marker", "neither camera_T_marker nor left", "the frames"),
    ("4.marker.covariance", POSE_COVARIANCE, "line 5: marker.covariance", "without camera_T_marker", "both or none"),
    ("3.marker.covariance", ZERO_VARIANCE, "line 4: marker.covariance", "the variance 0", "positive definite"),
    ("3.marker.covariance.2.2", -1, "line 4: marker.covariance", "the variance -1", "positive definite"),
    ("3.marker.covariance.2.2", 1e30, "line 4: marker.covariance", "standard deviations from", "positive definite"),
    ("3.marker.covariance", [1], "line 4: marker.covariance", "a list of 1", "6 lists of 6"),
    ("3.marker.lft", "frames/a.png", "line 4: marker.lft", "an unknown key", "did you mean left?"),
    ("3.trus", ABSENT, "line 4: trus", "nothing", "scan_deg"),
    ("3.trus", 3, "line 4: trus", "3", "scan_deg"),
    ("3.trus.scan_deg", ABSENT, "line 4: trus.scan_deg", "nothing", "within +-180 deg"),
    ("3.trus.scan_deg", 180.1, "line 4: trus.scan_deg", "180.1", "within +-180 deg"),
    ("3.trus.x_mm", ABSENT, "line 4: trus.x_mm", "nothing", "within +-200 mm"),
    ("3.trus.x_mm", -200.5, "line 4: trus.x_mm", "-200.5", "within +-200 mm"),
    ("3.trus.range_mm", ABSENT, "line 4: trus.range_mm", "nothing", "> 0 and <= 300 mm"),
    ("3.trus.range_mm", 0, "line 4: trus.range_mm", "0", "> 0 and <= 300 mm"),
    ("3.trus.range_mm", 300.5, "line 4: trus.range_mm", "300.5", "> 0 and <= 300 mm"),
    ("3.trus.range_mm", 1e999, "line 4", "Infinity", "finite numbers"),
    ("3.trus.range_mm", float("nan"), "line 4", "NaN", "finite numbers"),
    ("3.trus.amplitude", -1, "line 4: trus.amplitude", "-1", ">= 0"),
    ("3.trus.amplitude", None, "line 4: trus.amplitude", "null", ">= 0"),
    ("3.trus.sweep", 2, "line 4: trus.sweep", "2", "0 or 1 or -1"),
    ("3.trus.sweep", 1.0, "line 4: trus.sweep", "1.0", "0 or 1 or -1"),
    ("3.trus.frame", "frames/c.npy", "line 4: trus.frame", "together with x_mm", "x_mm and range_mm, or frame"),
    ("4.trus.covariance", session_files.diagonal(1, 1), "line 5: trus.covariance", "together with frame", "only"),
    ("6.trus.covariance", ASYMMETRIC, "line 7: trus.covariance", "not symmetric", "positive definite"),
    ("6.trus.covariance", INDEFINITE, "line 7: trus.covariance", "a correlation beyond 1", "positive definite"),
    ("6.trus.covariance", SINGULAR, "line 7: trus.covariance", "not positive definite", "positive definite"),
    ("6.trus.covariance", HUGE, "line 7: trus.covariance", "standard deviations", "positive definite"),
    ("1.camera_p_spot_mm", ABSENT, "line 2", "neither", "camera_p_spot_mm or corner"),
    ("2.covariance", session_files.diagonal(1, 1, 1), "line 3: covariance", "without camera_p_spot_mm", "both or"),
    ("1.camera_p_spot_mm", [1, 2], "line 2: camera_p_spot_mm", "[1, 2]", "a list of 3 numbers"),
    ("1.camera_p_spot_mm", [1, 2, 2001], "line 2: camera_p_spot_mm[2]", "2001", "within +-2000 mm"),
    ("1.corner", [0, 0], "line 2: corner", "without frames", "marker.left"),
    ("2.corner", ABSENT, "line 3", "neither", "camera_p_spot_mm or corner"),
    ("2.camera_p_spot_mm", [0, 0, 1], "line 3", "both", "camera_p_spot_mm or corner"),
    ("2.corner", [9, 0], "line 3: corner", "[9, 0]", "9 columns and 6 rows, counted from 0"),
    ("2.corner", [0, 6], "line 3: corner", "[0, 6]", "9 columns and 6 rows, counted from 0"),
    ("2.corner", [0, -1], "line 3: corner", "[0, -1]", "two integers >= 0"),
    ("2.corner", [0.0, 1], "line 3: corner", "[0.0, 1]", "two integers >= 0"),
    ("2.corner", 3, "line 3: corner", "3", "two integers >= 0"),
    ("8.trus", {"scan_deg": 0, "x_mm": 0, "range_mm": 9}, "line 9: looks", "together with trus", "one of the two"),
    ("8.looks", [], "line 9: looks", "[]", "a list of mappings"),
    ("8.looks", ABSENT, "line 9", "none of trus, looks, scan_deg", "one of them"),
    ("8.looks.1.frame", 3, "line 9: looks[1].frame", "3", "the name of a frame"),
    ("8.looks.1", 3, "line 9: looks[1]", "3", "a mapping with scan_deg"),
    ("9.scan_deg", 181, "line 10: scan_deg", "181", "within +-180 deg"),
    ("10.camera_new_T_camera_old", ABSENT, "line 11: covariance", "without camera_new_T_camera_old", "both or none"),
    ("11.detected", ABSENT, "line 12: since_t", "without detected: true", "both or none"),
    ("11.detected", 1, "line 12: detected", "1", "true or false"),
    ("11.since_t", 9.5, "line 12: since_t", "9.5", "at most t, 9"),
    ("12.event", ABSENT, "line 13: event", "nothing", "the event that was not taken in"),
    ("12.reason", ABSENT, "line 13: reason", "nothing", "a text"),
    ("13.command", ABSENT, "line 14: command", "nothing", "a text"),
    ("13.scan_deg", "0", "line 14: scan_deg", "'0'", "within +-180"),
    ("0.text", 3, "line 1: text", "3", "a text"),
    ("14.camera_p_mm", ABSENT, "line 15", "neither", "camera_p_mm, or left and right"),
    ("14.trus_p_mm", ABSENT, "line 15", "neither", "trus_p_mm or trus"),
    ("14.trus", {"scan_deg": 0, "x_mm": 0, "range_mm": 20}, "line 15", "both", "trus_p_mm or trus"),
    ("14.trus_covariance", session_files.diagonal(1, 1), "line 15: trus_covariance", "", "3 lists of 3 numbers"),
    ("15.right", ABSENT, "line 16: right", "nothing", "[u, v], with left"),
    ("15.left", [1.0], "line 16: left", "[1.0]", "2 numbers"),
    ("15.covariance", session_files.diagonal(1, 1, 1), "line 16: covariance", "without camera_p_mm", "both"),
    ("15.trus.range_mm", 0, "line 16: trus.range_mm", "0", "> 0"),
]


@pytest.mark.parametrize(("path", "value", "place", "found", "expected"), CASES)
def test_one_mistake_in_an_event(tmp_path: Path, path: str, value: Any, place: str, found: str, expected: str) -> None:
    events = session_files.events()
    change(events, path, value)
    text = error_of(session_files.write(tmp_path, None, events))
    assert text.startswith(f"events.jsonl: {place}: found ")
    found_at, expected_at = text.index(": found "), text.index(", expected ")
    assert found in text[found_at:expected_at]
    assert expected in text[expected_at:]


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("", "found an empty line, expected one JSON object"),
        ("[1, 2]", "found [1, 2], expected one JSON object"),
        ("3", "found 3, expected one JSON object"),
        ('"a"', "found 'a', expected one JSON object"),
        ('{"type": "note", "t": 1, "text": "a"', "found bad JSON (Expecting ',' delimiter, column 37)"),
        ('{"type": "note"} {"type": "note"}', "found bad JSON (Extra data, column 18)"),
        ('{"type": "note", "t": 1, "t": 1, "text": "a"}', "found the key t twice in one object"),
        ('{"type": "note", "t": 1, "text": "a", "x_a": {"b": 1, "b": 2}}', "found the key b twice"),
        ('{"type": "note", "t": -Infinity, "text": "a"}', "found -Infinity, expected finite numbers"),
        ('{"type": "note", "t": 1e999, "text": "a"}', "t: found inf, expected a finite number"),
        ('{"type": "note", "t": ' + "9" * 5000 + ', "text": "a"}', "t: found inf, expected a finite number"),
        ('{"type": "note", "t": 1, "text": "a", "x_a": ' + "[" * 200_000, "found nesting too deep"),
        ("{'type': 'note'}", "found bad JSON"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, line: str, found: str) -> None:
    good = json.dumps({"type": "note", "t": 0, "text": "a"})
    folder = session_files.write(tmp_path, None, f"{good}\n{line}\n{good}\n")
    text = error_of(folder)
    assert text.startswith("events.jsonl: line 2: " + found)
    # and the good lines around it are no problem
    assert len(check_session(folder)[0]) == 1


@pytest.mark.parametrize(
    ("line", "found"),
    [
        (b'{"type": "note", "t": 1, "text": "\xff"}', "found bytes that are not UTF-8, expected UTF-8 text"),
        ('{"type": "note", "t": 1, "text": "a"}'.encode("utf-16"), "found UTF-16 text"),
        (b" " * 1_000_001, "found a longer line, expected at most 1000000 bytes"),
        (b'{"type": "note", "t": 1, "te', "found bad JSON"),
    ],
)
def test_bad_bytes_with_a_line_end_are_no_cut_line(tmp_path: Path, line: bytes, found: str) -> None:
    folder = session_files.write(tmp_path, None, "")
    (folder / "events.jsonl").write_bytes(line + b"\n")
    assert error_of(folder).startswith("events.jsonl: line 1: " + found)


def test_a_repeated_key_on_the_last_line_is_no_cut_line(tmp_path: Path) -> None:
    text = error_of(session_files.write(tmp_path, None, '{"type": "note", "t": 1, "t": 2, "text": "a"}'))
    assert text.startswith("events.jsonl: line 1: found the key t twice")


def test_one_early_time_is_one_problem(tmp_path: Path) -> None:
    events = session_files.events()
    events[5]["t"] = 1000.0
    problems, _ = check_session(session_files.write(tmp_path, None, events))
    assert [problem.where for problem in problems if problem.where.endswith(": t")] == ["events.jsonl: line 7: t"]


@pytest.mark.parametrize(
    ("removed", "where", "found"),
    [
        ("camera", "events.jsonl: line 3: marker.left", "no camera in session.yaml"),
        ("camera.right", "events.jsonl: line 5: marker.right", "no camera.right in session.yaml"),
        ("marker", "events.jsonl: line 3: marker.left", "no marker in session.yaml"),
        ("board", "events.jsonl: line 3: corner", "without a board in session.yaml"),
        ("probe.channels probe.image", "events.jsonl: line 5: trus.frame", "neither probe.channels nor probe.image"),
    ],
)
def test_what_an_event_needs_of_the_setup(tmp_path: Path, removed: str, where: str, found: str) -> None:
    setup = session_files.setup()
    for path in removed.split():
        change(setup, path, ABSENT)
    if removed == "camera.right":
        change(setup, "camera.right_T_left", ABSENT)
    text = error_of(session_files.write(tmp_path, setup))
    assert text.startswith(f"{where}: found ")
    assert found in text


def test_frames_beside_a_pose_need_no_camera(tmp_path: Path) -> None:
    setup = session_files.setup()
    for section in ("camera", "marker", "board"):
        del setup[section]
    events = [session_files.events()[5]]
    assert len(read_session(session_files.write(tmp_path, setup, events)).events) == 1


def test_messages_stay_on_one_short_line_whatever_the_file_says(tmp_path: Path) -> None:
    nasty = "a\nb\r\u2028\x1b[31m\ud800" + "z" * 500
    for path in ("3.type", "3.pm", "3.trus.sweep", "4.marker.left", "4.trus.frame", "12.reason"):
        events = session_files.events()
        change(events, path, [nasty] if path == "12.reason" else nasty)
        assert len(error_of(session_files.write(tmp_path, None, events))) < 300
    events = session_files.events()
    events[3][nasty] = 1
    assert len(error_of(session_files.write(tmp_path, None, events))) < 300
    with pytest.raises(InputError) as caught:
        read_session(tmp_path / "no\nsuch")
    assert "\n" not in str(caught.value)
