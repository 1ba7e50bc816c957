"""Recorded events to measurements: detect in frames, fill in default noise, number epochs and shots.

A shot whose marker or PM is not found is not an error: it gets a reason and is left out. The corner noise is pooled
over the session before any covariance is computed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from fgreg.detection.check_points import check_measurement, known_point, visible_spot
from fgreg.detection.corner_noise import CornerNoise, Misfit, Weighed, pool_corner_noise
from fgreg.detection.results import (
    BoardFit,
    FrameResults,
    MarkerFit,
    NoSignal,
    NotFound,
    PaFind,
    board_corner,
    board_corner_dependence,
    marker_covariance,
)
from fgreg.geometry.rig import CAMERA
from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.model.camera_dependence import nominal_pose_dependence, nominal_spot_dependence
from fgreg.model.estimate import ExcludedShot
from fgreg.model.events import (
    AimEvent,
    CameraMovedEvent,
    CheckEvent,
    Event,
    MarkerRecord,
    PairEvent,
    PointEvent,
    TrackEvent,
    TrusRecord,
    looks_of,
    needs_frames,
    needs_marker_frames,
    refused_evidence,
    refused_lines,
)
from fgreg.model.excluded_shots import excluded_shots
from fgreg.model.known_points import data_at
from fgreg.model.measurement_checks import look_problem, marker_problem, of_earlier_epoch, spot_problem
from fgreg.model.measurements import (
    Aim,
    CameraDependence,
    Check,
    EpochStart,
    KnownPoint,
    Look,
    MarkerObservation,
    Measurements,
    OtherPosition,
    Pair,
    Track,
    default_marker_covariance,
)
from fgreg.model.session_model import SessionModel

Progress = Callable[[int, int], None]
"""Called with (frames done, total frames)."""


@dataclass(frozen=True, slots=True, eq=False)
class ExtractedMeasurements:
    """Measurements of a session, and the result for each event.

    Attributes:
        measurements: usable aims, pairs and epochs.
        tracks: tracking queries whose marker was found.
        aim_events, pair_events, track_events: index into the session's events of each aim, pair, track.
        unused: reason, by event index, for every unused aim, pair, track or check; unused_aims: indices of unused aims,
            without those left out by hand.
        markers: detection of each event whose marker came from frames.
        boards: the same for the board.
        finds: PA localisation in each frame, by (event index, look).
        marker_noise, board_noise: pooled corner noise.
        epoch_of: camera epoch of every event.
        checks: usable checks, by event index.
        excluded: shots left out by hand. set_aside: their measurements, by event index, where there are any.
    """

    measurements: Measurements
    tracks: tuple[Track, ...]
    aim_events: tuple[int, ...]
    pair_events: tuple[int, ...]
    track_events: tuple[int, ...]
    unused: dict[int, str]
    unused_aims: tuple[int, ...]
    markers: dict[int, MarkerFit | NotFound]
    boards: dict[int, BoardFit | NotFound]
    finds: dict[tuple[int, int], PaFind | NoSignal]
    marker_noise: CornerNoise
    board_noise: CornerNoise
    epoch_of: tuple[int, ...]
    point_events: tuple[int, ...] = ()
    checks: Mapping[int, Check] = field(default_factory=dict)
    excluded: tuple[ExcludedShot, ...] = ()
    refused: tuple[str, ...] = ()
    set_aside: Mapping[int, Aim | Pair | KnownPoint] = field(default_factory=dict)


def _marker_key(record: MarkerRecord, *, redetect: bool) -> object:
    """Key of a marker observation: equal for the same frames or the same matrix."""
    if needs_marker_frames(record, redetect=redetect) or record.camera_T_marker is None:
        return record.left, record.right
    return record.camera_T_marker.tobytes()


def extract_measurements(
    events: Sequence[Event], model: SessionModel, *, redetect: bool = False, progress: Progress | None = None
) -> ExtractedMeasurements:
    """Turn a session's events into measurements.

    Args:
        events: as read.
        model: the session's set-up.
        redetect: use the frames even where a pose is recorded.
        progress: called after each frame.

    Raises:
        InputError: a frame is missing or invalid.
    """
    found = _detect(events, model, redetect, progress)
    refused, by_hand = refused_lines(events), excluded_shots(events)
    taken = {index for index, event in enumerate(events) if event.line not in refused and event.line not in by_hand}
    marker_fits = [fit for index, fit in found.markers.items() if index in taken and isinstance(fit, MarkerFit)]
    board_fits = [fit for index, fit in found.boards.items() if index in taken and isinstance(fit, BoardFit)]
    builder = _Builder(
        model,
        found,
        pool_corner_noise(fit.pose for fit in marker_fits),
        pool_corner_noise(fit.pose for fit in board_fits),
        redetect,
    )
    starts, epoch_of = number_epochs(events, redetect=redetect)
    set_aside: dict[int, Aim | Pair | KnownPoint] = {}
    for index, event in enumerate(events):
        if event.line not in refused:
            builder.add(index, event, epoch_of[index])
            if event.line in by_hand:
                set_aside |= builder.take_out(index)
                builder.unused[index] = by_hand[event.line].text
        elif isinstance(event, AimEvent | PairEvent | TrackEvent | PointEvent | CheckEvent):
            builder.unused[index] = f"it was refused when it was taken: {refused[event.line]}"
    for index, check in [*builder.checks.items()]:
        if (reason := data_at(check, builder.points.values())) is not None:
            builder.unused[index] = reason
            del builder.checks[index]
    return ExtractedMeasurements(
        measurements=Measurements(tuple(builder.aims), tuple(builder.pairs), starts, tuple(builder.points.values())),
        tracks=tuple(builder.tracks),
        aim_events=tuple(builder.aim_events),
        pair_events=tuple(builder.pair_events),
        track_events=tuple(builder.track_events),
        unused=builder.unused,
        unused_aims=tuple(
            i for i in sorted(builder.unused) if isinstance(events[i], AimEvent) and events[i].line not in by_hand
        ),
        markers=found.markers,
        boards=found.boards,
        finds=found.finds,
        marker_noise=builder.marker_noise,
        board_noise=builder.board_noise,
        epoch_of=epoch_of,
        point_events=tuple(builder.points),
        checks=builder.checks,
        excluded=tuple(by_hand.values()),
        refused=refused_evidence(events),
        set_aside=set_aside,
    )


def number_epochs(events: Sequence[Event], *, redetect: bool = False) -> tuple[tuple[EpochStart, ...], tuple[int, ...]]:
    """Camera epochs, and the epoch of every event.

    An epoch starts with its ``camera_moved`` event (unless that was refused). A detected move starts its epoch at the
    first event at or after ``since_t``, but for looks that share the marker observation of an earlier one: they belong
    to its epoch, whenever their pulse came.
    """
    refused = refused_lines(events)
    first = events[0].t if events else 0.0
    starts = [EpochStart(min(0.0, first))]
    places: list[int] = []
    for index, event in enumerate(events):
        if not isinstance(event, CameraMovedEvent) or event.line in refused:
            continue
        since = event.since_t if event.detected and event.since_t is not None else event.t
        back = [i for i in range(index) if events[i].t >= since]
        place = back[0] if back else index
        before = {_observation(event, redetect=redetect) for event in events[:place] if isinstance(event, PairEvent)}
        while place < index and _shares(events[place], before, redetect=redetect):
            place += 1
        places.append(max(place, places[-1] if places else 0))
        starts.append(EpochStart(since, event.camera_new_T_camera_old, event.covariance))
    epoch_of = tuple(sum(place <= index for place in places) for index in range(len(events)))
    return tuple(starts), epoch_of


def _observation(event: PairEvent, *, redetect: bool) -> tuple[int, object]:
    return event.pm, _marker_key(event.marker, redetect=redetect)


def _shares(event: Event, before: set[tuple[int, object]], *, redetect: bool) -> bool:
    """Whether an event belongs before a move: a look with one of these marker observations, or a note."""
    if isinstance(event, PairEvent):
        return _observation(event, redetect=redetect) in before
    return not isinstance(event, AimEvent | TrackEvent | PointEvent | CheckEvent | CameraMovedEvent)


def _detect(events: Sequence[Event], model: SessionModel, redetect: bool, progress: Progress | None) -> FrameResults:
    if not any(needs_frames(event, redetect=redetect) for event in events):
        return FrameResults()
    from fgreg.detection.event_frames import detect_in_frames  # loads OpenCV, which poses and points do not need

    return detect_in_frames(events, model, redetect=redetect, progress=progress)


class _Builder:
    """Collects measurements event by event."""

    def __init__(
        self,
        model: SessionModel,
        found: FrameResults,
        marker_noise: CornerNoise,
        board_noise: CornerNoise,
        redetect: bool,
    ) -> None:
        self.model, self.found, self.redetect = model, found, redetect
        self.marker_noise, self.board_noise = marker_noise, board_noise
        self.aims: list[Aim] = []
        self.pairs: list[Pair] = []
        self.tracks: list[Track] = []
        self.aim_events: list[int] = []
        self.pair_events: list[int] = []
        self.track_events: list[int] = []
        self.checks: dict[int, Check] = {}
        self.points: dict[int, KnownPoint] = {}
        self.unused: dict[int, str] = {}
        self.ids: dict[object, int] = {}
        self.epochs: dict[tuple[int, int], int] = {}  # of the PMs' marker observations
        self.next_id = 0
        self.camera_matters = bool(model.constant_sigmas[CAMERA].any())

    def add(self, index: int, event: Event, epoch: int) -> None:
        """Turn one event into a measurement, or store the reason why not."""
        if isinstance(event, PointEvent):
            point = known_point(event, epoch, self.model)
            if isinstance(point, str):
                self.unused[index] = point
            else:
                self.points[index] = point
            return
        if isinstance(event, CheckEvent):
            check = check_measurement(event, epoch, self.model)
            if isinstance(check, str):
                self.unused[index] = check
            else:
                self.checks[index] = check
            return
        if not isinstance(event, AimEvent | PairEvent | TrackEvent):
            return
        marker = self._marker(index, event)
        if isinstance(marker, str):
            self.unused[index] = marker
            return
        if isinstance(event, AimEvent):
            spot = self._spot(index, event)
            if isinstance(spot, str):
                self.unused[index] = spot
                return
            self.aims.append(Aim(event.t, marker, *spot))
            self.aim_events.append(index)
            return
        looks: list[Look] = []
        for number, record in enumerate(looks_of(event)):
            look = self._look(index, number, record)
            if isinstance(look, str):
                self.unused[index] = look
            else:
                looks.append(look)
        if isinstance(event, PairEvent):
            spot_seen = None if event.spot is None else visible_spot(event.spot, self.model)
            if isinstance(spot_seen, str):
                self.unused[index] = spot_seen
            elif looks and self.epochs.setdefault((event.pm, marker.id), epoch) != epoch:
                self.unused[index] = of_earlier_epoch(event.pm)
            elif looks:
                offset_mm = self.model.noise_per_pm.beam_offset_mm
                self.pairs.append(Pair(event.t, event.pm, epoch, marker, looks[0], offset_mm, spot_seen))
                self.pair_events.append(index)
            return
        if event.looks and not looks:
            return  # no source found in any look: the reason is stored
        self.unused.pop(index, None)  # one look with a source is enough for a query
        scan = None if event.scan_deg is None else self.model.stage.scan_from_device(math.radians(event.scan_deg))
        self.tracks.append(Track(event.t, epoch, marker, tuple(looks), scan))
        self.track_events.append(index)

    def take_out(self, index: int) -> dict[int, Aim | Pair | KnownPoint]:
        """Take out what the event just added gave: its measurement by its index, or nothing."""
        if index in self.points:
            return {index: self.points.pop(index)}
        for events, measured in ((self.aim_events, self.aims), (self.pair_events, self.pairs)):
            if events and events[-1] == index:
                return {events.pop(): measured.pop()}
        return {}

    def _marker(self, index: int, event: AimEvent | PairEvent | TrackEvent) -> MarkerObservation | str:
        record = event.marker
        dependence = None
        if needs_marker_frames(record, redetect=self.redetect):
            fit = self.found.markers[index]
            if isinstance(fit, NotFound):
                return fit.reason
            transform, covariance = fit.camera_T_marker, marker_covariance(fit, self.marker_noise)
            dependence = fit.pose.dependence
        else:
            if record.camera_T_marker is None:
                raise AssertionError("a marker is a pose or frames")
            transform = record.camera_T_marker
            dependence = nominal_pose_dependence(self.model, transform) if self.camera_matters else None
            covariance = (
                default_marker_covariance(transform, self.model.noise)
                if record.covariance is None
                else record.covariance
            )
        key = _marker_key(record, redetect=self.redetect)
        if key not in self.ids:
            self.ids[key] = self.next_id
            self.next_id += 1
        number = self.ids[key]
        pose, covariance = as_float_array(transform, 4, 4), as_float_array(covariance, 6, 6)
        marker = MarkerObservation(pose, covariance, number, dependence)
        return marker_problem(marker) or marker

    def _spot(self, index: int, event: AimEvent) -> tuple[FloatArray, FloatArray, CameraDependence | None] | str:
        """The aimed-at spot (3,) mm, camera frame, its covariance (3, 3), which includes the laser's error, and how
        it depends on the rig's constants."""
        laser = np.diag(np.square(self.model.noise.aim_mm))
        if event.camera_p_spot_mm is not None:
            spot = event.camera_p_spot_mm
            dependence = nominal_spot_dependence(self.model, spot) if self.camera_matters else None
            given = laser if event.covariance is None else event.covariance
            return spot_problem(spot, given) or (spot, given, dependence)
        fit = self.found.boards[index]
        if isinstance(fit, NotFound):
            return fit.reason
        if event.corner is None:
            raise AssertionError("an aim has a spot or a corner")
        spot, covariance = board_corner(fit, event.corner[0], event.corner[1], self.board_noise)
        camera_R_board = fit.camera_T_board[:3, :3]
        dependence = board_corner_dependence(fit, event.corner[0], event.corner[1])
        whole = covariance + camera_R_board @ laser @ camera_R_board.T
        return spot_problem(spot, whole) or (spot, whole, dependence)

    def _look(self, index: int, number: int, record: TrusRecord) -> Look | str:
        noise, stage = self.model.noise, self.model.stage
        covariance = record.covariance
        x_mm, range_mm, amplitude = record.x_mm, record.range_mm, record.amplitude
        usual = np.diag([noise.lateral_mm**2, noise.range_mm**2])
        others = tuple(
            OtherPosition(other.x_mm, other.range_mm, usual if other.covariance is None else other.covariance)
            for other in record.others
        )
        wavefront = None
        if x_mm is None or range_mm is None:
            find = self.found.finds[index, number]
            if isinstance(find, NoSignal):
                return find.reason
            x_mm, range_mm = find.x_mm, find.range_mm
            covariance = find.covariance if covariance is None else covariance
            amplitude = find.amplitude if amplitude is None else amplitude
            others = tuple(OtherPosition(other.x_mm, other.range_mm, other.covariance) for other in find.others)
            wavefront = find.wavefront
        look = Look(
            scan_rad=stage.scan_from_device(math.radians(record.scan_deg)),
            scan_sigma_rad=noise.scan_rad,
            x_mm=x_mm,
            range_mm=range_mm,
            covariance=as_float_array(usual if covariance is None else covariance, 2, 2),
            sweep=stage.direction * record.sweep,
            amplitude=amplitude,
            window_sigma_rad=self.model.noise_per_pm.window_rad,
            others=others,
            wavefront=wavefront,
        )
        return look_problem(look) or look


class MeasurementExtractor:
    """Turns events into measurements one by one; corner noise is pooled over the frames up to now.

    The measurement of an event depends only on the accepted aims and pairs before it. The same events therefore give
    the same measurements, however often a session is interrupted.
    """

    def __init__(self, model: SessionModel) -> None:
        nothing = pool_corner_noise(())
        self._builder = _Builder(model, FrameResults(), nothing, nothing, redetect=False)
        self._markers: list[Misfit] = []
        self._boards: list[Misfit] = []
        self._before = (0, 0)

    def add(self, event: AimEvent | PairEvent | TrackEvent, epoch: int) -> Aim | Pair | Track | str:
        """The event as a measurement in camera epoch ``epoch``, or the reason why there is none.

        A query does not change the state.

        Raises:
            InputError: a frame is missing or invalid.
        """
        builder = self._builder
        found = builder.found = _detect([event], builder.model, redetect=False, progress=None)
        self._before = len(self._markers), len(self._boards)
        self._markers += [_misfit(fit.pose) for fit in found.markers.values() if isinstance(fit, MarkerFit)]
        self._boards += [_misfit(fit.pose) for fit in found.boards.values() if isinstance(fit, BoardFit)]
        if found.markers or found.boards:
            self._pool()
        builder.add(0, event, epoch)
        made: list[Aim | Pair | Track] = [*builder.aims, *builder.pairs, *builder.tracks]
        reason = builder.unused.get(0, "")
        for shots in (builder.aims, builder.pairs, builder.tracks):
            shots.clear()
        for numbers in (builder.aim_events, builder.pair_events, builder.track_events):
            numbers.clear()
        builder.unused.clear()
        if isinstance(event, TrackEvent):
            self.take_back()
        return made[0] if made else reason

    def take_back(self) -> None:
        """Undo the last event: it was not accepted, and is absent when the session is opened again."""
        if self._before != (len(self._markers), len(self._boards)):
            del self._markers[self._before[0] :], self._boards[self._before[1] :]
            self._pool()

    def _pool(self) -> None:
        self._builder.marker_noise = pool_corner_noise(self._markers)
        self._builder.board_noise = pool_corner_noise(self._boards)


def _misfit(fit: Weighed) -> Misfit:
    return Misfit(float(fit.cost), int(fit.dof))
