"""Proposals of the importance sampling of fgreg.registration.posterior: mixtures of Student densities."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, IntArray
from fgreg.graph.columns import Columns
from fgreg.graph.split_points import logsumexp

DEGREES_OF_FREEDOM = 6
"""Of the Student proposals: tails heavier than the posterior's, else rare samples would have all the weight."""
KERNELS = 40
"""Number of kernels of a later proposal that are centred on samples of earlier rounds."""
WIDE, SHARES = 1.8, (0.4, 0.1, 0.5)
"""Scale of the wide component, which finds curved tails; shares of draws: about the mean, wide, and on samples."""


def split_columns(columns: Columns) -> tuple[IntArray, IntArray]:
    """Columns that are sampled, and those of the constants that enter (nearly) linearly, all but the window's edge."""
    linear = [columns.at(Constant(c)) for c in columns.constants if c != Constant.WINDOW_EDGE]
    rest = np.setdiff1d(np.arange(columns.size), np.array(linear, dtype=np.int64))
    return rest, np.array(linear, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Conditional:
    """Gaussian of the linear constants (C,) given the sampled variables (X,), about a mode: ``origin + gain x``."""

    origin: FloatArray
    gain: FloatArray
    root: FloatArray

    @classmethod
    def of(cls, centre: FloatArray, covariance: FloatArray, sampled: IntArray, linear: IntArray) -> Conditional:
        """From a mode's tangent (D,) and its covariance (D, D)."""
        cross = covariance[np.ix_(linear, sampled)]
        gain = np.asarray(np.linalg.solve(covariance[np.ix_(sampled, sampled)], cross.T).T, dtype=np.float64)
        left = covariance[np.ix_(linear, linear)] - gain @ cross.T
        return cls(centre[linear] - gain @ centre[sampled], gain, cholesky(0.5 * (left + left.T)))

    def log(self, x: FloatArray, c: FloatArray) -> FloatArray:
        """(S,) log density of constants (S, C) at (S, X), up to a constant common to all modes."""
        off = np.linalg.solve(self.root, (c - self.origin - x @ self.gain.T).T)
        return np.asarray(-0.5 * np.sum(off**2, axis=0) - np.log(np.diag(self.root)).sum())


@dataclass(frozen=True, slots=True, eq=False)
class Students:
    """Mixture of K multivariate Student densities of the sampled variables, grouped by shape.

    The linear constants are drawn given these. Conditional on a sample their density is nearly Gaussian, so that they
    cost no effective samples, however many they are.

    Attributes:
        sampled (X,), linear (C,): columns.
        centre: (K, X). group: (K,) number of each one's root. scale: (K,) factor on it. share: (K,).
        root: (G, X, X) lower triangular Cholesky factors of the shapes.
        mode: (K,) whose conditional holds for each one. conditional: one for each mode.
    """

    sampled: IntArray
    linear: IntArray
    centre: FloatArray
    group: IntArray
    scale: FloatArray
    share: FloatArray
    root: FloatArray
    mode: IntArray
    conditional: tuple[Conditional, ...]

    def draw(self, rng: np.random.Generator, count: int) -> FloatArray:
        """(count, D) samples of all variables."""
        which = rng.choice(len(self.share), count, p=self.share)
        normal = rng.standard_normal((count, self.centre.shape[1]))
        stretch = self.scale[which] * np.sqrt(DEGREES_OF_FREEDOM / rng.chisquare(DEGREES_OF_FREEDOM, count))
        x = self.centre[which]
        for group, root in enumerate(self.root):
            mine = self.group[which] == group
            x[mine] += (normal[mine] * stretch[mine, None]) @ root.T
        out = np.empty((count, len(self.sampled) + len(self.linear)))
        out[:, self.sampled] = x
        noise = rng.standard_normal((count, len(self.linear)))
        for mode, given in enumerate(self.conditional):
            rows = np.flatnonzero(self.mode[which] == mode)
            out[np.ix_(rows, self.linear)] = given.origin + x[rows] @ given.gain.T + noise[rows] @ given.root.T
        return out

    def given(self, samples: FloatArray) -> FloatArray:
        """(M, S) log density of the linear constants of samples (S, D), for each mode; all rounds have the same."""
        x, c = samples[:, self.sampled], samples[:, self.linear]
        return np.stack([mode.log(x, c) for mode in self.conditional])

    def log(self, samples: FloatArray, given: FloatArray) -> FloatArray:
        """(S,) log density of all variables (S, D), up to a constant common to all mixtures; ``given`` as above."""
        x = samples[:, self.sampled]
        size = x.shape[1]
        out = []
        for mode, group in sorted({*zip(self.mode.tolist(), self.group.tolist(), strict=True)}):
            root = self.root[group]
            mine = np.flatnonzero((self.group == group) & (self.mode == mode))
            # Distances from the group's first centre keep the squares small, which is more accurate.
            origin = self.centre[mine[0]]
            at = np.linalg.solve(root, (x - origin).T)
            centre = np.linalg.solve(root, (self.centre[mine] - origin).T)
            square = np.sum(centre**2, axis=0)[:, None] - 2.0 * centre.T @ at + np.sum(at**2, axis=0)
            square = np.maximum(square, 0.0) / (DEGREES_OF_FREEDOM * self.scale[mine, None] ** 2)
            kernel = _power(np.sqrt(1.0 / (1.0 + square)), DEGREES_OF_FREEDOM + size)
            with np.errstate(divide="ignore"):  # no density far off
                log = np.log((self.share[mine] * self.scale[mine] ** -size) @ kernel) - np.log(np.diag(root)).sum()
            out.append(log + given[mode])
        return logsumexp(np.array(out), axis=0)


def _power(base: FloatArray, exponent: int) -> FloatArray:
    """Powers by repeated squaring, which take a third of the time of exponentials of logarithms."""
    out = np.ones_like(base)
    while exponent:
        if exponent & 1:
            out = out * base
        exponent >>= 1
        if exponent:
            base = base * base
    return out


def cholesky(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.cholesky(covariance), dtype=np.float64)


def effective_samples(log_weight: FloatArray) -> float:
    return float(np.exp(2.0 * logsumexp(log_weight) - logsumexp(2.0 * log_weight)))


def _tempered(log_weight: FloatArray, least: float) -> FloatArray:
    """Weights (S,), tempered by a power where their effective number of samples is below ``least``."""
    power = 1.0
    while effective_samples(power * log_weight) < min(least, 0.5 * len(log_weight)) and power > 1e-3:
        power *= 0.8
    return np.asarray(np.exp(power * log_weight - logsumexp(power * log_weight)))


def refitted(
    first: Students, x: FloatArray, log_weight: FloatArray, nearest: IntArray, rng: np.random.Generator
) -> Students:
    """The next round's proposal: Students about the samples' mean and about some of the samples.

    Args:
        first: the first round's proposal; the shape of its first component is used as far as samples are few.
        x: (S, D) samples. log_weight: (S,). nearest: (S,) mode of each.
        rng: random numbers.
    """
    x = x[:, first.sampled]
    size = x.shape[1]
    weight = _tempered(log_weight, 3.0 * size)
    effective = 1.0 / float(np.sum(weight**2))
    centre = weight @ x
    spread = x - centre
    trust = effective / (effective + size)
    fallback = first.root[0] @ first.root[0].T
    moment = trust * (spread * weight[:, None]).T @ spread + (1.0 - trust) * fallback
    # Kernel width of a density estimate from this many samples (Silverman).
    width = (4.0 / (size + 2.0)) ** (1.0 / (size + 4.0)) * effective ** (-1.0 / (size + 4.0))
    chosen = rng.choice(len(x), KERNELS, p=weight)
    main = int(np.argmax(np.bincount(nearest, weight)))
    return replace(
        first,
        centre=np.concatenate([centre[None], centre[None], x[chosen]]),
        group=np.zeros(2 + KERNELS, dtype=np.int64),
        scale=np.concatenate([[1.0, WIDE], np.full(KERNELS, width)]),
        share=np.concatenate([SHARES[:2], np.full(KERNELS, SHARES[2] / KERNELS)]),
        root=cholesky(moment)[None],
        mode=np.concatenate([[main, main], nearest[chosen]]),
    )
