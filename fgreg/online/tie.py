"""The motion that led to the epoch that lasts, from the one before or from an earlier one, learnt after it began."""

from __future__ import annotations

from dataclasses import replace

from fgreg.measurements import EpochStart
from fgreg.online.restart import Tools, registered
from fgreg.online.state import State, passed_from, summary, with_common
from fgreg.online.summary import carried_over
from fgreg.online.window import open_window


def with_motion(state: State, start: EpochStart, tools: Tools) -> State:
    """The state with another start of the epoch that lasts: one with the measured motion.

    Where the epoch that the motion is counted from has no registration it says nothing, and the state stays as it was.
    """
    setting = tools.setting
    state = replace(state.with_now(start=start), nis=None, used=False)
    before, layout = state.epochs[start.old(state.epoch)], state.layout
    if before.state is None or layout is None:
        return state
    common = state.window.state if state.window is not None else state.epochs[-2].state or before.state
    there = carried_over(with_common(before.state, common), start)
    state = replace(state, passed=passed_from(state.epochs, there, setting.columns)[0])
    if state.epoch_pairs:
        return registered(state, tools)
    window = open_window((), summary(state, there, setting), layout, state.epoch, 0)
    return replace(state.with_now(state=window.state), window=window, why_none="", is_open=False)
