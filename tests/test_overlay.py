"""The overlay: what lies where in the endoscope's picture, nothing of a refused registration, its sinks."""

from __future__ import annotations

import math
import socket
from dataclasses import dataclass, field, replace
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from fgreg.drivers import overlay_window
from fgreg.drivers.base import DeviceLost, OverlayPicture, StereoFrame, host_now
from fgreg.drivers.options import WindowOptions
from fgreg.drivers.overlay_picture import overlay_picture
from fgreg.drivers.tcp_link import Endpoint
from fgreg.errors import InputError
from fgreg.geometry.transforms import FloatArray, inverse, transform_points
from fgreg.live.loop import LiveLoop
from fgreg.live.overlay_feed import OLD
from fgreg.live.recorder import RecorderState
from fgreg.live.status import Devices
from fgreg.live.workflow import Workflow, WorkflowSettings
from fgreg.model.estimate import Verdict
from fgreg.model.events import NoteEvent
from fgreg.model.time_sync import Stamp
from fgreg.online.shared_snapshot import NoSnapshotError, Received
from fgreg.simulation.lens import project_points
from fgreg.viewer import palette
from tests.igtl_bytes import message, read_message
from tests.network_peers import wait_for
from tests.overlay_status import BESIDE_RAD, RoomStatus, room_status


@dataclass
class Screen:
    """A sink that keeps the pictures; ``fails``: the next ones are losses."""

    name: str = "screen"
    connected: bool = True
    dropped: int = 0
    fails: bool = False
    raises: Exception = field(default_factory=lambda: DeviceLost("unplugged"))
    shown: list[OverlayPicture] = field(default_factory=list)

    def send(self, picture: OverlayPicture) -> None:
        if self.fails:
            raise self.raises
        self.shown.append(picture)

    def close(self) -> None:
        """Nothing held."""


@pytest.fixture(scope="module")
def room() -> RoomStatus:
    return room_status(rendered=False)


def pixels(room: RoomStatus, trus_p_mm: FloatArray) -> FloatArray:
    assert room.model.camera is not None
    points = transform_points(inverse(room.room.trus_T_camera(room.t)), np.reshape(trus_p_mm, (-1, 3)))
    return np.asarray(project_points(room.model.camera.left, points))


def color_near(picture: npt.NDArray[np.uint8], at: FloatArray, color: palette.Color, reach: int) -> bool:
    x, y = (round(float(value)) for value in at)
    patch = picture[y - reach : y + reach + 1, x - reach : x + reach + 1].reshape(-1, 3).astype(int)
    return bool((np.abs(patch - np.array(color[::-1])).max(axis=1) < 12).any())


def drawn(room: RoomStatus, verdict: Verdict = Verdict.OK, **changes: object) -> npt.NDArray[np.uint8]:
    assert room.model.camera is not None
    feed = room.fed([])
    try:
        state = feed.state(room.with_verdict(verdict, host_now(), **changes))
    finally:
        feed.close()
    return overlay_picture(np.asarray(room.frame.left, np.uint8), room.model.camera.left, state)


def test_lines_and_marks_lie_where_the_lens_shows_them(room: RoomStatus) -> None:
    picture, before = drawn(room), room.frame.left
    assert picture.shape == (*before.shape, 3)
    spot = pixels(room, room.room.spot_mm(room.t))[0]
    x, y = (round(float(value)) for value in spot)
    assert (picture[y - 4 : y + 5, x - 4 : x + 5] == before[y - 4 : y + 5, x - 4 : x + 5, None]).all()
    assert color_near(picture, spot, palette.BEAM, 12)
    laser = room.room.trus_T_marker(room.t) @ room.room.marker_T_laser
    middle = pixels(room, 0.5 * (laser[:3, 3] + room.room.spot_mm(room.t)))[0]
    assert color_near(picture, middle, palette.BEAM, 2)
    stage = room.model.stage
    for pair in room.pairs[:-1]:
        scan = stage.scan_from_device(math.radians(pair.trus.scan_deg))
        assert pair.trus.x_mm is not None
        assert pair.trus.range_mm is not None
        radius = room.model.probe.radius_mm + pair.trus.range_mm
        pm = pixels(room, np.array([pair.trus.x_mm, radius * math.sin(scan), radius * math.cos(scan)]))[0]
        assert color_near(picture, pm, palette.PM, 3)
    goal, radius = room.room.plane_rad(room.t), room.model.probe.radius_mm
    half = 0.5 * room.model.probe.elements * room.model.probe.pitch_mm
    for scan, color in ((goal - BESIDE_RAD, palette.PLANE), (goal, palette.GOAL)):
        corner = pixels(room, np.array([half, radius * math.sin(scan), radius * math.cos(scan)]))[0]
        assert color_near(picture, corner, color, 12)


def test_nothing_is_drawn_but_the_banner_where_the_registration_may_not_be_used(room: RoomStatus) -> None:
    before = np.repeat(room.frame.left[..., None], 3, axis=2)
    banner = 100
    pictures = {
        "refused": drawn(room, Verdict.REFUSED),
        "invalid": drawn(room, Verdict.OK, invalid="the camera is moving"),
        "old": drawn(room, Verdict.OK, lost=("camera",)),
        "none": overlay_none(room),
    }
    for why, picture in pictures.items():
        assert (picture[banner:] == before[banner:]).all(), why
        assert not (picture[:banner] == before[:banner]).all(), why
    assert (drawn(room, Verdict.WARNING)[banner:] != before[banner:]).any()


def overlay_none(room: RoomStatus) -> npt.NDArray[np.uint8]:
    """The picture before there is a registration."""
    estimate = replace(room.estimate, trus_T_camera=None, verdict=Verdict.REFUSED)
    status = room.at(host_now())
    return drawn(room, recorder=replace(status.recorder, estimate=estimate))


def test_the_verdict_is_told_by_form_as_well_as_by_colour(room: RoomStatus) -> None:
    greys = [cv2.cvtColor(drawn(room, verdict)[:50], cv2.COLOR_BGR2GRAY) for verdict in Verdict]
    signs, patterns = [grey[:, :86] > 60 for grey in greys], [grey[10:40, 1100:].std() for grey in greys]
    for first, second in ((0, 1), (0, 2), (1, 2)):
        assert (signs[first] != signs[second]).mean() > 0.05
    assert patterns[0] < 2.0 < 20.0 < min(patterns[1:])


def test_a_picture_of_another_size_than_calibrated_shows_no_lines(room: RoomStatus) -> None:
    assert room.model.camera is not None
    feed = room.fed([])
    state = feed.state(room.at(host_now()))
    feed.close()
    small = np.full((180, 320), 90, np.uint8)
    picture = overlay_picture(small, room.model.camera.left, state)
    assert (picture[40:] == 90).all()


def test_a_pm_left_out_by_hand_is_a_cross(room: RoomStatus, screen: Screen) -> None:
    feed = room.fed([screen])
    try:
        now = host_now()
        both = feed.state(room.at(now)).seen
        status = room.at(now, recorder=replace(room.at(now).recorder, excluded=frozenset({1})))
        seen = feed.state(status).seen
        assert (len(seen.pms), len(seen.unused)) == (len(both.pms) - 1, len(both.unused) + 1)
    finally:
        feed.close()


@pytest.fixture
def screen() -> Screen:
    return Screen()


def test_each_frame_is_shown_once_and_an_old_one_again_without_lines(room: RoomStatus, screen: Screen) -> None:
    feed = room.fed([screen])
    try:
        feed.show(room.at(host_now()))
        wait_for(lambda: len(screen.shown) == 1)
        feed.show(room.at(host_now()))
        feed.show(room.at(host_now() + 1.0, lost=("camera",)))
        wait_for(lambda: len(screen.shown) == 2)
        first, again = screen.shown
        assert first.stamp == again.stamp == room.frame.stamp
        assert (again.image[100:] == room.frame.left[100:, :, None]).all()
        assert OLD in feed.state(room.at(host_now(), lost=("camera",))).hidden
        screen.fails = True
        now = host_now()
        feed.show(room.at(now, replace(room.frame, index=1)))
        wait_for(lambda: not screen.shown[2:] and feed._losses)
        assert feed.losses() == [(0, "unplugged")]
        assert feed.losses() == []
        screen.raises = RuntimeError("of a library")
        feed.show(room.at(now, replace(room.frame, index=2)))
        wait_for(lambda: feed._losses)
        assert "RuntimeError: of a library" in feed.losses()[0][1]
        screen.fails = False
        feed.show(room.at(now, replace(room.frame, index=3)))
        wait_for(lambda: screen.shown[2:])
    finally:
        feed.close()


def test_a_receiver_gets_the_picture_with_the_time_of_its_exposure(room: RoomStatus) -> None:
    pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")
    from fgreg.drivers.igtl_overlay import IgtlPictureSink

    sink = IgtlPictureSink(Endpoint.listening(0))
    image = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    try:
        with socket.create_connection(("127.0.0.1", sink.endpoint.port), timeout=5.0) as peer:
            wait_for(lambda: sink.connected)
            sink.send(OverlayPicture(room.frame.stamp, image, 0))
            for _ in range(2):
                told = read_message(peer.recv(1 << 16))
                assert (told.kind, told.device) == ("IMAGE", "Overlay")
                pixels = np.frombuffer(told.content[72:], np.uint8).reshape(4, 6, 3)
                np.testing.assert_array_equal(pixels, image[..., ::-1])  # RGB
                peer.sendall(message("GET_IMAGE", "", b""))
            with socket.create_connection(("127.0.0.1", sink.endpoint.port), timeout=5.0) as late:
                late.sendall(message("GET_CAPABIL", "", b""))
                assert read_message(late.recv(1 << 16)).kind == "CAPABILITY"  # and no picture, which may be refused now
        with pytest.raises(DeviceLost, match=r"overlay: 127\.0\.0\.1:\d+: "):
            wait_for(lambda: sink.send(OverlayPicture(room.frame.stamp, image, 1)))
    finally:
        sink.close()


def test_without_windows_or_display_there_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "getBuildInformation", lambda: "\n  GUI:                           NONE\n")
    with pytest.raises(InputError, match="an OpenCV without windows, expected one with windows"):
        overlay_window.OverlayWindow(WindowOptions())
    monkeypatch.setattr(cv2, "getBuildInformation", lambda: "\n  GUI:                           QT5\n")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(InputError, match="no display"):
        overlay_window.check_window(WindowOptions())
    monkeypatch.setenv("DISPLAY", ":none")
    monkeypatch.setattr(overlay_window, "TRIAL", "import os; os.abort()")  # as the windows' library does
    with pytest.raises(InputError, match="a display, :none, on which no window opens"):
        overlay_window.OverlayWindow(WindowOptions())


class Endoscope:
    """A camera whose next frames are set by the test."""

    name, connected, dropped = "endoscope", True, 0

    def __init__(self) -> None:
        self.frames: list[StereoFrame] = []

    def poll(self) -> list[StereoFrame]:
        found, self.frames = self.frames, []
        return found

    def tell(self, text: str, **_: object) -> None:
        """No one listens."""

    def close(self) -> None:
        """Nothing to close."""


class Told:
    """A recorder with an estimate, and a reader without a snapshot."""

    def __init__(self, state: RecorderState) -> None:
        self.state, self.notes = state, list[str]()

    def hand_over(self, event: NoteEvent) -> None:
        self.notes.append(event.text)

    def read(self) -> Received:
        raise NoSnapshotError("nothing yet")


def test_the_loop_shows_its_frames_and_tells_when_a_display_is_lost(room: RoomStatus, screen: Screen) -> None:
    camera, quiet = Endoscope(), cast("Any", Endoscope())
    told = Told(room.at(host_now()).recorder)
    feed = room.fed([screen])
    devices = Devices(camera, quiet, quiet, overlay=[screen])
    workflow = Workflow(room.model, WorkflowSettings(hearing_threshold=1.0))
    loop = LiveLoop(room.model, devices, cast("Any", told), told, workflow, 0.0, overlay=feed)
    try:
        camera.frames.append(room.frame)
        wait_for(lambda: (loop.turn(), screen.shown)[1], 60.0)  # the workers of the marker's detection start
        assert screen.shown[0].stamp == room.frame.stamp
        screen.fails, screen.connected = True, False
        now = host_now()
        camera.frames.append(StereoFrame(Stamp(now, now), room.frame.left[:, ::-1], None, 1))
        wait_for(lambda: loop.turn() and "overlay 1" in loop.lost, 60.0)
        assert loop.lost["overlay 1"] == "unplugged"
        assert "overlay 1 lost: unplugged" in told.notes
    finally:
        loop.close()
        feed.close()
