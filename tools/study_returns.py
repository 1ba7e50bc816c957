"""Camera moves beside the test on pairs: static tags, the scope put back, and moves that are told.

  tags-clean  frames of three static tags while nothing moves: false alarms (target: at most 1 in 2,000 pairs, 10 frames
              each)
  tags-shifts shifts about the camera, 60 steady frames before: share found within 10 frames, that is before the next
              pair (target: 99 %). Tags 0.1, 0.1, 0.8 mm and 0.01 rad; a fifth of that variance wanders with a time
              constant of 200 frames (and is drawn anew by a shift), the rest is new in every frame
  returns     15 pairs, camera gone and back (or to a place 2 mm or 1 deg off, 5 mm or 3 deg off, or anywhere): after
              how many pairs the old registration is used again, and how often wrongly
  told        15 pairs, a shift of up to 15 mm and 9 deg an axis, told with a motion (2 mm, 1 deg) or with none:
              RMS target error after n pairs, beside that of the steady epoch (target with motion: at most 1.2 of it
              after 3 pairs) and of a fresh registration with a known beam, 150 aims (target: no worse at every count)

Each mode prints what it has after every tenth of the work.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from fgreg.online.follow import EpochFollower, select_pms, summarise_aims

from fgreg.config import SolveConfig
from fgreg.errors import EstimationError
from fgreg.frames import FloatArray, exp_so3, inverse, make_transform
from fgreg.measurements import Aim, EpochStart, Measurements
from fgreg.models import SessionModel
from fgreg.online.moves import relinearisation
from fgreg.online.returns import default_return_settings, fits_again
from fgreg.online.tags import TagFrame, TagSettings, TagWatch, watch_tags
from fgreg.online.white import linearise, pose_columns
from fgreg.registration import pack_session, register
from fgreg.targets import tre_mm

sys.path.insert(0, os.fspath(Path(__file__).resolve().parent.parent))
from tests.forward import Truth, make_measurements, random_marker_T_laser, random_trus_T_camera

CONFIG = SolveConfig()
STEADY, AFTER = 15, 15
FRAMES_PER_PAIR = 10
TAG_SIGMA = np.array([0.01, 0.01, 0.01, 0.1, 0.1, 0.8])
STEADY_SHARE, TIME_CONSTANT = 0.2, 200.0
KINEMATICS = np.array([math.radians(1.0)] * 3 + [2.0] * 3)
Row = tuple[str, float, float]
SHIFTS: tuple[Row, ...] = (("5 mm or 3 deg", 5.0, 3.0), ("2 mm or 1 deg", 2.0, 1.0))


def random_direction(rng: np.random.Generator) -> FloatArray:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def shift_of(rng: np.random.Generator, mm: float, degrees: float) -> FloatArray:
    """camera_new_T_camera_old: by so many mm or turned by so many degrees, each half the time."""
    if rng.uniform() < 0.5:
        return make_transform(np.eye(3), mm * random_direction(rng))
    return make_transform(exp_so3(math.radians(degrees) * random_direction(rng)), np.zeros(3))


# --- static tags ----------------------------------------------------------------------------------------------------


class TagScene:
    """Three tags some 100 mm before the camera, and their errors: some stay for a while, some are new each frame."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.tags = {
            tag: make_transform(
                exp_so3(rng.uniform(-0.4, 0.4, 3)), np.array([*rng.uniform(-35.0, 35.0, 2), rng.uniform(90.0, 130.0)])
            )
            for tag in range(3)
        }
        self.settle()

    def settle(self) -> None:
        """What stays of the errors is drawn anew."""
        self.wander = {tag: self.rng.normal(size=6) for tag in self.tags}

    def move(self, motion: FloatArray) -> None:
        self.tags = {tag: motion @ pose for tag, pose in self.tags.items()}
        self.settle()

    def frame(self) -> TagFrame:
        keep = math.exp(-1.0 / TIME_CONSTANT)
        seen = {}
        for tag, pose in self.tags.items():
            self.wander[tag] = keep * self.wander[tag] + math.sqrt(1.0 - keep**2) * self.rng.normal(size=6)
            unit = math.sqrt(STEADY_SHARE) * self.wander[tag] + math.sqrt(1.0 - STEADY_SHARE) * self.rng.normal(size=6)
            # Translation noise is along the camera's axes: depth is the worst.
            turn = exp_so3(unit[:3] * TAG_SIGMA[:3])
            seen[tag] = make_transform(turn @ pose[:3, :3], pose[:3, 3] + unit[3:] * TAG_SIGMA[3:])
        return TagFrame(seen, {tag: _right_covariance(pose) for tag, pose in seen.items()})


def _right_covariance(pose: FloatArray) -> FloatArray:
    turn = np.kron(np.eye(2), pose[:3, :3].T)
    return np.asarray(turn @ np.diag(TAG_SIGMA**2) @ turn.T)


def tags_clean(count: int, seed: int) -> None:
    settings = TagSettings()
    scene, watch = TagScene(np.random.default_rng([seed, 0])), TagWatch()
    alarms, before, highest = 0, False, []
    for n in range(1, count + 1):
        if n % 1000 == 0:  # another scene: an epoch does not last for ever, and its start is what is compared with
            scene, watch, before = TagScene(np.random.default_rng([seed, n])), TagWatch(), False
        watch, check = watch_tags(watch, scene.frame(), settings)
        alarms += check.alarm and not before
        before = check.alarm
        highest.append(check.motion.chi2 if check.motion is not None else 0.0)
        if n % max(count // 10, 1) == 0:
            top = ", ".join(f"{v:.1f}" for v in sorted(highest)[-4:])
            per = alarms / (n / FRAMES_PER_PAIR) * 2000.0
            print(f"tags, nothing moves: {alarms} false alarms in {n} frames, {per:.2f} per 2,000 pairs (target <= 1); "
                  f"highest chi squares {top}, limit {settings.threshold:.1f}", flush=True)  # fmt: skip


def tags_shifts(count: int, seed: int) -> None:
    settings = TagSettings()
    for name, mm, degrees in SHIFTS:
        found: list[int] = []
        for s in range(count):
            rng = np.random.default_rng([seed, s])
            scene, watch = TagScene(rng), TagWatch()
            for _ in range(60):
                watch, _ = watch_tags(watch, scene.frame(), settings)
            scene.move(shift_of(rng, mm, degrees))
            at = FRAMES_PER_PAIR + 1
            for n in range(1, FRAMES_PER_PAIR + 1):
                watch, check = watch_tags(watch, scene.frame(), settings)
                if check.alarm:
                    at = n
                    break
            found.append(at)
            if (s + 1) % max(count // 10, 1) == 0:
                share = np.mean(np.array(found) <= FRAMES_PER_PAIR)
                print(f"tags, {name}: {100 * share:.1f} % of {len(found)} found before the next pair (target >= 99 %), "
                      f"median after {np.median(found):.0f} frames", flush=True)  # fmt: skip


# --- pairs ----------------------------------------------------------------------------------------------------------


def gone(
    seed: int, motion: FloatArray, before: int, after: int, *, first_hit: bool
) -> tuple[SessionModel, Measurements, tuple[Truth, Truth]]:
    """Pairs before and after a motion, as epochs 0 and 1; same beam, same window edge."""
    rng = np.random.default_rng(seed)
    trus_T_camera, beam = random_trus_T_camera(rng), random_marker_T_laser(rng)
    model, first, truth = make_measurements(
        np.random.default_rng([seed, 1]), aims=12, pairs=before, first_hit=first_hit, marker_T_laser=beam,
        trus_T_camera=trus_T_camera,
    )  # fmt: skip
    # The same seed draws the same window edge; without aims all that follows is drawn anew.
    _, second, moved = make_measurements(
        np.random.default_rng([seed, 1]), aims=0, pairs=after, first_hit=first_hit, marker_T_laser=beam,
        trus_T_camera=trus_T_camera @ inverse(motion),
    )  # fmt: skip
    t = first.pairs[-1].t + 1.0
    later = tuple(
        replace(p, t=p.t + t, pm=p.pm + before, epoch=1, marker=replace(p.marker, id=p.marker.id + 100000))
        for p in second.pairs
    )
    return model, Measurements(first.aims, first.pairs + later, (EpochStart(0.0), EpochStart(t))), (truth, moved)


def returns(count: int, seed: int, *, first_hit: bool) -> None:
    kind = "first-hit" if first_hit else "window only"
    rows = (("back", 0.0, 0.0), *SHIFTS[::-1], ("anywhere", 40.0, 20.0))
    for name, mm, degrees in rows:
        found: list[FloatArray] = []
        for s in range(count):
            motion = shift_of(np.random.default_rng([seed, s, 7]), mm, degrees)
            try:
                found.append(_log_bayes(seed * 100000 + s, motion, first_hit=first_hit))
            except EstimationError:
                continue
            if (s + 1) % max(count // 4, 1) == 0:
                _print_returns(f"returns ({kind}), {name}", np.array(found))


def _print_returns(name: str, log_bayes: FloatArray) -> None:
    """First decisions of each session (rows), pair by pair, by the settings' limit and by others about it."""
    settings = default_return_settings()
    for accept in (settings.accept - 1.0, settings.accept, settings.accept + 1.0):
        same = log_bayes >= accept
        same[:, : settings.least_pairs - 1] = False
        new = log_bayes <= -settings.reject
        at_same = np.where(same.any(axis=1), same.argmax(axis=1) + 1, AFTER + 1)
        at_new = np.where(new.any(axis=1), new.argmax(axis=1) + 1, AFTER + 1)
        by = ", ".join(f"{100 * np.mean((at_same <= k) & (at_same < at_new)):.1f} % by {k}" for k in (3, 6, 10, 15))
        elsewhere = 100 * np.mean((at_new <= AFTER) & (at_new < at_same))
        print(f"{name}, limit {accept:.1f}: old epoch used again {by}; elsewhere by 15: {elsewhere:.1f} % "
              f"({len(log_bayes)} sessions)", flush=True)  # fmt: skip


def _log_bayes(seed: int, motion: FloatArray, *, first_hit: bool) -> FloatArray:
    """(15,) log Bayes factors of the old registration after 1, 2, ... pairs."""
    model, measurements, _ = gone(seed, motion, STEADY, AFTER, first_hit=first_hit)
    together = replace(
        measurements, pairs=tuple(replace(p, epoch=0) for p in measurements.pairs), epochs=measurements.epochs[:1]
    )
    state = register(replace(together, pairs=together.pairs[:STEADY]), model, CONFIG).optimum.state
    problem = summarise_aims(pack_session(together, model, CONFIG), state)
    follower = EpochFollower(problem, state, STEADY)
    earlier = follower.everything()
    out = []
    for n in range(1, AFTER + 1):
        tail = select_pms(problem, np.arange(STEADY, STEADY + n))
        test = fits_again(
            earlier,
            linearise(tail, follower.state),
            default_return_settings(),
            pose=pose_columns(0),
            relinearise=relinearisation(tail, follower.state),
        )
        out.append(test.log_bayes)
    return np.array(out)


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def told(count: int, seed: int, counts: tuple[int, ...], *, first_hit: bool) -> None:
    steady: list[float] = []
    error: dict[tuple[str, int], list[float]] = {}
    for s in range(count):
        rng = np.random.default_rng([seed, s, 3])
        motion = make_transform(exp_so3(rng.uniform(-0.15, 0.15, 3)), rng.uniform(-15.0, 15.0, 3))
        model, whole, (truth, moved) = gone(seed * 100000 + s, motion, STEADY, AFTER, first_hit=first_hit)
        unit = rng.normal(size=6)
        starts = {}
        for name, sigma in (("an axis", KINEMATICS), ("in all", KINEMATICS / math.sqrt(3.0))):
            noise = unit * sigma
            measured = motion @ make_transform(exp_so3(noise[:3]), noise[3:])
            starts[f"told, 2 mm and 1 deg {name}"] = EpochStart(whole.epochs[1].t, measured, np.diag(sigma**2))

        def tre(of: Measurements, epoch: int, true: Truth, session: SessionModel = model) -> float | None:
            try:
                found = register(of, session, CONFIG)
            except EstimationError:
                return None
            if epoch not in found.epochs:
                return None
            transform = found.optimum.state.trus_T_camera(found.epochs.index(epoch))[0]
            return float(tre_mm(transform, true.trus_T_camera[0], session.targets_mm).mean())

        first = tre(replace(whole, pairs=whole.pairs[:STEADY], epochs=whole.epochs[:1]), 0, truth)
        if first is None:
            continue
        steady.append(first)
        many = many_aims(seed * 100000 + s, truth)
        for n in counts:
            cut = replace(whole, pairs=whole.pairs[: STEADY + n])
            alone = replace(cut, pairs=tuple(replace(p, epoch=0) for p in cut.pairs[STEADY:]), epochs=whole.epochs[:1])
            results = {
                **{name: tre(replace(cut, epochs=(whole.epochs[0], e)), 1, moved) for name, e in starts.items()},
                "told, motion not known": tre(cut, 1, moved),
                "fresh, same aims": tre(alone, 0, moved),
                "fresh, known beam": tre(replace(alone, aims=many), 0, moved),
            }
            for name, value in results.items():
                if value is not None:
                    error.setdefault((name, n), []).append(value)
        if (s + 1) % max(count // 10, 1) == 0:
            _print_told(steady, error, counts, first_hit)


def many_aims(seed: int, truth: Truth) -> tuple[Aim, ...]:
    """So many calibration shots that the beam counts as known."""
    rng = np.random.default_rng([seed, 9])
    return make_measurements(rng, aims=150, pairs=0, marker_T_laser=truth.marker_T_laser)[1].aims


def _print_told(
    steady: list[float], error: dict[tuple[str, int], list[float]], counts: tuple[int, ...], first_hit: bool
) -> None:
    kind = "first-hit" if first_hit else "window only"
    print(f"told moves ({kind}), {len(steady)} sessions: RMS target error of the steady epoch {_rms(steady):.2f} mm")
    for name in sorted({name for name, _ in error}):
        row = ", ".join(
            f"{n}: {_rms(error[name, n]):.2f} (x{_rms(error[name, n]) / _rms(steady):.2f}, "
            f"median {np.median(error[name, n]):.2f})"
            for n in counts
            if (name, n) in error
        )
        print(f"  {name}, after pairs {row}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=["tags-clean", "tags-shifts", "returns", "told"])
    parser.add_argument("--count", type=int, help="frames (tags-clean), or shifts or sessions a row")
    parser.add_argument("--window-only", action="store_true", help="looks know only the window")
    parser.add_argument(
        "--after", type=int, nargs="+", default=[3, 4, 6, 10, 15], help="told: numbers of pairs after it"
    )
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    first_hit = not args.window_only
    if args.mode == "tags-clean":
        tags_clean(args.count or 40000, args.seed)
    elif args.mode == "tags-shifts":
        tags_shifts(args.count or 500, args.seed)
    elif args.mode == "returns":
        returns(args.count or 200, args.seed, first_hit=first_hit)
    else:
        told(args.count or 100, args.seed, tuple(args.after), first_hit=first_hit)


if __name__ == "__main__":
    main()
