"""Camera moves apart from the test on pairs: static tags, loop closures, and reported moves.

  tags-clean  frames of three static tags without a move: false alarms (target: at most 1 in 2,000 pairs, 10 frames
              each)
  tags-shifts shifts about the camera, 60 steady frames before: share found within 10 frames, that is before the next
              pair (target: 99 %). Tags 0.1, 0.1, 0.8 mm and 0.01 rad; a fifth of that variance wanders with a time
              constant of 200 frames (and is drawn again after a shift), the rest is independent in every frame
  live        in the simulated room, in made-up time, from rendered stereo pictures to the recorded move: bumps of 1, 2,
              3 and 5 mm and 1 deg, with `--tags` static tags: share found, seconds until the stage holds and until the
              move is recorded, error of the measured move; hours with a steady camera: false alarms; a tag that moves
              with the tissue; tags that are covered now and then (`--width`, `--tags`, `--count`, `--minutes`)
  returns     15 pairs, then the scope taken away and put back (reported, without a motion), or to a place 2 mm or 1 deg
              off, 5 mm or 3 deg off, or anywhere: number of pairs until the engine uses the old registration again,
              and how often wrongly (target: at most 1 in 2,000 pairs)
  reported    15 (or --steady) pairs, a shift of up to 15 mm and 9 deg an axis, reported with a motion known to 2 mm and
              1 deg (each axis; or in all) or with none: RMS target error after n pairs, beside that of the steady epoch
              (target with motion: at most 1.2 of it after 3 pairs), of a fresh registration with the same aims, and of
              one with a known beam, 150 aims (target: no worse at every count, paired on the same pairs). In brackets
              the error of an ideal estimator: the information of all measurements at the truth, windows as Gaussians

Each mode prints what it has after every tenth of the work.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from typing import Any

import numpy as np

from fgreg.camera_moves.static_tags import TagFrame, TagMoveDetector, TagSettings, detect_tag_move
from fgreg.camera_moves.view_shift import view_shift_mm
from fgreg.detection.marker_roi import EVERYWHERE, MarkerRoi
from fgreg.drivers.base import StereoFrame
from fgreg.errors import EstimationError
from fgreg.geometry.target_error import tre_mm
from fgreg.geometry.transforms import FloatArray, exp_so3, inverse, make_transform
from fgreg.live.marker_tracker import WholeFrame
from fgreg.live.scope_holder import HolderMove
from fgreg.live.static_tags import StaticTags
from fgreg.live.view_worker import view_roi
from fgreg.model.measurements import EpochStart, Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.time_sync import Stamp
from fgreg.online.engine import OnlineRegistration
from fgreg.online.events import events_in_order
from fgreg.registration.posterior import pose_tangent
from fgreg.registration.register import register
from fgreg.session.setup_reader import read_setup
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import Room, room_config
from move_streams import CONFIG, ideal_covariance, ideal_tre, many_aims, shift_of, two_epochs
from tests.forward import Truth

AFTER = 30
FRAMES_PER_PAIR = 10
TAG_SIGMA = np.array([0.01, 0.01, 0.01, 0.1, 0.1, 0.8])
STEADY_SHARE, TIME_CONSTANT = 0.2, 200.0
KINEMATICS = np.array([math.radians(1.0)] * 3 + [2.0] * 3)
Row = tuple[str, float, float]
SHIFTS: tuple[Row, ...] = (("5 mm or 3 deg", 5.0, 3.0), ("2 mm or 1 deg", 2.0, 1.0))


# --- static tags ----------------------------------------------------------------------------------------------------


class TagScene:
    """Three tags some 100 mm before the camera, with correlated and independent errors."""

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
        """Draw the correlated errors again."""
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
    scene, watch = TagScene(np.random.default_rng([seed, 0])), TagMoveDetector()
    alarms, before, highest = 0, False, []
    for n in range(1, count + 1):
        if n % 1000 == 0:  # another scene: an epoch ends some time, and frames are compared with its start
            scene, watch, before = TagScene(np.random.default_rng([seed, n])), TagMoveDetector(), False
        watch, check = detect_tag_move(watch, scene.frame(), settings)
        alarms += check.alarm and not before
        before = check.alarm
        highest.append(check.motion.chi2 if check.motion is not None else 0.0)
        if n % max(count // 10, 1) == 0:
            top = ", ".join(f"{v:.1f}" for v in sorted(highest)[-4:])
            per = alarms / (n / FRAMES_PER_PAIR) * 2000.0
            print(f"tags, no move: {alarms} false alarms in {n} frames, {per:.2f} per 2,000 pairs (target <= 1); "
                  f"highest chi squares {top}, limit {settings.threshold:.1f}", flush=True)  # fmt: skip


def tags_shifts(count: int, seed: int) -> None:
    settings = TagSettings()
    for name, mm, degrees in SHIFTS:
        found: list[int] = []
        for s in range(count):
            rng = np.random.default_rng([seed, s])
            scene, watch = TagScene(rng), TagMoveDetector()
            for _ in range(60):
                watch, _ = detect_tag_move(watch, scene.frame(), settings)
            scene.move(shift_of(rng, mm, degrees))
            at = FRAMES_PER_PAIR + 1
            for n in range(1, FRAMES_PER_PAIR + 1):
                watch, check = detect_tag_move(watch, scene.frame(), settings)
                if check.alarm:
                    at = n
                    break
            found.append(at)
            if (s + 1) % max(count // 10, 1) == 0:
                share = np.mean(np.array(found) <= FRAMES_PER_PAIR)
                print(f"tags, {name}: {100 * share:.1f} % of {len(found)} found before the next pair (target >= 99 %), "
                      f"median after {np.median(found):.0f} frames", flush=True)  # fmt: skip


# --- static tags in the room ----------------------------------------------------------------------------------------

FRAMES_PER_S = 30.0
LATENCY_S = 0.1
"""Of the worker process, in made-up time."""
BUMPS: tuple[Row, ...] = (
    ("1 mm", 1.0, 0.0),
    ("2 mm", 2.0, 0.0),
    ("3 mm", 3.0, 0.0),
    ("5 mm", 5.0, 0.0),
    ("1 deg", 0.0, 1.0),
)
STEADY_S, AFTER_S = (12.0, 60.0), 20.0
"""Span of times from the start to the bump, and the time after it."""


class TaggedRoom(Room):
    """A room in which tag 3 may move with the breath, tags may be covered, and the camera gets a given bump.

    Attributes:
        breath_mm: amplitude, along the view. covered: share of the time in which each tag is covered by an instrument.
        jump: (4, 4) of the next bump, in the camera frame.
    """

    breath_mm = 0.0
    covered = 0.0
    jump: FloatArray = np.eye(4)

    def trus_T_tags(self, t_s: float) -> dict[int, FloatArray]:
        tags = super().trus_T_tags(t_s)
        if 3 in tags:
            tags[3] = tags[3].copy()
            tags[3][2, 3] += self.breath_mm * max(0.0, math.sin(2.0 * math.pi * t_s / 4.0)) ** 2
        hidden = np.random.default_rng((self.config.seed, int(t_s / 5.0), 11)).random(4) < self.covered
        return {number: pose for number, pose in tags.items() if not hidden[number]}

    def _bumped(self, trus_T_camera: FloatArray) -> FloatArray:
        return np.asarray(trus_T_camera @ inverse(self.jump))


class AtOnce:
    """In place of the worker process: jobs are done in this one, and take :data:`LATENCY_S` of made-up time."""

    busy = False

    def run(self, work: Callable[..., Any], *arguments: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(work(*arguments))
        return done


class TaggedRun:
    """The static tags of one room, looked for as by the live loop in whole frames, ten frames apart."""

    def __init__(self, seed: int, width_px: int, tags: int) -> None:
        config = room_config(seed, width_px, aims=0, bump_every_s=math.inf, static_tags=tags)
        model = read_setup(session_document(config.scene), "session.yaml", "room", []).model
        assert model is not None
        assert model.camera is not None
        assert model.marker is not None
        self.room, self.model = TaggedRoom(config), model
        self.left = MarkerRoi(model.camera.left, 0, np.eye(4), model.marker)
        self.right = view_roi(model.camera, model.marker, 1)
        self.tags = StaticTags(model, AtOnce())  # type: ignore[arg-type]
        self.now_s, self.index, self.news = 0.0, 0, list[str]()

    def frame(self) -> HolderMove | None:
        """One more whole frame; the move that has ended."""
        self.now_s += EVERYWHERE / FRAMES_PER_S
        self.index += 1
        room, now = self.room, self.now_s
        room.pass_to(now)
        if self.index % 12 == 0:
            room.proceed(now)  # the marker goes on, and may cover a tag
        left, right = room.pictures(now, self.index)
        views = self.left.detect(left, whole=True), self.right.detect(right, whole=True)
        whole = WholeFrame(now, StereoFrame(Stamp(now, now), left, right, self.index), *views)
        move = self.tags.step(whole, now, with_board=False)
        move = self.tags.step(None, now + LATENCY_S, with_board=False) or move
        self.news += self.tags.news()
        return move

    def until(self, t_s: float) -> tuple[float | None, float | None, HolderMove | None]:
        """Frames until a time: when the stage was held, when a move was recorded, and the move."""
        held = None
        while self.now_s < t_s:
            move = self.frame()
            if self.tags.moving_since_s is not None and held is None:
                held = self.now_s
            if move is not None:
                return held, self.now_s, move
        return held, None, None


def bumps_in_the_room(count: int, seed: int, width_px: int, tags: int, covered: float) -> None:
    for name, mm, degrees in BUMPS:
        held: list[float] = []
        ended: list[float] = []
        off: list[float] = []
        nees: list[float] = []
        early = blind = 0
        for s in range(count):
            rng = np.random.default_rng([seed, s, 5])
            run = TaggedRun(1000 * seed + s, width_px, tags)
            run.room.covered = covered
            early += run.until(float(rng.uniform(*STEADY_S)))[1] is not None
            at = run.now_s
            along, about = (axis / np.linalg.norm(axis) for axis in rng.normal(size=(2, 3)))
            run.room.jump = make_transform(exp_so3(math.radians(degrees) * about), mm * along)
            run.room.bump(at)
            first, last, move = run.until(at + AFTER_S)
            blind += not run.tags.frames
            if first is not None:
                held.append(first - at)
            if last is not None and move is not None and move.camera_new_T_camera_old is not None:
                ended.append(last - at)
                error = pose_tangent(run.room.jump, move.camera_new_T_camera_old)
                assert move.covariance is not None
                off.append(view_shift_mm(inverse(run.room.jump) @ move.camera_new_T_camera_old))
                nees.append(float(error @ np.linalg.solve(move.covariance, error)))
            if s + 1 == count:
                off_mm, chi2 = _spread(off), np.mean(nees) if nees else math.nan
                print(
                    f"live, {width_px} px, {tags} tags, each covered {covered:.0%} of the time, bump of {name}: held "
                    f"{len(held)} of {s + 1} ({blind} without a tag in view), after {_spread(held)} s; recorded "
                    f"{len(ended)}, after {_spread(ended)} s; the move off by {off_mm} mm, chi square {chi2:.1f} "
                    f"(expected 6 or less); alarms before it {early}",
                    flush=True,
                )


def _spread(values: list[float]) -> str:
    return f"{np.median(values):.2f} (most {max(values):.2f})" if values else "-"


def steady_room(minutes: float, seed: int, width_px: int, tags: int, breath_mm: float, covered: float) -> None:
    """A camera that stands: alarms, moves recorded, and what the operator is told."""
    alarms = moves = 0
    hours = 0.0
    for part in range(max(1, round(minutes / 20.0))):
        run = TaggedRun(5000 * seed + part, width_px, tags)
        run.room.breath_mm, run.room.covered = breath_mm, covered
        end, moving = 60.0 * min(minutes, 20.0), False
        while run.now_s < end:
            moves += run.frame() is not None
            alarms += run.tags.moving_since_s is not None and not moving
            moving = run.tags.moving_since_s is not None
        hours += end / 3600.0
        what = f"tag 3 breathes {breath_mm:g} mm" if breath_mm else "steady"
        print(
            f"live, {width_px} px, {tags} tags, {what}, covered {covered:.0%}: {alarms} alarms, {moves} moves recorded "
            f"in {hours:.2f} h of made-up time; {run.tags.frames} frames with tags; told: {run.news}",
            flush=True,
        )


# --- pairs ----------------------------------------------------------------------------------------------------------


def returns(count: int, seed: int, steady: int, *, first_hit: bool) -> None:
    kind = "first-hit" if first_hit else "window only"
    for name, mm, degrees in (("back", 0.0, 0.0), *SHIFTS[::-1], ("anywhere", 40.0, 20.0)):
        after: list[float] = []
        for s in range(count):
            motion = shift_of(np.random.default_rng([seed, s, 7]), mm, degrees)
            after.append(_used_again_after(seed * 100000 + s, motion, steady, first_hit=first_hit))
            if (s + 1) % max(count // 10, 1) == 0:
                found = np.array(after)
                by = ", ".join(f"{100 * np.mean(found <= k):.1f} % by {k}" for k in (8, 12, 15, 20, 30))
                wrong = "" if name == "back" else (
                    f"; {2000 * np.mean(found <= AFTER) / AFTER:.2f} in 2,000 pairs (target <= 1)"
                )  # fmt: skip
                print(f"returns ({kind}), {name}: old epoch used again {by}{wrong} ({len(after)} sessions)", flush=True)


def _used_again_after(seed: int, motion: FloatArray, steady: int, *, first_hit: bool) -> float:
    """Pairs of the new epoch after which the engine closes the loop to the old one; infinite: it does not."""
    model, measurements, _ = two_epochs(seed, motion, steady, AFTER, first_hit=first_hit, reported=True)
    engine, pairs = OnlineRegistration(model, CONFIG, verdicts=False), 0
    for index, event in events_in_order(measurements):
        estimate = engine.add(event)
        pairs += index is not None
        if engine.loop_closures or estimate.epoch > 1:
            return pairs - steady if engine.loop_closures else math.inf
    return math.inf


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def reported(count: int, seed: int, steady_pairs: int, counts: tuple[int, ...], *, first_hit: bool) -> None:
    steady: list[tuple[float, float]] = []
    error: dict[tuple[str, int], list[float]] = {}
    ideal: dict[tuple[str, int], list[float]] = {}
    for s in range(count):
        rng = np.random.default_rng([seed, s, 3])
        motion = make_transform(exp_so3(rng.uniform(-0.15, 0.15, 3)), rng.uniform(-15.0, 15.0, 3))
        number = seed * 100000 + s
        model, whole, truths = two_epochs(number, motion, steady_pairs, AFTER, first_hit=first_hit, reported=True)
        unit = rng.normal(size=6)
        starts = {}
        for name, sigma in (("an axis", KINEMATICS), ("in all", KINEMATICS / math.sqrt(3.0))):
            noise = unit * sigma
            measured = motion @ make_transform(exp_so3(noise[:3]), noise[3:])
            starts[f"reported, 2 mm and 1 deg {name}"] = EpochStart(whole.epochs[1].t, measured, np.diag(sigma**2))
        old = replace(whole, pairs=whole.pairs[:steady_pairs], epochs=whole.epochs[:1])
        first = _error(old, 0, truths[0], model)
        steady.append((first, _least(old, 0, truths[:1], model)))
        many = many_aims(number, truths[0])
        for n in counts:
            cut = replace(whole, pairs=whole.pairs[: steady_pairs + n])
            own = tuple(replace(p, epoch=0) for p in cut.pairs[steady_pairs:])
            alone = replace(cut, pairs=own, epochs=whole.epochs[:1])
            cases = {
                **{name: (replace(cut, epochs=(whole.epochs[0], e)), 1, truths) for name, e in starts.items()},
                "reported, motion not known": (cut, 1, truths),
                "fresh, same aims": (alone, 0, truths[1:]),
                "fresh, known beam": (replace(alone, aims=many), 0, truths[1:]),
            }
            for name, (of, epoch, true) in cases.items():
                error.setdefault((name, n), []).append(_error(of, epoch, truths[1], model))
                ideal.setdefault((name, n), []).append(_least(of, epoch, true, model))
        if (s + 1) % max(count // 10, 1) == 0:
            _print_reported(steady, error, ideal, counts, first_hit)


def _error(of: Measurements, epoch: int, truth: Truth, model: SessionModel) -> float:
    """RMS target error (mm) of one epoch's optimum; nan where there is none."""
    try:
        found = register(of, model, CONFIG)
    except EstimationError:
        return math.nan
    if epoch not in found.epochs:
        return math.nan
    transform = found.optimum.state.trus_T_camera(found.epochs.index(epoch))[0]
    return _rms(tre_mm(transform, truth.trus_T_camera[0], model.targets_mm).tolist())


def _least(of: Measurements, epoch: int, truths: tuple[Truth, ...], model: SessionModel) -> float:
    try:
        covariance, state = ideal_covariance(model, of, truths)
    except np.linalg.LinAlgError:
        return math.nan
    return ideal_tre(covariance, state, epoch, model.targets_mm)


def _print_reported(
    steady: list[tuple[float, float]],
    error: dict[tuple[str, int], list[float]],
    ideal: dict[tuple[str, int], list[float]],
    counts: tuple[int, ...],
    first_hit: bool,
) -> None:
    kind = "first-hit" if first_hit else "window only"
    base, least = _rms([e for e, _ in steady]), _rms([e for _, e in steady])
    print(
        f"reported moves ({kind}), {len(steady)} sessions: RMS target error of the steady epoch {base:.2f} "
        f"({least:.2f}) mm"
    )
    for name in sorted({name for name, _ in error}):
        row = []
        for n in counts:
            ours, best = np.array(error[name, n]), np.array(ideal[name, n])
            there = np.isfinite(ours)
            value, limit = _rms(ours[there].tolist()), _rms(best[np.isfinite(best)].tolist())
            row.append(
                f"{n}: {value:.2f} (x{value / base:.2f}, median {np.median(ours[there]):.2f}; "
                f"ideal {limit:.2f}, x{limit / least:.2f})"
            )
        print(f"  {name}, after pairs {', '.join(row)}", flush=True)
    for other in ("fresh, same aims", "fresh, known beam"):
        row = [f"{n}: {_paired(error['reported, motion not known', n], error[other, n])}" for n in counts]
        print(f"  reported, motion not known, over {other}, the same pairs: {', '.join(row)}", flush=True)


def _paired(ours: list[float], others: list[float]) -> str:
    """Median ratio of errors on the same pairs, and ratio of RMS, each with 95 % by resampling of sessions."""
    both = np.array([ours, others])
    both = both[:, np.isfinite(both).all(axis=0)]
    index = np.random.default_rng(0).integers(both.shape[1], size=(1000, both.shape[1]))
    median = np.exp(np.median(np.log(both[0] / both[1])[index], axis=1))
    rms = np.sqrt(np.mean(both[0][index] ** 2, axis=1) / np.mean(both[1][index] ** 2, axis=1))
    low, high = np.quantile(median, (0.025, 0.975))
    least, most = np.quantile(rms, (0.025, 0.975))
    return (
        f"median {math.exp(float(np.median(np.log(both[0] / both[1])))):.2f} ({low:.2f} to {high:.2f}), "
        f"RMS {_rms(both[0].tolist()) / _rms(both[1].tolist()):.2f} ({least:.2f} to {most:.2f})"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mode", choices=["tags-clean", "tags-shifts", "live", "returns", "reported"])
    parser.add_argument("--count", type=int, help="frames (tags-clean), or shifts or sessions a row")
    parser.add_argument("--window-only", action="store_true", help="looks know only the window")
    parser.add_argument("--steady", type=int, default=15, help="returns, reported: pairs of the first epoch")
    parser.add_argument(
        "--after", type=int, nargs="+", default=[3, 4, 6, 10, 15], help="reported: numbers of pairs after it"
    )
    parser.add_argument("--width", type=int, default=640, help="live: of the pictures, px")
    parser.add_argument("--tags", type=int, default=3, help="live: number of static tags, 1 to 3")
    parser.add_argument("--minutes", type=float, default=60.0, help="live: of made-up time with a steady camera")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    first_hit = not args.window_only
    if args.mode == "tags-clean":
        tags_clean(args.count or 40000, args.seed)
    elif args.mode == "tags-shifts":
        tags_shifts(args.count or 500, args.seed)
    elif args.mode == "live":
        for covered in (0.0, 0.3):
            bumps_in_the_room(args.count or 20, args.seed, args.width, args.tags, covered)
        if args.minutes > 0.0:
            steady_room(args.minutes, args.seed, args.width, args.tags, 0.0, 0.0)
            steady_room(args.minutes / 3.0, args.seed, args.width, args.tags, 0.0, 0.3)
            for breath_mm in (1.0, 4.0):
                steady_room(args.minutes / 6.0, args.seed, args.width, args.tags, breath_mm, 0.0)
    elif args.mode == "returns":
        returns(args.count or 200, args.seed, args.steady, first_hit=first_hit)
    else:
        reported(args.count or 100, args.seed, args.steady, tuple(args.after), first_hit=first_hit)


if __name__ == "__main__":
    main()
