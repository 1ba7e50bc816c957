"""A latched stage: the reason is reported until it is reset; after that it moves only if it is asked to again."""

from __future__ import annotations

import math

from fgreg.drivers.base import CommandKind, OperatorCommand
from fgreg.live.actions import Ask, Release, Sweep, Tell
from fgreg.live.workflow import ASK_AGAIN_S
from fgreg.simulation.room import Room, room_config
from tests.rehearsal import Rehearsal


def rehearsal(*, obliging: bool) -> Rehearsal:
    return Rehearsal(Room(room_config(3, aims=0, bump_every_s=math.inf)), obliging=obliging)


def asked_for_resets(session: Rehearsal) -> list[tuple[float, Tell]]:
    return [(t, tell) for t, tell in session.messages if tell.wants is CommandKind.RESET]


def test_why_it_is_latched_is_reported_at_once_and_again() -> None:
    session = rehearsal(obliging=False)
    session.run(1.0)
    session.latched = "emergency stop: button"
    latched_s = session.now_s
    session.run(2.5 * ASK_AGAIN_S)
    asked = asked_for_resets(session)
    assert len(asked) == 3
    assert asked[0][0] - latched_s < 0.1
    assert all("emergency stop: button" in tell.text for _, tell in asked)
    assert session.actions == []  # nothing is ordered meanwhile
    session.latched = "another trouble"
    session.run(0.1)
    assert "another trouble" in asked_for_resets(session)[-1][1].text


def test_after_the_reset_a_new_request_is_asked_for_at_once() -> None:
    session = rehearsal(obliging=True)
    while not any(isinstance(action, Sweep) for _, action in session.actions):
        session.run(0.1)
    session.latched, session.requested = "the stage is silent", None
    before = len(session.actions)
    session.obliging = False
    session.run(1.0)
    assert session.actions[before:] == []
    messages = len(session.messages)
    session._said.append(OperatorCommand(CommandKind.RESET))
    session.run(0.1)
    assert [action for _, action in session.actions[before:]] == [Release()]
    news = [tell for _, tell in session.messages[messages:]]
    assert any("free again" in tell.text for tell in news)
    assert [tell.wants for tell in news if tell.wants is not None] == [CommandKind.SEARCH]
    session.run(3.0)
    assert not any(isinstance(action, Sweep) for _, action in session.actions[before:])
    session.obliging = True
    session._said.append(OperatorCommand(CommandKind.SEARCH))
    session.run(5.0)
    assert any(isinstance(action, Sweep) for _, action in session.actions[before:])


def test_a_reset_where_nothing_is_latched_is_explained() -> None:
    session = rehearsal(obliging=False)
    session._said.append(OperatorCommand(CommandKind.RESET))
    session.run(0.1)
    assert any("no reset: the stage is not latched" in tell.text for _, tell in session.messages)
    assert not any(isinstance(action, Ask | Release) for _, action in session.actions)
