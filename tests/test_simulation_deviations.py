"""A lab that is not as declared: each deviation against numbers that are worked out here."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from fgreg.cli.main import app
from fgreg.errors import InputError
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, as_float_array, exp_so3, inverse, log_so3, make_transform
from fgreg.model.camera_dependence import nominal_pose_gain
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.session_model import NoiseModel, TagModel
from fgreg.model.systematic import NONE, Systematic
from fgreg.session.session_reader import read_session
from fgreg.simulation.array import TrueArray
from fgreg.simulation.config import SimulationConfig, Sweep, default_probe, default_rig
from fgreg.simulation.deviations import deviations_of, drawn_deviations, named, with_deviations
from fgreg.simulation.misreading import marker_poses_read, points_read, spots_read, true_rig
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.scene import refraction_mm
from fgreg.simulation.simulate import SimulatedSession, simulate
from fgreg.simulation.write import write_session

EDGE = {Constant.WINDOW_EDGE: 0.0}
QUIET = NoiseModel((0, 0, 0), (0, 0, 0), 0.0, (0, 0, 0), 0.0, 0.0, 0.0)
POINT = np.array([5.0, 0.0, 40.0])
AHEAD = np.zeros(())


def quiet(off: dict[Constant, float] | None = None, **changes: Any) -> SimulationConfig:
    return SimulationConfig(noise=QUIET, declared_noise=NoiseModel(), deviations=EDGE | (off or {}), **changes)


def pairs(simulated: SimulatedSession) -> list[tuple[FloatArray, dict[str, Any]]]:
    """PM and look of each pair."""
    pms = simulated.truth["pms"]
    return [(np.array(pms[e["pm"]]), e["trus"]) for e in simulated.events if e["type"] == "pair"]


def array(**off: float) -> TrueArray:
    return TrueArray.of(default_probe(), {Constant[name]: value for name, value in off.items()})


def measured(of: TrueArray, p: FloatArray) -> tuple[float, float, float]:
    """x, range and the angle at which the plane passes, at stage angle 0."""
    return float(of.x_mm(p, AHEAD)), float(of.range_mm(p, AHEAD)), float(of.plane_angle_rad(p))


# --- probe and stage ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("off", "p", "expected"),
    [
        ({}, POINT, (5.0, 30.0, 0.0)),
        ({"RADIUS": 1.0}, POINT, (5.0, 29.0, 0.0)),
        ({"RANGE_OFFSET": 1.0}, POINT, (5.0, 29.0, 0.0)),
        ({"SOUND_SPEED": 0.02}, POINT, (5.0, 30.0 / 1.02, 0.0)),
        ({"RANGE_OFFSET": 1.0, "SOUND_SPEED": 0.02}, POINT, (5.0, 29.0 / 1.02, 0.0)),
        ({"PITCH": 0.01}, POINT, (5.0 / 1.01, 30.0, 0.0)),
        ({"ARRAY_OFFSET": 3.0}, [5.0, 3.0, 40.0], (5.0, 30.0, 0.0)),
        ({"ARRAY_OFFSET": 3.0}, POINT, (5.0, math.sqrt(909.0), -math.asin(3.0 / 40.0))),
        # The array's direction is (0.8, 0, 0.6): 0.8 * 5 + 0.6 * 30 along it.
        ({"TILT_IN_PLANE": math.asin(0.6)}, POINT, (22.0, abs(-0.6 * 5.0 + 0.8 * 30.0), 0.0)),
        # (0.8, 0.6, 0): the plane at stage angle s has y / x = 0.75 there; the point's y is -40 sin s.
        ({"TILT_RADIAL": math.asin(0.6)}, POINT, (4.0, math.hypot(3.0, 30.0), -math.asin(3.75 / 40.0))),
        # The plane's direction is (0, 0.6, 0.8): 30 along it from the array is (0, 18, 10 + 24).
        ({"TILT_ELEVATION": math.asin(0.6)}, [5.0, 18.0, 34.0], (5.0, 30.0, 0.0)),
    ],
)
def test_array_measures_from_where_it_is(
    off: dict[str, float], p: list[float], expected: tuple[float, float, float]
) -> None:
    np.testing.assert_allclose(measured(array(**off), np.array(p)), expected, atol=1e-9)


def test_array_turns_with_the_stage() -> None:
    tilted = array(RADIUS=0.7, ARRAY_OFFSET=-0.4, TILT_IN_PLANE=0.02, TILT_RADIAL=-0.03, TILT_ELEVATION=0.01)
    rng = np.random.default_rng(1)
    for _ in range(20):
        p = np.array([*rng.uniform(-20.0, 20.0, 2), rng.uniform(30.0, 45.0)])
        scan = rng.uniform(-0.6, 0.6)
        turned = exp_so3(np.array([scan, 0.0, 0.0])) @ p  # takes (y, z) = (sin t, cos t) to (0, 1)
        np.testing.assert_allclose(tilted.x_mm(p, np.asarray(scan)), tilted.x_mm(turned, AHEAD), atol=1e-9)
        np.testing.assert_allclose(tilted.range_mm(p, np.asarray(scan)), tilted.range_mm(turned, AHEAD), atol=1e-9)
        # In the plane it is nowhere beside it: along the array's normal the distance is nil.
        there = float(tilted.plane_angle_rad(p))
        seen = exp_so3(np.array([there, 0.0, 0.0])) @ p - [0.0, -0.4, 10.7]
        assert abs(tilted.trus_R_array[:, 1] @ seen) < 1e-9


def test_small_tilts_add_up_to_the_first_order() -> None:
    # docs/model.md: q = A' q0 = q0 + q0 x w for w = (-elevation, -in plane, +radial).
    w = np.array([-3e-4, -2e-4, 1e-4])
    tilted = array(TILT_ELEVATION=3e-4, TILT_IN_PLANE=2e-4, TILT_RADIAL=1e-4)
    q0 = np.array([7.0, 4.0, 25.0])
    q = q0 + np.cross(q0, w)
    np.testing.assert_allclose(tilted.trus_R_array.T @ q0, q, atol=1e-5)
    p = q0 + np.array([0.0, 0.0, 10.0])
    assert float(tilted.x_mm(p, AHEAD)) == pytest.approx(q[0], abs=1e-5)
    assert float(tilted.range_mm(p, AHEAD)) == pytest.approx(math.hypot(q[1], q[2]), abs=1e-5)


def test_radius_makes_every_range_of_a_session_shorter() -> None:
    for p, trus in pairs(simulate(quiet({Constant.RADIUS: 1.0}), 3)):
        a = math.radians(trus["scan_deg"])
        expected = math.hypot(p[1] - 11.0 * math.sin(a), p[2] - 11.0 * math.cos(a))
        assert trus["range_mm"] == pytest.approx(expected, abs=1e-3)
        assert trus["x_mm"] == pytest.approx(p[0], abs=1e-4)


def ahead_deg(simulated: SimulatedSession) -> dict[int, FloatArray]:
    """By sweep: how far ahead of the reading the PM is at the first hits."""
    out: dict[int, list[float]] = {1: [], -1: []}
    for p, trus in pairs(simulated):
        out[trus["sweep"]].append(trus["sweep"] * (math.degrees(math.atan2(p[1], p[2])) - trus["scan_deg"]))
    return {sweep: np.array(values) for sweep, values in out.items()}


@pytest.mark.parametrize(
    ("off", "up", "down"),
    [
        ({}, (4.0, 6.0), (4.0, 6.0)),
        ({Constant.WINDOW_CENTRE: math.radians(1.0)}, (5.0, 7.0), (3.0, 5.0)),  # +7/-5 instead of +-6
        ({Constant.WINDOW_EDGE: math.radians(0.5)}, (4.5, 6.5), (4.5, 6.5)),
        ({Constant.BACKLASH: math.radians(0.5)}, (3.5, 5.5), (3.5, 5.5)),  # the reading is ahead of the plane
    ],
)
def test_first_hits_are_where_window_and_stage_have_them(
    off: dict[Constant, float], up: tuple[float, float], down: tuple[float, float]
) -> None:
    found = ahead_deg(simulate(quiet(off, pairs=60), 1))
    for sweep, (low, high) in ((1, up), (-1, down)):
        assert low - 0.01 < found[sweep].min() < low + 0.5
        assert high - 0.5 < found[sweep].max() < high + 0.01


def test_backlash_and_slip_leave_the_plane_behind_its_reading() -> None:
    config = quiet({Constant.BACKLASH: math.radians(0.5)}, stage_slip_rad=math.radians(2.0), pairs=10)
    for number, (p, trus) in enumerate(pairs(simulate(config, 2))):
        scan = math.radians(trus["scan_deg"] - 0.5 * trus["sweep"] - (2.0 if number >= 5 else 0.0))
        expected = math.hypot(p[1] - 10.0 * math.sin(scan), p[2] - 10.0 * math.cos(scan))
        assert trus["range_mm"] == pytest.approx(expected, abs=1e-3)


def test_slip_moves_what_the_stage_has_to_read_for_a_track() -> None:
    plain, slipped = (
        simulate(quiet(tracks_silent=1, stage_slip_rad=math.radians(a)), 2).truth["tracks"][0] for a in (0.0, 2.0)
    )
    assert slipped["stage_deg"] - plain["stage_deg"] == pytest.approx(2.0)


def test_backlash_without_a_known_sweep_is_to_either_side() -> None:
    config = quiet(sweep=Sweep.WINDOW, pairs=40)
    plain, loose = (simulate(replace(config, deviations=EDGE | {Constant.BACKLASH: b}), 2) for b in (0.0, 0.01))
    gap = [b["scan_deg"] - a["scan_deg"] for (_, a), (_, b) in zip(pairs(plain), pairs(loose), strict=True)]
    np.testing.assert_allclose(np.abs(gap), math.degrees(0.01), atol=1e-3)
    assert 8 < np.sum(np.array(gap) > 0) < 32


def test_window_varies_from_pm_to_pm() -> None:
    found = ahead_deg(simulate(quiet(edge_jitter_rad=math.radians(0.4), pairs=400), 1))
    # Uniform between 4 and 6, and Gaussian.
    assert np.concatenate(list(found.values())).std() == pytest.approx(math.hypot(1.0 / math.sqrt(3.0), 0.4), rel=0.08)


def test_two_sided_looks_detect_each_pm_from_both_sides() -> None:
    simulated = simulate(quiet(sweep=Sweep.TWO_SIDED, pairs=8, tracks_heard=1), 1)
    looks = pairs(simulated)
    assert [trus["sweep"] for _, trus in looks] == [1, -1, -1, 1] * 4
    found = ahead_deg(simulated)
    assert all(((f > 4.0 - 1e-3) & (f < 6.0 + 1e-3)).all() for f in found.values())
    markers = [e["marker"] for e in simulated.events if e["type"] == "pair"]
    assert markers[0] == markers[1]
    assert sum("trus" in e for e in simulated.events if e["type"] == "track") == 1


# --- beam and camera ------------------------------------------------------------------------------------------------


def beside_mm(simulated: SimulatedSession) -> FloatArray:
    """(n, 2) where PMs are beside their beam, in the laser's axes."""
    out = []
    for i, event in enumerate(simulated.events):
        if event["type"] == "pair":
            beam = simulated.scene.trus_T_camera[0] @ simulated.true_camera_T_marker[i] @ simulated.scene.marker_T_laser
            out.append((inverse(beam) @ [*simulated.truth["pms"][event["pm"]], 1.0])[:2])
    return np.array(out)


def test_pms_lie_beside_their_beams() -> None:
    off = np.concatenate([beside_mm(simulate(quiet(beam_offset_mm=0.15, pairs=60), seed)) for seed in range(5)])
    np.testing.assert_allclose(off.std(axis=0), 0.15, rtol=0.1)
    assert np.abs(beside_mm(simulate(quiet(), 1))).max() < 1e-6


def test_water_bends_beams() -> None:
    # 30 deg in air, 22.08 in water: the straight beam passes 10 (1 - tan 22.08 / tan 30) above the point hit.
    for degrees, above in ((30.0, 2.9731), (0.5, 10.0 * (1.0 - 1.0 / 1.33))):
        a = math.radians(degrees)
        direction = np.array([math.sin(a), 0.0, -math.cos(a)])
        past = refraction_mm(direction, 10.0, 1.33)
        over = past - past[0] / direction[0] * direction
        np.testing.assert_allclose(over, [0.0, 0.0, above], atol=2e-3)
    np.testing.assert_array_equal(refraction_mm(direction, 0.0, 1.33), 0.0)


def test_sessions_in_water_have_the_same_pms_beneath_their_beams() -> None:
    dry, wet = simulate(quiet(), 2), simulate(quiet(water_mm=10.0), 2)
    assert wet.session == dry.session
    for i, event in enumerate(wet.events):
        if event["type"] != "pair":
            continue
        beam = wet.scene.trus_T_camera[0] @ wet.true_camera_T_marker[i] @ wet.scene.marker_T_laser
        p, d = np.array(wet.truth["pms"][event["pm"]]), beam[:3, 2]
        gap = beam[:3, 3] - p
        over = gap - (gap[:2] @ d[:2]) / (d[:2] @ d[:2]) * d
        np.testing.assert_allclose(over[:2], 0.0, atol=1e-6)  # bent in the plane of incidence
        assert 2.4 < over[2] < 5.0


def test_camera_jumps_without_a_word() -> None:
    config = quiet(pairs=10, epochs=2, camera_move_mm=3.0, camera_moves_reported=False)
    simulated = simulate(config, 4)
    move = simulated.scene.camera_moves[0]
    np.testing.assert_array_equal(move[:3, :3], np.eye(3))
    assert np.linalg.norm(move[:3, 3]) == pytest.approx(3.0)
    assert not any(e["type"] == "camera_moved" for e in simulated.events)
    assert len(simulated.truth["trus_T_camera"]) == 2
    reported = simulate(replace(config, camera_moves_reported=True), 4)
    moves = [i for i, e in enumerate(reported.events) if e["type"] == "camera_moved"]
    assert moves == [12 + 5]
    assert reported.truth["pms"] == simulated.truth["pms"]


def simple_rig(width: int = 1280, both: bool = True) -> StereoRig:
    """Focal length 1,000 px, 5 mm apart, parallel, no distortion."""
    matrix = as_float_array([[1000.0, 0.0, 640.0], [0.0, 1000.0, 360.0], [0.0, 0.0, 1.0]])
    camera = CameraModel((width, 720), matrix, as_float_array(np.zeros(5)))
    right_T_left = make_transform(np.eye(3), np.array([-5.0, 0.0, 0.0]))
    return StereoRig(camera, camera, as_float_array(right_T_left)) if both else StereoRig(camera)


def undistorted(rig: StereoRig) -> StereoRig:
    assert rig.right is not None
    left, right = (replace(c, distortion=as_float_array(np.zeros(5))) for c in (rig.left, rig.right))
    return replace(rig, left=left, right=right)


ANGLE = math.radians(0.2)


@pytest.mark.parametrize(
    ("off", "expected"),
    [
        ({"FOCAL_LEFT": 0.01, "FOCAL_RIGHT": 0.01}, [10.0, 0.0, 100.0 / 1.01]),  # u and disparity grow alike
        ({"CENTRE_LEFT_X": 5.0, "CENTRE_RIGHT_X": 5.0}, [10.5, 0.0, 100.0]),
        ({"CENTRE_LEFT_Y": 5.0, "CENTRE_RIGHT_Y": 5.0}, [10.0, 0.5, 100.0]),
        ({"CENTRE_RIGHT_X": -1.0}, [1000.0 / 102.0, 0.0, 5000.0 / 51.0]),  # u 100, disparity 51 instead of 50 px
        ({"CAMERA_SCALE": 0.02}, [10.0 / 1.02, 0.0, 100.0 / 1.02]),
        ({"STEREO_TRANSLATION_X": 0.05}, [10.0 * 5.0 / 4.95, 0.0, 100.0 * 5.0 / 4.95]),
    ],
)
def test_points_are_triangulated_by_the_declared_rig(off: dict[str, float], expected: list[float]) -> None:
    off = {Constant[name]: value for name, value in off.items()}  # type: ignore[misc]
    config = quiet(off, camera=simple_rig(), camera_declared=True)  # type: ignore[arg-type]
    np.testing.assert_allclose(points_read(config, np.array([[10.0, 0.0, 100.0]])), [expected], atol=1e-6)


def test_points_are_triangulated_where_the_views_miss_each_other_by_pixels() -> None:
    config = quiet({Constant.STEREO_ROTATION_X: 0.003}, camera=simple_rig(), camera_declared=True)
    grid = np.stack(np.meshgrid([-25.0, 0.0, 25.0], [-25.0, 0.0, 25.0], [110.0, 150.0]), axis=-1).reshape(-1, 3)
    read = points_read(config, grid)
    # The right view's rows are 3 px off, and half of that is between the two; the depth hardly changes.
    rows = 1000.0 * (read[:, 1] / read[:, 2] - grid[:, 1] / grid[:, 2])
    np.testing.assert_allclose(rows, -1.5, atol=0.1)
    np.testing.assert_allclose(read[:, 2], grid[:, 2], atol=0.6)


def test_turned_right_camera_changes_the_disparity() -> None:
    # (0, 0, 100) is at (100 sin a - 5, 0, 100 cos a) in the right camera.
    config = quiet({Constant.STEREO_ROTATION_Y: ANGLE}, camera=simple_rig(), camera_declared=True)
    disparity = -1000.0 * (100.0 * math.sin(ANGLE) - 5.0) / (100.0 * math.cos(ANGLE))
    np.testing.assert_allclose(
        points_read(config, np.array([[0.0, 0.0, 100.0]])), [[0.0, 0.0, 5000.0 / disparity]], atol=1e-6
    )


def facing(z_mm: float = 100.0, lean_rad: float = 0.0) -> FloatArray:
    """(1, 4, 4) a marker before the camera, its face turned to it."""
    turn = np.diag([1.0, -1.0, -1.0]) @ exp_so3(np.array([lean_rad, 0.0, 0.0]))
    return make_transform(turn, np.array([3.0, -2.0, z_mm]))[None]


def test_small_print_seems_far_away() -> None:
    for camera in (simple_rig(both=False), default_rig()):
        # Of a pair of cameras the distance between them is as wrong, so that both agree.
        off = {Constant.TAG_SIZE: -0.03, Constant.BOARD_SIZE: -0.03, Constant.CAMERA_SCALE: -0.03}
        config = quiet(off, camera=camera, camera_declared=True)
        true = facing(lean_rad=0.4)
        read = marker_poses_read(config, true)
        np.testing.assert_allclose(read[0, :3, 3], true[0, :3, 3] / 0.97, rtol=1e-7)
        np.testing.assert_allclose(read[0, :3, :3], true[0, :3, :3], atol=1e-8)
        # A stereo pair is as wrong in all lengths: spots, by a board as wrong, as well.
        board = make_transform(exp_so3(np.array([0.1, -0.2, 0.1])), np.array([-36.0, -22.0, 130.0]))[None]
        corner = np.array([[3, 2]])
        spot = board[0, :3, :3] @ [27.0 * 0.97, 18.0 * 0.97, 0.0] + board[0, :3, 3]
        np.testing.assert_allclose(spots_read(config, spot[None], board, corner)[0], spot / 0.97, rtol=1e-6)


def test_stereo_and_print_meet_between_where_they_disagree() -> None:
    alone = quiet({Constant.TAG_SIZE: -0.03}, camera=simple_rig(), camera_declared=True)
    z = marker_poses_read(alone, facing())[0, 2, 3]
    # The size of 25 mm speaks for 103.09 mm; the 5 mm between the cameras, for 100: nearly all weight is the print's.
    assert 102.5 < z < 100.0 / 0.97


def test_long_lens_seems_near() -> None:
    config = quiet({Constant.FOCAL_LEFT: 0.01}, camera=simple_rig(both=False), camera_declared=True)
    true = facing()
    read = marker_poses_read(config, true)[0, :3, 3]
    # Magnified about the axis: x / z and y / z grow by 1.01, as does 1 / z.
    np.testing.assert_allclose(read, [3.0, -2.0, 100.0 / 1.01], atol=0.02)


def test_without_a_camera_lengths_are_scaled() -> None:
    true = facing()
    p = true[:, :3, 3]
    for off, tag, spot in (
        ({Constant.CAMERA_SCALE: 0.01}, p / 1.01, p / 1.01),
        ({Constant.TAG_SIZE: -0.03}, p / 0.97, p),
        ({Constant.FOCAL_LEFT: 0.01, Constant.FOCAL_RIGHT: 0.01}, p / [1.0, 1.0, 1.01], p / [1.0, 1.0, 1.01]),
    ):
        config = quiet(off)
        np.testing.assert_allclose(marker_poses_read(config, true)[:, :3, 3], tag)
        np.testing.assert_allclose(spots_read(config, p, true, np.zeros((1, 2), dtype=np.int64)), spot)
        np.testing.assert_allclose(points_read(config, p), spot)


def test_view_bias_is_along_the_normal_across_the_sight() -> None:
    true = make_transform(facing(lean_rad=math.radians(30.0))[0, :3, :3], np.array([0.0, 0.0, 100.0]))[None]
    normal = true[0, :3, 2]
    assert math.acos(-normal[2]) == pytest.approx(math.radians(30.0))
    for camera in (False, True):
        read = marker_poses_read(quiet({Constant.VIEW_BIAS: 0.2}, camera_declared=camera), true)
        shift = read[0, :3, 3] - true[0, :3, 3]
        np.testing.assert_allclose(shift, [0.0, 0.2 * normal[1], 0.0], atol=1e-6)
        assert np.linalg.norm(shift) == pytest.approx(0.2 * 0.5, abs=1e-6)


def test_poses_of_a_session_carry_what_the_camera_misreads() -> None:
    config = quiet({Constant.TAG_SIZE: -0.03}, pairs=4, aims=3, camera_declared=True)
    simulated = simulate(config, 1)
    assert simulated.session["marker"]["tags"][0]["size_mm"] == 25.0
    for i, true in simulated.true_camera_T_marker.items():
        read = np.array(simulated.events[i]["marker"]["camera_T_marker"])
        assert read[2, 3] / true[2, 3] == pytest.approx(1.0 / 0.97, abs=0.006)
        assert np.linalg.norm(log_so3(read[:3, :3] @ true[:3, :3].T)) < 0.02


@pytest.mark.parametrize("camera", [False, True])
def test_estimator_moves_poses_back_to_where_they_were(camera: bool, tmp_path: Path) -> None:
    # Two derivations of one thing: solved again by the declared rig, and linearised.
    config = quiet(pairs=3, aims=3, camera_declared=camera)
    simulated = simulate(config, 1)
    write_session(simulated, tmp_path / "s")
    model = read_session(tmp_path / "s").model
    true = np.stack(list(simulated.true_camera_T_marker.values()))
    sigmas = Systematic().sigmas(0.0, 0.0)
    for constant in list(Constant)[Constant.CAMERA_SCALE :]:
        off = 0.3 * float(sigmas[constant])
        read = marker_poses_read(replace(config, deviations={constant: off}), true)
        turn = log_so3(true[:, :3, :3] @ np.swapaxes(read[:, :3, :3], 1, 2))
        needed = np.concatenate([100.0 * turn, true[:, :3, 3] - read[:, :3, 3]], axis=1)  # turns at 100 mm
        gain = nominal_pose_gain(model, read)[:, :, constant - Constant.MARKER_BIAS_X] * off
        gain[:, :3] *= 100.0
        np.testing.assert_allclose(gain, needed, atol=max(0.01 * np.abs(needed).max(), 1e-6), err_msg=constant.name)


def test_marker_bias_is_fixed_where_it_is_given() -> None:
    simulated = simulate(quiet({Constant.MARKER_BIAS_Y: 0.4}, pairs=2, aims=2), 1)
    for i, true in simulated.true_camera_T_marker.items():
        read = np.array(simulated.events[i]["marker"]["camera_T_marker"])
        np.testing.assert_allclose(read[:3, 3] - true[:3, 3], [0.0, 0.4, 0.0], atol=1e-6)


# --- frames ---------------------------------------------------------------------------------------------------------


def frames_of(config: SimulationConfig) -> dict[str, Any]:
    simulated = simulate(replace(config, aims=1, pairs=1, tracks_heard=0, tracks_silent=0), 4)
    return {name: frame() for name, frame in simulated.frames.items()}


def test_frames_show_the_true_rig_and_prints() -> None:
    small = PRESETS["raw-small"]
    off = {Constant.TAG_SIZE: -0.03, Constant.BOARD_SIZE: -0.02, Constant.CENTRE_RIGHT_X: 3.0}
    off |= {Constant.FOCAL_LEFT: 0.01, Constant.CAMERA_SCALE: 0.01, Constant.STEREO_ROTATION_Z: 0.01}
    deviant = replace(small, deviations=off)
    real = replace(
        small,
        camera=true_rig(deviant),
        marker=replace(small.marker, tags=(TagModel(0, 0.97 * 25.0),)),
        board=replace(small.board, square_mm=0.98 * 13.0, charuco=replace(small.board.charuco, marker_mm=0.98 * 9.75)),  # type: ignore[type-var]
    )
    found = simulate(replace(deviant, aims=1, pairs=1), 4)
    made = replace(found, config=real)
    for name in ("frames/aim-00-left.png", "frames/aim-00-right.png", "frames/pm-00-right.png"):
        picture = found.frames[name].func.__self__  # type: ignore[attr-defined]
        right = "right" in name
        np.testing.assert_array_equal(picture.render(deviant, right), picture.render(made.config, right))
        assert not np.array_equal(picture.render(deviant, right), picture.render(small, right))
    assert found.session == simulate(replace(small, aims=1, pairs=1), 4).session


def test_channel_data_is_what_the_true_array_receives() -> None:
    small = replace(PRESETS["raw-small"], sweep=Sweep.WINDOW)
    source = simulate(replace(small, aims=1, pairs=1), 4).frames["frames/pm-00.npy"].func.__self__  # type: ignore[attr-defined]

    def record(config: SimulationConfig) -> FloatArray:
        return np.asarray(source.record(replace(config, snr_db=40.0)), dtype=np.float64)

    for off, probe in (
        ({Constant.RADIUS: 1.0}, replace(small.probe, radius_mm=11.0)),
        ({Constant.PITCH: 0.02}, replace(small.probe, pitch_mm=1.02 * 0.43)),
    ):
        changed = record(replace(small, probe=probe))
        # Directivity goes by the declared pitch, which is a matter of amplitude.
        difference = np.abs(record(replace(small, deviations=off)) - changed).max()
        assert difference <= (1.0 if Constant.RADIUS in off else 0.05 * np.abs(changed).max())
    # 1.54 mm of range offset is 1 us, 40 samples.
    late, early = record(small), record(replace(small, deviations={Constant.RANGE_OFFSET: 1.54}))
    loud = int(np.argmax(np.abs(late).max(axis=1)))
    assert int(np.argmax(np.abs(late[loud]))) - int(np.argmax(np.abs(early[loud]))) in (39, 40, 41)


# --- what is declared -----------------------------------------------------------------------------------------------


def test_nothing_off_is_exactly_as_without() -> None:
    zeros = dict.fromkeys(Constant, 0.0)
    for preset in ("camera-move", "many-looks"):
        quiet_one = replace(PRESETS[preset], deviations=EDGE, noise=replace(PRESETS[preset].noise, marker_bias_mm=0.0))
        plain, zero = simulate(quiet_one, 3), simulate(replace(quiet_one, deviations=zeros, camera_declared=False), 3)
        assert (plain.session, plain.events) == (zero.session, zero.events)
        assert plain.truth.keys() == zero.truth.keys()
    small = PRESETS["raw-small"]
    plain_frames, zero_frames = frames_of(small), frames_of(replace(small, deviations=zeros))
    assert plain_frames.keys() == zero_frames.keys()
    for name, frame in plain_frames.items():
        if not name.endswith("npy"):  # the window's edge is drawn where it is not given
            np.testing.assert_array_equal(frame, zero_frames[name])


def test_truth_says_what_was_off() -> None:
    off = deviations_of({"radius_mm": 1.0, "array_tilt_deg[1]": 0.5, "principal_point_px[3]": -2.0})
    assert off == {
        Constant.RADIUS: 1.0,
        Constant.TILT_RADIAL: pytest.approx(math.radians(0.5)),
        Constant.CENTRE_RIGHT_Y: -2.0,
    }
    assert named(off) == pytest.approx({"radius_mm": 1.0, "array_tilt_deg[1]": 0.5, "principal_point_px[3]": -2.0})
    truth = simulate(quiet(off, pairs=2), 1).truth
    assert truth["x_deviations"] == {
        "edge_sigma_deg": 0.0,
        "radius_mm": 1.0,
        "array_tilt_deg[1]": 0.5,
        "principal_point_px[3]": -2.0,
    }
    assert "x_deviations" not in simulate(PRESETS["paper"], 1).truth
    with pytest.raises(ValueError, match="radius_m is nothing"):
        deviations_of({"radius_m": 1.0})


def test_constants_are_drawn_from_their_sigmas() -> None:
    sigmas = Systematic().sigmas(0.005, 0.1)
    rng = np.random.default_rng(1)
    drawn = np.array([list(drawn_deviations(sigmas, rng).values()) for _ in range(2000)])
    np.testing.assert_allclose(drawn.std(axis=0), sigmas, rtol=0.08)


def test_session_declares_what_it_is_told(tmp_path: Path) -> None:
    config = replace(
        PRESETS["first-hit"],
        aims=2,
        pairs=2,
        camera_declared=True,
        declared_camera=undistorted(default_rig()),
        declared={"probe.radius_mm": 0.01},
        systematic=NONE,
    )
    write_session(simulate(config, 1), tmp_path / "s")
    model = read_session(tmp_path / "s").model
    assert model.probe.radius_mm == 0.01
    assert model.systematic == NONE
    assert model.camera is not None
    assert not model.camera.left.distortion.any()
    assert model.marker is not None
    assert model.board is not None


def test_checks_are_seen_by_both_devices() -> None:
    exact = simulate(quiet(checks=5, check_sigma_mm=(0.0, 0.0)), 1)
    trus_T_camera = exact.scene.trus_T_camera[-1]
    for check, true in zip(exact.checks, exact.check_points_mm, strict=True):
        np.testing.assert_allclose(trus_T_camera @ [*check["camera_p_mm"], 1.0], [*true, 1.0], atol=1e-6)
        np.testing.assert_allclose(check["trus_p_mm"], true, atol=1e-6)
    assert not any(event["type"] == "check" for event in exact.events)
    # The scanner's own map has them 1 mm nearer to the axis where the radius is 1 mm larger than set in it.
    wide = simulate(quiet({Constant.RADIUS: 1.0}, checks=5, check_sigma_mm=(0.0, 0.0)), 1)
    for check, true in zip(wide.checks, wide.check_points_mm, strict=True):
        reach = math.hypot(true[1], true[2])
        np.testing.assert_allclose(
            check["trus_p_mm"], true * [1.0, (reach - 1.0) / reach, (reach - 1.0) / reach], atol=1e-6
        )
    noisy = simulate(quiet(checks=400, check_sigma_mm=(0.3, 0.4)), 1)
    gap = [(trus_T_camera @ [*c["camera_p_mm"], 1.0])[:3] - c["trus_p_mm"] for c in noisy.checks]
    assert np.std(gap) == pytest.approx(0.5, rel=0.08)
    np.testing.assert_allclose(noisy.checks[0]["trus_covariance"], 0.16 * np.eye(3))


def test_command_line_takes_what_is_off(tmp_path: Path) -> None:
    run = CliRunner().invoke
    options = ["--preset", "first-hit", "--aims", "2", "--pairs", "2", "--sweep", "two-sided"]
    options += ["--off", "radius_mm=1", "--off", "water_mm=10", "--declare", "probe.radius_mm=0.01", "--camera"]
    options += ["--declare", "stage.direction=-1", "--declare", "probe.flip=true"]
    result = run(app, ["simulate", str(tmp_path / "s"), *options])
    assert result.exit_code == 0, result.output
    session = read_session(tmp_path / "s")
    assert session.model.probe.radius_mm == 0.01
    assert session.model.stage.direction == -1
    assert session.model.probe.flip
    assert session.model.camera is not None
    assert "x_deviations" in (tmp_path / "s" / "ground_truth.yaml").read_text()
    expected = simulate(
        with_deviations(
            replace(PRESETS["first-hit"], aims=2, pairs=2, sweep=Sweep.TWO_SIDED, camera_declared=True),
            {"radius_mm": 1.0, "water_mm": 10.0},
        ),
        1,
    )
    assert sum(e["type"] == "pair" for e in expected.events) == 4
    assert (
        f'"range_mm": {next(e for e in expected.events if e["type"] == "pair")["trus"]["range_mm"]}'
        in (tmp_path / "s" / "events.jsonl").read_text()
    )
    bad_options = [["--off", "radius_m=1"], ["--off", "radius_mm"], ["--off", "radius_mm=wide"], ["--sweep", "up"]]
    bad_declared = ("probes.radius_mm=1", "probe.radius_mm.x=1", "probe.radius_mm=wide", "probe.radius_mm=[")
    bad_options += [["--declare", declared] for declared in bad_declared]
    for bad in bad_options:
        result = run(app, ["simulate", str(tmp_path / "t"), "--preset", "first-hit", *bad])
        assert isinstance(result.exception, InputError | SystemExit), bad
        assert result.exit_code != 0
        assert not (tmp_path / "t").exists()
