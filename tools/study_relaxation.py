"""Semidefinite relaxations of the registration, solved by Clarabel, beside the certificate (fgreg.certificate).

    python tools/study_relaxation.py --sessions 10

The statement. With the beam known (o + lambda d in the camera), each PM at c + r u on its arc (c: the array's element
at the measured x, u: the unit vector (0, a, b) at an arc angle, both TRUS), one standard deviation sigma per pair, and
the window a Gaussian of the arc angle about u0, the cost is quadratic in R, s = R' t and w = R' u:

    sum over pairs of |(I - d d') (R' c + r w - s - o)|^2 / sigma^2 + |w - R' u0|^2 / sigma_arc^2

With q1, q2, q3 the rows of R: R R' = R' R = 1, each row is the cross product of the other two, |w| = 1, q1 . w = 0.
Shor's relaxation puts a positive semidefinite matrix in place of the products of the variables.

- ``dense``: these constraints, one matrix of 13 + 3 n rows.
- ``chordal``: a and b are variables too, with a = q2 . w, b = q3 . w, w = a q2 + b q3, q2 x w = b q1, q3 x w = -a q1,
  q1 x w = a q3 - b q2: all that hold, of second degree (seen by the rank of all products at random points). The pairs
  are coupled by (R, 1, s) only, so that only n blocks of 18 rows need be positive; Clarabel finds them. s is in units
  of ``SHIFT_MM``: in mm it is ill-scaled.

The bound is b'y of the dual, and the least eigenvalue of its matrix (s eliminated) times the trace: no tolerance of the
solver enters it. Proved: it is within 1e-3 of the best registration that local searches on the same cost find.

The certificate's statement is another one: x and range have their own weights along the TRUS axes (here their variance
is added to that across the beam, as one), the array's tilts count, the window is a Gaussian of the stage's rotation. It
also says where other registrations may be, and does so again with the beam as it is without the pairs; its times are of
all that. The relaxation proves only that no registration is better.

gtsam 4.3 has no part in it. From Python its RiemannianStaircaseOptimizer takes a graph of factors that know their
quadratic form (rotations and poses to each other); a QpCost or CustomFactor ends with ``qcqpFactors is not
implemented``. QcqpProblem takes any cost, but only a local search (AugmentedLagrangianOptimizer) takes QcqpProblem: the
solvers of its relaxation need MOSEK and are not in the wheel.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import clarabel
import numpy as np
from scipy import sparse
from scipy.optimize import least_squares

from fgreg.certificate.certify import LEAST_GAP, RELATIVE_GAP
from fgreg.certificate.conditional import Conditional, conditional
from fgreg.cli.options import CERTIFICATE_BUDGET
from fgreg.geometry.transforms import FloatArray, exp_so3
from fgreg.model.sensitivity import arc_of_rotation
from study_certificate import Task, is_good, session, shown
from study_pool import add_pool_options, pool_of
from systematic_cells import NOISES

ROWS = [("first hit", 6), ("first hit", 15), ("first hit", 25), ("window", 10)]
FORMS = ("dense", "chordal")
SHIFT_MM = 30.0
ROTATION, ONE, SHIFT, FIRST, EACH = slice(0, 9), 9, slice(10, 13), 13, 5
"""Places of the variables: the rows of R, the constant 1, s; from FIRST on EACH of a pair: w, a, b."""


@dataclass(frozen=True)
class Problem:
    """The cost |jacobian x|^2 over x = (R, 1, s, of each pair w, a, b); ``at`` gives x of (turn, shift, arc angles)."""

    jacobian: FloatArray
    start: FloatArray
    rotation: FloatArray
    scan_rad: FloatArray

    def at(self, variables: FloatArray) -> FloatArray:
        rotation = exp_so3(variables[:3]) @ self.rotation
        angle = self.scan_rad + variables[6:]
        arc = np.stack([np.zeros_like(angle), np.sin(angle), np.cos(angle)], axis=1)
        of_pairs = np.concatenate([arc @ rotation, arc[:, 1:]], axis=1)
        return np.concatenate([rotation.ravel(), [1.0], variables[3:6], of_pairs.ravel()])


def problem_of(of: Conditional) -> Problem:
    """The statement above, from the one that the certificate has of a session."""
    look, count, rotation = of.first, of.polar.shape[1], of.rotation
    (x, rho, angle), pieces = of.polar, []
    q = np.stack([x, rho * np.sin(angle), rho * np.cos(angle)])
    points = (of.origin + np.einsum("ijn,jn->in", of.from_array, q)).T @ rotation - of.shift
    middle = points.mean(axis=0)  # the origin in the camera
    delta = arc_of_rotation(look.rotation_rad, look.heard_mm, of.radius_mm)
    slope = look.heard_mm * (look.heard_mm + of.radius_mm * np.cos(delta))
    slope /= of.radius_mm**2 + look.heard_mm**2 + 2.0 * of.radius_mm * look.heard_mm * np.cos(delta)
    centres = of.origin.T + np.einsum("ijn,jn->ni", of.from_array[:, :1], look.x_mm[None])
    for i in range(count):
        _, size, across = np.linalg.svd(of.rows[:, :, i])
        plane = np.linalg.inv(look.weight[:2, :2, i])
        sigma = np.sqrt(0.5 * (size[:2] ** -2.0).sum() + 0.5 * np.trace(plane))
        across = across[:2] / sigma
        on_beam = -np.linalg.pinv(of.rows[:, :, i]) @ of.offset[:, i] - middle
        first, second = np.zeros((2, FIRST + EACH * count)), np.zeros((3, FIRST + EACH * count))
        w = slice(FIRST + EACH * i, FIRST + EACH * i + 3)
        first[:, ROTATION] = np.kron(centres[i], across)
        first[:, ONE], first[:, SHIFT], first[:, w] = -across @ on_beam, -SHIFT_MM * across, look.heard_mm[i] * across
        angle, weight = of.scan_rad[i] + delta[i], slope[i] * np.sqrt(look.weight[2, 2, i])
        second[:, ROTATION] = -weight * np.kron([0.0, np.sin(angle), np.cos(angle)], np.eye(3))
        second[:, w] = weight * np.eye(3)
        pieces += [first, second]
    start = np.concatenate([np.zeros(3), (of.shift + middle) / SHIFT_MM, of.polar[2]])
    return Problem(np.concatenate(pieces), start, rotation, of.scan_rad)


def local_minimum(problem: Problem) -> float:
    """Cost of the minimum near the estimate."""

    def residuals(variables: FloatArray) -> FloatArray:
        return problem.jacobian @ problem.at(variables)

    return float(2.0 * least_squares(residuals, problem.start, x_scale="jac").cost)


Terms = list[tuple[int, int, float]]
Constraint = tuple[Terms, float]


def constraints(count: int, form: str) -> Iterator[Constraint]:
    """Terms (i, j, factor of x_i x_j) and the value of each constraint, with x as in :class:`Problem`."""
    for i in range(3):
        for j in range(i, 3):
            equal = 1.0 if i == j else 0.0
            yield [(3 * i + k, 3 * j + k, 1.0) for k in range(3)], equal
            if (i, j) != (2, 2):  # the traces of R R' and R' R are the same
                yield [(3 * k + i, 3 * k + j, 1.0) for k in range(3)], equal
        a, b, c = (3 * ((i + k) % 3) for k in range(3))
        yield from _cross(a, b, [(ONE, c, 1.0)])
    yield [(ONE, ONE, 1.0)], 1.0
    for w in range(FIRST, FIRST + EACH * count, EACH):
        yield [(w + k, w + k, 1.0) for k in range(3)], 1.0
        yield [(k, w + k, 1.0) for k in range(3)], 0.0
        if form == "chordal":
            a, b = w + 3, w + 4
            yield [(a, a, 1.0), (b, b, 1.0)], 1.0
            yield [*((3 + k, w + k, 1.0) for k in range(3)), (a, ONE, -1.0)], 0.0
            yield [*((6 + k, w + k, 1.0) for k in range(3)), (b, ONE, -1.0)], 0.0
            for k in range(3):
                yield [(a, 3 + k, 1.0), (b, 6 + k, 1.0), (ONE, w + k, -1.0)], 0.0
            yield from _cross(0, w, [(a, 6, 1.0), (b, 3, -1.0)])
            yield from _cross(3, w, [(b, 0, 1.0)])
            yield from _cross(6, w, [(a, 0, -1.0)])


def _cross(first: int, second: int, equal: Terms) -> Iterator[Constraint]:
    """The cross product of the vectors that begin at two places is a sum of scalars (place, vector's place, factor)."""
    for k in range(3):
        u, v = (k + 1) % 3, (k + 2) % 3
        product = [(first + u, second + v, 1.0), (first + v, second + u, -1.0)]
        yield [*product, *((scalar, vector + k, -factor) for scalar, vector, factor in equal)], 0.0


def relaxed(problem: Problem, form: str) -> float:
    """The bound."""
    size = problem.jacobian.shape[1]
    count, every_place = (size - FIRST) // EACH, np.arange(size)
    keep = every_place[(form == "chordal") | (every_place < FIRST) | ((every_place - FIRST) % EACH < 3)]
    place = np.full(size, -1)
    place[keep] = np.arange(len(keep))
    every = [([(place[i], place[j], f) for i, j, f in terms], value) for terms, value in constraints(count, form)]
    slack = (problem.jacobian.T @ problem.jacobian)[np.ix_(keep, keep)]
    y = _multipliers(slack, every, chordal=form == "chordal")
    for multiplier, (terms, _) in zip(y, every, strict=True):
        for i, j, factor in terms:
            slack[i, j] -= 0.5 * multiplier * factor
            slack[j, i] -= 0.5 * multiplier * factor
    left = slack - slack[:, SHIFT] @ np.linalg.solve(slack[SHIFT, SHIFT], slack[SHIFT])
    left = np.delete(np.delete(left, SHIFT, 0), SHIFT, 1)
    trace = 4 + count * (2 if form == "chordal" else 1)
    bound: float = y @ [value for _, value in every] + trace * min(np.linalg.eigvalsh(left)[0], 0.0)
    return bound


def _multipliers(cost: FloatArray, every: Sequence[Constraint], *, chordal: bool) -> FloatArray:
    """Multipliers with the largest sum of values for which the cost less their constraints is positive semidefinite."""
    size, root = len(cost), np.sqrt(2.0)
    rows, columns, factors = [], [], []
    for number, (terms, _) in enumerate(every):
        for i, j, factor in terms:
            low, high = sorted((i, j))
            rows.append(high * (high + 1) // 2 + low)
            columns.append(number)
            factors.append(factor if low == high else factor / root)
    high_all, low_all = np.tril_indices(size)  # the upper triangle, column by column
    matrix = sparse.csc_matrix((factors, (rows, columns)), shape=(len(low_all), len(every)))
    scale = np.abs(cost).max()
    b = cost[low_all, high_all] * np.where(low_all == high_all, 1.0, root) / scale
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.chordal_decomposition_enable = chordal
    none, values = sparse.csc_matrix((len(every), len(every))), np.array([value for _, value in every])
    solver = clarabel.DefaultSolver(none, -values, matrix, b, [clarabel.PSDTriangleConeT(size)], settings)
    return np.asarray(scale * np.array(solver.solve().x))


def one(task: Task, forms: Sequence[str]) -> dict[str, tuple[float, float]] | None:
    """Relative gap and s of processor time, by each form and the certificate; None where the session is not good."""
    sweep, noise, pairs, seed = task
    found = session(sweep, NOISES[noise], pairs, seed)
    if not is_good(found):
        return None
    problem = problem_of(conditional(found.problem, found.optimum.state, found.optimum.evaluation.private))
    cost, out = local_minimum(problem), {}
    for form in forms:
        begin = time.process_time()
        bound = relaxed(problem, form)
        out[form] = ((cost - bound) / max(cost, LEAST_GAP), time.process_time() - begin)
    proved = shown(found, CERTIFICATE_BUDGET)
    out["certificate"] = (1.0 if proved.certificate is None else proved.certificate.gap, proved.time_s)
    return out


def show(task: Task, found: Sequence[dict[str, tuple[float, float]]]) -> None:
    sweep, noise, pairs, _ = task
    print(f"{sweep}, {pairs} pairs, noise {noise}:")
    for way in found[0] if found else ():
        gaps, times = np.array([result[way] for result in found]).T
        figures = (
            f"gap at most 1e-3 in {(gaps <= 1.0001 * RELATIVE_GAP).sum()} of {len(gaps)}, largest {gaps.max():.1e};"
        )
        print(f"  {way:12} {figures} {np.median(times):.2f} s (median), {times.max():.2f} s (longest)", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=10, help="of each row")
    parser.add_argument("--pairs", type=int, nargs="*", help="rows with these numbers of pairs only")
    parser.add_argument("--sweep", choices=("first hit", "window"), nargs="*", default=("first hit", "window"))
    parser.add_argument("--noise", choices=tuple(NOISES), nargs="*", default=tuple(NOISES))
    parser.add_argument("--form", choices=FORMS, nargs="*", default=FORMS)
    parser.add_argument("--seed", type=int, default=1, help="of the first session")
    add_pool_options(parser)
    args = parser.parse_args()
    work = partial(one, forms=args.form)
    with pool_of(args) as pool:
        for sweep, pairs in ROWS:
            if sweep in args.sweep and (not args.pairs or pairs in args.pairs):
                for noise in args.noise:
                    tasks = [(sweep, noise, pairs, args.seed + k) for k in range(args.sessions)]
                    show(tasks[0], [found for found in pool.map(work, tasks) if found is not None])


if __name__ == "__main__":
    main()
