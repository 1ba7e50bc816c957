"""A session under way as the viewer and the terminal show it: poses, next step, lost devices."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from fgreg.cli.live_display import page as terminal_page
from fgreg.cli.live_display import status_rows, word_rows
from fgreg.drivers.base import BmodeFrame, host_now
from fgreg.live.actions import RegistrationState, StageView
from fgreg.live.recorder import RecorderState
from fgreg.live.status import Figures, Status
from fgreg.live.viewer_feed import RerunFeed
from fgreg.model.estimate import PredictedTre, TrackEstimate, Verdict
from fgreg.model.measurements import MarkerObservation, Track
from fgreg.model.time_sync import Stamp
from fgreg.online.estimate import OnlineEstimate
from fgreg.viewer import shapes
from fgreg.viewer.endoscope_view import PATH, REFUSED
from fgreg.viewer.live import ViewerUpdate
from fgreg.viewer.null_viewer import NullViewer
from fgreg.viewer.picture_ring import PictureRing
from fgreg.viewer.recording import Viewer
from fgreg.viewer.shapes import CANVAS, canvas
from fgreg.viewer.status_line import Now
from tests.overlay_status import room_status
from tests.recordings import Row, read_recording, transform_of, views, views_of
from tests.test_viewer_recording import make_model

SCAN_RAD, GOAL_RAD = math.radians(20.0), math.radians(26.0)
NOW = Now("following", "go on", scan_rad=SCAN_RAD, homed=True, goal_rad=GOAL_RAD, sigma_rad=math.radians(0.8))
TRUS_T_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0]) + np.array([[0, 0, 0, 5.0], [0] * 4, [0, 0, 0, 120.0], [0] * 4])
PICTURE = np.arange(40 * 30, dtype=np.uint32).astype(np.uint8).reshape(40, 30)


def bmode(placed: bool = True) -> BmodeFrame:
    return BmodeFrame(Stamp(0.0, 0.0), PICTURE, 0, (0.5, 0.25), (2.0, -3.0) if placed else None)


def update(number: int, now: Now, verdict: Verdict | None = Verdict.OK) -> ViewerUpdate:
    """``verdict`` None: no registration."""
    track = Track(float(number), 0, MarkerObservation(np.eye(4), np.eye(6), number), ())
    return ViewerUpdate(
        float(number),
        number,
        track,
        "",
        None if verdict is None else TRUS_T_CAMERA,
        None if verdict is None else 0.01 * np.eye(6),
        None,
        None if verdict is None else PredictedTre(0.9, 1.2, 1.5),
        verdict or Verdict.REFUSED,
        ("a reason",),
        9,
        None,
        False,
        now=now,
        epoch=2,
    )


def recorded(path: Path, shown: list[tuple[ViewerUpdate, BmodeFrame | None]]) -> dict[str, list[Row]]:
    with Viewer(path, "live") as viewer:
        viewer.session(make_model(), 3.0)
        for one, picture in shown:
            viewer.bmode(one.t, one.number, picture)
            viewer.update(one)
    return read_recording(path)


def test_of_pictures_between_events_the_file_keeps_the_newest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shapes, "PASSING_BYTES", 60_000)
    image = np.random.default_rng(1).integers(0, 255, (64, 64), dtype=np.uint8)
    with Viewer(tmp_path / "a.rrd", "live") as viewer:
        viewer.session(make_model(), 3.0)
        for number in range(60):
            event = number in (3, 30)
            viewer.shot_images(float(number), "pair" if event else "track", number, image, passing=not event)
            viewer.update(update(number, NOW))
    rows = read_recording(tmp_path / "a.rrd")
    of_left = rows["/world/camera/left"]
    shots = [row.shot for row in of_left if row.shot is not None and "EncodedImage:blob" in row.values]
    assert {3, 30, 59} <= set(shots)
    kept = sorted(shot for shot in shots if shot not in (3, 30))
    assert 5 < len(kept) < 25
    assert kept == list(range(kept[0], 60)), "all of the last ones"
    assert len(rows["/summary"]) == 60, "only pictures are dropped"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.rrd"]


class FullDisk(io.BytesIO):
    """Takes half of what it is given."""

    def write(self, entry: Any) -> int:
        return len(entry) // 2


def test_of_entries_of_any_size_the_newest_are_kept_unharmed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = np.random.default_rng(2).integers(1, 300, 200)
    added = [bytes([number]) * int(size) for number, size in enumerate(sizes)]
    with PictureRing(1000, tmp_path) as ring:
        for number, entry in enumerate(added):
            ring.add(entry)
            kept = list(ring)
            assert kept == added[number + 1 - len(kept) : number + 1]
            assert len(kept) >= 1
        assert ring.dropped == len(added) - len(kept)
        ring._file.close()
        monkeypatch.setattr(ring, "_file", FullDisk())
        dropped = ring.dropped
        for _ in range(20):
            ring.add(bytes(100))
        assert ring.dropped >= dropped + 20


def page(rows: dict[str, list[Row]], number: int) -> str:
    (found,) = [row.values["TextDocument:text"][0] for row in rows["/summary"] if row.shot == number]
    return str(found)


def test_the_plane_is_at_the_stage_s_angle_and_the_goal_at_the_beam_s_predicted_angle(tmp_path: Path) -> None:
    rows = recorded(tmp_path / "a.rrd", [(update(0, NOW), None)])
    for entity, scan_rad in (("/world/stage", SCAN_RAD), ("/world/goal", GOAL_RAD)):
        up = transform_of(rows[entity][-1])[:3, :3] @ [0.0, 0.0, 1.0]
        np.testing.assert_allclose(up, [0.0, math.sin(scan_rad), math.cos(scan_rad)], atol=1e-6)
    # The model's stage counts the other way from 5 degrees: its own angles are what is written.
    assert "image plane, stage -15.0°" in rows["/world/shot/labels"][-1].values["Points3D:labels"]
    assert rows["/world/goal/label"][-1].values["Points3D:labels"] == ["beam at -21.0° ± 0.8° (1 sigma)"]
    text = page(rows, 0)
    assert text.startswith("# OK")
    assert "## Next: go on" in text
    assert "at -15.0°; beam at -21.0° ± 0.8° (1 sigma), 6.0° away" in text
    assert "1.50 mm" in text
    assert "9 pairs in camera epoch 2" in text
    assert {"Now", "Verdict", "Scene (live)"} <= {name for _, name in views_of(tmp_path / "a.rrd")}


def test_a_bmode_picture_lies_in_the_plane_with_its_pixels_size_and_goes_when_its_scanner_goes(tmp_path: Path) -> None:
    lost = replace(NOW, lost=("bmode",))
    rows = recorded(tmp_path / "a.rrd", [(update(0, NOW), bmode()), (update(1, lost), None)])
    with_it, without = rows["/world/stage/plane"]
    corners = with_it.array("Mesh3D:vertex_positions")
    radius = make_model().probe.radius_mm
    # Centre of the first pixel: 2 mm deep, x = -3; 40 rows of 0.5 mm, 30 columns of 0.25 mm.
    np.testing.assert_allclose(corners[0], [-3.125, 0.0, radius + 1.75], atol=1e-5)
    np.testing.assert_allclose(corners[2], [-3.125 + 7.5, 0.0, radius + 1.75 + 20.0], atol=1e-5)
    assert len(with_it.values["Mesh3D:albedo_texture_buffer"][0]) == 40 * 30 * 3
    assert len(without.values["Mesh3D:albedo_texture_buffer"][0]) == 3  # not the picture before it
    assert rows["/bmode/caption"][-1].values["Points2D:labels"] == ["no picture"]
    assert "# LOST: bmode" in page(rows, 1)
    assert rows["/verdict/word"][-1].values["Points2D:labels"] == ["OK; LOST: bmode"]


def test_a_picture_of_unknown_geometry_is_shown_in_its_view_only_and_says_so(tmp_path: Path) -> None:
    rows = recorded(tmp_path / "a.rrd", [(update(0, NOW), bmode(placed=False))])
    assert "its position in the plane is not known" in rows["/bmode/caption"][-1].values["Points2D:labels"][0]
    (plane,) = rows["/world/stage/plane"]
    assert len(plane.values["Mesh3D:albedo_texture_buffer"][0]) == 3


def test_without_a_registration_no_camera_stands_anywhere_and_lost_devices_are_to_be_got_back(tmp_path: Path) -> None:
    gone = replace(NOW, lost=("camera", "stage", "sink 1"), scan_rad=None, goal_rad=None)
    rows = recorded(tmp_path / "a.rrd", [(update(0, NOW, None), bmode()), (update(1, gone, None), None)])
    for entity in ("/world/camera", "/world/stage", "/world/camera/marker"):
        assert rows[entity][-1].values["Transform3D:parent_frame"] == ["not known"]
    text = page(rows, 1)
    assert text.startswith("# No registration yet")
    assert "## Next: get the camera and the stage back" in text
    assert "**Stage:** LOST" in text
    assert rows["/world/goal"][-1].values["Clear:is_recursive"] == [True]


def test_a_refused_registration_s_camera_is_crossed_out_as_long_as_it_is_refused(tmp_path: Path) -> None:
    shown = [update(number, NOW, verdict) for number, verdict in enumerate((Verdict.OK, Verdict.REFUSED, Verdict.OK))]
    rows = recorded(tmp_path / "a.rrd", [(one, None) for one in shown])
    crossed = {row.shot: row.values for row in rows["/world/camera/crossed"]}
    assert [number for number, values in crossed.items() if "LineStrips3D:strips" in values] == [1]
    assert crossed[2]["Clear:is_recursive"] == [True]
    colors = [row.values["Pinhole:color"][0] for row in rows["/world/camera/left"] if "Pinhole:color" in row.values]
    assert len(colors) == 3
    assert colors[0] == colors[2] != colors[1]
    said = {
        row.shot: row.values["Points2D:labels"] for row in rows[f"/{PATH}/refused"] if "Points2D:labels" in row.values
    }
    assert said == {1: [REFUSED]}


def test_the_last_picture_says_that_the_session_is_over(tmp_path: Path) -> None:
    rows = recorded(tmp_path / "a.rrd", [(update(0, NOW), None), (update(1, replace(NOW, ended=True)), None)])
    assert page(rows, 1).startswith("# THE SESSION HAS ENDED")
    assert "Next:" not in page(rows, 1)
    assert "Now" in views(tmp_path / "a.rrd").values()  # closing takes no view away


def status(verdict: Verdict | None, lost: tuple[str, ...] = (), reasons: tuple[str, ...] = ()) -> Status:
    known = RegistrationState(verdict or Verdict.REFUSED, reasons, 1, 12, verdict is not None)
    estimate = OnlineEstimate(
        1.0, 1, None, None, PredictedTre(1.0, 1.5, 1.87), None, False, known.verdict, reasons, 12, None, True
    )
    device = make_model().stage.device_from_scan(GOAL_RAD)
    answer = TrackEstimate(1.0, device, math.radians(0.8), 30.0, causal=True)
    plane = None if "stage" in lost else StageView(SCAN_RAD, False, True, 1.0)
    state = RecorderState(known, estimate, 8, 12, trouble="No space left on device" if lost else "")
    return Status(1.0, 1.0, "following", "news [red]", "hold it still", state, answer, plane, "", lost, None, None)


@pytest.mark.parametrize(
    ("shown", "expected"),
    [
        (
            status(Verdict.OK),
            ["OK", "1.87 mm", "hold it still", "at -15.0°; beam at -21.0° ± 0.8° (1 sigma)"],
        ),
        (
            replace(status(Verdict.OK), tracking=None, invalid="the camera is moving"),
            ["REFUSED", "not known yet", "the camera is moving"],
        ),
        (status(None, ("camera", "stage")), ["none yet", "camera, stage", "get the camera and the stage back", "LOST"]),
        (status(Verdict.REFUSED, ("bmode",), ("long " * 300, "short", "third")), ["REFUSED", "bmode", "No space left"]),
    ],
)
def test_the_panel_says_it_all_on_a_small_terminal(shown: Status, expected: list[str]) -> None:
    console = Console(width=80, height=24, force_terminal=False, highlight=False, record=True, file=io.StringIO())
    figures = Figures(frames=89_000, skipped=120, found=76_000, pictures=12_000, unshown=333)
    said = tuple((f"12:00:0{i}", f"message {i} [red] " + 40 * "long ") for i in range(4))
    rows = [*status_rows(figures, make_model().stage, shown), *word_rows(shown, said, "sear")]
    console.print(terminal_page(rows, console))
    text = console.export_text()
    assert all(word in text for word in [*expected, "message 3 [red]", "stop (x, or an empty line)", "sear_"]), text
    assert len(text.splitlines()) <= 23
    assert all(len(line) <= 80 for line in text.splitlines())


def test_pictures_of_any_size_and_kind_are_shown_on_one_canvas() -> None:
    grey = canvas(PICTURE)
    assert grey.shape == (CANVAS, CANVAS, 3)
    np.testing.assert_array_equal(grey[: 40 * 12 : 12, : 30 * 12 : 12, 1], PICTURE)  # 12 times fits, 13 would not
    assert not grey[40 * 12 :].any()
    colour = np.zeros((1200, 900, 3), dtype=np.uint8)
    colour[..., 2] = 9
    np.testing.assert_array_equal(canvas(colour)[:400, :300], colour[::3, ::3])
    assert not canvas(colour)[400:].any()


@pytest.mark.parametrize("registered", [False, True])
def test_the_viewer_names_a_slow_machine_as_a_cause(registered: bool) -> None:
    room, updates = room_status(rendered=False), list[ViewerUpdate]()

    class Shown(NullViewer):
        def update(self, update: ViewerUpdate) -> None:
            updates.append(update)

    feed = RerunFeed(Shown())
    feed.session(room.model, 3.0)
    recorder = RecorderState(RegistrationState(), room.estimate if registered else None)
    feed.status(room.at(host_now(), recorder=recorder, slow="this machine is slow"))
    feed.close()
    assert all(update.reasons[0] == "this machine is slow" for update in updates)
    assert updates
