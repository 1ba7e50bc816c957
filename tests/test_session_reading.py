"""A valid session is read as written: units, defaults, every type of event, and what is tolerated."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose

from fgreg.errors import InputError
from fgreg.geometry.transforms import as_float_array
from fgreg.model.camera_model import STEREO_RIG, CameraModel, StereoRig
from fgreg.model.events import (
    AimEvent,
    CameraMovedEvent,
    CheckEvent,
    ExcludeEvent,
    IncludeEvent,
    NoteEvent,
    PairEvent,
    PointEvent,
    RefusedEvent,
    StageEvent,
    TrackEvent,
)
from fgreg.model.session_model import SESSION, NoiseModel, SessionModel, default_targets_mm
from fgreg.schema.problems import FieldError
from fgreg.session.session_reader import read_ground_truth, read_session
from tests import session_files


def test_setup_in_radians_and_millimetres(tmp_path: Path) -> None:
    session = read_session(session_files.write(tmp_path))
    model = session.model
    assert (model.name, model.probe.elements, model.probe.pitch_mm, model.probe.flip) == (
        "phantom-01",
        128,
        0.43,
        False,
    )
    assert (model.probe.radius_mm, model.probe.sound_speed_m_s) == (10.0, 1540.0)
    assert_allclose(model.probe.sensitivity.half_width_rad, [0.104719755, 0.122173048, 0.139626340], atol=1e-9)
    assert model.probe.sensitivity.edge_sigma_rad == pytest.approx(0.005235988, abs=1e-9)
    assert model.probe.sensitivity.curve_rotation_rad is not None
    assert_allclose(model.probe.sensitivity.curve_rotation_rad, [-0.139626340, 0, 0.139626340], atol=1e-9)
    assert model.probe.channels is not None
    assert (model.probe.channels.t0_us, model.probe.channels.pulse_delay_us) == (0.5, 0.25)
    assert model.probe.image is not None
    assert (model.probe.image.pixel_mm, model.probe.image.origin_mm) == ((0.1, 0.2), (1.0, -20.0))
    assert model.stage.step_rad == pytest.approx(0.034906585, abs=1e-9)
    # direction -1 and zero 5 deg: a device angle of 18 deg is a plane angle of -13 deg.
    assert math.degrees(model.stage.scan_from_device(math.radians(18.0))) == pytest.approx(-13.0)
    assert model.noise.scan_rad == pytest.approx(0.003141593, abs=1e-9)
    assert model.noise.aim_mm == (2.0, 2.0, 0.2)
    assert model.camera is not None
    assert model.camera.right is not None
    assert model.camera.left.image_size == (640, 480)
    assert model.camera.left.matrix[0, 2] == 320
    assert model.marker is not None
    assert [(tag.id, tag.size_mm) for tag in model.marker.tags] == [(0, 30.0), (3, 12.5)]
    assert_allclose(model.marker.tags[1].marker_T_tag, np.eye(4))
    assert model.board is not None
    assert model.board.charuco is not None
    assert model.board.charuco.marker_mm == 7.0
    assert model.initial_trus_T_camera is not None
    assert_allclose(model.initial_trus_T_camera, session_files.QUARTER, atol=1e-15)
    assert_allclose(model.targets_mm, [[0.0, 0.0, 40.0], [10.0, -5.0, 35.5]])
    assert session.warnings == ()


def test_targets_have_names_or_numbers(tmp_path: Path) -> None:
    def model(targets: object) -> SessionModel:
        return SESSION.read({**setup, "targets": targets})  # type: ignore[no-any-return]

    setup = yaml.safe_load((session_files.write(tmp_path) / "session.yaml").read_text(encoding="utf-8"))
    assert SESSION.read(setup, tmp_path).target_names == ("1", "2")
    del setup["targets_mm"]
    apex, base = {"name": "apex", "trus_p_mm": [0, 0, 45]}, {"name": "base, left", "trus_p_mm": [-15, 8, 30]}
    named = model([apex, base])
    assert named.target_names == ("apex", "base, left")
    assert_allclose(named.targets_mm, [[0, 0, 45], [-15, 8, 30]])
    with pytest.raises(FieldError, match="'apex' again, expected each name once"):
        model([apex, base, apex])


def test_only_what_is_required(tmp_path: Path) -> None:
    text = """
format: fgreg-session/1
probe:
  elements: 64
  pitch_mm: 0.5
  flip: true
  radius_mm: 9
  sound_speed_m_s: 1500
  sensitivity: {depth_mm: [30], half_width_deg: [6], edge_sigma_deg: 0.4}
stage: {step_deg: 1}
"""
    session = read_session(session_files.write(tmp_path / "case-7", text, ""))
    model = session.model
    assert model.name == "case-7"
    assert model.probe.flip is True
    assert math.degrees(model.probe.sensitivity.edge_sigma_rad) == pytest.approx(0.4)
    assert [round(math.degrees(limit), 9) for limit in model.stage.limits_device_rad] == [-60, 60]
    assert (model.stage.direction, model.stage.zero_device_rad) == (1, 0.0)
    assert (model.camera, model.marker, model.board) == (None, None, None)
    assert (model.probe.channels, model.probe.image, model.initial_trus_T_camera) == (None, None, None)
    assert model.noise == NoiseModel()
    assert_allclose(model.targets_mm, default_targets_mm(9.0))
    assert session.events == ()


@pytest.mark.parametrize("key", ["flip: true", "radius_mm: 9", "edge_sigma_deg: 0.4"])
def test_what_the_probe_is_made_of_is_never_guessed(tmp_path: Path, key: str) -> None:
    probe = "{elements: 64, pitch_mm: 0.5, flip: true, radius_mm: 9, sound_speed_m_s: 1500, sensitivity: "
    probe += "{depth_mm: [30], half_width_deg: [6], edge_sigma_deg: 0.4}}"
    text = f"format: fgreg-session/1\nprobe: {probe.replace(key, 'x_other: 1')}\nstage: {{step_deg: 1}}\n"
    with pytest.raises(InputError, match=key.split(":")[0]):
        read_session(session_files.write(tmp_path / "case", text, ""))


def test_every_event(tmp_path: Path) -> None:
    session = read_session(session_files.write(tmp_path))
    events = session.events
    assert [event.line for event in events] == list(range(1, 21))
    assert [event.t for event in events[3:6]] == [3.0, 3.0, 4.0]
    kinds = [NoteEvent, AimEvent, AimEvent, *[PairEvent] * 4, *[TrackEvent] * 3, *[CameraMovedEvent] * 2]
    left_out = [ExcludeEvent, ExcludeEvent, IncludeEvent, PointEvent]
    assert [type(event) for event in events] == [*kinds, RefusedEvent, StageEvent, CheckEvent, CheckEvent, *left_out]
    frames = tmp_path.resolve() / "frames"

    _, spot, corner, posed, framed, both, own = events[:7]
    assert isinstance(spot, AimEvent)
    assert spot.covariance is not None
    assert spot.camera_p_spot_mm is not None
    assert_allclose(spot.camera_p_spot_mm, [1, 2, 150])
    assert_allclose(np.diag(spot.covariance), [1, 1, 0.01])
    assert isinstance(corner, AimEvent)
    assert (corner.corner, corner.camera_p_spot_mm, corner.marker.left) == ((8, 5), None, frames / "a.png")
    assert isinstance(posed, PairEvent)
    assert posed.marker.covariance is not None
    assert posed.marker.camera_T_marker is not None
    assert_allclose(posed.marker.camera_T_marker, session_files.QUARTER, atol=1e-15)
    assert_allclose(np.diag(posed.marker.covariance), [1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.64])
    # Angles of events stay the device's, in degrees.
    assert (posed.trus.scan_deg, posed.trus.x_mm, posed.trus.range_mm) == (-12.0, 3.2, 31.4)
    assert (posed.trus.amplitude, posed.trus.sweep, posed.trus.frame) == (0.8, 1, None)
    assert isinstance(framed, PairEvent)
    assert (framed.marker.left, framed.marker.right) == (frames / "a.png", frames / "b.png")
    assert (framed.trus.frame, framed.trus.x_mm, framed.trus.sweep) == (frames / "c.npy", None, -1)
    assert isinstance(both, PairEvent)
    assert both.pm == 7
    assert both.marker.camera_T_marker is not None
    assert both.marker.left is not None
    assert isinstance(own, PairEvent)
    assert own.trus.covariance is not None
    assert_allclose(np.diag(own.trus.covariance), [0.09, 0.04])

    one, several, none = events[7:10]
    assert isinstance(one, TrackEvent)
    assert isinstance(several, TrackEvent)
    assert isinstance(none, TrackEvent)
    assert [len(track.looks) for track in (one, several, none)] == [1, 2, 0]
    assert none.scan_deg == 3.0
    known, noticed = events[10:12]
    assert isinstance(known, CameraMovedEvent)
    assert known.camera_new_T_camera_old is not None
    assert known.detected is False
    assert isinstance(noticed, CameraMovedEvent)
    assert (noticed.detected, noticed.since_t, noticed.covariance) == (True, 8.5, None)
    refused, stage, place, seen = events[12:16]
    assert isinstance(refused, RefusedEvent)
    assert (refused.event, refused.reason) == ({"type": "pair", "t": 1.0}, "earlier than the last")
    assert refused.refused_line is None
    assert isinstance(stage, StageEvent)
    assert (stage.command, stage.scan_deg, stage.reason) == ("turn", 12.0, "track")
    assert isinstance(place, CheckEvent)
    assert place.camera_p_mm is not None
    assert place.covariance is not None
    assert place.trus_p_mm is not None
    assert place.trus_covariance is not None
    assert_allclose([*place.camera_p_mm, *place.trus_p_mm], [1, 2, 150, 3, 4, 40])
    assert_allclose([*np.diag(place.covariance), *np.diag(place.trus_covariance)], [0.04, 0.04, 0.25, *[0.04] * 3])
    assert (place.left, place.right, place.trus) == (None, None, None)
    assert isinstance(seen, CheckEvent)
    assert seen.left is not None
    assert seen.right is not None
    assert seen.trus is not None
    assert_allclose([*seen.left, *seen.right], [330, 250.5, 300, 250.5])
    assert (seen.trus.scan_deg, seen.trus.x_mm, seen.trus.range_mm) == (4.0, 1.0, 30.0)


def test_names_that_start_with_x_are_the_users_own_at_every_level(tmp_path: Path) -> None:
    setup = session_files.setup()
    for mapping in (
        setup,
        setup["probe"],
        setup["probe"]["sensitivity"],
        setup["probe"]["sensitivity"]["curve"],
        setup["probe"]["channels"],
        setup["probe"]["image"],
        setup["stage"],
        setup["camera"],
        setup["camera"]["left"],
        setup["marker"],
        setup["marker"]["tags"][1],
        setup["board"],
        setup["board"]["charuco"],
        setup["noise"],
        setup["initial"],
    ):
        mapping["x_mine"] = {"anything": [1, "b", None]}
    events = session_files.events()
    for event in events:
        event["x_operator"] = None
        for inner in [event.get("marker"), event.get("trus"), *event.get("looks", [])]:
            if inner is not None:
                inner["x_note"] = [1]
    assert len(read_session(session_files.write(tmp_path, setup, events)).events) == len(events)


def test_rotations_from_files_are_made_exactly_rigid(tmp_path: Path) -> None:
    rounded: list[list[float]] = [[0.8660, -0.5, 0, 1], [0.5, 0.8660, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    setup = session_files.setup()
    setup["initial"]["trus_T_camera"] = rounded
    transform = read_session(session_files.write(tmp_path, setup)).model.initial_trus_T_camera
    assert transform is not None
    assert_allclose(transform[:3, :3].T @ transform[:3, :3], np.eye(3), atol=1e-15)
    assert_allclose(transform, rounded, atol=1e-4)


@pytest.mark.parametrize("written", ["5e-1", ".5", "+0.5", "5.0E-01", "0.5e0"])
def test_numbers_as_any_program_writes_them(tmp_path: Path, written: str) -> None:
    text = json.dumps(session_files.setup()).replace('"pitch_mm": 0.43', f'"pitch_mm": {written}')
    assert read_session(session_files.write(tmp_path, text)).model.probe.pitch_mm == 0.5


@pytest.mark.parametrize("name", ["1e5", "7E12", "-.5", "12e4"])
def test_names_that_some_writers_leave_unquoted_though_they_look_like_numbers(tmp_path: Path, name: str) -> None:
    setup = {**session_files.setup(), "name": name}
    assert f"name: {name}\n" in yaml.safe_dump(setup)
    assert read_session(session_files.write(tmp_path, setup)).model.name == name


def test_aliases_stand_for_what_they_repeat(tmp_path: Path) -> None:
    text = json.dumps(session_files.setup()).replace('"left": {', '"left": &camera {', 1)
    at = text.index('"right": {')
    text = text[:at] + '"right": *camera ' + text[text.index("}", at) + 1 :]
    camera = read_session(session_files.write(tmp_path, text)).model.camera
    assert camera is not None
    assert camera.right is not None
    assert_allclose(camera.right.matrix, camera.left.matrix)


def test_a_byte_order_mark_and_windows_line_ends_are_tolerated(tmp_path: Path) -> None:
    folder = session_files.write(tmp_path)
    for name in ("session.yaml", "events.jsonl"):
        path = folder / name
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    session = read_session(folder)
    assert len(session.events) == 20
    assert session.warnings == ()


@pytest.mark.parametrize(
    "rest",
    [b'{"type": "pai', b'{"type": "note", "t": 11, "text": "\xc3', b'{"type": "note", "t": 1', b"\0\0\0\0", b"  "],
)
def test_a_last_line_cut_short_is_dropped_with_a_warning(tmp_path: Path, rest: bytes) -> None:
    folder = session_files.write(tmp_path)
    with (folder / "events.jsonl").open("ab") as file:
        file.write(rest)
    session = read_session(folder)
    assert len(session.events) == 20
    assert len(session.warnings) == 1
    assert "line 21" in session.warnings[0]


def test_a_whole_last_line_without_its_line_end_counts(tmp_path: Path) -> None:
    folder = session_files.write(tmp_path)
    path = folder / "events.jsonl"
    path.write_bytes(path.read_bytes().rstrip(b"\n"))
    session = read_session(folder)
    assert (len(session.events), session.warnings) == (20, ())


def test_every_cut_of_the_log_reads(tmp_path: Path) -> None:
    """Wherever the power failed, the events before the cut are there."""
    path = session_files.write(tmp_path) / "events.jsonl"
    whole = path.read_bytes()
    for cut in range(0, len(whole), 29):
        path.write_bytes(whole[:cut])
        complete = whole[:cut].count(b"\n") + (whole[cut : cut + 1] == b"\n")
        assert len(read_session(tmp_path).events) == complete


def test_warnings_for_implausible_values(tmp_path: Path) -> None:
    setup = session_files.setup()
    setup["probe"]["sound_speed_m_s"] = 1.54
    setup["camera"]["left"]["matrix"][0][2] = 3200
    setup["board"]["charuco"]["dictionary"] = "DICT_4X4_50"
    setup["stage"]["limits_deg"] = [-10, 60]
    warnings = read_session(session_files.write(tmp_path, setup)).warnings
    for words in ("1.54", "outside 640 x 480", "share ids", "line 4 and 4 more: scan_deg is outside"):
        assert any(words in warning for warning in warnings), words
    assert len(warnings) == 4


def test_ground_truth(tmp_path: Path) -> None:
    folder = session_files.write(tmp_path)
    assert read_ground_truth(folder) is None
    (folder / "ground_truth.yaml").write_text(yaml.safe_dump(session_files.truth()))
    truth = read_ground_truth(folder)
    assert truth is not None
    assert len(truth.trus_T_camera) == 2
    assert_allclose(truth.trus_T_camera[0], session_files.QUARTER, atol=1e-15)
    assert sorted(truth.trus_p_pm_mm) == [0, 7]
    assert_allclose(truth.trus_p_pm_mm[7], [0, -4, 35])
    assert [(track.t, round(track.stage_rad, 9)) for track in truth.tracks] == [(6.0, 0.314159265)]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "trus_T_camera: [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
            "trus_T_camera[0] (line 1): found 1 as row 0, expected 4 lists of 4 numbers",
        ),
        ("pms: {-1: [0, 0, 0]}", "pms.-1 (line 1): found the PM '-1'"),
        ("pms:\n  0: [0, 0]", "pms.0 (line 2): found [0, 0], expected a list of 3 numbers"),
        ("tracks: [{t: 1}]", "tracks[0].stage_deg (line 1): found nothing"),
        ("pm: {}", "pm (line 1): found an unknown key, expected a known one (did you mean pms?)"),
    ],
)
def test_bad_ground_truth(tmp_path: Path, text: str, words: str) -> None:
    (session_files.write(tmp_path) / "ground_truth.yaml").write_text(text)
    with pytest.raises(InputError) as caught:
        read_ground_truth(tmp_path)
    assert str(caught.value).startswith("ground_truth.yaml: " + words)


def test_a_fisheye_lens_is_written_and_read() -> None:
    matrix = as_float_array([[600.0, 0.0, 640.0], [0.0, 605.0, 360.0], [0.0, 0.0, 1.0]])
    left = CameraModel((1280, 720), matrix, as_float_array([0.1, -0.05, 0.01, 0.002]), fisheye=True)
    right = CameraModel((1280, 720), matrix, as_float_array([-0.1, 0.06, 0.0, 0.0, 0.0, 0.02, 0.0, 0.0]))
    shift = as_float_array([[1.0, 0.0, 0.0, -5.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    written = STEREO_RIG.write(StereoRig(left, right, shift))
    assert written["left"]["model"] == "fisheye"
    assert "model" not in written["right"]
    rig = STEREO_RIG.read(written)
    assert rig.left.fisheye
    assert not rig.right.fisheye
    assert np.array_equal(rig.right.distortion, right.distortion)
