"""A complete, valid session as plain data, to write to a folder and to break in one place."""

from __future__ import annotations

import copy
import json
import struct
import zlib
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import yaml

from fgreg.errors import InputError
from fgreg.session.session_reader import read_session

ABSENT = object()
BESIDE: list[list[float]] = [[1.0, 0.0, 0.0, -5.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
IDENTITY: list[list[float]] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
# A quarter turn about x, then 10, 20, 150 mm.
QUARTER: list[list[float]] = [
    [1.0, 0.0, 0.0, 10.0],
    [0.0, 0.0, -1.0, 20.0],
    [0.0, 1.0, 0.0, 150.0],
    [0.0, 0.0, 0.0, 1.0],
]


def diagonal(*variances: float) -> list[list[float]]:
    """A covariance without correlations, as nested lists."""
    return [[float(v) if i == j else 0.0 for j in range(len(variances))] for i, v in enumerate(variances)]


def setup() -> dict[str, Any]:
    """A ``session.yaml`` with every section; no part is shared with another."""
    camera = {"matrix": [[900.0, 0, 320], [0, 900, 240], [0, 0, 1]], "distortion": [0.1, -0.2, 0, 0, 0.05]}
    data = {
        "format": "fgreg-session/1",
        "name": "phantom-01",
        "probe": {
            "elements": 128,
            "pitch_mm": 0.43,
            "flip": False,
            "radius_mm": 10.0,
            "sound_speed_m_s": 1540.0,
            "sensitivity": {
                "depth_mm": [20, 30, 45],
                "half_width_deg": [6.0, 7.0, 8.0],
                "edge_sigma_deg": 0.3,
                "curve": {"rotation_deg": [-8, 0, 8], "amplitude": [0.1, 1.0, 0.1]},
            },
            "channels": {"sampling_mhz": 40.0, "t0_us": 0.5, "pulse_delay_us": 0.25},
            "image": {"pixel_mm": [0.1, 0.2], "origin_mm": [1.0, -20.0]},
        },
        "stage": {"step_deg": 2.0, "limits_deg": [-60, 60], "direction": -1, "zero_deg": 5.0},
        "camera": {"image_size": [640, 480], "left": camera, "right": dict(camera), "right_T_left": BESIDE},
        "marker": {
            "dictionary": "DICT_4X4_50",
            "tags": [{"id": 0, "size_mm": 30.0, "marker_T_tag": IDENTITY}, {"id": 3, "size_mm": 12.5}],
        },
        "board": {
            "columns": 9,
            "rows": 6,
            "square_mm": 10.0,
            "charuco": {"dictionary": "DICT_5X5_100", "marker_mm": 7.0},
        },
        "noise": {
            "marker_translation_mm": [0.2, 0.2, 0.9],
            "marker_rotation_rad": [0.02, 0.02, 0.03],
            "marker_bias_mm": 0.5,
            "aim_mm": [2.0, 2.0, 0.2],
            "lateral_mm": 0.4,
            "range_mm": 0.3,
            "scan_deg": 0.18,
        },
        "initial": {"trus_T_camera": QUARTER, "marker_T_laser": IDENTITY},
        "targets_mm": [[0, 0, 40], [10, -5, 35.5]],
    }
    return cast(dict[str, Any], json.loads(json.dumps(data)))


def events() -> list[dict[str, Any]]:
    """An ``events.jsonl`` with every type of event and every way to give a marker and a look."""
    pose = {"camera_T_marker": QUARTER}
    pose_with_covariance = {**pose, "covariance": diagonal(1e-4, 1e-4, 1e-4, 0.01, 0.01, 0.64)}
    both_views = {"left": "frames/a.png", "right": "frames/b.png"}
    heard = {"scan_deg": -12.0, "x_mm": 3.2, "range_mm": 31.4, "amplitude": 0.8, "sweep": 1}
    recorded = {"scan_deg": 4.0, "frame": "frames/c.npy", "sweep": -1}
    pixels = {"left": [330, 250.5], "right": [300, 250.5]}
    data = [
        {"type": "note", "t": 0.0, "text": "start\nof the session"},
        {"type": "aim", "t": 1.0, "marker": pose, "camera_p_spot_mm": [1, 2, 150], "covariance": diagonal(1, 1, 0.01)},
        {"type": "aim", "t": 2.0, "marker": {"left": "frames/a.png"}, "corner": [8, 5]},
        {"type": "pair", "t": 3.0, "pm": 0, "marker": pose_with_covariance, "trus": heard},
        {"type": "pair", "t": 3.0, "pm": 0, "marker": both_views, "trus": recorded, "spot": pixels},
        {"type": "pair", "t": 4.0, "pm": 7, "marker": {**pose, **both_views}, "trus": {**heard, "sweep": 0}},
        {
            "type": "pair",
            "t": 5,
            "pm": 8,
            "marker": pose,
            "trus": {**heard, "covariance": diagonal(0.09, 0.04)},
            "spot": {"camera_p_mm": [1, 2, 150], "covariance": diagonal(0.04, 0.04, 1)},
        },
        {"type": "track", "t": 6.0, "marker": pose, "trus": heard},
        {"type": "track", "t": 6.5, "marker": pose, "looks": [heard, recorded]},
        {"type": "track", "t": 7.0, "marker": pose, "scan_deg": 3.0},
        {
            "type": "camera_moved",
            "t": 8.0,
            "camera_new_T_camera_old": QUARTER,
            "covariance": diagonal(*[1e-4] * 3, *[1] * 3),
        },
        {"type": "camera_moved", "t": 9.0, "detected": True, "since_t": 8.5},
        {"type": "refused", "t": 9.5, "event": {"type": "pair", "t": 1.0}, "reason": "earlier than the last"},
        {"type": "stage", "t": 10.0, "command": "turn", "scan_deg": 12.0, "reason": "track"},
        {
            "type": "check",
            "t": 11.0,
            "camera_p_mm": [1, 2, 150],
            "covariance": diagonal(0.04, 0.04, 0.25),
            "trus_p_mm": [3, 4, 40],
            "trus_covariance": diagonal(0.04, 0.04, 0.04),
        },
        {
            "type": "check",
            "t": 12.0,
            "left": [330, 250.5],
            "right": [300, 250.5],
            "trus": {"scan_deg": 4.0, "x_mm": 1.0, "range_mm": 30.0, "covariance": diagonal(0.04, 0.04)},
        },
        {"type": "exclude", "t": 13.0, "pm": 0, "reason": "the fibre was bumped", "by": "A. N."},
        {"type": "exclude", "t": 13.0, "line": 2},
        {"type": "include", "t": 14.0, "pm": 0, "reason": "it was not"},
        {
            "type": "point",
            "t": 15.0,
            "left": [330, 250.5],
            "right": [300, 250.5],
            "trus_p_mm": [3, 4, 40],
            "trus_covariance": diagonal(0.04, 0.04, 0.04),
        },
    ]
    return cast(list[dict[str, Any]], json.loads(json.dumps(data)))


def truth() -> dict[str, Any]:
    """A ``ground_truth.yaml``."""
    data = {
        "trus_T_camera": [QUARTER, IDENTITY],
        "marker_T_laser": IDENTITY,
        "pms": {0: [1.0, 2.0, 30.0], 7: [0.0, -4.0, 35.0]},
        "tracks": [{"t": 6.0, "stage_deg": 18.0}],
    }
    return copy.deepcopy(data)


def write(folder: Path, session: Any = None, log: Any = None) -> Path:
    """Writes a session: data, or the text of a file, or the valid ones."""
    folder.mkdir(parents=True, exist_ok=True)
    session = setup() if session is None else session
    log = events() if log is None else log
    text = session if isinstance(session, str) else yaml.safe_dump(session, sort_keys=False)
    (folder / "session.yaml").write_text(text, encoding="utf-8")
    lines = log if isinstance(log, str) else "".join(json.dumps(event) + "\n" for event in log)
    (folder / "events.jsonl").write_text(lines, encoding="utf-8")
    return folder


def write_frames(folder: Path) -> None:
    """The frames that :func:`events` names: two PNG images and channel data."""
    (folder / "frames").mkdir(exist_ok=True)
    for name in ("a.png", "b.png"):
        (folder / "frames" / name).write_bytes(png(640, 480))
    np.save(folder / "frames" / "c.npy", np.zeros((128, 16), dtype=np.float32))


def png(width: int, height: int) -> bytes:
    """A black grey-scale PNG image, by the format's specification."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    pixels = zlib.compress(b"\0" * (height * (width + 1)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def change(data: Any, path: str, value: Any) -> None:
    """Sets (or, where ABSENT, removes) what a dotted path names; numbers index lists."""
    *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    for part in parents:
        data = data[part]
    if value is ABSENT:
        del data[last]
    else:
        data[last] = value


def error_of(folder: Path) -> str:
    """The message of the first problem of a session, which is one short line."""
    with pytest.raises(InputError) as caught:
        read_session(folder)
    text = str(caught.value)
    assert text.isprintable()
    assert len(text) < 400
    return text


def result() -> dict[str, Any]:
    """A ``result.yaml``."""
    epoch = {
        "index": 0,
        "start_s": 0.0,
        "trus_T_camera": QUARTER,
        "covariance": diagonal(*[1e-6] * 3, *[0.01] * 3),
        "pairs": 1,
        "verdict": "ok",
        "predicted_tre_mm": {"mean": 0.71, "p95": 1.12, "worst": 1.4},
    }
    used = {
        "pm": 0,
        "epoch": 0,
        "used": True,
        "lambda_mm": 38.2,
        "theta_deg": -14.1,
        "rotation_deg": 3.1,
        "trus_p_pm_mm": [3.1, -10.2, 38.0],
        "covariance": diagonal(0.04, 0.04, 0.09),
        "residual_mm": 0.21,
        "nis": 0.9,
    }
    data = {
        "format": "fgreg-result/1",
        "fgreg": "0.3.0",
        "session": "phantom-01",
        "verdict": "ok",
        "reasons": ["plain words"],
        "assumptions": [{"text": "one medium along the beam", "checks": [0]}],
        "checks": [
            {"t": 80.5, "error_mm": [0.1, -0.2, 0.5], "predicted_95_mm": 1.2, "nis": 0.5, "verdict": "ok"},
            {"t": 81.0, "error_mm": None, "predicted_95_mm": None, "nis": None, "verdict": "warning", "reason": "far"},
        ],
        "laser": {"marker_T_laser": IDENTITY, "covariance": diagonal(1e-6, 1e-6, 0, 0.01, 0.01, 0)},
        "epochs": [epoch],
        "pairs": [used, {"pm": 1, "epoch": 0, "used": False, "reason": "not heard"}],
        "tracks": [{"t": 91.2, "stage_deg": 12.4, "sigma_deg": 0.5, "lambda_mm": 40.1, "causal": False}],
    }
    return cast(dict[str, Any], json.loads(json.dumps(data)))
