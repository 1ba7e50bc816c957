"""The incremental estimate as an immutable value: measurements, inliers, and the active window.

Nothing changes a state in place, so an update that fails leaves the state before as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.graph.columns import Columns
from fgreg.graph.packing import ConstantsPrior, PackedProblem, evidence
from fgreg.graph.shared_state import Quadratic, SharedState, one_epoch
from fgreg.model.measurements import Aim, EpochStart, KnownPoint, Look, Measurements, Pair
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.epochs import restrict_epochs
from fgreg.registration.register import pack_session
from fgreg.smoother.isam_window import ActiveWindow
from fgreg.smoother.marginal_prior import has_moved, marginal_prior, with_registrations
from fgreg.smoother.shared_variables import Layout


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """The constants: the session's set-up and the configuration.

    ``empty``: a problem without shots and with one epoch, for its columns.
    """

    model: SessionModel
    config: SolveConfig
    empty: PackedProblem

    @property
    def columns(self) -> Columns:
        """Of the shared variables of one epoch."""
        return self.empty.columns

    def pack(self, measurements: Measurements) -> PackedProblem:
        """Measurements as arrays, with Gaussian sensitivity windows."""
        return pack_session(measurements, self.model, self.config)


def make_setting(model: SessionModel, config: SolveConfig) -> Setting:
    """The setting of a session.

    Raises:
        ValueError: the configuration makes the probe's radius a variable, which the graph's factors do not have.
    """
    if config.estimate_radius:
        raise ValueError("estimate_radius is set; online registration holds the probe's radius as the session gives it")
    gaussian = replace(config, window_shape=False)
    empty = pack_session(Measurements((), (), (EpochStart(0.0),)), model, gaussian)
    return Setting(model, gaussian, empty)


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """A pair with its label, inlier or outlier.

    Attributes:
        pair: with the number of its camera epoch, and its look in the position that was taken.
        measured: its look as it was measured.
        label: number of its PM in the estimate: ``pair.pm``, or one of its own where it was split off as an outlier.
        inlier: whether it is an inlier.
    """

    pair: Pair
    measured: Look
    label: int
    inlier: bool

    @property
    def as_measured(self) -> Pair:
        """The pair as it was measured."""
        return replace(self.pair, look=self.measured)

    @property
    def key(self) -> tuple[int, int]:
        """Epoch and label of its PM."""
        return self.pair.epoch, self.label


@dataclass(frozen=True, slots=True, eq=False)
class Epoch:
    """One camera epoch.

    Attributes:
        start: with the measured motion, where there is one.
        first: place of its first pair in the session's order.
        state: its last estimated registration with the common variables; None where it was never registered.
        covariance: (D, D) there.
        is_open: whether the registration is ambiguous: two minima fit equally well.
    """

    start: EpochStart
    first: int
    state: SharedState | None = None
    covariance: FloatArray | None = None
    is_open: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """The whole incremental estimate.

    Attributes:
        epochs: the last one is the current one.
        aims, aim_inlier: calibration shots, and which of them are inliers.
        shots: pairs, in the session's order. points: known points, each with its epoch.
        layout: None until a first registration.
        active_window: None where the current epoch has no registration (yet).
        finished: prior on the current epoch's shared variables from the pairs of the earlier epochs and the measured
            motions between epochs; None where it was not made, or nothing is known of earlier epochs.
        carried: ``finished``, with the aims, the epoch's known points and the priors of the configuration; older: from
            the epoch's own pairs that have left the active window. Their sum is the active window's marginal prior.
        marginalised: labels of the PMs in ``older``.
        why_none: why there is no registration, where there is none.
        nis, used: of the last event, where it was a pair.
    """

    epochs: tuple[Epoch, ...]
    aims: tuple[Aim, ...] = ()
    aim_inlier: tuple[bool, ...] = ()
    shots: tuple[Shot, ...] = ()
    points: tuple[KnownPoint, ...] = ()
    layout: Layout | None = None
    active_window: ActiveWindow | None = None
    finished: Quadratic | None = None
    carried: Quadratic | None = None
    older: Quadratic | None = None
    marginalised: frozenset[int] = frozenset()
    why_none: str = "take pairs"
    nis: float | None = None
    used: bool = False

    @property
    def epoch(self) -> int:
        """Index of the current epoch."""
        return len(self.epochs) - 1

    @property
    def now(self) -> Epoch:
        """The current epoch."""
        return self.epochs[-1]

    @property
    def is_open(self) -> bool:
        """Whether the current epoch's registration is ambiguous."""
        return self.now.is_open

    @property
    def current(self) -> tuple[Shot, ...]:
        """Shots of the current epoch."""
        return self.shots[self.now.first :]

    @property
    def epoch_pairs(self) -> int:
        """Pairs of the current epoch."""
        return len(self.shots) - self.now.first

    @property
    def epoch_pms(self) -> int:
        """PMs of the current epoch."""
        return len({shot.label for shot in self.current})

    def measurements(self) -> Measurements:
        """All measurements, as the batch solve takes them."""
        pairs = tuple(shot.as_measured for shot in self.shots)
        return Measurements(self.aims, pairs, tuple(epoch.start for epoch in self.epochs), self.points)

    def counts(self) -> tuple[int, int]:
        """Numbers of inlier PMs, and of all PMs, over the epochs that have a registration."""
        known = {k for k, epoch in enumerate(self.epochs) if epoch.state is not None}
        pms = {shot.key: shot.inlier for shot in self.shots if shot.pair.epoch in known}
        return sum(pms.values()), len(pms)


def looks_by_pm(shots: Sequence[Shot], first: int = 0) -> dict[tuple[int, int], list[int]]:
    """Places of the looks at each PM, by epoch and label, in the order of first looks; ``first``: of the first shot."""
    out: dict[tuple[int, int], list[int]] = {}
    for place, shot in enumerate(shots, first):
        out.setdefault(shot.key, []).append(place)
    return out


def numbered(shots: Sequence[Shot], numbers: dict[tuple[int, int], int], epoch: int | None = None) -> tuple[Pair, ...]:
    """Pairs with the number of their PM in the estimate; all of one epoch where that is given."""
    return tuple(
        replace(shot.pair, pm=numbers[shot.key], epoch=shot.pair.epoch if epoch is None else epoch) for shot in shots
    )


def pairs_of_epoch(shots: Sequence[Shot]) -> tuple[Pair, ...]:
    """Pairs of one epoch under their labels, as epoch 0."""
    return tuple(replace(shot.pair, pm=shot.label, epoch=0) for shot in shots)


def own_prior(state: State, labels: frozenset[int], at: SharedState, setting: Setting) -> Quadratic | None:
    """The quadratic of some inlier PMs on the current epoch's shared variables, at a state near their optimum.

    Raises:
        ArithmeticError: a number is not finite.
    """
    if not labels:
        return None
    shots = [shot for shot in state.current if shot.label in labels]
    problem = setting.pack(Measurements((), pairs_of_epoch(shots), (EpochStart(0.0),)))
    problem = replace(problem, prior=ConstantsPrior.none(problem.columns))
    return marginal_prior(problem, at)[0]


def finished_prior(state: State, at: SharedState, setting: Setting) -> State:
    """The state with the prior on the current epoch's shared variables from the earlier epochs that are registered.

    The earlier registrations are estimated again. A prior that was made before is kept while the estimate stays near
    its linearisation point.

    Args:
        state: ``layout`` has to be that of ``at``.
        at: shared variables of the current epoch (one hypothesis).

    Raises:
        ArithmeticError: a number is not finite.
    """
    now, before = state.epoch, state.finished
    same_chart = before is not None and np.array_equal(before.state.marker_T_nominal, at.marker_T_nominal)
    if before is not None and same_chart and not has_moved(before, at, setting.empty):
        return state
    known = [k for k, epoch in enumerate(state.epochs[:-1]) if epoch.state is not None]
    if not known:
        return replace(state, finished=None)
    shots = [shot for shot in state.shots[: state.now.first] if shot.inlier and shot.pair.epoch in known]
    numbers = {key: number for number, key in enumerate(looks_by_pm(shots))}
    starts = tuple(epoch.start for epoch in state.epochs)
    points = tuple(point for point in state.points if point.epoch != now)  # the current epoch's are not of the earlier
    finished = restrict_epochs(Measurements((), numbered(shots, numbers), starts, points), [*known, now])
    problem = setting.pack(finished)
    # The configuration's priors are those of the solve that uses this one.
    problem = replace(problem, prior=evidence(finished, problem.columns))
    each = [found for k in known if (found := state.epochs[k].state) is not None]
    prior, settled = marginal_prior(problem, with_registrations(at, [*each, at]))
    epochs = list(state.epochs)
    for place, k in enumerate(known):
        epochs[k] = replace(epochs[k], state=one_epoch(settled, place))
    return replace(state, epochs=tuple(epochs), finished=prior)


def carried_prior(state: State, at: SharedState, setting: Setting) -> State:
    """The state with the prior ``carried`` about ``at`` (arguments as of :func:`finished_prior`).

    Raises:
        ArithmeticError: a number is not finite.
    """
    state = finished_prior(state, at, setting)
    aims = tuple(aim for aim, inlier in zip(state.aims, state.aim_inlier, strict=True) if inlier)
    points = tuple(replace(point, epoch=0) for point in state.points if point.epoch == state.epoch)
    carried, _ = marginal_prior(setting.pack(Measurements(aims, (), (EpochStart(0.0),), points)), at)
    if state.finished is not None:
        carried = carried.plus(state.finished.at(at, setting.columns))
    return replace(state, carried=carried)


def total_prior(state: State, at: SharedState, setting: Setting) -> Quadratic:
    """The marginal prior of the active window, about a state near its linearisation points."""
    if state.carried is None:
        raise ValueError("there is no registration")
    prior = state.carried.at(at, setting.columns)
    seen = _seen_in_frames(state, at, setting.columns)
    if seen is not None:
        prior = prior.plus(seen)
    return prior if state.older is None else prior.plus(state.older.at(at, setting.columns))


def _seen_in_frames(state: State, at: SharedState, columns: Columns) -> Quadratic | None:
    """What the frames of the current epoch's pairs say about the rig's constants; None without frames."""
    shots = Measurements((), tuple(shot.pair for shot in state.current), (EpochStart(0.0),))
    seen = evidence(shots, columns)
    if not seen.information.any():
        return None
    step = at.constants[0, columns.constants] - seen.mean
    pull = seen.information @ step
    gradient, hessian = np.zeros(columns.size), np.zeros((columns.size, columns.size))
    gradient[columns.rig], hessian[columns.rig, columns.rig] = pull, seen.information
    return Quadratic(at, float(step @ pull), gradient, hessian)
