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
from fgreg.camera_moves.detector import LoopClosure
from fgreg.camera_moves.loop_closure import back_to
from fgreg.config import SolveConfig
from fgreg.errors import EventRefused
from fgreg.estimate import TrackEstimate, Verdict
from fgreg.frames import FloatArray, make_transform, rotation_to_direction
from fgreg.measurements import Aim, EpochStart, Measurements, Pair, Track
from fgreg.models import SessionModel
from fgreg.online.checks import check
from fgreg.online.estimate import OnlineEstimate, gaussian_tre
from fgreg.online.events import CameraMoved, DetectedMove, DetectedReturn, OnlineEvent, StaticTags
from fgreg.online.guard import MoveGuard, WatchKind
from fgreg.online.judge import Case, DeferredJudge, InlineJudge, Judge, Judgement, ProcessJudge, judge
from fgreg.online.numbers import Sink, Source
from fgreg.online.rest import Noticed, Rest, rested, with_effort
from fgreg.online.rest_codec import read_rest, write_rest
from fgreg.online.restart import Tools, all_measurements
from fgreg.online.shared import POSE
from fgreg.online.state import EpochData, Recent, State, kept_by_place, make_setting
from fgreg.online.store import MeasurementStore
from fgreg.online.tag_guard import TagsMoved, TagsRest
from fgreg.online.tie import with_motion
from fgreg.online.tracking import online_snapshot
from fgreg.online.updates import is_kept, with_aim, with_move, with_pair
from fgreg.registration import SoundSpeedPrior
from fgreg.surface import TissueSurface
from fgreg.tracking import Snapshot, track
from fgreg.verdict import accuracy

NOT_JUDGED = "this camera epoch has not been judged by the full solve yet: take the estimate as preliminary"
NO_REGISTRATION = "no registration of this camera epoch"


class OnlineRegistration:
    """Registers while the session goes on.

    Args:
        model: the session's set-up.
        config: settings of estimate and verdict.
        judge: ``inline`` judges within ``add`` at fixed counts of pairs (deterministic, some tenths of a second each),
            ``process`` in a process of its own (adopted when ready), None never.
        watch: how camera moves that nobody tells are looked for: ``inline`` within ``add`` (deterministic), ``process``
            in a process of its own (an alarm is adopted with the next event), None not at all.
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
        watch: WatchKind | None = "inline",
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
        self._surface: TissueSurface | None = None
        kinds: dict[str, Callable[[], Judge]] = {
            "inline": lambda: InlineJudge(model, self._config, sound_speed_prior),
            "process": lambda: ProcessJudge(model, self._config, sound_speed_prior),
        }
        if judge is not None and judge not in kinds:
            raise ValueError(f"judge is {judge!r}, expected 'inline', 'process' or None")
        self._guard = MoveGuard(watch, model, self._config, sound_speed_prior, self._tools.setting)
        self._moves: list[DetectedMove] = []
        self._returns: list[DetectedReturn] = []
        self._noticed: dict[int, str] = {}
        self._suspicion = ""
        self._judge: Judge | None = None if judge is None else kinds[judge]()
        self._on_schedule = judge != "process"
        self._estimate = self._report(self._state, 0.0, None)

    def __enter__(self) -> OnlineRegistration:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End the processes beside it, where there are any; the estimate stays."""
        self._guard.close()
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
        if not isinstance(event, CameraMoved):  # what is told comes before what is still being looked at
            self._adopt_found(event.t)
        before = self._state
        try:
            guard, said = self._guard.see(event) if isinstance(event, StaticTags) else (None, None)
            state = rested(with_effort(self._next(event, said)), self._tools.setting)
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
        if moved:
            self._guard.epoch_began(by_tags=guard is not None)
            if self._suspicion:
                self._suspicion = ""
                self._estimate = self._report(state, event.t, self._judgement)
        if guard is not None:
            self._guard.keep(guard)
        if isinstance(said, TagsMoved):
            self._note_move(before, state.now.first, said.since_t, event.t, None)
        elif isinstance(event, CameraMoved) and event.detected and event.since_t is not None:
            self._note_move(before, state.now.first, event.since_t, event.t, None, recorded=True)
        elif isinstance(event, Pair):
            self._guard.look(state, self._tools.store)
            moved = self._adopt_found(event.t) or moved
        self._consult(ask=moved or isinstance(said, TagsRest) or isinstance(event, Pair | Aim))
        return self._estimate

    def _next(self, event: OnlineEvent, said: TagsMoved | TagsRest | None) -> State:
        state = replace(self._state, steps=self._state.steps + 1)
        if isinstance(event, Pair):
            return with_pair(state, event, self._tools)
        if isinstance(event, Aim):
            return with_aim(state, event, self._tools)
        if isinstance(event, CameraMoved):
            start = EpochStart(event.t, event.camera_new_T_camera_old, event.covariance)
            if event.since_t is not None:
                return with_move(state, replace(start, t=event.since_t), self._tools, self._pairs_since(event.since_t))
            if self._noticed.get(state.epoch) and (state.window is None or not state.epoch_pairs):
                # Whether this is the move that was found out, or another, is not known: the motion of neither is.
                start = EpochStart(event.t)
            return with_move(state, start, self._tools)
        if isinstance(said, TagsMoved):
            return with_move(state, EpochStart(said.since_t), self._tools, self._pairs_since(said.since_t))
        if isinstance(said, TagsRest):
            start = EpochStart(state.now.start.t, said.camera_new_T_camera_old, said.covariance)
            return with_motion(state, start, self._tools)
        return replace(state, nis=None, used=False)

    def _pairs_since(self, t: float) -> int:
        """How many of the epoch's pairs were taken at a time or later."""
        store, first = self._tools.store, self._state.now.first
        return sum(store.time(place) >= t for place in range(first, self._state.pairs))

    def reassign(self, last: int, start: EpochStart) -> OnlineEstimate:
        """A new epoch to which the last so many pairs belong already: the camera moved before them, untold.

        Raises:
            EventRefused: they are not all of the epoch that lasts, or the update failed; nothing has changed then.
        """
        if not 0 <= last <= self._state.epoch_pairs:
            raise EventRefused(f"{last} pairs are to be reassigned, of {self._state.epoch_pairs} in the epoch")
        try:
            self._reassign(last, start)
        except Exception as error:
            raise EventRefused(f"the update failed: {type(error).__name__}: {error}") from error
        self._consult(ask=True)
        return self._estimate

    def _reassign(self, last: int, start: EpochStart) -> None:
        nis, place = self._state.nis, self._state.pairs - 1
        state = with_effort(with_move(replace(self._state, steps=self._state.steps + 1), start, self._tools, last))
        state = replace(state, nis=nis, used=nis is not None and is_kept(state, place))
        estimate = self._report(state, max(self._t, start.t), self._judgement)
        self._state, self._estimate = state, estimate
        self._serial += 1
        self._guard.epoch_began()
        self._suspicion = ""

    def _adopt_found(self, t: float) -> bool:
        """Begin a new epoch, or tie the one that lasts to an earlier one, where the watch says so; whether it does."""
        before = self._state
        found = self._guard.found(before)
        if found is None:
            return False
        if isinstance(found, LoopClosure):
            return self._go_back(found, t)
        since_t = self._tools.store.time(found.first)
        try:
            self._reassign(before.pairs - found.first, EpochStart(since_t))
        except Exception as error:  # the old registration is not to be trusted, and there is no new one
            self._suspicion = f"the camera has moved, and its pairs cannot be given to a new epoch: {error}"
            self._estimate = self._report(before, self._estimate.t, self._judgement)
            return False
        self._note_move(before, found.first, since_t, t, found.log_bayes)
        return True

    def _go_back(self, found: LoopClosure, t: float) -> bool:
        before = self._state
        start = back_to(before.now.start, found.to)
        try:
            state = with_motion(replace(before, steps=before.steps + 1), start, self._tools)
            state = replace(state, nis=before.nis, used=before.used)
            self._estimate = self._report(state, self._estimate.t, None)
        except Exception:  # it is the same camera epoch without it, only less well known
            return False
        self._returns.append(DetectedReturn(before.epoch, found.to, t, found.log_bayes))
        self._state, self._serial, self._judgement = state, self._serial + 1, None
        return True

    def _note_move(
        self, before: State, first: int, since_t: float, t: float, log_bayes: float | None, *, recorded: bool = False
    ) -> None:
        """Tell of a move that was found out, now or (``recorded``) when the session was recorded."""
        last_t = self._tools.store.time(first - 1) if first else before.now.start.t
        move = DetectedMove(before.epoch - len(self._moves), first, since_t, last_t, t, log_bayes)
        if not recorded:
            self._moves.append(move)
        self._noticed[self._state.epoch] = move.text
        self._estimate = self._report(self._state, self._estimate.t, self._judgement)

    def _consult(self, *, ask: bool) -> None:
        """Ask the judge, adopt what it answers."""
        if self._judge is None:
            return
        if ask:
            self._judge.ask(self._case, self._state.epoch_pairs)
        found = self._judge.answer()
        if found is not None:
            self._surface = found.surface or self._surface
            if found.epoch == self._state.epoch:
                self._judgement = found
        if self._judge.failure or found is not None:
            self._estimate = self._report(self._state, self._estimate.t, self._judgement)

    def _case(self) -> Case:
        return Case(self._serial, self._state.epoch, self.measurements())

    @contextmanager
    def catching_up(self) -> Iterator[None]:
        """While many events of before are taken in again: judged once, at the end.

        ``inline`` judges where the last judgement was due: what is reported afterwards is what it reports after the
        same events, but for the time that it takes. ``process`` judges all of it, and so does ``inline`` where nothing
        was due since a rest of such an engine. Moves that were found out are among the events; only after the last one
        they are looked for again.
        """
        usual, deferred = self._judge, DeferredJudge()
        self._judge = deferred if usual is not None and self._on_schedule else None
        self._guard.pause()
        self._caught = None
        try:
            yield
        finally:
            self._judge = usual
        if self._guard.resume(self._state, self._tools.store):
            self._adopt_found(self._t)
        case = deferred.case
        if case is None and usual is not None and self._serial and (self._judgement is None or not self._on_schedule):
            case = self._case()
        if case is not None:
            found, _ = judge(case, self._model, self._config, self._prior)
            self._caught, self._surface = found, found.surface or self._surface
            if found.epoch == self._state.epoch:
                self._judgement = found
                self._estimate = self._report(self._state, self._estimate.t, found)

    def rest(self) -> Callable[[Sink], None] | None:
        """What writes down the engine as it is now (at any later time), where the last event ended with a rest.

        What a judging process says comes when it comes, and is not written: whoever goes on from here judges anew.
        """
        state = self._state
        if state.window is None or state.window.seed is None:
            return None
        noticed = Noticed(tuple(self._moves), tuple(self._returns), self._suspicion)
        judgement = self._judgement if self._on_schedule else None
        found = Rest(state, self._t, self._serial, self._estimate.t, judgement, self._surface, noticed)
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
        self._moves, self._returns = list(rest.noticed.moves), list(rest.noticed.returns)
        self._noticed, self._suspicion = rest.noticed.texts(), rest.noticed.suspicion
        self._estimate = self._report(self._state, rest.estimate_t, rest.judgement)
        return self._estimate

    # --- what is known ----------------------------------------------------------------------------------------------

    @property
    def estimate(self) -> OnlineEstimate:
        """The latest."""
        return self._estimate

    def refresh(self) -> OnlineEstimate:
        """Adopt what the judge, and the watch for moves, have found since, without an event."""
        self._consult(ask=self._adopt_found(self._t))
        return self._estimate

    @property
    def moves(self) -> tuple[DetectedMove, ...]:
        """Camera moves that were found out, in the order of time; their epochs are numbered as told."""
        return tuple(self._moves)

    @property
    def returns(self) -> tuple[DetectedReturn, ...]:
        """Epochs in which the camera was found to be back where it was, in the order of time."""
        return tuple(self._returns)

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
        return tuple(kept_by_place(self._state).tolist())

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
        if self._judge is not None:
            self._judge.forgive()
        self._judgement, self._surface = found, found.surface or self._surface
        self._estimate = self._report(self._state, self._estimate.t, found)
        return solution

    def track(self, query: Track) -> TrackEstimate:
        """Answer a query from the estimate as it is; the graph is not touched."""
        self._adopt_found(self._t)
        return track(query, self.snapshot())

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
        """The estimate of a state, with what the judge said of its epoch, and what is known of moves."""
        estimate = self._judged(state, t, found)
        known = [(Verdict.REFUSED, self._suspicion), (Verdict.WARNING, self._noticed.get(state.epoch, ""))]
        if self._guard.failure:
            text = f"camera moves are not looked for: {self._guard.failure}; tell them by camera_moved"
            known.append((Verdict.WARNING, text))
        if self._judge is not None and self._judge.failure:
            text = f"the full solve failed: {self._judge.failure}: what it said before may hold no longer"
            known.append((Verdict.WARNING, text))
        told = [(verdict, text) for verdict, text in known if text]
        if not told:
            return estimate
        verdict = max(estimate.verdict, *(verdict for verdict, _ in told), key=lambda v: v.severity)
        return replace(estimate, verdict=verdict, reasons=(*(text for _, text in told), *estimate.reasons))

    def _judged(self, state: State, t: float, found: Judgement | None) -> OnlineEstimate:
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
