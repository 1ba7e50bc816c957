"""What finds out untold camera moves, as the engine uses it: the watch on pairs, and the guard on tags."""

from __future__ import annotations

import math
from typing import Literal

from fgreg.camera_moves.static_tags import TagSettings
from fgreg.config import SolveConfig
from fgreg.models import SessionModel
from fgreg.online.back import ReturnFound, return_case
from fgreg.online.early import early_case
from fgreg.online.events import StaticTags
from fgreg.online.evidence import GATE, move_case
from fgreg.online.state import Setting, State
from fgreg.online.store import MeasurementStore
from fgreg.online.tag_guard import TagGuard, TagsMoved, TagsRest, guarded
from fgreg.online.updates import FEW_PAIRS
from fgreg.online.watch import Case, Found, InlineWatch, ProcessWatch, Watch, WatchSettings
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
        self._settings, self._tag_settings, self._setting = WatchSettings(), TagSettings(), setting
        self._watch: Watch | None = None
        if kind is not None:
            make = InlineWatch if kind == "inline" else ProcessWatch
            self._watch = make(model, config, sound_speed, self._settings)
        self._tags = TagGuard()
        self._paused = False
        self._score: float | None = None
        self._failure = ""

    @property
    def failure(self) -> str:
        """Why nothing is watched though it should be; empty where it is."""
        return "" if self._watch is None else self._failure or self._watch.failure

    def look(self, state: State, serial: int, store: MeasurementStore) -> None:
        """A pair more: ask for the proper tests where the cheap look says so, and while the epoch is young."""
        if self._watch is None or self._paused:
            return
        try:
            move = None
            if self._may_look_moved(state):
                move, self._score = move_case(state, serial, self._setting, self._settings.moves)
            early = early_case(state, self._setting, store, self._settings.moves)
            back = return_case(state, self._setting, store, self._settings.returns)
            if move is not None or early is not None or back is not None:
                self._watch.ask(Case(state.epoch, move, early, back))
            self._failure = ""
        except Exception as error:  # the pair is in the estimate, whatever becomes of the look at it
            self._failure, self._score = f"{type(error).__name__}: {error}", None

    def _may_look_moved(self, state: State) -> bool:
        """Whether a look could show more than the gate: a pair adds at most half its NIS to the log of any move's odds.

        The odds of a move before it are those of none, so the sum of all grows to at most (sum + 1) times that. Among
        few pairs others may be judged anew with it, and then that is no limit.
        """
        if state.nis is None or not state.used or self._score is None or state.epoch_pairs <= FEW_PAIRS:
            return True
        self._score = math.log1p(math.exp(min(self._score, 50.0))) + 0.5 * state.nis
        return self._score >= GATE

    def pause(self) -> None:
        """Look at nothing for a while."""
        self._paused = True

    def resume(self, state: State, serial: int, store: MeasurementStore) -> bool:
        """Look again, at once; whether there was something to look at."""
        self._paused = False
        self.look(state, serial, store)
        return self._watch is not None

    def found(self, state: State) -> Found | None:
        """What has been found about the epoch that lasts, if anything has."""
        found = None if self._watch is None else self._watch.answer()
        if found is None or found.epoch != state.epoch:
            return None
        if isinstance(found, ReturnFound):
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
        self._score = None
        if self._watch is not None:
            self._watch.forget()
        if not by_tags:
            self._tags = TagGuard()

    def close(self) -> None:
        """End what runs beside."""
        if self._watch is not None:
            self._watch.close()
            self._watch = None
