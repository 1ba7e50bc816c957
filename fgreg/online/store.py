"""All measurements of a session, raw, in a few hundred bytes each: what summaries are built anew from.

A pair as Python objects takes over a kilobyte; hours of pairs are kept as rows of floats, exactly as they came, without
what can be told from the rest: the other half of symmetric matrices, the last row of poses.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable

import numpy as np

from fgreg.frames import FloatArray, IntArray
from fgreg.measurements import Aim, Look, MarkerObservation, Pair
from fgreg.online.numbers import Sink, Source, check_covariances, check_poses

ROWS = 512
_T, _POSE, _COVARIANCE, _SCAN, _LOOK_COVARIANCE, _SWEEP, _AMPLITUDE, WIDTH = 0, 1, 17, 53, 57, 61, 62, 63

_POSE_KEPT = np.arange(12)
_UPPER6 = np.flatnonzero(np.triu(np.ones((6, 6))).ravel())
_UPPER2 = np.array([0, 1, 3])
_KEPT = np.concatenate(
    [
        [_T],
        _POSE + _POSE_KEPT,
        _COVARIANCE + _UPPER6,
        np.arange(_SCAN, _LOOK_COVARIANCE),
        _LOOK_COVARIANCE + _UPPER2,
        [_SWEEP, _AMPLITUDE],
    ]
)
"""Columns of a whole row that are kept."""


def _mirrored() -> IntArray:
    """(WIDTH,) where among those kept each column is; -1 for the last row of the pose."""
    place = np.full(WIDTH, -1, dtype=np.int64)
    place[_KEPT] = np.arange(len(_KEPT))
    for start, size in ((_COVARIANCE, 6), (_LOOK_COVARIANCE, 2)):
        square = place[start : start + size * size].reshape(size, size)
        place[start : start + size * size] = np.maximum(square, square.T).ravel()
    return place


_FROM = _mirrored()
_LAST_ROW = slice(_POSE + 12, _POSE + 16)


def _whole(kept: FloatArray) -> FloatArray:
    """Whole rows (n, WIDTH) from what is kept of them (n, ...)."""
    rows = kept[:, _FROM]
    rows[:, _LAST_ROW] = 0.0, 0.0, 0.0, 1.0
    return rows


def _plain(values: FloatArray) -> FloatArray:
    return np.array(values, dtype=np.float64, order="C")


class MeasurementStore:
    """Aims and pairs in the order they came; append only."""

    def __init__(self) -> None:
        self.aims: list[Aim] = []
        self._blocks: list[FloatArray] = []
        self._odd: dict[int, FloatArray] = {}  # whole rows that are not as symmetric as they should be
        self._pm = array("q")
        self._marker = array("q")

    def __len__(self) -> int:
        """Number of pairs."""
        return len(self._pm)

    def append(self, pair: Pair) -> None:
        """Keep one more pair (its epoch is not kept: that may turn out to be another)."""
        index = len(self._pm)
        row = np.empty(WIDTH)
        look = pair.look
        row[_T] = pair.t
        row[_POSE:_COVARIANCE] = pair.marker.camera_T_marker.ravel()
        row[_COVARIANCE:_SCAN] = pair.marker.covariance.ravel()
        row[_SCAN:_LOOK_COVARIANCE] = look.scan_rad, look.scan_sigma_rad, look.x_mm, look.range_mm
        row[_LOOK_COVARIANCE:_SWEEP] = look.covariance.ravel()
        row[_SWEEP] = look.sweep
        row[_AMPLITUDE] = np.nan if look.amplitude is None else look.amplitude
        self._keep(index, row)
        self._pm.append(pair.pm)
        self._marker.append(pair.marker.id)

    def _keep(self, index: int, row: FloatArray) -> None:
        if index == len(self._blocks) * ROWS:
            self._blocks.append(np.empty((ROWS, len(_KEPT))))
        kept = row[_KEPT]
        self._blocks[-1][index % ROWS] = kept
        whole = kept[_FROM]
        whole[_LAST_ROW] = 0.0, 0.0, 0.0, 1.0
        if not (whole[:_AMPLITUDE] == row[:_AMPLITUDE]).all():  # the amplitude may be none, which equals nothing
            self._odd[index] = row

    def _row(self, index: int) -> FloatArray:
        odd = self._odd.get(index)
        return _whole(self._blocks[index // ROWS][index % ROWS][None])[0] if odd is None else odd

    def append_aim(self, aim: Aim) -> None:
        """Keep one more calibration shot. Its arrays are laid out as those that are read back: sums depend on that."""
        marker = aim.marker
        self.aims.append(
            Aim(
                aim.t,
                MarkerObservation(_plain(marker.camera_T_marker), _plain(marker.covariance), marker.id),
                _plain(aim.camera_p_spot_mm),
                _plain(aim.covariance),
            )
        )

    def looks_at(self, pm: int, first: int = 0) -> tuple[int, ...]:
        """Places of the pairs at a PM so far, from a place on."""
        numbers = np.frombuffer(self._pm, dtype=np.int64) if self._pm else np.zeros(0, dtype=np.int64)
        return tuple((first + np.flatnonzero(numbers[first:] == pm)).tolist())

    def pair(self, index: int, epoch: int, pm: int | None = None) -> Pair:
        """The pair at a place, bit for bit as it came, in this epoch; ``pm`` gives it another number."""
        row = self._row(index)
        marker = MarkerObservation(
            row[_POSE:_COVARIANCE].reshape(4, 4).copy(),
            row[_COVARIANCE:_SCAN].reshape(6, 6).copy(),
            self._marker[index],
        )
        scan, scan_sigma, x_mm, range_mm = (float(v) for v in row[_SCAN:_LOOK_COVARIANCE])
        amplitude = float(row[_AMPLITUDE])
        look = Look(
            scan,
            scan_sigma,
            x_mm,
            range_mm,
            row[_LOOK_COVARIANCE:_SWEEP].reshape(2, 2).copy(),
            int(row[_SWEEP]),
            None if np.isnan(amplitude) else amplitude,
        )
        return Pair(float(row[_T]), self._pm[index] if pm is None else pm, epoch, marker, look)

    def pairs(self, indices: Iterable[int], epoch: int) -> tuple[Pair, ...]:
        """Several pairs, all in one epoch."""
        return tuple(self.pair(index, epoch) for index in indices)

    def number(self, index: int) -> int:
        """The PM at which a pair was taken."""
        return self._pm[index]

    def time(self, index: int) -> float:
        """When a pair was taken."""
        return float(self._blocks[index // ROWS][index % ROWS, _T])

    # --- as plain numbers -------------------------------------------------------------------------------------------

    def write(self, sink: Sink, count: int) -> None:
        """Put the first pairs into a sink, bit for bit."""
        rows = _whole(np.concatenate([np.zeros((0, len(_KEPT))), *self._blocks])[:count])
        for index, row in list(self._odd.items()):
            if index < count:
                rows[index] = row
        silent = np.isnan(rows[:, _AMPLITUDE])
        rows[silent, _AMPLITUDE] = 0.0
        for numbers in (self._pm, self._marker):
            sink.integer_array(np.array(numbers[:count], dtype=np.int64))
        sink.integer_array(silent.astype(np.int64))
        sink.array(rows)

    def read(self, source: Source, count: int) -> None:
        """Append pairs that :meth:`write` put there.

        Raises:
            ValueError: they are not what a session may hold.
        """
        pm, marker, silent = source.integer_array(count), source.integer_array(count), source.flags(count)
        rows = source.array(count, WIDTH)
        check_poses(rows[:, _POSE:_COVARIANCE].reshape(-1, 4, 4))
        check_covariances(rows[:, _COVARIANCE:_SCAN].reshape(-1, 6, 6))
        check_covariances(rows[:, _LOOK_COVARIANCE:_SWEEP].reshape(-1, 2, 2))
        if (rows[:, _SCAN + 3] <= 0.0).any() or not np.isin(rows[:, _SWEEP], (-1.0, 0.0, 1.0)).all():
            raise ValueError("a range or sweep that cannot be")
        rows[silent, _AMPLITUDE] = np.nan
        for index, row in enumerate(rows):
            self._keep(index, row)
        self._pm.extend(pm.tolist())
        self._marker.extend(marker.tolist())
