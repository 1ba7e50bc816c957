"""The online registration: events in, estimates out.

Marker poses, PMs, lambda and theta' of recent pairs are variables in ISAM2, with the factors of the reference graph
(fgreg.online.window); older pairs are summed up in chunks that are linearised anew in turn (fgreg.online.summary).
An event either becomes part of the state or, whatever fails on the way, leaves it as it was.

The incremental state is a function of the sequence of events only. The judge decides what is *reported* beside it: the
shift from optimum to posterior mean, the widening of the covariance at few pairs, the verdict and its reasons.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from types import TracebackType
from typing import Literal

import gtsam
import numpy as np

from fgreg.batch import Solution
from fgreg.config import SolveConfig
from fgreg.errors import EventRefused
from fgreg.estimate import TrackEstimate, Verdict
from fgreg.frames import FloatArray, is_rigid, make_transform, rotation_to_direction
from fgreg.measurements import Aim, EpochStart, MarkerObservation, Measurements, Pair, Track
from fgreg.models import SessionModel
from fgreg.online.estimate import OnlineEstimate, gaussian_tre
from fgreg.online.events import CameraMoved, OnlineEvent, StaticTags
from fgreg.online.judge import Case, DeferredJudge, InlineJudge, Judge, Judgement, ProcessJudge, judge
from fgreg.online.numbers import Sink, Source
from fgreg.online.rest import Rest, rested, with_effort
from fgreg.online.rest_codec import read_rest, write_rest
from fgreg.online.restart import Tools, all_measurements
from fgreg.online.shared import POSE
from fgreg.online.state import EpochData, Recent, State, make_setting
from fgreg.online.store import MeasurementStore
from fgreg.online.tracking import online_snapshot
from fgreg.online.updates import with_aim, with_move, with_pair
from fgreg.registration import SoundSpeedPrior
from fgreg.tracking import Snapshot, SurfaceMap, fast_track
from fgreg.verdict import accuracy

INT64 = 2**63
NOT_JUDGED = "this camera epoch has not been judged by the full solve yet: take the estimate as preliminary"
NO_REGISTRATION = "no registration of this camera epoch"


class OnlineRegistration:
    """Registers while the session goes on.

    Args:
        model: the session's set-up.
        config: settings of estimate and verdict.
        judge: ``inline`` judges within ``add`` at fixed counts of pairs (deterministic, some tenths of a second each),
            ``process`` in a process of its own (adopted when ready), None never.
        sound_speed_prior: what is known of the sound speed ratio, where the configuration makes it a variable.
        start: of the first epoch.

    Raises:
        ValueError: the configuration asks for something that there is no online form of.
    """

    def __init__(
        self,
        model: SessionModel,
        config: SolveConfig | None = None,
        *,
        judge: Literal["inline", "process"] | None = "inline",
        sound_speed_prior: SoundSpeedPrior | None = None,
        start: EpochStart | None = None,
    ) -> None:
        self._model, self._config, self._prior = model, config or SolveConfig(), sound_speed_prior
        self._tools = Tools(make_setting(model, self._config, sound_speed_prior), self._config, MeasurementStore())
        self._state = State((EpochData(start or EpochStart(0.0), 0),))
        self._t = -math.inf
        self._serial = 0
        self._judgement: Judgement | None = None
        self._caught: Judgement | None = None
        self._snapshot: tuple[OnlineEstimate, Snapshot] | None = None
        self._surface: SurfaceMap | None = None
        kinds: dict[str, Callable[[], Judge]] = {
            "inline": lambda: InlineJudge(model, self._config, sound_speed_prior),
            "process": lambda: ProcessJudge(model, self._config, sound_speed_prior),
        }
        if judge is not None and judge not in kinds:
            raise ValueError(f"judge is {judge!r}, expected 'inline', 'process' or None")
        self._judge = None if judge is None else kinds[judge]()
        self._estimate = self._report(self._state, 0.0, None)

    def __enter__(self) -> OnlineRegistration:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End the judging process, where there is one; the estimate stays."""
        if self._judge is not None:
            self._judge.close()
            self._judge = None

    # --- events -----------------------------------------------------------------------------------------------------

    def add(self, event: OnlineEvent) -> OnlineEstimate:
        """Take in one event.

        A pair's own ``epoch`` is not looked at: it belongs to the epoch that lasts.

        Raises:
            EventRefused: the event cannot be taken in, or the update failed; everything is as it was before.
        """
        check(event, self._t)
        before = self._state
        try:
            state = rested(with_effort(self._next(event)), self._tools.setting)
            estimate = self._report(state, event.t, self._judgement)
        except EventRefused:
            raise
        except Exception as error:  # whatever failed, the state before still stands
            raise EventRefused(f"the update failed: {type(error).__name__}: {error}") from error
        # From here on nothing fails: what the event brought is kept.
        if isinstance(event, Pair):
            self._tools.store.append(event)
        elif isinstance(event, Aim):
            self._tools.store.append_aim(event)
        self._state, self._t = state, event.t
        self._serial += 1
        moved = state.epoch != before.epoch
        self._estimate = estimate
        self._consult(ask=moved or isinstance(event, Pair | Aim))
        return self._estimate

    def _next(self, event: OnlineEvent) -> State:
        state = replace(self._state, steps=self._state.steps + 1)
        if isinstance(event, Pair):
            return with_pair(state, event, self._tools)
        if isinstance(event, Aim):
            return with_aim(state, event, self._tools)
        if isinstance(event, CameraMoved):
            last = 0
            if event.since_t is not None:
                store, first = self._tools.store, state.now.first
                last = sum(store.time(place) >= event.since_t for place in range(first, state.pairs))
            start = EpochStart(event.t, event.camera_new_T_camera_old, event.covariance)
            return with_move(state, start, self._tools, last)
        return replace(state, nis=None, used=False)  # what tags tell is read by the test for moves

    def reassign(self, last: int, start: EpochStart) -> OnlineEstimate:
        """A new epoch to which the last so many pairs belong already: the camera moved before them, untold.

        Raises:
            EventRefused: they are not all of the epoch that lasts, or the update failed; nothing has changed then.
        """
        if not 0 <= last <= self._state.epoch_pairs:
            raise EventRefused(f"{last} pairs are to be reassigned, of {self._state.epoch_pairs} in the epoch")
        try:
            state = with_effort(with_move(replace(self._state, steps=self._state.steps + 1), start, self._tools, last))
            estimate = self._report(state, max(self._t, start.t), self._judgement)
        except Exception as error:
            raise EventRefused(f"the update failed: {type(error).__name__}: {error}") from error
        self._state, self._estimate = state, estimate
        self._serial += 1
        self._consult(ask=True)
        return self._estimate

    def _consult(self, *, ask: bool) -> None:
        """Ask the judge, adopt what it answers."""
        if self._judge is None:
            return
        try:
            if ask:
                self._judge.ask(self._case, self._state.epoch_pairs)
            found = self._judge.answer()
        except Exception as error:  # the estimate stands without the judge
            text = f"the full solve failed: {type(error).__name__}: {error}"
            self._estimate = replace(
                self._estimate,
                reasons=(*self._estimate.reasons, text),
                verdict=max(self._estimate.verdict, Verdict.WARNING, key=lambda v: v.severity),
            )
            return
        if found is not None:
            self._surface = found.surface or self._surface
        if found is not None and found.epoch == self._state.epoch:
            self._judgement = found
            self._estimate = self._report(self._state, self._estimate.t, found)

    def _case(self) -> Case:
        return Case(self._serial, self._state.epoch, self.measurements())

    @contextmanager
    def catching_up(self) -> Iterator[None]:
        """While many events of before are taken in again: judged once, at the end, where the last judgement was due.

        What is reported afterwards is what ``inline`` reports after the same events, but for the time that it takes.
        """
        usual, deferred = self._judge, DeferredJudge()
        self._judge = None if usual is None else deferred
        self._caught = None
        try:
            yield
        finally:
            self._judge = usual
        if deferred.case is not None:
            found, _ = judge(deferred.case, self._model, self._config, self._prior)
            self._caught, self._surface = found, found.surface or self._surface
            if found.epoch == self._state.epoch:
                self._judgement = found
                self._estimate = self._report(self._state, self._estimate.t, found)

    def rest(self) -> Callable[[Sink], None] | None:
        """What writes down the engine as it is now (at any later time), where the last event ended with a rest."""
        state = self._state
        if state.window is None or state.window.seed is None:
            return None
        found = Rest(state, self._t, self._serial, self._estimate.t, self._judgement, self._surface)
        if isinstance(self._judge, DeferredJudge):
            return partial(self._write_caught, found, self._judge.case)
        return partial(self._write, found)

    def _write(self, rest: Rest, sink: Sink) -> None:
        write_rest(sink, rest, self._tools.store.aims, self._tools.store)

    def _write_caught(self, rest: Rest, case: Case | None, sink: Sink) -> None:
        """Write a rest from :meth:`catching_up`, judged as it was due up to there."""
        if case is not None:
            found = self._caught
            if found is None or found.serial != case.serial:
                found, _ = judge(case, self._model, self._config, self._prior)
            rest = replace(rest, judgement=found, surface=found.surface or rest.surface)
        self._write(rest, sink)

    def resume(self, source: Source) -> OnlineEstimate:
        """Go on from a rest of an engine with the same model and configuration; the source has to end with it.

        Raises:
            ValueError: it holds something else, or this engine has taken in something already.
            RuntimeError, ArithmeticError: the window cannot be opened.
        """
        if self._serial:
            raise ValueError("events were taken in already")
        rest, store = read_rest(source, self._tools.setting)
        source.finish()
        self._tools = replace(self._tools, store=store)
        self._state, self._t, self._serial = rest.state, rest.t, rest.serial
        self._judgement, self._surface = rest.judgement, rest.surface
        self._estimate = self._report(self._state, rest.estimate_t, rest.judgement)
        return self._estimate

    # --- what is known ----------------------------------------------------------------------------------------------

    @property
    def estimate(self) -> OnlineEstimate:
        """The latest."""
        return self._estimate

    def refresh(self) -> OnlineEstimate:
        """Adopt what the judge has found since, without an event."""
        self._consult(ask=False)
        return self._estimate

    @property
    def recent(self) -> tuple[Recent, ...]:
        """The last pairs' quadratics and what was known before each, oldest first: for tests on moves."""
        return self._state.recent

    @property
    def state(self) -> State:
        """The incremental state; a value, never changed in place."""
        return self._state

    @property
    def kept(self) -> tuple[bool, ...]:
        """Whether each pair counts, in the order in which they came."""
        out = [False] * self._state.pairs
        for data in self._state.epochs:
            for chunk in data.shelf.chunks:
                for place, pm in zip(chunk.places.tolist(), chunk.problem.look_pm.tolist(), strict=True):
                    out[place] = bool(chunk.kept[pm])
        for group in self._state.window.groups if self._state.window is not None else ():
            for place in group.bundle.places:
                out[place] = group.kept
        return tuple(out)

    def measurements(self) -> Measurements:
        """All that was taken in, as the batch solve takes it."""
        return all_measurements(self._state, self._tools.store)

    def marker_T_laser(self) -> FloatArray | None:
        """(4, 4) the beam as the present epoch's estimate has it, origin by its chart; None where there is none yet."""
        if self._state.window is None:
            return None
        shared = self._state.window.state
        return make_transform(rotation_to_direction(shared.beam_direction()[0]), shared.beam_origin()[0])

    def settle(self) -> OnlineEstimate:
        """Judge now, by the full solve of everything so far; the estimate is then that solve's."""
        self.solution()
        return self._estimate

    def solution(self) -> Solution:
        """The full solve of everything so far, adopted as :meth:`settle` does."""
        found, solution = judge(self._case(), self._model, self._config, self._prior)
        self._judgement, self._surface = found, found.surface or self._surface
        self._estimate = self._report(self._state, self._estimate.t, found)
        return solution

    def track(self, query: Track) -> TrackEstimate:
        """Answer a query from the estimate as it is; the graph is not touched."""
        return fast_track(query, self.snapshot())

    def snapshot(self) -> Snapshot:
        """All that queries need of the estimate as it is; made once per event, on demand."""
        if self._snapshot is None or self._snapshot[0] is not self._estimate:
            window = self._state.window
            optimum = None if window is None else (window.state, window.covariance, self._tools.setting.columns)
            made = online_snapshot(self._model, self._config, self._estimate, optimum, self._surface)
            self._snapshot = (self._estimate, made)
        return self._snapshot[1]

    # --- reporting --------------------------------------------------------------------------------------------------

    def _report(self, state: State, t: float, found: Judgement | None) -> OnlineEstimate:
        """The estimate of a state, with what the judge said of its epoch."""
        if found is not None and found.epoch != state.epoch:
            found = None
        exact = found is not None and found.serial == self._serial and state is self._state
        window = state.window
        optimum = None if window is None else window.state.trus_T_camera()[0]
        count = _looks_kept(state)
        if exact and found is not None:
            return OnlineEstimate(
                t, state.epoch, found.trus_T_camera, found.covariance, found.predicted_tre, state.nis, state.used,
                found.verdict, found.reasons, found.pairs, optimum, True,
            )  # fmt: skip
        if window is None or optimum is None:
            why = state.why_none or "take pairs"
            reason = f"{NO_REGISTRATION}: {why}"
            return OnlineEstimate(
                t, state.epoch, None, None, None, state.nis, state.used, Verdict.REFUSED, (reason,), count, None, False
            )
        covariance = window.covariance[POSE, POSE]
        pose = optimum
        verdict: Verdict = Verdict.WARNING
        reasons: tuple[str, ...] = (NOT_JUDGED,)
        if state.is_open:
            verdict, reasons = (
                Verdict.REFUSED,
                ("two registrations explain these pairs equally well: take more", *reasons),
            )
        if found is not None:
            covariance, shift = found.applied(covariance)
            if np.any(shift):
                pose = optimum @ gtsam.Pose3.Expmap(shift).matrix()
            verdict, reasons = found.verdict, found.reasons
        tre = gaussian_tre(covariance, pose, self._model.targets_mm)
        if not (math.isfinite(tre.worst_mm) and np.isfinite(pose).all()):
            raise ArithmeticError("the reported registration is not finite")
        for condition in accuracy(tre, self._config):
            if condition.verdict.severity > verdict.severity or found is None:
                verdict = max(verdict, condition.verdict, key=lambda v: v.severity)
                reasons = (*reasons, condition.text)
        return OnlineEstimate(
            t, state.epoch, pose, covariance, tre, state.nis, state.used, verdict, reasons, count, optimum, False
        )


def _looks_kept(state: State) -> int:
    """Looks of the epoch that lasts that count."""
    kept = sum(len(group.bundle.pairs) for group in (state.window.groups if state.window else ()) if group.kept)
    return kept + state.now.shelf.counts[2]


# --- checks ---------------------------------------------------------------------------------------------------------


def check(event: OnlineEvent, after: float) -> None:
    """Refuse what must not reach the graph: numbers that are not finite, shapes, times that go back.

    Raises:
        EventRefused: with what was found.
    """
    if not isinstance(event, Aim | Pair | CameraMoved | StaticTags):
        raise EventRefused(f"a {type(event).__name__} is no event of a registration")
    if not math.isfinite(event.t):
        raise EventRefused(f"its time is {event.t}, expected a number")
    if event.t < after:
        raise EventRefused(f"its time is {event.t} s, before the last event's {after} s")
    if isinstance(event, Aim | Pair):
        _check_marker(event.marker)
    if isinstance(event, Aim):
        _array("camera_p_spot_mm", event.camera_p_spot_mm, (3,))
        _covariance("covariance of the spot", event.covariance, 3)
    elif isinstance(event, Pair):
        look = event.look
        for name in ("scan_rad", "scan_sigma_rad", "x_mm", "range_mm"):
            if not math.isfinite(getattr(look, name)):
                raise EventRefused(f"{name} is {getattr(look, name)}, expected a number")
        if look.range_mm <= 0.0:
            raise EventRefused(f"range_mm is {look.range_mm}, expected a number > 0")
        if look.amplitude is not None and not math.isfinite(look.amplitude):
            raise EventRefused(f"amplitude is {look.amplitude}, expected a number")
        if look.sweep not in (-1, 0, 1):
            raise EventRefused(f"sweep is {look.sweep}, expected -1, 0 or 1")
        _covariance("covariance of the look", look.covariance, 2)
        for name, number in (("pm", event.pm), ("marker id", event.marker.id)):
            if not -INT64 <= number < INT64:
                raise EventRefused(f"{name} is {number}, expected a number of 64 bits")
    elif isinstance(event, CameraMoved):
        if event.camera_new_T_camera_old is not None:
            _transform("camera_new_T_camera_old", event.camera_new_T_camera_old)
        if event.covariance is not None:
            _covariance("covariance of the motion", event.covariance, 6)
    else:
        for tag, pose in event.camera_T_tag.items():
            _transform(f"camera_T_tag of tag {tag}", pose)


def _check_marker(marker: MarkerObservation) -> None:
    _transform("camera_T_marker", marker.camera_T_marker)
    _covariance("covariance of the marker", marker.covariance, 6)


def _array(name: str, value: FloatArray, shape: tuple[int, ...]) -> None:
    if np.shape(value) != shape:
        raise EventRefused(f"{name} has shape {np.shape(value)}, expected {shape}")
    if not np.isfinite(value).all():
        raise EventRefused(f"{name} has an entry that is not finite")


def _transform(name: str, value: FloatArray) -> None:
    _array(name, value, (4, 4))
    if not is_rigid(value):
        raise EventRefused(f"{name} is no rigid transform")


def _covariance(name: str, value: FloatArray, size: int) -> None:
    _array(name, value, (size, size))
    scale = float(np.abs(value).max())
    if np.abs(value - value.T).max() > 1e-6 * scale or (np.diag(value) < 0).any():
        raise EventRefused(f"{name} is not symmetric with variances >= 0")
