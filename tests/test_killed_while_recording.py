"""A recorder that is killed at any moment loses nothing that it has acknowledged."""

from __future__ import annotations

from pathlib import Path

from fgreg.session.journal import Journal
from tests.kill import count_events, difference_from_uninterrupted, event_at, run_kills


def test_eighty_kills_lose_no_acknowledged_event(tmp_path: Path) -> None:
    toll = run_kills(tmp_path, kills=80, seed=1, estimate=False, longest=80, most_s=0.06)
    assert (toll.lives, toll.missing, toll.damaged) == (80, 0, 0)
    assert toll.taken >= 40  # the lives did something before they ended
    assert toll.unasked > 0  # and some ended between disk and acknowledgement
    for folder in toll.sessions:
        with Journal.open(folder) as journal:
            lines = journal.lines
            assert len(journal.events) == lines
            journal.append(event_at(tmp_path / "template", lines))
        assert count_events(folder) == lines + 1


def test_killed_and_opened_again_the_estimate_is_that_of_an_unbroken_session(tmp_path: Path) -> None:
    toll = run_kills(tmp_path, kills=14, seed=2, estimate=True, longest=12, most_s=0.2)
    assert (toll.lives, toll.missing, toll.damaged) == (14, 0, 0)
    assert toll.taken >= 7
    for folder in toll.sessions[:1]:
        assert difference_from_uninterrupted(folder, tmp_path / "template") <= 1e-6
