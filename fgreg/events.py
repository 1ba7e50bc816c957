"""What happened in a session, as recorded: one dataclass per event type of ``events.jsonl``.

``line`` is the 1-based line in the file. Frame names are resolved paths inside the session's folder. Angles here are
still the *device's*, in degrees, as the file has them: measurements.py holds what the estimator sees.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fgreg.frames import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class MarkerRecord:
    """A marker as recorded: a pose, the frames to get it from, or both (then the pose wins)."""

    camera_T_marker: FloatArray | None = None
    covariance: FloatArray | None = None
    left: Path | None = None
    right: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TrusRecord:
    """A look as recorded: x and range, or the frame to get them from."""

    scan_deg: float
    x_mm: float | None = None
    range_mm: float | None = None
    covariance: FloatArray | None = None
    amplitude: float | None = None
    sweep: int = 0
    frame: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AimEvent:
    """A calibration shot: the beam was aimed at a known spot."""

    t: float
    line: int
    marker: MarkerRecord
    camera_p_spot_mm: FloatArray | None = None
    covariance: FloatArray | None = None
    corner: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PairEvent:
    """A registration shot: a beam and one look at its photoacoustic marker."""

    t: float
    line: int
    pm: int
    marker: MarkerRecord
    trus: TrusRecord


@dataclass(frozen=True, slots=True, eq=False)
class TrackEvent:
    """A query: where to turn the stage for this beam."""

    t: float
    line: int
    marker: MarkerRecord
    looks: tuple[TrusRecord, ...] = ()
    scan_deg: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CameraMovedEvent:
    """The endoscope moved: a new epoch begins."""

    t: float
    line: int
    camera_new_T_camera_old: FloatArray | None = None
    covariance: FloatArray | None = None
    detected: bool = False
    since_t: float | None = None


@dataclass(frozen=True, slots=True)
class OtherEvent:
    """``refused``, ``stage`` or ``note``: kept for the record, of no effect on an estimate."""

    t: float
    line: int
    type: str
    text: str


Event = AimEvent | PairEvent | TrackEvent | CameraMovedEvent | OtherEvent
