"""The motion that led to the epoch that lasts, learnt after it began."""

from __future__ import annotations

from dataclasses import replace

from fgreg.measurements import EpochStart
from fgreg.online.restart import Tools, registered
from fgreg.online.state import State, passed_from, summary
from fgreg.online.summary import carried_over
from fgreg.online.window import open_window


def with_motion(state: State, start: EpochStart, tools: Tools) -> State:
    """The state with another start of the epoch that lasts: one with the measured motion.

    Where the epoch before has no registration the motion says nothing, and the state stays without one.
    """
    setting = tools.setting
    state = replace(state.with_now(start=start), nis=None, used=False)
    before, layout = state.epochs[-2], state.layout
    if before.state is None or layout is None:
        return state
    there = carried_over(before.state, start)
    state = replace(state, passed=passed_from(state.epochs, there, setting.columns)[0])
    if state.epoch_pairs:
        return registered(state, tools)
    window = open_window((), summary(state, there, setting), layout, state.epoch, 0)
    return replace(state.with_now(state=window.state), window=window, why_none="", is_open=False)
