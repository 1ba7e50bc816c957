"""A BK scanner's pictures from an emulator on loopback: every byte value, zooms, garbage, cut-off frames, power off."""

from __future__ import annotations

import time
from collections.abc import Iterator
from itertools import count

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fgreg.drivers import bk_oem, tcp_link
from fgreg.drivers.base import BmodeFrame, BmodeSource, DeviceLost
from fgreg.drivers.bk_oem import BkOemScanner, OemDecoder, encode, unescape
from fgreg.drivers.stream_decoder import Rejections, StreamBroken
from fgreg.drivers.tcp_link import Endpoint
from fgreg.errors import InputError
from fgreg.schema.limits import BK_MESSAGE_BYTES
from tests.bk_emulator import Scanner, Unframer, frame, grabbed
from tests.network_peers import collect, wait_for


@pytest.fixture
def scanner() -> Iterator[Scanner]:
    emulator = Scanner()
    yield emulator
    emulator.close()


@pytest.fixture
def source(scanner: Scanner, monkeypatch: pytest.MonkeyPatch) -> Iterator[BkOemScanner]:
    monkeypatch.setattr(tcp_link, "RETRY_S", 0.02)
    driver = BkOemScanner(Endpoint("127.0.0.1", scanner.port), rate_hz=25)
    yield driver
    driver.close()


def picture(scanner: Scanner, seed: int = 0) -> npt.NDArray[np.uint8]:
    columns, rows = scanner.window
    return np.random.default_rng(seed).integers(0, 256, (rows, columns), dtype=np.uint8)


def fetch(driver: BkOemScanner, number: int = 1) -> list[BmodeFrame]:
    return collect(driver.poll, number)


def test_the_scanner_is_asked_for_its_geometry_and_for_frames(scanner: Scanner, source: BkOemScanner) -> None:
    wait_for(lambda: scanner.grabbing)
    assert scanner.grabbing == b'QUERY:GRAB_FRAME "ON",25;'
    assert scanner.received[:4] == [
        b"QUERY:US_WIN_SIZE;",
        b"QUERY:B_GEOMETRY_PIXEL:A;",
        b"QUERY:B_GEOMETRY_TISSUE:A;",
        b"QUERY:B_GEOMETRY_US_FRAME_GRAB:A;",
    ]
    assert scanner.received[4].startswith(b'CONFIG:DATA:SUBSCRIBE "US_WIN_SIZE"')
    source.close()
    wait_for(lambda: scanner.grabbing == b'QUERY:GRAB_FRAME "OFF";')


def test_pictures_of_every_byte_value_arrive_with_their_scale(scanner: Scanner, source: BkOemScanner) -> None:
    typed: BmodeSource = source
    wait_for(lambda: scanner.grabbing)
    scanner.send(b"SDATA:US_WIN_SIZE 32,24;")
    pixels = np.arange(32 * 24, dtype=np.uint32).astype(np.uint8).reshape(24, 32)
    for ticks in range(20):
        scanner.send(grabbed(pixels + np.uint8(ticks), 0x01041B00 + ticks))
    found = collect(typed.poll, 20)
    for number, shown in enumerate(found):
        np.testing.assert_array_equal(shown.image, pixels + np.uint8(number))
    assert [shown.index for shown in found] == list(range(20))
    assert found[0].pixel_mm == pytest.approx((0.2, 0.1))  # 80 mm over 400 rows, 40 mm over 400 columns
    assert found[0].origin_mm == pytest.approx((1.0 - 10 * 0.2, -20.0 - 10 * 0.1))
    assert found[0].stamp.device_s == found[0].stamp.host_s <= time.monotonic()
    assert (source.rejected, source.dropped, source.connected) == (0, 0, True)


def test_colour_is_three_bytes_a_pixel(scanner: Scanner, source: BkOemScanner) -> None:
    wait_for(lambda: scanner.grabbing)
    colour = np.random.default_rng(5).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    scanner.send(grabbed(colour))
    np.testing.assert_array_equal(fetch(source)[0].image, colour)


def test_a_zoom_that_was_not_reported_is_queried(scanner: Scanner, source: BkOemScanner) -> None:
    wait_for(lambda: scanner.grabbing)
    scanner.send(grabbed(picture(scanner)))
    fetch(source)
    asked = scanner.received.count(b"QUERY:US_WIN_SIZE;")
    scanner.window = (10, 8)
    scanner.send(grabbed(picture(scanner)))
    wait_for(lambda: source.poll() or scanner.received.count(b"QUERY:US_WIN_SIZE;") > asked)
    assert "for a window of 6 x 4" in source.last_rejection
    wait_for(lambda: len(scanner.received) >= 10)
    scanner.send(grabbed(picture(scanner, 1)))
    (shown,) = fetch(source)
    np.testing.assert_array_equal(shown.image, picture(scanner, 1))
    assert shown.index == 2


def test_what_is_not_a_picture_is_left_out_and_the_next_one_is_shown(scanner: Scanner, source: BkOemScanner) -> None:
    wait_for(lambda: scanner.grabbing)
    good = picture(scanner)
    whole = frame(grabbed(good))
    wrong = [
        b"garbage between messages",
        whole[:20],  # cut off by the next message
        frame(grabbed(good)[:-9]),  # fewer bytes than stated
        frame(b"DATA:GRAB_FRAME #9;"),
        frame(b"DATA:GRAB_FRAME #x12345;"),
        frame(b"DATA:GRAB_FRAME;"),
        frame(b"DATA:GRAB_FRAME #3" + b"999" + bytes(999)),
        b"\x01ACK\x1b\x20;\x04",  # an escape that is none
        frame(b"DATA:US_WIN_SIZE 6;"),
        frame(b"DATA:US_WIN_SIZE 1e9,4;"),
        frame(b"DATA:US_WIN_SIZE nan,4;"),
        frame(b"DATA:US_WIN_SIZE -6,4;"),
        frame(b"DATA:B_GEOMETRY_PIXEL:A 1,2,three,4;"),
        frame(b"\xff\xfe\x00"),
        frame(b"ERROR:SOMETHING;"),
        b"\x04\x04",
    ]
    rejected = source.rejected
    for number, data in enumerate(wrong):
        scanner.send_raw(data + whole)
        (shown,) = fetch(source)
        np.testing.assert_array_equal(shown.image, good)
        assert source.rejected > rejected, f"wrong[{number}]"
        rejected = source.rejected
    scanner.send(b"DATA:B_GEOMETRY_PIXEL:A 5,5,5,5;")  # no extent: no scale, but pictures
    scanner.send_raw(whole)
    (shown,) = fetch(source)
    assert (shown.pixel_mm, shown.origin_mm) == (None, None)


def test_a_message_without_end_ends_the_connection_not_the_driver(
    scanner: Scanner, source: BkOemScanner, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bk_oem, "BK_MESSAGE_BYTES", 100_000)
    wait_for(lambda: scanner.grabbing)
    scanner.grabbing = b""
    scanner.send_raw(b"\x01" + b"x" * 150_000)
    with pytest.raises(DeviceLost, match="no end of a message within 100000 bytes"):
        wait_for(source.poll)
    wait_for(lambda: scanner.grabbing)
    scanner.send(grabbed(picture(scanner)))
    assert len(fetch(source)) == 1


def test_a_frozen_picture_is_a_silent_scanner(scanner: Scanner) -> None:
    driver = BkOemScanner(Endpoint("127.0.0.1", scanner.port), silent_s=0.2)
    try:
        wait_for(lambda: scanner.grabbing)
        with pytest.raises(DeviceLost, match=r"nothing received for 0\.2 s"):
            wait_for(driver.poll)
        assert not driver.connected
        scanner.send(grabbed(picture(scanner)))
        assert len(fetch(driver)) == 1
        assert driver.connected
    finally:
        driver.close()


@given(payload=st.binary(max_size=60) | st.lists(st.sampled_from([1, 4, 27, 254, 251, 228, 0]), max_size=40).map(bytes))
@settings(max_examples=300, deadline=None)
def test_escapes_are_the_emulators(payload: bytes) -> None:
    assert unescape(frame(payload)[1:-1]) == payload
    text = payload.decode("latin-1").encode("ascii", "ignore").decode()
    assert Unframer().feed(encode(text)) == [text.encode()]


@given(data=st.lists(st.binary(max_size=30) | st.sampled_from([b"\x01", b"\x04", b"\x1b", b"#9"]), max_size=20))
@settings(max_examples=300, deadline=None)
def test_hostile_bytes_are_left_out_and_the_next_message_is_read(data: list[bytes]) -> None:
    decoder = OemDecoder(Rejections(), count())
    for piece in data:
        decoder.feed(piece, 0.0)
    assert decoder.feed(b"\x04" + frame(b"ACK;"), 0.0)[-1].payload == b"ACK;"


def test_an_endless_message_is_bounded() -> None:
    decoder = OemDecoder(Rejections(), count())
    piece = b"x" * (1 << 18)
    decoder.feed(b"\x01" + piece, 0.0)
    for _ in range(BK_MESSAGE_BYTES // len(piece) - 2):
        assert decoder.feed(piece, 0.0) == []
    decoder.feed(piece[:-1], 0.0)
    with pytest.raises(StreamBroken, match="no end of a message"):
        decoder.feed(b"x", 0.0)


def test_a_rate_or_an_address_that_cannot_be_is_one_line() -> None:
    with pytest.raises(InputError, match="rate_hz: found 0, expected 1 to 100"):
        BkOemScanner(Endpoint("127.0.0.1", 7915), rate_hz=0)
    with pytest.raises(InputError, match="expected an address to connect to"):
        BkOemScanner(Endpoint.listening(0))


@pytest.mark.parametrize(
    ("tissue", "flip", "mirrored", "x_mm"),
    [
        (b"-0.02,0.001,0.03,0.081", False, False, -20.0 - 10 * 0.125),
        (b"-0.02,0.001,0.03,0.081", True, True, 20.0 + 10 * 0.125 - 5 * 0.125),
        (b"0.03,0.001,-0.02,0.081", False, True, 30.0 + 10 * 0.125 - 5 * 0.125),
        (b"0.03,0.001,-0.02,0.081", True, False, -30.0 - 10 * 0.125),
    ],
)
def test_columns_run_along_trus_x_whichever_way_the_scanner_has_them(
    scanner: Scanner, tissue: bytes, flip: bool, mirrored: bool, x_mm: float
) -> None:
    driver = BkOemScanner(Endpoint("127.0.0.1", scanner.port), flip=flip)
    try:
        wait_for(lambda: scanner.grabbing)
        scanner.send(b"DATA:B_GEOMETRY_TISSUE:A " + tissue + b";")
        sent = picture(scanner)
        scanner.send(grabbed(sent))
        (shown,) = fetch(driver)
    finally:
        driver.close()
    np.testing.assert_array_equal(shown.image, sent[:, ::-1] if mirrored else sent)
    assert shown.pixel_mm == pytest.approx((0.2, 0.125))
    assert shown.origin_mm == pytest.approx((1.0 - 10 * 0.2, x_mm))
