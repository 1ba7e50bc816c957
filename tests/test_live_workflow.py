"""The course of a session: calibrating, searching PMs, following, starting again; in a simulated room and time."""

from __future__ import annotations

import math

import pytest

from fgreg.camera_moves.validity import Validity
from fgreg.drivers.base import CommandKind
from fgreg.live.actions import (
    Ask,
    Follow,
    Halt,
    Inputs,
    LocatedPulse,
    RegistrationState,
    Sweep,
    TakeMove,
    TakePairs,
    TakeVerify,
    Tell,
)
from fgreg.live.merge_looks import one_spot
from fgreg.live.shots import pair_events
from fgreg.live.verification import compared
from fgreg.live.workflow import SHOWN_S, VERIFY_PMS, Stage, Workflow, WorkflowSettings
from fgreg.model.estimate import Verdict
from fgreg.model.solve_config import SolveConfig
from fgreg.model.time_sync import PoseHistory
from fgreg.simulation.room import Room, room_config
from fgreg.stage.limits import MotionKind
from tests.rehearsal import Rehearsal


def rehearsal(
    seed: int = 3, *, aims: int = 8, frame_s: float = 1.0 / 15.0, static_tags: int = 0, **options: object
) -> Rehearsal:
    room = Room(room_config(seed, aims=aims, bump_every_s=math.inf, static_tags=static_tags))
    return Rehearsal(room, frame_s=frame_s, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def whole() -> Rehearsal:
    """A session up to following, and 80 s of it."""
    session = rehearsal(static_tags=3)
    while session.workflow.stage is not Stage.FOLLOWING and session.now_s < 240.0:
        session.run(1.0)
    predicted = session.engine.estimate.predicted_tre
    assert predicted is not None
    session.begun_mm = session.error_mm(), predicted.worst_mm
    session.run(80.0)
    return session


def test_a_session_comes_to_a_registration_that_is_right(whole: Rehearsal) -> None:
    assert whole.workflow.stage is Stage.FOLLOWING
    estimate = whole.engine.estimate
    assert estimate.verdict is Verdict.OK
    error_mm, predicted_mm = whole.begun_mm
    assert error_mm < predicted_mm
    assert max(error_mm, whole.error_mm()) < 2.0


def test_the_stage_follows_the_beam(whole: Rehearsal) -> None:
    assert len(whole.errors_deg) >= 4
    assert sorted(whole.errors_deg)[len(whole.errors_deg) // 2] < 1.0
    assert max(whole.errors_deg) < 3.0


def test_every_motion_comes_after_a_request_for_its_kind(whole: Rehearsal) -> None:
    requested: MotionKind | None = None
    for _, action in whole.actions:
        if isinstance(action, Ask):
            requested = action.kind
        elif isinstance(action, Sweep):
            assert requested is MotionKind.SEARCH
        elif isinstance(action, Follow):
            assert requested is MotionKind.TRACK
    kinds = [a.kind for _, a in whole.actions if isinstance(a, Ask)]
    assert kinds[:3] == [MotionKind.HOME, MotionKind.SEARCH, MotionKind.TRACK]
    assert kinds.count(MotionKind.HOME) == 1


def test_beams_that_miss_the_known_tissue_are_searched_and_then_followed(whole: Rehearsal) -> None:
    wants = [tell for _, tell in whole.messages if tell.wants is CommandKind.SEARCH]
    assert any("hold it still and search here" in tell.text for tell in wants)
    kinds = [a.kind for _, a in whole.actions if isinstance(a, Ask)]
    assert kinds.count(MotionKind.TRACK) >= 2


def test_looks_at_a_pm_are_within_its_window_and_paired_at_their_pulse(whole: Rehearsal) -> None:
    taken = [(t, a) for t, a in whole.actions if isinstance(a, TakePairs)]
    assert len({a.pm for _, a in taken}) == len(taken)
    for t, pairs in taken:
        for look in pairs.looks:
            assert look.marker is not None
            assert look.marker.t_s == pytest.approx(look.pulse_s)
            assert look.pulse_s < t
            plane = whole.room.plane_rad(look.pulse_s)
            assert look.scan_rad is not None
            assert abs(plane - look.scan_rad) < math.radians(7.0)


def test_each_pm_is_looked_at_from_both_sides_by_default(whole: Rehearsal) -> None:
    searched = [a for _, a in whole.actions if isinstance(a, TakePairs) and len(a.looks) > 1]
    both = [a for a in searched if {1, -1} <= {look.sweep for look in a.looks}]
    assert len(both) >= 0.8 * len(searched) > 0
    step, edge = whole.model.stage.step_rad, math.radians(6.0) + whole.room.scene.window_edge_rad
    for look in (look for a in both for look in a.looks if look.sweep):
        assert look.scan_rad is not None
        ahead = look.sweep * (whole.room.plane_rad(look.pulse_s) - look.scan_rad)
        # The hand trembles, and amplitudes have noise of 5 %.
        assert edge - step - math.radians(0.8) < ahead < edge + math.radians(0.8)
    told = [tell.text for _, tell in whole.messages]
    assert sum("with looks from both sides: go on" in text for text in told) == len(both)
    assert any("hold the fibre still until it was looked at from both sides" in text for text in told)


def test_looks_from_both_sides_can_be_turned_off_and_a_weak_pm_has_none() -> None:
    for options in ({"both_sides": False}, {"hearing_threshold": 0.7}):
        session = rehearsal(aims=0, threshold=0.7 if "hearing_threshold" in options else 0.45)
        settings = WorkflowSettings(**{"aims": 0, "hearing_threshold": session.threshold, **options})  # type: ignore[arg-type]
        session.workflow = Workflow(session.model, settings)
        while session.now_s < 60.0 and not any(isinstance(a, TakePairs) for _, a in session.actions):
            session.run(0.5)
        taken = [a for _, a in session.actions if isinstance(a, TakePairs)]
        assert len(taken) == 1
        assert all(look.sweep == 0 for look in taken[0].looks)


def test_a_fibre_that_moves_while_the_edges_are_searched_keeps_the_pm() -> None:
    session = rehearsal(aims=0)
    while not any("until it was looked at from both sides" in tell.text for _, tell in session.messages):
        session.run(0.1)
    session.room.proceed(session.now_s)
    session.run(1.5)
    taken = [a for _, a in session.actions if isinstance(a, TakePairs)]
    assert len(taken) == 1
    assert all(look.sweep == 0 for look in taken[0].looks)
    assert any("the fibre has moved during the search" in tell.text for _, tell in session.messages)


def test_a_stage_that_was_not_asked_to_turn_does_not() -> None:
    session = rehearsal(aims=0, obliging=False)
    session.run(25.0)
    assert session.actions == []
    wants = [tell.wants for _, tell in session.messages if tell.wants is not None]
    assert 2 <= len(wants) <= 4  # asked again from time to time, not at every frame


def test_a_fibre_that_moves_during_a_search_gives_no_pair() -> None:
    session = rehearsal(aims=0)
    while not any(isinstance(a, Sweep) for _, a in session.actions):
        session.run(0.1)
    session.run(0.3)
    session.room.proceed(session.now_s)
    session.run(0.6)
    assert not any(isinstance(a, TakePairs) for _, a in session.actions)
    assert any("the fibre has moved during the search" in tell.text for _, tell in session.messages)


def test_the_search_for_a_pm_that_is_not_detected_ends_with_a_message() -> None:
    session = rehearsal(aims=0, no_source_from_s=0.0)
    session.run(45.0)
    assert not any(isinstance(a, TakePairs) for _, a in session.actions)
    assert any("nothing detected between" in tell.text and tell.done for _, tell in session.messages)


def test_without_the_marker_nothing_is_searched() -> None:
    session = rehearsal(aims=0, no_marker_from_s=0.0)
    session.run(15.0)
    assert not any(isinstance(a, Sweep) for _, a in session.actions)


@pytest.mark.parametrize("pictures", [True, False])
def test_a_marker_lost_during_a_search_ends_it(pictures: bool) -> None:
    session = rehearsal(aims=0)
    while not any(isinstance(a, Sweep) for _, a in session.actions):
        session.run(0.1)
    if pictures:
        session.no_marker_from_s = session.now_s
    else:  # camera lost, or the machine too slow: the marker may well be in view
        session.no_picture_from_s = session.now_s
    before = len(session.messages)
    session.run(10.0)
    told = [tell for _, tell in session.messages[before:]]
    assert any("the marker is not seen" in tell.text for tell in told) is pictures
    assert any("no new picture was looked at" in tell.text for tell in told) is not pictures
    assert any(tell.done for tell in told) is pictures, "the fibre goes on"
    assert not any(isinstance(a, TakePairs) for _, a in session.actions)


def test_a_verification_searches_new_pms_and_adds_nothing(whole: Rehearsal) -> None:
    known, before = whole.engine.estimate.pairs, len(whole.actions)
    whole.say(CommandKind.VERIFY)
    taken: list[TakeVerify] = []
    end_s = whole.now_s + 90.0
    while len(taken) < VERIFY_PMS and whole.now_s < end_s:
        whole.run(0.5)
        taken = [a for _, a in whole.actions[before:] if isinstance(a, TakeVerify)]
    assert [(a.number, a.count) for a in taken] == [(i, VERIFY_PMS) for i in range(VERIFY_PMS)]
    last = whole.actions.index(next(entry for entry in whole.actions if entry[1] is taken[-1]))
    assert not any(isinstance(a, TakePairs | Follow) for _, a in whole.actions[before:last])
    looks = [event for a in taken for event in pair_events(a.number, one_spot(a.looks), 0.0, whole.model.stage)]
    found = compared(looks, whole.engine.snapshot(), whole.model, SolveConfig())
    assert found.validity is Validity.VALID, (found.reason, known)


def test_with_static_tags_no_order_comes_from_a_bumped_camera_and_the_registration_goes_on(whole: Rehearsal) -> None:
    # it changes the session: of the tests that use it only the next one comes later
    orders, bumps = len(whole.actions), 3
    for _ in range(bumps):
        whole.room.bump(whole.now_s)
        whole.run(8.0)
    followed = [action for _, action in whole.actions[orders:] if isinstance(action, Follow)]
    assert followed
    off = [(action.scan_rad - whole.room.plane_rad(action.marker_s)) / action.sigma_rad for action in followed]
    assert max(map(abs, off)) < 4.0, "in sigmas of what was said"
    estimate = whole.engine.estimate
    assert estimate.epoch == bumps
    assert estimate.verdict is not Verdict.REFUSED
    assert estimate.predicted_tre is not None
    assert whole.error_mm() < estimate.predicted_tre.worst_mm
    assert any("as measured" in tell.text for _, tell in whole.messages)


def test_after_a_reported_move_it_halts_and_searches_again(whole: Rehearsal) -> None:
    # last of the tests that use the session: it changes it
    whole._tags = None  # nobody but the operator says that the camera has moved
    whole.room.bump(whole.now_s)
    whole.run(1.0)
    before = len(whole.actions)
    whole.say(CommandKind.MOVED)
    whole.run(30.0)
    after = [a for _, a in whole.actions[before:]]
    assert isinstance(after[0], TakeMove)
    assert isinstance(after[1], Halt), "the step of the word follows nothing"
    assert not any(isinstance(a, Follow) for a in after)
    assert any(isinstance(a, Ask) and a.kind is MotionKind.SEARCH for a in after)
    assert any(isinstance(a, TakePairs) for a in after)
    assert whole.workflow.stage is Stage.COLLECTING


def test_an_epoch_that_stays_refused_is_reported_with_what_helps() -> None:
    session = rehearsal(aims=0)  # without a beam nothing can be registered
    session.workflow = Workflow(
        session.model, WorkflowSettings(aims=0, pms=2, most_pms=2, hearing_threshold=session.threshold)
    )
    while session.now_s < 200.0 and sum(isinstance(a, TakePairs) for _, a in session.actions) < 5:
        session.run(1.0)
    messages = [tell.text for _, tell in session.messages if "the camera was moved, say moved (m)" in tell.text]
    assert [text.split()[0] for text in messages] == ["2", "4"]
    assert all("the beam has no start" in text for text in messages)


def test_a_bump_after_few_pms_ends_in_following_all_the_same() -> None:
    session = rehearsal(4, frame_s=1.0 / 30.0)
    settings = WorkflowSettings(aims=8, pms=8, most_pms=9, hearing_threshold=session.threshold)
    session.workflow = Workflow(session.model, settings)
    while sum(isinstance(a, TakePairs) for _, a in session.actions) < 2:
        session.run(0.5)
    bumped_s = session.now_s
    session.room.bump(bumped_s)
    while session.workflow.stage is not Stage.FOLLOWING and session.now_s < bumped_s + 400.0:
        session.run(1.0)
    # While the odds favour a move, but not so much that it is found, the registration is refused: more PMs are taken.
    assert session.workflow.stage is Stage.FOLLOWING
    assert session.engine.moves
    estimate = session.engine.estimate
    assert estimate.epoch == len(session.engine.moves)
    assert estimate.predicted_tre is not None
    assert session.error_mm() < max(2.0, 1.5 * estimate.predicted_tre.worst_mm)


@pytest.mark.parametrize(
    "changes", [{"aims": -1}, {"pms": 0}, {"pms": 20}, {"hearing_threshold": 0.0}, {"hearing_threshold": math.nan}]
)
def test_settings_that_cannot_be_are_refused(changes: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(changes)).split("_")[0]):
        WorkflowSettings(**{"hearing_threshold": 1.0, **changes})  # type: ignore[arg-type]


def test_pairs_wait_for_a_frame_that_shows_the_static_tags_at_rest() -> None:
    def step(now_s: float, still_until_s: float, moving_s: float | None = None) -> list[TakePairs | Tell]:
        view = Inputs(now_s, PoseHistory(), None, (), (), RegistrationState(), None, 0, moving_s, still_until_s)
        return [action for action in workflow.step(view) if isinstance(action, TakePairs | Tell)]

    def held() -> TakePairs:
        return TakePairs(0, (LocatedPulse(10.0, 0.1), LocatedPulse(9.0, 0.1)))

    workflow = rehearsal(static_tags=3).workflow
    workflow._held = [held()]
    assert not any(isinstance(action, TakePairs) for action in step(10.2, 9.9))
    assert [a.pm for a in step(10.3, 10.1) if isinstance(a, TakePairs)] == [0]
    workflow._held = [held()]
    moved = step(10.4, 9.9, 10.2)
    assert any(isinstance(action, Tell) and "they are not used" in action.text for action in moved)
    assert not any(isinstance(action, TakePairs) for action in [*moved, *step(20.0, math.inf)])
    workflow._held = [held()]
    assert any(isinstance(action, TakePairs) for action in step(10.0 + SHOWN_S + 0.1, 9.9)), "no tag is in view"
    workflow._held = [held()]
    assert [pairs.pm for pairs in workflow.still_held()] == [0], "the session ends"
    assert workflow.still_held() == ()
