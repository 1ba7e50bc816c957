"""Smoke, blood, wet surfaces, fields and MJPEG against numbers worked out here; poses under the curve of video."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fgreg.cli.main import app
from fgreg.detection.corner_noise import pool_corner_noise
from fgreg.detection.marker import detect_marker
from fgreg.detection.results import MarkerFit, marker_covariance
from fgreg.geometry.transforms import make_transform
from fgreg.simulation.blood import transmission
from fgreg.simulation.disturbances import Disturbances, SpoiltView, compressed, video_levels, with_values
from fgreg.simulation.documents import session_document
from fgreg.simulation.highlights import Wetness, highlights
from fgreg.simulation.presets import RAW_SMALL, THEATRE
from fgreg.simulation.simulate import simulate
from tests.marker_scene import pose_error


def test_smoke_leaves_light_by_distance_and_adds_its_own() -> None:
    view = SpoiltView(Disturbances(smoke=0.5), np.diag([100.0, -100.0, 1.0]), False, (1,), 200.0, 100.0)
    near, far = np.full((90, 160), 100.0, np.float32), np.full((90, 160), 200.0, np.float32)
    black, white = np.zeros_like(near), np.full_like(near, 200.0)
    left = [(view.light([white], d)[0] - view.light([black], d)[0]) / 200.0 for d in (near, far)]
    np.testing.assert_allclose(left[1], left[0] ** 2, atol=1e-5)  # twice the way
    assert float(np.median(left[0])) == pytest.approx(0.5, abs=0.1)
    np.testing.assert_allclose(view.light([black], near)[0], 120.0 * (1.0 - left[0]), rtol=1e-4)


def test_blood_takes_green_and_leaves_red() -> None:
    blue, green, red = (float(band[0]) for band in transmission(np.array([0.05]), 3))
    assert (blue, green, red) == pytest.approx((math.exp(-1.8), math.exp(-2.0), math.exp(-0.12)), rel=1e-5)
    (grey,) = transmission(np.array([0.05]), 1)
    assert float(grey[0]) == pytest.approx(0.114 * blue + 0.587 * green + 0.299 * red, rel=1e-5)


def test_wet_surface_shines_where_it_faces_the_light() -> None:
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 61, dtype=np.float32), np.linspace(-0.3, 0.3, 61, dtype=np.float32))
    facing = make_transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 5.0]))
    shines = [highlights(facing, x, y, 0.0, Wetness(1.0, np.zeros(3), seed)) for seed in range(6)]
    peak = 0.025 / (4.0 * 0.08**2)  # pi F D / 4, head on
    assert max(shine.max() for shine in shines) == pytest.approx(peak, rel=0.01)  # in a pool of liquid
    assert min(shine.max() for shine in shines) < 0.5 * peak  # beside one
    for shine in shines:
        assert (shine[np.hypot(x, y) > 0.3] < 1e-3 * peak).all()


def test_one_field_is_the_even_lines_of_its_own_time() -> None:
    fields = Disturbances(field_hz=50.0, hand_mm_s=30.0)
    quiet = replace(RAW_SMALL, optics=replace(RAW_SMALL.optics, read_noise=0.0, shot_noise=0.0))
    whole, field = (
        simulate(replace(quiet, disturbances=what), 1).frames["frames/pm-00-left.png"]().astype(float)
        for what in (fields, replace(fields, deinterlace=True))
    )
    assert field.shape == (whole.shape[0] // 2, whole.shape[1])
    # The field is of the middle time: its lines lie between those of the frame's two fields, one early and one late.
    assert 2.0 < np.abs(whole[::2] - field).max() < np.abs(whole[::2] - whole[1::2]).max()
    declared = session_document(replace(quiet, disturbances=replace(fields, deinterlace=True)))["camera"]
    assert declared["image_size"] == [800, 225]
    assert declared["left"]["matrix"][1][1] == pytest.approx(0.5 * quiet.camera.left.matrix[1, 1])


def test_video_curve_and_compression() -> None:
    level = video_levels(np.array([0.0, 2.55, 127.5, 255.0], dtype=np.float32))
    np.testing.assert_allclose(level, [0.0, 255 * 0.045, 255 * (1.099 * 0.5**0.45 - 0.099), 255.0], rtol=1e-4)
    picture = np.zeros((32, 32, 3), dtype=np.uint8)
    picture[:, 15:, 2] = 255  # an edge of colour within a block of chroma
    errors = [
        np.abs(compressed(picture, Disturbances(jpeg_quality=95, chroma=c)).astype(float) - picture).max()
        for c in (444, 420)
    ]
    assert errors[0] < 0.5 * errors[1]


def test_shots_draw_their_own_and_the_truth_says_what() -> None:
    means = [THEATRE.disturbances.of_shot((1, n)) for n in range(400)]
    assert np.mean([what.smoke for what in means]) == pytest.approx(0.2, abs=0.04)
    assert np.mean([what.blood for what in means]) == pytest.approx(1.0, abs=0.15)
    truth = simulate(replace(THEATRE, aims=2, pairs=2), 1).truth["x_disturbances"]
    assert set(truth) == {
        f"{kind}-{n:02d}" for kind, last in (("aim", 2), ("pm", 2), ("track", 4)) for n in range(last)
    }
    assert truth["aim-00"] == THEATRE.disturbances.of_shot((1, 0)).named()


def test_poses_under_the_curve_of_video_say_how_far_off_they_are() -> None:
    what = Disturbances(video_curve=True)
    config = replace(RAW_SMALL, aims=0, pairs=4, tracks_heard=0, tracks_silent=0, disturbances=what)
    session = simulate(config, 1)
    found = []
    for n, event in enumerate(session.events[:2]):
        left, right = (session.frames[event["marker"][side]]() for side in ("left", "right"))
        found.append((n, detect_marker(left, right, config.camera, config.marker)))
    fits = [(n, fit) for n, fit in found if isinstance(fit, MarkerFit)]
    assert len(fits) == 2
    noise = pool_corner_noise(fit.pose for _, fit in fits)
    for n, fit in fits:
        error = pose_error(session.true_camera_T_marker[n], fit.camera_T_marker)
        assert error @ np.linalg.solve(marker_covariance(fit, noise), error) / 6.0 < 5.0  # 75 for a linear camera


def test_what_cannot_be_disturbed_is_refused(tmp_path: Path) -> None:
    assert with_values(Disturbances(), {"smoke": 0.3, "jpeg_quality": 50.0}) == Disturbances(smoke=0.3, jpeg_quality=50)
    for preset, value, said in (
        ("theatre", "fog=1", "fog is no disturbance; there are smoke, blood"),
        ("theatre", "smoke=2", "smoke 2"),
        ("theatre", "field_hz=55", "field_hz is 55, expected 50 or 60"),
        ("paper", "smoke=0.3", "no pictures"),
    ):
        out = tmp_path / "s"
        run = CliRunner().invoke(app, ["simulate", str(out), "--preset", preset, "--disturb", value])
        assert run.exit_code != 0
        assert said in str(run.exception) + run.output
        assert not out.exists()
