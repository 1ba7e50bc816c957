"""Everything that a tracking query needs, as plain arrays, so that queries do not depend on the running estimation.

A query concerns one camera epoch and one PM. So from the joint covariance of the shared variables it needs the block of
its registration and the common variables: 16 variables in a fixed order, with zero variance where one is not estimated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.rig import COUNT
from fgreg.geometry.transforms import FloatArray, IntArray
from fgreg.graph.columns import Columns, make_columns
from fgreg.graph.shared_state import SharedState
from fgreg.model.estimate import Verdict
from fgreg.model.probe_model import SensitivityModel
from fgreg.model.session_model import SessionModel, StageModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.tissue_surface import TissueSurface

SHARED = 10 + COUNT
"""Size of an epoch's covariance: registration 6, beam 4, and a place for each of the rig's constants."""


@dataclass(frozen=True, slots=True, eq=False)
class EpochSnapshot:
    """One camera epoch: ``trus_T_camera`` as rotation (3, 3) and translation (3,) mm, covariance (SHARED, SHARED).

    ``verdict`` and ``reason``: queries of a refused epoch are not answered.
    """

    number: int
    verdict: Verdict
    rotation: FloatArray
    translation_mm: FloatArray
    covariance: FloatArray
    reason: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """The estimate at one moment.

    Attributes:
        t: session time of the last event taken in. pairs: number of pairs. causal: whether no later events are used.
        epochs: those with a registration, and those refused.
        marker_T_nominal: (4, 4) of the beam chart. beam: (4,). origin_shift_mm: lambda of the laser frame's origin.
        constants: (COUNT,) as in :class:`fgreg.graph.shared_state.SharedState`. radius_mm: the declared one.
        sensitivity, stage: of the session. amplitude_sigma, window_shape: of its configuration.
        surface: where the PMs trace one.
        oldest: lowest number of the epochs that it may have.
    """

    t: float
    pairs: int
    causal: bool
    epochs: tuple[EpochSnapshot, ...]
    marker_T_nominal: FloatArray
    beam: FloatArray
    origin_shift_mm: float
    constants: FloatArray
    radius_mm: float
    sensitivity: SensitivityModel
    stage: StageModel
    amplitude_sigma: float
    window_shape: bool
    surface: TissueSurface | None
    oldest: int = 0

    def epoch(self, number: int) -> EpochSnapshot | None:
        """The epoch of that number."""
        for epoch in self.epochs:
            if epoch.number == number:
                return epoch
        return None

    def shared(self, epoch: EpochSnapshot) -> tuple[SharedState, Columns, FloatArray]:
        """An epoch's shared variables: values (one hypothesis), columns and covariance (D, D) of those estimated."""
        estimated = np.diag(epoch.covariance) > 0.0
        columns = make_columns(1, np.diag(epoch.covariance)[10:])
        state = SharedState(
            rotation=epoch.rotation[None, None],
            translation_mm=epoch.translation_mm[None, None],
            marker_T_nominal=self.marker_T_nominal[None],
            beam=self.beam[None],
            constants=self.constants[None],
        )
        return state, columns, epoch.covariance[np.ix_(estimated, estimated)]

    @classmethod
    def without_registration(cls, model: SessionModel, config: SolveConfig, refused: Mapping[int, str]) -> Snapshot:
        """A snapshot without a registration: all epochs are refused, with the reason (which may be empty)."""
        return cls(
            t=0.0,
            pairs=0,
            causal=True,
            epochs=tuple(_refused_epoch(number, reason) for number, reason in sorted(refused.items())),
            marker_T_nominal=np.eye(4),
            beam=np.zeros(4),
            origin_shift_mm=0.0,
            constants=np.zeros(COUNT),
            radius_mm=model.probe.radius_mm,
            sensitivity=model.probe.sensitivity,
            stage=model.stage,
            amplitude_sigma=config.amplitude_sigma,
            window_shape=config.window_shape,
            surface=None,
        )


def _refused_epoch(number: int, reason: str) -> EpochSnapshot:
    nothing = np.zeros((SHARED, SHARED))
    return EpochSnapshot(number, Verdict.REFUSED, np.eye(3), np.zeros(3), nothing, reason)


def _epoch_columns(columns: Columns, place: int) -> tuple[IntArray, IntArray]:
    """Columns of the whole covariance that concern an epoch, and their places among the ``SHARED``."""
    whole = [*range(6 * place, 6 * place + 6), *range(columns.beam, columns.size)]
    mine = [*range(10), *(10 + constant for constant in columns.constants)]
    return np.array(whole), np.array(mine)


def make_snapshot(
    model: SessionModel,
    config: SolveConfig,
    state: SharedState,
    covariance: FloatArray,
    columns: Columns,
    epochs: Sequence[int],
    *,
    origin_shift_mm: float,
    surface: TissueSurface | None,
    causal: bool,
    t: float = 0.0,
    pairs: int = 0,
    refused: Mapping[int, str] | None = None,
) -> Snapshot:
    """A snapshot of an estimate.

    Args:
        model, config: of the session.
        state: one hypothesis; its registrations are those of ``epochs``.
        covariance: (D, D) of the shared variables, laid out by ``columns``.
        epochs: the session's numbers of the epochs with a registration.
        origin_shift_mm, surface, causal, t, pairs: as in :class:`Snapshot`.
        refused: further epochs, or some of ``epochs``, whose queries are not answered, and why (may be empty).
    """
    refused = {} if refused is None else refused
    found = []
    for place, number in enumerate(epochs):
        whole, mine = _epoch_columns(columns, place)
        block = np.zeros((SHARED, SHARED))
        block[np.ix_(mine, mine)] = covariance[np.ix_(whole, whole)]
        verdict = Verdict.REFUSED if number in refused else Verdict.OK
        rotation, translation = state.rotation[0, place].copy(), state.translation_mm[0, place].copy()
        found.append(EpochSnapshot(number, verdict, rotation, translation, block, refused.get(number, "")))
    found += [_refused_epoch(number, reason) for number, reason in refused.items() if number not in epochs]
    return Snapshot(
        t=t,
        pairs=pairs,
        causal=causal,
        epochs=tuple(sorted(found, key=lambda epoch: epoch.number)),
        marker_T_nominal=state.marker_T_nominal[0].copy(),
        beam=state.beam[0].copy(),
        origin_shift_mm=origin_shift_mm,
        constants=state.constants[0].copy(),
        radius_mm=model.probe.radius_mm,
        sensitivity=model.probe.sensitivity,
        stage=model.stage,
        amplitude_sigma=config.amplitude_sigma,
        window_shape=config.window_shape,
        surface=surface,
    )
