"""Tracking queries and answers as bytes: plain numbers, so that nothing received is ever unpickled."""

from __future__ import annotations

import math
import struct

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import TrackEstimate
from fgreg.model.measurements import Look, MarkerObservation, Track

MOST_LOOKS = 1000
_HEAD = struct.Struct("<dqddqq")
"""t, epoch, whether scan_rad is given, scan_rad, looks, markers of looks."""
_LOOK, _MARKER = 10, 4 * 4 + 6 * 6 + 1
_ANSWER = struct.Struct("<dddddd")
"""t, stage_rad, sigma_rad, lambda_mm (NaN: none), causal, age of the snapshot in seconds."""
_ERROR = b"!"
_FINE = b"."


class QueryError(Exception):
    """A query that cannot be processed; the text says why."""


def encode_query(query: Track) -> bytes:
    """A query as bytes. The markers' ids are reduced to which of them are equal."""
    numbers: dict[int, int] = {}
    markers = (query.marker, *query.look_markers)
    parts = [_HEAD.pack(
        query.t,
        query.epoch,
        0.0 if query.scan_rad is None else 1.0,
        0.0 if query.scan_rad is None else query.scan_rad,
        len(query.looks),
        len(query.look_markers),
    )]  # fmt: skip
    for marker in markers:
        parts.append(marker.camera_T_marker.astype("<f8").tobytes())
        parts.append(marker.covariance.astype("<f8").tobytes())
        parts.append(struct.pack("<d", float(numbers.setdefault(marker.id, len(numbers)))))
    for look in query.looks:
        amplitude = math.nan if look.amplitude is None else look.amplitude
        (a, b), (c, d) = look.covariance.tolist()
        parts.append(
            struct.pack(
                "<10d",
                look.scan_rad,
                look.scan_sigma_rad,
                look.x_mm,
                look.range_mm,
                a,
                b,
                c,
                d,
                float(look.sweep),
                amplitude,
            )
        )
    return b"".join(parts)


def decode_query(data: bytes) -> Track:
    """A query from bytes.

    Raises:
        QueryError: the bytes are no query, or hold an invalid number.
    """
    if len(data) < _HEAD.size:
        raise QueryError(f"a query of {len(data)} bytes, expected at least {_HEAD.size}")
    t, epoch, has_scan, scan, looks, own = _HEAD.unpack_from(data)
    if not (0 <= looks <= MOST_LOOKS and own in (0, looks)):
        raise QueryError(f"a query of {looks} looks and {own} markers of looks")
    expected = _HEAD.size + 8 * (_MARKER * (1 + own) + _LOOK * looks)
    if len(data) != expected:
        raise QueryError(f"a query of {len(data)} bytes, expected {expected}")
    values: FloatArray = np.frombuffer(data, dtype="<f8", offset=_HEAD.size)
    markers = []
    for k in range(1 + own):
        at = _MARKER * k
        block = values[at : at + _MARKER]
        pose, covariance = block[:16].reshape(4, 4), block[16:52].reshape(6, 6)
        markers.append(MarkerObservation(pose, covariance, int(block[52])))
    rows = values[_MARKER * (1 + own) :].reshape(-1, _LOOK)
    if not (np.isfinite(values[: _MARKER * (1 + own)]).all() and np.isfinite(rows[:, :9]).all()):
        raise QueryError("a query with a number that is not finite")
    heard = []
    for row in rows:
        scan_rad, scan_sigma, x, heard_mm, *_, sweep, amplitude = row.tolist()
        given = None if math.isnan(amplitude) else amplitude
        heard.append(Look(scan_rad, scan_sigma, x, heard_mm, row[4:8].reshape(2, 2), int(sweep), given))
    return Track(t, epoch, markers[0], tuple(heard), scan if has_scan else None, tuple(markers[1:]))


def encode_answer(answer: TrackEstimate, age_s: float) -> bytes:
    """An answer, and the age of the snapshot it is from, as bytes."""
    numbers = (answer.stage_rad, answer.sigma_rad, answer.lambda_mm)
    given = (math.nan if number is None else number for number in numbers)
    return _FINE + _ANSWER.pack(answer.t, *given, float(answer.causal), age_s) + answer.reason.encode()


def encode_error(text: str) -> bytes:
    """An error message as bytes."""
    return _ERROR + text.encode()


def decode_answer(data: bytes) -> tuple[TrackEstimate, float]:
    """An answer, and the age (s) of the snapshot it is from.

    Raises:
        QueryError: the query could not be processed, or the bytes are no result.
    """
    if data[:1] == _ERROR:
        raise QueryError(data[1:].decode(errors="replace"))
    if data[:1] != _FINE or len(data) < 1 + _ANSWER.size:
        raise QueryError(f"an answer of {len(data)} bytes that is none")
    t, stage, sigma, lambda_mm, causal, age_s = _ANSWER.unpack_from(data, 1)
    stage_rad, sigma_rad, lam = (None if math.isnan(v) else v for v in (stage, sigma, lambda_mm))
    reason = data[1 + _ANSWER.size :].decode(errors="replace")
    return TrackEstimate(t, stage_rad, sigma_rad, lam, bool(causal), reason), age_s
