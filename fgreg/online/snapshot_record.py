"""Snapshots of fixed size: the estimate as one record of numbers, for shared memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fgreg.geometry.rig import COUNT
from fgreg.model.estimate import Verdict
from fgreg.model.probe_model import SensitivityModel
from fgreg.model.session_model import SessionModel, StageModel
from fgreg.model.tissue_surface import MOST_POINTS, TissueSurface
from fgreg.tracking.snapshot import SHARED, EpochSnapshot, Snapshot

Record = np.ndarray[Any, np.dtype[Any]]
"""A structured array of shape ()."""
EPOCHS_KEPT = 8
"""Number of newest epochs (also refused ones) in a record: queries concern where the camera is now."""
REASON_BYTES = 240
_VERDICTS = (Verdict.OK, Verdict.WARNING, Verdict.REFUSED)


@dataclass(frozen=True, slots=True)
class Layout:
    """Sizes in a record: entries of the sensitivity table and of the amplitude curve (0: none), and epochs."""

    depths: int
    curve: int
    epochs: int = EPOCHS_KEPT

    @classmethod
    def of(cls, model: SessionModel) -> Layout:
        """The layout for a session."""
        return layout_of(model.probe.sensitivity)

    def dtype(self) -> np.dtype[np.void]:
        """The record's type: 8-byte fields throughout."""
        session = np.dtype(
            [
                ("depth_mm", "f8", (self.depths,)),
                ("half_width_rad", "f8", (self.depths,)),
                ("edge_sigma_rad", "f8"),
                ("curve_rotation_rad", "f8", (self.curve,)),
                ("curve_amplitude", "f8", (self.curve,)),
                ("step_rad", "f8"),
                ("limits_device_rad", "f8", (2,)),
                ("direction", "i8"),
                ("zero_device_rad", "f8"),
                ("amplitude_sigma", "f8"),
                ("window_shape", "i8"),
            ]
        )
        epoch = np.dtype(
            [
                ("number", "i8"),
                ("verdict", "i8"),
                ("rotation", "f8", (3, 3)),
                ("translation_mm", "f8", (3,)),
                ("covariance", "f8", (SHARED, SHARED)),
                ("reason", "S", REASON_BYTES),
            ]
        )
        return np.dtype(
            [
                ("session", session),
                ("t", "f8"),
                ("pairs", "i8"),
                ("causal", "i8"),
                ("oldest", "i8"),
                ("epoch_count", "i8"),
                ("epochs", epoch, (self.epochs,)),
                ("marker_T_nominal", "f8", (4, 4)),
                ("beam", "f8", (4,)),
                ("origin_shift_mm", "f8"),
                ("constants", "f8", (COUNT,)),
                ("radius_mm", "f8"),
                ("places", "i8"),
                ("axes", "f8", (3, 3)),
                ("centre", "f8", (3,)),
                ("place", "f8", (MOST_POINTS, 2)),
                ("covariance_inverse", "f8", (MOST_POINTS, MOST_POINTS)),
                ("trend", "f8", (3,)),
                ("trend_covariance", "f8", (3, 3)),
                ("residual", "f8", (MOST_POINTS,)),
                ("relief_mm", "f8"),
                ("inflation", "f8"),
            ]
        )


def layout_of(sensitivity: SensitivityModel, epochs: int = EPOCHS_KEPT) -> Layout:
    """The layout that holds a session's snapshots."""
    curve = sensitivity.curve_rotation_rad
    return Layout(sensitivity.depth_mm.size, 0 if curve is None else curve.size, epochs)


_SURFACE = ("axes", "centre", "trend", "trend_covariance", "relief_mm", "inflation")
_SCALARS = ("t", "pairs", "origin_shift_mm", "radius_mm")
_ARRAYS = ("marker_T_nominal", "beam", "constants")


def encode_snapshot(snapshot: Snapshot, record: Record) -> None:
    """Write a snapshot into a record ``()`` of its layout's type; the newest epochs where it has too many.

    Raises:
        ValueError: the record is of another session's layout, or a number is not finite.
    """
    _encode_session(snapshot, record["session"])
    for name in (*_SCALARS, *_ARRAYS):
        record[name] = getattr(snapshot, name)
    record["causal"] = snapshot.causal
    slots = record["epochs"]
    kept = snapshot.epochs[-len(slots) :]
    left_out = snapshot.epochs[: -len(slots)]
    record["oldest"] = left_out[-1].number + 1 if left_out else snapshot.oldest
    record["epoch_count"] = len(kept)
    for k, epoch in enumerate(kept):
        slot = slots[k]
        slot["number"], slot["verdict"] = epoch.number, _VERDICTS.index(epoch.verdict)
        slot["rotation"], slot["translation_mm"] = epoch.rotation, epoch.translation_mm
        slot["covariance"] = epoch.covariance
        slot["reason"] = epoch.reason.encode()[:REASON_BYTES]
        if not (np.isfinite(epoch.covariance).all() and np.isfinite(epoch.translation_mm).all()):
            raise ValueError(f"camera epoch {epoch.number}: a number of the estimate is not finite")
    surface = snapshot.surface
    record["places"] = 0 if surface is None else len(surface.place)
    if surface is not None:
        for name in _SURFACE:
            record[name] = getattr(surface, name)
        count = len(surface.place)
        record["place"][:count], record["residual"][:count] = surface.place, surface.residual
        record["covariance_inverse"][:count, :count] = surface.covariance_inverse


def _encode_session(snapshot: Snapshot, record: Record) -> None:
    sensitivity, stage = snapshot.sensitivity, snapshot.stage
    rotation, amplitude = sensitivity.curve_rotation_rad, sensitivity.curve_amplitude
    curve = 0 if rotation is None else rotation.size
    if record["depth_mm"].size != sensitivity.depth_mm.size or record["curve_rotation_rad"].size != curve:
        raise ValueError("the snapshot is of a session with another sensitivity table")
    record["depth_mm"], record["half_width_rad"] = sensitivity.depth_mm, sensitivity.half_width_rad
    record["edge_sigma_rad"] = sensitivity.edge_sigma_rad
    if rotation is not None and amplitude is not None:
        record["curve_rotation_rad"], record["curve_amplitude"] = rotation, amplitude
    record["step_rad"], record["limits_device_rad"] = stage.step_rad, stage.limits_device_rad
    record["direction"], record["zero_device_rad"] = stage.direction, stage.zero_device_rad
    record["amplitude_sigma"], record["window_shape"] = snapshot.amplitude_sigma, snapshot.window_shape


class SnapshotDecoder:
    """Reads snapshots from records; constants of the session are made (and checked) once."""

    def __init__(self) -> None:
        self._session_bytes = b""
        self._session: tuple[SensitivityModel, StageModel] | None = None

    def decode(self, record: Record) -> Snapshot:
        """The snapshot in a record ``()``. Its arrays are views of the record, which must not change afterwards."""
        session = record["session"]
        sensitivity, stage = self._models(session)
        count = int(record["epoch_count"])
        epochs = tuple(
            EpochSnapshot(
                number=int(slot["number"]),
                verdict=_VERDICTS[int(slot["verdict"])],
                rotation=slot["rotation"],
                translation_mm=slot["translation_mm"],
                covariance=slot["covariance"],
                reason=bytes(slot["reason"]).decode(errors="ignore"),
            )
            for slot in record["epochs"][:count]
        )
        places = int(record["places"])
        surface = None
        if places:
            surface = TissueSurface(
                axes=record["axes"],
                centre=record["centre"],
                place=record["place"][:places],
                covariance_inverse=record["covariance_inverse"][:places, :places],
                trend=record["trend"],
                trend_covariance=record["trend_covariance"],
                residual=record["residual"][:places],
                relief_mm=float(record["relief_mm"]),
                inflation=float(record["inflation"]),
            )
        return Snapshot(
            t=float(record["t"]),
            pairs=int(record["pairs"]),
            causal=bool(record["causal"]),
            oldest=int(record["oldest"]),
            epochs=epochs,
            marker_T_nominal=record["marker_T_nominal"],
            beam=record["beam"],
            origin_shift_mm=float(record["origin_shift_mm"]),
            constants=record["constants"],
            radius_mm=float(record["radius_mm"]),
            sensitivity=sensitivity,
            stage=stage,
            amplitude_sigma=float(session["amplitude_sigma"]),
            window_shape=bool(session["window_shape"]),
            surface=surface,
        )

    def _models(self, record: Record) -> tuple[SensitivityModel, StageModel]:
        same = record.tobytes()
        if self._session is None or same != self._session_bytes:
            has_curve = record["curve_rotation_rad"].size > 0
            sensitivity = SensitivityModel(
                depth_mm=record["depth_mm"].copy(),
                half_width_rad=record["half_width_rad"].copy(),
                edge_sigma_rad=float(record["edge_sigma_rad"]),
                curve_rotation_rad=record["curve_rotation_rad"].copy() if has_curve else None,
                curve_amplitude=record["curve_amplitude"].copy() if has_curve else None,
            )
            low, high = record["limits_device_rad"].tolist()
            stage = StageModel(
                step_rad=float(record["step_rad"]),
                limits_device_rad=(low, high),
                direction=int(record["direction"]),
                zero_device_rad=float(record["zero_device_rad"]),
            )
            self._session_bytes, self._session = same, (sensitivity, stage)
        return self._session
