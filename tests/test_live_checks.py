"""Check points in a live session: the operator names them, and the verdict follows."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgreg.drivers.base import CommandKind, OperatorCommand
from fgreg.geometry.transforms import FloatArray, inverse, transform_points
from fgreg.model.estimate import Verdict
from fgreg.model.events import CheckEvent, ExcludeEvent, PointEvent
from fgreg.model.lens import project
from fgreg.session.session_reader import read_session
from tests.test_live_camera_moves import Stand, standing


@pytest.fixture
def stand(pose_session: Path) -> Iterator[Stand]:
    with standing(pose_session) as found:
        found.turn(1.0)
        yield found


def say_check(stand: Stand, error_mm: FloatArray, kind: CommandKind = CommandKind.CHECK) -> None:
    """The operator's check (or point) in the present plane, at which the registration is off by ``error_mm``."""
    model, estimate = stand.session.journal.model, stand.session.estimate
    assert estimate is not None
    assert estimate.trus_T_camera is not None
    rig = model.camera
    assert rig is not None
    assert rig.right is not None
    assert rig.right_T_left is not None
    reach = model.probe.radius_mm + 30.0
    status = stand.link.view.status
    assert status is not None
    scan = model.stage.scan_from_device(status.scan_rad)
    trus_p = np.array([2.0, reach * math.sin(scan), reach * math.cos(scan)])
    camera_p = transform_points(inverse(estimate.trus_T_camera), (trus_p + error_mm)[None])[0]
    left, right = project(rig.left, camera_p), project(rig.right, transform_points(rig.right_T_left, camera_p[None])[0])
    point = (float(left[0]), float(left[1]), float(right[0]), float(right[1]), 2.0, 30.0)
    stand.operator.waiting.append(OperatorCommand(kind, point=point))


def checks_on_disk(stand: Stand) -> list[CheckEvent]:
    return [e for e in read_session(stand.session.journal.folder).events if isinstance(e, CheckEvent)]


def checks_known(stand: Stand) -> int:
    estimate = stand.recorder.state.estimate
    return 0 if estimate is None else len(estimate.checks)


def test_a_check_that_the_operator_names_is_recorded_and_compared(stand: Stand) -> None:
    say_check(stand, np.array([0.3, 0.0, 0.0]))
    stand.turn(5.0, lambda: checks_known(stand) == 1)
    (event,) = checks_on_disk(stand)
    assert event.trus is not None
    estimate = stand.recorder.state.estimate
    assert estimate is not None
    (check,) = estimate.checks
    assert check.error_mm is not None
    assert check.error_mm[0] == pytest.approx(0.3, abs=0.02)
    assert check.verdict is Verdict.OK
    assert any("check taken" in told for told in stand.operator.messages)


def test_a_check_that_is_off_costs_the_ok(stand: Stand) -> None:
    say_check(stand, np.array([6.0, 0.0, 0.0]))
    stand.turn(5.0, lambda: checks_known(stand) == 1)
    known = stand.recorder.state.registration
    assert known.verdict is Verdict.WARNING
    assert any("the check is off by 6.0 mm along the probe" in reason for reason in known.reasons)


def test_a_point_that_the_operator_names_is_data_until_it_is_left_out(stand: Stand) -> None:
    say_check(stand, np.array([0.3, 0.0, 0.0]), CommandKind.POINT)
    stand.turn(5.0, lambda: bool(stand.session.measurements().points))
    assert any("point taken" in told for told in stand.operator.messages)
    (event,) = [e for e in read_session(stand.session.journal.folder).events if isinstance(e, PointEvent)]
    stand.recorder.hand_over(ExcludeEvent(event.t, 0, shot_line=event.line))
    stand.turn(10.0, lambda: bool(stand.session.excluded) and not stand.recorder.state.choosing)
    assert not stand.session.measurements().points
    reasons = stand.recorder.state.registration.reasons
    assert any("left out by hand (known point 0)" in reason for reason in reasons)


def test_a_stage_that_is_not_homed_knows_no_angle_for_a_check(stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    view = stand.link.view
    assert view.status is not None
    unhomed = replace(view, status=replace(view.status, homed=False))
    monkeypatch.setattr(type(stand.link), "view", property(lambda _: unhomed))
    say_check(stand, np.zeros(3), CommandKind.POINT)
    stand.turn(1.0, lambda: any("no point: the stage is not homed" in told for told in stand.operator.messages))
    assert any("no point: the stage is not homed" in told for told in stand.operator.messages)
    assert not stand.session.measurements().points


def test_pixels_that_are_of_no_point_are_answered(stand: Stand) -> None:
    command = OperatorCommand(CommandKind.CHECK, point=(100.0, 100.0, 90.0, 180.0, 0.0, 30.0))
    stand.operator.waiting.append(command)
    stand.turn(1.0, lambda: any("no check" in told for told in stand.operator.messages))
    assert any("px apart across the epipolar line" in told for told in stand.operator.messages)
    assert checks_on_disk(stand) == []
