"""The operator's words in a live session: stops, words that are refused, shots left out by hand, a verification."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fgreg.drivers.base import CommandKind, OperatorCommand, RefusedWord, host_now
from fgreg.errors import FgregError
from fgreg.live import recorder
from fgreg.live.actions import LocatedPulse, TakeVerify
from fgreg.live.workflow import Workflow
from fgreg.model.estimate import Verdict
from fgreg.model.events import ExcludeEvent, IncludeEvent, NoteEvent, PairEvent, TrackEvent
from fgreg.model.time_sync import TimedPose
from fgreg.session.session_reader import read_session
from tests.test_live_camera_moves import Stand, standing


def say(stand: Stand, *commands: OperatorCommand | RefusedWord) -> None:
    """The operator says this."""
    stand.operator.waiting += commands


def told(stand: Stand, text: str) -> bool:
    return any(text in message for message in stand.operator.messages)


def test_what_the_operator_says_has_its_effect_or_is_refused_and_noted(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with standing(pose_session) as stand:
        stand.turn(0.3)
        stops: list[str] = []
        monkeypatch.setattr(stand.link, "stop", stops.append)
        # A stop counts before everything that was said with it, and an old word does not.
        now = host_now()
        say(stand, *[OperatorCommand(CommandKind.NEXT, said_s=now - 2.0)] * 400)
        say(stand, OperatorCommand(CommandKind.STOP, said_s=now - 2.0, peer="foot switch"))
        stand.turn(0.1)
        assert stops == ["the operator has stopped the stage"]
        shown = stand.loop.status()
        assert shown.heard == "stop from foot switch"
        assert shown.refused.startswith("next from the operator is refused: it is 2.")
        assert told(stand, "(and 399 words more)")

        # PM 3 is left out: the registration is invalid until it is solved without it.
        pairs = stand.recorder.state.pairs
        say(
            stand,
            OperatorCommand(CommandKind.EXCLUDE, pm=99),
            OperatorCommand(CommandKind.EXCLUDE, pm=3, peer="keyboard"),
        )
        beats = len(stand.link.beats)
        stand.turn(10.0, lambda: stand.recorder.state.excluded == {3})
        assert told(stand, "no exclude: the PMs that count: 0 to 19")
        assert None in stand.link.beats[beats:]
        assert not told(stand, "registration lost")
        state = stand.recorder.state
        assert state.pairs == pairs - 1
        assert state.registration.verdict is Verdict.WARNING
        assert any("left out by hand" in reason for reason in state.registration.reasons)
        say(stand, OperatorCommand(CommandKind.INCLUDE, pm=4), OperatorCommand(CommandKind.INCLUDE, pm=3))
        stand.turn(10.0, lambda: not stand.recorder.state.excluded)
        assert told(stand, "no include: the PMs that are left out: 3")
        assert stand.recorder.state.pairs == pairs
        stand.turn(0.1)
        assert stand.link.beats[-1] is not None

        # Looks at a new PM are compared and not added; one alone never shows every turn.
        shot = [event for event in read_session(pose_session).events if isinstance(event, PairEvent)][-1]
        marker, stage = TimedPose(host_now(), stand.marker, 1e-6 * np.eye(6)), stand.session.journal.model.stage
        scan = stage.scan_from_device(math.radians(shot.trus.scan_deg))
        look = LocatedPulse(host_now(), scan, marker, "", shot.trus.x_mm, shot.trus.range_mm, 0.01 * np.eye(2), 1.0)
        with monkeypatch.context() as once:
            once.setattr(Workflow, "step", lambda *_: (TakeVerify(0, 1, (look,)),))
            stand.loop.turn()
            stand.turn(0.05)
        stand.turn(10.0, lambda: told(stand, "verify: "))
        assert stand.recorder.state.pairs == pairs
    events = read_session(pose_session).events
    (out,) = [event for event in events if isinstance(event, ExcludeEvent)]
    assert (out.pm, out.by, out.reason) == (3, "keyboard", "said in the live session")
    assert [event.pm for event in events if isinstance(event, IncludeEvent)] == [3]
    queries = [event for event in events if isinstance(event, TrackEvent) and event.looks]
    assert queries[-1].looks[0].x_mm == look.x_mm
    notes = [event.text for event in events if isinstance(event, NoteEvent)]
    assert any(note.startswith("verify: ") for note in notes)
    assert len([note for note in notes if "next from the operator is refused" in note]) == 1


def test_a_choice_whose_engine_does_not_start_leaves_no_registration_with_the_shot(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with standing(pose_session) as stand:
        stand.turn(0.3)
        revive, fails = stand.session.revive, [True]

        def failing() -> object:
            if fails[0]:
                stand.session._gone = True
                raise FgregError("no process can be started")
            return revive()

        monkeypatch.setattr(stand.session, "revive", failing)
        say(stand, OperatorCommand(CommandKind.EXCLUDE, pm=3))
        stand.turn(2.0, lambda: "no process" in stand.recorder.state.trouble)
        beats = len(stand.link.beats)
        stand.turn(0.5)
        assert set(stand.link.beats[beats:]) == {None}
        assert stand.loop.status().invalid
        fails[0] = False
        monkeypatch.setattr(recorder, "AGAIN_S", 0.0)
        stand.turn(10.0, lambda: stand.link.beats[-1] is not None)
        assert stand.recorder.state.excluded == {3}
