"""Solves a recorded session, from its folder to its result: the steps of ``fgreg solve`` on one page.

read the session -> detect marker, board and PM in the frames -> calibrate and register in one graph -> verdict
-> answer the tracking queries -> write the result (and the recording).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fgreg.camera_moves.found import DetectedMove
from fgreg.camera_moves.recorded_session import EpochsFound, find_epochs, renumbered, split_epochs
from fgreg.camera_moves.recorded_tags import with_tag_moves
from fgreg.detection.events_to_measurements import ExtractedMeasurements, extract_measurements
from fgreg.detection.results import MarkerFit, NoSignal, PaFind
from fgreg.geometry.target_error import beam_error, tre_mm
from fgreg.geometry.transforms import FloatArray, transform_points
from fgreg.model.estimate import (
    AimEstimate,
    CheckEstimate,
    PairEstimate,
    PointEstimate,
    SessionEstimate,
    SettingsUsed,
    TrackEstimate,
    Verdict,
)
from fgreg.model.events import AimEvent, CheckEvent, Event, PairEvent, PointEvent, TrackEvent, looks_of
from fgreg.model.hindrances import with_hindrances
from fgreg.model.lens import project
from fgreg.model.measurements import Check, Look, Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.output.atomic_file import check_outputs
from fgreg.pipeline.exclude import ShotNames, without_shots
from fgreg.registration.checks import CHECKS_REFUSE, not_compared, with_checks
from fgreg.registration.influence import influences
from fgreg.registration.move_doubt import TELLING
from fgreg.registration.rig_at_checks import rig_at_checks
from fgreg.registration.solve import Solution, solve
from fgreg.registration.verdict import Condition, by_hand, refused_shots
from fgreg.session.ground_truth import GroundTruth
from fgreg.session.input_hashes import read_with_hashes
from fgreg.session.result_file import RESULT_FILE, RESULT_KIND, write_result
from fgreg.session.session_reader import Session, read_ground_truth, session_place
from fgreg.version import __version__
from fgreg.viewer.null_viewer import NullViewer, open_viewer
from fgreg.viewer.recording_file import RECORDING

if TYPE_CHECKING:
    from fgreg.viewer.recording import Viewer
    from fgreg.viewer.scene import ShotKind

TOO_FEW_AIMS = 0.5
"""Share of unusable aims from which there is a warning."""

Progress = Callable[[str, int, int], None]
"""Called with (name of the step, items done, total items)."""


@dataclass(frozen=True, slots=True)
class SolveRequest:
    """Options of a solve.

    Attributes:
        folder: the session. out: result file; None: ``result.yaml`` in the session's folder.
        rrd: the recording to write, if any. redetect: detect in frames even where poses are recorded.
        detect_moves: detect unreported camera moves, and split the session into epochs at them.
        without: shots left out besides those of the session's ``exclude`` events.
    """

    folder: Path
    out: Path | None = None
    rrd: Path | None = None
    redetect: bool = False
    detect_moves: bool = True
    without: ShotNames = field(default_factory=ShotNames)


@dataclass(frozen=True, slots=True, eq=False)
class TruthErrors:
    """Errors against the ground truth.

    Attributes:
        tre_mm: per epoch, distances (n,) at the targets; None where there is no registration or no truth.
        beam_angle_rad, beam_offset_mm: angle between the beams; distance of the true beam's origin from the beam.
        track_rad: per track, estimated less true stage angle, None where there is no result.
    """

    tre_mm: tuple[FloatArray | None, ...]
    beam_angle_rad: float | None
    beam_offset_mm: float | None
    track_rad: tuple[float | None, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SolveReport:
    """Result of a solve.

    Attributes:
        session: as read.
        extracted: detections in its frames; ``extracted.measurements`` were solved.
        solution: the estimate with its registration, posterior and snapshot.
        estimate: contents of ``result.yaml``: verdict, reasons, beam, epochs, pairs, tracks, aims.
        truth: of ``ground_truth.yaml``. errors: against it; None where there is none.
        result_path, rrd_path: written files; the latter None without a recording.
        elapsed_s: time of the whole solve.
    """

    session: Session
    extracted: ExtractedMeasurements
    solution: Solution
    estimate: SessionEstimate
    truth: GroundTruth | None
    errors: TruthErrors | None
    result_path: Path
    rrd_path: Path | None
    elapsed_s: float

    @property
    def looks(self) -> tuple[Look, ...]:
        """The look of each measured pair, in the position that was taken."""
        registration, measurements = self.solution.registration, self.extracted.measurements
        if registration is None:
            return tuple(pair.look for pair in measurements.pairs)
        return registration.looks_of(measurements)


def solve_session(
    request: SolveRequest, config: SolveConfig | None = None, progress: Progress | None = None
) -> SolveReport:
    """Solve a recorded session.

    Raises:
        InputError: bad input; an older result stays.
    """
    start = time.perf_counter()
    config = config or SolveConfig()
    result_path = result_place(request.folder, request.out, request.rrd)
    session, inputs = read_with_hashes(request.folder)
    session = without_shots(session, request.without, "--without-")
    session = with_tag_moves(session) if request.detect_moves else session
    truth = read_ground_truth(request.folder)
    with open_viewer(request.rrd, session.model.name, made_from=inputs) as viewer:
        extracted = extract_measurements(
            session.events,
            session.model,
            redetect=request.redetect,
            progress=None if progress is None else lambda done, total: progress("looking at frames", done, total),
        )
        extracted, found, solution, estimate = solve_extracted(session, extracted, config, request.detect_moves)
        used = settings_used(config, request.detect_moves, request.redetect)
        estimate = replace(with_hindrances(estimate, session.events), inputs=inputs, settings=used)
        errors = errors_where_known(estimate, truth, found.moves, session.model.targets_mm)
        show(viewer, session, extracted, estimate, truth, config.limit_mm)
        write_result(estimate, session.model, result_path, __version__)
    elapsed = time.perf_counter() - start
    return SolveReport(session, extracted, solution, estimate, truth, errors, result_path, request.rrd, elapsed)


def solve_extracted(
    session: Session, extracted: ExtractedMeasurements, config: SolveConfig, detect_moves: bool = True
) -> tuple[ExtractedMeasurements, EpochsFound, Solution, SessionEstimate]:
    """A session's measurements to its estimate: camera moves, one solve, every shot and check.

    Returns:
        The measurements in the epochs that were found, these epochs, the solution, and the estimate.
    """
    found = EpochsFound()
    if detect_moves:
        found = find_epochs(extracted.measurements, session.model, config)
        extracted = with_moves(extracted, found)
    solution = solve(
        extracted.measurements,
        extracted.tracks,
        session.model,
        config,
        [*move_conditions(found, extracted.measurements), *detection_conditions(extracted)],
        registration=found.registration,
    )
    return extracted, found, solution, session_estimate(session, extracted, solution, config)


def settings_used(config: SolveConfig, detect_moves: bool, redetect: bool) -> SettingsUsed:
    """What a result says of the settings it was made with."""
    names = (("sound_speed", config.estimate_sound_speed), ("probe_radius", config.estimate_radius))
    return SettingsUsed(config.limit_mm, tuple(name for name, wanted in names if wanted), detect_moves, redetect)


def result_place(folder: Path, out: Path | None, rrd: Path | None) -> Path:
    """The result's file, checked together with the recording's before the work begins.

    Raises:
        InputError: the session's folder does not exist, or one of them cannot be written.
    """
    session_place(folder)
    place = folder / RESULT_FILE if out is None else out
    check_outputs([("the result", place, RESULT_KIND), ("--rrd", rrd, RECORDING)])
    return place


def with_moves(extracted: ExtractedMeasurements, found: EpochsFound) -> ExtractedMeasurements:
    """The session's measurements with detected camera moves: pairs and tracks get their new epochs."""
    if not found.texts:
        return extracted
    epoch_of = renumbered(extracted.epoch_of, extracted.pair_events, found.moves)
    tracks = zip(extracted.track_events, extracted.tracks, strict=True)
    return replace(
        extracted,
        measurements=split_epochs(extracted.measurements, found.moves, found.loop_closures),
        tracks=tuple(replace(track, epoch=epoch_of[index]) for index, track in tracks),
        checks={index: replace(check, epoch=epoch_of[index]) for index, check in extracted.checks.items()},
        epoch_of=epoch_of,
    )


def move_conditions(found: EpochsFound, split: Measurements) -> list[Condition]:
    """Conditions of the verdict from detected camera moves; ``split``: the measurements with their epochs.

    So few PMs as determine a registration do not show whether they are all of one, and a move may be placed one PM off.
    """
    conditions = [Condition(Verdict.WARNING, text) for text in found.texts]
    pms = len({pair.pm for pair in split.pairs if pair.epoch == len(split.epochs) - 1})
    if found.moves and found.moves[-1].since_t == split.epochs[-1].t and pms < TELLING:
        text = (
            f"{pms} pairs since the camera moved do not show that all of them are: take at least {TELLING - pms} more"
        )
        conditions.append(Condition(Verdict.REFUSED, text))
    return conditions


def hand_conditions(extracted: ExtractedMeasurements) -> list[Condition]:
    """Conditions of the verdict from shots that were left out by hand, and from refused events."""
    shots = extracted.measurements
    used = len(shots.aims) + len(shots.pairs) + len(shots.points)
    return by_hand(extracted.excluded, used) + refused_shots(extracted.refused)


def detection_conditions(extracted: ExtractedMeasurements) -> list[Condition]:
    """Conditions of the verdict from before the solve: shots left out or refused, unusable calibration shots."""
    found = hand_conditions(extracted)
    lost_aims, used = extracted.unused_aims, len(extracted.measurements.aims)
    if lost_aims and len(lost_aims) >= TOO_FEW_AIMS * (used + len(lost_aims)):
        text = (
            f"{len(lost_aims)} of {used + len(lost_aims)} aims could not be used ({extracted.unused[lost_aims[0]]}): "
            "take them again with marker and board in both views"
        )
        found.append(Condition(Verdict.WARNING, text))
    return found


def session_estimate(
    session: Session, extracted: ExtractedMeasurements, solution: Solution, config: SolveConfig
) -> SessionEstimate:
    """The solution with every shot and check of the session in it, in event order; unused ones have their reason."""
    pairs = dict(zip(extracted.pair_events, with_influence(solution, session.model), strict=True))
    tracks = dict(zip(extracted.track_events, solution.tracks, strict=True))
    aims = dict(zip(extracted.aim_events, solution.aims, strict=True))
    points = dict(zip(extracted.point_events, solution.points, strict=True))
    checks: dict[int, Check | CheckEstimate] = dict(extracted.checks)
    for index, event in enumerate(session.events):
        reason = extracted.unused.get(index, "")
        if isinstance(event, PairEvent) and index not in pairs:
            pairs[index] = PairEstimate(event.t, event.pm, extracted.epoch_of[index], used=False, reason=reason)
        elif isinstance(event, TrackEvent) and index not in tracks:
            tracks[index] = TrackEstimate(event.t, None, None, None, causal=False, reason=reason)
        elif isinstance(event, AimEvent) and index not in aims:
            aims[index] = AimEstimate(event.t, used=False, reason=reason)
        elif isinstance(event, PointEvent) and index not in points:
            points[index] = PointEstimate(event.t, extracted.epoch_of[index], used=False, reason=reason)
        elif isinstance(event, CheckEvent) and index not in checks:
            checks[index] = not_compared(event.t, reason)
    solved = solution.as_session(session.model.name)
    rigs = rig_at_checks(session.model, solution.snapshot, [*extracted.checks.values()])
    checked = with_checks(solved, [checks[i] for i in sorted(checks)], config.limit_mm, session.model.targets_mm, rigs)
    if checked.epochs and checked.epochs[-1].verdict is Verdict.REFUSED is not solved.epochs[-1].verdict:
        for index in extracted.track_events:
            if extracted.epoch_of[index] == checked.epochs[-1].index:
                tracks[index] = replace(
                    tracks[index], stage_rad=None, sigma_rad=None, lambda_mm=None, reason=CHECKS_REFUSE
                )
    return replace(
        checked,
        pairs=tuple(pairs[i] for i in sorted(pairs)),
        tracks=tuple(tracks[i] for i in sorted(tracks)),
        aims=tuple(aims[i] for i in sorted(aims)),
        points=tuple(points[i] for i in sorted(points)),
        excluded=extracted.excluded,
    )


def with_influence(solution: Solution, model: SessionModel) -> tuple[PairEstimate, ...]:
    """The pairs of a solution with the influence of each PM that is an inlier."""
    if solution.registration is None:
        return solution.pairs
    found = {(of.epoch, of.pm): of.moved_mm for of in influences(solution.registration, model.targets_mm)}
    return tuple(
        replace(pair, influence_mm=moved) if pair.used and np.isfinite(moved) else pair
        for pair in solution.pairs
        for moved in [found.get((pair.epoch, pair.pm), np.inf)]
    )


def errors_where_known(
    estimate: SessionEstimate, truth: GroundTruth | None, moves: Sequence[DetectedMove], targets_mm: FloatArray
) -> TruthErrors | None:
    """:func:`truth_errors`; None without a truth, or where detected moves give more epochs than it has."""
    if truth is None or (moves and len(truth.trus_T_camera) < len(estimate.epochs)):
        return None
    return truth_errors(estimate, truth, targets_mm)


def truth_errors(estimate: SessionEstimate, truth: GroundTruth, targets_mm: FloatArray) -> TruthErrors:
    """Errors of an estimate against the session's ground truth.

    Where a move went unreported the camera now is compared: the last epoch with the last true registration.
    """
    same = len(estimate.epochs) >= len(truth.trus_T_camera)
    tre: list[FloatArray | None] = []
    for left, epoch in zip(range(len(estimate.epochs))[::-1], estimate.epochs, strict=True):
        known = epoch.index if same else len(truth.trus_T_camera) - 1
        if epoch.trus_T_camera is None or known >= len(truth.trus_T_camera) or (left and not same):
            tre.append(None)
            continue
        tre.append(tre_mm(epoch.trus_T_camera, truth.trus_T_camera[known], targets_mm))
    angle = offset = None
    if estimate.laser is not None and truth.marker_T_laser is not None:
        angle, offset = beam_error(estimate.laser.marker_T_laser, truth.marker_T_laser)
    stage = {round(track.t, 6): track.stage_rad for track in truth.tracks}
    track_rad = tuple(
        None
        if track.stage_rad is None or round(track.t, 6) not in stage
        else float(np.mod(track.stage_rad - stage[round(track.t, 6)] + np.pi, 2 * np.pi) - np.pi)
        for track in estimate.tracks
    )
    return TruthErrors(tuple(tre), angle, offset, track_rad)


def show(
    viewer: Viewer | NullViewer,
    session: Session,
    extracted: ExtractedMeasurements,
    estimate: SessionEstimate,
    truth: GroundTruth | None,
    limit_mm: float,
) -> None:
    """Draw the frames with their detections, then the result."""
    if isinstance(viewer, NullViewer):
        return  # spares reading the frames again
    model = session.model
    viewer.session(model, limit_mm)
    shot = 0
    for index, event in enumerate(session.events):
        if isinstance(event, AimEvent | PairEvent | TrackEvent):
            show_frames(viewer, session, extracted, index, event, shot)
            shot += 1
    viewer.result(model, extracted.measurements, estimate, truth, extracted.tracks)


def show_frames(
    viewer: Viewer | NullViewer,
    session: Session,
    extracted: ExtractedMeasurements,
    index: int,
    event: AimEvent | PairEvent | TrackEvent,
    shot: int,
) -> None:
    """Draw the frames of one event with their detections; ``shot``: its number among aims, pairs and tracks."""
    if isinstance(viewer, NullViewer):
        return  # spares reading the frames again
    from fgreg.detection.event_frames import load_trus_frame, marker_pictures
    from fgreg.detection.frame_files import to_display

    model = session.model
    kind: ShotKind = "aim" if isinstance(event, AimEvent) else "pair" if isinstance(event, PairEvent) else "track"
    if event.marker.left is not None and model.camera is not None:
        left, right = marker_pictures(event.marker, event.line, model.camera)
        viewer.shot_images(
            event.t,
            kind,
            shot,
            to_display(left),
            None if right is None else to_display(right),
            _outlines(extracted, index, model),
            _corner(extracted, index, event, model),
        )
    for number, look in enumerate(looks_of(event)):
        if look.frame is None:
            continue
        frame = load_trus_frame(look.frame, event.line, "trus.frame", model)
        find = extracted.finds.get((index, number), NoSignal(""))
        source = find if isinstance(find, PaFind) else None
        viewer.pa_frame(
            event.t,
            shot,
            frame,
            source.x_mm if source else look.x_mm,
            source.range_mm if source else look.range_mm,
            source.covariance if source else look.covariance,
            model.probe,
        )


def _outlines(extracted: ExtractedMeasurements, index: int, model: SessionModel) -> list[FloatArray] | None:
    """The tags' outlines (4, 2) px in the left image, from the fitted pose; None without one."""
    fit = extracted.markers.get(index)
    if not isinstance(fit, MarkerFit) or model.marker is None or model.camera is None:
        return None
    left = model.camera.left
    return [project(left, transform_points(fit.camera_T_marker, tag.marker_p_corners_mm)) for tag in model.marker.tags]


def _corner(extracted: ExtractedMeasurements, index: int, event: Event, model: SessionModel) -> FloatArray | None:
    """The aimed-at spot (2,) px in the left image; None where unknown."""
    if not isinstance(event, AimEvent) or index not in extracted.aim_events or model.camera is None:
        return None
    aim = extracted.measurements.aims[extracted.aim_events.index(index)]
    return np.asarray(project(model.camera.left, aim.camera_p_spot_mm[None])[0])
