"""Messages of the main program to the watchdog as lines of JSON, and the actions of the safety gate.

Times are seconds of the host's clock. A line that is not exactly one of these messages raises :class:`MessageError`,
since its sender is faulty.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields
from typing import Any

from fgreg.errors import FgregError
from fgreg.schema.limits import STAGE_TEXT
from fgreg.stage.limits import MotionKind


class MessageError(FgregError):
    """A line that is not a valid message."""


@dataclass(frozen=True, slots=True)
class Beat:
    """Heartbeat of the main program, with what tracking depends on.

    Attributes:
        sent_s: time of the main loop's step.
        marker_s: exposure of the newest frame in which the marker was found.
        registration: verdict of the *current* registration (``ok``, ``warning``, ``refused``); None if there is none
            that is valid for the camera's current pose.
    """

    sent_s: float
    marker_s: float | None = None
    registration: str | None = None


@dataclass(frozen=True, slots=True)
class Request:
    """The operator's request for a kind of motion; ``by`` names the operator or the control."""

    sent_s: float
    kind: MotionKind
    by: str


@dataclass(frozen=True, slots=True)
class Command:
    """A motion: ``scan_rad`` is None for homing, ``sigma_rad`` is that of the tracking result, else None."""

    sent_s: float
    number: int
    kind: MotionKind
    scan_rad: float | None
    speed_rad_s: float
    sigma_rad: float | None
    reason: str


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop and drop the operator's request; ``emergency``: also refuse everything until a :class:`Reset`."""

    sent_s: float
    emergency: bool
    reason: str


@dataclass(frozen=True, slots=True)
class Reset:
    """Reset after the operator's inspection: motion may be requested again."""

    sent_s: float
    by: str


Message = Beat | Request | Command | Stop | Reset
_KINDS: dict[str, type[Message]] = {"beat": Beat, "request": Request, "command": Command, "stop": Stop, "reset": Reset}
_NAMES = {kind: name for name, kind in _KINDS.items()}
_OPTIONAL = {"marker_s", "registration", "scan_rad", "sigma_rad"}


@dataclass(frozen=True, slots=True)
class Drive:
    """Move the stage; the only action that ever sets it in motion."""

    kind: MotionKind
    scan_rad: float | None
    speed_rad_s: float
    reason: str
    number: int


@dataclass(frozen=True, slots=True)
class Halt:
    """Stop the stage now. ``latched``: nothing moves until a reset."""

    reason: str
    latched: bool


@dataclass(frozen=True, slots=True)
class Refusal:
    """A refused message; ``number`` of the command, None if it was no command."""

    reason: str
    number: int | None = None


@dataclass(frozen=True, slots=True)
class Arrived:
    """The motion of a command has ended where it should."""

    number: int


Action = Drive | Halt | Refusal | Arrived


def encode(message: Message) -> bytes:
    """One line. Raises ValueError for a number that is not finite."""
    document = {"message": _NAMES[type(message)], **asdict(message)}
    for key in ("reason", "by"):
        if key in document:
            document[key] = document[key][:STAGE_TEXT]
    return json.dumps(document, allow_nan=False).encode() + b"\n"


def decode(line: bytes) -> Message:
    """The message of a line.

    Raises:
        MessageError: not a valid message.
    """
    try:
        document = json.loads(line.decode("utf-8"), parse_constant=_no_number)
        kind = _KINDS[document.pop("message")]
        names = {field.name for field in fields(kind)}
        if set(document) != names:
            raise ValueError(f"fields {sorted(document)}, expected {sorted(names)}")
        return kind(**{name: _checked(name, value) for name, value in document.items()})
    except (ValueError, KeyError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise MessageError(f"a message that cannot be read: {type(error).__name__}: {error}"[:STAGE_TEXT]) from error


def _checked(name: str, value: Any) -> Any:
    if value is None and name in _OPTIONAL:
        return None
    if name in ("reason", "by", "registration"):
        if not isinstance(value, str) or len(value) > STAGE_TEXT:
            raise ValueError(f"{name} is no text")
        return value
    if name == "kind":
        return MotionKind(value)
    if name == "emergency":
        if not isinstance(value, bool):
            raise ValueError("emergency is neither true nor false")
        return value
    if name == "number":
        if type(value) is not int:
            raise ValueError("number is no integer")
        return value
    if type(value) not in (int, float) or not math.isfinite(value):
        raise ValueError(f"{name} is no finite number")
    return float(value)


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number")
