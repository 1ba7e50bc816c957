"""What the time of a session went into is told in words."""

from fgreg.live.time_spent import CALIBRATING, SEARCHING, TimeSpent


def test_time_is_summed_up_by_purpose_and_short_ones_are_left_out() -> None:
    spent = TimeSpent()
    for t, purpose in (
        (10.0, CALIBRATING),
        (38.0, CALIBRATING),
        (50.0, SEARCHING),
        (50.4, "resting"),
        (60.0, SEARCHING),
    ):
        spent.add(t, purpose)
    assert spent.text() == "50 s: 28 s calibrating, 22 s searching"
