"""One camera's pictures one after another: found where it was, the marker is found as in the whole picture."""

from __future__ import annotations

import numpy as np
import pytest

from fgreg.detection import marker_roi
from fgreg.detection.marker import ViewCorners, view_corners
from fgreg.detection.marker_roi import EVERYWHERE, MarkerRoi, window_about
from fgreg.geometry.transforms import FloatArray
from fgreg.model.session_model import SessionModel
from fgreg.session.setup_reader import read_setup
from fgreg.simulation.documents import session_document
from fgreg.simulation.render import UInt8Image
from fgreg.simulation.room import Room, room_config

SAME_PX = 3e-3


def of_room(width_px: int) -> tuple[SessionModel, Room]:
    config = room_config(3, width_px, aims=0)
    model = read_setup(session_document(config.scene), "session.yaml", "room", []).model
    assert model is not None
    return model, Room(config)


def watching(model: SessionModel) -> MarkerRoi:
    assert model.camera is not None
    assert model.marker is not None
    return MarkerRoi(model.camera.left, 0, np.eye(4), model.marker)


def whole(model: SessionModel, image: UInt8Image) -> ViewCorners:
    assert model.camera is not None
    assert model.marker is not None
    return view_corners(image, model.camera.left, 0, np.eye(4), model.marker)


def corners(found: ViewCorners) -> FloatArray:
    assert found.corners is not None
    return found.corners.ideal_px


@pytest.mark.parametrize("width_px", [640, 1280])
def test_a_moving_marker_has_the_corners_of_the_whole_picture(width_px: int, monkeypatch: pytest.MonkeyPatch) -> None:
    model, room = of_room(width_px)
    watch, looks = watching(model), []

    def counted(*arguments: object, near: object = None) -> ViewCorners:
        looks.append(near)
        return view_corners(*arguments, near=near)  # type: ignore[arg-type]

    monkeypatch.setattr(marker_roi, "view_corners", counted)
    room.proceed(0.2)
    for k in range(EVERYWHERE + 4):
        image = room.pictures(k / 15.0, k)[0]
        found, expected = watch.detect(image, whole=k % EVERYWHERE == 0), whole(model, image)
        assert np.abs(corners(found) - corners(expected)).max() < SAME_PX
    assert len(looks) < EVERYWHERE + 8, "most are found where they were"
    assert sum(near is not None for near in looks) > EVERYWHERE


def test_a_marker_that_has_leapt_is_found_all_the_same() -> None:
    model, room = of_room(640)
    watch = watching(model)
    image = room.pictures(0.0, 0)[0]
    watch.detect(image)
    leapt = np.ascontiguousarray(image[:, ::-1][::-1])  # half a turn about the middle
    assert np.abs(corners(watch.detect(leapt)) - corners(whole(model, leapt))).max() < SAME_PX


def test_a_picture_without_a_marker_is_empty_and_the_next_one_is_processed_as_a_whole() -> None:
    model, room = of_room(640)
    watch = watching(model)
    image = room.pictures(0.0, 0)[0]
    watch.detect(image)
    assert watch.detect(np.full_like(image, 90)).corners is None
    assert np.abs(corners(watch.detect(image)) - corners(whole(model, image))).max() < SAME_PX


def test_a_second_tag_of_the_same_id_is_noticed_in_the_whole_picture() -> None:
    model, room = of_room(640)
    watch = watching(model)
    image = room.pictures(0.0, 0)[0]
    first = watch.detect(image)
    low, high = first.outlines_px.min(axis=0).astype(int) - 12, first.outlines_px.max(axis=0).astype(int) + 12
    tag = image[max(low[1], 0) : high[1], max(low[0], 0) : high[0]]
    double = image.copy()
    height, width = tag.shape
    x = 0 if low[0] > width else image.shape[1] - width
    y = 0 if low[1] > height else image.shape[0] - height
    double[y : y + height, x : x + width] = tag
    assert whole(model, double).corners is None
    assert watch.detect(double).corners is not None
    assert watch.detect(double, whole=True).corners is None


def test_the_window_stays_in_the_picture_and_begins_at_even_pixels() -> None:
    outline = np.array([[3.0, 7.0], [55.0, 6.0], [52.0, 61.0], [4.0, 60.0]])
    left, right, top, bottom = window_about(outline, (64, 640))
    assert (left, top, bottom) == (0, 0, 64)
    assert 55 + 0.5 * 52 < right < 640
    left, right, top, bottom = window_about(outline + np.array([301.0, 200.0]), (480, 640))
    assert left % 2 == 0
    assert top % 2 == 0
    assert left < 304 - 0.5 * 52
    assert bottom > 261 + 0.5 * 52
