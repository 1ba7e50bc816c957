"""Camera moves as the endoscope's holder measures them: whether one is under way, and the motion once it has ended.

While the camera moves, the registration is invalid. A move is measured between two rests. Each rest is the mean of its
samples, so neither the noise of single samples nor the path in between matters. Pure state: samples in, moves out.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from fgreg.camera_moves.view_shift import view_shift_mm
from fgreg.drivers.base import MotionSample
from fgreg.geometry.transforms import FloatArray, adjoint, exp_so3, inverse, log_so3, make_transform
from fgreg.model.time_sync import DeviceClock
from fgreg.schema.kinds import Number
from fgreg.schema.record import Key

REST_S = 0.4
"""The camera is at rest once it has stood still for this long."""
FEWEST = 4
"""Least number of samples of a rest."""
SILENT_S = 2.0
"""A holder that was silent for longer may have been switched off and on, and may have a new origin."""


@dataclass(frozen=True, slots=True)
class HolderSettings:
    """Accuracy of the holder; sigmas per axis.

    Attributes:
        sigma_mm, sigma_rad: of a measured move.
        least_mm: smallest displacement of the view that counts as a move.
    """

    sigma_mm: Annotated[
        float,
        Key("of a move as motion reports it", Number(0.0, 100.0, above=True, unit="mm"), name="holder_sigma_mm"),
    ] = 2.0
    sigma_rad: Annotated[
        float,
        Key(
            "the same, of its rotation",
            Number(0.0, 30.0, above=True, unit="deg", degrees=True),
            name="holder_sigma_deg",
        ),
    ] = math.radians(1.0)
    least_mm: Annotated[
        float,
        Key("a smaller shift of the view is no move", Number(0.0, 10.0, above=True, unit="mm"), name="holder_least_mm"),
    ] = 1.0

    def __post_init__(self) -> None:
        for name in ("sigma_mm", "sigma_rad", "least_mm"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}, expected a number > 0")


@dataclass(frozen=True, slots=True, eq=False)
class HolderMove:
    """A move that has ended; it began at host time ``since_s`` or just before.

    ``camera_new_T_camera_old`` (4, 4) with its covariance (6, 6), right tangent (rad, mm); both None if the holder was
    silent meanwhile, so that the motion is unknown. ``reported``: by the operator, too.
    """

    since_s: float
    camera_new_T_camera_old: FloatArray | None
    covariance: FloatArray | None
    reported: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class _Rest:
    base_T_camera: FloatArray
    covariance: FloatArray


@dataclass(slots=True, eq=False)
class Holder:
    """Detects and measures moves in the holder's samples.

    Attributes:
        settings: accuracy of the holder.
        latency_s: of its messages (fgreg.model.time_sync.Latencies).
        moving_since_s: host time at which the current move was detected; None at rest.
    """

    settings: HolderSettings
    latency_s: float = 0.0
    moving_since_s: float | None = None
    _clock: DeviceClock = field(init=False)
    _recent: list[tuple[float, MotionSample]] = field(default_factory=list)
    _rest: _Rest | None = None
    _newest_s: float = -math.inf
    _silent: bool = False

    def __post_init__(self) -> None:
        self._clock = DeviceClock(self.latency_s)

    def take(self, samples: Sequence[MotionSample], now_s: float) -> HolderMove | None:
        """Take in new samples; returns the move that has just ended, or None."""
        for sample in samples:
            t_s = self._clock.host_time(sample.stamp)
            if t_s <= self._newest_s:
                continue
            if t_s - self._newest_s > SILENT_S:
                self._recent.clear()
                self._silent = self._rest is not None
            self._newest_s = t_s
            self._recent = [(t, recent) for t, recent in self._recent if t > t_s - REST_S]
            self._recent.append((t_s, sample))
            if self._rest is not None and self.moving_since_s is None and self._away(sample.base_T_camera) > 1.0:
                self.moving_since_s = t_s
        if samples:
            return self._settle()
        if self.moving_since_s is not None and now_s - self._newest_s > SILENT_S:
            return self._end(None)  # it fell silent during the move: the new pose is unknown
        return None

    def _away(self, base_T_camera: FloatArray) -> float:
        """Displacement from the rest, in units of ``settings.least_mm``."""
        return 0.0 if self._rest is None else self._shift_mm(self._rest.base_T_camera, base_T_camera)

    def _shift_mm(self, before: FloatArray, after: FloatArray) -> float:
        """Displacement of what the camera sees, in units of ``settings.least_mm``."""
        return view_shift_mm(np.asarray(inverse(after) @ before)) / self.settings.least_mm

    def _settle(self) -> HolderMove | None:
        """Detect a rest; returns the move that it ends, or None."""
        times = [t for t, _ in self._recent]
        if len(times) < FEWEST or times[-1] - times[0] < 0.75 * REST_S:
            return None
        rest = _mean_rest([sample for _, sample in self._recent])
        if any(self._shift_mm(rest.base_T_camera, sample.base_T_camera) > 0.5 for _, sample in self._recent):
            return None
        if self._rest is None:
            self._rest = rest
            return None
        if self.moving_since_s is None:
            self._silent = False
            return None
        if self._away(rest.base_T_camera) <= 1.0:  # there and back, or a wrong sample
            self.moving_since_s, self._silent = None, False
            return None
        return self._end(None if self._silent else rest)

    def _end(self, rest: _Rest | None) -> HolderMove:
        before, since_s = self._rest, self.moving_since_s
        if before is None or since_s is None:
            raise AssertionError("no move is under way")
        self.moving_since_s, self._silent, self._rest = None, False, rest
        if rest is None:
            return HolderMove(since_s, None, None)
        return HolderMove(since_s, *_move(before, rest, self.settings))


def _mean_rest(samples: Sequence[MotionSample]) -> _Rest:
    """Mean of the samples at rest, with the covariance of one sample: the holder's errors are strongly correlated."""
    first = samples[0].base_T_camera[:3, :3]
    turns = np.array([log_so3(first.T @ sample.base_T_camera[:3, :3]) for sample in samples])
    middle = np.mean([sample.base_T_camera[:3, 3] for sample in samples], axis=0)
    covariance = samples[-1].covariance
    return _Rest(
        make_transform(first @ exp_so3(turns.mean(axis=0)), middle),
        np.zeros((6, 6)) if covariance is None else covariance,
    )


def _move(before: _Rest, after: _Rest, settings: HolderSettings) -> tuple[FloatArray, FloatArray]:
    """``inv(base_T_new) base_T_old`` and its covariance, the sum of both rests' and that of the settings.

    A right perturbation ``d`` of the new pose perturbs the product on the right by ``-Ad(inv(new_T_old)) d``.
    """
    new_T_old = np.asarray(inverse(after.base_T_camera) @ before.base_T_camera)
    transport = adjoint(np.asarray(inverse(new_T_old)))
    of_move = np.diag(np.repeat([settings.sigma_rad**2, settings.sigma_mm**2], 3))
    covariance = before.covariance + transport @ after.covariance @ transport.T + of_move
    return new_T_old, np.asarray(0.5 * (covariance + covariance.T))
