"""Streams of events for the online registration, and the distance of an estimate from the batch solver's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from fgreg.geometry.transforms import FloatArray, inverse
from fgreg.model.measurements import EpochStart, Measurements
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.online.engine import OnlineRegistration
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.events import CameraMoved, OnlineEvent
from fgreg.registration.posterior import pose_tangent
from fgreg.registration.register import Registration, register
from tests.forward import Truth, make_measurements, random_marker_T_laser, random_trus_T_camera


def events(measurements: Measurements) -> Iterator[OnlineEvent]:
    """Aims, pairs, known points and moves in the order in which they happened."""
    yield from measurements.aims
    epoch = 0
    for pair in measurements.pairs:
        while epoch < pair.epoch:
            epoch += 1
            start: EpochStart = measurements.epochs[epoch]
            yield CameraMoved(start.t, start.camera_new_T_camera_old, start.covariance)
        yield pair
        yield from (point for point in measurements.points if (point.epoch, point.t) == (pair.epoch, pair.t))


def run(engine: OnlineRegistration, measurements: Measurements) -> list[OnlineEstimate]:
    """The estimates after each event."""
    return [engine.add(event) for event in events(measurements)]


def restored(engine: OnlineRegistration, measurements: Measurements) -> OnlineRegistration:
    """The engine with measurements taken in at once, registered at their end: a quick way to a long epoch."""
    with engine.restoring():
        run(engine, measurements)
    return engine


def first(measurements: Measurements, pairs: int) -> Measurements:
    """The measurements up to a number of pairs."""
    taken = measurements.pairs[:pairs]
    epochs = measurements.epochs[: taken[-1].epoch + 1] if taken else measurements.epochs[:1]
    points = tuple(point for point in measurements.points if taken and point.t <= taken[-1].t)
    return replace(measurements, pairs=taken, epochs=epochs, points=points)


def batch(measurements: Measurements, model: SessionModel) -> Registration:
    """The optimum that the online estimate is compared with."""
    return register(measurements, model, SolveConfig())


def sigmas_apart(found: Registration, estimate: OnlineEstimate) -> float:
    """Mahalanobis distance of the online optimum from the batch optimum, by the batch covariance."""
    place = found.epochs.index(estimate.epoch)
    if estimate.optimum_trus_T_camera is None:
        return float("inf")
    covariance = found.covariance[6 * place : 6 * place + 6, 6 * place : 6 * place + 6]
    tangent = pose_tangent(found.optimum.state.trus_T_camera(place)[0], estimate.optimum_trus_T_camera)
    return float(np.sqrt(tangent @ np.linalg.solve(covariance, tangent)))


def sigmas_between(found: OnlineEstimate, expected: OnlineEstimate) -> float:
    """Mahalanobis distance of two registrations as reported, by the covariance expected."""
    if found.trus_T_camera is None or expected.trus_T_camera is None or expected.covariance is None:
        return 0.0 if found.trus_T_camera is expected.trus_T_camera else float("inf")
    tangent = pose_tangent(expected.trus_T_camera, found.trus_T_camera)
    return float(np.sqrt(tangent @ np.linalg.solve(expected.covariance, tangent)))


def unreported_move(
    seed: int, motion: FloatArray, after: int, before: int
) -> tuple[SessionModel, Measurements, tuple[Truth, Truth]]:
    """Pairs before and after a motion, all recorded as of epoch 0."""
    rng = np.random.default_rng(seed)
    trus_T_camera, beam = random_trus_T_camera(rng), random_marker_T_laser(rng)
    again = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 1])  # so that both have one window edge
    model, first, truth = make_measurements(
        again[0], aims=12, pairs=before, marker_T_laser=beam, trus_T_camera=trus_T_camera
    )
    _, second, moved = make_measurements(
        again[1], aims=0, pairs=after, marker_T_laser=beam, trus_T_camera=trus_T_camera @ inverse(motion)
    )
    t = first.pairs[-1].t
    later = tuple(
        replace(p, t=p.t + t, pm=p.pm + before, marker=replace(p.marker, id=p.marker.id + 1000)) for p in second.pairs
    )
    return model, replace(first, pairs=first.pairs + later), (truth, moved)
