"""Evaluations as plain data: a JSON document and a long CSV table."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from fgreg.evaluation.resolve import Resolved
from fgreg.evaluation.run import SessionEvaluation
from fgreg.evaluation.summary import (
    CurvePoint,
    Prediction,
    all_track_errors_deg,
    all_tre_mm,
    curve_of,
    pooled_curve,
    prediction_of,
    spread_of,
)
from fgreg.output.atomic_file import FileKind

COLUMNS = ("session", "table", "epoch", "pm", "pairs", "quantity", "value")
"""Columns of the CSV file: one figure per line; ``quantity`` ends in its unit."""
CSV_FILE = FileKind("a table of fgreg evaluate", (",".join(COLUMNS).encode() + b"\n",))


def plain(value: Any) -> Any:
    """A value as JSON types, also within containers; numbers that are not finite become None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    if isinstance(value, bool | str) or value is None:
        return value
    if isinstance(value, int | np.integer):
        return int(value)
    # Nine digits: the last digits of sums in linear algebra libraries depend on the alignment of arrays in memory.
    return float(f"{value:.9g}") if math.isfinite(value) else None


def as_dict(evaluations: Sequence[SessionEvaluation]) -> dict[str, Any]:
    """All figures as plain types; numbers that are not finite are None."""
    together: dict[str, Any] = {
        "sessions": len(evaluations),
        "tre_mm": _maybe(spread_of(all_tre_mm(evaluations))),
        "track_error_deg": _maybe(spread_of(all_track_errors_deg(evaluations))),
        "leave_one_out": _maybe(prediction_of([s for e in evaluations for s in e.leave_one_out])),
        "k_fold": _maybe(prediction_of([s for e in evaluations for s in e.k_fold])),
        "curve": [asdict(point) for point in pooled_curve(evaluations)],
    }
    out: dict[str, Any] = plain({"sessions": [_session(e) for e in evaluations], "together": together})
    return out


def _maybe(figures: Any) -> Any:
    return None if figures is None else asdict(figures)


def _session(evaluation: SessionEvaluation) -> dict[str, Any]:
    whole = evaluation.whole
    return {
        "session": evaluation.name,
        "verdict": whole.verdict.value,
        "reasons": list(whole.reasons),
        "epochs": [
            {
                "index": k,
                "pairs": whole.epoch_pms[k],
                "predicted_tre_mm": None
                if (p := whole.predicted[k]) is None
                else {"mean": p.mean_mm, "p95": p.p95_mm, "worst": p.worst_mm},
                "tre_mm": None if (e := whole.tre_mm[k]) is None else _maybe(spread_of(e)),
            }
            for k in range(len(whole.trus_T_camera))
        ],
        "beam_error": None
        if whole.beam_angle_rad is None
        else {"angle_deg": math.degrees(whole.beam_angle_rad), "offset_mm": whole.beam_offset_mm},
        "track_error_deg": [None if e is None else math.degrees(e) for e in whole.track_error_rad],
        "leave_one_out": _cross(evaluation.leave_one_out),
        "k_fold": _cross(evaluation.k_fold),
        "curve": [asdict(point) for point in curve_of(evaluation)],
        "influence": [
            {
                "pm": i.pm,
                "epoch": i.epoch,
                "moved_mm": i.moved_mm,
                "worst_moved_mm": i.worst_moved_mm,
                "expected_tre_mm": i.expected_mm,
                "expected_tre_without_mm": i.expected_without_mm,
            }
            for i in whole.influence
        ],
    }


def _cross(solves: Sequence[Resolved]) -> dict[str, Any] | None:
    figures = prediction_of(solves)
    if figures is None:
        return None
    pms = [
        {
            "pm": pm.pm,
            "epoch": pm.epoch,
            "pair_residual_mm": pm.pair_residual_mm,
            "nis": pm.nis,
            "degrees_of_freedom": pm.degrees_of_freedom,
        }
        for solve in solves
        for pm in solve.held_out
    ]
    return {**asdict(figures), "pms": pms}


def as_csv(evaluations: Sequence[SessionEvaluation]) -> str:
    """All figures as one long table (``COLUMNS``)."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for evaluation in evaluations:
        for table, epoch, pm, pairs, quantity, value in _lines(evaluation):
            if value is not None and math.isfinite(value):
                writer.writerow([evaluation.name, table, epoch, pm, pairs, quantity, f"{value:.6g}"])
    return text.getvalue()


_Line = tuple[str, int | str, int | str, int | str, str, float | None]


def _lines(evaluation: SessionEvaluation) -> list[_Line]:
    whole = evaluation.whole
    out: list[_Line] = []
    for k, pms in enumerate(whole.epoch_pms):
        predicted, errors = whole.predicted[k], whole.tre_mm[k]
        if predicted is not None:
            out += [
                ("whole", k, "", pms, "predicted_tre_mean_mm", predicted.mean_mm),
                ("whole", k, "", pms, "predicted_tre_p95_mm", predicted.p95_mm),
                ("whole", k, "", pms, "predicted_tre_worst_mm", predicted.worst_mm),
            ]
        figures = None if errors is None else spread_of(errors)
        if figures is not None:
            out += [
                ("whole", k, "", pms, "tre_mean_mm", figures.mean),
                ("whole", k, "", pms, "tre_p95_mm", figures.p95),
                ("whole", k, "", pms, "tre_worst_mm", figures.worst),
            ]
    if whole.beam_angle_rad is not None:
        out.append(("whole", "", "", "", "beam_angle_deg", math.degrees(whole.beam_angle_rad)))
        out.append(("whole", "", "", "", "beam_offset_mm", whole.beam_offset_mm))
    out += [
        ("whole", "", "", "", f"track_{i}_error_deg", None if e is None else math.degrees(e))
        for i, e in enumerate(whole.track_error_rad)
    ]
    for table, solves in (("leave_one_out", evaluation.leave_one_out), ("k_fold", evaluation.k_fold)):
        out += _prediction_lines(table, prediction_of(solves))
        for solve in solves:
            for pm in solve.held_out:
                out.append((table, pm.epoch, pm.pm, len(solve.kept), "pair_residual_mm", pm.pair_residual_mm))
                out.append((table, pm.epoch, pm.pm, len(solve.kept), "nis", pm.nis))
    for item in whole.influence:
        out.append(("influence", item.epoch, item.pm, "", "moved_mm", item.moved_mm))
        out.append(("influence", item.epoch, item.pm, "", "expected_tre_without_mm", item.expected_without_mm))
    for point in curve_of(evaluation):
        out += _curve_lines(point, evaluation.curve_epoch)
    return out


def _prediction_lines(table: str, figures: Prediction | None) -> list[_Line]:
    if figures is None:
        return []
    residual = figures.pair_residual_mm
    return [
        (table, "", "", "", "pair_residual_mean_mm", residual.mean),
        (table, "", "", "", "pair_residual_std_mm", residual.std),
        (table, "", "", "", "pair_residual_p95_mm", residual.p95),
        (table, "", "", "", "pair_residual_worst_mm", residual.worst),
        (table, "", "", "", "nis_per_degree", figures.nis_per_degree),
        (table, "", "", "", "beyond_95", figures.beyond_95),
    ]


def _curve_lines(point: CurvePoint, epoch: int) -> list[_Line]:
    figures: dict[str, float | None] = {
        "subsets": float(point.subsets),
        "failed": float(point.failed),
        "ambiguous": point.ambiguous,
        "expected_tre_mm": point.expected_mm,
        "tre_rms_mm": point.tre_rms_mm,
    }
    for name, of in (("tre", point.tre_mm), ("pair_residual", point.pair_residual_mm)):
        if of is not None:
            figures |= {f"{name}_mean_mm": of.mean, f"{name}_p95_mm": of.p95, f"{name}_worst_mm": of.worst}
    return [("curve", epoch, "", point.pairs, quantity, value) for quantity, value in figures.items()]
