"""Messages and limits between the main program and the watchdog: invalid ones are refused."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fgreg.schema.limits import STAGE_TEXT
from fgreg.stage.limits import MotionKind, MotionLimits
from fgreg.stage.messages import (
    Beat,
    Command,
    Message,
    MessageError,
    Request,
    Reset,
    Stop,
    decode,
    encode,
)
from tests.test_stage_safety_gate import LIMITS


def test_messages_come_back_as_they_went() -> None:
    messages: list[Message] = [
        Beat(1.5, None, None),
        Beat(1.5, 1.25, "ok"),
        Request(2.0, MotionKind.HOME, "pédale"),
        Command(2.0, 3, MotionKind.TRACK, -0.1, 0.2, 0.01, "a\nb"),
        Command(2.0, 4, MotionKind.HOME, None, 0.2, None, ""),
        Stop(3.0, True, "x"),
        Reset(4.0, "y"),
    ]
    for message in messages:
        line = encode(message)
        assert line.count(b"\n") == 1
        assert decode(line) == message
    assert len(encode(Stop(0.0, True, "x" * 9999))) < STAGE_TEXT + 200
    with pytest.raises(ValueError, match="not JSON compliant"):
        encode(Command(2.0, 3, MotionKind.TRACK, math.nan, 0.2, 0.01, ""))


_COMMAND = {**json.loads(encode(Command(2.0, 3, MotionKind.TRACK, 0.1, 0.2, 0.01, "why")))}


_WRONG: dict[str, list[Any]] = {
    "number": [True, 1.0, "1", None],
    "scan_rad": [True, "1", [], 10**400],
    "speed_rad_s": [None, False, {}],
    "kind": ["fly", None, ["home"]],
    "message": ["drive", None, [], 3],
    "reason": [None, 3, "x" * 301],
    "more": [1],
}


@pytest.mark.parametrize("change", [{name: value} for name, values in _WRONG.items() for value in values])
def test_message_with_a_wrong_field_is_none(change: dict[str, Any]) -> None:
    with pytest.raises(MessageError):
        decode(json.dumps(_COMMAND | change).encode())


@pytest.mark.parametrize(
    "line", [b"", b"{", b"[]", b"null", b"\xff\xfe", b'{"message": "beat"}', b"[" * 3000, b'{"a": NaN}']
)
def test_line_that_is_no_message_is_none(line: bytes) -> None:
    with pytest.raises(MessageError):
        decode(line)


@settings(max_examples=200, derandomize=True, deadline=None)
@given(st.binary(max_size=200))
def test_garbage_never_becomes_a_message(line: bytes) -> None:
    with pytest.raises(MessageError):
        decode(line)


def test_limits_survive_being_handed_over() -> None:
    document = json.loads(json.dumps(LIMITS.document()))
    assert MotionLimits.from_document(document) == LIMITS
    with pytest.raises(TypeError):
        MotionLimits.from_document(document | {"more": 1})
