"""What a solve says of each camera epoch: the estimate, its verdict, and the conditions that it missed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.graph.shared_state import SharedState
from fgreg.model.estimate import (
    EpochEstimate,
    PairEstimate,
    Verdict,
)
from fgreg.model.measurements import Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.systematic import largest_causes
from fgreg.registration.epochs import epoch_chains, has_registration
from fgreg.registration.error_budget import (
    Budget,
    targets_with_effects,
    with_effects,
)
from fgreg.registration.group_tests import group_conditions
from fgreg.registration.move_doubt import may_share_a_registration, move_doubt, outliers_in_a_row
from fgreg.registration.posterior import Posterior
from fgreg.registration.register import Registration, too_few_text
from fgreg.registration.verdict import (
    SURE_OF_PAIRS,
    Condition,
    accuracy,
    ambiguity,
    causes_of_error,
    hypotheses,
    left_out,
    mirrored,
    possible_camera_move,
    side_of_a_move,
    spread,
    sweeps,
    too_few_to_tell,
    two_sided,
    untested_motion,
    verdict_of,
)


@dataclass(frozen=True, slots=True, eq=False)
class EpochReport:
    """What a solve says of one epoch: the estimate, and the conditions that it missed.

    ``tied``: contradictions within other epochs that measured motions tie to it, since all have one registration.
    ``common``: conditions of the solve as a whole, with the last epoch.
    """

    estimate: EpochEstimate
    conditions: tuple[Condition, ...]
    tied: tuple[Condition, ...] = ()
    common: tuple[Condition, ...] = ()

    @property
    def own_verdict(self) -> Verdict:
        """Without what is common to all epochs."""
        return verdict_of([*self.conditions, *self.tied])


def epoch_verdicts(
    measurements: Measurements,
    registration: Registration,
    posterior: Posterior,
    budget: Budget,
    pairs: Sequence[PairEstimate],
    model: SessionModel,
    config: SolveConfig,
    common: Sequence[Condition],
    steady: Mapping[int, Sequence[Condition]],
    before: Sequence[EpochReport],
) -> tuple[EpochReport, ...]:
    """Each epoch with its verdict and conditions.

    ``steady``: camera-move conditions of each epoch, tested at the optimum. ``before``: reports of the first epochs,
    which were not solved.
    """
    out, state = list(before), registration.optimum.state
    places = {k: place for place, k in enumerate(registration.epochs)}
    chains = epoch_chains(registration.measurements, list(places.values()))
    tied = {k: next(chain for chain in chains if place in chain) for k, place in places.items()}
    found: dict[int, list[Condition]] = {}
    contradict: dict[int, list[Condition]] = {}
    for k, place in places.items():
        lacking = _epoch_conditions(registration, pairs, k, tied[k], model, config)
        causes = causes_of_error(registration, place, model.targets_mm)
        both = two_sided(pair for pair in measurements.pairs if pair.epoch == k)
        named_mm = sum(condition.effect_mm for condition in common)
        largest = largest_causes(budget.constants)
        tre = with_effects(budget.predicted[place], common)
        lacking.extend(accuracy(tre, config, causes, largest, both_sides=both, named_mm=named_mm))
        doubted = verdict_of([*common, *steady[k], *lacking]) is not Verdict.OK
        side = _side_of_a_move(registration, place, measurements, config, doubted=doubted)
        found[k], contradict[k] = [*steady[k], *lacking, *side], [*steady[k], *side]
    for k, start in enumerate(measurements.epochs[len(out) :], len(out)):
        count = sum(pair.epoch == k and pair.used for pair in pairs)
        if k not in places:
            pms = len({pair.pm for pair in measurements.pairs if pair.epoch == k})
            few = Condition(Verdict.REFUSED, too_few_text(pms, config))
            out.append(EpochReport(EpochEstimate(k, start.t, None, None, count, few.verdict, None), (few,)))
            continue
        inherited = []
        for other in (registration.epochs[at] for at in tied[k] if at != places[k]):
            search = registration.searches[other]
            # An epoch without minima of its own has the hypothesis of those that it is tied to.
            rivals = [] if registration.searches[k].minima else [*mirrored(search, config), *hypotheses(search, config)]
            inherited += [replace(c, text=f"epoch {other}: {c.text}") for c in (*contradict[other], *rivals)]
        block = slice(6 * places[k], 6 * places[k] + 6)
        estimate = EpochEstimate(
            index=k,
            start_s=start.t,
            trus_T_camera=state.trus_T_camera(places[k])[0],
            covariance=posterior.covariance[block, block],
            pairs=count,
            verdict=verdict_of([*common, *found[k], *inherited]),
            predicted_tre=with_effects(budget.predicted[places[k]], common),
            targets=targets_with_effects(budget.targets[places[k]], common),
        )
        out.append(EpochReport(estimate, tuple(found[k]), tuple(inherited)))
    return tuple(out)


def _epoch_conditions(
    registration: Registration,
    pairs: Sequence[PairEstimate],
    epoch: int,
    tied: Sequence[int],
    model: SessionModel,
    config: SolveConfig,
) -> list[Condition]:
    """Conditions of one epoch; ``tied``: places of it and of those tied to it by measured motions.

    The pairs of all these have one registration between them, so they are counted together.
    """
    place, state = registration.epochs.index(epoch), registration.optimum.state
    shared = [pair for pair in registration.measurements.pairs if pair.epoch in tied]
    search, anchor = registration.searches[epoch], registration.problem.anchor
    # Finished epochs are a prior only where their own verdict is ok, so that they miss none of these conditions.
    anchored = anchor is not None and has_registration(anchor)
    found = ambiguity(
        search,
        len({(pair.epoch, pair.pm) for pair in shared}),
        is_open=epoch in registration.ambiguous,
        has_initial=model.initial_trus_T_camera is not None or anchored,
        config=config,
    )
    found.extend(hypotheses(search, config))
    found.extend(_outlier_conditions(registration, [place]) or _outlier_conditions(registration, tied))
    if not any(pair.epoch == place for pair in shared) and (anchored or len(tied) > 1):
        found.extend(untested_motion())
    if shared and not anchored:
        directions = np.concatenate(
            [
                _directions_in_trus(np.stack([p.marker.camera_T_marker for p in shared if p.epoch == at]), state, at)
                for at in sorted({pair.epoch for pair in shared})
            ]
        )
        of_session = {registration.epochs[at] for at in tied}
        points = [e.trus_p_pm_mm for e in pairs if e.epoch in of_session and e.used and e.trus_p_pm_mm is not None]
        found.extend(spread(directions, np.stack(points), config))
        found.extend(sweeps(shared, config))
    return found


def steadiness(registration: Registration, place: int, limit_mm: float, names: Mapping[int, int]) -> list[Condition]:
    """Whether all PMs of an epoch have one registration: over all split points in time, and by groups.

    ``names``: the recorded number of each PM; a look that was split off its PM is one of its own.
    """
    groups = group_conditions(registration.problem, registration.optimum, registration.covariance, place)
    doubt = move_doubt(registration, place, limit_mm)
    if doubt is None:
        return groups
    named = replace(doubt, before=names[doubt.before], after=names[doubt.after])
    return [*possible_camera_move(named, limit_mm), *groups]


def _outlier_conditions(registration: Registration, places: Sequence[int]) -> list[Condition]:
    """Conditions on the outliers of some epochs together, and on PMs that do not fit but were not left out."""
    shots = registration.shots
    mine = np.zeros(len(shots.problem.pms), dtype=bool)
    mine[shots.problem.beam_pm[np.isin(shots.problem.beam_epoch, places)]] = True
    if not mine.any():
        return []
    kept, nis = shots.pm_inlier[mine], shots.innovations.pm[mine]
    pms = [pm for pm, here in zip(shots.problem.pms, mine, strict=True) if here]
    names = [f"PM {pm}" for pm in pms]
    return [
        *left_out(kept, nis, "pairs", SURE_OF_PAIRS),
        *too_few_to_tell(shots.pm_beyond_limit[mine], kept, nis, names),
    ]


def _side_of_a_move(
    registration: Registration, place: int, measurements: Measurements, config: SolveConfig, *, doubted: bool
) -> list[Condition]:
    """Outliers in a row that may share a registration.

    Where they are the last PMs the registration may be that of the camera before it moved. Where they are not, the PMs
    on both sides of them fit one registration, so they count only where that is ``doubted`` for another reason.
    """
    shots = registration.shots
    mine = np.unique(shots.problem.beam_pm[shots.problem.beam_epoch == place])
    kept = shots.pm_inlier[mine]
    row = outliers_in_a_row(kept)
    if row is None or (row.stop < len(mine) and not doubted):
        return []
    looks = [pair for pair in measurements.pairs if pair.epoch in registration.epochs]
    of_row = set(mine[row].tolist())
    pm_of = shots.problem.look_pm.tolist()
    pairs = [pair for pair, pm in zip(looks, pm_of, strict=True) if pm in of_row]
    if not may_share_a_registration(measurements, pairs, registration.model, config):
        return []
    first, last = (looks[pm_of.index(pm)].pm for pm in (mine[row.start], mine[row.stop - 1]))
    return side_of_a_move(first, last, int(np.sum(~kept[row])))


def _directions_in_trus(camera_T_marker: FloatArray, state: SharedState, epoch: int) -> FloatArray:
    camera_d = camera_T_marker[:, :3, :3] @ state.beam_direction()[0]
    return np.asarray(camera_d @ state.rotation[0, epoch].T)
