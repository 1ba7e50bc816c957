"""The recording's colours are told apart by colour-blind people, and the verdict without colours."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from fgreg.model.estimate import Verdict
from fgreg.viewer import blueprint, legend, palette
from fgreg.viewer.verdict_strip import strip
from tests.color_vision import SEEN, contrast, difference

TOLD_APART = 15.0
"""CIE 1976 distance; 2.3 is just noticeable side by side."""
SEEN_ON_GROUND = 3.0
"""WCAG's contrast ratio for graphical objects."""


@pytest.mark.parametrize("seen", SEEN)
@pytest.mark.parametrize(
    "colors", [tuple(palette.DRAWN.values()), palette.ERRORS, tuple(palette.VERDICTS.values())], ids=str
)
def test_no_two_colours_that_are_drawn_together_look_alike(colors: tuple[palette.Color, ...], seen: str) -> None:
    closest = min(difference(first, second, seen) for first, second in itertools.combinations(colors, 2))
    assert closest > TOLD_APART


def test_red_and_green_of_one_lightness_do_look_alike_to_the_test() -> None:
    assert difference((200, 90, 60), (130, 125, 50), "deuteranopia") < TOLD_APART


def test_everything_stands_out_from_the_ground() -> None:
    ground = blueprint.BACKGROUNDS[Verdict.OK]
    assert min(contrast(color, ground) for color in palette.DRAWN.values()) >= SEEN_ON_GROUND
    assert len({words for words, _, _ in legend.ENTRIES}) == len(legend.ENTRIES)
    # Two entries of one colour have different signs.
    assert len({(sign, color) for _, sign, color in legend.ENTRIES}) == len(legend.ENTRIES)


def test_errors_change_colour_at_the_limit_and_at_the_refusal() -> None:
    colors = palette.error_colors(np.array([0.0, 1.5, 2.9, 3.1, 6.0, 6.1, np.inf]), 3.0)
    assert [palette.ERRORS.index(color) for color in colors] == [0, 0, 1, 2, 2, 3, 3]


def test_verdicts_have_different_signs_and_patterns_in_one_colour() -> None:
    strips = [strip(verdict, (200, 200, 200)).astype(float) for verdict in (*Verdict, None)]
    for first, second in itertools.combinations(strips, 2):
        sign, pattern = (np.abs(first - second)[:, part].mean() for part in (slice(100), slice(140, None)))
        assert sign > 10.0
        assert pattern > 10.0
