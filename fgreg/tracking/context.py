"""What queries about a solved session are answered from."""

from __future__ import annotations

from dataclasses import dataclass, field

from fgreg.config import SolveConfig
from fgreg.estimate import TrackEstimate
from fgreg.frames import FloatArray
from fgreg.graph.shared_state import SharedState
from fgreg.measurements import Track
from fgreg.models import SessionModel
from fgreg.posterior import Posterior
from fgreg.surface import TissueSurface
from fgreg.tracking.answer import fast_track
from fgreg.tracking.snapshot import Snapshot


@dataclass(frozen=True, slots=True, eq=False)
class TrackContext:
    """What a query is answered from.

    Attributes:
        model: the session's set-up.
        epochs: the session's numbers of the solved epochs, in the order of ``state``.
        state: the estimate (one hypothesis). covariance: (D, D) of its shared variables. posterior: their samples.
        surface: the tissue surface, where the PMs trace one.
        origin_shift_mm: lambda of the laser frame's origin in the beam chart.
        causal: whether only what was known at the query's time entered.
        config: that of the session's solve.
    """

    model: SessionModel
    epochs: tuple[int, ...]
    state: SharedState
    covariance: FloatArray
    posterior: Posterior
    surface: TissueSurface | None
    origin_shift_mm: float
    causal: bool = False
    config: SolveConfig = field(default_factory=SolveConfig)


def track(query: Track, context: TrackContext) -> TrackEstimate:
    """Answer one query; of many, make the :class:`Snapshot` once and call :func:`fast_track`."""
    return fast_track(query, Snapshot.from_context(context))
