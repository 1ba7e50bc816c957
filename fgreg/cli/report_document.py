"""The summary of a solved session as plain data for programs, with the names and units of ``result.yaml``."""

from __future__ import annotations

import math
from dataclasses import asdict, fields
from typing import Any

from fgreg.cli.report import SummaryExtras
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import (
    EpochEstimate,
    PairEstimate,
    PredictedPart,
    PredictedTre,
    SessionEstimate,
)
from fgreg.model.measurements import Look
from fgreg.model.session_model import SessionModel


def summary_dict(model: SessionModel, estimate: SessionEstimate, extra: SummaryExtras) -> dict[str, Any]:
    """The result as plain types, with the names and units of ``result.yaml``; figures that are not finite are None.

    Besides those: ``aims``, ``targets``, each look's ``t``, ``scan_deg``, ``x_mm`` and ``range_mm``, and where there
    are any ``truth``, ``detections``, ``elapsed_s`` and ``files``.
    """
    laser = estimate.laser
    out: dict[str, Any] = {
        "session": estimate.session,
        "inputs": dict(estimate.inputs),
        "settings": None if estimate.settings is None else asdict(estimate.settings),
        "verdict": estimate.verdict.value,
        "reasons": list(estimate.reasons),
        "laser": None
        if laser is None
        else {"marker_T_laser": _rows(laser.marker_T_laser), "covariance": _rows(laser.covariance)},
        "epochs": [_epoch_dict(epoch) for epoch in estimate.epochs],
        "pairs": [
            _pair_dict(pair, model, extra.looks[i] if i < len(extra.looks) else None)
            for i, pair in enumerate(estimate.pairs)
        ],
        "systematic": [
            {field.name: _plain_value(getattr(one, field.name)) for field in fields(one)} for one in estimate.systematic
        ],
        "tracks": [
            {
                "t": track.t,
                "stage_deg": _degrees(track.stage_rad),
                "sigma_deg": _degrees(track.sigma_rad),
                "lambda_mm": _plain(track.lambda_mm),
                "causal": track.causal,
                "reason": track.reason,
            }
            for track in estimate.tracks
        ],
        "checks": [
            {
                "t": check.t,
                "error_mm": None if check.error_mm is None else [_plain(value) for value in check.error_mm],
                "predicted_95_mm": _plain(check.predicted_95_mm),
                "nis": _plain(check.nis),
                "verdict": check.verdict.value,
                "reason": check.reason,
            }
            for check in estimate.checks
        ],
        "assumptions": [{"text": entry.text, "checks": list(entry.checks)} for entry in estimate.assumptions],
        "excluded": [asdict(shot) for shot in estimate.excluded],
        "aims": [
            {
                "t": aim.t,
                "used": aim.used,
                "reason": aim.reason,
                "lambda_mm": _plain(aim.lambda_mm),
                "residual_mm": _plain(aim.residual_mm),
                "nis": _plain(aim.nis),
            }
            for aim in estimate.aims
        ],
        "points": [
            {
                "t": point.t,
                "used": point.used,
                "reason": point.reason,
                "error_mm": None if point.error_mm is None else [_plain(value) for value in point.error_mm],
                "nis": _plain(point.nis),
            }
            for point in estimate.points
        ],
        "targets": len(model.targets_mm),
    }
    if estimate.timing is not None:
        out["timing_ms"] = asdict(estimate.timing)
    if extra.truth is not None:
        out["truth"] = {
            "tre_mean_mm": [_plain(value) for value in extra.truth.tre_mean_mm],
            "tre_worst_mm": [_plain(value) for value in extra.truth.tre_worst_mm],
            "track_error_deg": [_degrees(value) for value in extra.truth.track_error_rad],
        }
    if extra.detections is not None:
        found = extra.detections
        out["detections"] = {
            "markers_found": found.markers_found,
            "markers_total": found.markers_total,
            "sources_found": found.sources_found,
            "sources_total": found.sources_total,
        }
    if extra.elapsed_s is not None:
        out["elapsed_s"] = extra.elapsed_s
    files = {name: str(path) for name, path in (("result", extra.result), ("rrd", extra.rrd)) if path is not None}
    if files:
        out["files"] = files
    return out


def _epoch_dict(epoch: EpochEstimate) -> dict[str, Any]:
    tre = epoch.predicted_tre
    return {
        "index": epoch.index,
        "start_s": epoch.start_s,
        "trus_T_camera": _rows(epoch.trus_T_camera),
        "covariance": _rows(epoch.covariance),
        "pairs": epoch.pairs,
        "verdict": epoch.verdict.value,
        "predicted_tre_mm": None
        if tre is None
        else {
            **_figures(tre),
            **{name: _figures(part) for name in ("random", "systematic", "seen") if (part := getattr(tre, name))},
        },
        "target_errors_mm": [
            {
                "name": target.name,
                "trus_p_mm": target.trus_p_mm.tolist(),
                "rms": _plain(target.rms_mm),
                "p95": _plain(target.p95_mm),
                "random_p95": _plain(target.random_mm),
                "systematic_p95": _plain(target.systematic_mm),
            }
            for target in epoch.targets
        ],
    }


def _plain_value(value: str | float) -> str | float | None:
    return value if isinstance(value, str) else _plain(value)


def _figures(of: PredictedTre | PredictedPart) -> dict[str, Any]:
    return {"mean": _plain(of.mean_mm), "p95": _plain(of.p95_mm), "worst": _plain(of.worst_mm)}


def _pair_dict(pair: PairEstimate, model: SessionModel, look: Look | None) -> dict[str, Any]:
    return {
        "t": pair.t,
        "pm": pair.pm,
        "epoch": pair.epoch,
        "used": pair.used,
        "reason": pair.reason,
        "scan_deg": None if look is None else _degrees(model.stage.device_from_scan(look.scan_rad)),
        "x_mm": None if look is None else _plain(look.x_mm),
        "range_mm": None if look is None else _plain(look.range_mm),
        "lambda_mm": _plain(pair.lambda_mm),
        "theta_deg": _degrees(pair.theta_rad),
        "rotation_deg": _degrees(pair.rotation_rad),
        "trus_p_pm_mm": None if pair.trus_p_pm_mm is None else [_plain(value) for value in pair.trus_p_pm_mm],
        "covariance": _rows(pair.covariance),
        "residual_mm": _plain(pair.residual_mm),
        "spot_error_mm": None if pair.spot_error_mm is None else [_plain(value) for value in pair.spot_error_mm],
        "nis": _plain(pair.nis),
        "nis_dof": pair.nis_dof,
        "influence_mm": _plain(pair.influence_mm),
    }


def _rows(matrix: FloatArray | None) -> list[list[float | None]] | None:
    return None if matrix is None else [[_plain(value) for value in row] for row in matrix]


def _plain(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _degrees(value_rad: float | None) -> float | None:
    return _plain(None if value_rad is None else math.degrees(value_rad))
