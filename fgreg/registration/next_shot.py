"""Where the next shot helps most: candidate beams and spots, ranked by the decrease of the predicted target error.

Candidates are spots on the tissue surface that the measured PMs trace, each hit from directions about the mean beam and
detected by a sweep from either side: the middle of the two is free of the window's width and of the backlash. The
information of a candidate is known before it is taken: noise-free virtual looks at the estimate add their Hessian A to
the information H of the shared variables, so the covariance after them is (H + A)^-1.

While two registrations fit equally well a shot also separates them. A virtual shot that fits the better registration
raises the chi square of the other by D (at its own optimum). The probability of choosing the wrong one is then at most
sqrt(p q) exp(-D / 8) (Chernoff), p and q their posterior weights. Candidates are ranked by the expected squared error,
which includes both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from fgreg.errors import EstimationError
from fgreg.geometry.rig import Constant
from fgreg.geometry.target_error import expected_tre_mm, target_jacobians
from fgreg.geometry.transforms import (
    FloatArray,
    IntArray,
    as_float_array,
    inverse,
    make_transform,
    right_from_parent_covariance,
    rotation_to_direction,
    transform_points,
)
from fgreg.graph.contributions import contributions, pm_columns
from fgreg.graph.packing import PackedProblem, pack, pack_more
from fgreg.graph.reduced_blocks import initial_private
from fgreg.graph.reduced_graph import evaluate
from fgreg.graph.reduced_system import refine
from fgreg.graph.scaled_inverse import without_others
from fgreg.graph.shared_state import SharedState
from fgreg.model.lens import in_view
from fgreg.model.measurements import EpochStart, Look, MarkerObservation, Measurements, Pair
from fgreg.model.session_model import SessionModel
from fgreg.model.tissue_surface import REACH_MM, TissueSurface, fit_surface
from fgreg.registration.epochs import restrict_epochs
from fgreg.registration.multistart import Minimum
from fgreg.registration.register import Registration

TILT_RAD = math.radians(25.0)
TILT_STEPS = 5
"""Directions are tilted from the mean beam by up to this to either side, about two axes; number of steps."""
SPOT_STEP_MM = 4.0
MOST_SPOTS = 60
APART_MM = 8.0
APART_RAD = math.radians(12.0)
"""Of two advised shots that are closer than both of these only the better is listed."""
IMAGE_MARGIN = 0.04
"""Smallest distance of spots and markers from the image's edge, as a share of its width."""
RIVAL_CHI2 = 14.0
"""Other registrations whose cost is within this of the best are to be separated from it."""
FEW_PAIRS = 6
REFINEMENTS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """n shots that could be taken.

    Attributes:
        camera_p_spot_mm: (n, 3) spot to aim at. camera_d: (n, 3) unit direction of the beam.
        camera_T_marker: (n, 4, 4) expected marker pose. trus_p_mm: (n, 3) expected PM.
        tilt_rad: (n, 2) tilt from the mean beam towards the image's right and its lower edge.
        sweeps: the K sweeps of each shot: +1 or -1 (plane), 0 where not swept.
        scan_rad: (n, K) plane angles of the PM's first detection.
        shots: the noise-free virtual pairs, K for each candidate: looks at one PM with one marker observation.
    """

    camera_p_spot_mm: FloatArray
    camera_d: FloatArray
    camera_T_marker: FloatArray
    trus_p_mm: FloatArray
    tilt_rad: FloatArray
    sweeps: tuple[int, ...]
    scan_rad: FloatArray
    shots: tuple[tuple[Pair, ...], ...]


@dataclass(frozen=True, slots=True)
class AdvisedLook:
    """One look of an advised shot.

    Attributes:
        device_rad: stage angle of the PM's first detection. sweep: +1 or -1, direction of the device's sweep; 0: none.
    """

    device_rad: float
    sweep: int


@dataclass(frozen=True, slots=True, eq=False)
class AdvisedShot:
    """One advised shot.

    Attributes:
        candidate: its number among the candidates.
        camera_p_spot_mm: (3,) spot to aim at. camera_d: (3,) direction of the beam.
        tilt_right_rad, tilt_down_rad: tilt from the mean of the beams up to now, to the image's right and lower edge.
        trus_p_mm: (3,) expected PM.
        looks: at the PM, by stage angle: one from either side, or one only.
        expected_mm: predicted TRE after all of them (mean over targets of the root of the expected square).
        separation: chi square by which it would separate the rival registration; None without a rival.
    """

    candidate: int
    camera_p_spot_mm: FloatArray
    camera_d: FloatArray
    tilt_right_rad: float
    tilt_down_rad: float
    trus_p_mm: FloatArray
    looks: tuple[AdvisedLook, ...]
    expected_mm: float
    separation: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Advice:
    """Shots, best first.

    Attributes:
        epoch: of the camera. pairs: PMs taken in it.
        expected_mm: predicted TRE now (mean over targets of the root of the expected square).
        shots: distinct ones. candidates: all of them; ``order`` (n,) is their ranking.
        notes: sentences for the user.
    """

    epoch: int
    pairs: int
    expected_mm: float
    shots: tuple[AdvisedShot, ...]
    candidates: Candidates
    order: IntArray
    notes: tuple[str, ...]


def advise(
    registration: Registration,
    *,
    predicted_mm: Mapping[int, float] | None = None,
    epoch: int | None = None,
    count: int = 5,
    both_sides: bool = True,
) -> Advice:
    """Rank the candidates for the next shot.

    Args:
        registration: of the session up to now.
        predicted_mm: the predicted TRE of its epochs (mean over targets), from the whole posterior; None: of the
            Gaussian at the optimum, which says by which factor a shot lowers it.
        epoch: the session's camera epoch to advise on; None: the last one with a registration.
        count: number of shots to list.
        both_sides: detect each PM from both sides; else from the side that the session has used less (from none where
            it does not sweep).

    Raises:
        EstimationError: the epoch has no registration, or there is no candidate.
    """
    model = registration.model
    epoch = registration.epochs[-1] if epoch is None else epoch
    if epoch not in registration.epochs:
        raise EstimationError(f"camera epoch {epoch} has no registration to advise on")
    place = registration.epochs.index(epoch)
    mine = [pair for pair in registration.measurements.pairs if pair.epoch == place]
    if not mine:
        raise EstimationError(f"camera epoch {epoch} has no pairs of its own to advise on")
    found = propose(registration, place, (1, -1) if both_sides else (_sweep_side(registration, place),))
    state = registration.optimum.state
    transform = state.trus_T_camera(place)[0]
    block = slice(6 * place, 6 * place + 6)
    problem = pack_more([pair for shot in found.shots for pair in shot], model, registration.problem.columns)
    _, _, added, columns = _contributions(problem, state, found.trus_p_mm)
    # The candidates' registration comes first of the columns; those of other epochs are eliminated.
    information = without_others(registration.optimum.evaluation.hessian[0], columns) + added
    after = np.asarray(np.linalg.inv(information)[:, :6, :6], dtype=np.float64)
    expected = expected_tre_mm(after, transform, model.targets_mm).mean(axis=-1)
    jacobian = target_jacobians(transform, model.targets_mm)
    square = np.einsum("nij,sjk,nik->s", jacobian, after, jacobian) / len(model.targets_mm)
    separation = _separate(registration, epoch, found)
    risk = square
    if separation is not None:
        wrong = np.sqrt(separation.weight * (1.0 - separation.weight)) * np.exp(-separation.chi2 / 8.0)
        risk = square + wrong * separation.distance2_mm2
    order = np.argsort(risk, kind="stable")
    gaussian = float(expected_tre_mm(registration.covariance[block, block], transform, model.targets_mm).mean())
    before = gaussian if predicted_mm is None else predicted_mm[epoch]
    shots = tuple(
        AdvisedShot(
            candidate=int(i),
            camera_p_spot_mm=found.camera_p_spot_mm[i],
            camera_d=found.camera_d[i],
            tilt_right_rad=float(found.tilt_rad[i, 0]),
            tilt_down_rad=float(found.tilt_rad[i, 1]),
            trus_p_mm=found.trus_p_mm[i],
            looks=_looks(found, int(i), model),
            expected_mm=float(expected[i]) * before / gaussian,
            separation=None if separation is None else float(separation.chi2[i]),
        )
        for i in _distinct(found, order, count)
    )
    pms = len({pair.pm for pair in mine})
    return Advice(epoch, pms, before, shots, found, np.asarray(order), _notes(pms, separation, found))


def _looks(found: Candidates, i: int, model: SessionModel) -> tuple[AdvisedLook, ...]:
    looks = [
        AdvisedLook(model.stage.device_from_scan(float(scan)), model.stage.direction * sweep)
        for scan, sweep in zip(found.scan_rad[i], found.sweeps, strict=True)
    ]
    return tuple(sorted(looks, key=lambda look: look.device_rad))


def _notes(pms: int, separation: _Separation | None, found: Candidates) -> tuple[str, ...]:
    notes = []
    if separation is not None and separation.weight > 0.01:
        notes.append(
            f"another registration explains the {pms} pairs nearly as well ({separation.gap:.1f} chi square apart, "
            f"{math.sqrt(separation.distance2_mm2):.0f} mm at the targets): shots that separate them come first"
        )
    elif pms < FEW_PAIRS:
        notes.append(
            f"{pms} pairs are few: the registration may be a wrong one, and with it the figures here; take "
            f"{FEW_PAIRS - pms} more before trusting it"
        )
    if len(found.sweeps) > 1:
        notes.append(
            "take two looks at each spot, with the fibre held still (one pm): sweep the stage up to the first "
            "detection, then down to the first one from the other side"
        )
    elif found.sweeps[0]:
        notes.append("sweep the stage from the side given: sweeps from both sides make the window's edge known")
    return tuple(notes)


def _distinct(found: Candidates, order: IntArray, count: int) -> list[int]:
    """The best candidates, none close to a better one in both spot and direction."""
    chosen: list[int] = []
    for index in order:
        i = int(index)
        near = [
            np.linalg.norm(found.camera_p_spot_mm[i] - found.camera_p_spot_mm[j]) < APART_MM
            and float(found.camera_d[i] @ found.camera_d[j]) > math.cos(APART_RAD)
            for j in chosen
        ]
        if not any(near):
            chosen.append(i)
        if len(chosen) == count:
            break
    return chosen


# ---- candidates ----


def propose(registration: Registration, place: int, sweeps: tuple[int, ...]) -> Candidates:
    """All candidates in one of the solved epochs (``place`` is its index among them), with these sweeps each.

    Raises:
        EstimationError: none is within the reach of probe, stage and camera.
    """
    model, problem = registration.model, registration.problem
    state, at = registration.optimum.state, registration.optimum.evaluation
    transform = state.trus_T_camera(place)[0]
    beams = np.flatnonzero(problem.beam_epoch == place)
    looks = np.flatnonzero(problem.beam_epoch[problem.look_beam] == place)
    camera_d = problem.beams.rotation[beams] @ state.beam_direction()[0]
    trus_p = at.private.trus_p_pm[0, np.unique(problem.beam_pm[beams])]
    spots = _spots(registration, place, trus_p, camera_d @ transform[:3, :3].T)
    directions, tilts = _directions(camera_d)
    trus_p_spot = np.repeat(spots, len(directions), axis=0)
    d = np.tile(directions, (len(spots), 1))
    camera_p = transform_points(inverse(transform), trus_p_spot)
    # Each marker is held as in the measured shot of the nearest beam, with the smallest rotation to the new direction.
    nearest = beams[np.argmax(d @ camera_d.T, axis=1)]
    turned = np.stack(
        [
            rotation_to_direction(new) @ rotation_to_direction(old).T @ problem.beams.rotation[beam]
            for new, old, beam in zip(d, camera_d[np.searchsorted(beams, nearest)], nearest, strict=True)
        ]
    )
    lambda_mm = float(np.median(at.lambda_mm[0, beams]))
    on_beam = state.beam_origin()[0] + lambda_mm * state.beam_direction()[0]
    bias = state.constants[0, Constant.MARKER_BIAS_X : Constant.MARKER_BIAS_Z + 1]
    camera_T_marker = make_transform(turned, camera_p - turned @ on_beam + bias)
    scan = np.array([[_first_detection(p, sweep, model) for sweep in sweeps] for p in trus_p_spot])
    low, high = sorted(model.stage.scan_from_device(limit) for limit in model.stage.limits_device_rad)
    aperture = model.probe.element_x_mm
    keep = ((scan >= low) & (scan <= high)).all(axis=1)
    keep &= (trus_p_spot[:, 0] > aperture.min()) & (trus_p_spot[:, 0] < aperture.max())
    if model.camera is not None:
        margin_px = IMAGE_MARGIN * model.camera.left.image_size[0]
        keep &= in_view(model.camera.left, camera_p, margin_px)
        keep &= in_view(model.camera.left, camera_T_marker[:, :3, 3], margin_px)
    index = np.flatnonzero(keep)
    if index.size == 0:
        within = ", from both sides," if len(sweeps) > 1 else ""
        raise EstimationError(f"no spot within the reach of probe, stage and camera{within} is left to advise on")
    marker_covariance = problem.beams.covariance[beams].mean(axis=0)
    look_covariance = np.linalg.inv(problem.looks.weight[looks][:, :2, :2]).mean(axis=0)
    seen = {pair.pm: pair.marker.dependence for pair in registration.measurements.pairs if pair.epoch == place}
    scan_sigma = float(np.mean([p.look.scan_sigma_rad for p in registration.measurements.pairs if p.epoch == place]))
    shots = []
    for number, i in enumerate(index):
        marker = MarkerObservation(
            camera_T_marker=as_float_array(camera_T_marker[i], 4, 4),
            covariance=as_float_array(right_from_parent_covariance(turned[i], marker_covariance), 6, 6),
            id=number,
            dependence=seen[problem.pms[problem.beam_pm[nearest[i]]]],
        )
        both = (
            _exact_look(trus_p_spot[i], float(at), sweep, scan_sigma, look_covariance, model)
            for at, sweep in zip(scan[i], sweeps, strict=True)
        )
        shots.append(tuple(Pair(0.0, number, place, marker, look, model.noise_per_pm.beam_offset_mm) for look in both))
    return Candidates(
        camera_p_spot_mm=camera_p[index],
        camera_d=d[index],
        camera_T_marker=camera_T_marker[index],
        trus_p_mm=trus_p_spot[index],
        tilt_rad=np.tile(tilts, (len(spots), 1))[index],
        sweeps=sweeps,
        scan_rad=scan[index],
        shots=tuple(shots),
    )


def _spots(registration: Registration, place: int, trus_p_pm: FloatArray, trus_d: FloatArray) -> FloatArray:
    """(m, 3) TRUS points of the tissue surface, on a grid up to ``REACH_MM`` from the PMs."""
    problem, at = registration.problem, registration.optimum.evaluation
    pms = np.unique(problem.beam_pm[problem.beam_epoch == place])
    surface = fit_surface(trus_p_pm, at.point_covariance[0, pms], trus_d[: len(pms)])
    points = _grid_on(surface) if surface is not None else _grid_about(trus_p_pm)
    if len(points) > MOST_SPOTS:
        points = points[np.linspace(0, len(points) - 1, MOST_SPOTS).round().astype(int)]
    return points


def _grid(place: FloatArray, step_mm: float = SPOT_STEP_MM) -> FloatArray:
    """(m, 2) grid points within ``REACH_MM`` of places (n, 2)."""
    low, high = place.min(axis=0) - REACH_MM, place.max(axis=0) + REACH_MM
    axes = [np.arange(a, b + step_mm, step_mm) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    near = np.linalg.norm(grid[:, None] - place, axis=-1).min(axis=1)
    return np.asarray(grid[near < REACH_MM])


def _grid_on(surface: TissueSurface) -> FloatArray:
    grid = _grid(surface.place)
    height, _ = surface.height(grid)
    return np.asarray(surface.centre + np.column_stack([grid, height]) @ surface.axes.T)


def _grid_about(trus_p: FloatArray) -> FloatArray:
    """Points where the PMs trace no surface yet: depths by inverse square distance, along x and about the axis."""
    reach = np.hypot(trus_p[:, 1], trus_p[:, 2])
    angle = np.arctan2(trus_p[:, 1], trus_p[:, 2])
    middle = float(reach.mean())
    place = np.column_stack([trus_p[:, 0], middle * angle])
    grid = _grid(place)
    weight = 1.0 / (np.sum((grid[:, None] - place) ** 2, axis=-1) + 1.0)
    rho = (weight @ reach) / weight.sum(axis=1)
    around = grid[:, 1] / middle
    return np.column_stack([grid[:, 0], rho * np.sin(around), rho * np.cos(around)])


def _directions(camera_d: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions (k, 3) about the mean of (n, 3), and their tilt (k, 2) towards the image's right and lower edge."""
    mean = camera_d.mean(axis=0)
    mean = mean / np.linalg.norm(mean)
    turn = rotation_to_direction(mean)
    steps = np.linspace(-TILT_RAD, TILT_RAD, TILT_STEPS)
    tilts = np.array([(a, b) for a in steps for b in steps if math.hypot(a, b) < 1.2 * TILT_RAD])
    local = np.column_stack([np.tan(tilts), np.ones(len(tilts))])
    return local / np.linalg.norm(local, axis=1, keepdims=True) @ turn.T, tilts


def _sweep_side(registration: Registration, place: int) -> int:
    """The less used sweep direction of the plane; 0 where the session does not sweep."""
    sides = [pair.look.sweep for pair in registration.measurements.pairs if pair.epoch == place and pair.look.sweep]
    return 0 if not sides else 1 if sides.count(1) <= sides.count(-1) else -1


def _first_detection(trus_p: FloatArray, sweep: int, model: SessionModel) -> float:
    """Expected plane angle of the look: the middle of the interval that a first hit, or the window, allows."""
    bearing, radius = math.atan2(float(trus_p[1]), float(trus_p[2])), model.probe.radius_mm
    scan = bearing
    for _ in range(4):  # the window depends on the range, the range (a little) on the angle
        range_mm = math.hypot(trus_p[1] - radius * math.sin(scan), trus_p[2] - radius * math.cos(scan))
        width = float(model.probe.sensitivity.half_width_at(range_mm))
        ahead = width - 0.5 * min(model.stage.step_rad, 2.0 * width)
        scan = bearing - sweep * ahead
    return scan


def _exact_look(
    trus_p: FloatArray, scan_rad: float, sweep: int, scan_sigma_rad: float, covariance: FloatArray, model: SessionModel
) -> Look:
    radius = model.probe.radius_mm
    dy, dz = trus_p[1] - radius * math.sin(scan_rad), trus_p[2] - radius * math.cos(scan_rad)
    return Look(
        scan_rad=scan_rad,
        scan_sigma_rad=scan_sigma_rad,
        x_mm=float(trus_p[0]),
        range_mm=math.hypot(float(dy), float(dz)),
        covariance=as_float_array(covariance, 2, 2),
        sweep=sweep,
        window_sigma_rad=model.noise_per_pm.window_rad,
    )


# ---- information of the candidates ----


@dataclass(frozen=True, slots=True, eq=False)
class _Separation:
    """Separation of the best registration from its likeliest rival.

    Posterior ``weight`` of the rival now, cost ``gap``, mean square distance at the targets, chi square per candidate.
    """

    weight: float
    gap: float
    distance2_mm2: float
    chi2: FloatArray


def _contributions(
    problem: PackedProblem, state: SharedState, trus_p: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Cost (n,), gradient (n, K) and Hessian (n, K, K) of virtual pairs of one epoch at a state, and K columns.

    PMs are started at (n, 3).
    """
    private = replace(initial_private(problem, state), trus_p_pm=trus_p[None])
    for _ in range(REFINEMENTS):
        private = refine(problem, state, private)
    parts = contributions(problem, state, private).pm
    columns = pm_columns(problem, np.arange(len(trus_p)))
    return parts.cost[0], parts.gradient[0][:, columns], parts.hessian(columns=columns)[0], columns


def _separate(registration: Registration, epoch: int, found: Candidates) -> _Separation | None:
    """Compare with the likeliest other minimum of the epoch's own search; None where no other has a similar cost."""
    search, model = registration.searches[epoch], registration.model
    place = registration.epochs.index(epoch)
    here = registration.optimum.state.trus_T_camera(place)[0]

    def apart(minimum: Minimum) -> float:
        camera_p = transform_points(inverse(here), model.targets_mm)
        there = transform_points(minimum.state.trus_T_camera()[0], camera_p)
        return float(np.mean(np.sum((there - model.targets_mm) ** 2, axis=1)))

    rivals = [m for m in search.minima if apart(m) > 1.0 and m.cost - search.minima[0].cost < RIVAL_CHI2]
    if not rivals:
        return None
    rival = rivals[0]
    problem = pack(restrict_epochs(registration.measurements, [place]), model)
    hessians = []
    for state in (_alone(registration, place), rival.state):
        private = initial_private(problem, state)
        for _ in range(REFINEMENTS):
            private = refine(problem, state, private)
        at = evaluate(problem, state, private)
        hessians.append((float(at.cost[0]), at.hessian[0]))
    (cost, hessian), (rival_cost, rival_hessian) = hessians
    # Laplace: weight ~ exp(-cost / 2) / sqrt(det H).
    log_ratio = -0.5 * (rival_cost - cost) - 0.5 * (np.linalg.slogdet(rival_hessian)[1] - np.linalg.slogdet(hessian)[1])
    weight = float(1.0 / (1.0 + np.exp(-np.clip(log_ratio, -30.0, 30.0))))
    virtual = pack(
        Measurements((), tuple(replace(p, epoch=0) for s in found.shots for p in s), (EpochStart(0.0),)), model
    )
    # The looks are those that the best registration predicts, so the rival's PMs start there, too.
    c, g, a, _ = _contributions(virtual, rival.state, found.trus_p_mm)
    chi2 = c - np.sum(g * np.linalg.solve(rival_hessian + a, g[..., None])[..., 0], axis=-1)
    return _Separation(weight, rival_cost - cost, apart(rival), np.maximum(chi2, 0.0))


def _alone(registration: Registration, place: int) -> SharedState:
    """The joint optimum with one of its epochs only."""
    state = registration.optimum.state
    return replace(
        state,
        rotation=state.rotation[:, place : place + 1],
        translation_mm=state.translation_mm[:, place : place + 1],
    )
