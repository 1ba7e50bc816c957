"""The proof that follows each full solve of the current epoch (fgreg.registration.proof), by a solver of its own.

It takes up to some seconds, and nothing waits for it: where pairs come faster, what they replace is not proved.
"""

from __future__ import annotations

from dataclasses import replace

from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.full_solve import FullSolveCase, Report
from fgreg.online.solver import Where, make_prover


class Proofs:
    """Proves one full solve after another; none where ``config`` asks for no proof.

    ``failure``: why the last proof failed; empty where it did not. ``refusal``: why the last one of this epoch refused
    the registration; empty where it did not.
    """

    def __init__(self, where: Where, model: SessionModel, config: SolveConfig) -> None:
        wanted = config.certificate_budget > 0
        self._solver = make_prover(where, model, config) if wanted else None
        self._waiting: FullSolveCase | None = None
        self._counts = False  # whether the case under way is of the pairs as they are divided now
        self.refusal = ""

    @property
    def failure(self) -> str:
        """See the class."""
        return "" if self._solver is None else self._solver.failure

    def want(self, case: FullSolveCase) -> None:
        """Prove what the full solve of this case found, instead of a case that still waits."""
        self._waiting = replace(case, move=None, draft=False, detected=False, certify=True)

    def forget(self) -> None:
        """The pairs were divided into epochs again: what was proved is of others."""
        self._waiting, self._counts, self.refusal = None, False, ""

    def fetch(self, of: Report | None) -> Report | None:
        """The report ``of`` the last full solve with its proof; None while there is none.

        A refusal counts for later pairs, too, until their proof.
        """
        if self._solver is None:
            return None
        if self._waiting is not None and not self._solver.busy:
            case, self._waiting, self._counts = self._waiting, None, True
            self._solver.submit(case)
        found = self._solver.fetch()
        if found is None or found.report is None or of is None or not self._counts:
            return None
        of_epochs = found.report.epochs
        certificate = of_epochs[found.epoch].estimate.certificate if of_epochs else None
        refuses = certificate is not None and certificate.other_trus_T_camera is not None
        is_last = found.serial == of.serial
        if certificate is not None and (is_last or refuses):
            self.refusal = certificate.reason if refuses else ""
        return found.report if is_last else None

    def close(self) -> None:
        """End its worker process, if there is one."""
        if self._solver is not None:
            self._solver.close()
