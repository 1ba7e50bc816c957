"""Whether new shots agree with a finished registration: is it still valid, has the camera moved, or is it degraded?

Nothing is added to the registration. The new PMs as whitened linear equations (fgreg.camera_moves.whitened) have a
residual r, a derivative J by the shared variables and the covariance S = 1 + J C J', C that of the estimate. Their
chi square r' S^-1 r splits into two independent parts:

- what another registration would explain: least squares over its six parameters, of as many degrees of freedom as the
  equations determine;
- the rest, which no camera move explains.

Either alarms with half of the false alarms, and the first with all of them where there is no rest (up to three PMs of
one look each). The Bayes factor of a camera move against outliers and noise (fgreg.camera_moves.bayes_filter) then
tells a move from a wrong detection.

Without an alarm the registration is valid only where the Bayes factor of a camera elsewhere, far enough for the
registration to do harm (fgreg.camera_moves.loop_closure), is small, and where the shots determine all six parameters. A
single shot is two equations, and never shows every turn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.special import chdtrc, chdtri, chndtrinc

from fgreg.camera_moves.bayes_filter import MoveSettings, move_evidence, relinearisation
from fgreg.camera_moves.loop_closure import elsewhere_scales
from fgreg.camera_moves.whitened import POSE, TYPICAL_MM, TYPICAL_RAD, Gaussian, WhitenedPms, linearise
from fgreg.geometry.transforms import FloatArray, IntArray, hat, inverse, make_transform, transform_points
from fgreg.graph.packing import PackedProblem
from fgreg.model.measurements import EpochStart, Measurements, Pair
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.registration.register import pack_session
from fgreg.tracking.snapshot import EpochSnapshot, Snapshot

FALSE_ALARMS = 0.01
POWER = 0.9
"""Probability with which a change is shown that is said to be."""
MOVED_LOG_ODDS = math.log(3.0)
"""Odds of a move, against wrong detections, above which the camera counts as moved."""
VALID_LOG_ODDS = math.log(20.0)
"""Log odds against a camera that is elsewhere from which the registration is valid."""
SPARE = 3
"""Number of PMs that have to agree before one other is left out as an outlier."""
LEAST_SEEN = 1e-9
"""Relative information on a motion below which it is not seen at all."""
SCALE = np.repeat([TYPICAL_RAD, TYPICAL_MM], 3)
"""Rotations (rad) and shifts (mm) of equal importance."""
MOST_DEG, MOST_LOG_ODDS = 90.0, math.log(1e6)
"""Larger turns and odds are not given in figures."""


class Validity(StrEnum):
    """What new shots say of a finished registration."""

    VALID = "valid"
    MOVED = "moved"
    DEGRADED = "degraded"
    CANNOT_TELL = "cannot tell"


@dataclass(frozen=True, slots=True)
class NewShot:
    """One new PM: its innovation by the registration alone, with degrees of freedom and tail probability."""

    pm: int
    nis: float
    equations: int
    p: float
    used: bool


@dataclass(frozen=True, slots=True)
class Verification:
    """Result for a registration.

    Attributes:
        validity, reason: the verdict, and a sentence with its figures and what to do.
        log_odds: log Bayes factor of a camera move against none; without an alarm of a move far enough to do harm.
        p: tail probability of the shots' chi square, had nothing changed.
        shots: each PM; an outlier among agreeing ones is not used.
        shift_mm, turn_rad: smallest shift in every direction, and smallest turn about the middle of the targets about
            every axis, that the shots show with probability ``POWER``; infinite where some are never shown.
    """

    validity: Validity
    reason: str
    log_odds: float
    p: float
    shots: tuple[NewShot, ...]
    shift_mm: float = math.inf
    turn_rad: float = math.inf


def verify(
    pairs: Sequence[Pair],
    snapshot: Snapshot,
    epoch: EpochSnapshot,
    model: SessionModel,
    config: SolveConfig,
) -> Verification:
    """Compare new pairs with a registration.

    Args:
        pairs: new ones; their epochs are ignored.
        snapshot, epoch: the registration.
        model, config: as it was solved with.
    """
    if not pairs:
        return Verification(Validity.CANNOT_TELL, "there is no usable pair: take one", 0.0, 1.0, ())
    numbers = tuple(dict.fromkeys(pair.pm for pair in pairs))
    state, _, covariance = snapshot.shared(epoch)

    def packed(chosen: IntArray, *, shapes: bool) -> PackedProblem:
        mine = tuple(
            replace(pair, pm=place, epoch=0)
            for place, i in enumerate(chosen)
            for pair in pairs
            if pair.pm == numbers[i]
        )
        settings = config if shapes else replace(config, window_shape=False)
        return pack_session(Measurements((), mine, (EpochStart(0.0),)), model, settings)

    every = np.arange(len(numbers))
    terms = linearise(packed(every, shapes=False), state)
    alone = [_Fit.of(terms, every[i : i + 1], covariance) for i in every]
    used, fit = every, _Fit.of(terms, every, covariance)
    if fit.alarm and len(numbers) > SPARE:
        without = [_Fit.of(terms, np.delete(every, i), covariance) for i in every]
        best = int(np.argmin([one.chi2 for one in without]))
        if not without[best].alarm:
            used, fit = np.delete(every, best), without[best]
    problem = packed(used, shapes=True)
    before = Gaussian(np.zeros(len(covariance)), covariance)
    first = np.zeros(1, dtype=np.int64)
    terms, settings = linearise(problem, state), MoveSettings() if fit.alarm else MoveSettings(elsewhere_scales())
    evidence = move_evidence(before, terms, first, settings, relinearisation(problem, state))
    log_odds = float(evidence.log_bayes[0])
    shots = tuple(
        NewShot(pm, one.chi2, one.freedom, float(chdtrc(one.freedom, one.chi2)), bool(i in used))
        for i, (pm, one) in enumerate(zip(numbers, alone, strict=True))
    )
    shift_mm, turn_rad = _sizes_shown(fit, make_transform(epoch.rotation, epoch.translation_mm), model.targets_mm)
    validity, reason = _verdict(fit, log_odds, _shown_text(shift_mm, turn_rad), shots)
    return Verification(validity, reason, log_odds, fit.p, shots, shift_mm, turn_rad)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Chi square of some PMs in two parts: what another registration would explain, and the rest.

    Attributes:
        chi2, freedom: the whole. explained, determined: the first part.
        information: (6, 6) of the PMs on the registration, all else and the registration as well known as they are.
    """

    chi2: float
    freedom: int
    explained: float
    determined: int
    information: FloatArray

    @classmethod
    def of(cls, terms: WhitenedPms, chosen: IntArray, covariance: FloatArray) -> _Fit:
        residual = terms.residual[0, chosen].reshape(-1)
        jacobian = terms.jacobian[0, chosen].reshape(len(residual), -1)
        spread = np.eye(len(residual)) + jacobian @ covariance @ jacobian.T
        by_pose = jacobian[:, POSE]
        weighted = np.linalg.solve(spread, np.column_stack([residual, by_pose]))
        chi2 = float(residual @ weighted[:, 0] + terms.rest[0, chosen].sum())
        information, pull = by_pose.T @ weighted[:, 1:], by_pose.T @ weighted[:, 0]
        freedom = int(terms.equations[chosen].sum())
        values, vectors = np.linalg.eigh(information * SCALE * SCALE[:, None])
        kept = values > LEAST_SEEN * values[-1]
        kept[: max(0, 6 - freedom)] = False
        explained = float(np.sum((vectors.T @ (SCALE * pull))[kept] ** 2 / values[kept]))
        return cls(chi2, freedom, min(explained, chi2), int(kept.sum()), information)

    @property
    def level(self) -> float:
        """False alarms of each part."""
        return FALSE_ALARMS if self.freedom == self.determined else 0.5 * FALSE_ALARMS

    @property
    def move_p(self) -> float:
        return float(chdtrc(self.determined, self.explained))

    @property
    def rest_p(self) -> float:
        rest = self.freedom - self.determined
        return float(chdtrc(rest, self.chi2 - self.explained)) if rest else 1.0

    @property
    def p(self) -> float:
        """Tail probability of the more unlikely part."""
        return min(1.0, min(self.move_p, self.rest_p) * FALSE_ALARMS / self.level)

    @property
    def alarm(self) -> bool:
        return self.p < FALSE_ALARMS


def _sizes_shown(fit: _Fit, trus_T_camera: FloatArray, targets_mm: FloatArray) -> tuple[float, float]:
    """Smallest shift (mm) and smallest turn (rad) about the middle of the targets that are shown in any direction."""
    needed = float(chndtrinc(chdtri(fit.determined, fit.level), fit.determined, 1.0 - POWER))
    middle = transform_points(inverse(trus_T_camera), targets_mm.mean(axis=0)[None])[0]
    shift, turn = np.eye(6)[:, 3:], np.concatenate([np.eye(3), hat(middle)])

    def size(directions: FloatArray) -> float:
        values = np.linalg.eigvalsh(directions.T @ fit.information @ directions)
        return math.sqrt(needed / values[0]) if values[0] > LEAST_SEEN * values[-1] else math.inf

    return size(shift), size(turn)


def _verdict(fit: _Fit, log_odds: float, shown: str, shots: Sequence[NewShot]) -> tuple[Validity, str]:
    """The verdict and its sentence; ``shown``: what the shots show in every direction."""
    count = sum(shot.used for shot in shots)
    out = [f"PM {shot.pm} (nis {shot.nis:.0f})" for shot in shots if not shot.used]
    aside = f"; {out[0]} does not fit and is left out: look at what was detected there" if out else ""
    figures = f"chi square {fit.chi2:.1f} for {fit.freedom} degrees of freedom"
    many = count > 1
    if fit.alarm:
        wrong = f"the {f'{count} shots do' if many else 'shot does'} not fit the registration ({figures})"
        look = "look at what was detected, check fibre, marker and probe"
        if fit.rest_p < fit.level:
            return Validity.DEGRADED, f"{wrong}, and no other registration explains that: {look}, and register again"
        if log_odds > MOVED_LOG_ODDS:
            return Validity.MOVED, f"{wrong}; odds {odds_text(log_odds)} that the camera has moved: register again"
        text = f"odds {odds_text(-log_odds)} for a wrong detection against a camera move: {look}, take another shot"
        if log_odds > 0.0:
            text = f"wrong detections explain that about as well as a camera move: {look}, take another shot"
        return Validity.DEGRADED, f"{wrong}; {text}"
    agree = f"the {f'{count} shots agree' if many else 'shot agrees'} with the registration ({figures}); odds"
    agree += f" {odds_text(-log_odds)} that the camera has not moved"
    if fit.determined == 6 and log_odds <= -VALID_LOG_ODDS:
        return Validity.VALID, f"{agree}; {shown}{aside}"
    return Validity.CANNOT_TELL, f"{agree}, but {shown}: take more shots, at other spots and from other sides{aside}"


def _shown_text(shift_mm: float, turn_rad: float) -> str:
    """What the shots show with probability ``POWER``, in every direction."""
    if math.isinf(shift_mm) or math.degrees(turn_rad) > MOST_DEG:
        return "some shifts or turns would not show, however large"
    return (
        f"a shift of {shift_mm:.1f} mm or a turn of {math.degrees(turn_rad):.1f} deg about the middle of the targets "
        f"would show ({100 * POWER:.0f} % of the time)"
    )


def odds_text(log_odds: float) -> str:
    """Odds from their log, such as "1 to 3" and "25 to 1"."""
    odds = f"{math.exp(min(abs(log_odds), MOST_LOG_ODDS)):,.0f}"
    return f"1 to {odds}" if log_odds < 0.0 else f"{odds} to 1"
