"""A recording read back holds what was estimated, at the right places, times and in the right frames."""

from __future__ import annotations

import inspect
import io
import math
import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, as_float_array, inverse
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.estimate import SessionEstimate, TargetEstimate, TrackEstimate, Verdict
from fgreg.model.measurements import Measurements, Track
from fgreg.model.probe_model import ChannelModel
from fgreg.model.session_model import MarkerModel, SessionModel, StageModel, TagModel
from fgreg.simulation.lens import project_points
from fgreg.viewer import endoscope_lines, endoscope_view, palette, scene, shapes
from fgreg.viewer.blueprint import WORLD_PX
from fgreg.viewer.null_viewer import NullViewer, open_viewer
from fgreg.viewer.recording import Viewer
from tests.answers import answer_from_truth
from tests.forward import Truth, make_measurements, make_session
from tests.recordings import Row, read_recording, transform_of, views, views_of

AIMS, PAIRS = 2, 6
UNUSED = 3
TRACK_T = 100.0
TRACK_DEVICE_DEG = -12.0
LIMIT_MM = 3.0
WORST_MM = 6.4


def make_model() -> SessionModel:
    """A session with everything: stereo, marker, channels, a stage that counts the other way from 5 degrees."""
    base = make_session()
    matrix = as_float_array([[300.0, 0.0, 160.0], [0.0, 310.0, 90.0], [0.0, 0.0, 1.0]])
    camera = CameraModel((320, 180), matrix, as_float_array([-0.3, 0.1, 0.0, 0.0, 0.0]))
    right_T_left = np.eye(4)
    right_T_left[0, 3] = -5.0
    return replace(
        base,
        name="phantom",
        probe=replace(base.probe, channels=ChannelModel(40.0)),
        stage=StageModel(math.radians(2.0), (-1.5, 1.5), direction=-1, zero_device_rad=math.radians(5.0)),
        camera=StereoRig(camera, camera, as_float_array(right_T_left)),
        marker=MarkerModel("DICT_4X4_50", (TagModel(0, 20.0),)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    path: Path
    model: SessionModel
    measurements: Measurements
    estimate: SessionEstimate
    truth: Truth
    rows: dict[str, list[Row]]

    def at(self, entity: str, shot: int) -> Row:
        """The row of an entity that was logged at a shot."""
        (found,) = [row for row in self.rows[entity] if row.shot == shot]
        return found

    def look(self, shot: int) -> Row:
        """What stays drawn of a look, which appears with its shot."""
        return self.at(f"/world/looks/{shot}", shot)

    def words(self, shot: int) -> list[str]:
        """The labels of the scene at a shot."""
        return [str(word) for word in self.at("/world/shot/labels", shot).values["Points3D:labels"]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    rng = np.random.default_rng(11)
    model, measurements, truth = make_measurements(
        rng, aims=AIMS, pairs=PAIRS, epochs=2, noise=False, session=make_model()
    )
    last = measurements.pairs[-1]
    track = TrackEstimate(TRACK_T, math.radians(TRACK_DEVICE_DEG), 0.01, truth.pair_lambda_mm[-1], causal=False)
    estimate = answer_from_truth(rng, model, measurements, truth, unused=(UNUSED,), tracks=(track,))
    places = zip(model.targets_mm, np.linspace(0.2, WORST_MM, len(model.targets_mm)), strict=True)
    errors = tuple(
        TargetEstimate(
            "apex" if i == len(model.targets_mm) - 1 else str(i + 1), at, 0.5 * p95, p95, 0.8 * p95, 0.6 * p95
        )
        for i, (at, p95) in enumerate(places)
    )
    estimate = replace(estimate, epochs=tuple(replace(epoch, targets=errors) for epoch in estimate.epochs))
    path = tmp_path_factory.mktemp("recording") / "phantom.rrd"
    frame = rng.normal(size=(128, 1200))
    left = np.zeros((180, 320), dtype=np.uint8)
    left[:, 160:] = 200
    right = np.zeros((180, 320, 3), dtype=np.uint8)
    right[..., 0] = 250
    with open_viewer(path, model.name) as viewer:
        viewer.session(model, LIMIT_MM)
        viewer.shot_images(
            1.0, "aim", 0, left, right, [np.array([[1.0, 2], [3, 2], [3, 4], [1, 4]])], np.array([7.0, 8])
        )
        viewer.shot_images(2.0, "aim", 1, left)
        look = measurements.pairs[0].look
        viewer.pa_frame(measurements.pairs[0].t, AIMS, frame, look.x_mm, look.range_mm, look.covariance, model.probe)
        viewer.pa_frame(measurements.pairs[1].t, AIMS + 1, frame, None, None, None, model.probe)
        assert not path.exists()
        viewer.result(model, measurements, estimate, truth, [Track(TRACK_T, 1, last.marker)])
    return Recorded(path, model, measurements, estimate, truth, read_recording(path))


def test_the_camera_stands_where_each_epoch_has_it(recorded: Recorded) -> None:
    rows = recorded.rows["/world/camera"]
    # Epoch 1 begins with the pair that first belongs to it.
    first = next(i for i, pair in enumerate(recorded.measurements.pairs) if pair.epoch == 1)
    assert [row.shot for row in rows] == [0, AIMS + first]
    for row, expected in zip(rows, recorded.truth.trus_T_camera, strict=True):
        np.testing.assert_allclose(transform_of(row), expected, atol=2e-5)
    assert rows[1].seconds == pytest.approx(recorded.measurements.pairs[first].t)


def test_the_marker_is_where_it_was_seen(recorded: Recorded) -> None:
    seen = [aim.marker for aim in recorded.measurements.aims] + [pair.marker for pair in recorded.measurements.pairs]
    for shot, marker in enumerate(seen):
        np.testing.assert_allclose(
            transform_of(recorded.at("/world/camera/marker", shot)), marker.camera_T_marker, atol=2e-5
        )
    (tag,) = recorded.rows["/world/camera/marker/tags"]
    corners = np.array(tag.values["LineStrips3D:strips"][0])
    np.testing.assert_allclose(corners[:4], [[-10, 10, 0], [10, 10, 0], [10, -10, 0], [-10, -10, 0]])


def test_beams_end_at_their_photoacoustic_markers(recorded: Recorded) -> None:
    for i, pair in enumerate(recorded.measurements.pairs):
        shot = AIMS + i
        if i == UNUSED:
            assert "Arrows3D:origins" not in recorded.look(shot).values
            continue
        for entity in (f"/world/looks/{shot}", "/world/shot/beam"):
            row = recorded.at(entity, shot)
            tip = row.array("Arrows3D:origins") + row.array("Arrows3D:vectors")
            np.testing.assert_allclose(tip[0], recorded.truth.trus_p_pm_mm[pair.pm], atol=1e-4)


def test_the_beam_of_an_aim_ends_at_its_spot(recorded: Recorded) -> None:
    for i, spot in enumerate(recorded.truth.camera_p_spot_mm):
        row = recorded.at("/world/shot/beam", i)
        tip = (row.array("Arrows3D:origins") + row.array("Arrows3D:vectors"))[0]
        camera_p = inverse(recorded.truth.trus_T_camera[0]) @ [*tip, 1.0]
        np.testing.assert_allclose(camera_p[:3], spot, atol=1e-3)


def test_arcs_pass_through_their_photoacoustic_markers(recorded: Recorded) -> None:
    for i, pair in enumerate(recorded.measurements.pairs):
        strip = np.array(recorded.look(AIMS + i).values["LineStrips3D:strips"][0])
        pm = recorded.truth.trus_p_pm_mm[pair.pm]
        # The arc is drawn through 25 points: between two of them it bulges by less than 0.02 mm.
        segment = np.diff(strip, axis=0)
        along = np.clip(np.sum((pm - strip[:-1]) * segment, axis=1) / np.sum(segment**2, axis=1), 0.0, 1.0)
        assert np.linalg.norm(strip[:-1] + along[:, None] * segment - pm, axis=1).min() < 0.05
        sound = np.array(recorded.at("/world/shot/sound", AIMS + i).values["LineStrips3D:strips"][0])
        np.testing.assert_allclose(sound[1], pm, atol=1e-4)
        assert np.linalg.norm(sound[1] - sound[0]) == pytest.approx(pair.look.range_mm, rel=1e-5)


def test_ellipsoids_are_the_covariances(recorded: Recorded) -> None:
    for i, pair in enumerate(recorded.estimate.pairs):
        row = recorded.look(AIMS + i)
        assert pair.trus_p_pm_mm is not None
        assert pair.covariance is not None
        if pair.used:
            centre = row.array("Points3D:positions")[0]
        else:  # a cross about it
            centre = np.mean(row.values["LineStrips3D:strips"][1:], axis=(0, 1))
        np.testing.assert_allclose(centre, pair.trus_p_pm_mm, atol=1e-5)
        np.testing.assert_allclose(row.array("Ellipsoids3D:centers")[0], pair.trus_p_pm_mm, atol=1e-5)
        half, (x, y, z, w) = row.array("Ellipsoids3D:half_sizes")[0], row.array("Ellipsoids3D:quaternions")[0]
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        shown = rotation @ np.diag(half**2) @ rotation.T / 7.814728
        np.testing.assert_allclose(shown, pair.covariance, atol=1e-4)


def test_the_stage_turns_to_each_look_and_its_label_shows_the_device_angle(recorded: Recorded) -> None:
    for i, pair in enumerate(recorded.measurements.pairs):
        t = pair.look.scan_rad
        plane = transform_of(recorded.at("/world/stage", AIMS + i)) @ [0.0, 0.0, 1.0, 0.0]
        np.testing.assert_allclose(plane[:3], [0.0, math.sin(t), math.cos(t)], atol=1e-6)
        assert f"image plane, stage {5.0 - math.degrees(t):.1f}°" in recorded.words(AIMS + i)
        assert f"PM {pair.pm}" + (", not used" if i == UNUSED else "") in recorded.words(AIMS + i)


def test_a_track_turns_the_plane_to_its_answer(recorded: Recorded) -> None:
    shot = AIMS + PAIRS
    plane = transform_of(recorded.at("/world/stage", shot)) @ [0.0, 0.0, 1.0, 0.0]
    scan = math.radians(5.0 - TRACK_DEVICE_DEG)
    np.testing.assert_allclose(plane[:3], [0.0, math.sin(scan), math.cos(scan)], atol=1e-6)
    assert {"turn the stage to -12.0° ± 0.6° (1 sigma)", "predicted spot"} <= set(recorded.words(shot))
    spot = recorded.at("/world/shot/pm", shot).array("Points3D:positions")[0]
    np.testing.assert_allclose(spot, recorded.truth.trus_p_pm_mm[recorded.measurements.pairs[-1].pm], atol=1e-4)


def test_plots_hold_the_figures_of_their_shots(recorded: Recorded) -> None:
    def plot(name: str) -> dict[int, float]:
        return {row.shot: row.values["Scalars:scalars"][0] for row in recorded.rows[name] if row.shot is not None}

    used = {AIMS + i: pair for i, pair in enumerate(recorded.estimate.pairs) if pair.used}
    assert plot("/plots/residual_mm/pair") == {shot: pair.residual_mm for shot, pair in used.items()}
    assert plot("/plots/nis/pair") == {shot: pair.nis for shot, pair in used.items()}
    assert plot("/plots/lambda_mm/pair") == {shot: pair.lambda_mm for shot, pair in used.items()}
    turns = plot("/plots/rotation_deg/pair")
    assert turns.keys() == used.keys()
    for shot, pair in used.items():
        assert pair.rotation_rad is not None
        assert turns[shot] == pytest.approx(math.degrees(pair.rotation_rad))
    assert plot("/plots/residual_mm/pair_not_used") == {AIMS + UNUSED: recorded.estimate.pairs[UNUSED].residual_mm}
    assert plot("/plots/residual_mm/aim") == {i: aim.residual_mm for i, aim in enumerate(recorded.estimate.aims)}


def test_targets_carry_the_bound_of_the_predicted_error_in_size_and_colour(recorded: Recorded) -> None:
    row = recorded.rows["/world/targets/bound_95"][0]
    targets = recorded.model.targets_mm
    np.testing.assert_allclose(row.array("Points3D:positions"), targets, atol=1e-5)
    bounds = np.array([target.p95_mm for target in recorded.estimate.epochs[0].targets])
    np.testing.assert_allclose(row.array("Points3D:radii"), np.minimum(np.maximum(bounds, 0.6), 4.5), atol=1e-4)
    colors = [int(color) >> 8 for color in row.values["Points3D:colors"]]
    classes = [int.from_bytes(bytes(color), "big") for color in palette.ERRORS]
    assert [classes.index(color) for color in colors] == [int(b > 1.5) + int(b > 3.0) + int(b > 6.0) for b in bounds]
    assert recorded.rows["/world/targets/worst"][0].values["Points3D:labels"] == [f"worst: {WORST_MM:.2f} mm\napex"]
    dots = recorded.rows["/scale/targets"][0].array("Points2D:positions")
    np.testing.assert_allclose(dots[:, 0], 100.0 * bounds / LIMIT_MM, atol=1e-3)
    edges = recorded.rows["/scale/edges"][0].values["Points2D:labels"]
    assert edges == ["0 mm", "1.5", "limit 3.0 mm", "refused from 6.0 mm"]


def test_images_come_back_as_they_went_in(recorded: Recorded) -> None:
    def image(entity: str, shot: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
        rows = [row for row in recorded.rows[entity] if row.shot == shot and "EncodedImage:blob" in row.values]
        (blob,) = rows[0].values["EncodedImage:blob"]
        data = blob.encode() if isinstance(blob, str) else bytes(blob)
        return np.asarray(Image.open(io.BytesIO(data)))

    left = image("/world/camera/left", 0)
    assert left.shape == (180, 320)
    assert left[:, :150].max() < 20
    assert left[:, 170:].min() > 180
    right = image("/world/camera/right", 0)
    # Blue came first in BGR and is last in RGB.
    assert (np.abs(right.astype(int) - [0, 0, 250]) < 12).all()
    assert image("/pa", AIMS).ndim == 2


def test_outline_and_corner_lie_on_the_left_image(recorded: Recorded) -> None:
    strip = np.array(recorded.at("/world/camera/left/marker/outline", 0).values["LineStrips2D:strips"][0])
    np.testing.assert_allclose(strip, [[1, 2], [3, 2], [3, 4], [1, 4], [1, 2]])
    corner = recorded.at("/world/camera/left/corner/spot", 0)
    np.testing.assert_allclose(corner.array("Points2D:positions"), [[7, 8]])
    # The next shot had neither: what is there is cleared.
    cleared = [row.shot for row in recorded.rows["/world/camera/left/marker"] if "Clear:is_recursive" in row.values]
    assert 1 in cleared
    assert all(row.shot == 0 for row in recorded.rows["/world/camera/left/marker/outline"])


def test_the_detection_is_marked_on_its_frame_and_cleared_where_there_is_none(recorded: Recorded) -> None:
    captions = {row.shot: row.values["Points2D:labels"][0] for row in recorded.rows["/pa/caption"]}
    look = recorded.measurements.pairs[0].look
    assert captions == {
        AIMS: f"shot {AIMS}: x {look.x_mm:.1f} mm, range {look.range_mm:.1f} mm",
        AIMS + 1: f"shot {AIMS + 1}: no source found",
    }
    front = recorded.at("/pa/detection/wavefront", AIMS).array("Points2D:positions")
    assert len(front) > 10
    assert [row.shot for row in recorded.rows["/pa/detection/spot"]] == [AIMS]
    assert [row.shot for row in recorded.rows["/pa/detection"]] == [AIMS, AIMS + 1]


def test_frames_lie_on_the_image_plane_and_a_plain_plane_where_there_is_none(recorded: Recorded) -> None:
    rows = recorded.rows["/world/stage/plane"]
    planes = {row.shot: len(row.values["Mesh3D:albedo_texture_buffer"][0]) > 3 for row in rows}  # more than a pixel
    assert planes == {AIMS: True, AIMS + 1: True, AIMS + 2: False}


def test_cameras_have_their_intrinsics_and_the_right_one_stands_beside_the_left(recorded: Recorded) -> None:
    (left,) = [row for row in recorded.rows["/world/camera/left"] if "Pinhole:image_from_camera" in row.values]
    assert left.shot is None
    matrix = left.array("Pinhole:image_from_camera").reshape(3, 3).T
    np.testing.assert_allclose(matrix, [[300, 0, 160], [0, 310, 90], [0, 0, 1]])
    (right,) = [row for row in recorded.rows["/world/camera/right"] if "Transform3D:translation" in row.values]
    np.testing.assert_allclose(transform_of(right)[:3, 3], [5.0, 0.0, 0.0])


def test_the_truth_is_shown_beside_the_estimate(recorded: Recorded) -> None:
    (pms,) = recorded.rows["/world/truth/pms"]
    np.testing.assert_allclose(pms.array("Points3D:positions"), list(recorded.truth.trus_p_pm_mm.values()), atol=1e-4)
    assert [row.shot for row in recorded.rows["/world/truth/camera"]] == [
        row.shot for row in recorded.rows["/world/camera"]
    ]


def test_the_blueprint_shows_world_images_text_and_plots(recorded: Recorded) -> None:
    shown = views(recorded.path)
    assert set(shown) == {
        "verdict",
        "world",
        "scale",
        "legend",
        "world/camera/left",
        "world/camera/right",
        "pa",
        "summary",
        "log",
        "plots/residual_mm",
        "plots/nis",
        "plots/rotation_deg",
        "plots/lambda_mm",
    }
    names = [name for origin, name in views_of(recorded.path) if origin == "world"]
    assert sorted(names) == ["Predicted error at the targets: 95 % bound, mm", "Scene"]
    # A title of more than this is cut at 1600 px; the errors have the widest view.
    assert all(len(name) <= 40 for origin, name in views_of(recorded.path) if origin != "world")


def test_the_summary_says_ok_and_the_log_why_a_look_was_left_out(recorded: Recorded) -> None:
    (page,) = recorded.rows["/summary"]
    assert page.values["TextDocument:text"][0].startswith("# OK")
    said = recorded.at(f"/log/{AIMS + UNUSED}", AIMS + UNUSED)
    assert "range is 4.1 sigma off" in said.values["TextLog:text"][0]
    assert said.values["TextLog:level"][0] == "WARN"


def test_the_endoscope_shows_pms_beam_and_plane_where_its_bent_picture_has_them(recorded: Recorded) -> None:
    assert recorded.model.camera is not None
    camera = recorded.model.camera.left
    shot = AIMS + 2
    pair = recorded.measurements.pairs[2]
    camera_T_trus = inverse(recorded.truth.trus_T_camera[pair.epoch])

    def pixels(points: FloatArray) -> FloatArray:
        return project_points(camera, (np.c_[points, np.ones(len(points))] @ camera_T_trus.T)[:, :3])

    known = np.array([recorded.truth.trus_p_pm_mm[p.pm] for p in recorded.measurements.pairs[:3]])
    spots = recorded.at(f"/{endoscope_view.PATH}/pms", shot).array("Points2D:positions")
    np.testing.assert_allclose(spots, pixels(known), atol=0.01)
    beam = np.array(recorded.at(f"/{endoscope_view.PATH}/beam", shot).values["LineStrips2D:strips"][0])
    np.testing.assert_allclose(beam[-1], spots[-1], atol=0.01)
    straight = beam[0] + np.linspace(0.0, 1.0, len(beam))[:, None] * (beam[-1] - beam[0])
    across = np.abs(np.cross(np.append(beam[-1] - beam[0], 0.0), np.c_[beam - straight, np.zeros(len(beam))])[:, 2])
    assert across.max() / np.linalg.norm(beam[-1] - beam[0]) > 0.05  # px: the lens bends it
    plane = np.array(recorded.at(f"/{endoscope_view.PATH}/plane", shot).values["LineStrips2D:strips"][0])
    scan, half = pair.look.scan_rad, 0.5 * recorded.model.probe.elements * recorded.model.probe.pitch_mm
    radius = recorded.model.probe.radius_mm
    face = np.array([[side * half, radius * math.sin(scan), radius * math.cos(scan)] for side in (-1.0, 1.0)])
    np.testing.assert_allclose(plane[[0, endoscope_lines.POINTS - 1]], pixels(face), atol=0.01)


def test_frames_are_named_and_labels_do_not_cover_each_other(recorded: Recorded) -> None:
    blueprint = read_recording(recorded.path, blueprint=True)
    controls = [row for rows in blueprint.values() for row in rows if "EyeControls3D:position" in row.values]
    eyes = [
        scene.Eye(row.array("EyeControls3D:position")[0], row.array("EyeControls3D:look_target")[0]) for row in controls
    ]
    scores = []
    for eye in eyes:
        shared = 0.0
        for row in recorded.rows["/world/shot/labels"]:
            words = row.values["Points3D:labels"]
            seen = eye.seen(row.array("Points3D:positions"))
            boxes = [scene.label_box(word, at, WORLD_PX) for word, at in zip(words, seen, strict=True)]
            for i, first in enumerate(boxes):
                for second in boxes[:i]:
                    sides = np.minimum(first[2:], second[2:]) - np.maximum(first[:2], second[:2])
                    shared += float(np.prod(np.maximum(sides, 0.0)))
        scores.append(shared)
    assert min(scores) == pytest.approx(0.0, abs=1.0)  # by the scene's eye; the other is that of the errors
    named = set(recorded.words(AIMS + 1))
    assert {"TRUS x: rotation axis", "y", "z", "camera", "marker", "laser", "TRUS probe"} <= named


def record(
    path: Path, model: SessionModel, measurements: Measurements, estimate: SessionEstimate
) -> dict[str, list[Row]]:
    with open_viewer(path, model.name) as viewer:
        viewer.session(model, LIMIT_MM)
        viewer.result(model, measurements, estimate)
    return read_recording(path)


def test_a_refused_registration_says_so_everywhere(tmp_path: Path) -> None:
    rng = np.random.default_rng(12)
    model, measurements, truth = make_measurements(rng, aims=0, pairs=4, session=make_model())
    estimate = answer_from_truth(
        rng, model, measurements, truth, verdict=Verdict.REFUSED, reasons=("two registrations fit",)
    )
    path = tmp_path / "refused.rrd"
    rows = record(path, model, measurements, estimate)
    assert rows["/verdict/word"][0].values["Points2D:labels"][0].startswith("REFUSED: do not use")
    page = rows["/summary"][0].values["TextDocument:text"][0]
    assert page.startswith("# REFUSED: do not use this registration")
    assert "- two registrations fit → [from shot 0 (PM " in page
    shown = [name for origin, name in views_of(path) if origin == "world"]
    assert "Scene: REFUSED" in shown
    assert not {"pa", "world/camera/left"} & set(views(path))
    # Told by the camera's colour, by what crosses its picture out, and by its name.
    colors = [row.values["Pinhole:color"][0] for row in rows["/world/camera/left"] if "Pinhole:color" in row.values]
    assert colors == [int.from_bytes(bytes((*palette.REFUSED, 255)), "big")]
    assert len(rows["/world/camera/crossed"][-1].values["LineStrips3D:strips"]) == 2
    assert "camera: REFUSED" in rows["/world/shot/labels"][-1].values["Points3D:labels"]
    # Nothing in the endoscope's picture says where PMs and image plane are.
    assert not {f"/{endoscope_view.PATH}/{name}" for name in ("plane", "pms", "beam")} & rows.keys()
    assert f"/{endoscope_view.PATH}/refused" in rows
    blueprint = read_recording(path, blueprint=True)
    backgrounds = {
        row.values["Background:color"][0]
        for entity in blueprint.values()
        for row in entity
        if "Background:color" in row.values
    }
    assert any(color >> 24 & 255 > 2 * (color >> 16 & 255) for color in backgrounds)


def test_an_epoch_without_a_registration_hides_its_camera_instead_of_standing_at_the_origin(tmp_path: Path) -> None:
    rng = np.random.default_rng(13)
    model, measurements, truth = make_measurements(rng, aims=0, pairs=4, epochs=2)
    estimate = answer_from_truth(rng, model, measurements, truth, verdict=Verdict.REFUSED)
    lost = replace(estimate.epochs[1], trus_T_camera=None, covariance=None, predicted_tre=None)
    estimate = replace(estimate, epochs=(estimate.epochs[0], lost))
    rows = record(tmp_path / "lost.rrd", model, measurements, estimate)
    second = rows["/world/camera"][1]
    assert second.shot == 2
    # To a frame that is nowhere. A scale of 0 is a mistake to Rerun 0.41, which then draws the camera at the origin.
    assert second.values["Transform3D:parent_frame"] == ["not known"]
    assert "Transform3D:translation" not in second.values
    assert [shot for shot in range(4) if "Arrows3D:origins" in rows[f"/world/looks/{shot}"][0].values] == [0, 1]
    assert all("LineStrips3D:strips" in rows[f"/world/looks/{shot}"][0].values for shot in range(4))


def test_what_was_not_detected_or_is_not_finite_is_left_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(14)
    model, measurements, truth = make_measurements(rng, aims=0, pairs=3)
    estimate = answer_from_truth(rng, model, measurements, truth)
    pairs = (
        replace(estimate.pairs[0], nis=math.inf, covariance=np.diag([1.0, 1e8, 1.0])),
        replace(estimate.pairs[1], used=False, reason="no marker found", lambda_mm=None, trus_p_pm_mm=None),
        estimate.pairs[2],
    )
    heard = replace(measurements, pairs=(measurements.pairs[0], measurements.pairs[2]))
    rows = record(tmp_path / "part.rrd", model, heard, replace(estimate, pairs=pairs))
    assert [row.shot for row in rows["/plots/nis/pair"] if row.shot is not None] == [2]
    assert [shot for shot in range(3) if f"/world/looks/{shot}" in rows] == [0, 2]
    sizes = [len(rows[f"/world/looks/{shot}"][0].values["Ellipsoids3D:half_sizes"]) for shot in (0, 2)]
    assert sizes == [0, 1]


def test_a_session_without_shots_makes_a_recording(tmp_path: Path) -> None:
    estimate = SessionEstimate("empty", Verdict.REFUSED, ("no pairs",), None, (), (), ())
    rows = record(tmp_path / "empty.rrd", make_session(), Measurements((), (), ()), estimate)
    assert "/world/probe" in rows
    assert "/verdict" in rows


def test_a_crash_leaves_neither_a_file_nor_a_changed_one(tmp_path: Path) -> None:
    path = tmp_path / "phantom.rrd"
    path.write_bytes(b"RRF2 an older one of fgreg")

    def crash() -> None:
        with open_viewer(path, "phantom") as viewer:
            viewer.session(make_session(), LIMIT_MM)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        crash()
    assert path.read_bytes() == b"RRF2 an older one of fgreg"
    assert list(tmp_path.iterdir()) == [path]


def test_a_recording_takes_the_place_of_an_older_one_and_leaves_no_other_file(tmp_path: Path) -> None:
    path = tmp_path / "phantom.rrd"
    for _ in range(2):
        with open_viewer(path, "phantom") as viewer:
            viewer.session(make_session(), LIMIT_MM)
    assert "/world/probe" in read_recording(path)
    assert "world" in views(path)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("failure", ["", "File-writer thread shut down prematurely"])
def test_a_recording_that_is_not_written_to_its_end_leaves_the_older_one(
    failure: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "phantom.rrd"
    path.write_bytes(b"RRF2 an older one of fgreg")
    real = shapes.Recorder.close

    def close(recorder: shapes.Recorder) -> None:
        real(recorder)
        (part,) = tmp_path.glob(".phantom.rrd.*.part")
        os.truncate(part, part.stat().st_size - 5)
        if failure:
            raise RuntimeError(failure)

    monkeypatch.setattr(shapes.Recorder, "close", close)
    with pytest.raises(InputError, match="a recording that cannot be written"), open_viewer(path, "phantom") as viewer:
        viewer.session(make_session(), LIMIT_MM)
    assert path.read_bytes() == b"RRF2 an older one of fgreg"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_does_not_exist_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        open_viewer(tmp_path / "nowhere" / "a.rrd", "a")
    with pytest.raises(InputError, match="found a folder"):
        open_viewer(tmp_path, "a")


def test_nothing_but_a_recording_is_written_over(tmp_path: Path) -> None:
    for name, content, found in (
        ("events.jsonl", b"{}", "the name of a session's own file"),
        ("notes.txt", b"{}", "a file that is not a recording"),
        ("other.rrd", b"RRF2 of another program", "a file that is not a recording"),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(InputError, match=found):
            open_viewer(path, "a")
        assert path.read_bytes() == content


def test_the_null_viewer_takes_every_call_and_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    viewer = open_viewer(None, "phantom")
    assert isinstance(viewer, NullViewer)
    for name, method in vars(Viewer).items():
        if inspect.isfunction(method) and not name.startswith("_"):
            getattr(viewer, name)()
    rng = np.random.default_rng(15)
    model, measurements, truth = make_measurements(rng, aims=1, pairs=2)
    with viewer:
        viewer.session(model, LIMIT_MM)
        viewer.result(model, measurements, answer_from_truth(rng, model, measurements, truth))
    assert not list(tmp_path.iterdir())


def test_rerun_is_not_imported_before_a_recording_is_asked_for() -> None:
    code = (
        "import sys; from fgreg.viewer.null_viewer import open_viewer\n"
        "with open_viewer(None, 'x') as v: pass\n"
        "print(sorted({'rerun', 'cv2'}.intersection(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, timeout=60, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"
