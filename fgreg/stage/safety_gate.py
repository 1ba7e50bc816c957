"""The safety gate between planner and stage: decides what may move, and when motion has to stop.

It is pure: it gets messages, the stage's status and the time, and returns actions; it reads no clock and no device. It
runs in the watchdog process, as the last step before the driver.

Three ways to stop:
- *hold*: the motion ends; the operator's request stays (the marker was lost for a moment).
- *halt*: the operator also has to request again (the main program stalled, stop was pressed).
- *latch*: nothing moves until a reset (emergency, clock, faulty stage).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from fgreg.stage.interface import MAX_CALL_S, StageStatus
from fgreg.stage.limits import MotionKind, MotionLimits
from fgreg.stage.messages import Action, Arrived, Beat, Command, Drive, Halt, Message, Refusal, Request, Reset, Stop

FUTURE_S = 1e-3
"""A stamp that is later than now by more than this comes from another clock."""
START_S = 0.3
"""A stage that has not moved by this time after a command will not move, or is at its target already."""
TRACKABLE = ("ok", "warning")
"""Verdicts with which a registration may be followed."""


@dataclass(frozen=True, slots=True)
class _Motion:
    """A motion under way: between ``low_rad`` and ``high_rad``, finished by ``deadline_s``, at most at the commanded
    speed or, until ``carried_until_s``, at the speed of the motion before it (``carried_speed``), which it brakes."""

    command: Command
    began_s: float
    start_rad: float
    low_rad: float
    high_rad: float
    deadline_s: float
    carried_speed: float
    carried_until_s: float

    def speed_at(self, t_s: float) -> float:
        """Highest speed at a time."""
        speed = self.command.speed_rad_s
        return max(speed, self.carried_speed) if t_s <= self.carried_until_s else speed


class Gate:
    """State of the safety gate. All methods take the time ``now`` (s, host clock) and return actions.

    Attributes:
        latched: why nothing may move until a reset; None if the stage may move.
    """

    def __init__(self, limits: MotionLimits) -> None:
        self.limits = limits
        self.latched: str | None = None
        self._now: float | None = None
        self._beat: Beat | None = None
        self._request: tuple[MotionKind, float] | None = None
        self._motion: _Motion | None = None
        self._status: StageStatus | None = None
        self._arrived_before_s: float | None = None  # the status before ``_status``
        self._halted_s: float | None = None
        self._braking: _Motion | None = None
        self._seen_moving = False
        self._stands_rad: float | None = None  # where it came to rest; None while it turns or brakes
        self._strayed_s = -math.inf  # when it last left that angle, by its positions

    @property
    def moving(self) -> MotionKind | None:
        """The kind of motion under way, or None."""
        return None if self._motion is None else self._motion.command.kind

    @property
    def requested(self) -> MotionKind | None:
        """The kind of motion that the operator has requested, or None."""
        return None if self._request is None else self._request[0]

    def handle(self, message: Message, now: float) -> list[Action]:
        """Take in a message of the main program."""
        actions = self._clock(now)
        match message:
            case Beat():
                if message.sent_s > now + FUTURE_S:
                    return [*actions, *self._latch("a heartbeat from the future: the clocks disagree")]
                if self._beat is None or message.sent_s >= self._beat.sent_s:
                    self._beat = message
                return [*actions, *self._supervise(now)]
            case Stop(emergency=True):
                return [*actions, *self._latch(f"emergency stop: {message.reason}")]
            case Stop():
                return [*actions, *self._halt(message.reason)]
            case Request():
                return [*actions, *self._on_request(message, now)]
            case Reset():
                return [*actions, *self._on_reset(message, now)]
            case Command():
                return [*actions, *self._on_command(message, now)]

    def tick(self, now: float, status: StageStatus | None) -> list[Action]:
        """Time has passed; ``status`` is a new status or None. Call it at least every few hundredths of a second."""
        actions = self._clock(now)
        if status is not None:
            actions += self._on_status(status, now)
        return actions + self._supervise(now)

    def fault(self, reason: str, now: float) -> list[Action]:
        """Latch on a fault that only the watchdog can know: a lost stage, an unreadable message, a signal."""
        return self._clock(now) + self._latch(reason)

    # -- ways to stop

    def _hold(self, reason: str) -> list[Action]:
        """End the motion; the request stays."""
        if self._motion is None:
            return []
        self._come_to_rest()
        return [Halt(reason, latched=self.latched is not None)]

    def _halt(self, reason: str) -> list[Action]:
        """Stop, and drop the request. The stop is sent in any case."""
        self._request = None
        self._come_to_rest()
        return [Halt(reason, latched=self.latched is not None)]

    def _come_to_rest(self) -> None:
        """A stage that stands already has no way left to brake: a stop gives it no time to move."""
        if self._motion is not None:
            self._braking, self._halted_s, self._stands_rad = self._motion, self._now, None
        self._motion = None

    def _latch(self, reason: str) -> list[Action]:
        if self.latched is None:
            self.latched = reason
        return self._halt(reason)

    # -- time

    def _clock(self, now: float) -> list[Action]:
        """Latch if the clock cannot be trusted; earlier stamps are then invalid."""
        last, self._now = self._now, now
        if last is None and math.isfinite(now):
            return []
        if not math.isfinite(now):
            self._now = last
            reason = "the clock shows no time"
        elif last is not None and now < last:
            reason = f"the clock went back by {last - now:.3f} s"
        elif last is not None and now - last > self.limits.clock_gap_s:
            reason = f"the clock jumped by {now - last:.3f} s: the watchdog did not run"
        else:
            return []
        self._beat = self._status = self._arrived_before_s = self._stands_rad = None
        self._halted_s, self._strayed_s = self._now, -math.inf
        return self._latch(reason)

    def _alive(self, now: float, kind: MotionKind | None = None) -> bool:
        return self._beat is not None and now - self._beat.sent_s <= self.limits.heartbeat(kind)

    def _fresh_status(self, now: float) -> StageStatus | None:
        status = self._status
        return status if status is not None and now - status.stamp.host_s <= self.limits.status_age_s else None

    # -- requests and commands

    def _on_request(self, request: Request, now: float) -> list[Action]:
        reason = self._stale(request.sent_s, now)
        if self.latched is not None:
            reason = f"latched: {self.latched}"
        elif reason is None and not self._alive(now, request.kind):
            reason = "the main program's heartbeat is missing"
        if reason is not None:
            return [Refusal(f"request to {request.kind} refused: {reason}")]
        actions: list[Action] = []
        if self.moving not in (None, request.kind):
            actions = self._halt(f"the operator asked to {request.kind}")
        self._request = (request.kind, now)
        return actions

    def _on_reset(self, reset: Reset, now: float) -> list[Action]:
        if self.latched is None:
            return []
        status = self._fresh_status(now)
        reason = self._stale(reset.sent_s, now)
        if reason is None and not self._alive(now):
            reason = "the main program's heartbeat is missing"
        elif reason is None and status is None:
            reason = "the stage is silent"
        elif reason is None and status is not None and (status.moving or status.fault):
            reason = status.fault or "the stage still moves"
        elif reason is None and now - self._strayed_s <= self.limits.standing_s():
            reason = "the stage still moves"
        if reason is not None:
            return [Refusal(f"reset refused: {reason}")]
        self.latched = None
        self._motion = self._request = None
        return []

    def _on_command(self, command: Command, now: float) -> list[Action]:
        reason, status = self._forbidden(command, now), self._status
        if reason is not None or status is None:
            return [Refusal(f"{command.kind} refused: {reason}", command.number)]
        here, target, limits = status.scan_rad, command.scan_rad, self.limits
        low, high, carried = self._carried(status, now)
        if target is None:
            travel = limits.homing_travel()
        else:
            travel = max(abs(target - low), abs(target - high))
            low, high = min(low, target), max(high, target)
        deadline = now + 1.5 * travel / command.speed_rad_s + limits.slack_s
        until = now + MAX_CALL_S + carried / limits.deceleration_rad_s2
        self._seen_moving, self._stands_rad = False, None
        self._motion = _Motion(command, now, here, low, high, deadline, carried, until)
        if command.kind is MotionKind.HOME:
            self._request = None  # one request, one homing
        return [Drive(command.kind, target, command.speed_rad_s, command.reason, command.number)]

    def _carried(self, status: StageStatus, now: float) -> tuple[float, float, float]:
        """Lowest and highest angle that the stage may still reach from the motion before, and its highest speed.

        It may go as far as it can before it has reversed (:meth:`MotionLimits.reach_rad`), but never beyond the range
        of the motion before.
        """
        here, limits, old = status.scan_rad, self.limits, self._motion
        speed = 0.0
        if old is not None:
            speed = old.speed_at(now)
        elif self._braking is not None and self._halted_s is not None:
            old, braked_s = self._braking, status.stamp.host_s - self._halted_s - MAX_CALL_S
            speed = max(0.0, old.speed_at(self._halted_s) - limits.deceleration_rad_s2 * max(0.0, braked_s))
        if old is None or old.command.kind is MotionKind.HOME:
            return here, here, 0.0
        reach = limits.reach_rad(speed, now - status.stamp.host_s)
        return min(here, max(here - reach, old.low_rad)), max(here, min(here + reach, old.high_rad)), speed

    def _stale(self, sent_s: float, now: float) -> str | None:
        age = now - sent_s
        if age > self.limits.command_age_s:
            return f"{1e3 * age:.0f} ms on its way, at most {1e3 * self.limits.command_age_s:.0f} allowed"
        return "from the future: the clocks disagree" if age < -FUTURE_S else None

    def _forbidden(self, command: Command, now: float) -> str | None:
        """Why a command is not allowed now; None if it is allowed."""
        limits, status = self.limits, self._fresh_status(now)
        if self.latched is not None:
            return f"latched: {self.latched}"
        if self._request is None or self._request[0] is not command.kind:
            return f"the operator has not asked to {command.kind}"
        if now - self._request[1] > limits.request_s:
            return f"the operator's request is older than {limits.request_s:.0f} s"
        if not self._alive(now, command.kind):
            return "the main program's heartbeat is missing"
        if (stale := self._stale(command.sent_s, now)) is not None:
            return stale
        if status is None:
            return "the stage is silent"
        if status.fault:
            return status.fault
        highest = limits.speed(command.kind)
        if not 0.0 < command.speed_rad_s <= highest * (1.0 + 1e-9):
            return (
                f"speed {math.degrees(command.speed_rad_s):.1f} deg/s, expected above 0, "
                f"at most {math.degrees(highest):.1f} deg/s"
            )
        if command.kind is MotionKind.HOME:
            if command.scan_rad is not None:
                return "homing has no target"
            return "the stage moves" if status.moving or self._motion is not None else None
        return self._forbidden_target(command, status, now)

    def _forbidden_target(self, command: Command, status: StageStatus, now: float) -> str | None:
        limits, target, here = self.limits, command.scan_rad, status.scan_rad
        if not status.homed:
            return "the stage is not homed"
        if self.moving is MotionKind.HOME or status.homing:
            return "the stage is homing"
        if target is None or not math.isfinite(target):
            return "no target"
        if not limits.inside(target):
            return f"target {math.degrees(target):.1f} deg is outside the stage's limits"
        if not limits.inside(here, limits.tolerance_rad):
            return f"the stage stands at {math.degrees(here):.1f} deg, outside its limits"
        if command.kind is MotionKind.SEARCH:
            for name, angle, slack in (("target", target, 0.0), ("present angle", here, limits.tolerance_rad)):
                if not limits.in_sweep(angle, slack):
                    return f"{name} {math.degrees(angle):.1f} deg is outside the sweep range"
            return None
        if command.sigma_rad is None or not 0.0 <= command.sigma_rad <= limits.track_sigma_rad:
            sigma = "none" if command.sigma_rad is None else f"{math.degrees(command.sigma_rad):.2f} deg"
            return f"1 sigma of the angle is {sigma}, at most {math.degrees(limits.track_sigma_rad):.2f} deg allowed"
        return self._untrackable(now)

    def _untrackable(self, now: float) -> str | None:
        """Why tracking is not allowed: marker or registration; None if it is allowed."""
        beat = self._beat
        if beat is None or beat.marker_s is None:
            return "no marker detected"
        age = now - beat.marker_s
        if age > self.limits.marker_age_s:
            return f"the marker is {1e3 * age:.0f} ms old, at most {1e3 * self.limits.marker_age_s:.0f} ms allowed"
        if age < -FUTURE_S:
            return "the marker is from the future: the clocks disagree"
        if beat.registration is None:
            return "there is no current registration"
        return None if beat.registration in TRACKABLE else f"the registration is {beat.registration}"

    # -- supervision of motions

    def _on_status(self, status: StageStatus, now: float) -> list[Action]:
        if not (math.isfinite(status.scan_rad) and math.isfinite(status.velocity_rad_s)):
            return self._latch("the stage reports no angle")
        if status.stamp.host_s > now + FUTURE_S:
            return self._latch("a status from the future: the clocks disagree")
        before, self._status = self._status, status
        if before is not None and status.stamp.host_s < before.stamp.host_s:
            self._status = before
            return []
        read_after_s = self._arrived_before_s  # the earlier of the two was asked for then, and may have come late
        if before is not None and status.stamp.host_s > before.stamp.host_s:
            self._arrived_before_s = before.stamp.host_s
        if self._motion is None:
            return self._at_rest(before, status, now)
        reason = self._misbehaves(self._motion, before, read_after_s, status, now)
        if reason is not None:
            return self._latch(reason)
        return self._ended(self._motion, status)

    def _at_rest(self, before: StageStatus | None, status: StageStatus, now: float) -> list[Action]:
        """Check a stage that should be at rest, or be braking.

        Its own moving flag is believed where it says that it moves. Where it says that it stands, its positions count:
        from one to another lie at most two tolerances, one for each.
        """
        limits, here = self.limits, status.scan_rad
        if status.moving or status.homing:
            self._stands_rad = None
            if status.homed and not limits.inside(here, limits.tolerance_rad):
                return self._latch(f"the stage is at {math.degrees(here):.1f} deg, outside its limits")
            braking = self._halted_s is not None and now - self._halted_s <= limits.standing_s()
            return [] if braking else self._latch("the stage moves without a command")
        if before is not None and before.homed != status.homed:
            self._stands_rad = None  # its zero was set or lost: the angle jumps, the stage does not
        if self._stands_rad is None:
            # Until the angle was surely read after the brakes' time, it may be one on the way.
            read_after_s = -math.inf if self._arrived_before_s is None else self._arrived_before_s
            if self._halted_s is None or read_after_s >= self._halted_s + limits.standing_s():
                self._stands_rad = here
            return []
        strayed = abs(here - self._stands_rad)
        if strayed <= 2.0 * limits.tolerance_rad:
            return []
        self._stands_rad, self._strayed_s = here, now
        return self._latch(f"the stage says that it stands, and turned by {math.degrees(strayed):.1f} deg")

    def _misbehaves(
        self,
        motion: _Motion,
        before: StageStatus | None,
        read_after_s: float | None,
        status: StageStatus,
        now: float,
    ) -> str | None:
        """Why a motion must stop, or None.

        A status is stamped when it arrives. Its angle was read between the arrival of the status before it and its
        own, so the way between two statuses is compared with the time since ``read_after_s``.
        """
        limits, here = self.limits, status.scan_rad
        if status.fault:
            return status.fault
        since_s = status.stamp.host_s if before is None else before.stamp.host_s
        since_s = since_s if read_after_s is None else read_after_s
        bound = limits.overspeed * motion.speed_at(since_s)
        slack = limits.tolerance_rad
        if abs(status.velocity_rad_s) > bound + slack:
            return f"the stage turns at {math.degrees(abs(status.velocity_rad_s)):.1f} deg/s: too fast"
        found_zero = motion.command.kind is MotionKind.HOME and status.homed and not status.homing
        if before is not None and not found_zero:
            took = status.stamp.host_s - since_s
            if abs(here - before.scan_rad) > bound * took + slack:
                return f"the stage turned by {math.degrees(abs(here - before.scan_rad)):.1f} deg in {1e3 * took:.0f} ms"
        if motion.command.kind is MotionKind.HOME:
            if status.homed and not limits.inside(here, slack):
                return f"the stage is at {math.degrees(here):.1f} deg, outside its limits"
            if not found_zero and abs(here - motion.start_rad) > limits.homing_travel() + slack:
                return f"zero position not found within {math.degrees(limits.homing_travel()):.0f} deg"
        elif not status.homed or status.homing:
            return "the stage has lost its zero position"
        elif not motion.low_rad - slack <= here <= motion.high_rad + slack or not limits.inside(here, slack):
            return f"the stage is at {math.degrees(here):.1f} deg, off its way"
        return "the motion takes longer than it can" if now > motion.deadline_s else None

    def _ended(self, motion: _Motion, status: StageStatus) -> list[Action]:
        limits, here, took = self.limits, status.scan_rad, status.stamp.host_s - motion.began_s
        if took <= 0.0:
            return []
        if status.moving or status.homing:
            self._seen_moving = True
            return []
        if not self._seen_moving and took <= START_S:
            return []
        if motion.command.scan_rad is None:
            arrived = status.homed
            if arrived and not limits.inside(here, limits.tolerance_rad):
                return self._latch(f"homed at {math.degrees(here):.1f} deg, outside the limits")
        else:
            arrived = abs(here - motion.command.scan_rad) <= limits.tolerance_rad
        if arrived:
            self._come_to_rest()
            self._braking, self._stands_rad = None, here
            return [Arrived(motion.command.number)]
        if took > limits.stop_s:
            return self._halt(f"the stage stopped by itself at {math.degrees(here):.1f} deg")
        return []

    def _supervise(self, now: float) -> list[Action]:
        """Stop a motion whose conditions no longer hold."""
        if not self._alive(now, self.moving or self.requested) and (self._motion or self._request):
            return self._halt("the main program's heartbeat is missing")
        if self._request is not None and now - self._request[1] > self.limits.request_s:
            self._request = None
            return self._hold("the operator's request has run out")
        if self._motion is None:
            return []
        if self._fresh_status(now) is None:
            return self._latch("the stage is silent")
        if self._motion.command.kind is MotionKind.TRACK and (reason := self._untrackable(now)) is not None:
            return self._hold(f"tracking held: {reason}")
        return []
