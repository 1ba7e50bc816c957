"""What the fuzzers feed: readers of files, decoders of network messages and of the serial line, with valid inputs."""

from __future__ import annotations

import gzip
import io
import json
import shutil
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fuzz_inputs import Form
from tests import bags, bk_emulator, igtl_bytes, live_configs, session_files

Read = Callable[[bytes, Path], object]


@dataclass(frozen=True, slots=True)
class Target:
    """Something that reads what others wrote.

    Attributes:
        name, what: of it.
        valid: valid inputs. form: what they are.
        read: reads an input; may use the folder.
        share: of all inputs, relative to the other targets; small where one takes long.
        raises: errors besides fgreg's own by which it says that an input is wrong.
    """

    name: str
    what: str
    valid: Callable[[], Sequence[bytes]]
    form: Form
    read: Read
    share: float
    raises: tuple[type[Exception], ...] = ()


def _written(data: bytes, folder: Path, name: str) -> Path:
    path = folder / name
    if path.is_dir():
        shutil.rmtree(path)
    path.write_bytes(data)
    return path


def _yaml(document: Any) -> bytes:
    return yaml.safe_dump(document, sort_keys=False).encode()


def _lines(events: Sequence[Any]) -> bytes:
    return "".join(json.dumps(event) + "\n" for event in events).encode()


# --- a session's files ----------------------------------------------------------------------------------------------


def _session(folder: Path) -> Path:
    """A whole session, whose files are then replaced."""
    session = folder / "session"
    if not session.is_dir():
        session_files.write(session)
    return session


def _read_setup(data: bytes, folder: Path) -> None:
    from fgreg.session.session_reader import check_session, read_session

    session = folder / "setup"
    if not session.is_dir():
        session_files.write(session)
    (session / "session.yaml").write_bytes(data)
    check_session(session)
    read_session(session)


def _read_events(data: bytes, folder: Path) -> None:
    from fgreg.session.session_reader import read_session

    session = _session(folder)
    (session / "events.jsonl").write_bytes(data)
    read_session(session)


def _append(data: bytes, folder: Path) -> None:
    from fgreg.model.events import NoteEvent
    from fgreg.session.journal import Journal
    from fgreg.session.session_reader import read_session

    session = folder / "append"
    if not session.is_dir():
        session_files.write(session)
    for old in session.glob("*.cut*"):
        old.unlink()
    path = session / "events.jsonl"
    path.write_bytes(data)
    try:
        readable = bool(read_session(session).events is not None)
    except Exception:
        readable = False
    try:
        with Journal.open(session) as journal:
            journal.append(NoteEvent(journal.last_t or 0.0, 0, "appended"), durable=False)
    except Exception:
        if path.read_bytes() != data:
            raise AssertionError("a recording that was refused has been changed") from None
        raise
    if not readable:
        raise AssertionError("a recording that cannot be read was opened for appending")
    if data and not path.read_bytes().startswith(data[: data.rfind(b"\n") + 1]):
        raise AssertionError("whole lines of a recording have been changed")


def _read_truth(data: bytes, folder: Path) -> None:
    from fgreg.session.session_reader import read_ground_truth

    (_session(folder) / "ground_truth.yaml").write_bytes(data)
    read_ground_truth(_session(folder))


def _read_result(data: bytes, folder: Path) -> None:
    from fgreg.session.result_file import read_result

    read_result(_written(data, folder, "result.yaml"))


def _read_rig(data: bytes, folder: Path) -> None:
    from fgreg.session.rig_file import read_rig

    read_rig(_written(data, folder, "rig.yaml"))


def _valid_recording() -> list[bytes]:
    pose = [[1, 0, 0, 5], [0, 1, 0, -2], [0, 0, 1, 120], [0, 0, 0, 1]]
    lines = [
        {"type": "medium", "t": 0, "sound_speed_m_s": 1482, "sigma_m_s": 2},
        {"type": "target", "t": 0, "target": 0, "depth_mm": 25.1, "depth_sigma_mm": 0.2},
        {"type": "target", "t": 0, "target": 1, "from": 0, "apart_mm": 41.2, "towards": ["+y", "-x"]},
        {"type": "pulse", "t": 1, "target": 0, "scan_deg": -26, "x_mm": -4.1, "range_mm": 25.6, "amplitude": 31},
        {"type": "stage", "t": 2, "scan_deg": -11.9},
        {"type": "marker", "t": 3, "camera_T_marker": pose},
    ]
    return [_lines(lines)]


def _read_recording(data: bytes, folder: Path) -> None:
    from fgreg.session.recording_reader import read_recording

    read_recording(_written(data, folder, "recording.jsonl"))


def _read_live(data: bytes, folder: Path) -> None:
    from fgreg.live.config import read_config

    if not (folder / "live").is_dir():
        live_configs.write(folder / "live")
    (folder / "live" / "live.yaml").write_bytes(data)
    read_config(folder / "live" / "live.yaml")


def _parse_yaml(data: bytes, _folder: Path) -> None:
    from fgreg.session.yaml_loader import parse_yaml

    parse_yaml(data.decode("utf-8", "surrogateescape"), "file.yaml")


def _valid_rig() -> list[bytes]:
    rig = {"format": "fgreg-rig/1", "names": ["radius_mm", "tag_size"], "values": [0.2, -0.01]}
    rig |= {"covariance": [[0.01, 0.0], [0.0, 1e-6]], "prior_sigmas": [0.2, 0.003], "created": "today"}
    return [_yaml({**rig, "sessions": [{"events.jsonl": 64 * "a"}]})]


def _yaml_texts() -> list[bytes]:
    return [
        b"a: 1\nb: [1, 2, {c: d}]\ne: |\n  text\n  more\nf: &x {g: 1}\nh: *x\n",
        b"'a b': \"\\x41\"\nc:\n- 1\n- [2]\n",
        *(_yaml(document) for document in (session_files.setup(), session_files.truth())),
    ]


# --- frames ---------------------------------------------------------------------------------------------------------


def _valid_pictures() -> list[bytes]:
    import cv2

    image = (np.arange(48 * 64, dtype=np.uint32) * 7919 % 251).astype(np.uint8).reshape(48, 64)
    colour = np.stack([image, image[::-1], image.T.reshape(48, 64)], axis=-1)
    out = [session_files.png(64, 48)]
    for suffix, picture in ((".png", image), (".png", image.astype(np.uint16) * 257), (".jpg", colour)):
        out.append(cv2.imencode(suffix, picture)[1].tobytes())
    return out


def _read_picture(data: bytes, folder: Path) -> None:
    from fgreg.detection.frame_files import read_picture
    from fgreg.session.frame_files import check_camera_frame

    path = _written(data, folder, "a.png")
    if data.startswith(b"\x89P"):
        check_camera_frame(path, "a.png", "line 1", (64, 48))
    read_picture(path)


def _valid_arrays() -> list[bytes]:
    out = []
    for array in (np.ones((8, 8), np.float32), np.ones((4, 200), np.int16), np.ones((3, 3), ">f8")):
        buffer = io.BytesIO()
        np.save(buffer, array)
        out.append(buffer.getvalue())
    return out


def _read_array(data: bytes, folder: Path) -> None:
    from fgreg.detection.frame_files import read_array
    from fgreg.session.frame_files import check_trus_frame

    path = _written(data, folder, "a.npy")
    check_trus_frame(path, "a.npy", "line 1", None)
    read_array(path)


# --- files of other programs ----------------------------------------------------------------------------------------

_MATRIX = [[900.0, 0.0, 320.0], [0.0, 900.0, 240.0], [0.0, 0.0, 1.0]]


@cache
def _valid_calibrations() -> list[bytes]:
    import cv2

    out = []
    for suffix in (".yml", ".xml", ".json"):
        storage = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        for name, value in (("M1", _MATRIX), ("M2", _MATRIX), ("D1", [[0.1, 0, 0, 0, 0]]), ("D2", [[0.1, 0, 0, 0, 0]])):
            storage.write(name, np.array(value, dtype=np.float64))
        storage.write("R", np.eye(3))
        storage.write("T", np.array([[5.0], [0.0], [0.0]]))
        storage.write("image_width", 640)
        storage.write("image_height", 480)
        out.append(storage.releaseAndGetString().encode())
    rows = {"rows": 3, "cols": 3, "data": [900.0, 0.0, 320.0, 0.0, 900.0, 240.0, 0.0, 0.0, 1.0]}
    ros = {"image_width": 640, "image_height": 480, "camera_name": "left", "camera_matrix": rows}
    ros |= {
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.1, 0, 0, 0, 0]},
    }
    ros |= {"rectification_matrix": {"rows": 3, "cols": 3, "data": [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
    ros |= {"projection_matrix": {"rows": 3, "cols": 4, "data": [900, 0, 320, 0, 0, 900, 240, 0, 0, 0, 1, 0]}}
    cam = {"camera_model": "pinhole", "intrinsics": [900.0, 900.0, 320.0, 240.0], "resolution": [640, 480]}
    cam |= {"distortion_model": "radtan", "distortion_coeffs": [0.1, 0.0, 0.0, 0.0]}
    near = np.eye(4)
    near[0, 3] = -0.005
    kalibr = {"cam0": cam, "cam1": {**cam, "T_cn_cnm1": near.tolist()}}
    return [*out, _yaml(ros), _yaml(kalibr)]


def _read_calibration(data: bytes, folder: Path) -> None:
    from fgreg.drivers.calibration_files import read_calibration

    read_calibration([_written(data, folder, "calibration.yaml")])


def _valid_sequences() -> list[bytes]:
    pose = "1 0 0 5 0 1 0 6 0 0 1 120 0 0 0 1"
    frames = "".join(
        f"Seq_Frame{k:04d}_{key} = {value}\n"
        for k in range(3)
        for key, value in (
            ("Timestamp", 8.5 + k),
            ("ImageStatus", "OK"),
            ("MarkerToCameraTransform", pose),
            ("MarkerToCameraTransformStatus", "OK"),
            ("StageAngle", 2.0 * k),
            ("FgregX", 3.0),
            ("FgregRange", 30.0),
        )
    )
    head = (
        "ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nCompressedData = {packed}\n"
        "DimSize = 4 5 3\nElementSpacing = 1 1 1\nKinds = domain domain list\nUltrasoundImageOrientation = MFA\n"
        "UltrasoundImageType = BRIGHTNESS\nElementType = MET_UCHAR\n" + frames + "ElementDataFile = LOCAL\n"
    )
    import zlib

    image = bytes(range(60))
    return [head.format(packed=False).encode() + image, head.format(packed=True).encode() + zlib.compress(image)]


def _read_sequence(data: bytes, folder: Path) -> None:
    from fgreg.convert.mapping import RecordingMapping
    from fgreg.convert.plus import read_plus

    read_plus(_written(data, folder, "sequence.mha"), RecordingMapping())


@cache
def _valid_nrrd() -> list[bytes]:
    pose = "1 0 0 5 0 1 0 6 0 0 1 120 0 0 0 1"
    fields = "".join(
        f"Seq_Frame{k:04d}_{key}:={value}\n"
        for k in range(3)
        for key, value in (
            ("Timestamp", 8.5 + k),
            ("MarkerToCameraTransform", pose),
            ("MarkerToCameraTransformStatus", "OK"),
            ("StageAngle", 2.0 * k),
            ("FgregX", 3.0),
            ("FgregRange", 30.0),
        )
    )
    head = (
        "NRRD0005\ntype: unsigned char\ndimension: 3\nsizes: 4 5 3\nkinds: domain domain list\nencoding: {packed}\n"
        "ultrasound image orientation:=MFA\nUltrasoundImageOrientation:=MFA\nUltrasoundImageType:=BRIGHTNESS\n"
    )
    image = bytes(range(60))
    whole = [(head.format(packed="raw") + fields + "\n").encode() + image]
    return [*whole, (head.format(packed="gzip") + fields + "\n").encode() + gzip.compress(image, mtime=0)]


def _read_nrrd(data: bytes, folder: Path) -> None:
    from fgreg.convert.mapping import RecordingMapping
    from fgreg.convert.plus import read_plus

    read_plus(_written(data, folder, "sequence.nrrd"), RecordingMapping())


@cache
def _valid_matlab() -> list[bytes]:
    from scipy.io import savemat

    out = []
    for packed in (False, True):
        buffer: Any = io.BytesIO()
        savemat(buffer, {"t": np.arange(3.0), "pm": np.arange(3), "scan_deg": np.ones(3)}, do_compression=packed)
        out.append(buffer.getvalue())
    return out


def _read_matlab(data: bytes, folder: Path) -> None:
    from fgreg.convert.child_reader import open_array_file
    from fgreg.convert.mapping import RecordingMapping

    open_array_file(_written(data, folder, "a.mat"), RecordingMapping())


def _valid_tables() -> list[bytes]:
    pose = ",".join(f"m{row}{column}" for row in range(3) for column in range(4))
    values = "1,0,0,5,0,1,0,6,0,0,1,120"
    return [
        f"t,type,pm,scan_deg,sweep,x_mm,range_mm,{pose}\n1,pair,0,3.0,1,4.0,30.0,{values}\n2,pair,1,4,-1,5,31,{values}\n".encode(),
        b"t;type;text\n1;note;hello\n2;camera_moved;\n",
    ]


def _read_table(data: bytes, folder: Path) -> None:
    from fgreg.convert.mapping import RecordingMapping
    from fgreg.convert.table import read_table

    read_table(_written(data, folder, "table.csv"), RecordingMapping())


def _valid_mappings() -> list[bytes]:
    return [
        _yaml({"format": "fgreg-mapping/1", "columns": {"t": "time", "pm": {"column": "id", "scale": 2.0}}}),
        _yaml({"format": "fgreg-mapping/1", "topics": {"marker": "/m"}, "scan": {"joint": "j", "unit": "deg"}}),
        _yaml({"format": "fgreg-mapping/1", "fields": {"pm": "Pm"}, "frames": [0, 1], "camera_moved": {}}),
    ]


def _read_mapping(data: bytes, folder: Path) -> None:
    from fgreg.convert.mapping import read_mapping

    read_mapping(_written(data, folder, "mapping.yaml"))


@cache
def _valid_bags() -> list[bytes]:
    import tempfile

    messages: list[bags.Message] = []
    for k in range(3):
        messages += [
            ("/fgreg/scan", 1.0 * k, bags.number(10.0 * k)),
            ("/fgreg/frame", 1.0 * k, bags.image(1.0 * k, "32FC1", np.ones((16, 20), np.float32))),
            ("/marker", 1.0 * k, bags.pose_stamped(1.0 * k, (0.0, 0.01, 0.12))),
        ]
    with tempfile.TemporaryDirectory() as folder:
        bag = bags.write_bag(Path(folder) / "bag", messages, mcap=True)
        plain = bags.write_bag(Path(folder) / "plain", messages)
        return [next(bag.glob("*.mcap")).read_bytes(), next(plain.glob("*.db3")).read_bytes()]


def _read_bag(data: bytes, folder: Path) -> None:
    from fgreg.convert.bag import read_bag
    from fgreg.convert.mapping import RecordingMapping

    topics = {"marker": "/marker"}
    suffix = "db3" if data.startswith(b"SQLite") else "mcap"
    imported = read_bag(_written(data, folder, f"a.{suffix}"), RecordingMapping(topics=topics))
    del imported


# --- messages -------------------------------------------------------------------------------------------------------


def _valid_igtl() -> list[bytes]:
    pose = igtl_bytes.transform_body(np.eye(4))
    image = igtl_bytes.image_body(np.ones((1, 3, 4), np.uint8))
    text = struct.pack(">HH", 3, 4) + b"home"
    status = struct.pack(">HQ20s", 1, 0, b"") + b"ok\0"
    tracked = struct.pack(">20sBB", b"Device", 2, 0)
    part = igtl_bytes.image_body(np.zeros((1, 2, 5), np.uint8), size=(1, 4, 5), start=(0, 2, 0))
    kinds = {"TRANSFORM": pose, "IMAGE": image, "STRING": text, "STATUS": status}
    kinds |= {
        "GET_STATUS": b"",
        "STT_TDATA": bytes(36),
        "TDATA": tracked + pose,
        "QTDATA": tracked + bytes(24) + pose[-4:],
        "POSITION": bytes(24) + pose[:4],
    }
    out = [igtl_bytes.message("IMAGE", "Device", part)]
    for version in (1, 2):
        for kind, body in kinds.items():
            out.append(igtl_bytes.message(kind, "Device", body, version))
    return [*out, b"".join(out)]


def _feed_igtl(data: bytes, _folder: Path) -> None:
    from fgreg.drivers.igtl_decoder import MessageDecoder
    from fgreg.drivers.stream_decoder import Rejections

    wanted = frozenset((kind, "") for kind in ("TRANSFORM", "IMAGE", "STRING", "STATUS"))
    decoder = MessageDecoder(Rejections(), wanted, Counter())
    half = len(data) // 3
    decoder.feed(data[:half], 1.0)
    decoder.feed(data[half:], 2.0)


def _igtl_broken() -> tuple[type[Exception], ...]:
    from fgreg.drivers.stream_decoder import StreamBroken

    return (StreamBroken,)


def _valid_bk() -> list[bytes]:
    return [
        bk_emulator.grabbed(np.ones((4, 5), np.uint8)),
        bk_emulator.frame(b"DATA:US_WIN_SIZE:A 640,480;"),
        bk_emulator.frame(b"DATA:US_FRAME_RATE:A 25;") + bk_emulator.frame(b"ACK;"),
    ]


def _feed_bk(data: bytes, _folder: Path) -> None:
    from fgreg.drivers.bk_oem import OemDecoder
    from fgreg.drivers.stream_decoder import Rejections

    decoder = OemDecoder(Rejections(), count())
    half = len(data) // 3
    decoder.feed(data[:half], 1.0)
    decoder.feed(data[half:], 2.0)


def _valid_apt() -> list[bytes]:
    status = struct.pack("<HHBB", 0x0491, 14, 0x81, 0x50) + struct.pack("<HiHHI", 1, 1000, 0, 0, 0x400)
    velocity = struct.pack("<HHBB", 0x0415, 14, 0x81, 0x50) + struct.pack("<Hiii", 1, 0, 100, 200)
    done = struct.pack("<HHBB", 0x0444, 0, 0x01, 0x50)
    return [status, velocity + status, status + done + status]


def _feed_apt(data: bytes, _folder: Path) -> None:
    from fgreg.drivers import thorlabs_apt

    parser = thorlabs_apt.AptParser()
    half = len(data) // 3
    readers = {14: (thorlabs_apt.read_status, thorlabs_apt.read_velocity, thorlabs_apt.read_home)}
    readers |= {84: (thorlabs_apt.read_model, thorlabs_apt.read_serial)}  # type: ignore[dict-item]
    for message in [*parser.feed(data[:half]), *parser.feed(data[half:])]:
        for reader in readers.get(len(message.data), ()):
            reader(message.data)


def _valid_stage() -> list[bytes]:
    from fgreg.stage.limits import MotionKind
    from fgreg.stage.messages import Beat, Command, Request, Reset, Stop, encode

    kind = next(iter(MotionKind))
    messages = (
        Beat(1.0, 0.9, "ok"),
        Request(1.0, kind, "page"),
        Command(1.0, 3, kind, 0.1, 0.2, 0.01, "next"),
        Stop(1.0, True, "by hand"),
        Reset(1.0, "page"),
    )
    return [encode(message).strip() for message in messages]


def _decode_stage(data: bytes, _folder: Path) -> None:
    from fgreg.stage.messages import decode

    decode(data)


def _words(data: bytes, _folder: Path) -> None:
    from fgreg.drivers.operator_words import understand

    understand(data.decode("utf-8", "replace"), (7, 5))


def _of(make: Callable[[], Any], as_text: Callable[[Any], bytes] = _yaml) -> Callable[[], list[bytes]]:
    return lambda: [as_text(make())]


TARGETS: dict[str, Target] = {
    target.name: target
    for target in (
        Target("setup", "session.yaml", _of(session_files.setup), Form.YAML, _read_setup, 1.0),
        Target("events", "events.jsonl", _of(session_files.events, _lines), Form.LINES, _read_events, 2.0),
        Target(
            "append", "events.jsonl opened for appending", _of(session_files.events, _lines), Form.LINES, _append, 1.0
        ),
        Target("truth", "ground_truth.yaml", _of(session_files.truth), Form.YAML, _read_truth, 2.0),
        Target("result", "result.yaml", _of(session_files.result), Form.YAML, _read_result, 1.0),
        Target("rig", "rig.yaml", _valid_rig, Form.YAML, _read_rig, 3.0),
        Target("recording", "set-up recordings", _valid_recording, Form.LINES, _read_recording, 3.0),
        Target("live", "the configuration of a live session", _of(live_configs.config), Form.YAML, _read_live, 1.0),
        Target("yaml", "any YAML", _yaml_texts, Form.YAML, _parse_yaml, 3.0),
        Target("picture", "PNG and JPEG frames", _valid_pictures, Form.BYTES, _read_picture, 10.0),
        Target("array", "NPY frames", _valid_arrays, Form.BYTES, _read_array, 10.0),
        Target("calibration", "calibrations of other programs", _valid_calibrations, Form.TEXT, _read_calibration, 2.0),
        Target("sequence", "PLUS sequences", _valid_sequences, Form.TEXT, _read_sequence, 6.0),
        Target("nrrd", "NRRD sequences", _valid_nrrd, Form.TEXT, _read_nrrd, 4.0),
        Target("matlab", "MATLAB files, read by a process of their own", _valid_matlab, Form.BYTES, _read_matlab, 0.02),
        Target("table", "CSV tables", _valid_tables, Form.TEXT, _read_table, 6.0),
        Target("mapping", "mapping files", _valid_mappings, Form.YAML, _read_mapping, 3.0),
        Target("bag", "ROS recordings", _valid_bags, Form.BYTES, _read_bag, 2.0),
        Target("igtl", "OpenIGTLink messages", _valid_igtl, Form.BYTES, _feed_igtl, 15.0, _igtl_broken()),
        Target("bk", "messages of BK scanners", _valid_bk, Form.BYTES, _feed_bk, 15.0, _igtl_broken()),
        Target("apt", "the serial line of Thorlabs stages", _valid_apt, Form.BYTES, _feed_apt, 15.0),
        Target("stage", "messages of the stage's process", _valid_stage, Form.LINES, _decode_stage, 10.0),
        Target(
            "words",
            "the operator's words",
            lambda: [b"aim 3 4", b"pair", b"check 1 2 3", b"stop"],
            Form.TEXT,
            _words,
            10.0,
        ),
    )
}
