"""A rest as plain numbers, and back: linearisation points, who counts, and the measurements; the rest is made anew.

What is read is checked for shapes, bounds and finite numbers, and measurements for what a session may hold; the packed
arrays, the factors and the window are then made from it as they were made before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgreg.estimate import PredictedTre, Verdict
from fgreg.frames import FloatArray, IntArray
from fgreg.graph.packing import PackedProblem
from fgreg.graph.reduced_blocks import PrivateState
from fgreg.graph.shared_state import SharedState
from fgreg.measurements import Aim, EpochStart, MarkerObservation
from fgreg.online.events import DetectedMove, DetectedReturn
from fgreg.online.judge import Judgement
from fgreg.online.numbers import FARTHEST_MM, Sink, Source, check_covariances, check_poses
from fgreg.online.rest import Noticed, Rest, private_count, window_of
from fgreg.online.shared import Layout, Quadratic
from fgreg.online.state import EpochData, Recent, Setting, State
from fgreg.online.store import MeasurementStore
from fgreg.online.summary import Chunk, Shelf, plus_tally, tally_of
from fgreg.online.window import Bundle, GroupSeed, WindowSeed
from fgreg.surface import MOST_POINTS, TissueSurface

INT64 = 2**63
MOST_ROWS, MOST_PLACES = 10_000, 1_000_000


# --- writing --------------------------------------------------------------------------------------------------------


def write_rest(sink: Sink, rest: Rest, aims: Sequence[Aim], store: MeasurementStore) -> None:
    """Put a rest and the measurements up to it into a sink."""
    state = rest.state
    if state.window is None or state.window.seed is None or state.layout is None:
        raise ValueError("no rest")
    sink.integers(state.pairs, state.aims, len(state.epochs), state.steps, rest.serial)
    sink.floats(rest.t, rest.estimate_t)
    for aim in aims[: state.aims]:
        _put_aim(sink, aim)
    store.write(sink, state.pairs)
    sink.array(state.layout.marker_T_nominal)
    for data in state.epochs:
        _put_epoch(sink, data)
    sink.integers(len(state.aim_chunks))
    for chunk in state.aim_chunks:
        _put_chunk(sink, chunk)
    _put_optional_quadratic(sink, state.passed)
    sink.text(state.why_none)
    sink.integers(state.is_open, state.used, state.nis is not None, len(state.recent))
    sink.floats(0.0 if state.nis is None else state.nis)
    for recent in state.recent:
        sink.integers(recent.place, recent.used)
        _put_quadratic(sink, recent.quadratic)
        _put_shared(sink, recent.state)
        sink.array(recent.covariance)
        sink.floats(recent.nis)
    _put_seed(sink, state.window.seed)
    _put_judgement(sink, rest.judgement)
    _put_surface(sink, rest.surface)
    _put_noticed(sink, rest.noticed)


def _put_aim(sink: Sink, aim: Aim) -> None:
    sink.integers(aim.marker.id)
    sink.floats(aim.t)
    for values in (aim.marker.camera_T_marker, aim.marker.covariance, aim.camera_p_spot_mm, aim.covariance):
        sink.array(values)


def _put_shared(sink: Sink, state: SharedState) -> None:
    for name in SharedState.__slots__:
        sink.array(getattr(state, name))


def _put_quadratic(sink: Sink, quadratic: Quadratic) -> None:
    _put_shared(sink, quadratic.state)
    sink.floats(quadratic.cost)
    sink.array(quadratic.gradient)
    sink.array(quadratic.hessian)


def _put_optional_quadratic(sink: Sink, quadratic: Quadratic | None) -> None:
    sink.integers(quadratic is not None)
    if quadratic is not None:
        _put_quadratic(sink, quadratic)


def _put_epoch(sink: Sink, data: EpochData) -> None:
    start = data.start
    sink.integers(
        data.first, start.camera_new_T_camera_old is not None, start.covariance is not None, data.state is not None
    )
    sink.integers(-1 if start.after is None else start.after)
    sink.floats(start.t)
    for values in (start.camera_new_T_camera_old, start.covariance):
        if values is not None:
            sink.array(values)
    if data.state is not None:
        _put_shared(sink, data.state)
    sink.integers(len(data.shelf.full), data.shelf.open is not None)
    for chunk in data.shelf.chunks:
        _put_chunk(sink, chunk)
    _put_optional_quadratic(sink, data.shelf.total)


def _put_chunk(sink: Sink, chunk: Chunk) -> None:
    problem = chunk.problem
    sink.integers(len(chunk.places), len(chunk.kept))
    sink.integer_array(chunk.places)
    sink.integer_array(np.array(problem.pms, dtype=np.int64)[problem.look_pm])
    sink.integer_array(chunk.kept.astype(np.int64))
    for name in PrivateState.__slots__:
        sink.array(getattr(chunk.private, name))
    _put_quadratic(sink, chunk.quadratic)


def _put_seed(sink: Sink, seed: WindowSeed) -> None:
    _put_shared(sink, seed.at)
    sink.integers(len(seed.groups))
    for group in seed.groups:
        bundle = group.bundle
        sink.integers(
            bundle.label, len(bundle.places), len(group.residual), bundle.kept, group.far, group.values is not None
        )
        sink.integer_array(bundle.places)
        sink.array(group.rows)
        sink.array(group.residual)
        _put_shared(sink, group.state)
        if group.values is not None:
            sink.array(group.values)


def _put_judgement(sink: Sink, found: Judgement | None) -> None:
    sink.integers(found is not None)
    if found is None:
        return
    tre = found.predicted_tre
    arrays = (found.trus_T_camera, found.covariance, found.shift, found.root, found.optimum_root)
    sink.integers(found.serial, found.epoch, found.pairs, found.verdict.severity, len(found.reasons), tre is not None)
    for reason in found.reasons:
        sink.text(reason)
    if tre is not None:
        sink.floats(tre.mean_mm, tre.p95_mm, tre.worst_mm)
    for values in arrays:
        sink.integers(values is not None)
        if values is not None:
            sink.array(values)


def _put_surface(sink: Sink, surface: TissueSurface | None) -> None:
    sink.integers(0 if surface is None else len(surface.place))
    if surface is not None:
        for name in TissueSurface.__slots__:
            sink.array(np.asarray(getattr(surface, name)))


def _put_noticed(sink: Sink, noticed: Noticed) -> None:
    sink.text(noticed.suspicion)
    sink.integers(len(noticed.moves), len(noticed.returns))
    for move in noticed.moves:
        sink.integers(move.epoch, move.since, move.log_bayes is not None)
        sink.floats(move.since_t, move.last_t, move.alarm_t, 0.0 if move.log_bayes is None else move.log_bayes)
    for back in noticed.returns:
        sink.integers(back.epoch, back.to)
        sink.floats(back.t, back.log_bayes)


# --- reading --------------------------------------------------------------------------------------------------------


def read_rest(source: Source, setting: Setting) -> tuple[Rest, MeasurementStore]:
    """The rest that :func:`write_rest` wrote, its window opened.

    Raises:
        ValueError: not one, or not of this setting.
        RuntimeError, ArithmeticError: its window cannot be opened.
    """
    pairs, aims, epochs = (source.integer(0, MOST_PLACES) for _ in range(3))
    steps, serial = source.integer(0, INT64 - 1), source.integer(0, INT64 - 1)
    t, estimate_t = source.number(), source.number()
    store = MeasurementStore()
    store.aims.extend(_aim(source) for _ in range(aims))
    store.read(source, pairs)
    layout = Layout(setting.columns, _pose(source))
    reader = _Reader(source, setting, store)
    every = reader.epochs(epochs, pairs)
    aim_chunks = tuple(reader.aim_chunk() for _ in range(source.integer(0, aims)))
    passed = reader.optional_quadratic()
    why_none = source.text()
    is_open, used, has_nis = source.flag(), source.flag(), source.flag()
    count, nis = source.integer(0, MOST_ROWS), source.number()
    state = State(
        every, pairs, aims, layout, aim_chunks, passed, None, why_none, is_open,
        tuple(reader.recent(pairs) for _ in range(count)), steps, nis if has_nis else None, used,
    )  # fmt: skip
    seed = reader.seed(len(every) - 1, every[-1].first, pairs)
    judgement = _judgement(source, len(every))
    surface = _surface(source)
    noticed = _noticed(source, len(every), pairs)
    window = window_of(seed, state, setting)
    state = replace(state.with_now(state=window.state), window=window)
    return Rest(state, t, serial, estimate_t, judgement, surface, noticed), store


def _pose(source: Source) -> FloatArray:
    pose = source.array(4, 4)
    check_poses(pose[None])
    return pose


def _covariance(source: Source, size: int) -> FloatArray:
    covariance = source.array(size, size)
    check_covariances(covariance[None])
    return covariance


def _aim(source: Source) -> Aim:
    number, t = int(source.integer_array(1)[0]), source.number()
    marker = MarkerObservation(_pose(source), _covariance(source, 6), number)
    return Aim(t, marker, source.array(3), _covariance(source, 3))


class _Reader:
    """Reads what needs the setting and the measurements."""

    def __init__(self, source: Source, setting: Setting, store: MeasurementStore) -> None:
        self._source, self._setting, self._store = source, setting, store
        self._size = setting.columns.size
        self._taken = np.zeros(len(store), dtype=bool)

    def shared(self) -> SharedState:
        source = self._source
        rotation, translation = source.array(1, 1, 3, 3), source.array(1, 1, 3)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation[0, 0], translation[0, 0]
        check_poses(pose[None])
        nominal = source.array(1, 4, 4)
        check_poses(nominal)
        sizes = ((1, 4), (1,), (1, 3), (1,), (1,))
        return SharedState(rotation, translation, nominal, *(source.array(*size) for size in sizes))

    def quadratic(self) -> Quadratic:
        source, size = self._source, self._size
        return Quadratic(self.shared(), source.number(), source.array(size), source.array(size, size))

    def optional_quadratic(self) -> Quadratic | None:
        return self.quadratic() if self._source.flag() else None

    def epochs(self, count: int, pairs: int) -> tuple[EpochData, ...]:
        if not count:
            raise ValueError("no epoch")
        out: list[EpochData] = []
        for _ in range(count):
            out.append(self._epoch(len(out), out[-1].first if out else 0, pairs))
        return tuple(out)

    def _epoch(self, index: int, least: int, pairs: int) -> EpochData:
        source = self._source
        first = source.integer(least, pairs)
        has_motion, has_covariance, has_state = source.flag(), source.flag(), source.flag()
        after = source.integer(-1, index - 1)
        t = source.number()
        motion = _pose(source) if has_motion else None
        covariance = _covariance(source, 6) if has_covariance else None
        state = self.shared() if has_state else None
        full, has_open = source.integer(0, pairs), source.flag()
        chunks = [self._pair_chunk(first) for _ in range(full + has_open)]
        tally = (0, 0, 0)
        for chunk in chunks[:full]:
            tally = plus_tally(tally, tally_of(chunk))
        shelf = Shelf(tuple(chunks[:full]), self.optional_quadratic(), chunks[full] if has_open else None, tally)
        if full and shelf.total is None:
            raise ValueError("full chunks without their sum")
        return EpochData(EpochStart(t, motion, covariance, None if after < 0 else after), first, shelf, state)

    def _places(self, count: int, first: int) -> IntArray:
        """Places of pairs, none of them twice in all."""
        places = self._source.integer_array(count)
        if count and (places.min() < first or places.max() >= len(self._taken)):
            raise ValueError("no such pair")
        if len(np.unique(places)) < count or self._taken[places].any():
            raise ValueError("a pair twice")
        self._taken[places] = True
        return places

    def _pair_chunk(self, first: int) -> Chunk:
        source = self._source
        looks, pms = source.integer(1, len(self._taken)), source.integer(1, len(self._taken))
        places = self._places(looks, first)
        labels = source.integer_array(looks)
        pairs = [
            self._store.pair(place, 0, label) for place, label in zip(places.tolist(), labels.tolist(), strict=True)
        ]
        return self._chunk(places, self._setting.pack((), pairs), pms)

    def aim_chunk(self) -> Chunk:
        source, aims = self._source, self._store.aims
        count = source.integer(1, len(aims))
        kept = source.integer(count, count)
        places = source.integer_array(count)
        if places.min() < 0 or places.max() >= len(aims):
            raise ValueError("no such aim")
        return self._chunk(places, self._setting.pack([aims[i] for i in places.tolist()], ()), kept)

    def _chunk(self, places: IntArray, problem: PackedProblem, shots: int) -> Chunk:
        source = self._source
        if shots != (len(problem.pms) or len(problem.aim_spot_mm)):
            raise ValueError("not as many PMs as their looks have")
        kept = source.flags(shots)
        beams, aims = len(problem.beam_pm), len(problem.aim_spot_mm)
        private = PrivateState(
            source.array(1, len(problem.pms), 3),
            source.array(1, beams, 6),
            source.array(1, aims, 6),
            source.array(1, aims, 3),
        )
        if any(np.abs(getattr(private, name)).max(initial=0.0) > FARTHEST_MM for name in PrivateState.__slots__):
            raise ValueError("a place out of bounds")
        return Chunk(places.copy(), problem, kept, private, self.quadratic(), int(kept.sum()))

    def recent(self, pairs: int) -> Recent:
        source = self._source
        place, used = source.integer(0, pairs - 1), source.flag()
        return Recent(
            place, self.quadratic(), self.shared(), source.array(self._size, self._size), source.number(), used
        )

    def seed(self, epoch: int, first: int, pairs: int) -> WindowSeed:
        source = self._source
        at = self.shared()
        groups = []
        for _ in range(source.integer(0, pairs)):
            label = int(source.integer_array(1)[0])
            looks, rows = source.integer(1, pairs), source.integer(0, MOST_ROWS)
            kept, far, has_values = source.flag(), source.flag(), source.flag()
            if kept != has_values:
                raise ValueError("a PM counts without its variables")
            places = tuple(self._places(looks, first).tolist())
            bundle = Bundle(label, places, self._store.pairs(places, epoch), kept)
            matrix, residual, state = source.array(rows, self._size), source.array(rows), self.shared()
            values = source.array(private_count(bundle.pairs)) if has_values else None
            if values is not None and np.abs(values).max() > FARTHEST_MM:
                raise ValueError("a place out of bounds")
            groups.append(GroupSeed(bundle, matrix, residual, state, far, values))
        return WindowSeed(at, tuple(groups))


def _judgement(source: Source, epochs: int) -> Judgement | None:
    if not source.flag():
        return None
    serial, epoch = source.integer(0, INT64 - 1), source.integer(0, epochs - 1)
    pairs, severity, reasons = source.integer(0, MOST_PLACES), source.integer(0, 2), source.integer(0, MOST_ROWS)
    has_tre = source.flag()
    texts = tuple(source.text() for _ in range(reasons))
    tre = PredictedTre(source.number(), source.number(), source.number()) if has_tre else None
    sizes = ((4, 4), (6, 6), (6,), (6, 6), (6, 6))
    pose, covariance, shift, root, optimum_root = (source.array(*size) if source.flag() else None for size in sizes)
    if pose is not None:
        check_poses(pose[None])
    verdict = [Verdict.OK, Verdict.WARNING, Verdict.REFUSED][severity]
    return Judgement(serial, epoch, pairs, verdict, texts, pose, covariance, tre, shift, root, optimum_root, None)


def _surface(source: Source) -> TissueSurface | None:
    places = source.integer(0, MOST_POINTS)
    if not places:
        return None
    return TissueSurface(
        axes=source.array(3, 3),
        centre=source.array(3),
        place=source.array(places, 2),
        covariance_inverse=source.array(places, places),
        trend=source.array(3),
        trend_covariance=source.array(3, 3),
        residual=source.array(places),
        relief_mm=source.number(),
        inflation=source.number(),
    )


def _noticed(source: Source, epochs: int, pairs: int) -> Noticed:
    suspicion = source.text()
    many, back = source.integer(0, epochs), source.integer(0, epochs)
    moves, returns = [], []
    for _ in range(many):
        epoch, since, has_odds = source.integer(0, epochs - 1), source.integer(0, pairs), source.flag()
        since_t, last_t, alarm_t, odds = (source.number() for _ in range(4))
        moves.append(DetectedMove(epoch, since, since_t, last_t, alarm_t, odds if has_odds else None))
    for _ in range(back):
        epoch, to = source.integer(0, epochs - 1), source.integer(0, epochs - 1)
        returns.append(DetectedReturn(epoch, to, source.number(), source.number()))
    return Noticed(tuple(moves), tuple(returns), suspicion)
