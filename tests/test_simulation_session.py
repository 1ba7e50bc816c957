"""Simulated sessions against their own truth, with the geometry written out here once more."""

from __future__ import annotations

import ast
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import fgreg.simulation
from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, log_so3
from fgreg.model.probe_model import SensitivityModel
from fgreg.model.session_model import NoiseModel, StageModel
from fgreg.simulation.config import SimulationConfig, Sweep
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import SimulatedSession, simulate

R = 10.0
STEP = 2.0
EDGE = {Constant.WINDOW_EDGE: 0.0}


def events(simulated: SimulatedSession, kind: str) -> list[tuple[int, dict[str, Any]]]:
    return [(i, event) for i, event in enumerate(simulated.events) if event["type"] == kind]


def plane_angle_deg(p: list[float]) -> float:
    return math.degrees(math.atan2(p[1], p[2]))


def distance_to_element_mm(p: list[float], scan_deg: float) -> float:
    a = math.radians(scan_deg)
    return math.hypot(p[1] - R * math.sin(a), p[2] - R * math.cos(a))


def offsets_deg(simulated: SimulatedSession) -> np.ndarray:
    """Rotation from each pair's scan angle to its PM."""
    pms = simulated.truth["pms"]
    return np.array([plane_angle_deg(pms[e["pm"]]) - e["trus"]["scan_deg"] for _, e in events(simulated, "pair")])


def without_noise(**changes: Any) -> SimulationConfig:
    quiet = NoiseModel((0, 0, 0), (0, 0, 0), 0.0, (0, 0, 0), 0.0, 0.0, 0.0)
    return SimulationConfig(noise=quiet, declared_noise=NoiseModel(), **changes)


def test_same_seed_same_session_other_seed_other_session() -> None:
    one, again, other = (simulate(PRESETS["paper"], seed) for seed in (4, 4, 5))
    assert (one.session, one.events, one.truth) == (again.session, again.events, again.truth)
    assert one.events != other.events


def test_noise_does_not_change_the_geometry() -> None:
    loud = replace(PRESETS["paper"], noise=replace(PRESETS["paper"].noise, range_mm=3.0, marker_bias_mm=2.0))
    assert simulate(loud, 3).truth["pms"] == simulate(PRESETS["paper"], 3).truth["pms"]


@pytest.mark.parametrize("preset", ["paper", "first-hit", "camera-move"])
def test_every_beam_ends_in_its_pm(preset: str) -> None:
    simulated = simulate(PRESETS[preset], 1)
    marker_T_laser = np.array(simulated.truth["marker_T_laser"])
    epoch = 0
    for i, event in enumerate(simulated.events):
        epoch += event["type"] == "camera_moved"
        if event["type"] != "pair":
            continue
        trus_T_laser = (
            np.array(simulated.truth["trus_T_camera"][epoch]) @ simulated.true_camera_T_marker[i] @ marker_T_laser
        )
        p = np.linalg.inv(trus_T_laser) @ [*simulated.truth["pms"][event["pm"]], 1.0]
        np.testing.assert_allclose(p[:2], 0.0, atol=1e-6)
        assert 20.0 <= p[2] <= 60.0


def test_aims_miss_the_spot_by_the_aim_noise_along_camera_axes() -> None:
    miss = []
    for seed in range(60):
        simulated = simulate(replace(PRESETS["paper"], tracks_heard=0, tracks_silent=0, pairs=0), seed)
        marker_T_laser = np.array(simulated.truth["marker_T_laser"])
        for i, event in events(simulated, "aim"):
            camera_T_laser = simulated.true_camera_T_marker[i] @ marker_T_laser
            # Foot of the perpendicular from the nominal spot: only the miss across the beam can be seen.
            spot = np.array(event["camera_p_spot_mm"])
            across = np.eye(3) - np.outer(camera_T_laser[:3, 2], camera_T_laser[:3, 2])
            miss.append((across @ (camera_T_laser[:3, 3] - spot), across))
    got = sum(np.outer(m, m) for m, _ in miss)
    expected = sum(a @ np.diag([1.0, 1.0, 0.01]) @ a for _, a in miss)
    np.testing.assert_allclose(got, expected, atol=0.15 * np.trace(expected) / 2)


def test_marker_noise_is_the_published_model() -> None:
    turns, shifts, biases = [], [], []
    for seed in range(80):
        simulated = simulate(PRESETS["paper"], seed)
        bias = np.array(simulated.truth["x_marker_bias_mm"])
        biases.append(bias)
        for i, true in simulated.true_camera_T_marker.items():
            observed = np.array(simulated.events[i]["marker"]["camera_T_marker"])
            turns.append(log_so3(observed[:3, :3] @ true[:3, :3].T))
            shifts.append(observed[:3, 3] - true[:3, 3] - bias)
    assert len(turns) == 80 * (12 + 10 + 6)
    np.testing.assert_allclose(np.std(turns, axis=0), 0.01, rtol=0.06)
    np.testing.assert_allclose(np.std(shifts, axis=0), [0.1, 0.1, 0.8], rtol=0.06)
    np.testing.assert_allclose(np.mean(shifts, axis=0), 0.0, atol=0.07)
    assert np.std(biases) == pytest.approx(0.1, rel=0.15)
    assert simulated.session["noise"]["marker_bias_mm"] == 0.1


def test_range_is_measured_from_the_element_and_x_along_the_axis() -> None:
    simulated = simulate(without_noise(pairs=12), 2)
    for _, event in events(simulated, "pair"):
        p, trus = simulated.truth["pms"][event["pm"]], event["trus"]
        assert trus["range_mm"] == pytest.approx(distance_to_element_mm(p, trus["scan_deg"]), abs=2e-4)
        assert trus["x_mm"] == pytest.approx(p[0], abs=1e-4)


def test_range_x_and_scan_noise_have_the_declared_sigmas() -> None:
    x, r = [], []
    for seed in range(60):
        simulated = simulate(replace(PRESETS["first-hit"], noise=NoiseModel(scan_rad=0.0)), seed)
        for _, event in events(simulated, "pair"):
            p, trus = simulated.truth["pms"][event["pm"]], event["trus"]
            x.append(trus["x_mm"] - p[0])
            r.append(trus["range_mm"] - distance_to_element_mm(p, trus["scan_deg"]))
    assert np.std(x) == pytest.approx(0.3, rel=0.07)
    assert np.std(r) == pytest.approx(0.2, rel=0.07)
    # The stage reading: what is off a grid of exact steps is noise.
    exact, noisy = (
        simulate(SimulationConfig(pairs=400, aims=0, noise=n), 1) for n in (NoiseModel(scan_rad=0.0), NoiseModel())
    )
    scan = [np.array([e["trus"]["scan_deg"] for _, e in events(s, "pair")]) for s in (exact, noisy)]
    assert np.std(scan[1] - scan[0]) == pytest.approx(0.1, rel=0.1)


def test_stage_stops_at_the_first_angle_with_a_detection() -> None:
    for seed in range(20):
        simulated = simulate(without_noise(pairs=10), seed)
        width = 6.0 + simulated.truth["x_window_edge_deg"]
        sweeps = np.array([e["trus"]["sweep"] for _, e in events(simulated, "pair")])
        ahead = offsets_deg(simulated) * sweeps
        assert (ahead < width).all()
        assert (ahead > width - STEP - 1e-3).all()
        np.testing.assert_array_equal(sweeps, [1, -1] * 5)


def test_one_way_sweeps_all_come_from_one_side() -> None:
    simulated = simulate(PRESETS["one-way"], 1)
    assert {e["trus"]["sweep"] for _, e in events(simulated, "pair")} == {1}


def test_window_only_is_uniform_over_the_window_with_one_edge_error_per_session() -> None:
    every = []
    for seed in range(60):
        simulated = simulate(
            without_noise(pairs=20, sweep=Sweep.WINDOW, deviations={Constant.WINDOW_EDGE: math.radians(0.5)}), seed
        )
        assert all("sweep" not in e["trus"] for _, e in events(simulated, "pair"))
        every.append(offsets_deg(simulated))
    offsets = np.concatenate(every)
    assert np.abs(offsets).max() < 6.5
    assert np.abs(offsets).max() > 6.4
    assert offsets.std() == pytest.approx(6.5 / math.sqrt(3), rel=0.05)
    edges = [simulate(PRESETS["paper"], seed).truth["x_window_edge_deg"] for seed in range(400)]
    assert np.std(edges) == pytest.approx(0.3, rel=0.12)


def test_window_follows_depth() -> None:
    config = without_noise(pairs=40, sweep=Sweep.WINDOW, deviations={Constant.WINDOW_EDGE: 0.0})
    table = SensitivityModel(np.array([20.0, 45.0]), np.radians([3.0, 8.0]), 0.0)
    simulated = simulate(replace(config, probe=replace(config.probe, sensitivity=table)), 3)
    share = []
    for (_, event), offset in zip(events(simulated, "pair"), offsets_deg(simulated), strict=True):
        width = 3.0 + (event["trus"]["range_mm"] - 20.0) / 5.0
        share.append(abs(offset) / width)
    assert max(share) < 1.0
    assert max(share) > 0.9


def test_a_detection_at_the_first_stop_gives_no_sweep() -> None:
    # The stage's lower limit lies within the window of every PM: it detects them before the first step.
    stage = StageModel(math.radians(2.0), (math.radians(-1.0), math.radians(60.0)))
    config = without_noise(pairs=6, stage=stage, sweep=Sweep.ONE_WAY, pm_angle_rad=math.radians(1.5))
    assert all("sweep" not in e["trus"] for _, e in events(simulate(config, 1), "pair"))


def test_device_angles_follow_direction_and_zero() -> None:
    plain = simulate(without_noise(pairs=8, sweep=Sweep.WINDOW, tracks_silent=1), 7)
    stage = StageModel(math.radians(2.0), (math.radians(-50.0), math.radians(70.0)), -1, math.radians(10.0))
    turned = simulate(without_noise(pairs=8, sweep=Sweep.WINDOW, tracks_silent=1, stage=stage), 7)
    for (_, a), (_, b) in zip(events(plain, "pair"), events(turned, "pair"), strict=True):
        assert b["trus"]["scan_deg"] == pytest.approx(10.0 - a["trus"]["scan_deg"], abs=2e-4)
    assert turned.truth["tracks"][0]["stage_deg"] == pytest.approx(
        10.0 - plain.truth["tracks"][0]["stage_deg"], abs=1e-6
    )


def test_sweep_is_the_devices_direction() -> None:
    stage = StageModel(math.radians(2.0), (math.radians(-60.0), math.radians(60.0)), -1)
    simulated = simulate(without_noise(pairs=10, stage=stage), 2)
    pms = simulated.truth["pms"]
    for _, event in events(simulated, "pair"):
        ahead = (-plane_angle_deg(pms[event["pm"]]) - event["trus"]["scan_deg"]) * event["trus"]["sweep"]
        assert ahead > 3.0


def test_reversed_stage_and_elements_mirror_what_is_recorded_but_not_what_is_declared() -> None:
    config = without_noise(pairs=6, sweep=Sweep.WINDOW, tracks_heard=1)
    plain = simulate(config, 5)
    mirrored = simulate(replace(config, reversed_stage=True, reversed_elements=True), 5)
    assert mirrored.session == plain.session
    assert mirrored.truth["pms"] == plain.truth["pms"]
    for (_, a), (_, b) in zip(events(plain, "pair"), events(mirrored, "pair"), strict=True):
        assert b["trus"]["scan_deg"] == pytest.approx(-a["trus"]["scan_deg"], abs=1e-9)
        assert b["trus"]["x_mm"] == pytest.approx(-a["trus"]["x_mm"], abs=1e-9)
        assert b["trus"]["range_mm"] == a["trus"]["range_mm"]
    assert mirrored.truth["tracks"][0]["stage_deg"] == pytest.approx(-plain.truth["tracks"][0]["stage_deg"], abs=1e-9)


def test_wrong_sound_speed_scales_ranges() -> None:
    plain, slow = (
        simulate(without_noise(deviations={Constant.SOUND_SPEED: c / 1540.0 - 1.0}), 5) for c in (1540.0, 1500.0)
    )
    for (_, a), (_, b) in zip(events(plain, "pair"), events(slow, "pair"), strict=True):
        assert b["trus"]["range_mm"] == pytest.approx(a["trus"]["range_mm"] * 1540.0 / 1500.0, abs=1e-4)
    assert slow.truth["x_sound_speed_ratio"] == pytest.approx(1500.0 / 1540.0)


def test_outlier_pairs_are_elsewhere_and_the_truth_lists_them() -> None:
    simulated = simulate(without_noise(pairs=20, outlier_pairs=6), 5)
    outliers = set(simulated.truth["x_outlier_pms"])
    assert len(outliers) == 6
    for _, event in events(simulated, "pair"):
        p, trus = simulated.truth["pms"][event["pm"]], event["trus"]
        off = math.hypot(trus["x_mm"] - p[0], trus["range_mm"] - distance_to_element_mm(p, trus["scan_deg"]))
        assert (off > 1e-3) == (event["pm"] in outliers)


def test_camera_moves_chain_the_registrations() -> None:
    config = replace(PRESETS["camera-move"], epochs=3, camera_move_known=True, camera_move_sigma=(1e-5, 1e-4))
    simulated = simulate(config, 2)
    registrations = [np.array(t) for t in simulated.truth["trus_T_camera"]]
    moves = events(simulated, "camera_moved")
    assert len(registrations) == 3
    assert len(moves) == 2
    for k, (_, event) in enumerate(moves):
        move = np.array(event["camera_new_T_camera_old"])
        np.testing.assert_allclose(registrations[k + 1] @ move, registrations[k], atol=0.02)
        np.testing.assert_allclose(np.sqrt(np.diag(event["covariance"])), [1e-5] * 3 + [1e-4] * 3)
        assert np.linalg.norm(registrations[k + 1] - registrations[k]) > 1.0
    kinds = "".join(e["type"][0] for e in simulated.events)
    assert kinds.count("c") == 2
    assert all(part.count("p") == 8 for part in kinds.split("c"))


def test_looks_at_one_pm_share_the_marker_and_their_amplitudes_follow_the_curve() -> None:
    simulated = simulate(without_noise(looks_per_pm=4, amplitudes=True, amplitude_noise=0.0, deviations=EDGE), 3)
    curve = simulated.session["probe"]["sensitivity"]["curve"]
    by_pm: dict[int, list[dict[str, Any]]] = {}
    for _, event in events(simulated, "pair"):
        by_pm.setdefault(event["pm"], []).append(event)
    assert [len(looks) for looks in by_pm.values()] == [4] * 10
    for pm, looks in by_pm.items():
        assert all(look["marker"] == looks[0]["marker"] for look in looks)
        offset = [plane_angle_deg(simulated.truth["pms"][pm]) - look["trus"]["scan_deg"] for look in looks]
        strength = [look["trus"]["amplitude"] for look in looks] / np.interp(
            offset, curve["rotation_deg"], curve["amplitude"]
        )
        np.testing.assert_allclose(strength, strength[0], rtol=5e-3)  # the curve is a table


def test_further_looks_of_a_sweep_are_at_later_steps() -> None:
    simulated = simulate(without_noise(pairs=6, looks_per_pm=3), 3)
    for pm in range(6):
        looks = [e["trus"] for _, e in events(simulated, "pair") if e["pm"] == pm]
        assert [look.get("sweep", 0) for look in looks[1:]] == [0, 0]
        steps = np.diff([look["scan_deg"] for look in looks]) * looks[0]["sweep"] / STEP
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-3)
        assert (steps >= 1).all()


def test_track_events_have_a_look_at_the_pm_or_none() -> None:
    simulated = simulate(replace(PRESETS["first-hit"], tracks_heard=2, tracks_silent=2, track_looks=2), 3)
    tracks = [e for _, e in events(simulated, "track")]
    assert sorted("looks" in e for e in tracks) == [False, False, True, True]
    assert all(("looks" in e) != ("scan_deg" in e) for e in tracks)
    assert [t["t"] for t in simulated.truth["tracks"]] == [e["t"] for e in tracks]
    for truth, event in zip(simulated.truth["tracks"], tracks, strict=True):
        for heard in event.get("looks", []):
            assert abs(truth["stage_deg"] - heard["scan_deg"]) < 7.5


def test_times_never_decrease() -> None:
    t = [e["t"] for e in simulate(PRESETS["camera-move"], 3).events]
    assert t == sorted(t)


def test_parallel_beams_and_collinear_spots() -> None:
    simulated = simulate(without_noise(pairs=8, beam_tilt_rad=0.0, collinear=True), 4)
    beams = []
    for i, _ in events(simulated, "pair"):
        camera_T_laser = simulated.true_camera_T_marker[i] @ np.array(simulated.truth["marker_T_laser"])
        beams.append(camera_T_laser[:3, 2])
    np.testing.assert_allclose(beams, np.broadcast_to(beams[0], (8, 3)), atol=1e-7)
    pms = np.array(list(simulated.truth["pms"].values()))
    singular = np.linalg.svd(pms - pms.mean(axis=0), compute_uv=False)
    assert singular[0] > 5.0
    assert singular[1] < 1e-6


def corners_px(camera: Any, camera_T_left: FloatArray, camera_T_marker: FloatArray, half: float) -> np.ndarray:
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]], dtype=float)
    pose = camera_T_left @ camera_T_marker
    rotation, _ = cv2.Rodrigues(pose[:3, :3])
    return cv2.projectPoints(square, rotation, pose[:3, 3], camera.matrix, camera.distortion)[0].reshape(4, 2)


def test_markers_are_in_both_images_and_face_the_camera() -> None:
    rig = PRESETS["phantom"].camera
    assert rig.right is not None
    assert rig.right_T_left is not None
    for seed in range(10):
        for pose in simulate(PRESETS["phantom"], seed).true_camera_T_marker.values():
            for camera, view in ((rig.left, np.eye(4)), (rig.right, rig.right_T_left)):
                px = corners_px(camera, view, pose, 12.5)
                assert (px > 12).all()
                assert (px < [1280 - 13, 720 - 13]).all()
            distance = np.linalg.norm(pose[:3, 3])
            assert 75.0 <= distance <= 160.0
            assert -pose[:3, 2] @ pose[:3, 3] / distance >= math.cos(math.radians(50.0)) - 1e-9


def test_every_seed_can_be_realised() -> None:
    for preset in ("phantom", "camera-move", "raw-small"):
        for seed in range(25):
            made = simulate(PRESETS[preset], 1000 + seed)
            assert sum(event["type"] == "pair" for event in made.events) >= PRESETS[preset].pairs


def test_pms_span_the_tissue() -> None:
    pms = np.concatenate([list(simulate(PRESETS["first-hit"], s).truth["pms"].values()) for s in range(40)])
    depth = np.hypot(pms[:, 1], pms[:, 2]) - R
    assert depth.min() >= 22.0 - 1e-6
    assert depth.max() <= 42.0 + 1e-6
    assert np.ptp(depth) > 15.0
    assert np.abs(pms[:, 0]).max() <= 20.0
    assert np.ptp(pms[:, 0]) > 35.0
    assert np.abs(np.degrees(np.arctan2(pms[:, 1], pms[:, 2]))).max() <= 35.0 + 1e-9


def test_frames_show_the_corner_aimed_at_and_are_the_same_each_time() -> None:
    simulated = simulate(replace(PRESETS["raw-small"], aims=2, pairs=1), 4)
    board = simulated.config.board
    assert board.charuco is not None
    book = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.charuco.dictionary))
    size = (board.columns + 1, board.rows + 1)
    detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard(size, board.square_mm, board.charuco.marker_mm, book))
    marker_T_laser = np.array(simulated.truth["marker_T_laser"])
    for i, event in events(simulated, "aim"):
        image = simulated.frames[event["marker"]["left"]]()
        np.testing.assert_array_equal(image, simulated.frames[event["marker"]["left"]]())
        corners, ids, _, _ = detector.detectBoard(np.asarray(image, dtype=np.uint8))
        column, row = event["corner"]
        seen = np.asarray(corners).reshape(-1, 2)[np.asarray(ids).ravel().tolist().index(row * board.columns + column)]
        # The beam passes within the aim's 0.3 mm (some 3 sigma) of the corner: so does its image.
        beam = simulated.true_camera_T_marker[i] @ marker_T_laser
        points = beam[:3, 3] + np.linspace(15.0, 65.0, 2001)[:, None] * beam[:3, 2]
        camera = simulated.config.camera.left
        px = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix, camera.distortion)[0].reshape(-1, 2)
        assert np.linalg.norm(px - seen, axis=1).min() < 1.2 * camera.matrix[0, 0] / 105.0


def test_channel_frames_hold_the_pm_at_its_range() -> None:
    simulated = simulate(replace(PRESETS["raw-small"], snr_db=40.0), 4)
    channels = simulated.session["probe"]["channels"]
    for _, event in events(simulated, "pair"):
        data = simulated.frames[event["trus"]["frame"]]().astype(float)
        assert data.shape == (128, 1160)
        p = simulated.truth["pms"][event["pm"]]
        element = int(np.argmin(np.abs((np.arange(128) - 63.5) * 0.43 - p[0])))
        peak = int(np.argmax(np.abs(data[element])))
        time_us = channels["t0_us"] + peak / channels["sampling_mhz"] - channels["pulse_delay_us"]
        expected = distance_to_element_mm(p, event["trus"]["scan_deg"])
        assert time_us * 1.54 == pytest.approx(expected, abs=0.2)  # the carrier's peak, to half a wave


def test_reversed_elements_reverse_the_channels() -> None:
    plain, turned = (simulate(replace(PRESETS["raw-small"], reversed_elements=r), 4) for r in (False, True))
    np.testing.assert_array_equal(plain.frames["frames/pm-01.npy"](), turned.frames["frames/pm-01.npy"]()[::-1])


@pytest.mark.parametrize(
    "changes",
    [
        {"epochs": 0},
        {"pairs": -1},
        {"outlier_pairs": 11},
        {"frames": True},
        {"looks_per_pm": 0},
        {"camera_move_mm": 3.0},
    ],
)
def test_impossible_configurations_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"have to be|expected|need"):
        SimulationConfig(**changes)


def test_geometry_out_of_sight_or_out_of_reach_is_refused() -> None:
    with pytest.raises(ValueError, match="camera can see"):
        simulate(SimulationConfig(marker_distance_mm=(300.0, 310.0)), 1)
    stage = StageModel(math.radians(2.0), (math.radians(50.0), math.radians(60.0)))
    with pytest.raises(ValueError, match="never detected"):
        simulate(SimulationConfig(stage=stage), 1)


def test_simulation_shares_no_code_with_the_estimator() -> None:
    allowed = {"fgreg.errors", "fgreg.model.events", "fgreg.geometry.transforms", "fgreg.model.session_model"}
    allowed |= {"fgreg.geometry.rig", "fgreg.model.camera_model", "fgreg.model.systematic", "fgreg.schema.yaml_writer"}
    allowed |= {"fgreg.output.session_folder", "fgreg.model.static_tags", "fgreg.model.probe_model"}
    for source in Path(fgreg.simulation.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(source.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for name in names:
                assert not name.startswith("fgreg") or name in allowed or name.startswith("fgreg.simulation"), name
                assert name.split(".")[0] != "gtsam"
