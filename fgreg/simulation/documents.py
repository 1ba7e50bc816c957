"""A configuration as the content of ``session.yaml`` (see fgreg.model.session_model), with numbers rounded."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.session_model import SESSION, SessionModel
from fgreg.simulation.config import SimulationConfig

DECIMALS = 9
"""Digits after the point of mm, degrees, and entries of a rotation."""


def rows(array: FloatArray) -> list[Any]:
    """Nested lists of an array, rounded."""
    rounded: list[Any] = round_array(array).tolist()
    return rounded


def round_array(array: FloatArray) -> FloatArray:
    """An array rounded as in files."""
    return np.asarray(np.round(np.asarray(array, dtype=np.float64), DECIMALS) + 0.0)


def degrees(angle_rad: float) -> float:
    """Degrees, rounded."""
    return round(math.degrees(angle_rad), DECIMALS) + 0.0


def session_document(config: SimulationConfig, marker_T_laser_guess: FloatArray | None = None) -> dict[str, Any]:
    """The content of ``session.yaml``; devices that recorded nothing (cameras without frames) are left out.

    Raises:
        ValueError: a key of ``config.declared`` lies in no section.
    """
    sensitivity = config.probe.sensitivity
    if config.amplitudes:
        # Measured at the middle depth, as a user would: turn the stage across a source and record the amplitudes.
        width = float(sensitivity.half_width_at(float(np.mean(config.pm_depth_mm))))
        rotation = np.linspace(-1.4, 1.4, 29) * width
        amplitude = as_float_array(config.elevation.amplitude(rotation, width))
        sensitivity = replace(sensitivity, curve_rotation_rad=as_float_array(rotation), curve_amplitude=amplitude)
    channels = config.probe.channels if config.frames else None
    image = config.probe.image if config.frames and channels is None else None
    model = SessionModel(
        name=config.name,
        probe=replace(config.probe, sensitivity=sensitivity, channels=channels, image=image),
        stage=config.stage,
        camera=_recorded_camera(config) if config.has_camera else None,
        marker=config.marker if config.has_camera else None,
        board=config.board if config.has_camera else None,
        noise=config.declared_noise or config.noise,
        initial_marker_T_laser=marker_T_laser_guess,
        systematic=config.systematic,
        static_tags=config.static_tags if config.has_camera else (),
    )
    document: dict[str, Any] = _rounded(SESSION.write(model))
    document.pop("targets_mm")
    if config.targets_mm is not None:
        document["targets_mm"] = rows(config.targets_mm)
    for key, value in config.declared.items():
        *within, last = key.split(".")
        place = document
        for name in within:
            if not isinstance(place.get(name), dict):
                raise ValueError(f"{key}, but {name} is no part of this session.yaml")
            place = place[name]
        place[last] = value
    return document


def _recorded_camera(config: SimulationConfig) -> StereoRig:
    """The session's camera: of single fields where these are recorded, whose line v is line 2 v of the frame."""
    rig = config.declared_camera or config.camera
    if not (config.frames and config.disturbances.deinterlace):
        return rig

    def halved(camera: CameraModel) -> CameraModel:
        width, height = camera.image_size
        matrix = as_float_array(np.diag([1.0, 0.5, 1.0]) @ camera.matrix)
        return replace(camera, image_size=(width, (height + 1) // 2), matrix=matrix)

    return replace(rig, left=halved(rig.left), right=None if rig.right is None else halved(rig.right))


def _rounded(value: Any) -> Any:
    """A document with all its floats rounded."""
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return round(value, DECIMALS) + 0.0 if isinstance(value, float) else value
