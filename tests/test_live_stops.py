"""However ``fgreg live`` is ended, its stage gets a stop order, and no other order after that."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from fgreg.session.session_reader import read_session
from tests.stage_ends import SIGNALS, live_stopped_after


@pytest.mark.parametrize("number", SIGNALS)
def test_stage_of_a_live_session_stops_whatever_signal_ends_or_halts_it(tmp_path: Path, number: signal.Signals) -> None:
    folder = tmp_path / "session"
    assert live_stopped_after(folder, "home", number) < 10.0
    assert read_session(folder).events  # what was recorded can be read
