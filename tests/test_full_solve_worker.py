"""The full solve in a worker process: its results are those of the same process, late ones fit, a dead worker costs no
event.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from fgreg.model.estimate import CertificateEstimate, Verdict
from fgreg.model.measurements import Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.events import CameraMoved
from fgreg.online.full_solve import FullSolveCase, FullSolveResult
from fgreg.online.solver import InProcessSolver, WorkerSolver
from fgreg.registration import solve as batch_solve
from fgreg.registration.proof import Proof
from fgreg.registration.verdict import Condition
from fgreg.workers.worker_process import WorkerProcess
from tests.forward import make_measurements
from tests.online_streams import batch, first, restored, run, sigmas_apart

PATIENCE_S = 60.0
PAIRS = 8
"""That are there before each test; the next one is due."""


@pytest.fixture(scope="module")
def case() -> tuple[SessionModel, Measurements]:
    model, measurements, _ = make_measurements(np.random.default_rng(4), pairs=PAIRS + 4)
    return model, measurements


@pytest.fixture
def working(case: tuple[SessionModel, Measurements]) -> Iterator[OnlineRegistration]:
    with OnlineRegistration(case[0], full_solve="worker", find_moves=False) as engine:
        yield restored(engine, first(case[1], PAIRS))


def _worker(engine: OnlineRegistration) -> WorkerProcess[FullSolveCase, FullSolveResult]:
    assert isinstance(engine._solver, WorkerSolver)
    return engine._solver._worker


def _refreshed(engine: OnlineRegistration, until: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not until():
        assert time.monotonic() < end
        time.sleep(0.01)
        engine.refresh()


def test_a_worker_reports_what_the_same_process_does(
    case: tuple[SessionModel, Measurements], working: OnlineRegistration
) -> None:
    model, measurements = case
    here = restored(OnlineRegistration(model, find_moves=False), first(measurements, PAIRS))
    expected = here.add(measurements.pairs[PAIRS])
    assert expected.settled
    waited = working.add(measurements.pairs[PAIRS])
    assert not waited.settled  # no event waits for it
    assert waited.trus_T_camera is not None
    _refreshed(working, lambda: working.estimate.settled)
    found = working.estimate
    assert (found.verdict, found.reasons, found.pairs) == (expected.verdict, expected.reasons, expected.pairs)
    assert found.used is waited.used
    np.testing.assert_allclose(np.asarray(found.trus_T_camera), np.asarray(expected.trus_T_camera), rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.asarray(found.covariance), np.asarray(expected.covariance), rtol=1e-5, atol=1e-9)
    assert working.inliers == here.inliers


def test_a_worker_killed_at_its_case_is_replaced_and_the_case_is_solved(
    case: tuple[SessionModel, Measurements], working: OnlineRegistration
) -> None:
    _refreshed(working, lambda: _worker(working).ready)
    pid = _worker(working).pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)  # so that it has the case, and has not solved it
    working.add(case[1].pairs[PAIRS])
    assert working._solver.busy
    os.kill(pid, signal.SIGKILL)
    _refreshed(working, lambda: "process has ended" in " ".join(working.estimate.reasons))
    assert working.estimate.verdict.severity >= Verdict.WARNING.severity
    assert working.estimate.trus_T_camera is not None
    _refreshed(working, lambda: working.estimate.settled)
    assert working.estimate.pairs == PAIRS + 1
    assert not any("has ended" in reason for reason in working.estimate.reasons)
    assert _worker(working).pid != pid


def test_closed_its_process_is_gone_and_the_estimate_stays(
    case: tuple[SessionModel, Measurements], working: OnlineRegistration
) -> None:
    estimate = working.estimate
    working.close()
    assert not _worker(working).alive
    assert working.estimate is estimate


def test_another_place_for_the_full_solve_is_refused(case: tuple[SessionModel, Measurements]) -> None:
    with pytest.raises(ValueError, match="expected 'in_process' or 'worker'"):
        OnlineRegistration(case[0], full_solve="often")  # type: ignore[arg-type]


# --- results that come late, without a process ------------------------------------------------------------------------


class Late(InProcessSolver):
    """Gives its result only when it is released."""

    released = False

    def submit(self, case: FullSolveCase) -> None:
        """Solve, and keep it."""
        super().submit(case)
        self.busy, self.released = True, False

    def fetch(self) -> FullSolveResult | None:
        """The result, where it is released."""
        if not self.released:
            return None
        self.busy = False
        return super().fetch()


@pytest.fixture
def late(case: tuple[SessionModel, Measurements]) -> tuple[OnlineRegistration, Late]:
    engine = OnlineRegistration(case[0], verdicts=False, find_moves=False)
    solver = Late(case[0], SolveConfig(), verdicts=False)
    engine._solver = solver
    return restored(engine, first(case[1], PAIRS)), solver


def test_pairs_that_came_while_it_was_under_way_count_on_top_of_it(
    case: tuple[SessionModel, Measurements], late: tuple[OnlineRegistration, Late]
) -> None:
    model, measurements = case
    engine, solver = late
    run(engine, Measurements((), measurements.pairs[PAIRS : PAIRS + 1], measurements.epochs))
    assert solver.busy
    run(engine, Measurements((), measurements.pairs[PAIRS + 1 :], measurements.epochs))
    solver.released = True
    estimate = engine.refresh()
    assert solver.busy  # they are due as well
    assert estimate.pairs == len(measurements.pairs)
    assert sigmas_apart(batch(measurements, model), estimate) < 0.05


def test_a_result_about_pairs_that_are_of_other_epochs_by_now_is_dropped(
    case: tuple[SessionModel, Measurements], late: tuple[OnlineRegistration, Late]
) -> None:
    engine, solver = late
    pairs = case[1].pairs
    engine.add(pairs[PAIRS])
    assert solver.busy
    # The camera moved before the last three pairs, as becomes known now.
    moved = engine.add(CameraMoved(pairs[PAIRS].t + 0.5, detected=True, since_t=pairs[PAIRS - 2].t))
    assert (moved.epoch, moved.trus_T_camera) == (1, None)
    solver.released = True
    assert engine.refresh().trus_T_camera is None
    assert solver.busy  # asked again, with the epochs as they are
    assert [pair.epoch for pair in engine.measurements().pairs] == [0] * (PAIRS - 2) + [1] * 3
    solver.released = True
    estimate = engine.refresh()
    assert estimate.epoch == 1
    assert estimate.pairs <= 3
    assert engine.state.epochs[0].state is not None


# --- proofs -----------------------------------------------------------------------------------------------------------

PROVING = SolveConfig(certificate_budget=200_000)
PROVED, OTHER = "no other registration explains these pairs", "another registration explains the pairs as well"


@pytest.fixture
def proving(case: tuple[SessionModel, Measurements]) -> tuple[OnlineRegistration, Late]:
    """With the proofs of the full solves given when they are released."""
    engine, prover = OnlineRegistration(case[0], PROVING, find_moves=False), Late(case[0], PROVING, verdicts=True)
    engine._proofs._solver = prover
    return restored(engine, first(case[1], PAIRS)), prover


def test_a_proof_is_reported_when_it_is_there_and_nothing_waits_for_it(
    case: tuple[SessionModel, Measurements], proving: tuple[OnlineRegistration, Late]
) -> None:
    engine, prover = proving
    before = engine.estimate
    assert prover.busy
    assert before.settled
    assert PROVED not in " ".join(before.reasons)
    prover.released = True
    after = engine.refresh()
    assert (after.verdict, after.settled) == (before.verdict, True)
    assert PROVED in " ".join(after.reasons)
    assert not prover.busy
    prover.failure = "the proof's process has ended"
    assert "not certified: the proof's process has ended" in engine.refresh().reasons
    assert engine.estimate.verdict is before.verdict
    engine.add(case[1].pairs[PAIRS])
    assert prover.busy  # the next full solve's
    assert PROVED not in " ".join(engine.estimate.reasons)


def test_a_registration_that_a_proof_refuses_stays_refused_until_the_next_proof(
    case: tuple[SessionModel, Measurements],
    proving: tuple[OnlineRegistration, Late],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    engine, prover = proving
    found = CertificateEstimate(False, 0.0, 9.2, None, None, np.eye(4), OTHER)
    proof = Proof(found, (Condition(Verdict.REFUSED, OTHER),))
    monkeypatch.setattr(batch_solve, "prove", lambda *_: proof)
    engine.add(case[1].pairs[PAIRS])  # while the one before is being proved, which ends in vain
    for _ in range(3):
        prover.released = True
        estimate = engine.refresh()
    assert not prover.busy
    assert (estimate.verdict, estimate.reasons.count(OTHER)) == (Verdict.REFUSED, 1)
    monkeypatch.undo()
    for pair in case[1].pairs[PAIRS + 1 :]:
        estimate = engine.add(pair)
        assert (estimate.verdict, estimate.reasons.count(OTHER)) == (Verdict.REFUSED, 1)
    assert prover.busy
    for _ in range(3):
        prover.released = True
        estimate = engine.refresh()
    assert estimate.verdict is not Verdict.REFUSED
    assert OTHER not in estimate.reasons
    assert PROVED in " ".join(estimate.reasons)


def test_what_is_proved_of_pairs_that_are_of_other_epochs_by_now_does_not_count(
    case: tuple[SessionModel, Measurements], proving: tuple[OnlineRegistration, Late]
) -> None:
    engine, prover = proving
    engine.add(CameraMoved(case[1].pairs[PAIRS].t - 0.01))
    prover.released = True
    assert PROVED not in " ".join(engine.refresh().reasons)
