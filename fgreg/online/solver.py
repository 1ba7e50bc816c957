"""Where the full solve runs: within the engine's calls, or in a worker process."""

from __future__ import annotations

from functools import partial
from typing import Literal, Protocol

from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.full_solve import FullSolveCase, FullSolveResult, full_solve
from fgreg.workers.worker_process import NICENESS, Work, WorkerProcess

Where = Literal["in_process", "worker"]


class Solver(Protocol):
    """Solves one case after another.

    ``busy``: a case is being solved. ``failure``: why the last one failed; empty where it did not. ``lost``: whether it
    was lost because its process ended.
    """

    failure: str
    lost: bool

    @property
    def busy(self) -> bool: ...

    def submit(self, case: FullSolveCase) -> None:
        """Start on a case; not to be called while ``busy``."""

    def fetch(self) -> FullSolveResult | None:
        """A result that has not been fetched yet; None without one."""

    def close(self) -> None:
        """Stop."""


class InProcessSolver:
    """Solves at once: the same events give the same results."""

    def __init__(self, model: SessionModel, config: SolveConfig, *, verdicts: bool) -> None:
        self._work = partial(full_solve, model=model, config=config, verdicts=verdicts)
        self._found: FullSolveResult | None = None
        self.failure = ""
        self.busy = self.lost = False

    def submit(self, case: FullSolveCase) -> None:
        """Solve now."""
        self._found, self.failure = None, ""
        try:
            self._found = self._work(case)
        except Exception as error:  # the incremental estimate stays valid
            self.failure = f"{type(error).__name__}: {error}"

    def fetch(self) -> FullSolveResult | None:
        """What :meth:`submit` found."""
        found, self._found = self._found, None
        return found

    def close(self) -> None:
        """Nothing to stop."""


class WorkerSolver:
    """Solves in a worker process; ``name`` and ``what``: of it, as in messages, ``niceness``: added to the owner's."""

    def __init__(
        self,
        model: SessionModel,
        config: SolveConfig,
        *,
        verdicts: bool,
        name: str = "fgreg-solve",
        what: str = "the full solve's process",
        niceness: int = NICENESS,
    ) -> None:
        self._what = what
        self._worker: WorkerProcess[FullSolveCase, FullSolveResult] = WorkerProcess(
            _work, model, config, verdicts, name=name, what=what, niceness=niceness
        )

    @property
    def busy(self) -> bool:
        """Whether a case is being solved."""
        return self._worker.busy

    @property
    def failure(self) -> str:
        """Why the last case failed; empty where it did not."""
        waits = self._worker.busy and self._worker.trouble  # the process does not take the case
        return f"{self._what}: {self._worker.trouble}" if waits else self._worker.failure

    @failure.setter
    def failure(self, text: str) -> None:
        self._worker.failure = text

    @property
    def lost(self) -> bool:
        """Whether the last case was lost with its process."""
        return self._worker.lost

    @lost.setter
    def lost(self, value: bool) -> None:
        self._worker.lost = value

    def submit(self, case: FullSolveCase) -> None:
        """Send a case to the worker process."""
        self._worker.send(case)

    def fetch(self) -> FullSolveResult | None:
        """The worker process's result; None while there is none."""
        found = self._worker.fetch()
        return None if found is None else found[0]

    def close(self) -> None:
        """End the worker process."""
        self._worker.close()


def _work(model: SessionModel, config: SolveConfig, verdicts: bool) -> Work[FullSolveCase, FullSolveResult]:
    return partial(full_solve, model=model, config=config, verdicts=verdicts)


def make_solver(where: Where, model: SessionModel, config: SolveConfig, *, verdicts: bool) -> Solver:
    """The solver for ``full_solve`` = ``where``.

    Raises:
        ValueError: there is no such kind.
    """
    if where == "in_process":
        return InProcessSolver(model, config, verdicts=verdicts)
    if where == "worker":
        return WorkerSolver(model, config, verdicts=verdicts)
    raise ValueError(f"full_solve is {where!r}, expected 'in_process' or 'worker'")


def make_prover(where: Where, model: SessionModel, config: SolveConfig) -> Solver:
    """As :func:`make_solver`, for the proofs that follow full solves: it gives way to these."""
    if where == "worker":
        what, niceness = "the proof's process", 2 * NICENESS
        return WorkerSolver(model, config, verdicts=True, name="fgreg-proof", what=what, niceness=niceness)
    return make_solver(where, model, config, verdicts=True)
