"""The online registration: events in, estimates out.

Recent pairs are factors in iSAM2, everything older is one marginal prior (fgreg.smoother). An event either becomes part
of the state or, where the update fails, leaves the state as it was.

In addition the full solve (fgreg.online.full_solve) registers all measurements without an initial guess: at the first
pairs of an epoch, when a shot does not fit, and from time to time. The engine takes over its optimum and inliers. The
full solve also decides what is *reported*: the shift from optimum to posterior mean, the covariance at few pairs, the
verdict and its reasons. Before it, every pair is tested for an unreported camera move.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import TracebackType

from fgreg.camera_moves.detector import CameraMove, LoopClosure
from fgreg.camera_moves.found import DetectedLoopClosure, DetectedMove
from fgreg.camera_moves.loop_closure import back_to
from fgreg.camera_moves.static_tags import TagFrame, TagMonitor, TagsAtRest, TagSettings, TagsMoved, monitored
from fgreg.errors import EventRefused
from fgreg.geometry.transforms import FloatArray, make_transform, rotation_to_direction
from fgreg.graph.shared_state import Quadratic
from fgreg.model.estimate import TrackEstimate, Verdict
from fgreg.model.measurements import Aim, EpochStart, KnownPoint, Measurements, Pair, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.tissue_surface import TissueSurface
from fgreg.online.cases import FIRST_PMS, LEAST_PMS, finished_epochs, is_due, known_minima, move_case
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.event_checks import check
from fgreg.online.events import CameraMoved, LoopClosed, OnlineEvent, StaticTags
from fgreg.online.full_solve import FullSolveCase, FullSolveResult, Report, full_solve, other_start, result_of
from fgreg.online.next_state import next_state
from fgreg.online.noticed_moves import NoticedMoves
from fgreg.online.proofs import Proofs
from fgreg.online.reported_estimate import reported
from fgreg.online.solver import Where, make_solver
from fgreg.online.tracking_snapshot import online_snapshot
from fgreg.registration.epoch_verdicts import EpochReport
from fgreg.registration.epochs import FinishedEpochs, last_epoch
from fgreg.registration.multistart import EpochSearch
from fgreg.registration.solve import Solution, solve
from fgreg.smoother.initialise import initialised
from fgreg.smoother.innovation import misplaced_pms
from fgreg.smoother.marginal_prior import has_moved
from fgreg.smoother.state import Epoch, State, finished_prior, make_setting
from fgreg.smoother.updates import (
    FIRST_PAIRS,
    finished_prior_at_start,
    with_motion,
    with_move,
    without_move,
)
from fgreg.tracking.query import track
from fgreg.tracking.snapshot import Snapshot

MOST_LOSSES = 3
"""Times that a case is submitted again after its worker process has ended, until the next event."""
MOST_ROUNDS = 4
"""Largest number of full solves at one event: after each camera move that one finds another follows."""


class OnlineRegistration:
    """Registers while the session goes on.

    Args:
        model: the session's set-up.
        config: settings of estimate and verdict.
        full_solve: ``in_process`` runs it within :meth:`add` (deterministic), ``worker`` in a worker process, whose
            results are taken over with the next event or by :meth:`refresh`.
        verdicts: False leaves posterior and verdict out of the full solve, which only registers.
        find_moves: whether unreported camera moves are looked for.
        start: of the first epoch.

    Raises:
        ValueError: the configuration has an option that the online registration does not support.
    """

    def __init__(
        self,
        model: SessionModel,
        config: SolveConfig | None = None,
        *,
        full_solve: Where = "in_process",
        verdicts: bool = True,
        find_moves: bool = True,
        start: EpochStart | None = None,
    ) -> None:
        self._model, self._config = model, config or SolveConfig()
        self._setting = make_setting(model, self._config)
        self._state = State((Epoch(start or EpochStart(0.0), 0),))
        self._t = -math.inf
        self._serial = 0  # changes with the measurements and their epochs
        self._division = 0  # changes with the division of the pairs into epochs
        self._asked = 0  # division of the submitted case
        self._solved = 0  # number of the first epochs that have been through the full solve
        self._reports: tuple[EpochReport, ...] = ()  # of these epochs
        self._misfit = 0  # the current epoch, where its PMs did not all fit with the earlier epochs as a prior
        self._finished_prior: Quadratic | None = None  # from the earlier epochs, in the full solve of the current one
        self._draft: tuple[int, EpochSearch] | None = None  # of a full solve that has to follow: serial, minima
        self._solve_wanted = self._move_wanted = self._move_untested = False
        self._misplaced: frozenset[int] = frozenset()
        self._restoring = False
        self._report: Report | None = None
        self._snapshot: tuple[OnlineEstimate, Snapshot] | None = None
        self._surface: TissueSurface | None = None
        self._find_moves, self._verdicts = find_moves, verdicts
        self._move_failure = ""  # of the camera-move test
        self._failures = ("", "", "")  # as reported in the estimate
        self._losses = 0  # cases lost in a row
        self._tags = TagMonitor()
        self._noticed = NoticedMoves()
        self._solver = make_solver(full_solve, model, self._config, verdicts=verdicts)
        self._proofs = Proofs(full_solve, model, self._config)
        self._submitted: FullSolveCase | None = None
        self._estimate = self._estimated(self._state, 0.0)

    def __enter__(self) -> OnlineRegistration:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """End the worker processes, if there are any; the estimate stays."""
        self._solver.close()
        self._proofs.close()

    # --- events -----------------------------------------------------------------------------------------------------

    def add(self, event: OnlineEvent) -> OnlineEstimate:
        """Take in one event.

        A pair's own ``epoch`` is ignored: it belongs to the current epoch.

        Raises:
            EventRefused: the event cannot be taken in, or the update failed; everything is as it was before.
        """
        check(event, self._t)
        if not isinstance(event, CameraMoved):  # a reported move has priority over one that is still being tested for
            self._fetch()
        before = self._state
        try:
            tags, found = self._seen(event)
            noticed = before.epoch in self._noticed.texts
            state = next_state(before, event, found, self._setting, noticed=noticed, restoring=self._restoring)
            estimate = self._estimated(state, event.t)
            misplaced = self._misplaced if self._restoring else self._misplaced_now(state, event)
        except EventRefused:
            raise
        except Exception as error:  # whatever failed, the state before stays valid
            raise EventRefused(f"the update failed: {type(error).__name__}: {error}") from error
        # From here on nothing can fail: the event is taken in.
        self._state, self._t, self._estimate, self._tags = state, event.t, estimate, tags
        self._serial += 1
        if state.epoch != before.epoch:
            self._divided(by_tags=found is not None)
        elif state.now.start is not before.now.start:
            self._finished_prior = None  # it is without the motion that is known now
        if isinstance(found, TagsMoved):
            self._note_move(before, state.now.first, found.since_t, event.t, None)
        elif isinstance(event, CameraMoved) and event.detected and event.since_t is not None:
            self._note_move(before, state.now.first, event.since_t, event.t, None, recorded=True)
        elif isinstance(event, LoopClosed):
            self._noticed.loop_closures.append(DetectedLoopClosure(event.epoch, event.to, event.t, None))
        self._want(event, found, misplaced)
        self._solve(event.t)
        if isinstance(event, Pair) and state is not self._state and self._state.shots:
            self._state = replace(self._state, nis=state.nis, used=self._state.shots[-1].inlier)
            self._estimate = replace(self._estimate, nis=self._state.nis, used=self._state.used)
        return self._estimate

    def _seen(self, event: OnlineEvent) -> tuple[TagMonitor, TagsMoved | TagsAtRest | None]:
        """The tag monitor after a frame of static tags, and what it detected."""
        if not (isinstance(event, StaticTags) and self._find_moves):
            return self._tags, None
        return monitored(self._tags, event.t, TagFrame(event.camera_T_tag, event.covariance), TagSettings())

    def _misplaced_now(self, state: State, event: OnlineEvent) -> frozenset[int]:
        """PMs of the state that are inliers beyond their limit, or outliers within it; none where no shot was added."""
        return misplaced_pms(state, self._setting) if isinstance(event, Pair | Aim | KnownPoint) else frozenset()

    def _divided(self, *, by_tags: bool = False) -> None:
        """Note that the division of the pairs into epochs has changed: results of earlier cases are invalid."""
        self._division += 1
        self._proofs.forget()
        self._misplaced, self._finished_prior = frozenset(), None
        if self._state.epoch_pairs:  # the epoch before has other pairs now
            self._solved = min(self._solved, self._state.epoch - 1)
        if not by_tags:
            self._tags = TagMonitor()

    # --- the full solve ---------------------------------------------------------------------------------------------

    def _want(self, event: OnlineEvent, found: TagsMoved | TagsAtRest | None, misplaced: frozenset[int]) -> None:
        """Decide what the full solve has to do after an event."""
        state, self._losses = self._state, 0
        if self._solver.failure and state.epoch_pairs:  # the last full solve gave no result
            self._solve_wanted = True
        if isinstance(event, Pair):
            self._move_wanted = self._find_moves
            rejected = state.nis is not None and not state.used
            no_estimate = state.active_window is None or state.is_open
            due = is_due(state.epoch_pairs) or state.epoch_pms <= FIRST_PMS
            if no_estimate or rejected or due or not misplaced <= self._misplaced:
                self._solve_wanted = True
        elif isinstance(event, Aim | KnownPoint):
            first = state.active_window is None or state.epoch_pairs <= FIRST_PAIRS
            if state.epoch_pairs and (first or not misplaced <= self._misplaced):
                self._solve_wanted = True
        elif (found is not None or isinstance(event, CameraMoved)) and state.epoch_pairs:
            self._solve_wanted = True

    def _solve(self, t: float) -> None:
        """Submit the wanted case, and take over a result."""
        if self._restoring:
            return
        for _ in range(MOST_ROUNDS):
            if not self._solver.busy:
                case = self._case()
                if case is None:
                    break
                self._asked, self._solve_wanted, self._move_wanted = self._division, False, False
                self._move_untested = case.move is not None and case.move.known is None
                self._submitted = case
                self._solver.submit(case)
                if self._solver.busy and case.measurements is not None and self._state.active_window is None:
                    self._state = replace(self._state, why_none="its pairs are being registered")
                    self._estimate = self._estimated(self._state, self._estimate.t)
            if not self._fetch(t):
                break
        self._take_proof()
        failures = (self._solver.failure, self._move_failure, self._proofs.failure)
        if failures != self._failures:
            self._failures = failures
            self._estimate = self._estimated(self._state, self._estimate.t)

    def _fetch(self, t: float | None = None) -> bool:
        """Take over a result; whether there was one."""
        found = self._solver.fetch()
        if found is None:
            if self._solver.lost:  # with its process: submitted again, at most so often until the next event
                self._solver.lost, self._losses = False, self._losses + 1
                if self._losses <= MOST_LOSSES:
                    self._solve_wanted, self._move_wanted = True, self._find_moves
            return False
        self._losses = 0
        if self._asked != self._division or found.epoch != self._state.epoch:
            self._solve_wanted = True
            return True
        if found.initial is not None and found.initial.first and not found.initial.fits:
            # Where some are outliers, or would be among more, the earlier epochs decide together with this one.
            self._misfit, self._solve_wanted = found.epoch, True
            return True
        t = self._t if t is None else t
        if found.move_failure is not None:
            self._move_failure = found.move_failure
        if isinstance(found.move, CameraMove):
            before = {shot.label for shot in self._state.shots[self._state.now.first : found.move.first]}
            if self._noticed.by_pairs(self._state) and len(before) < LEAST_PMS:  # they show nothing of a move
                self._begin_again(found.move.first)
            else:
                self._reassign(found.move, t)
        elif found.begins is not None:
            self._begin_again(found.begins)
        elif isinstance(found.move, LoopClosure):
            self._close_loop(found.move, t)
        else:
            self._take_over(found)
            if self._submitted is not None and found.initial is not None and self._report is found.report:
                self._proofs.want(self._submitted)
        return True

    def _case(self) -> FullSolveCase | None:
        """The case that is wanted and possible now."""
        state = self._state
        move = None
        if self._move_wanted:
            try:
                move = move_case(state, self._setting.columns)
            except Exception as error:  # the pair is taken in without the test
                self._move_failure = f"{type(error).__name__}: {error}"
        if not self._solve_wanted:
            return None if move is None else FullSolveCase(self._serial, state.epoch, None, move=move)
        finished = self._finished()
        measurements = self._state.measurements()
        if finished is None:
            known, detected = known_minima(self._state), self._noticed.by_pairs(self._state)
            return FullSolveCase(self._serial, state.epoch, measurements, known, move=move, detected=detected)
        return FullSolveCase(
            self._serial,
            state.epoch,
            last_epoch(measurements),
            finished=finished,
            before=self._reports[: state.epoch],
            first=state.now.first,
            move=move,
            draft=self._draft is None,
            searched=self._draft[1] if self._draft is not None and self._draft[0] == self._serial else None,
        )

    def _finished(self) -> FinishedEpochs | None:
        """The earlier epochs as a prior, at the first pairs of an epoch; None where everything has to be solved."""
        state = self._state
        early = state.epoch_pairs <= FIRST_PAIRS or state.epoch_pms <= FIRST_PMS
        if not early or not state.epoch or self._solved < state.epoch or self._misfit == state.epoch:
            return None
        try:
            prior = self._finished_prior = self._finished_prior or finished_prior_at_start(state, self._setting)
        except ArithmeticError:
            return None
        found = None if prior is None else finished_epochs(state, prior, self._reports)
        if found is not None and state.finished is None:
            self._state = replace(state, finished=prior)
        return found

    def _take_over(self, found: FullSolveResult) -> None:
        """Take over optimum, inliers and report of a full solve; where that fails the incremental estimate stays."""
        if self._report is not None and found.serial < self._report.serial:
            return  # a later one has been taken over
        before = self._state, self._misplaced, self._report, self._surface
        self._draft = None if found.draft is None else (found.serial, found.draft)
        try:
            if found.report is not None:
                self._report = found.report
                self._surface = found.report.surface or self._surface
            if found.initial is not None:
                self._state = initialised(self._state, found.initial, self._setting)
                # Pairs that came before the first registration have not been tested for a move yet.
                self._move_wanted, self._move_untested = self._move_wanted or self._move_untested, False
                self._misplaced = misplaced_pms(self._state, self._setting)
                if self._draft is None:
                    self._solved, self._reports = found.epoch + 1, () if found.report is None else found.report.epochs
                prior, here = self._finished_prior, self._state.active_window
                if not found.initial.first:
                    self._finished_prior = None  # the earlier epochs were solved, too
                elif prior and here and (self._draft or has_moved(prior, here.state, self._setting.empty)):
                    self._finished_prior = finished_prior(self._state, here.state, self._setting).finished
                    self._solve_wanted = True
                self._solve_wanted |= self._draft is not None
            elif found.why_none:
                self._state = replace(self._state, active_window=None, why_none=found.why_none)
            self._estimate = self._estimated(self._state, self._estimate.t)
        except Exception as error:
            self._state, self._misplaced, self._report, self._surface = before
            self._solver.failure = f"{type(error).__name__}: {error}"
            self._estimate = self._estimated(self._state, self._estimate.t)

    def _take_proof(self) -> None:
        """Take over what was proved since of the last full solve's registration."""
        refusal, report = self._proofs.refusal, self._proofs.fetch(self._report)
        if report is not None and report.epoch == self._state.epoch:
            self._report, self._reports = report, report.epochs
        if report is not None or self._proofs.refusal != refusal:
            self._estimate = self._estimated(self._state, self._estimate.t)

    def _reassign(self, found: CameraMove, t: float) -> None:
        """Begin a new epoch at the first pair after an unreported camera move."""
        before = self._state
        since_t = before.shots[found.first].pair.t
        self._state = with_move(before, EpochStart(since_t), self._setting, len(before.shots) - found.first, since_t)
        self._serial += 1
        self._divided()
        self._solve_wanted = True
        self._note_move(before, found.first, since_t, t, found.log_bayes)

    def _begin_again(self, first: int) -> None:
        """The current epoch, which began with a move that was detected, begins with another pair."""
        state = self._state
        known = self._noticed.begun_by(state)
        before = without_move(state)
        since_t = state.shots[first].pair.t
        self._state = with_move(before, EpochStart(since_t), self._setting, len(before.shots) - first, since_t)
        self._serial += 1
        self._divided()
        self._solve_wanted = True
        if known is not None:
            self._noticed.moves.remove(known)
        t, log_bayes = (self._t, None) if known is None else (known.alarm_t, known.log_bayes)
        self._note_move(before, first, since_t, t, log_bayes, recorded=known is None)

    def _close_loop(self, found: LoopClosure, t: float) -> None:
        """Close a loop: the earlier epoch's registration becomes a prior of the current epoch."""
        before, report = self._state, self._report
        self._report = self._finished_prior = None  # they were of another registration
        try:
            state = with_motion(before, back_to(before.now.start, found.to), self._setting)
            state = replace(state, nis=before.nis, used=before.used)
            estimate = self._estimated(state, self._estimate.t)
        except Exception:  # the epoch stays as it was, only its registration is less certain
            self._report = report
            return
        self._noticed.loop_closures.append(DetectedLoopClosure(before.epoch, found.to, t, found.log_bayes))
        self._state, self._estimate = state, estimate
        self._serial += 1
        self._division += 1
        self._proofs.forget()
        self._solve_wanted = True

    def _note_move(
        self, before: State, first: int, since_t: float, t: float, log_bayes: float | None, *, recorded: bool = False
    ) -> None:
        """Note a move that was detected, and report it; arguments as of :meth:`NoticedMoves.add`."""
        self._noticed.add(before, self._state.epoch, first, since_t, t, log_bayes, recorded=recorded)
        self._estimate = self._estimated(self._state, self._estimate.t)

    @contextmanager
    def restoring(self) -> Iterator[None]:
        """While events of a recorded session are taken in again: everything is estimated once, at the end.

        Camera moves and loop closures that were detected are among the recorded events. New ones are looked for in the
        current epoch only.
        """
        self._restoring = True
        try:
            yield
        finally:
            self._restoring = False
        if not self._state.shots:
            return
        try:
            self._solve_all()
        except Exception as error:  # the events are taken in; the next event requests the full solve again
            self._solver.failure = f"{type(error).__name__}: {error}"
            self._estimate = self._estimated(self._state, self._estimate.t)
        self._move_wanted = self._find_moves and bool(self._state.epoch_pairs)
        self._solve_wanted = False
        self._solve(self._t)

    def _solve_all(self) -> None:
        """Run the full solve of everything in this process."""
        for left in range(MOST_ROUNDS)[::-1]:
            detected = left > 0 and self._noticed.by_pairs(self._state)
            case = FullSolveCase(self._serial, self._state.epoch, self._state.measurements(), detected=detected)
            found = full_solve(case, self._model, self._config, verdicts=self._verdicts)
            if found.begins is None:
                self._take_over(found)
                if found.initial is not None:
                    self._proofs.want(case)
                break
            self._begin_again(found.begins)

    # --- estimate ---------------------------------------------------------------------------------------------------

    @property
    def estimate(self) -> OnlineEstimate:
        """The estimate after the last event or result."""
        return self._estimate

    def refresh(self) -> OnlineEstimate:
        """Take over a result of the full solve, without an event."""
        self._fetch()
        self._solve(self._t)
        return self._estimate

    @property
    def moves(self) -> tuple[DetectedMove, ...]:
        """Detected camera moves in the order of time; their epochs are numbered as reported."""
        return tuple(self._noticed.moves)

    @property
    def loop_closures(self) -> tuple[DetectedLoopClosure, ...]:
        """Loop closures in the order of time."""
        return tuple(self._noticed.loop_closures)

    @property
    def state(self) -> State:
        """The incremental state; it is never changed in place."""
        return self._state

    @property
    def inliers(self) -> tuple[bool, ...]:
        """Whether each pair is an inlier, in the order of the pairs."""
        return tuple(shot.inlier for shot in self._state.shots)

    def measurements(self) -> Measurements:
        """All measurements, as the batch solve takes them."""
        return self._state.measurements()

    def starts(self) -> tuple[EpochStart, ...]:
        """Starts of the camera epochs."""
        return tuple(epoch.start for epoch in self._state.epochs)

    def marker_T_laser(self) -> FloatArray | None:
        """(4, 4) the current estimate of the beam, origin by its chart; None where there is none yet."""
        if self._state.active_window is None:
            return None
        shared = self._state.active_window.state
        return make_transform(rotation_to_direction(shared.beam_direction()[0]), shared.beam_origin()[0])

    def settle(self) -> OnlineEstimate:
        """Run the full solve of everything now, unless it is up to date; the estimate is then that of the solve."""
        if not self._estimate.settled or known_minima(self._state):
            self.solution()
        return self._estimate

    def solution(self) -> Solution:
        """The full solve of everything, taken over as by :meth:`settle`."""
        for left in range(MOST_ROUNDS)[::-1]:
            measurements = self.measurements()
            solution = solve(measurements, [], self._model, self._config)
            detected = left > 0 and self._noticed.by_pairs(self._state)
            case = FullSolveCase(self._serial, self._state.epoch, measurements, detected=detected)
            found = solution.registration
            begins = None if found is None else other_start(case, measurements, found, self._config)
            if begins is None:
                break
            self._begin_again(begins)
        self._solver.failure = ""
        self._solve_wanted = False
        self._proofs.forget()
        self._take_over(result_of(case, measurements, solution))
        return solution

    def track(self, query: Track) -> TrackEstimate:
        """Answer a query from the current estimate; the graph does not change."""
        self._fetch()
        return track(query, self.snapshot())

    def snapshot(self) -> Snapshot:
        """The current estimate for tracking queries; made at most once per event, on demand."""
        if self._snapshot is None or self._snapshot[0] is not self._estimate:
            active = self._state.active_window
            optimum = None if active is None else (active.state, active.covariance, self._setting.columns)
            made = online_snapshot(self._model, self._config, self._estimate, optimum, self._surface)
            self._snapshot = (self._estimate, made)
        return self._snapshot[1]

    # --- reporting --------------------------------------------------------------------------------------------------

    def _estimated(self, state: State, t: float) -> OnlineEstimate:
        """The estimate of a state, with the full solve's report of its epoch, and detected camera moves."""
        report = self._report if self._report is not None and self._report.epoch == state.epoch else None
        settled = report is not None and report.serial == self._serial and state is self._state
        estimate = reported(state, t, report, self._model, self._config, settled=settled)
        # A move whose motion was measured, by static tags or by the holder, is as sure as a reported one.
        measured = state.now.start.motion_known and state.now.start.after is None
        known = ["" if measured else self._noticed.texts.get(state.epoch, "")]
        if self._solver.failure:
            known.append(f"the full solve failed: {self._solver.failure}: its earlier result may be out of date")
        if self._move_failure:
            known.append(f"camera moves are not looked for: {self._move_failure}")
        refusal, failure = self._proofs.refusal, self._proofs.failure
        texts = tuple(text for text in known if text)
        verdict = Verdict.WARNING if texts else Verdict.OK
        if refusal and refusal not in estimate.reasons:  # of fewer pairs
            texts, verdict = (refusal, *texts), Verdict.REFUSED
        if failure:
            texts = (*texts, f"not certified: {failure}")
        if not texts:
            return estimate
        verdict = max(estimate.verdict, verdict, key=lambda v: v.severity)
        return replace(estimate, verdict=verdict, reasons=(*texts, *estimate.reasons))
