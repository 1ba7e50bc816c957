"""The registration at check points: points known to both devices, which never enter the estimate.

The error at a check is where the registration puts the camera's point, less where the TRUS probe has it. For the tests
both are moved by the estimate of the rig's constants. Its predicted covariance is that of registration and constants at
that point plus the check's own. The checks of one camera epoch give three tests,
whose false alarms together are 0.3 % of sessions:

- a common shift of all of them, three degrees of freedom. Such a shift is what a refracting layer between fibre and
  tissue makes of a registration, and what line and arc cannot show;
- each of them alone;
- the mean error has to stay below the limit with its own 95 %: a bound that does not use the registration's covariance,
  since that does not include what the checks are for. Where cameras and scanner locate the checks too coarsely for it
  (``COARSE``), there is none, and each check says so.

What line and arc cannot show is *covered* where the first two tests would show it: an error of the registration, of the
assumption's own kind and as large as the limit at the worst target, with probability ``COVERED_POWER``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc, chdtri, chndtr

from fgreg.geometry.target_error import gaussian_quantile_mm, offset_quantile_mm
from fgreg.geometry.transforms import FloatArray, hat
from fgreg.model.estimate import Assumption, CheckEstimate, SessionEstimate, Verdict, worst_verdict
from fgreg.model.measurements import Check
from fgreg.registration.rig_at_checks import RigAtChecks
from fgreg.registration.verdict import Condition, verdict_of

SHIFT_P, ALONE_P = 2e-3, 1e-3
"""False alarms of the common shift, and of all checks of an epoch taken alone."""
COVERED_POWER = 0.8
"""Probability of showing an error as large as the limit from which checks cover an assumption that could cause it."""
COARSE = 0.5
"""Share of the limit from which the mean of the checks, located 95 % as well, is too coarse to bound the error."""
MAIN_SHARE = 0.8
"""Share of the error's length from which one axis alone is named."""
NOT_REGISTERED = "there is no registration of its camera epoch"
CHECKS_REFUSE = "the checks refuse the registration of its camera epoch"

ASSUMPTIONS = (
    "one medium along the beam: a layer of water, gel or glass between fibre and tissue refracts the beam and shifts "
    "the registration along the layer's normal, by 2.5 mm for 10 mm of water",
    "the sensitivity window is centred on the image plane: where it is not, the registration is turned about the "
    "probe's axis",
)
"""What line and arc cannot show, in the order of :func:`powers`."""


@dataclass(frozen=True, slots=True, eq=False)
class CheckedEpoch:
    """The checks of one camera epoch: an estimate for each, and the conditions of the verdict."""

    checks: tuple[CheckEstimate, ...]
    conditions: tuple[Condition, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Errors:
    """Errors at n checks: ``plain`` (n, 3), ``each`` (n, 3) with the constants at their estimate, ``covariance``
    (n, 3, 3) with the registration's and the constants'.

    Of the mean, each check weighted by its own precision: ``share`` (n, 3, 3), ``mean`` and ``plain_mean`` (3,),
    ``mean_located`` (3, 3)
    of the checks and of the constants by which the devices locate them, ``mean_covariance`` (3, 3) with the
    registration's. All along the TRUS axes.
    """

    plain: FloatArray
    each: FloatArray
    covariance: FloatArray
    share: FloatArray
    mean: FloatArray
    plain_mean: FloatArray
    mean_located: FloatArray
    mean_covariance: FloatArray


def check_registration(
    checks: Sequence[Check],
    trus_T_camera: FloatArray,
    covariance: FloatArray,
    limit_mm: float,
    rig: RigAtChecks | None = None,
) -> CheckedEpoch:
    """Compare a registration with the checks of its camera epoch.

    Args:
        checks: at least one.
        trus_T_camera: (4, 4). covariance: (6, 6) over its right tangent.
        limit_mm: of the error.
        rig: the constants and their covariance, joint with the registration's; None: they are as declared.
    """
    errors, n = _errors(checks, trus_T_camera, covariance, rig), len(checks)
    nis = np.einsum("ni,ni->n", errors.each, np.linalg.solve(errors.covariance, errors.each[..., None])[..., 0])
    alone = chdtrc(3, nis) < ALONE_P / n
    shift_p = float(chdtrc(3, errors.mean @ np.linalg.solve(errors.mean_covariance, errors.mean)))
    located_mm = float(gaussian_quantile_mm(errors.mean_located[None])[0])
    bound_mm = None
    if located_mm < COARSE * limit_mm or rig is None:
        bound_mm = offset_quantile_mm(errors.plain_mean, errors.mean_located)
    quantiles = gaussian_quantile_mm(errors.covariance)
    off = alone | (shift_p < SHIFT_P)
    found = _conditions(checks, errors, alone, shift_p, bound_mm, limit_mm)
    coarse = ""
    if bound_mm is None:
        coarse = (
            f"cameras and scanner locate the checks to {located_mm:.1f} mm (95 % bound), too coarse to bound an error "
            f"of {limit_mm:g} mm: calibrate the cameras, or commission the rig"
        )
    estimates = tuple(
        CheckEstimate(
            check.t,
            errors.plain[i],
            float(quantiles[i]),
            float(nis[i]),
            Verdict.WARNING if off[i] else Verdict.OK,
            coarse,
        )
        for i, check in enumerate(checks)
    )
    return CheckedEpoch(estimates, tuple(found))


def _errors(
    checks: Sequence[Check], trus_T_camera: FloatArray, covariance: FloatArray, rig: RigAtChecks | None
) -> _Errors:
    rotation, n = trus_T_camera[:3, :3], len(checks)
    camera_p = np.stack([check.camera_p_mm for check in checks])
    trus_p = np.stack([check.trus_p_mm for check in checks])
    error = camera_p @ rotation.T + trus_T_camera[:3, 3] - trus_p
    own = np.stack([rotation @ check.covariance @ rotation.T + check.trus_covariance for check in checks])
    gain = np.concatenate([-rotation @ hat(camera_p), np.broadcast_to(rotation, (n, 3, 3))], axis=-1)
    plain = error
    if rig is not None:
        by_constants = rotation @ rig.seen(camera_p) - rig.shown(trus_p)
        error, covariance = error + by_constants @ rig.value, rig.covariance
        gain = np.concatenate([gain, by_constants], axis=-1)
    predicted = own + gain @ covariance @ gain.swapaxes(1, 2)
    # One that was written down several times counts once.
    points = np.concatenate([camera_p, trus_p], axis=1)
    times = (points[:, None] == points).all(axis=-1).sum(axis=1)
    weight = np.linalg.inv(own) / times[:, None, None]
    own_mean = np.linalg.inv(weight.sum(axis=0))
    share = own_mean @ weight
    mean, plain_mean = (np.einsum("nij,nj->i", share, one) for one in (error, plain))
    mean_gain = np.einsum("nij,njk->ik", share, gain)
    spread = own_mean + mean_gain @ covariance @ mean_gain.T
    located = own_mean + mean_gain[:, 6:] @ covariance[6:, 6:] @ mean_gain[:, 6:].T
    return _Errors(plain, error, predicted, share, mean, plain_mean, located, spread)


def powers(
    checks: Sequence[Check],
    trus_T_camera: FloatArray,
    covariance: FloatArray,
    limit_mm: float,
    targets_mm: FloatArray,
    rig: RigAtChecks | None = None,
) -> tuple[float, ...]:
    """With which probability the checks show an error as large as the limit at the worst target, per ``ASSUMPTIONS``.

    That of a layer shifts all points alike, in the direction in which it shows least, since its normal is not known.
    That of a window turns them about the probe's axis.

    Args:
        checks, trus_T_camera, covariance, limit_mm, rig: as of :func:`check_registration`.
        targets_mm: (m, 3) TRUS.
    """
    errors = _errors(checks, trus_T_camera, covariance, rig)
    trus_p = np.stack([check.trus_p_mm for check in checks])
    least = np.linalg.eigh(errors.mean_covariance)[1][:, -1]
    reach_mm = float(np.linalg.norm(targets_mm[:, 1:], axis=1).max())
    turned = np.cross([1.0, 0.0, 0.0], trus_p) / max(reach_mm, 1e-9)
    return tuple(_power(limit_mm * moved, errors) for moved in (np.broadcast_to(least, trus_p.shape), turned))


def _power(moved: FloatArray, errors: _Errors) -> float:
    """With which probability one of the tests shows that the registration is off by (n, 3) at the checks."""
    mean = np.einsum("nij,nj->i", errors.share, moved)
    together = mean @ np.linalg.solve(errors.mean_covariance, mean)
    alone = np.einsum("ni,ni->n", moved, np.linalg.solve(errors.covariance, moved[..., None])[..., 0])
    shown = [chndtr(chdtri(3, SHIFT_P), 3, together), *chndtr(chdtri(3, ALONE_P / len(moved)), 3, alone)]
    return 1.0 - float(min(shown))


def _conditions(
    checks: Sequence[Check], errors: _Errors, alone: FloatArray, shift_p: float, bound_mm: float | None, limit_mm: float
) -> list[Condition]:
    found = []
    error, mean = errors.plain, errors.plain_mean
    norm = float(np.linalg.norm(mean))
    several = len(checks) > 1
    middle = np.mean([check.trus_p_mm for check in checks], axis=0)
    if shift_p < SHIFT_P:
        expected = float(gaussian_quantile_mm(errors.mean_covariance[None])[0])
        surely_mm = 2.0 * norm - offset_quantile_mm(mean, errors.mean_located)
        text = (
            f"the {'checks are' if several else 'check is'} off by {norm:.1f} mm {direction_text(mean, middle)}, "
            f"{expected:.1f} mm expected at most: look for a layer of water or gel between fibre and tissue, and check "
            "radius, ranges and sensitivity window in session.yaml; register again, or locate the checks again"
        )
        found.append(Condition(Verdict.REFUSED if surely_mm > 2.0 * limit_mm else Verdict.WARNING, text))
    if bound_mm is not None and bound_mm >= limit_mm:
        advice = "register again" if shift_p < SHIFT_P else "locate the checks more accurately, or take more of them"
        text = (
            f"the mean error at the check{'s' if several else ''} is {norm:.1f} mm, at most {bound_mm:.1f} mm (95 % "
            f"bound), and has to be below {limit_mm:g} mm: {advice}"
        )
        found.append(Condition(Verdict.WARNING, text))
    if several:
        for i in np.flatnonzero(alone).tolist():
            where = direction_text(error[i], checks[i].trus_p_mm)
            text = (
                f"the check at {checks[i].t:.1f} s is off by {np.linalg.norm(error[i]):.1f} mm {where}: locate it again"
            )
            found.append(Condition(Verdict.WARNING, text))
    return found


def direction_text(error_mm: FloatArray, trus_p_mm: FloatArray) -> str:
    """Along which of the probe's own axes an error (3,) is at a point (3,), both TRUS, in plain words."""
    radial = np.array([0.0, trus_p_mm[1], trus_p_mm[2]])
    radial = radial / max(float(np.linalg.norm(radial)), 1e-9)
    sideways = np.array([0.0, radial[2], -radial[1]])
    parts = [
        (float(error_mm[0]), "along the probe", "too far towards +x", "too far towards -x"),
        (float(error_mm @ radial), "along the line to the probe", "too far from it", "too near it"),
        (float(error_mm @ sideways), "sideways", "at too large stage angles", "at too small stage angles"),
    ]
    parts.sort(key=lambda part: -abs(part[0]))
    norm = float(np.linalg.norm(error_mm))
    if abs(parts[0][0]) >= MAIN_SHARE * norm:
        _, axis, plus, minus = parts[0]
        return f"{axis} (the registration puts points {plus if parts[0][0] > 0 else minus})"
    named = [
        f"{abs(size):.1f} mm {axis} ({plus if size > 0 else minus})"
        for size, axis, plus, minus in parts
        if abs(size) >= 0.3 * norm
    ]
    return "(" + " and ".join(named) + ")"


def with_checks(
    estimate: SessionEstimate,
    checks: Sequence[Check | CheckEstimate],
    limit_mm: float,
    targets_mm: FloatArray,
    rigs: Mapping[int, RigAtChecks] | None = None,
) -> SessionEstimate:
    """The estimate with its checks, their effect on the verdicts, and the assumptions that they cover.

    Args:
        estimate: of the session, without checks.
        checks: in event order; those that are not usable with the reason.
        limit_mm: of the error.
        targets_mm: (m, 3) TRUS points at which it matters.
        rigs: the constants in each epoch, by its number; as declared where absent.
    """
    results: dict[int, CheckEstimate] = {}
    covered: tuple[tuple[int, ...], ...] = ((),) * len(ASSUMPTIONS)
    conditions: dict[int, tuple[Condition, ...]] = {}
    current = len(estimate.epochs) - 1
    for epoch in estimate.epochs:
        mine = {i: at for i, at in enumerate(checks) if isinstance(at, Check) and at.epoch == epoch.index}
        if not mine or epoch.trus_T_camera is None or epoch.covariance is None:
            continue
        rig = (rigs or {}).get(epoch.index)
        found = check_registration([*mine.values()], epoch.trus_T_camera, epoch.covariance, limit_mm, rig)
        results.update(zip(mine, found.checks, strict=True))
        conditions[epoch.index] = found.conditions
        if epoch.index == current and not found.conditions and epoch.verdict is not Verdict.REFUSED:
            shown = powers([*mine.values()], epoch.trus_T_camera, epoch.covariance, limit_mm, targets_mm, rig)
            covered = tuple(tuple(mine) if power >= COVERED_POWER else () for power in shown)
    for i, at in enumerate(checks):
        if i not in results:
            results[i] = at if isinstance(at, CheckEstimate) else not_compared(at.t, NOT_REGISTERED)
    return replace(
        with_conditions(estimate, conditions),
        checks=tuple(results[i] for i in range(len(checks))),
        assumptions=tuple(Assumption(text, by) for text, by in zip(ASSUMPTIONS, covered, strict=True)),
    )


def not_compared(t: float, reason: str) -> CheckEstimate:
    """The estimate of a check that is not usable."""
    return CheckEstimate(t, None, None, None, Verdict.WARNING, reason)


def with_conditions(estimate: SessionEstimate, conditions: Mapping[int, Sequence[Condition]]) -> SessionEstimate:
    """The estimate with more conditions of some of its epochs. The camera is in the last epoch."""
    several, current = len(estimate.epochs) > 1, len(estimate.epochs) - 1
    verdicts = {
        index: verdict_of(found) if index == current else min(verdict_of(found), Verdict.WARNING, key=_severity)
        for index, found in conditions.items()
    }
    texts = [
        f"epoch {index}: {condition.text}" if several else condition.text
        for index, found in conditions.items()
        for condition in found
    ]
    worse = any(verdict.severity > estimate.verdict.severity for verdict in verdicts.values())
    return replace(
        estimate,
        verdict=worst_verdict(estimate.verdict, *verdicts.values()),
        reasons=(*texts, *estimate.reasons) if worse else (*estimate.reasons, *texts),
        epochs=tuple(
            replace(epoch, verdict=worst_verdict(epoch.verdict, verdict_of(conditions.get(epoch.index, ()))))
            for epoch in estimate.epochs
        ),
    )


def _severity(verdict: Verdict) -> int:
    return verdict.severity
