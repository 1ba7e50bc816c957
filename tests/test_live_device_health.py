"""Losses and returns of devices are reported once each; a bad picture counts as none."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest

from fgreg.drivers.base import DeviceLost, StereoFrame
from fgreg.live.device_health import FLAT, LEFT_OUT_S, NOTHING_NEW_S, SILENT_S, START_S, Health, Pictures, Source
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.time_sync import Stamp

FRAME_S = 1.0 / 30.0


@dataclass
class Device:
    """A scripted device."""

    connected: bool = True
    name: str = "the device"
    loses: list[str] = field(default_factory=list)
    rejected: int = 0
    last_rejection: str = ""

    def poll(self) -> list[int]:
        if self.loses:
            raise DeviceLost(self.loses.pop())
        return [1]


def frame(rng: np.random.Generator, level: float = 90.0, contrast: float = 30.0, noise: float = 2.0) -> StereoFrame:
    """One exposure of a scene with a sensor's noise."""
    scene = level + contrast * np.sin(np.linspace(0.0, 20.0, 320))[None, :] * np.ones((180, 1))
    sides = [np.clip(scene + noise * rng.standard_normal(scene.shape), 0, 255).astype(np.uint8) for _ in range(2)]
    return StereoFrame(Stamp(0.0, 0.0), sides[0], sides[1], 0)


def test_loss_and_return_are_reported_once_each() -> None:
    health = Health()
    health.found("probe", "")
    assert health.news() == []
    for reason in ("gone", "gone", "still gone"):
        health.found("probe", reason)
    assert health.news() == ["probe lost: gone"]
    assert health.lost == {"probe": "still gone"}
    health.found("probe", "")
    health.found("probe", "")
    assert health.news() == ["probe is back"]
    assert health.lost == {}


def test_a_loss_is_reported_even_if_the_device_is_back_at_once() -> None:
    device = Device(loses=["cable out"])
    source = Source(device, 0.0, sends=True)
    assert source.poll() == ()
    assert source.trouble(0.1) == "cable out"
    assert source.trouble(0.2) == ""
    assert source.poll() == [1]


def test_a_device_that_sends_has_some_time_to_begin_and_none_later() -> None:
    device = Device(connected=False)
    camera, operator = Source(device, 10.0, sends=True), Source(device, 10.0, sends=False)
    assert camera.trouble(10.0 + 0.9 * START_S) == ""
    assert camera.trouble(10.0 + 1.1 * START_S) == "the device does not answer"
    assert operator.trouble(100.0) == ""
    device.connected = True
    assert camera.trouble(20.0) == ""
    device.connected = False
    assert camera.trouble(20.1) == "the device does not answer"


def test_pictures_that_change_are_new_and_nothing_is_wrong_with_them() -> None:
    rng, pictures = np.random.default_rng(1), Pictures()
    for i in range(60):
        assert pictures.is_new(frame(rng), i * FRAME_S)
        assert pictures.trouble(i * FRAME_S) == ""


@pytest.mark.parametrize("frozen", ["left", "right"])
def test_a_repeated_picture_is_no_new_measurement_and_soon_reported(frozen: str) -> None:
    rng, pictures = np.random.default_rng(2), Pictures()
    first = frame(rng)
    assert pictures.is_new(first, 0.0)
    told_s = None
    for i in range(1, 40):
        other = frame(rng)
        left, right = (first.left, other.right) if frozen == "left" else (other.left, first.right)
        assert not pictures.is_new(StereoFrame(Stamp(i * FRAME_S, i * FRAME_S), left, right, i), i * FRAME_S)
        if told_s is None and pictures.trouble(i * FRAME_S):
            told_s = i * FRAME_S
    assert told_s is not None
    assert NOTHING_NEW_S < told_s < NOTHING_NEW_S + 2 * FRAME_S
    assert f"{frozen} picture is frozen" in pictures.trouble(40 * FRAME_S)
    assert pictures.is_new(frame(rng), 40 * FRAME_S)
    assert pictures.trouble(40 * FRAME_S) == ""


@pytest.mark.parametrize(("level", "trouble"), [(2.0, "shows nothing"), (90.0, "shows nothing"), (255.0, "frozen")])
def test_black_plain_and_white_pictures_are_reported(level: float, trouble: str) -> None:
    rng, pictures = np.random.default_rng(3), Pictures()
    for i in range(30):
        pictures.is_new(frame(rng, level, 0.0, 0.4 * FLAT if level < 255.0 else 0.0), i * FRAME_S)
    assert trouble in pictures.trouble(29 * FRAME_S)
    assert pictures.is_new(frame(rng), 30 * FRAME_S)
    assert pictures.trouble(30 * FRAME_S) == ""


def test_pictures_of_another_size_than_calibrated_are_not_used() -> None:
    rng = np.random.default_rng(5)
    first = frame(rng)
    height, width = first.left.shape[:2]
    camera = CameraModel((width, height), np.eye(3), np.zeros(4))
    pictures = Pictures(StereoRig(camera, CameraModel((width, height // 2), np.eye(3), np.zeros(4)), np.eye(4)))
    assert not pictures.is_new(first, 0.0)
    assert pictures.trouble(0.0) == (
        f"its pictures have {width} x {height} px, the calibration is for {width} x {height // 2}"
    )
    for size, fits in (((width, height), True), ((2 * width, height), False)):
        pictures = Pictures(StereoRig(CameraModel(size, np.eye(3), np.zeros(4))))
        assert pictures.is_new(replace(first, right=None), 0.0) is fits
        assert bool(pictures.trouble(0.0)) is not fits


def test_a_video_that_stops_is_reported_and_single_pictures_are_no_video() -> None:
    rng, video, stills = np.random.default_rng(4), Pictures(), Pictures()
    for i in range(10):
        video.is_new(frame(rng), i * FRAME_S)
        stills.is_new(frame(rng), float(i))
    last = 9 * FRAME_S
    assert video.trouble(last + 0.9 * SILENT_S) == ""
    assert video.trouble(last + 1.1 * SILENT_S) == "it sends no pictures"
    assert stills.trouble(9.0 + 5.0) == ""


def test_messages_left_out_are_told_with_their_number_and_not_too_often() -> None:
    device = Device()
    source = Source(device, 0.0, sends=True)
    assert source.left_out(0.0) == ""
    device.rejected, device.last_rejection = 1, "127.0.0.1:5000: wrong checksum"
    assert source.left_out(1.0) == "1 message left out, the last one from 127.0.0.1:5000: wrong checksum"
    device.rejected = 400
    assert source.left_out(2.0) == ""
    assert source.left_out(1.1 + LEFT_OUT_S).startswith("399 messages left out")
    assert source.left_out(3.0 + LEFT_OUT_S) == ""
    silent = SimpleNamespace(name="pedal", rejected=2)  # does not say why
    assert Source(silent, 0.0, sends=False).left_out(0.0) == "2 messages left out, the last one from pedal"
