"""The workflow of a session: calibration shots, PM searches, following the beam.

It has no devices, no clock and no estimate: :meth:`Workflow.step` gets the inputs of one moment and returns actions.
The safety gate (fgreg.stage) decides whether the stage may turn; the workflow only says what would be useful.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

from fgreg.drivers.base import CommandKind, OperatorCommand
from fgreg.drivers.operator_words import spelt
from fgreg.geometry.transforms import FloatArray
from fgreg.live import time_spent
from fgreg.live.actions import (
    Action,
    Ask,
    Follow,
    Halt,
    Inputs,
    LocatedPulse,
    RegistrationState,
    Release,
    StageView,
    Sweep,
    TakeAim,
    TakeChoice,
    TakeMove,
    TakePairs,
    TakePoint,
    TakeVerify,
    Tell,
)
from fgreg.live.hold_still import NO_PICTURE, held_pose, moved_mm, turned_rad, unseen
from fgreg.live.pm_search import PmSearch
from fgreg.live.time_spent import TimeSpent
from fgreg.model.estimate import Verdict
from fgreg.model.session_model import SessionModel
from fgreg.schema.kinds import Integer, Number
from fgreg.schema.problems import FieldError
from fgreg.schema.record import Key
from fgreg.search.detection_model import DetectionModel
from fgreg.search.planner import Found, NotFound, Prediction, SearchPlanner, Turn
from fgreg.stage.limits import MotionKind

SLIP_MM, SLIP_RAD = 1.2, 0.03
"""A fibre that leaves its pose by more than this during a search has moved: its pulses belong to no single spot."""
LIKELY_PMS = 2
"""Found PMs after which a search begins where they were."""
ANOTHER_MM, ANOTHER_RAD = 3.0, 0.06
"""A new PM needs the fibre to be at least this far from the pose of the last PM."""
WORTH_PREDICTING_RAD = math.radians(8.0)
"""A prediction less certain than this is no better than a sweep."""
CHECK_RAD = math.radians(2.0)
"""While the stage follows, a PM detected with the plane this close to the tracking result becomes a pair."""
CHECK_S = 0.3
"""Time between two such detections."""
SHOWN_S = 3.0
"""Pairs wait at most so long for a frame that shows the static tags in their place."""
ASK_AGAIN_S = 10.0
PATIENCE_S = 6.0
"""Wait after which the operator gets a message about what is missing."""
VERIFY_PMS = 4
"""New PMs that a verification takes: with one fewer no wrong detection among them could be told from the others."""
MISSED = 8
"""Number of consecutive pulses without a PM, where one is expected, after which the operator gets a message."""


def _why(registration: RegistrationState) -> str:
    """The first reason for refusing the registration."""
    return registration.reasons[0] if registration.reasons else "no registration"


def _usable(registration: RegistrationState) -> bool:
    """Whether there is a registration that is not refused."""
    return registration.registered and registration.verdict is not Verdict.REFUSED


class Stage(StrEnum):
    """Stages of a session."""

    AIMING = "calibrating"
    COLLECTING = "registering"
    FOLLOWING = "following"


@dataclass(frozen=True, slots=True)
class WorkflowSettings:
    """How many shots and PMs to take, and what counts as a detection. The operator can end the calibration earlier."""

    aims: Annotated[int, Key("calibration shots", Integer(0, 1000))] = 8
    pms: Annotated[
        int, Key("PMs since the last unmeasured camera move, after which the stage may follow", Integer(1, 1000))
    ] = 8
    most_pms: Annotated[int, Key("the same where the verdict is a warning", Integer(1, 1000))] = 15
    hearing_threshold: Annotated[
        float,
        Key(
            "least amplitude of a detection, in the source's unit",
            Number(0.0, 1e12, above=True),
            default="required, but in the simulated room",
            example="20.0",
        ),
    ] = 0.0
    both_sides: Annotated[bool, Key("whether each PM that was found is looked at from both sides")] = True
    follow: Annotated[bool, Key("whether the stage follows the beam at all")] = True

    def __post_init__(self) -> None:
        if self.aims < 0 or not 1 <= self.pms <= self.most_pms:
            raise ValueError("aims has to be 0 or more, pms from 1 to most_pms")
        if not (math.isfinite(self.hearing_threshold) and self.hearing_threshold > 0):
            found = "nothing" if self.hearing_threshold == 0.0 else str(self.hearing_threshold)
            raise FieldError.of(found, "a number > 0", "hearing_threshold")


class Workflow:
    """The workflow of one session.

    Args:
        model: session model.
        settings: how many shots and PMs to take.
        next_pm: number of the next PM; in a resumed session it follows the recorded ones.

    Attributes:
        stage: current stage of the session.
        not_yet: why the stage may not be homed yet; empty if it may.
        spent: what the time went into.
    """

    def __init__(self, model: SessionModel, settings: WorkflowSettings, next_pm: int = 0) -> None:
        self._model, self._settings, self._next_pm = model, settings, next_pm
        self._detection_model = DetectionModel.of_session(
            model.probe.sensitivity, settings.hearing_threshold, scan_sigma_rad=model.noise.scan_rad
        )
        low, high = (model.stage.scan_from_device(angle) for angle in model.stage.limits_device_rad)
        self._field = (min(low, high), max(low, high))
        self.stage = Stage.AIMING if settings.aims else Stage.COLLECTING
        self.not_yet = ""
        self.spent = TimeSpent()
        self._search: PmSearch | None = None
        self._done_at: FloatArray | None = None
        self._pms, self._epoch = 0, 0
        self._found_rad: list[float] = []  # plane angles of the PMs found
        self._ahead = False  # whether the stage was sent to where the next search begins
        self._refused_pms = 0
        self._missed = 0
        self._wanted: CommandKind | None = None
        self._latched = ""
        self._wanted_s = -math.inf
        self._waits_s = -math.inf
        self._checks, self._checked_s = False, -math.inf
        self._verified: int | None = None  # PMs of the verification under way
        self._aims = -1  # calibration shots that were taken when the next one was asked for
        self._held: list[TakePairs] = []  # until the camera is known to have stood still
        self._not_before_s = -math.inf  # earlier pulses belong to another epoch

    @property
    def wants_pulses(self) -> bool:
        """Whether pulses should be located now; locating a source takes processor time."""
        return self._checks if self._search is None else self._search.wants_pulses

    def step(self, inputs: Inputs) -> tuple[Action, ...]:
        """The actions for these inputs."""
        out: list[Action] = []
        self._checks = False
        self.spent.add(inputs.now_s, self._purpose(inputs.stage))
        for command in inputs.commands:
            out += self._obey(command, inputs)
        latched = inputs.stage is not None and self._is_latched(inputs.stage, inputs.now_s, out)
        if inputs.camera_moving_s is not None or any(isinstance(action, TakeMove) for action in out):
            # The registration is invalid. The motion request stays; the safety gate blocks the motion meanwhile.
            self._search, self._not_before_s = None, max(self._not_before_s, inputs.now_s)
            self._waits_s = inputs.now_s  # the marker's poses from before are dropped: it is not unseen
            if self._held:
                out.append(Tell("the camera has moved during the last looks, or just after: they are not used"))
                self._pms -= len(self._held)
                self._held.clear()
            self._end_verification("the camera moves", out)
            return tuple(out)
        if inputs.registration.epoch != self._epoch:
            # A registration without pairs of this epoch is the one before, moved as the camera did.
            goes_on = _usable(inputs.registration) and inputs.registration.pairs == 0
            self._epoch, self._done_at, self._missed, self._search = inputs.registration.epoch, None, 0, None
            self._pms, self._refused_pms = self._pms if goes_on else 0, 0
            self._end_verification("the camera has moved", out)
            measured = "the camera has moved, as measured: the registration goes on"
            out.append(Tell(measured if goes_on else "the camera has moved: the registration starts again"))
        self._hand_over(inputs, out)
        self._advance(inputs, out)
        if any(isinstance(action, Ask | Halt | Release) for action in out):
            self._search = None
            return tuple(out)  # the next stage order depends on how the stage reacts
        if inputs.stage is not None and not latched and self._may_turn(inputs, inputs.stage, out):
            searches = inputs.stage.requested is MotionKind.SEARCH
            if self._searching or (self.stage is Stage.FOLLOWING and searches):
                self._collect(inputs, inputs.stage, out)
            elif self.stage is Stage.FOLLOWING:
                self._follow(inputs, inputs.stage, out)
        else:
            self._search = None
        return tuple(out)

    def _purpose(self, stage: StageView | None) -> str:
        """What the time since the last step went into."""
        if self._search is not None:
            return time_spent.SEARCHING if self._search.found is None else time_spent.BOTH_SIDES
        if self.stage is Stage.COLLECTING:
            ready = stage is not None and stage.homed and stage.requested is MotionKind.SEARCH
            return time_spent.GOING if ready else time_spent.WAITING
        return time_spent.CALIBRATING if self.stage is Stage.AIMING else time_spent.FOLLOWING

    def _is_latched(self, stage: StageView, now_s: float, out: list[Action]) -> bool:
        """Whether the stage is latched; then ask the operator for a reset."""
        if stage.latched != self._latched:
            self._latched, self._wanted = stage.latched, None  # ask at once
            if not stage.latched:
                out.append(Tell("the stage is free again, and moves once it is asked to"))
        if stage.latched:
            text = f"the stage is latched ({stage.latched}): look at it and the probe, and when it may move again"
            self._want(CommandKind.RESET, text, now_s, out)
        return bool(stage.latched)

    def _may_turn(self, inputs: Inputs, stage: StageView, out: list[Action]) -> bool:
        """Whether the stage is homed and the operator has requested the next kind of motion; if not, ask for it."""
        if not stage.homed:
            if self.not_yet:
                if inputs.now_s - self._waits_s > PATIENCE_S:
                    self._waits_s = inputs.now_s
                    out.append(Tell(f"the stage is not homed: {self.not_yet}"))
                return False
            self._want(CommandKind.HOME, "the stage has to find its zero position", inputs.now_s, out)
            return False
        if self._searching and stage.requested is not MotionKind.SEARCH:
            self._want(CommandKind.SEARCH, "the stage has to turn in search of PMs", inputs.now_s, out)
            return False
        if self.stage is Stage.FOLLOWING and not self._searching and self._settings.follow and self._search is None:
            tracking = inputs.tracking
            answered = tracking is not None and tracking.stage_rad is not None
            if answered and stage.requested is not MotionKind.TRACK:
                self._want(CommandKind.FOLLOW, "the stage is ready to follow the beam", inputs.now_s, out)
            elif not answered and tracking is not None and stage.requested is MotionKind.TRACK:
                self._want(CommandKind.SEARCH, f"{tracking.reason}: hold it still and search here", inputs.now_s, out)
        return True

    @property
    def _searching(self) -> bool:
        """Whether PMs have to be searched now."""
        return self.stage is Stage.COLLECTING or self._verified is not None

    def _want(self, wanted: CommandKind, text: str, now_s: float, out: list[Action]) -> None:
        """Ask the operator for a command, and again after a while."""
        if self._wanted == wanted and now_s - self._wanted_s < ASK_AGAIN_S:
            return
        self._wanted, self._wanted_s = wanted, now_s
        out.append(Tell(text, wants=wanted))

    # --- the session's course ---------------------------------------------------------------------------------------

    def _obey(self, command: OperatorCommand, inputs: Inputs) -> list[Action]:
        match command.kind:
            case CommandKind.HOME if self.not_yet:
                return [Tell(f"not homed: {self.not_yet}", answer=True)]
            case CommandKind.HOME:
                return [Ask(MotionKind.HOME, command.peer)]
            case CommandKind.SEARCH:
                return [Ask(MotionKind.SEARCH, command.peer)]
            case CommandKind.FOLLOW:
                out: list[Action] = []
                self._end_verification("follow was said", out)
                return [*out, Ask(MotionKind.TRACK, command.peer)]
            case CommandKind.AIM if command.corner is not None:
                return [TakeAim(command.corner)]
            case CommandKind.REGISTER if self.stage is Stage.AIMING:
                self.stage = Stage.COLLECTING
            case CommandKind.REGISTER:
                return [Tell("no register: the calibration shots are done", answer=True)]
            case CommandKind.NEXT if self._search is not None:
                self._done_at, self._search = self._search.held, None
                return [Tell("this spot is left: hold the fibre elsewhere", answer=True)]
            case CommandKind.NEXT:
                return [Tell("no next: nothing is searched for now", answer=True)]
            case CommandKind.MOVED:
                self._search = None
                return [TakeMove()]
            case CommandKind.CHECK | CommandKind.POINT if command.point is not None:
                if (stage := inputs.stage) is None or stage.no_angle:
                    why = "not there" if stage is None else stage.no_angle
                    return [Tell(f"no {command.kind}: the stage is {why}", answer=True)]
                if inputs.camera_moving_s is not None:
                    return [Tell(f"no {command.kind}: the camera moves", answer=True)]
                return [TakePoint(command.kind, command.point, stage.scan_rad)]
            case CommandKind.EXCLUDE | CommandKind.INCLUDE if command.pm is not None:
                return [TakeChoice(command.pm, command.kind is CommandKind.INCLUDE, command.peer)]
            case CommandKind.VERIFY:
                return [self._begin_verification(inputs)]
            case CommandKind.STOP:
                self._search = None
                return [Halt("the operator has stopped the stage")]
            case CommandKind.RESET:
                if inputs.stage is not None and inputs.stage.latched:
                    return [Release()]
                return [
                    Tell(f"no reset: the stage is not {'there' if inputs.stage is None else 'latched'}", answer=True)
                ]
        return []

    def _begin_verification(self, inputs: Inputs) -> Tell:
        if inputs.stage is None:
            return Tell("no verify: the stage is not there", answer=True)
        if inputs.camera_moving_s is not None or not _usable(inputs.registration):
            return Tell("no verify: there is no registration that may be used", answer=True)
        self._verified, self._search = 0, None
        return Tell(
            f"verifying with {VERIFY_PMS} new PMs, which are not added to the registration: hold the fibre elsewhere",
            done=True,
        )

    def _end_verification(self, why: str, out: list[Action]) -> None:
        if self._verified is not None:
            self._verified = None
            out.append(Tell(f"the verification ends without a result: {why}", answer=True))

    def _advance(self, inputs: Inputs, out: list[Action]) -> None:
        registration = inputs.registration
        usable = _usable(registration)
        if not usable:
            self._end_verification(f"the registration is refused: {_why(registration)}", out)
        if self.stage is Stage.AIMING and inputs.aims != self._aims and inputs.aims < self._settings.aims:
            self._aims = inputs.aims
            shots = f"{inputs.aims} of {self._settings.aims} calibration shots are taken"
            out.append(Tell(f"{shots}: put the beam on a corner of the board, and say {spelt(CommandKind.AIM)}"))
        if self.stage is Stage.AIMING and inputs.aims >= self._settings.aims:
            self.stage = Stage.COLLECTING
            out.append(Tell("calibrated: hold the fibre at the tissue", done=True))
        elif self.stage is Stage.COLLECTING and usable:
            enough = self._settings.pms if registration.verdict is Verdict.OK else self._settings.most_pms
            if self._pms >= enough and self._search is None:
                self.stage = Stage.FOLLOWING
                out.append(Tell(f"registered; where the time went: {self.spent.text()}", done=True))
        elif self.stage is Stage.COLLECTING and self._pms >= self._refused_pms + self._settings.most_pms:
            self._refused_pms = self._pms
            why = _why(registration)
            moved = spelt(CommandKind.MOVED)
            out.append(Tell(f"{self._pms} PMs, and refused: {why}; if the camera was moved, say {moved}"))
        elif self.stage is Stage.FOLLOWING and not usable:
            self.stage, self._pms, self._refused_pms = Stage.COLLECTING, 0, 0
            why = _why(registration)
            out += [Halt(f"the registration is refused: {why}"), Tell("hold the fibre at the tissue: registering")]

    # --- searching --------------------------------------------------------------------------------------------------

    def _collect(self, inputs: Inputs, stage: StageView, out: list[Action]) -> None:
        held = held_pose(inputs.poses, inputs.now_s)
        if self._search is None:
            if held is None or not self._is_another(held):
                self._go_ahead(inputs, stage, out)
                self._wait(inputs, held, out)
                return
            self._ahead = False
            self._waits_s = inputs.now_s
            self._search = self._begin(inputs, stage, held, cold=False)
        elif (slipped := self._slipped(inputs, self._search)) is not None:
            search, self._search = self._search, None
            out.append(Tell(f"{slipped}: hold it still"))
            if search.found is not None:  # the PM is known, and only a look from one side is missing
                self._found(inputs, search, search.found, out)
            return
        known = self._search.found is not None
        step = self._search.step(inputs.now_s, stage, inputs.pulses)
        if isinstance(step, Turn):
            if self._search.found is not None and not known:
                out.append(Tell("PM detected: hold the fibre still until it was looked at from both sides"))
            out.append(Sweep(step.scan_rad, step.reason))
        elif isinstance(step, Found):
            self._found(inputs, self._search, step, out)
        elif isinstance(step, NotFound):
            self._not_found(inputs, stage, self._search, step, out)

    def _wait(self, inputs: Inputs, held: FloatArray | None, out: list[Action]) -> None:
        """Tell the operator what is missing, once the wait is long."""
        if inputs.now_s - self._waits_s < PATIENCE_S:
            return
        self._waits_s = inputs.now_s
        why = unseen(inputs.poses, inputs.pictured_s, inputs.now_s)
        if why == NO_PICTURE:
            out.append(Tell("no new picture was looked at: hold the fibre where it is"))
        elif why:
            out.append(Tell("the marker is not seen: hold the fibre elsewhere", done=True))
        elif held is None:
            out.append(Tell("hold the fibre still", done=False))
        else:
            out.append(Tell("this spot is done: hold the fibre elsewhere", done=True))

    def _begin(self, inputs: Inputs, stage: StageView, held: FloatArray, *, cold: bool) -> PmSearch:
        low, high = self._field
        prediction, tracking = None, inputs.tracking
        if not cold and tracking is not None and tracking.stage_rad is not None and tracking.sigma_rad is not None:
            at, sigma = self._model.stage.scan_from_device(tracking.stage_rad), max(tracking.sigma_rad, 1e-3)
            refused = inputs.registration.verdict is Verdict.REFUSED
            if low <= at <= high and sigma <= WORTH_PREDICTING_RAD and not refused:
                prediction = Prediction(at, sigma)
        stands = min(max(stage.scan_rad, low), high)
        planner = SearchPlanner(self._detection_model, low, high, stands, prediction, likely_rad=self._likely())
        return PmSearch(
            planner,
            held,
            prediction is None,
            self._settings.hearing_threshold,
            self._model,
            self._detection_model,
            self._field,
            self._settings.both_sides,
        )

    def _likely(self) -> tuple[float, float] | None:
        """Lowest and highest angle of the PMs found up to now: tissue is there, wherever the camera is."""
        return (min(self._found_rad), max(self._found_rad)) if len(self._found_rad) >= LIKELY_PMS else None

    def _go_ahead(self, inputs: Inputs, stage: StageView, out: list[Action]) -> None:
        """While the fibre goes on to the next spot, turn the stage to where the search there will begin."""
        known = inputs.registration.registered and inputs.registration.verdict is not Verdict.REFUSED
        if self._ahead or self._done_at is None or stage.moving or known:
            return
        self._ahead = True
        low, high = self._field
        stands = min(max(stage.scan_rad, low), high)
        step = SearchPlanner(self._detection_model, low, high, stands, likely_rad=self._likely()).next()
        if isinstance(step, Turn):
            out.append(Sweep(step.scan_rad, "to where the next search begins"))

    def _found(self, inputs: Inputs, search: PmSearch, found: Found, out: list[Action]) -> None:
        self._search, self._done_at, self._waits_s = None, search.held, inputs.now_s
        self._found_rad.append(found.scan_rad)
        looks = tuple(look for look in search.best_looks(found) if look.marker is not None)
        if not looks:
            off_window = "the looks were outside the sensitivity window"
            why = next((look.unpaired for look in search.looks if look.unpaired), off_window)
            out.append(Tell(f"the PM was detected, but cannot be paired ({why}): go on to the next spot", done=True))
            return
        if self._verified is None:
            self._take(looks, inputs, out)
        else:
            out.append(TakeVerify(self._verified, VERIFY_PMS, looks))
            self._verified = self._verified + 1 if self._verified + 1 < VERIFY_PMS else None
        turn, sigma = math.degrees(found.scan_rad), math.degrees(found.sigma_rad)
        text = f"PM detected at {turn:.1f} +- {sigma:.1f} deg (1 sigma) after {found.positions} positions"
        if self._settings.both_sides:
            text += ("", ", with a look from one side only", ", with looks from both sides")[len(search.first_hits)]
        out.append(Tell(f"{text}: go on to the next spot", done=True))

    def _take(self, looks: tuple[LocatedPulse, ...], inputs: Inputs, out: list[Action]) -> None:
        """Looks at one more PM."""
        self._held.append(TakePairs(self._next_pm, looks))
        self._next_pm += 1
        self._pms += 1
        self._hand_over(inputs, out)

    def _hand_over(self, inputs: Inputs, out: list[Action]) -> None:
        """Pairs once a frame after their last pulse shows that the camera has stood still, or none shows anything."""
        shown_s = max(inputs.still_until_s, inputs.now_s - SHOWN_S)
        waits = [pairs for pairs in self._held if max(look.pulse_s for look in pairs.looks) > shown_s]
        out += [pairs for pairs in self._held if pairs not in waits]
        self._held = waits

    def still_held(self) -> tuple[TakePairs, ...]:
        """Pairs that still wait when the session ends: looks that were taken are recorded."""
        held, self._held = tuple(self._held), []
        return held

    def _not_found(self, inputs: Inputs, stage: StageView, search: PmSearch, why: NotFound, out: list[Action]) -> None:
        if not search.cold:
            self._search = self._begin(inputs, stage, search.held, cold=True)
            out.append(Tell(f"{why.reason}: searching the whole field"))
            return
        self._search, self._done_at, self._waits_s = None, search.held, inputs.now_s
        out.append(Tell(f"{why.reason}: go on to the next spot", done=True))

    def _slipped(self, inputs: Inputs, search: PmSearch) -> str | None:
        """Why a search has to end; None if it goes on."""
        newest, why = inputs.poses.newest(), unseen(inputs.poses, inputs.pictured_s, inputs.now_s)
        if newest is None or why:
            return why
        pose = newest.parent_T_child
        if moved_mm(pose, search.held) > SLIP_MM or turned_rad(pose, search.held) > SLIP_RAD:
            return "the fibre has moved during the search"
        return None

    def _is_another(self, held: FloatArray) -> bool:
        """Whether the fibre is far enough from where the last PM was taken."""
        if self._done_at is None:
            return True
        return moved_mm(held, self._done_at) > ANOTHER_MM or turned_rad(held, self._done_at) > ANOTHER_RAD

    # --- following --------------------------------------------------------------------------------------------------

    def _follow(self, inputs: Inputs, stage: StageView, out: list[Action]) -> None:
        tracking, newest = inputs.tracking, inputs.poses.newest()
        if tracking is None or tracking.stage_rad is None or tracking.sigma_rad is None or newest is None:
            return
        plane = self._model.stage.scan_from_device(tracking.stage_rad)
        shown = newest.t_s <= inputs.still_until_s
        if self._settings.follow and stage.requested is MotionKind.TRACK and shown:
            reason = f"following the beam, +- {math.degrees(tracking.sigma_rad):.1f} deg (1 sigma)"
            out.append(Follow(plane, tracking.sigma_rad, newest.t_s, reason))
        held = held_pose(inputs.poses, inputs.now_s)
        if held is None or abs(stage.scan_rad - plane) > CHECK_RAD:
            self._missed = 0
            return
        self._checks = inputs.now_s - self._checked_s > CHECK_S
        for pulse in inputs.pulses:
            if pulse.scan_rad is None or abs(pulse.scan_rad - plane) > CHECK_RAD or pulse.pulse_s < self._not_before_s:
                continue
            self._checked_s = inputs.now_s
            loud = pulse.amplitude is not None and pulse.amplitude >= self._settings.hearing_threshold
            self._missed = 0 if loud else self._missed + 1
            if loud and pulse.marker is not None and self._is_another(held):
                self._done_at = held
                self._take((pulse,), inputs, out)
        if self._missed == MISSED:
            moved = spelt(CommandKind.MOVED)
            text = f"the PM is not detected where the registration expects it: if the camera has moved, say {moved}"
            out.append(Tell(text))
