"""What finds out untold camera moves, as the engine uses it: the watch on pairs, and the guard on tags."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from fgreg.camera_moves.detector import LoopClosure, MoveCase
from fgreg.camera_moves.loop_closure import CANDIDATES, MIN_EARLIER, MIN_LOOKS, MOST_LOOKS
from fgreg.camera_moves.static_tags import TagSettings
from fgreg.config import SolveConfig
from fgreg.graph.shared_state import SharedState
from fgreg.models import SessionModel
from fgreg.online.events import StaticTags
from fgreg.online.shared import Quadratic
from fgreg.online.state import NOTHING, Setting, State, kept_by_place, passed_from, summary
from fgreg.online.store import MeasurementStore
from fgreg.online.tag_guard import TagGuard, TagsMoved, TagsRest, guarded
from fgreg.online.watch import Found, InlineWatch, ProcessWatch, Watch
from fgreg.registration import SoundSpeedPrior

WatchKind = Literal["inline", "process"]


class MoveGuard:
    """Watches for moves.

    Args:
        kind: how pairs are tested (fgreg.online.watch); None: neither pairs nor tags are looked at.
        model, config, sound_speed: of the session.
        setting: of the engine.

    Raises:
        ValueError: another kind.
    """

    def __init__(
        self,
        kind: WatchKind | None,
        model: SessionModel,
        config: SolveConfig,
        sound_speed: SoundSpeedPrior | None,
        setting: Setting,
    ) -> None:
        if kind not in ("inline", "process", None):
            raise ValueError(f"watch is {kind!r}, expected 'inline', 'process' or None")
        self._tag_settings, self._setting = TagSettings(), setting
        self._watch: Watch | None = None
        if kind is not None:
            make = InlineWatch if kind == "inline" else ProcessWatch
            self._watch = make(model, config, sound_speed)
        self._tags = TagGuard()
        self._paused = False
        self._failure = ""

    @property
    def failure(self) -> str:
        """Why nothing is watched though it should be; empty where it is."""
        return "" if self._watch is None else self._failure or self._watch.failure

    def look(self, state: State, store: MeasurementStore) -> None:
        """A pair more: test the epoch."""
        if self._watch is None or self._paused or not state.epoch_pairs:
            return
        try:
            self._watch.ask(move_case(state, self._setting, store))
            self._failure = ""
        except Exception as error:  # the pair is in the estimate, whatever becomes of the look at it
            self._failure = f"{type(error).__name__}: {error}"

    def pause(self) -> None:
        """Look at nothing for a while."""
        self._paused = True

    def resume(self, state: State, store: MeasurementStore) -> bool:
        """Look again, at once; whether there was something to look at."""
        self._paused = False
        self.look(state, store)
        return self._watch is not None

    def found(self, state: State) -> Found | None:
        """What has been found about the epoch that lasts, if anything has."""
        found = None if self._watch is None else self._watch.answer()
        if found is None or found.epoch != state.epoch:
            return None
        if isinstance(found, LoopClosure):
            return None if state.now.start.motion_known else found
        return found if state.now.first < found.first < state.pairs else None

    def see(self, event: StaticTags) -> tuple[TagGuard, TagsMoved | TagsRest | None]:
        """What a frame of tags says; the guard that comes of it counts once it is given to :meth:`keep`."""
        return (self._tags, None) if self._watch is None else guarded(self._tags, event, self._tag_settings)

    def keep(self, guard: TagGuard) -> None:
        """Go on from here."""
        self._tags = guard

    def epoch_began(self, *, by_tags: bool = False) -> None:
        """Another epoch: what was asked of the old one does not count; tags are compared with those seen from now."""
        if self._watch is not None:
            self._watch.forget()
        if not by_tags:
            self._tags = TagGuard()

    def close(self) -> None:
        """End what runs beside."""
        if self._watch is not None:
            self._watch.close()
            self._watch = None


def move_case(state: State, setting: Setting, store: MeasurementStore) -> MoveCase:
    """The current epoch as the test takes it."""
    looks: dict[int, list[int]] = {}
    for place in range(state.now.first, state.pairs):
        looks.setdefault(store.number(place), []).append(place)
    kept = kept_by_place(state)
    window = None if state.is_open else state.window
    return MoveCase(
        epoch=state.epoch,
        pms=tuple(store.pairs(places, 0) for places in looks.values()),
        places=tuple(places[0] for places in looks.values()),
        inlier=kept[[places[0] for places in looks.values()]],
        state=None if window is None else window.state,
        known=None if window is None else summary(state.with_now(shelf=NOTHING), window.state, setting),
        aims=tuple(store.aims),
        earlier=_earlier(state, setting),
    )


def _earlier(state: State, setting: Setting) -> dict[int, tuple[SharedState, Quadratic]]:
    """Earlier epochs' shared variables, and what was known of them when they ended."""
    found: dict[int, tuple[SharedState, Quadratic]] = {}
    if state.now.start.motion_known or not MIN_LOOKS <= state.epoch_pairs <= MOST_LOOKS:
        return found
    for epoch in range(max(0, state.epoch - CANDIDATES), state.epoch):
        data, until = state.epochs[epoch], state.epochs[: epoch + 1]
        if data.state is not None and sum(len(chunk.kept) for chunk in data.shelf.chunks) >= MIN_EARLIER:
            passed, _ = passed_from(until, data.state, setting.columns)
            then = replace(state, epochs=until, passed=passed)
            found[epoch] = data.state, summary(then, data.state, setting)
    return found
