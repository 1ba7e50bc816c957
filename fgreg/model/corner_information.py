"""What all pictures of a session say about the cameras' constants and the prints.

Each detection tells about the constants by its misfit (fgreg.model.camera_dependence). That is the same in every shot,
so it is summed over the session and enters the estimate once, with the constants' prior.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.rig import CAMERA
from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_dependence import plausible_share
from fgreg.model.measurements import CameraDependence, Measurements
from fgreg.model.systematic import CAREFUL_LAB

DEFAULT_SIGMAS = CAREFUL_LAB.sigmas(0.0, 0.0)[CAMERA]
"""(19,) of the camera's constants in a careful lab: sizes that matter."""
_WIDE = 10.0
"""Factor on them for deciding which detections fit: constants far beyond their priors are still constants."""
_ROUNDS = 10


@dataclass(frozen=True, slots=True, eq=False)
class CornerInformation:
    """What all detections of a session say about the constants of ``CAMERA`` (n = 19).

    Attributes:
        information: (n, n). pull: (n,).
        weight: of each detection; below 1 where no constants make its corners fit.
        misfit: of each detection, chi square over degrees of freedom that no constants explain.
    """

    information: FloatArray
    pull: FloatArray
    weight: FloatArray
    misfit: FloatArray


def observed_dependences(measurements: Measurements) -> Iterator[CameraDependence]:
    """What each picture of a tag or board says about the constants, once for each."""
    once: dict[int, CameraDependence] = {}
    markers = [aim.marker for aim in measurements.aims] + [pair.marker for pair in measurements.pairs]
    for marker in markers:
        if marker.dependence is not None:
            once[marker.id] = marker.dependence
    spots = [aim.dependence for aim in measurements.aims if aim.dependence is not None]
    yield from (found for found in (*once.values(), *spots) if found.information.any())


def corner_information(detections: Sequence[CameraDependence]) -> CornerInformation | None:
    """Sum over detections; None where nothing was detected in frames.

    A detection speaks with full weight where some constants, the same for all, make its corners fit: a wrong print
    spoils every detection alike, a glint only one.
    """
    if not detections:
        return None
    chi_square = np.array([d.chi_square for d in detections])
    degrees = np.array([d.degrees_of_freedom for d in detections])
    share = np.array([plausible_share(c, n) for c, n in zip(chi_square, degrees, strict=True)])
    information = np.stack([d.information for d in detections]) / share[:, None, None]
    pull = np.stack([d.pull for d in detections]) / share[:, None]
    weight, left = share, chi_square
    for _ in range(_ROUNDS):
        c, _ = posterior_of(np.tensordot(weight, information, 1), weight @ pull, _WIDE * DEFAULT_SIGMAS)
        left = np.maximum(chi_square + c @ information @ c - 2.0 * pull @ c, 0.0)
        previous, weight = weight, np.array([plausible_share(r, n) for r, n in zip(left, degrees, strict=True)])
        if np.abs(weight - previous).max() < 1e-3:
            break
    misfit = left / np.maximum(degrees, 1)
    return CornerInformation(np.tensordot(weight, information, 1), weight @ pull, weight, misfit)


def posterior_of(information: FloatArray, pull: FloatArray, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(mean (n,), covariance (n, n)) of constants with independent priors of these standard deviations (n,) or 0."""
    root = np.outer(sigmas, sigmas)
    inner = np.linalg.inv(np.eye(len(sigmas)) + root * information)
    covariance = root * (0.5 * (inner + inner.T))
    return covariance @ pull, covariance
