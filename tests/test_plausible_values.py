"""Values that no rig has: a warning with the unit that was probably meant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgreg.errors import InputError
from fgreg.model.plausible import RADIUS, WINDOW, implausible_distances, implausible_setup
from fgreg.model.session_model import SESSION
from fgreg.session.session_reader import check_session, read_session
from tests import session_files


def changed(path: str, value: Any) -> dict[str, Any]:
    """The usual ``session.yaml`` with another value at a dotted path."""
    setup = session_files.setup()
    session_files.change(setup, path, value)
    return setup


def test_usual_values_are_not_doubted(tmp_path: Path) -> None:
    assert read_session(session_files.write(tmp_path)).warnings == ()


@pytest.mark.parametrize("folder", ["paper", "phantom"])
def test_the_sessions_in_the_repository_are_not_doubted(folder: str) -> None:
    assert read_session(Path(__file__).parent.parent / "sessions" / folder).warnings == ()


def test_the_likely_unit_is_named() -> None:
    assert RADIUS.doubt("probe.radius_mm", 0.01) == [
        "probe.radius_mm: 0.01 mm is hardly a probe's radius (1 to 50 mm); in metres it would be 10 mm"
    ]
    assert RADIUS.doubt("probe.radius_mm", 9000.0)[0].endswith("in micrometres it would be 9 mm")
    assert WINDOW.doubt("half_width_deg", 0.10472)[0].endswith("in radians it would be 6 deg")
    assert RADIUS.doubt("probe.radius_mm", 600.0) == ["probe.radius_mm: 600 mm is hardly a probe's radius (1 to 50 mm)"]
    assert RADIUS.doubt("probe.radius_mm", 10.0) == []


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("probe.radius_mm", 0.01, "in metres it would be 10 mm"),
        ("probe.pitch_mm", 0.0043, "probe.pitch_mm: 0.0043 mm is hardly"),
        ("probe.sound_speed_m_s", 1.54, "in mm/us it would be 1540 m/s"),
        ("probe.sensitivity.half_width_deg", [0.105, 0.12, 0.14], "in radians it would be 6.016 deg"),
        ("probe.sensitivity.depth_mm", [0.02, 0.03, 0.045], "in metres it would be 45 mm"),
        ("probe.channels.sampling_mhz", 0.2, "probe.channels.sampling_mhz: 0.2 MHz is hardly a sampling rate"),
        ("probe.channels.t0_us", 13000.0, "in ns it would be 13 us"),
        ("stage.limits_deg", [-1.05, 1.05], "stage.limits_deg: 2.1 deg is hardly the travel"),
        ("camera.left.matrix.0.0", 4.0, "camera.left.matrix: 0.00625 is hardly a focal length"),
        ("camera.right_T_left.0.3", -0.005, "in metres it would be 5 mm"),
        ("marker.tags.0.size_mm", 0.03, "in metres it would be 30 mm"),
        ("board.square_mm", 300.0, "board.square_mm: 300 mm is hardly a square"),
        ("noise.marker_rotation_rad", [0.5, 0.5, 0.6], "in degrees it would be 0.01047 rad"),
        ("systematic", {"sound_speed": 1.0}, "in per cent it would be 0.01"),
        ("targets_mm", [[0, 0, 0.04]], "in metres it would be 40 mm"),
    ],
)
def test_each_kind_of_value(path: str, value: Any, words: str) -> None:
    setup = changed(path, value)
    doubts = implausible_setup(SESSION.read(setup))
    assert len(doubts) == 1, doubts
    assert words in doubts[0]


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("probe.pitch_mm", 0.00043, "expected a number >= 0.001 and <= 100 mm (in metres it would be 0.43 mm)"),
        ("probe.channels.sampling_mhz", 40_000_000, "(in Hz it would be 40 MHz)"),
    ],
)
def test_an_error_names_the_likely_unit_too(tmp_path: Path, path: str, value: Any, words: str) -> None:
    with pytest.raises(InputError) as found:
        read_session(session_files.write(tmp_path, changed(path, value)))
    assert words in str(found.value)


def test_other_errors_do_not_hide_a_doubt(tmp_path: Path) -> None:
    setup = changed("probe.radius_mm", 0.01)
    setup["stage"]["step_deg"] = -1
    problems, warnings = check_session(session_files.write(tmp_path, setup))
    assert problems
    assert [w for w in warnings if "in metres it would be 10 mm" in w]


def test_poses_and_ranges_in_metres(tmp_path: Path) -> None:
    events = session_files.events()
    for event in events:
        for row in range(3):
            if "camera_T_marker" in event.get("marker", {}):
                event["marker"]["camera_T_marker"][row][3] *= 0.001
        if event["type"] == "pair" and "range_mm" in event["trus"]:
            event["trus"]["range_mm"] *= 0.001
    warnings = read_session(session_files.write(tmp_path, None, events)).warnings
    assert len(warnings) == 2
    assert "median of camera_T_marker" in warnings[0]
    assert "in metres it would be" in warnings[0]
    assert "median of range_mm: 0.0314 mm is hardly the range of a PM" in warnings[1]


def test_poses_behind_the_camera_are_doubted() -> None:
    ahead, behind = np.eye(4), np.eye(4)
    ahead[2, 3], behind[2, 3] = 120.0, -120.0
    assert implausible_distances([ahead] * 3, [], []) == ()
    (found,) = implausible_distances([ahead, behind], [], [])
    assert "1 of 2 marker poses lie behind the camera" in found
