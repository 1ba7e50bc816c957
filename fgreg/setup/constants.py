"""What the estimators of this package take from the declared set-up, and what they give."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fgreg.geometry.rig import Constant
from fgreg.model.session_model import NoiseModel, SessionModel


@dataclass(frozen=True, slots=True)
class Declared:
    """What the set-up declares that the estimators need; mm, rad.

    Attributes:
        radius_mm, sound_speed_m_s, zero_device_rad, direction, flip: of probe and stage.
        range_offset_sigma_mm, sound_speed_sigma, tilt_sigma_rad, backlash_sigma_rad: of constants that are taken as
            zero where a recording does not show them.
        noise: of looks.
    """

    radius_mm: float
    sound_speed_m_s: float
    zero_device_rad: float
    direction: int
    flip: bool
    range_offset_sigma_mm: float
    sound_speed_sigma: float
    tilt_sigma_rad: float
    backlash_sigma_rad: float
    noise: NoiseModel

    @classmethod
    def of(cls, model: SessionModel) -> Declared:
        """That of a session's set-up; a constant that is declared exact is so."""
        sigma = model.constant_sigmas

        def least(constant: Constant, floor: float) -> float:
            return max(float(sigma[constant]), floor)

        return cls(
            model.probe.radius_mm,
            model.probe.sound_speed_m_s,
            model.stage.zero_device_rad,
            model.stage.direction,
            model.probe.flip,
            least(Constant.RANGE_OFFSET, 1e-4),
            least(Constant.SOUND_SPEED, 1e-6),
            least(Constant.TILT_IN_PLANE, 1e-6),
            least(Constant.BACKLASH, math.radians(1e-3)),
            model.noise,
        )


@dataclass(frozen=True, slots=True)
class Found:
    """One constant, in the unit of files.

    Attributes:
        name: its key in session.yaml or CONFIG.yaml, or a word for what has none.
        value: its value. sigma: 1 sigma; None of a sign.
        unit: of both; empty where there is none.
        how: in one sentence, from what.
        z: of a sign: by how many sigmas what it was told by differs from nothing.
        depth_mm: at which it was found, where that matters.
        seen: whether the recordings show it at all: False where its prior alone says as much.
    """

    name: str
    value: float | bool
    sigma: float | None
    unit: str
    how: str
    z: float | None = None
    depth_mm: float | None = None
    seen: bool = True
