"""Flat objects that a camera sees: tags, boards, plain patches, and the background behind them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.session_model import BoardModel
from fgreg.simulation.textures import CellTexture, board_texture, plain_texture, tag_texture

FILM_SLOPE = 0.12
"""Standard deviation of the slopes of a film of liquid on something flat."""


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """A textured plane: ``texture_from_surface`` (2, 3) maps (x, y, 1) mm to texture (u, v) mm.

    ``slope``: of the liquid on it where the scene is wet, 0 where it stays dry.
    """

    camera_T_surface: FloatArray
    texture: CellTexture
    texture_from_surface: FloatArray
    albedo: tuple[float, float, float]
    faces_camera: bool
    outline_mm: FloatArray
    depth_bias_mm: float = 0.0
    slope: float = 0.0


class Surface(Protocol):
    """Interface of a flat object that can be drawn."""

    def sheet(self) -> Sheet:
        """Plane, texture and colours, in the camera frame that the surface is expressed in."""
        ...

    def seen_from(self, other_T_camera: FloatArray) -> Surface:
        """The same surface expressed in another camera's frame."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class TagSurface:
    """A printed tag. Tag frame: origin at the centre, x right and y up as printed, z out of the printed face.

    Attributes:
        dictionary, id: the OpenCV dictionary and the tag in it.
        size_mm: outer edge of the black border.
        camera_T_tag: (4, 4).
        quiet_modules: width of the white zone around the border, in modules.
    """

    dictionary: str
    id: int
    size_mm: float
    camera_T_tag: FloatArray
    quiet_modules: float = 1.0
    black: float = 0.06
    white: float = 1.0

    def sheet(self) -> Sheet:
        texture = tag_texture(self.dictionary, self.id, self.size_mm, self.quiet_modules)
        half = texture.u_mm[1] / 2.0
        # u = x + half, v = half - y: the texture's v runs down, the tag's y up.
        to_texture = np.array([[1.0, 0.0, half], [0.0, -1.0, half]])
        # z towards the viewer: the camera's origin lies on the side that z points to.
        front = float(self.camera_T_tag[:3, 2] @ self.camera_T_tag[:3, 3]) < 0.0
        return Sheet(
            self.camera_T_tag,
            texture,
            to_texture,
            (0.0, self.black, self.white),
            front,
            np.array([[-half, -half], [half, -half], [half, half], [-half, half]]),
            slope=FILM_SLOPE,
        )

    def seen_from(self, other_T_camera: FloatArray) -> TagSurface:
        return replace(self, camera_T_tag=other_T_camera @ self.camera_T_tag)


@dataclass(frozen=True, slots=True, eq=False)
class BoardSurface:
    """The calibration board.

    Board frame: origin at inner corner [0, 0], x along the columns (right) and y along the rows (down), seen from the
    front with the black corner square at the top left; z = x cross y points away from the viewer. Inner corner
    [column, row] is at (column, row, 0) * square_mm.
    """

    board: BoardModel
    camera_T_board: FloatArray
    black: float = 0.06
    white: float = 0.8

    def sheet(self) -> Sheet:
        texture = board_texture(self.board)
        shift = 2.0 * self.board.square_mm
        to_texture = np.array([[1.0, 0.0, shift], [0.0, 1.0, shift]])
        front = float(self.camera_T_board[:3, 2] @ self.camera_T_board[:3, 3]) > 0.0
        (u0, u1), (v0, v1) = texture.u_mm, texture.v_mm
        outline = np.array([[u0, v0], [u1, v0], [u1, v1], [u0, v1]]) - shift
        return Sheet(self.camera_T_board, texture, to_texture, (0.0, self.black, self.white), front, outline)

    def seen_from(self, other_T_camera: FloatArray) -> BoardSurface:
        return replace(self, camera_T_board=other_T_camera @ self.camera_T_board)


@dataclass(frozen=True, slots=True, eq=False)
class PatchSurface:
    """A rectangle of one colour, seen from both sides: fibre, instrument shaft, clutter. Origin at its centre.

    ``depth_bias_mm`` is added to the distance in the order of occlusion.
    """

    camera_T_patch: FloatArray
    width_mm: float
    height_mm: float
    albedo: float
    depth_bias_mm: float = 0.0

    def sheet(self) -> Sheet:
        w, h = self.width_mm / 2.0, self.height_mm / 2.0
        return Sheet(
            self.camera_T_patch,
            plain_texture(self.width_mm, self.height_mm),
            np.array([[1.0, 0.0, w], [0.0, 1.0, h]]),
            (0.0, self.albedo, self.albedo),
            True,
            np.array([[-w, -h], [w, -h], [w, h], [-w, h]]),
            self.depth_bias_mm,
            FILM_SLOPE,
        )

    def seen_from(self, other_T_camera: FloatArray) -> PatchSurface:
        return replace(self, camera_T_patch=other_T_camera @ self.camera_T_patch)


@dataclass(frozen=True, slots=True, eq=False)
class Background:
    """What lies behind everything: a plane (z = 0 of its frame) with smooth mottling, the same from every view.

    Attributes:
        camera_T_background: (4, 4).
        albedo: mean; contrast: relative amplitude of the mottling.
        seed: of the pattern.
        blood_mm: mean thickness of the blood in it, which gives tissue its colour; 0: grey.
        pale: what is left of the albedo is larger by this factor in colour pictures of tissue.
        slope: standard deviation of its surface's slopes; 0: it stays dry.
    """

    camera_T_background: FloatArray
    albedo: float = 0.22
    contrast: float = 0.35
    seed: int = 0
    blood_mm: float = 0.0
    pale: float = 1.4
    slope: float = 0.0

    def seen_from(self, other_T_camera: FloatArray) -> Background:
        """The same background expressed in another camera's frame."""
        return replace(self, camera_T_background=other_T_camera @ self.camera_T_background)

    def albedo_at(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Albedo at points of the plane: waves of 25 to 90 mm and a few dark and bright spots."""
        rng = np.random.default_rng(self.seed)
        value = np.zeros(np.shape(x_mm))
        for _ in range(8):
            turn, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
            wave = 2.0 * np.pi / rng.uniform(25.0, 90.0)
            value += np.cos(wave * (np.cos(turn) * x_mm + np.sin(turn) * y_mm) + phase) / 8.0
        for _ in range(12):
            cx, cy = rng.uniform(-70.0, 70.0, 2)
            value += rng.uniform(-1.0, 0.9) * np.exp(
                -((x_mm - cx) ** 2 + (y_mm - cy) ** 2) / (2.0 * rng.uniform(4.0, 9.0) ** 2)
            )
        return np.asarray(self.albedo * np.clip(1.0 + self.contrast * 1.6 * value, 0.05, 2.0))

    def film_mm_at(self, x_mm: FloatArray, y_mm: FloatArray) -> FloatArray:
        """Thickness of the blood at points of the plane: lognormal, in waves of 6 to 60 mm."""
        rng = np.random.default_rng((self.seed, 5))
        value, waves = np.zeros(np.shape(x_mm)), 14
        for _ in range(waves):
            turn, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
            wave = 2.0 * np.pi / np.exp(rng.uniform(np.log(6.0), np.log(60.0)))
            value += np.cos(wave * (np.cos(turn) * x_mm + np.sin(turn) * y_mm) + phase) * np.sqrt(2.0 / waves)
        return np.asarray(self.blood_mm * np.exp(0.35 * value))
