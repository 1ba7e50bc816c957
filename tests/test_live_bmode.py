"""B-mode pictures in the live loop: the newest is shown, others are counted, and a lost scanner's picture goes away."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest

from fgreg.drivers import tcp_link
from fgreg.drivers.bk_oem import BkOemScanner
from fgreg.drivers.tcp_link import Endpoint
from fgreg.live.actions import RegistrationState
from fgreg.live.loop import LiveLoop
from fgreg.live.recorder import Recorder, RecorderState
from fgreg.live.status import Devices
from fgreg.live.workflow import Workflow, WorkflowSettings
from fgreg.model.events import NoteEvent
from fgreg.model.session_model import SessionModel
from fgreg.online.shared_snapshot import NoSnapshotError, Received
from fgreg.session.setup_reader import read_setup
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import Room, room_config
from tests.bk_emulator import Scanner, grabbed
from tests.network_peers import wait_for


class NothingYet:
    """A reader without an estimate."""

    def read(self) -> Received:
        raise NoSnapshotError("nothing yet")


class Quiet:
    """A connected device that sends nothing."""

    name, connected, dropped = "quiet", True, 0

    def poll(self) -> Sequence[Any]:
        return ()

    def tell(self, text: str, **_: object) -> None:
        """No one listens."""

    def close(self) -> None:
        """Nothing to close."""


@dataclass(eq=False)
class Notes:
    """A recorder that stores the events."""

    state: RecorderState = field(default_factory=lambda: RecorderState(RegistrationState()))
    kept: list[NoteEvent] = field(default_factory=list)

    def hand_over(self, event: NoteEvent) -> None:
        self.kept.append(event)


def model() -> SessionModel:
    found = read_setup(session_document(room_config(1).scene), "session.yaml", "room", []).model
    assert found is not None
    return found


@pytest.fixture
def scanner() -> Iterator[Scanner]:
    emulator = Scanner()
    yield emulator
    emulator.close()


@pytest.fixture
def live(scanner: Scanner, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[LiveLoop, Notes]]:
    monkeypatch.setattr(tcp_link, "RETRY_S", 0.02)
    device = BkOemScanner(Endpoint("127.0.0.1", scanner.port))
    notes, quiet = Notes(), cast("Any", Quiet())
    session = model()
    loop = LiveLoop(
        session,
        Devices(quiet, quiet, quiet, bmode=device),
        cast("Recorder", notes),
        NothingYet(),
        Workflow(session, WorkflowSettings(hearing_threshold=1.0)),
        0.0,
    )
    wait_for(lambda: scanner.grabbing)
    yield loop, notes
    loop.close()
    device.close()


def pictures(count: int, seed: int = 0) -> npt.NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (count, 4, 6), dtype=np.uint8)


def shown(loop: LiveLoop) -> npt.NDArray[np.uint8] | None:
    loop.turn()
    bmode = loop.status().bmode
    return None if bmode is None else bmode.image


def test_only_the_newest_picture_is_kept_and_the_others_are_counted(
    scanner: Scanner, live: tuple[LiveLoop, Notes]
) -> None:
    loop, _ = live
    sent = pictures(7)
    for picture in sent:
        scanner.send(grabbed(picture))
    wait_for(lambda: np.array_equal(cast("Any", shown(loop)), sent[-1]))
    assert loop.figures.pictures == 7
    assert loop.figures.unshown <= 6
    wait_for(lambda: shown(loop) is not None)
    assert np.array_equal(cast("Any", shown(loop)), sent[-1])  # a frozen picture stays while its scanner is there
    bmode = loop.status().bmode
    assert bmode is not None
    assert bmode.pixel_mm == pytest.approx((0.2, 0.1))
    assert loop.status().lost == ()


def test_pictures_not_fetched_in_time_are_counted(
    scanner: Scanner, live: tuple[LiveLoop, Notes], monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, _ = live
    monkeypatch.setattr(tcp_link, "QUEUE_ITEMS", 4)
    # A pause of this machine may take the 0.8 s after which a silent scanner is lost.
    monkeypatch.setattr(cast("Any", loop._devices.bmode)._link, "_silent_s", 10.0)
    loop.turn()
    assert loop._devices.bmode is not None
    sent = pictures(9, 1)
    for picture in sent:
        scanner.send(grabbed(picture))
    wait_for(lambda: loop._devices.bmode is not None and loop._devices.bmode.dropped == 5)
    wait_for(lambda: np.array_equal(cast("Any", shown(loop)), sent[-1]))
    assert (loop.figures.pictures, loop.figures.unshown) == (4, 5 + 3)


def test_a_lost_scanner_is_reported_its_picture_is_removed_and_it_comes_back(
    scanner: Scanner, live: tuple[LiveLoop, Notes]
) -> None:
    loop, notes = live
    first, second = pictures(2, 2)
    scanner.send(grabbed(first))
    wait_for(lambda: shown(loop) is not None)
    task = loop.status().task
    scanner.hang_up()
    wait_for(lambda: shown(loop) is None and "bmode" in loop.status().lost)
    assert notes.kept[-1].text.startswith("bmode lost: BK scanner: ")
    assert loop.status().task == task  # what was asked of the operator still holds
    wait_for(lambda: scanner.grabbing)
    scanner.send(grabbed(second))
    wait_for(lambda: np.array_equal(cast("Any", shown(loop)), second))
    wait_for(lambda: loop.turn() or loop.status().lost == ())
    assert notes.kept[-1].text == "bmode is back"


def test_the_rooms_scanner_shows_the_tissue_where_the_room_has_it() -> None:
    room = Room(room_config(3, aims=0, bump_every_s=math.inf))
    radius = room.config.scene.probe.radius_mm
    for scan_rad in (-0.6, 0.0, 0.4):
        image, (row_mm, column_mm), (depth_mm, x_mm) = room.bmode(scan_rad, 5)
        for column in (20, image.shape[1] // 2, image.shape[1] - 20):
            surface = room.scene.tissue.point(np.array(x_mm + column * column_mm), np.array(scan_rad))
            brightest = depth_mm + row_mm * int(np.argmax(image[:, column - 1 : column + 2].mean(axis=1)))
            assert brightest == pytest.approx(math.hypot(surface[1], surface[2]) - radius, abs=1.0)
