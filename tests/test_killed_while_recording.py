"""A recorder that is killed at any moment loses nothing that it has acknowledged."""

from __future__ import annotations

from pathlib import Path

from fgreg.session.journal import Journal
from tests.kill import count_events, event_at, run_kills


def test_two_hundred_kills_lose_no_acknowledged_event(tmp_path: Path) -> None:
    toll = run_kills(tmp_path, kills=200, seed=1, estimate=False, longest=80, most_s=0.1)
    assert (toll.lives, toll.missing, toll.damaged) == (200, 0, 0)
    assert toll.taken > 200  # many lives did something before they ended
    assert toll.unasked > 10  # and many ended between disk and acknowledgement
    for folder in toll.sessions:
        with Journal.open(folder) as journal:
            lines = journal.lines
            assert len(journal.take_recorded()) == lines
            journal.append(event_at(tmp_path / "template", lines))
        assert count_events(folder) == lines + 1
