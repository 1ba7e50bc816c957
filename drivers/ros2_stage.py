"""A rotation stage that speaks CRTK over ROS 2: ``measured_js``, ``move_jp``, ``operating_state``, ``state_command``.

The joint's position is the stage's own angle (rad). CRTK has no speed in ``move_jp``: it is sent as the joint's
velocity, and a device that turns faster is stopped by the safety gate. It stops by the command ``pause`` together with
a goal where it stands, repeated until it stands; the next order resumes it first. A device that has fallen silent is
told to stop before it is given up. Statuses are the device's newest messages: it publishes by itself.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from fgreg.drivers import ros2_messages as ros
from fgreg.drivers.base import host_now
from fgreg.drivers.options import Ros2StageOptions
from fgreg.drivers.ros2_transport import open_transport
from fgreg.errors import FgregError
from fgreg.model.session_model import StageModel
from fgreg.model.time_sync import Stamp
from fgreg.stage.interface import StageError, StageLost, StageStatus

if TYPE_CHECKING:
    from fgreg.drivers.base import DriverContext

OPEN_S = 0.3
"""Longest wait for the first messages."""
LOST_S = 0.5
"""A stage without ``measured_js`` for this long is lost."""
RESUME_S = 0.3
"""An order waits this long for a paused stage to be ready."""
PAUSE_S = 0.1
"""For this long after the last ``pause`` the stage may be about to pause, whatever it says."""
AGAIN_S = 0.05
STANDS_RAD_S = math.radians(0.05)
_LEAST_S = 0.02


class Ros2Stage:
    """See ``fgreg.stage.interface.RotationStage``.

    Raises:
        StageLost: no device publishes. StageError: there is no way to ROS 2.
    """

    def __init__(self, model: StageModel, options: Ros2StageOptions) -> None:
        self._model, self._joint = model, options.joint
        self._name = f"stage at {options.namespace}"
        self._lock = threading.Lock()
        self._lost: str | None = None
        self._position = self._velocity = 0.0
        self._before: tuple[float, float] | None = None
        self._named, self._rejected = options.joint or "", ""
        self._arrived_s = -math.inf
        self._state: Any = None
        self._homing = self._stopping = False
        self._stopped_s = -math.inf
        self._waiting: tuple[float, Callable[[], None]] | None = None
        try:
            self._transport = open_transport(options, ros.hash_of)
        except FgregError as error:
            raise StageError(f"{self._name}: {error}") from error
        try:
            ros.prepare(ros.JOINTS, ros.STATE, ros.COMMAND)
            space = options.namespace
            self._send_goal = self._transport.publisher(f"{space}/move_jp", ros.JOINTS, urgent=True)
            self._send_command = self._transport.publisher(f"{space}/state_command", ros.COMMAND, urgent=True)
            self._transport.subscribe(f"{space}/operating_state", ros.STATE, self._take_state, latched=True)
            self._transport.subscribe(f"{space}/measured_js", ros.JOINTS, self._take_joint)
            self._wait()
        except BaseException:
            self.close()
            raise

    def home(self, speed_rad_s: float) -> None:  # noqa: ARG002
        """Start homing with the device's own speed, which CRTK cannot set; the safety gate watches it."""
        self._check()
        self._order(lambda: self._command("home"), homing=True)

    def move_to(self, scan_rad: float, speed_rad_s: float) -> None:
        """Turn to a plane angle."""
        self._check()
        goal = self._model.device_from_scan(scan_rad)
        self._order(lambda: self._goal(goal, speed_rad_s))

    def stop(self) -> None:
        """Pause, with a goal where it stands; :meth:`status` repeats it until it stands."""
        self._check()
        with self._lock:
            self._waiting, self._homing, self._stopping = None, False, True
        self._stop_now()

    def status(self) -> StageStatus:
        """The newest status. Raises StageLost."""
        self._check()
        with self._lock:
            silent = host_now() - self._arrived_s
            state, position, velocity, arrived_s = self._state, self._position, self._velocity, self._arrived_s
            waiting, rejected = self._waiting, self._rejected
        if silent > LOST_S:
            besides = f"; left out: {rejected}" if rejected else ""
            with contextlib.suppress(StageLost):
                self._stop_now()  # where only its messages are lost, it still hears this
            raise self._give_up(f"has said nothing for {LOST_S:g} s: is its node running?{besides}")
        busy = bool(state.is_busy)
        moving = busy or abs(velocity) > STANDS_RAD_S
        self._homing = self._homing and not (state.is_homed and not moving and waiting is None)
        if self._stopping and not moving:
            self._stopping = False
        if self._stopping and host_now() - self._stopped_s > AGAIN_S:
            self._stop_now()
        if waiting is not None:
            self._resume(waiting, str(state.state))
        fault = "" if state.state in ("ENABLED", "PAUSED") else f"{self._name} is {state.state}: switch its motor on"
        return StageStatus(
            Stamp(arrived_s, arrived_s),
            self._model.scan_from_device(position),
            self._model.direction * velocity,
            moving,
            self._homing,
            bool(state.is_homed) and not self._homing,
            fault,
        )

    def close(self) -> None:
        """End the connection."""
        self._lost = self._lost or f"{self._name} is closed"
        try:
            self._transport.close()
        except Exception:  # of the link's library
            return

    # -- orders

    def _order(self, give: Callable[[], None], homing: bool = False) -> None:
        """Give an order, after a paused stage is ready again."""
        with self._lock:
            self._stopping, self._homing, self._waiting = False, homing, None
            paused = self._state.state == "PAUSED" or host_now() - self._stopped_s < PAUSE_S
            if paused:
                self._waiting = host_now(), give
        if paused:
            self._command("resume")
        else:
            give()

    def _resume(self, waiting: tuple[float, Callable[[], None]], state: str) -> None:
        since_s, give = waiting
        now = host_now()
        if (state == "PAUSED" and now - since_s <= RESUME_S) or now - self._stopped_s < PAUSE_S:
            return
        self._waiting = None
        if state == "PAUSED":
            raise StageError(f"{self._name} does not resume after a pause")
        give()

    def _stop_now(self) -> None:
        self._stopped_s = host_now()
        self._command("pause")
        self._goal(self._position, None)

    def _command(self, command: str) -> None:
        self._sent(lambda: self._send_command(ros.state_command(command, time.time())))

    def _goal(self, device_rad: float, speed_rad_s: float | None) -> None:
        self._sent(lambda: self._send_goal(ros.joint_goal(self._named, device_rad, speed_rad_s, time.time())))

    def _sent(self, send: Callable[[], None]) -> None:
        try:
            send()
        except Exception as error:  # of the link's library
            raise self._give_up(f"takes nothing in: {error}") from error

    # -- messages, in the link's thread

    def _take_joint(self, data: bytes, kind: str, host_s: float) -> None:
        try:
            message = self._decoded(data, kind, ros.JOINTS)
            position, velocity = ros.joint_of(message, self._joint)
            name = self._joint or (str(message.name[0]) if message.name else "")
        except (ValueError, TypeError, AttributeError) as error:
            self._rejected = str(error)
            return
        with self._lock:
            measured = self._measured(position, host_s)
            self._velocity = measured if velocity is None or abs(velocity) < abs(measured) else velocity
            self._position, self._arrived_s, self._named = position, host_s, name

    def _measured(self, position: float, host_s: float) -> float:
        """Velocity by the positions, since a device may leave its own out, or at zero."""
        if self._before is None:
            self._before = host_s, position
            return 0.0
        took = host_s - self._before[0]
        if took < _LEAST_S:
            return self._velocity
        velocity = (position - self._before[1]) / took
        self._before = host_s, position
        return velocity

    def _take_state(self, data: bytes, kind: str, _host_s: float) -> None:
        try:
            state = self._decoded(data, kind, ros.STATE)
        except ValueError as error:
            self._rejected = str(error)
            return
        with self._lock:
            if self._state is not None and state.is_homed != self._state.is_homed:
                self._before, self._velocity = None, 0.0  # the zero was set: the position jumps, the stage does not
            self._state = state

    @staticmethod
    def _decoded(data: bytes, kind: str, expected: str) -> Any:
        if kind != expected:
            raise ValueError(f"messages of {kind}, expected {expected}")
        return ros.decode(data, kind)

    def _wait(self) -> None:
        until = host_now() + OPEN_S
        while self._state is None or math.isinf(self._arrived_s):
            if host_now() > until:
                missing = "operating_state" if self._state is None else "measured_js"
                besides = f"; left out: {self._rejected}" if self._rejected else ""
                raise self._give_up(f"publishes no {missing}: is its node running?{besides}")
            time.sleep(0.002)

    def _check(self) -> None:
        if self._lost is not None:
            raise StageLost(self._lost)

    def _give_up(self, reason: str) -> StageLost:
        self._lost = f"{self._name} {reason}"
        return StageLost(self._lost)


def open_stage(model: StageModel, **options: Any) -> Ros2Stage:
    """The stage, for the watchdog: options are those of ``Ros2StageOptions``."""
    return Ros2Stage(model, Ros2StageOptions(**options))


def ask_stage(_context: DriverContext, options: Ros2StageOptions) -> str:
    """What a stage says of itself; nothing is sent to it. Raises StageLost, StageError."""
    stage = Ros2Stage(StageModel(math.radians(1.0), (-math.pi, math.pi)), options)
    try:
        status = stage.status()
    finally:
        stage.close()
    zero = "knows its zero position" if status.homed else "has to find its zero position"
    return f"stands at {math.degrees(status.scan_rad):.1f} deg, {zero}{'; ' + status.fault if status.fault else ''}"
