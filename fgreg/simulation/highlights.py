"""Specular light on wet things: a film of liquid mirrors the scope's light where its surface faces it.

The film is a microfacet surface (Cook and Torrance 1982) with Beckmann's distribution of slopes, on bumps that are
resolved. Of light from direction l it sends towards v, relative to white paper in the same light,

    pi F D / (4 (n.l)(n.v)),   D = exp(-tan2 / alpha2) / (pi alpha2 cos4),   cos = n.h,   h = (l + v) / |l + v|

with F = 0.025 for n = 1.37. The light is at the scope's tip, so bright spots are where the normal faces the camera.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.simulation.textures import Float32Array

FRESNEL = 0.025
ROUGHNESS = 0.08
"""alpha, slope of the facets that are not resolved."""
WAVES = 10
WAVE_MM = 5.0, 40.0
"""Number and lengths of the bumps' waves."""
POOL_WAVES = 4
POOL_MM = 15.0, 60.0
"""The same of the pools of liquid."""


@dataclass(frozen=True, slots=True, eq=False)
class Wetness:
    """How wet a scene is.

    Attributes:
        share: of the mirrored light where there is liquid.
        camera_p_light_mm: (3,) the light.
        seed: of the bumps.
    """

    share: float
    camera_p_light_mm: FloatArray
    seed: int


def highlights(
    camera_T_surface: FloatArray, x: Float32Array, y: Float32Array, slope: float, wet: Wetness
) -> Float32Array:
    """Mirrored light (h, w), in units of the light from white paper, where rays (x, y, 1) meet a plane.

    Args:
        slope: standard deviation of the bumps' slope along either axis.
    """
    rotation, t = camera_T_surface[:3, :3], camera_T_surface[:3, 3]
    offset = float(rotation[:, 2] @ t)
    side = np.float32(-1.0 if offset >= 0.0 else 1.0)  # of the plane, on which the camera is
    a = (rotation.T @ np.eye(3)).astype(np.float32)
    ray = [a[i, 0] * x + a[i, 1] * y + a[i, 2] for i in range(3)]  # in the surface's frame
    away = side * ray[2] < np.float32(-1e-6)
    along = np.where(away, np.float32(offset) / np.where(away, ray[2], np.float32(1.0)), np.float32(0.0))
    eye = (rotation.T @ -t).astype(np.float32)
    u, v = eye[0] + along * ray[0], eye[1] + along * ray[1]
    slopes = _slopes(u, v, slope, wet.seed)
    normal = _unit([-side * slopes[0], -side * slopes[1], np.full_like(u, 1.0)])
    light = (rotation.T @ (wet.camera_p_light_mm - t)).astype(np.float32)
    to_eye = _unit([eye[0] - u, eye[1] - v, np.full_like(u, abs(eye[2]))])
    to_light = _unit([light[0] - u, light[1] - v, np.full_like(u, abs(light[2]))])
    half = _unit([p + q for p, q in zip(to_eye, to_light, strict=True)])
    cos2 = np.clip(_dot(normal, half), 0.05, 1.0) ** 2
    facets = np.exp((1.0 - 1.0 / cos2) / np.float32(ROUGHNESS**2)) / (np.pi * ROUGHNESS**2 * cos2**2)
    faces = 4.0 * np.clip(_dot(normal, to_eye), 0.1, 1.0) * np.clip(_dot(normal, to_light), 0.1, 1.0)
    mirrored = np.pi * FRESNEL * facets / faces * _pools(u, v, wet.seed)
    return np.asarray(np.where(away, wet.share * mirrored, 0.0), dtype=np.float32)


def _slopes(u: Float32Array, v: Float32Array, slope: float, seed: int) -> tuple[Float32Array, Float32Array]:
    """Slopes along the plane's axes."""
    rng = np.random.default_rng((seed, 17))
    along_u, along_v = np.zeros_like(u), np.zeros_like(v)
    for wave, c, s in _waves(u, v, rng, WAVE_MM, WAVES):
        along_u += np.float32(2.0 * slope / np.sqrt(WAVES) * c) * wave
        along_v += np.float32(2.0 * slope / np.sqrt(WAVES) * s) * wave
    return along_u, along_v


def _pools(u: Float32Array, v: Float32Array, seed: int) -> Float32Array:
    """Where there is liquid, 0 to 1: on a third of the surface."""
    value = np.zeros_like(u)
    for wave, _, _ in _waves(u, v, np.random.default_rng((seed, 18)), POOL_MM, POOL_WAVES):
        value += np.float32(np.sqrt(2.0 / POOL_WAVES)) * wave
    return np.asarray(np.clip(2.0 * (value - 0.2), 0.0, 1.0))


def _waves(
    u: Float32Array, v: Float32Array, rng: np.random.Generator, length_mm: tuple[float, float], number: int
) -> Iterator[tuple[Float32Array, float, float]]:
    """Cosines in random directions (also given), their lengths even in the logarithm."""
    for _ in range(number):
        turn, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        wave = 2.0 * np.pi / np.exp(rng.uniform(*np.log(length_mm)))
        c, s = float(np.cos(turn)), float(np.sin(turn))
        yield np.cos(np.float32(wave * c) * u + np.float32(wave * s) * v + np.float32(phase)), c, s


def _dot(a: list[Float32Array], b: list[Float32Array]) -> Float32Array:
    return np.asarray(sum(p * q for p, q in zip(a, b, strict=True)))


def _unit(vector: list[Float32Array]) -> list[Float32Array]:
    length = np.sqrt(np.maximum(_dot(vector, vector), np.float32(1e-12)))
    return [np.asarray(part / length, dtype=np.float32) for part in vector]
