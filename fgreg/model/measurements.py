"""Measurements for the estimator: numbers with covariances. Millimetres, radians, TRUS and camera frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from fgreg.geometry.transforms import FloatArray, right_from_parent_covariance
from fgreg.model.session_model import NoiseModel

FLOOR_RAD = 1e-5
FLOOR_MM = 1e-3
"""Floor of the noise: it replaces a noise of zero, and its squares are added to covariances that are smaller in some
direction."""
POSE_FLOOR = (FLOOR_RAD,) * 3 + (FLOOR_MM,) * 3


@dataclass(frozen=True, slots=True, eq=False)
class CameraDependence:
    """How an observation of the camera depends on the rig's constants, linearised, for c the constants of ``CAMERA``.

    With constants off by c, what was observed has to be moved by ``gain @ c`` to be right: by a twist (rotation rad,
    translation mm) along the camera's axes about the marker's origin, or by a shift of a spot (mm). The corners' misfit
    tells something about the constants themselves: its chi square changes by ``c' information c - 2 pull' c``.

    Attributes:
        gain: (6, n) of a marker pose or (3, n) of a spot, n constants (fgreg.model.systematic.CAMERA).
        information: (n, n). pull: (n,).
        chi_square, degrees_of_freedom: of the corners' misfit, before ``information`` and ``pull`` were weighed down
            where it is not plausible (fgreg.model.camera_dependence). Zero where there were no corners.
    """

    gain: FloatArray
    information: FloatArray
    pull: FloatArray
    chi_square: float = 0.0
    degrees_of_freedom: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class MarkerObservation:
    """One detection of the marker.

    Attributes:
        camera_T_marker: (4, 4).
        covariance: (6, 6) over the right tangent (rotation rad, translation mm).
        id: the same for identical observations (same frames, or same matrix), unique otherwise.
        dependence: on the rig's constants, where it was detected in frames; None: that of a nominal detection.
    """

    camera_T_marker: FloatArray
    covariance: FloatArray
    id: int
    dependence: CameraDependence | None = None


@dataclass(frozen=True, slots=True)
class Wavefront:
    """The sound speed that the curvature of a wavefront shows, given the measured range: true over assumed.

    ``sigma``: its standard deviation by the frame's noise.
    """

    ratio: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class OtherPosition:
    """Another position in the image plane that a look may have detected the PM at.

    Attributes:
        x_mm, range_mm, covariance, amplitude: as of :class:`Look`.
    """

    x_mm: float
    range_mm: float
    covariance: FloatArray
    amplitude: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One detection of a PM in the TRUS image plane.

    Attributes:
        scan_rad: stage angle t of the plane (TRUS convention).
        scan_sigma_rad: of the stage reading.
        x_mm, range_mm: lateral position, and range from the element.
        covariance: (2, 2) over (x_mm, range_mm).
        sweep: +1 or -1 where the plane was stepping towards larger or smaller ``scan_rad`` and stopped at its first
            hit, else 0.
        amplitude: comparable within one PM only.
        window_sigma_rad: standard deviation of the window's half width, from PM to PM.
        wavefront: where the PM was found in channel data.
        others: other positions at which the PM may be instead, the likeliest first: later waves of the same frame.
            Where this position is an outlier, one of them that fits is taken.
    """

    scan_rad: float
    scan_sigma_rad: float
    x_mm: float
    range_mm: float
    covariance: FloatArray
    sweep: int = 0
    amplitude: float | None = None
    window_sigma_rad: float = 0.0
    wavefront: Wavefront | None = None
    others: tuple[OtherPosition, ...] = ()

    def elsewhere(self) -> tuple[Look, ...]:
        """The look at each of its other positions; this position is then one of the others."""
        here = OtherPosition(self.x_mm, self.range_mm, self.covariance, self.amplitude)
        return tuple(
            replace(
                self,
                x_mm=other.x_mm,
                range_mm=other.range_mm,
                covariance=other.covariance,
                amplitude=other.amplitude,
                wavefront=None,  # it was this position's
                others=(here, *self.others[:number], *self.others[number + 1 :]),
            )
            for number, other in enumerate(self.others)
        )


@dataclass(frozen=True, slots=True, eq=False)
class Aim:
    """A calibration shot: marker and the spot (3,) in the camera frame with its (3, 3) covariance.

    ``dependence``: of the spot on the rig's constants, where the board was detected in frames.
    """

    t: float
    marker: MarkerObservation
    camera_p_spot_mm: FloatArray
    covariance: FloatArray
    dependence: CameraDependence | None = None


@dataclass(frozen=True, slots=True, eq=False)
class VisibleSpot:
    """The laser's spot on the tissue as the camera sees it: (3,) mm, camera frame.

    ``covariance`` (3, 3): also of the sound's origin about the spot. ``dependence``: on the rig's constants.
    """

    camera_p_mm: FloatArray
    covariance: FloatArray
    dependence: CameraDependence | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """A registration shot: one look at PM ``pm`` with the marker pose of its beam, in camera epoch ``epoch``.

    ``beam_offset_mm``: standard deviation of the sound's origin beside the beam, each axis. ``spot``: where the camera
    sees the PM's spot; looks of one PM with one marker observation have one spot, the first one's that has it.
    """

    t: float
    pm: int
    epoch: int
    marker: MarkerObservation
    look: Look
    beam_offset_mm: float = 0.0
    spot: VisibleSpot | None = None


def observation(pair: Pair) -> tuple[int, int]:
    """PM and marker observation of a pair: looks that share it have one beam, in one camera epoch."""
    return pair.pm, pair.marker.id


def visible_spots(pairs: Sequence[Pair]) -> dict[tuple[int, int], VisibleSpot]:
    """The spot of each shot that has one, by PM and marker observation: a picture shows it once for all its looks."""
    spots: dict[tuple[int, int], VisibleSpot] = {}
    for pair in pairs:
        if pair.spot is not None:
            spots.setdefault((pair.pm, pair.marker.id), pair.spot)
    return spots


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """A query in camera epoch ``epoch``; ``looks`` where the PM is detected now.

    ``look_markers``: one per look, where the marker was detected at each look; else ``marker`` is used for all.
    """

    t: float
    epoch: int
    marker: MarkerObservation
    looks: tuple[Look, ...] = ()
    scan_rad: float | None = None
    look_markers: tuple[MarkerObservation, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class LocatedPoint:
    """A point known to both devices, in camera epoch ``epoch``.

    Attributes:
        camera_p_mm, trus_p_mm: (3,) in the camera's and in the TRUS frame.
        covariance, trus_covariance: (3, 3) of each, in its own frame.
    """

    t: float
    epoch: int
    camera_p_mm: FloatArray
    covariance: FloatArray
    trus_p_mm: FloatArray
    trus_covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Check(LocatedPoint):
    """A point known to both devices that checks the registration; it never enters the estimate."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownPoint(LocatedPoint):
    """A point known to both devices as data of the registration, such as a tool's tip; it never checks it."""


@dataclass(frozen=True, slots=True, eq=False)
class EpochStart:
    """Start of a camera epoch, with the motion (and its 6x6 covariance, right tangent) where kinematics measured it.

    ``after``: the epoch from which the motion is counted; None: the one before. It is an earlier one after a loop
    closure.
    """

    t: float
    camera_new_T_camera_old: FloatArray | None = None
    covariance: FloatArray | None = None
    after: int | None = None

    def old(self, index: int) -> int:
        """The epoch from which the motion is counted, for the epoch with this index."""
        return index - 1 if self.after is None else self.after

    @property
    def motion_known(self) -> bool:
        """Whether there is a motion prior between the epochs: a motion without a covariance is not used."""
        return self.camera_new_T_camera_old is not None and self.covariance is not None


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """All of a session that enters the estimate. ``epochs[0]`` starts the session."""

    aims: tuple[Aim, ...]
    pairs: tuple[Pair, ...]
    epochs: tuple[EpochStart, ...]
    points: tuple[KnownPoint, ...] = ()

    def points_of(self, epoch: int) -> tuple[KnownPoint, ...]:
        """The known points of a camera epoch, as of epoch 0."""
        return tuple(replace(point, epoch=0) for point in self.points if point.epoch == epoch)


def default_marker_covariance(camera_T_marker: FloatArray, noise: NoiseModel) -> FloatArray:
    """(6, 6) right-tangent covariance of a marker pose that came without one (``noise`` of session.yaml)."""
    sigma = np.array([*noise.marker_rotation_rad, *noise.marker_translation_mm])
    return right_from_parent_covariance(camera_T_marker[:3, :3], np.diag(sigma**2))


def usable_covariance(covariance: FloatArray, floor: Sequence[float]) -> FloatArray:
    """Covariances (..., n, n), with the floor's squares (n,) added to those with a direction below the floor."""
    least = _squares(tuple(floor))
    try:
        # It is large enough if it has a Cholesky factor without the floor: a fraction of the time of eigenvalues.
        np.linalg.cholesky(covariance - least)
    except np.linalg.LinAlgError:
        below = np.linalg.eigvalsh(covariance - least)[..., :1, None] <= 0.0
        return np.where(below, covariance + least, covariance)
    return covariance


@lru_cache
def _squares(sigmas: tuple[float, ...]) -> FloatArray:
    """Diagonal matrix of squares."""
    return np.diag(np.square(sigmas))
