"""A configuration as the mapping that ``session.yaml`` holds: degrees and lists, keys as in the format's text."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fgreg.frames import FloatArray
from fgreg.models import CameraModel, NoiseModel, ProbeModel
from fgreg.simulation.config import SimulationConfig

FORMAT = "fgreg-session/1"


def rows(array: FloatArray) -> list[Any]:
    """Nested lists of an array, rounded to 1e-9 (mm, or parts of a rotation) so that files stay readable."""
    rounded: list[Any] = (np.round(np.asarray(array, dtype=np.float64), 9) + 0.0).tolist()
    return rounded


def degrees(angle_rad: float) -> float:
    """Degrees, rounded to 1e-9."""
    return round(math.degrees(angle_rad), 9) + 0.0


def session_document(config: SimulationConfig, marker_T_laser_guess: FloatArray | None = None) -> dict[str, Any]:
    """The content of ``session.yaml``; devices that recorded nothing (cameras without frames) are left out."""
    document: dict[str, Any] = {
        "format": FORMAT,
        "name": config.name,
        "probe": _probe(config),
        "stage": {
            "step_deg": degrees(config.stage.step_rad),
            "limits_deg": [degrees(v) for v in config.stage.limits_device_rad],
            "direction": config.stage.direction,
            "zero_deg": degrees(config.stage.zero_device_rad),
        },
    }
    if config.frames:
        document |= _cameras_and_prints(config)
    document["noise"] = _noise(config.declared_noise or config.noise)
    if marker_T_laser_guess is not None:
        document["initial"] = {"marker_T_laser": rows(marker_T_laser_guess)}
    if config.targets_mm is not None:
        document["targets_mm"] = rows(config.targets_mm)
    return document


def _probe(config: SimulationConfig) -> dict[str, Any]:
    probe: ProbeModel = config.probe
    sensitivity: dict[str, Any] = {
        "depth_mm": rows(probe.sensitivity.depth_mm),
        "half_width_deg": [degrees(v) for v in probe.sensitivity.half_width_rad],
        "edge_sigma_deg": degrees(probe.sensitivity.edge_sigma_rad),
    }
    if config.amplitudes:
        # Measured at the middle depth, as a user would: turn the stage across a source and write down what is heard.
        middle = float(np.mean(config.pm_depth_mm))
        width = float(np.interp(middle, probe.sensitivity.depth_mm, probe.sensitivity.half_width_rad))
        rotation = np.linspace(-1.4, 1.4, 29) * width
        sensitivity["curve"] = {
            "rotation_deg": [degrees(v) for v in rotation],
            "amplitude": rows(config.elevation.amplitude(rotation, width)),
        }
    document: dict[str, Any] = {
        "elements": probe.elements,
        "pitch_mm": probe.pitch_mm,
        "flip": probe.flip,
        "radius_mm": probe.radius_mm,
        "sound_speed_m_s": probe.sound_speed_m_s,
        "sensitivity": sensitivity,
    }
    if config.frames and probe.channels is not None:
        document["channels"] = {
            "sampling_mhz": probe.channels.sampling_mhz,
            "t0_us": probe.channels.t0_us,
            "pulse_delay_us": probe.channels.pulse_delay_us,
        }
    return document


def _cameras_and_prints(config: SimulationConfig) -> dict[str, Any]:
    rig, board = config.camera, config.board
    camera: dict[str, Any] = {"image_size": list(rig.left.image_size), "left": _camera(rig.left)}
    if rig.right is not None and rig.right_T_left is not None:
        camera |= {"right": _camera(rig.right), "right_T_left": rows(rig.right_T_left)}
    tags: list[dict[str, Any]] = []
    for tag in config.marker.tags:
        tags.append({"id": tag.id, "size_mm": tag.size_mm})
        if not np.array_equal(tag.marker_T_tag, np.eye(4)):
            tags[-1]["marker_T_tag"] = rows(tag.marker_T_tag)
    printed: dict[str, Any] = {"columns": board.columns, "rows": board.rows, "square_mm": board.square_mm}
    if board.charuco is not None:
        printed["charuco"] = {"dictionary": board.charuco.dictionary, "marker_mm": board.charuco.marker_mm}
    return {"camera": camera, "marker": {"dictionary": config.marker.dictionary, "tags": tags}, "board": printed}


def _camera(camera: CameraModel) -> dict[str, Any]:
    return {"matrix": rows(camera.matrix), "distortion": rows(camera.distortion)}


def _noise(noise: NoiseModel) -> dict[str, Any]:
    return {
        "marker_translation_mm": list(noise.marker_translation_mm),
        "marker_rotation_rad": list(noise.marker_rotation_rad),
        "marker_bias_mm": noise.marker_bias_mm,
        "aim_mm": list(noise.aim_mm),
        "lateral_mm": noise.lateral_mm,
        "range_mm": noise.range_mm,
        "scan_deg": degrees(noise.scan_rad),
    }
