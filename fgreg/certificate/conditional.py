"""The cost of one camera epoch's pairs as a function of its registration alone.

The reduced graph's chi square of the pairs, with everything else as estimated: the beam, the rig's constants, which
shots are inliers, and each beam's covariance (which grows with the distance along it; here it is that where the PM is
estimated). The markers' errors enter to first order about their estimates, as covariance. Then a beam's
whitened residual is linear in its PM, camera axes (``rows camera_p + offset``), whatever the registration: the weights
across a beam do not depend on it. Those of a look act along the TRUS axes and do turn with it, so a PM stays a
variable. It is written in polar coordinates of its first look, in which x and range are exactly linear:

    z = (x, rho, delta)      q = (x, rho sin delta, rho cos delta)       p = from_array q + origin

A camera point is R' (p - t); with s = R' (t - pivot) it is R' (p - pivot) - s, and s is free like t.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray, IntArray
from fgreg.graph.packing import BeamArrays, PackedProblem
from fgreg.graph.reduced_blocks import Chart, PrivateState, Whitening, expected_rotation, inner, line_block
from fgreg.graph.shared_state import SharedState


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """Looks (n): x, range and rotation measured, weights (3, 3, n) over them, and the array's frame.

    Attributes:
        pm: (n,) place of each look's PM.
        x_mm, heard_mm, rotation_rad: (n,) what is measured, with the constants as estimated.
        weight: (3, 3, n). x and range are coupled, the rotation is not.
        from_first: (3, 3, n), origin: (3, n): q = from_first q' + origin, q' in the frame of the PM's first look.
    """

    pm: IntArray
    x_mm: FloatArray
    heard_mm: FloatArray
    rotation_rad: FloatArray
    weight: FloatArray
    from_first: FloatArray
    origin: FloatArray

    def take(self, index: IntArray) -> Looks:
        return Looks(*(getattr(self, name)[..., index] for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class Conditional:
    """The cost of J PMs.

    Attributes:
        rows: (m, 3, J), offset: (m, J) whitened residual across the beams. constant: chi square that does not change.
        first: the first look of each PM, in the order of PMs. others: all other looks.
        from_array: (3, 3, J), origin: (3, J) TRUS point of a point in the array's frame at the first look, less pivot.
        pivot: (3,) TRUS point near the PMs. radius_mm: of the probe.
        scan_rad: (J,) by how much the array is turned at the first look. skew: (J,) how far ``from_array`` is from that
            turn alone, there and back. stretch: (J,) its largest factor. plane_sigma_mm: (J,) largest standard
            deviation of the first look's x and range.
        rotation, shift: of the estimate, (3, 3) and s (3,). polar: (3, J) the PMs there.
    """

    rows: FloatArray
    offset: FloatArray
    constant: float
    first: Looks
    others: Looks
    from_array: FloatArray
    origin: FloatArray
    pivot: FloatArray
    radius_mm: float
    scan_rad: FloatArray
    skew: FloatArray
    stretch: FloatArray
    plane_sigma_mm: FloatArray
    rotation: FloatArray
    shift: FloatArray
    polar: FloatArray


def conditional(
    problem: PackedProblem,
    state: SharedState,
    private: PrivateState,
    epoch: int = 0,
    distance_mm: float | None = None,
) -> Conditional:
    """The cost of one epoch at an optimum (one hypothesis).

    Args:
        problem: the inliers.
        state, private: their optimum.
        epoch: place of the epoch.
        distance_mm: take the beams' covariances at this distance along them, not where the PMs are, and the markers'
            errors about their observed poses: nothing of the lines depends on the estimate of PMs and markers then.
    """
    rotation, translation = state.rotation[0, epoch], state.translation_mm[0, epoch]
    mine = np.unique(problem.beam_pm[problem.beam_epoch == epoch])
    place = np.full(len(problem.pms), -1, dtype=np.int64)
    place[mine] = np.arange(len(mine))
    points = private.trus_p_pm[0][mine]
    pivot = points.mean(axis=0)
    rows, offset, constant = _lines(problem, state, private, epoch, place, distance_mm)
    looks, matrix, origin = _looks(problem, state, place)
    first = np.array([int(np.flatnonzero(looks.pm == j)[0]) for j in range(len(mine))], dtype=np.int64)
    rest = np.setdiff1d(np.arange(len(looks.pm)), first)
    back = np.asarray(np.linalg.inv(matrix[first]), dtype=np.float64)
    scan, tilt = turn_of(matrix[first])
    there, again = (np.linalg.norm(one - np.eye(3), ord=2, axis=(1, 2)) for one in (tilt, np.linalg.inv(tilt)))
    skew = np.asarray((1.0 + there) * (1.0 + again) - 1.0)
    start = -np.einsum("nij,nj->ni", back, origin[first])
    of_pm = first[looks.pm]
    from_first = matrix @ back[looks.pm]
    from_origin = origin - np.einsum("nij,nj->ni", from_first, origin[of_pm])
    looks = Looks(
        looks.pm, looks.x_mm, looks.heard_mm, looks.rotation_rad, looks.weight,
        from_first.transpose(1, 2, 0), from_origin.T,
    )  # fmt: skip
    q = np.einsum("nij,nj->in", matrix[first], points) + origin[first].T
    return Conditional(
        rows=rows,
        offset=offset,
        constant=constant,
        first=looks.take(first),
        others=looks.take(rest),
        from_array=back.transpose(1, 2, 0),
        origin=(start - pivot).T,
        pivot=pivot,
        radius_mm=problem.radius_mm + float(state.constants[0, Constant.RADIUS]),
        scan_rad=scan,
        skew=skew,
        stretch=np.linalg.norm(back, ord=2, axis=(1, 2)),
        plane_sigma_mm=np.asarray(np.linalg.eigvalsh(looks.weight[:2, :2, first].transpose(2, 0, 1))[:, 0] ** -0.5),
        rotation=rotation,
        shift=rotation.T @ (translation - pivot),
        polar=np.stack([q[0], np.hypot(q[1], q[2]), np.arctan2(q[1], q[2])]),
    )


def turn_of(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles (n,) about x and rests (n, 3, 3) such that matrices (n, 3, 3) turn by the angle first, and hardly more."""
    angle = np.arctan2(matrix[:, 2, 1] - matrix[:, 1, 2], matrix[:, 1, 1] + matrix[:, 2, 2])
    cosine, sine = np.cos(angle), np.sin(angle)
    back = np.zeros_like(matrix)
    back[:, 0, 0] = 1.0
    back[:, 1, 1], back[:, 1, 2], back[:, 2, 1], back[:, 2, 2] = cosine, sine, -sine, cosine
    return angle, matrix @ back


def _lines(
    problem: PackedProblem,
    state: SharedState,
    private: PrivateState,
    epoch: int,
    place: IntArray,
    distance_mm: float | None,
) -> tuple[FloatArray, FloatArray, float]:
    """Rows (m, 3, J), offsets (m, J) and constant of the beams; a PM with several has their stack, as few rows."""
    index = np.flatnonzero(problem.beam_epoch == epoch)
    beams = BeamArrays(*(getattr(problem.beams, name)[index] for name in BeamArrays.__slots__))
    pm = problem.beam_pm[index]
    error = inner(private.beam_error)[index]
    if distance_mm is None:
        camera_p = (private.trus_p_pm[0][pm] - state.translation_mm[0, epoch]) @ state.rotation[0, epoch]
    else:
        marker_p = state.beam_origin()[0] + distance_mm * state.beam_direction()[0]
        camera_p, error = beams.rotation @ marker_p + beams.translation_mm, np.zeros_like(error)
    block = line_block(beams, error, Chart.of(state), camera_p[..., None])
    white = Whitening.of(block.covariance).rows(block.rows)[..., 0]  # (n, 4, 2)
    matrix = white[:, 1:].swapaxes(1, 2)
    offset = white[:, 0] - np.einsum("nij,nj->ni", matrix, camera_p)
    count = int(place.max()) + 1
    at = place[pm]
    width = 2 if np.bincount(at).max() == 1 else 3
    rows, offsets, constant = np.zeros((width, 3, count)), np.zeros((width, count)), 0.0
    for j in range(count):
        stack = np.concatenate([matrix[at == j], offset[at == j][..., None]], axis=-1).reshape(-1, 4)
        if len(stack) > width:
            stack = np.asarray(np.linalg.qr(stack, mode="r"))
            constant += float(stack[3, 3] ** 2)
        rows[: len(stack), :, j], offsets[: len(stack), j] = stack[:width, :3], stack[:width, 3]
    return rows, offsets, constant


def _looks(problem: PackedProblem, state: SharedState, place: IntArray) -> tuple[Looks, FloatArray, FloatArray]:
    """The looks of the PMs with a place, and q = matrix (n, 3, 3) p + origin (n, 3) of each, in the array's frame."""
    index = np.flatnonzero(place[problem.look_pm] >= 0)
    looks, c = problem.looks, state.constants[0]
    scan = looks.scan_rad[index] - looks.sweep[index] * c[Constant.BACKLASH]
    sine, cosine = np.sin(scan), np.cos(scan)
    turn = np.zeros((len(index), 3, 3))
    turn[:, 0, 0] = 1.0
    turn[:, 1, 1], turn[:, 1, 2], turn[:, 2, 1], turn[:, 2, 2] = cosine, -sine, sine, cosine
    in_plane, radial, steer = c[Constant.TILT_IN_PLANE], c[Constant.TILT_RADIAL], c[Constant.TILT_ELEVATION]
    tilt = np.array([[1.0, radial, in_plane], [-radial, 1.0, -steer], [-in_plane, steer, 1.0]])
    axis = np.array([0.0, c[Constant.ARRAY_OFFSET], problem.radius_mm + c[Constant.RADIUS]])
    terms = Looks(
        pm=place[problem.look_pm[index]],
        x_mm=(1.0 + c[Constant.PITCH]) * looks.x_mm[index],
        heard_mm=(1.0 + c[Constant.SOUND_SPEED]) * looks.range_mm[index] + c[Constant.RANGE_OFFSET],
        rotation_rad=expected_rotation(problem, state)[0][index],
        weight=looks.weight[index].transpose(1, 2, 0),
        from_first=np.zeros((3, 3, len(index))),
        origin=np.zeros((3, len(index))),
    )
    return terms, tilt @ turn, np.broadcast_to(-tilt @ axis, (len(index), 3))
