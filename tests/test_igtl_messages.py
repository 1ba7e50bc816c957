"""OpenIGTLink on the wire: against bytes packed and read by the protocol's text, and the C library's checksum."""

from __future__ import annotations

import ctypes
import ctypes.util
import itertools
import struct
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fgreg.drivers.stream_decoder import Rejections, StreamBroken
from fgreg.errors import InputError, MissingExtraError
from fgreg.schema.limits import IGTL_BODY_BYTES
from tests.igtl_bytes import crc64, image_body, message, read_message, transform_body

pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")

from fgreg.drivers import igtl_contents as contents
from fgreg.drivers import igtl_messages as igtl
from fgreg.drivers.igtl_decoder import MessageDecoder

MATRIX = np.array([[0.0, -1.0, 0.0, 10.5], [1.0, 0.0, 0.0, -20.25], [0.0, 0.0, 1.0, 33.0], [0.0, 0.0, 0.0, 1.0]])
ALL = frozenset({("TRANSFORM", ""), ("IMAGE", ""), ("STRING", ""), ("STATUS", "")})


def decoder(wanted: frozenset[tuple[str, str]] = ALL) -> tuple[MessageDecoder, Rejections]:
    rejections = Rejections()
    return MessageDecoder(rejections, wanted, Counter()), rejections


def test_the_checksum_is_the_c_librarys() -> None:
    name = ctypes.util.find_library("OpenIGTLink")
    if name is None:
        pytest.skip("libopenigtlink is not installed (Debian: libopenigtlink-dev)")
    function = ctypes.CDLL(name).crc64
    function.restype, function.argtypes = ctypes.c_uint64, [ctypes.c_char_p, ctypes.c_uint64, ctypes.c_uint64]
    body = np.random.default_rng(1).bytes(5000)
    assert crc64(body) == function(body, len(body), 0)


@pytest.mark.parametrize("version", [1, 2])
def test_what_is_packed_reads_as_the_protocol_says(version: int) -> None:
    metadata = {"TransformStatus": "OK", "Reasons": "none"}
    packed = igtl.pack_transform("CameraToTrus", MATRIX, 1234.5, metadata, version)
    read = read_message(packed)
    assert (read.version, read.kind, read.device) == (version, "TRANSFORM", "CameraToTrus")
    assert read.sent_s == pytest.approx(1234.5, abs=1e-8)
    assert read.metadata == (metadata if version == 2 else {})
    assert read.content == transform_body(MATRIX)
    text = read_message(igtl.pack_text("Note", "angle 3°", 1.0, {}, version))
    assert text.content == struct.pack(">HH", 3, 11) + b"angle 3\\xb0"
    status = read_message(igtl.pack_status("S", contents.Status(13, -2, "REFUSED", "why"), 1.0, {}, version))
    assert status.content == struct.pack(">Hq20s", 13, -2, b"REFUSED") + b"why\0"


@pytest.mark.parametrize("version", [1, 2])
def test_what_others_send_is_read(version: int) -> None:
    pixels = np.arange(6 * 4, dtype=np.int16).reshape(1, 4, 6) - 9
    metadata = {"TransformStatus": "MISSING", "Größe": "12"} if version == 2 else {}
    stream = b"".join(
        [
            message("TRANSFORM", "ProbeToTracker", transform_body(MATRIX), version, metadata, 5.25),
            message("IMAGE", "Image_Probe", image_body(pixels, spacing=(0.2, 0.1, 1.0)), version),
            message("IMAGE", "Image_Probe", image_body(pixels.astype(">i2")), version),
            message("STRING", "Depth", struct.pack(">HH", 3, 4) + b"50mm", version),
            message("STATUS", "Scanner", struct.pack(">Hq20s", 1, 0, b"OK") + b"ready\0", version),
        ]
    )
    reader, rejections = decoder()
    messages = reader.feed(stream, 7.0)
    assert (rejections.count, reader.partial) == (0, False)
    transform, image, swapped, text, status = (found.content for found in messages)
    assert isinstance(transform, contents.Transform)
    np.testing.assert_allclose(transform.to_T_from, MATRIX, atol=1e-6)
    assert (messages[0].device, messages[0].sent_s, messages[0].host_s) == ("ProbeToTracker", 5.25, 7.0)
    assert messages[0].metadata == metadata
    assert messages[1].sent_s is None
    assert isinstance(image, contents.Image)
    assert isinstance(swapped, contents.Image)
    np.testing.assert_array_equal(image.pixels, pixels)
    np.testing.assert_array_equal(swapped.pixels, pixels)
    np.testing.assert_allclose(np.linalg.norm(image.world_T_ijk[:3, :3], axis=0), [0.2, 0.1, 1.0], rtol=1e-6)
    assert image.pixels.flags.writeable
    assert text == contents.Text("50mm")
    assert status == contents.Status(1, 0, "OK", "ready")


@given(cuts=st.lists(st.integers(0, 600), max_size=12))
@settings(max_examples=50, deadline=None)
def test_how_the_stream_is_cut_into_pieces_does_not_matter(cuts: list[int]) -> None:
    stream = b"".join(message("TRANSFORM", f"T{number}", transform_body(MATRIX), 1 + number % 2) for number in range(4))
    reader, rejections = decoder()
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    found = [m for a, b in itertools.pairwise(edges) for m in reader.feed(stream[a:b], 0.0)]
    assert [m.device for m in found] == ["T0", "T1", "T2", "T3"]
    assert rejections.count == 0
    assert not reader.partial


def test_messages_that_are_wrong_inside_are_left_out_and_the_next_one_is_read() -> None:
    pixels = np.zeros((1, 4, 6), np.uint8)
    good = message("TRANSFORM", "Good", transform_body(MATRIX))
    wrong = {
        "checksum": message("TRANSFORM", "Bad", transform_body(MATRIX), checksum=1),
        "buffer": message("TRANSFORM", "Bad", transform_body(MATRIX)[:-1]),
        "finite": message("TRANSFORM", "Bad", transform_body(MATRIX * np.nan)),
        "reshape": message("IMAGE", "Bad", image_body(pixels)[:-1]),
        "KeyError|77": message("IMAGE", "Bad", image_body(pixels, scalar=77)),
        "image of": message("IMAGE", "Bad", image_body(np.zeros((1, 0, 6), np.uint8))),
        "codec|decode": message("STRING", "Bad", struct.pack(">HH", 3, 2) + b"\xff\xfe"),
        "Bad": message("STATUS", "Bad", b"\0\1"),
    }
    for reason, bad in wrong.items():
        reader, rejections = decoder()
        assert [m.device for m in reader.feed(bad + good, 0.0)] == ["Good"], reason
        assert rejections.count == 1, reason
        assert "Bad" in rejections.last
    for extended in ((0xFFFF, 0, 0), (12, 0xFFFF, 0xFFFFFFFF), (12, 10, 50), (0, 2, 0)):
        reader, rejections = decoder()
        bad = message("TRANSFORM", "Bad", transform_body(MATRIX), 2, {"a": "b"}, extended=extended)
        assert [m.device for m in reader.feed(bad + good, 0.0)] == ["Good"], extended
        assert rejections.count == 1, extended


def test_a_left_out_message_shows_in_the_count() -> None:
    reader, _ = decoder(frozenset({("IMAGE", "US")}))
    body = image_body(np.zeros((1, 2, 2), np.uint8))
    stream = b"".join(message("IMAGE", "US", body, checksum=1 if number == 1 else None) for number in range(3))
    assert [m.index for m in reader.feed(stream, 0.0)] == [0, 2]


def test_messages_not_wanted_are_skipped_unread() -> None:
    reader, rejections = decoder(frozenset({("IMAGE", "Image_Probe")}))
    stream = message("IMAGE", "Other", b"nonsense", checksum=1) + message("GET_IMAGE", "Image_Probe", b"")
    stream += message("IMAGE", "Image_Probe", image_body(np.ones((1, 2, 2), np.uint8)))
    assert [m.device for m in reader.feed(stream, 0.0)] == ["Image_Probe"]
    assert rejections.count == 0


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        (struct.pack(">H12s20sIIQQ", 1, b"IMAGE", b"US", 0, 0, 1 << 60, 0), "1152921504606846976 bytes announced"),
        (struct.pack(">H12s20sIIQQ", 1, b"IMAGE", b"US", 0, 0, IGTL_BODY_BYTES + 1, 0), "bytes announced"),
        (struct.pack(">H12s20sIIQQ", 3, b"IMAGE", b"US", 0, 0, 10, 0), "header version 3"),
        (struct.pack(">H12s20sIIQQ", 1, b"\xff\xff", b"US", 0, 0, 10, 0), "not text"),
        (struct.pack(">H12s20sIIQQ", 1, b"IMAGE", b"\x01\x02", 0, 0, 10, 0), "not text"),
        (b"GET / HTTP/1.1\r\nHost: localhost:18944\r\nAccept: */*\r\n\r\n....", "not OpenIGTLink"),
    ],
)
def test_a_header_that_cannot_be_one_breaks_the_stream_before_any_memory_is_taken(header: bytes, reason: str) -> None:
    reader, _ = decoder()
    with pytest.raises(StreamBroken, match=reason):
        reader.feed(header, 0.0)


@given(noise=st.binary(max_size=400), flips=st.lists(st.tuples(st.integers(0, 300), st.integers(1, 255)), max_size=6))
@settings(max_examples=200, deadline=None)
def test_hostile_bytes_break_the_stream_or_are_left_out(noise: bytes, flips: list[tuple[int, int]]) -> None:
    stream = bytearray(
        message("TRANSFORM", "T", transform_body(MATRIX), 2, {"TransformStatus": "OK"})
        + message("IMAGE", "I", image_body(np.zeros((1, 3, 3), np.uint8)))
        + noise
    )
    for position, mask in flips:
        stream[position % len(stream)] ^= mask
    reader, _ = decoder()
    try:
        for found in reader.feed(bytes(stream), 0.0):
            assert isinstance(found, igtl.Message)
    except StreamBroken:
        pass


@given(
    body=st.binary(max_size=200),
    kind=st.sampled_from(["TRANSFORM", "IMAGE", "STRING", "STATUS"]),
    version=st.sampled_from([1, 2]),
)
@settings(max_examples=200, deadline=None)
def test_hostile_bodies_with_the_right_checksum_are_left_out_or_read(body: bytes, kind: str, version: int) -> None:
    reader, rejections = decoder()
    raw = struct.pack(">H12s20sIIQQ", version, kind.encode(), b"X", 0, 0, len(body), crc64(body)) + body
    found = reader.feed(raw + message("STRING", "Good", struct.pack(">HH", 3, 2) + b"ok"), 0.0)
    assert found[-1].content == contents.Text("ok")
    assert len(found) + rejections.count == 2


@pytest.mark.parametrize("name", ["", "x" * 21, "Kamera→TRUS", "a\nb", " a", "\x00"])
def test_names_that_the_protocol_would_cut_or_change_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="expected 1 to 20 printable ASCII characters"):
        igtl.check_name(name)
    with pytest.raises(InputError):
        igtl.pack_transform(name, MATRIX, 0.0, {})
    assert igtl.check_name("x" * 20) == "x" * 20


def test_a_missing_pyigtl_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise ModuleNotFoundError(name)

    igtl._pyigtl.cache_clear()
    monkeypatch.setattr("importlib.import_module", absent)
    with pytest.raises(MissingExtraError, match=r"pip install 'fgreg\[igtl\]'"):
        igtl.require_pyigtl()
