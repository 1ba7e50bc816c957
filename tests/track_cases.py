"""Snapshots and queries for tests of tracking at camera rate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.rig import COUNT
from fgreg.model.estimate import Verdict
from fgreg.model.measurements import Measurements, Pair, Track
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.tissue_surface import TissueSurface
from fgreg.registration.posterior import Posterior
from fgreg.registration.solve import Solution, solve
from fgreg.tracking.snapshot import SHARED, EpochSnapshot, Snapshot


def held_out(measurements: Measurements, count: int) -> tuple[Measurements, list[list[Pair]]]:
    """The measurements without their last ``count`` PMs, and the looks at each of those."""
    pms = sorted({pair.pm for pair in measurements.pairs})[-count:]
    kept = tuple(pair for pair in measurements.pairs if pair.pm not in pms)
    return replace(measurements, pairs=kept), [[p for p in measurements.pairs if p.pm == pm] for pm in pms]


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A solved session: the snapshot that queries are answered from, and all epochs' variables for the reference."""

    model: SessionModel
    config: SolveConfig
    epochs: tuple[int, ...]
    posterior: Posterior
    snapshot: Snapshot


def solved_of(solution: Solution, model: SessionModel, config: SolveConfig) -> Solved:
    """A solution with an estimate."""
    assert solution.registration is not None
    assert solution.posterior is not None
    assert solution.snapshot is not None
    return Solved(model, config, solution.registration.epochs, solution.posterior, solution.snapshot)


def solved(measurements: Measurements, model: SessionModel, config: SolveConfig | None = None) -> Solved:
    """The measurements solved, on a stage that turns any way; answered whatever the verdict."""
    config = config or SolveConfig()
    found = solved_of(solve(measurements, [], model, config), model, config)
    stage = replace(model.stage, limits_device_rad=(-4.0, 4.0))
    epochs = tuple(replace(epoch, verdict=Verdict.OK, reason="") for epoch in found.snapshot.epochs)
    return replace(
        found, model=replace(model, stage=stage), snapshot=replace(found.snapshot, stage=stage, epochs=epochs)
    )


def query_of(pairs: list[Pair], *, looks: int, sweeps: bool = True) -> Track:
    """A query with the first looks of a PM; ``sweeps``: known as first hits where they were."""
    first = pairs[:looks]
    heard = tuple(pair.look if sweeps else replace(pair.look, sweep=0) for pair in first)
    return Track(1.0, first[0].epoch, first[0].marker, heard, look_markers=tuple(pair.marker for pair in first))


def marked_snapshot(base: Snapshot, value: int) -> Snapshot:
    """A snapshot all of whose numbers tell its version: whole only if they agree."""
    number = float(value)
    epoch = EpochSnapshot(
        0, base.epochs[0].verdict, np.eye(3) * number, np.full(3, number), np.full((SHARED, SHARED), number), str(value)
    )
    surface = base.surface
    if surface is not None:
        surface = replace(
            surface, residual=np.full_like(surface.residual, number), place=np.full_like(surface.place, number)
        )
    return replace(base, t=number, pairs=value, epochs=(epoch,), beam=np.full(4, number), surface=surface)


def is_whole(snapshot: Snapshot) -> bool:
    """Whether all numbers of a marked snapshot are of one version."""
    value, epoch, surface = snapshot.pairs, snapshot.epochs[0], snapshot.surface
    whole = snapshot.t == value and epoch.reason == str(value) and bool((snapshot.beam == value).all())
    whole = whole and bool((epoch.covariance == value).all() and (epoch.translation_mm == value).all())
    return whole and (surface is None or bool((surface.residual == value).all() and (surface.place == value).all()))


def plain_snapshot(model: SessionModel, surface: TissueSurface | None = None) -> Snapshot:
    """A snapshot that no session was solved for."""
    return Snapshot(
        t=0.0,
        pairs=0,
        causal=True,
        epochs=(EpochSnapshot(0, Verdict.OK, np.eye(3), np.zeros(3), np.eye(SHARED)),),
        marker_T_nominal=np.eye(4),
        beam=np.zeros(4),
        origin_shift_mm=0.0,
        constants=np.zeros(COUNT),
        radius_mm=model.probe.radius_mm,
        sensitivity=model.probe.sensitivity,
        stage=model.stage,
        amplitude_sigma=0.05,
        window_shape=True,
        surface=surface,
    )
