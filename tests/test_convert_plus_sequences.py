"""PLUS sequences as sessions: written by SimpleITK, and by hand after PLUS's description of the format."""

from __future__ import annotations

import json
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from fgreg.cli.main import app
from fgreg.convert.drafts import ImageKind
from fgreg.convert.plus import oriented
from fgreg.convert.sequence_file import read_sequence
from fgreg.errors import FgregError, InputError
from tests import session_files

RUNNER = CliRunner()
POSE = "1 0 0 10 0 0 -1 20 0 1 0 150 0 0 0 1"
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
IMAGES = np.arange(3 * 5 * 4, dtype=np.uint8).reshape(3, 5, 4)
HEADER = """\
ObjectType = Image
NDims = 3
AnatomicalOrientation = RAI
BinaryData = True
BinaryDataByteOrderMSB = False
CenterOfRotation = 0 0 0
CompressedData = {compressed}
DimSize = {size}
ElementSpacing = 1 1 1
Kinds = domain domain list
Offset = 0 0 0
TransformMatrix = 1 0 0 0 1 0 0 0 1
UltrasoundImageOrientation = {orientation}
UltrasoundImageType = {kind}
ElementType = {element}
{fields}ElementDataFile = LOCAL
"""


def frame_fields(index: int, **fields: object) -> dict[str, str]:
    """Fields of a frame: time, a marker pose, a stage angle; ``None`` leaves one out."""
    found: dict[str, object] = {"FrameNumber": 100 + index, "Timestamp": 8151.5 + 0.25 * index, "ImageStatus": "OK"}
    found |= {"MarkerToCameraTransform": POSE, "MarkerToCameraTransformStatus": "OK", "StageAngle": 2.0 * index}
    found |= fields
    return {f"Seq_Frame{index:04d}_{key}": str(value) for key, value in found.items() if value is not None}


def by_hand(
    path: Path,
    fields: dict[str, str],
    images: Any = IMAGES,
    *,
    orientation: str = "MFA",
    kind: str = "BRIGHTNESS",
    compressed: bool = False,
) -> Path:
    element = {"uint8": "MET_UCHAR", "int16": "MET_SHORT", "float32": "MET_FLOAT"}[images.dtype.name]
    text = "".join(f"{key} = {value}\n" for key, value in fields.items())
    size = " ".join(map(str, images.shape[::-1]))
    head = HEADER.format(
        compressed=compressed, size=size, orientation=orientation, kind=kind, element=element, fields=text
    )
    data = images.tobytes()
    path.write_bytes(head.encode() + (zlib.compress(data) if compressed else data))
    return path


def three(**last: object) -> dict[str, str]:
    return frame_fields(0) | frame_fields(1) | frame_fields(2, **last)


def by_simpleitk(path: Path, fields: dict[str, str], images: Any = IMAGES, *, compressed: bool = False) -> Path:
    sitk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed")
    image = sitk.GetImageFromArray(images)
    for key, value in {**fields, "UltrasoundImageOrientation": "MFA", "UltrasoundImageType": "BRIGHTNESS"}.items():
        image.SetMetaData(key, value)
    sitk.WriteImage(image, str(path), useCompression=compressed)
    return path


def setup(folder: Path, **image: object) -> Path:
    data = session_files.setup()
    data["probe"]["image"] |= image
    path = folder / "setup.yaml"
    path.write_text(yaml.safe_dump(data), encoding="utf-8")
    return path


def mapping(folder: Path, content: str) -> Path:
    path = folder / "map.yaml"
    path.write_text(f"format: fgreg-mapping/1\n{content}\n", encoding="utf-8")
    return path


def convert(*words: object) -> Any:
    return RUNNER.invoke(app, ["convert", *map(str, words)])


def refused(*words: object) -> str:
    done = convert(*words)
    assert isinstance(done.exception, FgregError), done.output
    assert str(done.exception).isprintable()
    return str(done.exception)


def events(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()]


@pytest.mark.parametrize("writer", ["hand", "hand-compressed", "SimpleITK", "SimpleITK-compressed"])
def test_each_frame_becomes_a_pair_with_its_image(tmp_path: Path, writer: str) -> None:
    make: Any = by_hand if writer.startswith("hand") else by_simpleitk
    path = make(tmp_path / "scan.mha", three(), compressed=writer.endswith("compressed"))
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path, log_db=60))
    assert done.exit_code == 0, done.output
    note, *pairs = events(tmp_path / "s")
    assert note["text"] == "converted from PLUS sequence scan.mha"
    assert [pair["pm"] for pair in pairs] == [0, 1, 2]
    assert [pair["t"] for pair in pairs] == [8151.5, 8151.75, 8152.0]
    assert [pair["trus"]["scan_deg"] for pair in pairs] == [0.0, 2.0, 4.0]
    assert pairs[1]["marker"]["camera_T_marker"] == session_files.QUARTER
    stored = np.load(tmp_path / "s" / pairs[1]["trus"]["frame"])
    np.testing.assert_array_equal(stored, IMAGES[1])
    assert stored.dtype == np.uint8  # the type that says what is white


def test_fields_say_type_pm_sweep_and_position_and_a_mapping_names_others(tmp_path: Path) -> None:
    turned = math.radians(15.0)  # the probe's z axis along (0, sin 15, cos 15) deg
    stage = f"1 0 0 0 0 {math.cos(turned)} {math.sin(turned)} 0 0 {-math.sin(turned)} {math.cos(turned)} 0 0 0 0 1"
    fields = frame_fields(0, StageAngle=None, ProbeToStageTransform=stage, FgregX=3.5, FgregRange=31.25, Spot=7)
    fields |= frame_fields(1, FgregType="track", StageAngle=-3)
    fields |= frame_fields(2, FgregType="note", FgregText="moved the table", MarkerToCameraTransform=None)
    fields["Seq_Frame0000_FgregSweep"] = "-1"
    fields["Seq_Frame0000_StageAngleStatus"] = "MISSING"  # of a field that is not there
    path = by_hand(tmp_path / "scan.mha", fields)
    mapped = tmp_path / "map.yaml"
    mapped.write_text("format: fgreg-mapping/1\nfields: {pm: Spot}\nframes: [0, 1, 2]\n")
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", mapped)
    assert done.exit_code == 0, done.output
    _, pair, track, note = events(tmp_path / "s")
    assert pair["pm"] == 7
    assert pair["trus"].pop("scan_deg") == pytest.approx(15.0)
    assert pair["trus"] == {"x_mm": 3.5, "range_mm": 31.25, "sweep": -1}
    assert (track["type"], track["scan_deg"]) == ("track", -3.0)
    assert note["text"] == "moved the table"
    mapped.write_text("format: fgreg-mapping/1\nframes: [1]\n")
    assert convert(path, tmp_path / "t", "--setup", setup(tmp_path), "--map", mapped).exit_code == 0
    assert [event["type"] for event in events(tmp_path / "t")] == ["note", "track"]


def test_frames_in_which_the_marker_was_not_tracked_are_left_out_and_reported(tmp_path: Path) -> None:
    path = by_hand(tmp_path / "scan.mha", three(MarkerToCameraTransformStatus="MISSING"))
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path, log_db=60))
    assert done.exit_code == 0, done.output
    assert "2 pair" in done.stdout
    assert "frame 2 is left out: MarkerToCameraTransform is MISSING" in done.stderr
    path = by_hand(tmp_path / "scan.mha", three(ImageStatus="INVALID"))
    done = convert(path, tmp_path / "t", "--setup", setup(tmp_path, log_db=60))
    assert "frame 2 is left out: ImageStatus is INVALID" in done.stderr


def test_images_are_turned_to_depth_and_lateral_whatever_their_orientation() -> None:
    depth_lateral = np.arange(12, dtype=np.uint8).reshape(4, 3)  # far is down, marked is right
    views = {
        "MFA": depth_lateral,
        "UFA": depth_lateral[:, ::-1],
        "MN": depth_lateral[::-1],
        "UN": depth_lateral[::-1, ::-1],
        "FMA": depth_lateral.T,
        "FU": depth_lateral[:, ::-1].T,
        "NM": depth_lateral[::-1].T,
    }
    for letters, stored in views.items():
        np.testing.assert_array_equal(
            oriented(stored, letters, ImageKind.ENVELOPE, "f"), depth_lateral, err_msg=letters
        )
    waves = np.arange(12, dtype=np.int16).reshape(3, 4)  # stored with x along the samples: elements, samples
    channels = oriented(waves, "FMA", ImageKind.CHANNELS, "f")
    np.testing.assert_array_equal(channels, waves)
    assert channels.dtype == np.int16
    with pytest.raises(InputError, match="UltrasoundImageOrientation: found 'XX'"):
        oriented(stored, "XX", ImageKind.ENVELOPE, "f")


def test_radio_frequency_frames_of_single_elements_become_channel_data(tmp_path: Path) -> None:
    waves = np.random.default_rng(1).integers(-999, 999, (3, 128, 20)).astype(np.int16)
    path = by_hand(tmp_path / "rf.mha", three(), waves, orientation="FMA", kind="RF_REAL")
    elements = mapping(tmp_path, "images: channels")
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", elements)
    assert done.exit_code == 0, done.output
    stored = np.load(tmp_path / "s" / events(tmp_path / "s")[2]["trus"]["frame"])
    np.testing.assert_array_equal(stored, waves[1])
    assert stored.dtype == np.int16


def test_a_header_with_its_pixels_in_a_file_beside_it(tmp_path: Path) -> None:
    path = by_hand(tmp_path / "scan.mhd", three())
    head, _, data = path.read_bytes().partition(b"LOCAL\n")
    path.write_bytes(head + b"scan.raw")  # some writers end the last line without a line feed
    (tmp_path / "scan.raw").write_bytes(data)
    images = read_sequence(path).images
    assert images is not None
    np.testing.assert_array_equal(images, IMAGES)
    path.write_bytes(head + b"../scan.raw\n")
    with pytest.raises(InputError, match="expected LOCAL, or a file beside it"):
        read_sequence(path)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"ObjectType = Image", b"\x89PNG", "found no header of key = value lines"),
        (b"ObjectType = Image", b"ObjectType = Tube", "found another file"),
        (b"ElementDataFile = LOCAL\n", b"", "found no header of key = value lines"),
        (
            b"ElementDataFile = LOCAL",
            b"ElementDataFile = ",
            "ElementDataFile: found '', expected LOCAL, or a file beside",
        ),
        (b"ElementDataFile = LOCAL", b"ElementDataFile = ..", "ElementDataFile: found '..', expected LOCAL"),
        (b"DimSize = 4 5 3", b"DimSize = 4 5", "scan.mha: Seq_Frame0002: found it, expected frames below 1"),
        (b"DimSize = 4 5 3", b"DimSize = 4 x 3", "DimSize: found '4 x 3'"),
        (b"DimSize = 4 5 3", b"DimSize = 4 50 3", "found 60 bytes of pixels, expected 600"),
        (b"DimSize = 4 5 3", b"DimSize = 99999999 99999999 3", "DimSize: found"),
        (b"DimSize = 4 5 3", b"DimSize = 2097152 4194304 2097152", "DimSize: found 18446744073709551616 bytes"),
        (b"MET_UCHAR", b"MET_STRING", "ElementType: found 'MET_STRING'"),
        (b"CompressedData = False", b"CompressedData = True", "compressed data that are damaged"),
        (b"Frame0001_Timestamp = 8151.75", b"Frame0001_Timestamp = soon", "Seq_Frame0001_Timestamp: found 'soon'"),
        (b"Seq_Frame0001_Timestamp = 8151.75\n", b"", "Seq_Frame0001_Timestamp: found nothing"),
        (b"Frame0001_MarkerToCameraTransform = 1", b"Frame0001_MarkerToCameraTransform = 3", "a rigid 4x4 matrix"),
        (b"MarkerToCameraTransform =", b"NeedleToCameraTransform =", "no field MarkerToCameraTransform, expected it"),
        (b"StageAngle", b"Angle", "Seq_Frame0000_StageAngle: found nothing"),
        (b"StageAngle = 4.0", b"StageAngle = 900", "scan.mha: frame 2: trus.scan_deg: found 900"),
    ],
)
def test_a_bad_sequence_is_one_line_and_leaves_nothing(tmp_path: Path, old: bytes, new: bytes, message: str) -> None:
    path = by_hand(tmp_path / "scan.mha", three())
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new))
    assert message in refused(path, tmp_path / "s", "--setup", setup(tmp_path, log_db=60))
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["scan.mha", "setup.yaml"]


def test_a_mapping_of_an_absent_field_is_reported_with_the_fields_present(tmp_path: Path) -> None:
    path = by_hand(tmp_path / "scan.mha", three())
    mapped = tmp_path / "map.yaml"
    mapped.write_text("format: fgreg-mapping/1\nfields: {scan: Winkel}\n")
    message = refused(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", mapped)
    assert "'Winkel' in no frame, expected a field of the frames, for scan" in message
    assert "StageAngle" in message
    mapped.write_text("format: fgreg-mapping/1\nframes: [1, 9]\n")
    assert "frame 9: found no such frame" in refused(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", mapped)


@pytest.mark.parametrize(
    ("field", "status"),
    [
        ("MarkerToCameraTransform", "REQ_TIMEOUT"),
        ("MarkerToCameraTransform", "invalid"),
        ("StageAngle", "OUT_OF_VOLUME"),
        ("FgregRange", ""),
    ],
)
def test_only_ok_counts_as_a_status_of_any_field_that_is_used(tmp_path: Path, field: str, status: str) -> None:
    known: dict[str, Any] = {"FgregX": 1.0, "FgregRange": 30.0}
    fields = frame_fields(0, **known) | frame_fields(1, **known) | frame_fields(2, **known) | frame_fields(3, **known)
    fields["Seq_Frame0000_StageAngleStatus"] = "ok"
    fields |= {f"Seq_Frame{index:04d}_{field}Status": status for index in (1, 2)}
    path = by_hand(tmp_path / "scan.mha", fields, np.zeros((4, 5, 4), np.uint8))
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path))
    assert done.exit_code == 0, done.output
    assert [pair["t"] for pair in events(tmp_path / "s")[1:]] == [8151.5, 8152.25]
    assert f"2 frames (1 to 2) are left out: {field} is {status or 'nothing'}" in done.stderr


def test_a_recording_with_every_status_word_keeps_the_frame_that_is_ok(tmp_path: Path) -> None:
    case = Path(__file__).parents[2] / "shared" / "cases" / "exchange" / "status.mha"
    if not case.exists():
        pytest.skip("no ../shared/cases")
    done = convert(case, tmp_path / "s", "--setup", setup(tmp_path))
    assert done.exit_code == 0, done.output
    assert [event["t"] for event in events(tmp_path / "s")[1:]] == [0.0]
    assert [f"frame {index} is left out" in done.stderr for index in range(12)] == [False] + [True] * 11


def test_poses_in_a_trackers_frame_are_composed_and_those_stated_the_other_way_are_inverted(tmp_path: Path) -> None:
    camera = "0 -1 0 5 1 0 0 6 0 0 1 7 0 0 0 1"  # tracker_T_camera, a quarter turn about z
    known: dict[str, Any] = {"FgregX": 1.0, "FgregRange": 30.0, "MarkerToCameraTransform": None}
    tracked = {"MarkerToTrackerTransform": POSE, "CameraToTrackerTransform": camera}
    turned = math.radians(15.0)
    probe = f"1 0 0 0 0 {math.cos(turned)} {math.sin(turned)} 0 0 {-math.sin(turned)} {math.cos(turned)} 0 0 0 0 1"
    held: dict[str, Any] = {"ProbeToTrackerTransform": probe, "StageToTrackerTransform": IDENTITY, "StageAngle": None}
    single = np.zeros((1, 5, 4), np.uint8)
    path = by_hand(tmp_path / "scan.mha", frame_fields(0, **known, **tracked, **held), single)
    assert convert(path, tmp_path / "s", "--setup", setup(tmp_path)).exit_code == 0
    pair = events(tmp_path / "s")[1]
    # By hand: R' (p - t) with R' = [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], of (10, 20, 150) and the marker's axes.
    expected = [[0, 0, -1, 14], [-1, 0, 0, -5], [0, 1, 0, 143], [0, 0, 0, 1]]
    np.testing.assert_allclose(pair["marker"]["camera_T_marker"], expected, atol=1e-12)
    assert pair["trus"]["scan_deg"] == pytest.approx(15.0)
    unseen = frame_fields(0, **known, **tracked, CameraToTrackerTransformStatus="MISSING")
    lost = by_hand(tmp_path / "lost.mha", unseen, single)
    assert "CameraToTrackerTransform is MISSING" in refused(lost, tmp_path / "x", "--setup", setup(tmp_path))
    other = by_hand(tmp_path / "other.mha", frame_fields(0, **known, MarkerToTrackerTransform=POSE), single)
    assert "others that lead from Marker to Camera" in refused(other, tmp_path / "x", "--setup", setup(tmp_path))


@pytest.mark.parametrize(
    ("fields", "mapped", "expected", "told"),
    [
        ({"CameraToMarkerTransform": "1 0 0 -10 0 0 1 -150 0 -1 0 20 0 0 0 1"}, None, session_files.QUARTER, ""),
        ({"CameraToPenTransform": "1 0 0 -10 0 0 1 -150 0 -1 0 20 0 0 0 1"}, "CameraToPen", session_files.QUARTER, ""),
        (
            {"TrackerToPenTransform": "1 0 0 -10 0 0 1 -150 0 -1 0 20 0 0 0 1"},
            "TrackerToPen",
            session_files.QUARTER,
            "no",
        ),
        (
            {"PenToTrackerTransform": POSE},
            "PenToTracker",
            session_files.QUARTER,
            "no field leads from Tracker to Camera",
        ),
        ({"PenToCameraTransform": POSE}, "PenToCamera", session_files.QUARTER, ""),
    ],
)
def test_a_field_is_taken_in_the_direction_that_its_name_states(
    tmp_path: Path, fields: dict[str, str], mapped: str | None, expected: list[list[float]], told: str
) -> None:
    path = by_hand(tmp_path / "scan.mha", three(MarkerToCameraTransform=None, FgregX=1, FgregRange=30, **fields))
    wanted = f"frames: [2]\nfields: {{marker: {mapped}Transform}}" if mapped else "frames: [2]"
    if not mapped:
        for index in (0, 1):
            path.write_bytes(
                path.read_bytes().replace(b"Seq_Frame%04d_MarkerToCamera" % index, b"Seq_Frame%04d_X" % index)
            )
    done = convert(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", mapping(tmp_path, wanted))
    assert done.exit_code == 0, done.output
    assert events(tmp_path / "s")[1]["marker"]["camera_T_marker"] == expected
    assert (told in done.stderr) if told else ("is taken as" not in done.stderr)


@pytest.mark.parametrize(
    ("kind", "wanted", "message"),
    [
        ("BRIGHTNESS", "", "found log-compressed images, expected probe.image.log_db in session.yaml"),
        ("BRIGHTNESS", "images: channels", "UltrasoundImageType: found BRIGHTNESS, expected another type"),
        ("RF_REAL", "", "UltrasoundImageType: found RF_REAL, expected images: channels in the mapping"),
        ("RF_REAL", "images: channels", "found channels frames, float32 of shape [4, 5], expected"),
        ("RF_IQ_LINE", "images: channels", "found 'RF_IQ_LINE', expected BRIGHTNESS, or RF_REAL"),
        ("RF_I_LINE_Q_LINE", "", "found 'RF_I_LINE_Q_LINE'"),
        ("RGB_COLOR", "images: envelope", "found 'RGB_COLOR'"),
        ("Elastography", "", "found 'ELASTOGRAPHY'"),
        ("XX", "", "UltrasoundImageType: found XX, expected images in the mapping"),
    ],
)
def test_images_of_other_kinds_are_not_taken_for_envelopes(
    tmp_path: Path, kind: str, wanted: str, message: str
) -> None:
    path = by_hand(tmp_path / "scan.mha", three(), kind=kind)
    found = refused(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", mapping(tmp_path, wanted))
    assert message in found
    assert not (tmp_path / "s").exists()


def test_the_mapping_says_what_images_are_that_are_linear(tmp_path: Path) -> None:
    linear = mapping(tmp_path, "images: envelope")
    for kind in ("BRIGHTNESS", "XX"):
        path = by_hand(tmp_path / "scan.mha", three(), kind=kind)
        assert convert(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", linear, "--overwrite").exit_code == 0
    assert np.load(tmp_path / "s" / events(tmp_path / "s")[2]["trus"]["frame"]).dtype == np.float32
    message = refused(path, tmp_path / "t", "--setup", setup(tmp_path, log_db=60), "--map", linear)
    assert "found linear images, expected log-compressed ones" in message
    tall = by_hand(tmp_path / "tall.mha", three(), np.zeros((3, 128, 4), np.uint8), kind="XX")
    message = refused(tall, tmp_path / "t", "--setup", setup(tmp_path), "--map", linear)
    assert "found envelope frames, float32 of shape [128, 4]" in message  # it would be read as channel data


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"Spacing = 1 1 1", b"Spacing = 0.2 0.1 1", ""),
        (b"Spacing = 1 1 1", b"Spacing = 0.1 0.2 1", "pixels of 0.2 x 0.1 mm (depth, lateral), expected 0.1 x 0.2 mm"),
        (b"Spacing = 1 1 1", b"Spacing = 0 0.2 1", "ElementSpacing: found '0 0.2 1'"),
        (
            b"Seq_Frame0000_Timestamp",
            b"Seq_Frame0000_ImageToCroppedImageTransform = 1 0 0 -9 0 1 0 -7 0 0 1 0 0 0 0 1\n"
            b"Seq_Frame0000_ImageToProbeTransform = 0 0.25 0 9 0.1 0 0 0 0 0 1 0 0 0 0 1\nSeq_Frame0000_Timestamp",
            "pixels of 0.25 x 0.1 mm (depth, lateral), expected 0.1 x 0.2 mm",
        ),
        (b"TransformMatrix = 1 0 0 0 1", b"TransformMatrix = 0 1 0 1 0", "TransformMatrix: found '0 1 0 1 0 0 0 0 1'"),
        (b"NDims = 3", b"NDims = 4", "NDims: found '4', expected 3, as many as in DimSize"),
        (b"NDims = 3", b"NDims = 3\nDimSize = 4 4 3", "DimSize: found '4 4 3' and '4 5 3', expected one value"),
        (b"DimSize = 4 5 3", b"DimSize = 4 4 3", "found 60 bytes of pixels, expected 48"),
        (b"UltrasoundImageOrientation = MFA\n", b"", "UltrasoundImageOrientation: found nothing"),
        (b"ElementType", b"HeaderSize = 12\nElementType", "HeaderSize: found '12'"),
    ],
)
def test_what_a_header_says_of_its_pixels_is_held_against_the_setup(
    tmp_path: Path, old: bytes, new: bytes, message: str
) -> None:
    path = by_hand(tmp_path / "scan.mha", three())
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new))
    if message:
        assert message in refused(path, tmp_path / "s", "--setup", setup(tmp_path, log_db=60))
    else:
        assert convert(path, tmp_path / "s", "--setup", setup(tmp_path, log_db=60)).exit_code == 0
