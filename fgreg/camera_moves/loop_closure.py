"""Closing the loop: whether the camera went back to where an earlier epoch had it.

The new epoch's pairs are judged under the earlier epoch's registration (with its uncertainty) against one that is off
by a prior of scales that starts where re-use would do harm: a nudge below that is no reason to start anew, and the
test for moves goes on after re-use anyway. Where static tags were seen in both epochs, they decide.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np

from fgreg.camera_moves.bayes_filter import MoveSettings, Relinearise, check_for_move
from fgreg.camera_moves.static_tags import TagMotion, log_bayes_of_motion
from fgreg.camera_moves.whitened import Gaussian, WhiteTerms
from fgreg.steadiness import MoveScales

SEEN_SIGMAS = 3.0
"""Differences that matter are seen where they are so many standard deviations of the tags' motion."""


class Return(enum.Enum):
    """What the evidence is good for."""

    SAME = "same"
    NEW = "new"
    OPEN = "open"


def elsewhere_scales() -> MoveScales:
    """Where the camera is if it is not back: from just far enough to matter to anywhere.

    Near by, turned only and shifted only have shares of their own: else no turn would speak against a shift.
    """
    degrees, mm = [1.0, 1.2, 0.1, 2.0, 10.0, 40.0], [2.0, 0.3, 2.4, 4.0, 30.0, 120.0]
    return MoveScales(np.radians(degrees), np.array(mm), np.array([0.2, 0.15, 0.15, 0.2, 0.2, 0.1]))


@dataclass(frozen=True, slots=True, eq=False)
class ReturnSettings:
    """How to decide.

    Attributes:
        elsewhere: prior of the registration's difference where the camera is not back.
        least_pairs: fewer never re-use an epoch.
        accept, reject: log Bayes factors of the same place from which it is (or below minus which it is not) re-used;
            accept by the share of cameras 2 mm or 1 deg off that are taken for back (tools/study_returns.py).
        junk_probability: of each pair.
        least_difference: turn (rad) and shift (mm) that matter.
        tolerance: turn (rad) and shift (mm), sigmas, that a camera that is back may be off.
    """

    elsewhere: MoveScales
    least_pairs: int = 8
    accept: float = 4.7
    reject: float = math.log(100.0)
    junk_probability: float = 0.04
    least_difference: tuple[float, float] = (math.radians(1.0), 2.0)
    tolerance: tuple[float, float] = (math.radians(0.15), 0.3)

    def __post_init__(self) -> None:
        if not (self.accept > 0 and self.reject > 0 and self.least_pairs >= 1):
            raise ValueError("accept and reject have to be > 0, least_pairs >= 1")


@dataclass(frozen=True, slots=True)
class ReturnTest:
    """Log Bayes factor of the earlier epoch's registration against another one, and what follows."""

    log_bayes: float
    decision: Return


def fits_again(
    earlier: Gaussian,
    terms: WhiteTerms,
    settings: ReturnSettings,
    *,
    pose: slice,
    relinearise: Relinearise | None = None,
    tags: TagMotion | None = None,
) -> ReturnTest:
    """Whether a new epoch's pairs are of an earlier epoch's registration.

    Args:
        earlier: the shared variables' step given everything before these pairs; ``pose`` that of the earlier epoch.
        terms: the new epoch's pairs so far, linearised at the earlier epoch's registration; may be none with tags.
        settings: priors and limits.
        pose: columns of the earlier epoch's registration.
        relinearise: for large differences.
        tags: motion of the static tags from the earlier epoch to now, where both saw them.
    """
    if tags is not None:
        sure = _sees(tags, settings)
        return _decided(-log_bayes_of_motion(tags, settings.elsewhere), settings, enough=sure)
    if terms.count == 0:
        return ReturnTest(0.0, Return.OPEN)
    moves = MoveSettings(settings.elsewhere, settings.junk_probability)
    test = check_for_move(earlier, terms, moves, pose=pose, last=0, relinearise=relinearise)
    return _decided(-float(test.log_bayes[0]), settings, enough=terms.count >= settings.least_pairs)


def _sees(tags: TagMotion, settings: ReturnSettings) -> bool:
    """Whether the tags would show every difference that matters, whichever way it goes."""
    sigma = np.repeat(settings.least_difference, 3)
    worst = float(np.linalg.eigvalsh(tags.covariance / np.outer(sigma, sigma))[-1])
    return worst <= SEEN_SIGMAS**-2


def _decided(log_bayes: float, settings: ReturnSettings, *, enough: bool) -> ReturnTest:
    if enough and log_bayes >= settings.accept:
        return ReturnTest(log_bayes, Return.SAME)
    return ReturnTest(log_bayes, Return.NEW if log_bayes <= -settings.reject else Return.OPEN)


def which_epoch(tests: dict[int, ReturnTest]) -> int | None:
    """The earlier epoch to re-use: of those that fit the one that fits best; None where none does."""
    fitting = {k: t for k, t in tests.items() if t.decision is Return.SAME}
    return max(fitting, key=lambda k: fitting[k].log_bayes) if fitting else None


def default_return_settings() -> ReturnSettings:
    """Settings that the figures in tools/study_moves.py are for."""
    return ReturnSettings(elsewhere_scales())


__all__ = [
    "Return",
    "ReturnSettings",
    "ReturnTest",
    "default_return_settings",
    "elsewhere_scales",
    "fits_again",
    "which_epoch",
]
