"""Unreported camera moves before an epoch's seventh PM: the verdict on the mixed pairs, and when the move is found.

Simulated streams as in tools/study_moves.py: some PMs, an unreported move, up to 20 PMs more. The online engine takes
them pair by pair, with a full solve after each PM (``settle``). Moves:

  room    2 deg and 2.5 mm a side and axis about the tissue's middle, as a bump of the simulated room's camera
  small   2 mm or 1 deg about the camera, in a random direction
  none    no move: how often the verdict is wrong

Printed, by the number of PMs after the move: verdicts; how many are wrong; how often a move has been found; and how
often the registration is usable (not refused) and right. Wrong is a registration whose largest error at the targets is
beyond 1.5 times the predicted 95 % (three sigma), or beyond the limit where the prediction is within it.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from fgreg.geometry.target_error import tre_mm
from fgreg.geometry.transforms import FloatArray
from fgreg.model.estimate import Verdict
from fgreg.online.engine import OnlineRegistration
from fgreg.online.estimate import OnlineEstimate
from move_streams import CONFIG, bump_of, shift_of, two_epochs
from study_pool import add_pool_options, pool_of

AFTER = 20
LOOKED_AT = (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 15, 20)
"""Numbers of PMs after the move at which the verdict is read."""
SIGMAS = 1.5
"""An error beyond this multiple of the predicted 95 % (two sigma) is wrong."""


@dataclass(frozen=True, slots=True)
class Stood:
    """A session after one PM: verdict, largest error at the targets and its prediction (mm), found moves."""

    verdict: Verdict
    error_mm: float
    predicted_mm: float
    found: bool

    @property
    def wrong(self) -> bool:
        """Whether the predicted error is too small."""
        limit = CONFIG.limit_mm
        return self.error_mm > SIGMAS * self.predicted_mm or self.predicted_mm <= limit < self.error_mm


def motion_of(kind: str, seed: int) -> FloatArray:
    """camera_new_T_camera_old."""
    if kind == "room":
        return bump_of(seed, 2.5, np.radians(2.0))
    return shift_of(np.random.default_rng([seed, 5]), 2.0, 1.0) if kind == "small" else np.eye(4)


def course(task: tuple[int, int], *, kind: str, first_hit: bool, looks: int) -> dict[int, Stood]:
    """One session, by the number of PMs after the move; ``task``: seed, and PMs before it."""
    seed, before = task
    model, measurements, (_, moved) = two_epochs(
        seed, motion_of(kind, seed), before, AFTER, first_hit=first_hit, looks=looks
    )
    engine, out = OnlineRegistration(model, CONFIG, verdicts=False), {}
    for aim in measurements.aims:
        engine.add(aim)
    for n, pair in enumerate(measurements.pairs, 1):
        engine.add(pair)
        after = n // looks - before
        if n % looks == 0 and after in LOOKED_AT:
            out[after] = stood(engine.settle(), moved.trus_T_camera[0], model.targets_mm, found=bool(engine.moves))
    return out


def stood(estimate: OnlineEstimate, true_trus_T_camera: FloatArray, targets_mm: FloatArray, *, found: bool) -> Stood:
    if estimate.trus_T_camera is None or estimate.predicted_tre is None:
        return Stood(Verdict.REFUSED, 0.0, 0.0, found)
    error = float(tre_mm(estimate.trus_T_camera, true_trus_T_camera, targets_mm).max())
    return Stood(estimate.verdict, error, estimate.predicted_tre.worst_mm, found)


def report(name: str, courses: Iterable[dict[int, Stood]]) -> None:
    rows = list(courses)
    print(f"{name}: {len(rows)} sessions")
    print("  PMs after    ok  warning  refused   wrong+ok  wrong+warning   found  usable and right")
    for after in LOOKED_AT:
        at = [row[after] for row in rows]
        said = {verdict: [s for s in at if s.verdict is verdict] for verdict in Verdict}
        wrong = {verdict: sum(s.wrong for s in said[verdict]) for verdict in Verdict}
        right = sum(s.verdict is not Verdict.REFUSED and not s.wrong for s in at)
        print(
            f"  {after:9d} {len(said[Verdict.OK]):5d} {len(said[Verdict.WARNING]):8d} {len(said[Verdict.REFUSED]):8d} "
            f"{wrong[Verdict.OK]:10d} {wrong[Verdict.WARNING]:14d} {sum(s.found for s in at):7d} {right:17d}"
        )
    print(flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moves", default="room,small,none", help="which, with commas between")
    parser.add_argument("--before", default="1,2,3,4,5,6,7", help="PMs before the move")
    parser.add_argument("--looks", default="1,3", help="at each PM")
    parser.add_argument("--sweep", choices=["first-hit", "window", "both"], default="both")
    parser.add_argument("--seeds", type=int, default=20, help="sessions of each kind and number of PMs before")
    parser.add_argument("--each", action="store_true", help="a table for each number of PMs before")
    add_pool_options(parser)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    before = [int(word) for word in args.before.split(",")]
    sweeps = {"first-hit": (True,), "window": (False,), "both": (True, False)}[args.sweep]
    with pool_of(args) as pool:
        for kind, looks, first_hit in product(args.moves.split(","), map(int, args.looks.split(",")), sweeps):
            one = partial(course, kind=kind, first_hit=first_hit, looks=looks)
            name = f"{kind}, {looks} looks a PM, {'first-hit' if first_hit else 'window only'}"
            tasks = [(1000 * args.seed + s, b) for b in before for s in range(args.seeds)]
            found = list(pool.map(one, tasks))
            parts = before if args.each else []
            for b in parts:
                rows = [row for (_, of), row in zip(tasks, found, strict=True) if of == b]
                report(f"{name}, {b} PMs before", rows)
            report(name, found)


if __name__ == "__main__":
    main()
