"""What the report says, section by section, from a session and its result: texts and pictures for the template.

Nothing is estimated here. Figures are those of the result; counts and bounds of chi square are made from them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup
from scipy.special import chdtri

from fgreg.geometry.transforms import log_so3
from fgreg.html_report import figures, target_map, words
from fgreg.html_report.words import degrees, number, percent, vector
from fgreg.model.estimate import EpochEstimate, PairEstimate, SessionEstimate, SettingsUsed, TrackEstimate, Verdict
from fgreg.model.events import CameraMovedEvent, Event, NoteEvent, PairEvent, RefusedEvent, StageEvent
from fgreg.model.known_points import nis_limit
from fgreg.model.session_model import SessionModel
from fgreg.model.systematic import TEXTS, largest_causes

MOST_PAIRS = 400
"""Looks listed; of more the unused ones and those with the largest NIS."""
MOST_LOGGED = 300
"""Lines of the stage's log; of more all stops and the last ones."""
OUTSIDE = 0.05
Row = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """What a report is made from.

    Attributes:
        session: the name of its folder. model, events: as read.
        estimate: its result. settings: those of the result.
        pictures: by place among the looks (as in ``estimate.pairs``), the thumbnails.
        hashes: SHA-256 of files beside those that the result names.
        version: of this package.
    """

    session: str
    model: SessionModel
    events: tuple[Event, ...]
    estimate: SessionEstimate
    settings: SettingsUsed
    pictures: Mapping[int, Sequence[Markup]]
    hashes: Mapping[str, str]
    version: str

    @property
    def epoch(self) -> EpochEstimate | None:
        """The epoch in which the camera is now."""
        return self.estimate.epochs[-1] if self.estimate.epochs else None


def contents(source: Source) -> Row:
    """All that the template shows."""
    estimate = source.estimate
    return {
        "name": estimate.session,
        "folder": source.session,
        "version": source.version,
        "verdict": _verdict(source),
        "targets": _targets(source),
        "assumptions": [
            {"text": a.text, "checks": ", ".join(str(place + 1) for place in a.checks)} for a in estimate.assumptions
        ],
        "checks": _checks(source),
        "registration": _registration(source),
        "tracks": _tracks(source),
        "pairs": _pairs(source),
        "points": _points(source),
        "calibration": _calibration(source),
        "moves": _moves(source),
        "log": _log(source),
        "held_out": _held_out(source),
        "next": list(words.next_steps(estimate, source.session)),
        "settings": _settings(source),
        "hashes": {**estimate.inputs, **source.hashes},
        "research": words.RESEARCH,
    }


def shown_pairs(pairs: Sequence[PairEstimate], most: int) -> list[int]:
    """Places of the looks to show, in order: all, else the unused ones and those with the largest NIS."""
    order = sorted(range(len(pairs)), key=lambda i: (pairs[i].used, -(pairs[i].nis or 0.0), i))
    return sorted(order[:most])


def _verdict(source: Source) -> Row:
    estimate, epoch = source.estimate, source.epoch
    tre = None if epoch is None else epoch.predicted_tre
    worst = max(epoch.targets, key=lambda target: target.p95_mm, default=None) if epoch is not None else None
    newest = estimate.tracks[-1] if estimate.tracks else None
    question, angle = "Turn the probe by this registration?", "There is no tracking query in this session."
    if newest is not None:
        angle = f"The newest query, at {newest.t:.1f} s, has no answer: {newest.reason}."
        if newest.stage_rad is not None:
            question = f"Turn the probe by this angle, to {degrees(newest.stage_rad)} deg?"
            angle = f"It answers the newest query, at {newest.t:.1f} s; 1 sigma is {degrees(newest.sigma_rad)} deg."
    verdict, loose = _answer_verdict(newest, source) if newest is not None else (estimate.verdict, "")
    if newest is None or newest.stage_rad is None:
        verdict = estimate.verdict
    used = sum(pair.used for pair in estimate.pairs)
    answered = sum(track.stage_rad is not None for track in estimate.tracks)
    compared = sum(check.error_mm is not None for check in estimate.checks)
    at = "" if worst is None or len(source.model.targets) == 0 else f" ({worst.name})"
    of_epoch = f" in camera epoch {epoch.index}" if epoch is not None and len(estimate.epochs) > 1 else ""
    return {
        "kind": verdict.value,
        "answer": words.ANSWER[verdict],
        "sign": words.SIGNS[verdict],
        "question": question,
        "permits": words.PERMITS[verdict],
        "angle": angle,
        "reasons": [*estimate.reasons, *([f"the newest angle: {loose}"] if loose else [])],
        "figures": [
            (
                f"{number(None if tre is None else tre.worst_mm)} mm",
                f"predicted error at the worst target{at}{of_epoch}, 95 % bound; "
                f"the limit is {source.settings.limit_mm:g} mm",
            ),
            (_of(used, len(estimate.pairs)), "looks used"),
            (_of(answered, len(estimate.tracks)), "tracking queries answered"),
            (_of(compared, len(estimate.checks)), "check points compared"),
        ],
    }


def _of(count: int, total: int) -> str:
    return f"{count} of {total}" if total else "none"


def _targets(source: Source) -> Row:
    epoch, limit = source.epoch, source.settings.limit_mm
    targets = () if epoch is None else epoch.targets
    tre = None if epoch is None else epoch.predicted_tre
    rows = [
        {
            "name": target.name,
            "at": [number(float(value), 1) for value in target.trus_p_mm],
            "random": number(target.random_mm),
            "systematic": number(target.systematic_mm),
            "p95": number(target.p95_mm),
            "share": number(100.0 * target.p95_mm / limit, 0),
            "width": min(100.0, 50.0 * target.p95_mm / limit),
            "kind": ("ok", "ok", "warning", "refused")[target_map.error_class(target.p95_mm, limit)],
            "within": target.p95_mm <= limit,
        }
        for target in targets
    ]
    summary = []
    if tre is not None:
        parts = (("both", tre), ("random", tre.random), ("systematic", tre.systematic))
        rows_of = [(name, part) for name, part in parts if part is not None]
        if tre.seen is not None:
            rows_of.append(("against what the scanner shows", tre.seen))
        summary = [(name, number(p.mean_mm), number(p.p95_mm), number(p.worst_mm)) for name, p in rows_of]
    return {
        "named": bool(source.model.targets),
        "epoch": epoch.index if epoch is not None and len(source.estimate.epochs) > 1 else None,
        "limit": f"{limit:g}",
        "maps": target_map.target_maps(targets, limit, source.model.probe),
        "key": target_map.error_key(),
        "rows": rows,
        "summary": summary,
        "causes": largest_causes(source.estimate.systematic),
    }


def _checks(source: Source) -> list[Row]:
    return [
        {
            "number": place + 1,
            "t": number(check.t, 1),
            "error": None if check.error_mm is None else vector(check.error_mm.tolist()),
            "length": None if check.error_mm is None else number(float(np.linalg.norm(check.error_mm))),
            "bound": number(check.predicted_95_mm),
            "nis": number(check.nis, 1),
            "kind": check.verdict.value,
            "word": "as predicted" if check.verdict is Verdict.OK else "look at it",
            "reason": check.reason,
        }
        for place, check in enumerate(source.estimate.checks)
    ]


def _registration(source: Source) -> Row:
    epoch = source.epoch
    if epoch is None or epoch.trus_T_camera is None:
        return {"there": False}
    turn = log_so3(epoch.trus_T_camera[:3, :3])
    angle = float(np.linalg.norm(turn))
    sigma = None if epoch.covariance is None else np.sqrt(np.clip(np.diag(epoch.covariance), 0.0, None))
    return {
        "there": True,
        "refused": source.estimate.verdict is Verdict.REFUSED,
        "rows": [[f"{value:.6f}" for value in row] for row in epoch.trus_T_camera],
        "translation": vector(epoch.trus_T_camera[:3, 3].tolist()),
        "angle": f"{math.degrees(angle):.2f}",
        "axis": vector((turn / angle).tolist() if angle > 1e-12 else [1.0, 0.0, 0.0], 4),
        "sigma_mm": None if sigma is None else vector(sigma[3:].tolist()),
        "sigma_deg": None if sigma is None else vector(np.degrees(sigma[:3]).tolist()),
        "pictures": figures.frames_pictures(epoch, source.estimate.pairs, source.model.probe, source.model.stage),
        "stage": f"{degrees(source.model.stage.zero_device_rad)} deg",
        "direction": "from +z towards +y" if source.model.stage.direction > 0 else "from +z towards -y",
    }


def _answer_verdict(track: TrackEstimate, source: Source) -> tuple[Verdict, str]:
    """Whether the probe may be turned by one answer, and why not where the registration itself is good enough.

    An answer has an error of its own, from its marker and its beam: at the target farthest from the probe's axis, its
    95 % bound has to be within the limit as well.
    """
    verdict = source.estimate.verdict
    if track.stage_rad is None or track.sigma_rad is None:
        return Verdict.REFUSED, ""
    farthest_mm = float(np.linalg.norm(source.model.targets_mm[:, 1:], axis=1).max())
    bound_mm = figures.SIGMA_95 * track.sigma_rad * farthest_mm
    if verdict is not Verdict.OK or bound_mm <= source.settings.limit_mm:
        return verdict, ""
    text = f"its 95 % bound is {bound_mm:.1f} mm at the target farthest from the probe's axis, the limit "
    return Verdict.WARNING, f"{text}{source.settings.limit_mm:g} mm; see the marker better, or take more aims"


def _tracks(source: Source) -> Row:
    tracks = source.estimate.tracks
    judged = [_answer_verdict(track, source) for track in tracks]
    rows = [
        {
            "t": number(track.t, 1),
            "angle": degrees(track.stage_rad),
            "sigma": degrees(track.sigma_rad, 2),
            "bound": degrees(None if track.sigma_rad is None else figures.SIGMA_95 * track.sigma_rad, 2),
            "lambda": number(track.lambda_mm, 1),
            "from": "what was known then" if track.causal else "the whole session",
            "answer": words.ANSWER[verdict],
            "kind": verdict.value,
            "reason": track.reason,
            "loose": loose,
        }
        for track, (verdict, loose) in zip(tracks, judged, strict=True)
    ]
    return {"rows": rows, "picture": figures.track_picture(tracks, source.model.stage)}


def _bound(pair: PairEstimate) -> float | None:
    """95 % bound of a pair's NIS."""
    return float(chdtri(pair.nis_dof, OUTSIDE)) if pair.nis_dof else None


def _pairs(source: Source) -> Row:
    pairs = source.estimate.pairs
    events = [event for event in source.events if isinstance(event, PairEvent)]
    places = shown_pairs(pairs, MOST_PAIRS)
    rows = []
    for place in places:
        pair, event = pairs[place], events[place]
        rows.append(
            {
                "pm": pair.pm,
                "epoch": pair.epoch,
                "t": number(event.t, 1),
                "scan": number(event.trus.scan_deg, 1),
                "sweep": {1: "up", -1: "down", 0: words.NOTHING}[event.trus.sweep],
                "lambda": number(pair.lambda_mm, 1),
                "residual": number(pair.residual_mm, 3),
                "spot": words.NOTHING if pair.spot_error_mm is None else vector(pair.spot_error_mm.tolist(), 1),
                "nis": number(pair.nis, 1),
                "bound": number(_bound(pair), 1),
                "influence": number(pair.influence_mm),
                "used": pair.used,
                "reason": pair.reason,
                "pictures": source.pictures.get(place, ()),
            }
        )
    return {
        "rows": rows,
        "total": len(pairs),
        "used": sum(pair.used for pair in pairs),
        "several": len(source.estimate.epochs) > 1,
        "pictures": bool(source.pictures),
        "spots": any(pair.spot_error_mm is not None for pair in pairs),
    }


def _points(source: Source) -> Row:
    points = source.estimate.points
    limit = nis_limit(points)
    rows = []
    for place, point in enumerate(points):
        fits = point.nis is None or point.nis <= limit
        kind, word = ("ok", "used") if fits else ("warning", "used, contradicts the others")
        rows.append(
            {
                "number": place,
                "epoch": point.epoch,
                "t": number(point.t, 1),
                "used": point.used,
                "error": words.NOTHING if point.error_mm is None else vector(point.error_mm.tolist()),
                "length": number(None if point.error_mm is None else float(np.linalg.norm(point.error_mm))),
                "nis": number(point.nis, 1),
                "kind": kind if point.used else "refused",
                "word": word if point.used else "not used",
                "reason": point.reason,
            }
        )
    return {"rows": rows, "used": sum(point.used for point in points), "limit": number(limit, 1)}


def _first_looks(source: Source) -> list[PairEstimate]:
    """One look of each PM that has a NIS: it is of the PM, the same for all its looks."""
    found: dict[tuple[int, int], PairEstimate] = {}
    for pair in source.estimate.pairs:
        if pair.nis is not None and pair.nis_dof:
            found.setdefault((pair.epoch, pair.pm), pair)
    return list(found.values())


def _held_out(source: Source) -> Row:
    looks = _first_looks(source)
    ratios = [(pair.pm, (pair.nis or 0.0) / (_bound(pair) or 1.0), pair.used) for pair in looks]
    used = [pair for pair in looks if pair.used]
    beyond = [pair for pair in used if (pair.nis or 0.0) > (_bound(pair) or math.inf)]
    freedom = sum(pair.nis_dof or 0 for pair in used)
    return {
        "picture": figures.nis_picture(ratios),
        "count": len(used),
        "beyond": len(beyond),
        "share": percent(len(beyond) / len(used)) if used else "",
        "which": ", ".join(str(pair.pm) for pair in beyond),
        "per_degree": number(sum(pair.nis or 0.0 for pair in used) / freedom) if freedom else words.NOTHING,
        "left_out": ", ".join(str(pair.pm) for pair in looks if not pair.used),
    }


def _calibration(source: Source) -> Row:
    laser, aims = source.estimate.laser, source.estimate.aims
    texts = {text.name: text for text in TEXTS}
    beam = None
    if laser is not None:
        direction = math.sqrt(max(0.0, float(np.linalg.eigvalsh(laser.covariance[:2, :2])[-1])))
        place = math.sqrt(max(0.0, float(np.linalg.eigvalsh(laser.covariance[3:5, 3:5])[-1])))
        beam = {
            "origin": vector(laser.marker_T_laser[:3, 3].tolist()),
            "place": number(place),
            "direction": vector(laser.marker_T_laser[:3, 2].tolist(), 4),
            "sigma": degrees(direction, 2),
        }
    constants = []
    for constant in source.estimate.systematic:
        text = texts.get(constant.name)
        share = text is not None and not text.unit
        factor, unit = (100.0, "%") if share else (1.0, text.unit if text is not None else "")
        constants.append(
            {
                "what": text.what if text is not None else constant.name,
                "prior": f"{number(factor * constant.prior_sigma)} {unit}",
                "value": f"{number(factor * constant.value)} {unit}",
                "sigma": f"{number(factor * constant.sigma)} {unit}",
                "observed": percent(constant.observed),
                "score": number(constant.score, 1),
                "effect": number(constant.worst_target_mm),
            }
        )
    return {
        "beam": beam,
        "aims": [
            {
                "number": place,
                "t": number(aim.t, 1),
                "used": aim.used,
                "lambda": number(aim.lambda_mm, 1),
                "residual": number(aim.residual_mm),
                "nis": number(aim.nis, 1),
                "reason": aim.reason,
            }
            for place, aim in enumerate(aims)
        ],
        "used": sum(aim.used for aim in aims),
        "constants": constants,
        "rig": source.model.rig_file.name if source.model.rig_file is not None else "",
    }


def _moves(source: Source) -> Row:
    reported = [event for event in source.events if isinstance(event, CameraMovedEvent)]
    rows = []
    for epoch in source.estimate.epochs:
        move = next((e for e in reported if epoch.start_s in (e.t, e.since_t)), None)
        if epoch.index == 0:
            how = "start of the session"
        elif move is None:
            how = "found by fgreg from the pairs"
        elif move.detected:
            how = "found by the program that recorded"
        else:
            how = "reported" + ("" if move.camera_new_T_camera_old is None else ", with its motion")
        worst = None if epoch.predicted_tre is None else epoch.predicted_tre.worst_mm
        rows.append(
            {
                "index": epoch.index,
                "from": number(epoch.start_s, 1),
                "how": how,
                "pairs": epoch.pairs,
                "worst": number(worst),
                "kind": epoch.verdict.value,
            }
        )
    count = len(rows) - 1
    moved = "once" if count == 1 else f"{count} times"
    return {"rows": rows, "count": count, "moved": moved}


def _log(source: Source) -> Row:
    rows = []
    for event in source.events:
        row: Row | None = None
        if isinstance(event, StageEvent):
            row = {"what": event.command, "angle": number(event.scan_deg, 1), "why": event.reason}
            row["stop"] = "stop" in event.command.lower()
        elif isinstance(event, RefusedEvent):
            row = {"what": "event not taken in", "angle": words.NOTHING, "why": event.reason, "stop": False}
        elif isinstance(event, NoteEvent):
            row = {"what": "note", "angle": words.NOTHING, "why": event.text, "stop": False}
        if row is not None:
            rows.append({"t": number(event.t, 1), **row})
    stops = sum(row["stop"] for row in rows)
    first = len(rows) - MOST_LOGGED
    return {
        "rows": [row for i, row in enumerate(rows) if i >= first or row["stop"]],
        "total": len(rows),
        "stops": stops,
    }


def _settings(source: Source) -> list[tuple[str, str]]:
    used, systematic = source.settings, source.model.systematic
    return [
        ("Session", source.estimate.session),
        ("Solved by", f"fgreg {source.estimate.version}"),
        ("Report by", f"fgreg {source.version}"),
        ("Limit at the worst target (95 %)", f"{used.limit_mm:g} mm"),
        ("Estimated besides", ", ".join(used.estimate) or "nothing"),
        ("Unreported camera moves", "looked for" if used.detect_moves else "not looked for"),
        ("Poses", "detected in the frames again" if used.redetect else "as recorded, else detected in the frames"),
        (
            "Rig's constants",
            "with their standard deviations" if systematic.declared else "taken as exact (systematic: none)",
        ),
        (
            "Targets",
            f"{len(source.model.targets_mm)}, {'named in session.yaml' if source.model.targets else 'by number'}",
        ),
    ]
