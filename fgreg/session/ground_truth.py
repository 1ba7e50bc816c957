"""The truth about a session, where it is known: simulation, or a phantom that was measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fgreg.frames import FloatArray


@dataclass(frozen=True, slots=True)
class TrackTruth:
    """Where the stage has to be turned to at time ``t`` (s): absolute device angle (rad)."""

    t: float
    stage_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class GroundTruth:
    """What ``ground_truth.yaml`` holds; what it does not say is empty or None.

    Attributes:
        trus_T_camera: (4, 4) of each epoch.
        marker_T_laser: (4, 4).
        trus_p_pm_mm: (3,) of each PM, by its number.
        tracks: the right answers to track events.
    """

    trus_T_camera: tuple[FloatArray, ...]
    marker_T_laser: FloatArray | None
    trus_p_pm_mm: Mapping[int, FloatArray]
    tracks: tuple[TrackTruth, ...]
