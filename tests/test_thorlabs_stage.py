"""The Thorlabs driver against an emulated cube: what is sent and understood, lost replies, garbage, unplugging."""

from __future__ import annotations

import builtins
import contextlib
import math
import os
import signal
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest
import thorlabs_apt_protocol as library
from hypothesis import given, settings
from hypothesis import strategies as st
from thorlabs_apt_protocol.unpacker import Unpacker

from fgreg.drivers import thorlabs_apt
from fgreg.drivers.thorlabs_identify import identify
from fgreg.drivers.thorlabs_stage import LOST_S, ThorlabsStage, open_stage, write_all
from fgreg.errors import MissingExtraError
from fgreg.model.session_model import StageModel
from fgreg.stage.client import Report, StageLink, StageRecord
from fgreg.stage.interface import RotationStage, StageError, StageLost, StageStatus
from fgreg.stage.limits import MotionKind, MotionLimits
from tests.cube_emulator import CubeEmulator

# The other way round, zero at 10 deg.
MODEL = StageModel(math.radians(2.0), (math.radians(-50.0), math.radians(70.0)), -1, math.radians(10.0))


@contextmanager
def _emulated(**options: Any) -> Iterator[CubeEmulator]:
    cube = CubeEmulator(**options)
    try:
        yield cube
    finally:
        if cube.port and cube._slave is not None:
            cube.close()


@contextmanager
def _opened(**options: Any) -> Iterator[tuple[CubeEmulator, ThorlabsStage]]:
    with _emulated(**options) as cube:
        stage = open_stage(MODEL, port=cube.port)
        try:
            yield cube, stage
        finally:
            stage.close()
        assert not cube.complaints


def _until(stage: RotationStage, condition: Callable[[StageStatus], bool], seconds: float = 8.0) -> StageStatus:
    until = time.monotonic() + seconds
    while True:
        status = stage.status()
        if condition(status):
            return status
        assert time.monotonic() < until, status
        time.sleep(0.01)


def _rested(status: StageStatus) -> bool:
    return not status.moving and not status.homing


def test_homes_then_turns_with_the_sessions_direction_and_zero() -> None:
    with _opened(device_deg=6.0) as (cube, stage):
        assert not stage.status().homed
        stage.home(math.radians(8.0))
        _until(stage, lambda status: status.homing and not status.homed)
        status = _until(stage, lambda status: status.homed and _rested(status))
        assert cube.orders[-1][0] == "home"
        assert cube.orders[-1][1] == pytest.approx(8.0, abs=1e-3)
        assert math.degrees(status.scan_rad) == pytest.approx(10.0, abs=1e-3)
        stage.move_to(math.radians(4.0), math.radians(20.0))
        velocities: list[float] = []

        def arrived(status: StageStatus) -> bool:
            velocities.append(math.degrees(status.velocity_rad_s))
            return _rested(status) and abs(math.degrees(status.scan_rad) - 4.0) < 0.01

        status = _until(stage, arrived)
        assert -20.5 < min(velocities) < -14.0  # never faster than it turns, whenever its statuses arrive
        assert cube.device_deg == pytest.approx(6.0, abs=1e-3)
        assert [name for name, _ in cube.orders[-2:]] == ["velocity", "move"]
        assert cube.orders[-2][1] == pytest.approx(20.0, abs=1e-3)
        assert not status.fault


def test_stop_stops_at_once() -> None:
    with _opened() as (cube, stage):
        stage.move_to(math.radians(-40.0), math.radians(10.0))
        _until(stage, lambda status: status.moving)
        stage.stop()
        status = _until(stage, lambda status: not status.moving)
        assert cube.orders[-1][0] == "stop"
        assert abs(math.degrees(status.scan_rad) - cube.orders[-1][1]) < 20.0
        assert cube.device_deg < 45.0


def test_speed_and_home_speed_are_never_above_what_was_asked_for() -> None:
    with _opened() as (cube, stage):
        stage.home(math.radians(50.0))
        _until(stage, lambda _: bool(cube.orders) and cube.orders[-1][0] == "home")
        assert cube.home_speed_deg_s == pytest.approx(10.0, abs=1e-3)  # the cube's own is slower
        stage.move_to(0.0, math.radians(3.3))
        _until(stage, lambda _: cube.orders[-1][0] == "move")
        assert cube.speed_deg_s <= 3.3


def test_lost_replies_are_asked_for_again() -> None:
    with _emulated() as cube:
        cube.drop = 2
        stage = open_stage(MODEL, port=cube.port)
        cube.homed = True
        stage.move_to(math.radians(6.0), math.radians(20.0))
        status = _until(stage, lambda status: _rested(status) and abs(math.degrees(status.scan_rad) - 6.0) < 0.01)
        assert status.homed
        stage.close()


@pytest.mark.parametrize("garbage", [b"\x00", b"\x91\x04\x0e\x00", b"\xff" * 37, b"\x91\x04\x0e\x00\x81\x50\x01"])
def test_garbage_between_replies_is_skipped(garbage: bytes) -> None:
    with _emulated() as cube:
        stage = open_stage(MODEL, port=cube.port)
        cube.garbage = garbage
        stage.move_to(math.radians(8.0), math.radians(20.0))
        status = _until(stage, lambda status: _rested(status) and abs(math.degrees(status.scan_rad) - 8.0) < 0.01)
        assert not status.fault
        stage.close()


def test_silent_cube_is_lost_after_a_second_and_stays_so() -> None:
    with _opened() as (cube, stage):
        cube.drop = 1
        began = time.monotonic()
        with pytest.raises(StageLost, match="has said nothing for 1 s"):
            _until(stage, lambda _: False)
        assert LOST_S <= time.monotonic() - began < 3.0
        cube.drop = 0
        with pytest.raises(StageLost, match="has said nothing"):
            stage.status()
        with pytest.raises(StageLost, match="has said nothing"):
            stage.stop()


def test_port_that_is_absent_or_silent_or_of_another_device_is_one_line() -> None:
    with pytest.raises(StageLost, match="cannot be opened"):
        open_stage(MODEL, port="/nowhere/ttyUSB9")
    with _emulated() as cube:
        cube.drop = 1
        with pytest.raises(StageLost, match="does not answer"):
            open_stage(MODEL, port=cube.port)
    with _emulated(model=b"LTS150\0\0") as cube, pytest.raises(StageError, match="'LTS150', expected one of KDC101"):
        open_stage(MODEL, port=cube.port)


def test_cube_complaints_become_faults() -> None:
    with _opened() as (cube, stage):
        for bits, says in ((0x4000, "motion error"), (0x01000000, "current")):
            cube.extra_bits = bits
            assert says in _until(stage, lambda status: bool(status.fault)).fault
            cube.extra_bits = 0
            _until(stage, lambda status: not status.fault)
        cube.enabled = False
        assert "switched off" in _until(stage, lambda status: bool(status.fault)).fault


SHORT_ERROR = b"\x80\x00\x00\x00\x01\x50"
LONG_ERROR = b"\x81\x00\x44\x00\x81\x50" + struct.pack("<HH64s", 0x0453, 7, b"Motor overload")
POSITION = b"\x12\x04\x06\x00\x81\x50" + struct.pack("<Hi", 1, 99)
NOT_KNOWN_HERE = b"\x12\x02\x01\x01\x01\x50"  # MOD_GET_CHANENABLESTATE


def _bits(bits: int) -> bytes:
    return b"\x2a\x04\x06\x00\x81\x50" + struct.pack("<HI", 1, bits)


def test_messages_behind_a_status_are_those_of_the_library_and_never_cost_it() -> None:
    for behind in (SHORT_ERROR, LONG_ERROR, POSITION, _bits(0x80000400), NOT_KNOWN_HERE):
        unpacker = Unpacker(on_error="raise")
        unpacker.feed(behind)
        assert len(list(unpacker)) == 1
        status = b"\x91\x04\x0e\x00\x81\x50\x01\x00" + bytes([10, 11, 12, 0, 14, 15, 16, 17, 0, 4, 0, 128])
        for at_once in (True, False):
            parser = thorlabs_apt.AptParser()
            parts = [status + behind] if at_once else [bytes([byte]) for byte in status + behind]
            found = [message for part in parts for message in parser.feed(part)]
            assert [message.data for message in found if message.is_status] == [status[6:]]
            assert len(found) == (1 if behind is NOT_KNOWN_HERE else 2)


@pytest.mark.parametrize(
    ("error", "says"),
    [(SHORT_ERROR, "an error: without a code"), (LONG_ERROR, "an error: code 7, Motor overload, about message 0x0453")],
)
def test_error_of_the_cube_is_raised_once_and_a_fault_while_it_is_repeated(error: bytes, says: str) -> None:
    with _opened() as (cube, stage):
        cube.device_deg = 3.0
        cube.behind = error
        with pytest.raises(StageError, match=says):
            _until(stage, lambda _: False)
        status = stage.status()  # its position came right before the error
        assert math.degrees(status.scan_rad) == pytest.approx(10.0 - 3.0, abs=1e-3)
        assert says in status.fault
        cube.behind = error
        _until(stage, lambda _: not cube.behind)
        assert says in stage.status().fault


def test_bits_without_a_position_are_taken_but_are_no_newer_status() -> None:
    with _opened() as (cube, stage):
        _until(stage, lambda status: not status.fault)
        cube.drop, before = 1, stage.status()
        os.write(cube._master, _bits(0x80004400) + POSITION)
        status = _until(stage, lambda status: bool(status.fault))
        assert "motion error" in status.fault
        assert status.homed
        assert (status.stamp, status.scan_rad) == (before.stamp, before.scan_rad)


@pytest.mark.parametrize(("status_id", "more"), [(0x0491, 14), (0x0481, 0), (0x0481, 14)])
def test_statuses_of_newer_controllers_are_read(status_id: int, more: int) -> None:
    with _emulated(device_deg=4.0) as cube:
        cube.status_id, cube.status_more = status_id, bytes(more)
        assert identify(cube.port).model == "KDC101"
        with closing(open_stage(MODEL, port=cube.port)) as stage:
            stage.move_to(math.radians(8.0), math.radians(20.0))
            status = _until(stage, lambda status: _rested(status) and abs(math.degrees(status.scan_rad) - 8.0) < 0.01)
            assert not status.fault


def test_cube_that_keeps_its_old_speed_is_a_fault() -> None:
    with _opened() as (cube, stage):
        cube.deaf_to_velocity = True
        stage.move_to(math.radians(-20.0), math.radians(5.0))
        fault = _until(stage, lambda status: bool(status.fault)).fault
        assert "is set to 25.0 deg/s, was told 5.0 deg/s" in fault


def test_without_pyserial_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def no_serial(name: str, *rest: Any, **more: Any) -> Any:
        if name.split(".")[0] == "serial":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", no_serial)
    with pytest.raises(MissingExtraError, match=r"pip install 'fgreg\[stage\]'"):
        open_stage(MODEL, port="/dev/null")
    with pytest.raises(MissingExtraError, match=r"pip install 'fgreg\[stage\]'"):
        open_stage(MODEL)


def test_through_the_watchdog_homed_searched_unplugged_and_reported() -> None:
    log: list[StageRecord] = []
    limits = MotionLimits.of_session(MODEL, heartbeat_s=1.0)
    with (
        _emulated(device_deg=3.0) as cube,
        StageLink.open("fgreg.drivers.thorlabs_stage:open_stage", {"port": cube.port}, limits, log.append) as link,
    ):
        reports: list[Report] = []

        def until(what: str) -> None:
            end = time.monotonic() + 10.0
            while not any(report.what == what for report in reports):
                assert time.monotonic() < end, (reports, link.view)
                link.beat()
                reports.extend(link.poll())
                time.sleep(0.02)
            reports.clear()

        link.beat()
        time.sleep(0.1)
        link.beat()
        link.request(MotionKind.HOME, "test")
        link.home("start of the session")
        until("arrived")
        link.request(MotionKind.SEARCH, "test")
        link.search_to(math.radians(7.0), "position 1")
        until("arrived")
        assert cube.device_deg == pytest.approx(3.0, abs=0.01)
        link.search_to(math.radians(-30.0), "position 2")
        began = time.monotonic()
        cube.close()
        until("stopped")
        assert time.monotonic() - began < 1.0
        assert log[-1].command == "stop"
        assert "stage at" in log[-1].reason
        assert not cube.complaints


def test_watchdog_that_is_killed_itself_is_noticed_and_the_next_one_stops_the_stage() -> None:
    limits = MotionLimits.of_session(MODEL, heartbeat_s=1.0)
    driver, records = "fgreg.drivers.thorlabs_stage:open_stage", list[StageRecord]()
    with _emulated() as cube:
        cube.homed = True
        options = {"port": cube.port}
        with StageLink.open(driver, options, limits, records.append) as link:
            link.beat()
            time.sleep(0.1)
            link.request(MotionKind.SEARCH, "test")
            link.search_to(math.radians(-50.0), "far")
            end = time.monotonic() + 5.0
            while cube.orders[-1][0] != "move":
                assert time.monotonic() < end
                time.sleep(0.01)
            os.kill(link.pid, signal.SIGKILL)
            os.waitid(os.P_PID, link.pid, os.WEXITED | os.WNOWAIT)
            with pytest.raises(StageLost, match="watchdog"):
                link.poll()
        with StageLink.open(driver, options, limits, records.append):
            end = time.monotonic() + 1.0
            while cube.orders[-1][0] != "stop":
                assert time.monotonic() < end
                time.sleep(0.01)
        assert cube.device_deg < 50.0


def test_parser_understands_what_the_library_does_whatever_comes_before() -> None:
    @settings(max_examples=150, derandomize=True, deadline=None)
    @given(st.lists(st.binary(max_size=9), max_size=4), st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1))
    def check(noise: list[bytes], position: int, bits: int) -> None:
        parser = thorlabs_apt.AptParser()
        for part in noise:
            parser.feed(part)
        data = position.to_bytes(4, "little", signed=True) + bytes(4) + bits.to_bytes(4, "little")
        message = b"\x91\x04\x0e\x00\x81\x50\x01\x00" + data
        read = [found for found in parser.feed(message * 8) if found.id == thorlabs_apt.GET_STATUS]
        assert len(read) >= 1  # noise may swallow some, never all
        assert thorlabs_apt.read_status(read[-1].data) == thorlabs_apt.CubeStatus(position, bits)

    check()


@pytest.mark.parametrize("lost", range(1, 14))
def test_status_whose_end_was_lost_does_not_swallow_the_next(lost: int) -> None:
    message = b"\x91\x04\x0e\x00\x81\x50\x01\x00" + bytes([10, 11, 12, 0, 14, 15, 16, 17, 0, 4, 0, 128])
    parser = thorlabs_apt.AptParser()
    found = parser.feed(message + message[:-lost] + message)
    assert [thorlabs_apt.read_status(each.data) for each in found] == [
        thorlabs_apt.CubeStatus(0x000C0B0A, 0x80000400)
    ] * 2


def test_orders_are_packed_as_the_library_packs_them() -> None:
    to = {"dest": 0x50, "source": 0x01}
    assert thorlabs_apt.move_absolute(-77) == library.mot_move_absolute(**to, chan_ident=1, position=-77)
    assert thorlabs_apt.set_velocity(3, 4) == library.mot_set_velparams(
        **to, chan_ident=1, min_velocity=0, acceleration=3, max_velocity=4
    )
    assert thorlabs_apt.short(thorlabs_apt.MOVE_STOP, 1, 1) == library.mot_move_stop(**to, chan_ident=1, stop_mode=1)
    assert thorlabs_apt.set_home(thorlabs_apt.HomeSettings(2, 1, 9, -5)) == library.mot_set_homeparams(
        **to, chan_ident=1, home_dir=2, limit_switch=1, home_velocity=9, offset_distance=-5
    )


def test_a_line_that_takes_nothing_in_is_an_error_and_a_pause_of_this_process_is_none() -> None:
    reader, writer = os.pipe()
    try:
        os.set_blocking(writer, False)
        began = time.monotonic()
        with pytest.raises(OSError, match="not for 50 ms"):
            write_all(writer, b"a" * 200_000)
        assert 0.05 <= time.monotonic() - began < 5.0
        os.set_blocking(reader, False)
        with contextlib.suppress(BlockingIOError):
            while os.read(reader, 65536):
                pass
        write_all(writer, b"whole")
        assert os.read(reader, 100).endswith(b"whole")
    finally:
        os.close(reader)
        os.close(writer)
