"""What spoils a picture: blur, spots on the tag, smoke, drops on the lens, noise, fields and compression.

All of it acts on the light before the sensor but for the fields of interlaced video and the compression. Nothing here
is shared with the detectors.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray
from fgreg.simulation.textures import Float32Array

SUBPIXELS = 16
"""Of a blur's kernel."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbances:
    """The default spoils nothing. Spots lie on the first tag; sizes are shares of its side.

    Attributes:
        defocus_px: radius of the disc that a point becomes.
        motion_px, motion_rad: straight uniform motion during the exposure: its length, its direction from x to y.
        interlace_px: motion between the two fields, along ``motion_rad``; the marker's pose is that halfway.
        noise_gain: the sensor's noise is larger by this factor.
        jpeg_quality: each picture is compressed as in an MJPEG stream, 1 to 100.
        specks: white blobs of radius 5 to 14 %, anywhere on the tag and a margin of 20 %, up to 8 % elsewhere in the
            right view: specular light on wet plastic.
        glare: the same with a halo that brightens what is around.
        stains: corners under a dark blob of radius 12 %, the same in both views.
        blood: translucent dark films of radius 10 to 25 % with soft rims, the same in both views.
        smoke: share of the light that comes from smoke, 0 to 1; it is uneven.
        drops: water drops on each lens, over the tag or beside it: behind them the picture is blurred and enlarged.
    """

    defocus_px: float = 0.0
    motion_px: float = 0.0
    motion_rad: float = 0.0
    interlace_px: float = 0.0
    noise_gain: float = 1.0
    jpeg_quality: int | None = None
    specks: int = 0
    glare: int = 0
    stains: int = 0
    blood: int = 0
    smoke: float = 0.0
    drops: int = 0

    def __post_init__(self) -> None:
        if min(self.defocus_px, self.motion_px, self.specks, self.glare, self.blood, self.drops) < 0:
            raise ValueError("blur and numbers of spots have to be 0 or more")
        if not (0 <= self.stains <= 4 and 0.0 <= self.smoke < 1.0 and self.noise_gain > 0.0):
            raise ValueError("expected stains 0 to 4, smoke 0 to below 1, noise_gain above 0")
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality is {self.jpeg_quality}, expected 1 to 100")


@dataclass(frozen=True, slots=True, eq=False)
class SpoiltView:
    """Disturbances as one view of one shot has them.

    Attributes:
        what: the disturbances.
        image_from_tag: (3, 3) homography: tag coordinates, in sides from its centre, x right and y up, to pixels.
        right: the right view.
        seed: of the shot.
        white: grey level of white paper.
    """

    what: Disturbances
    image_from_tag: FloatArray
    right: bool
    seed: tuple[int, ...]
    white: float

    def light(self, image: Float32Array) -> Float32Array:
        """The light (h, w) that reaches the sensor, from that of a clean scene behind a clean lens in focus."""
        what, rng = self.what, np.random.default_rng((*self.seed, 71))
        for _ in range(what.blood):
            centre, radius = rng.uniform(-0.6, 0.6, 2), rng.uniform(0.10, 0.25)
            image = image * (1.0 - 0.7 * self._blob(image, centre, radius, 0.25 * radius))
        for corner in rng.permutation(4)[: what.stains]:
            centre = 0.5 * np.array([(-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)][corner])
            cover = self._blob(image, centre, 0.12)
            image = (1.0 - cover) * image + cover * np.float32(0.06 * self.white)
        for number in range(what.specks + what.glare):
            centre, radius, shift = rng.uniform(-0.7, 0.7, 2), rng.uniform(0.05, 0.14), rng.uniform(-0.08, 0.08, 2)
            centre = centre + shift * self.right
            if number >= what.specks:
                image = image + np.float32(0.7 * self.white) * self._blob(image, centre, 0.5 * radius, 1.2 * radius)
            cover = self._blob(image, centre, radius)
            image = (1.0 - cover) * image + cover * np.float32(1.4 * self.white)
        if what.smoke > 0.0:
            image = self._smoky(image, rng)
        rng = np.random.default_rng((*self.seed, 72, int(self.right)))  # each lens has its own drops
        for _ in range(what.drops):
            image = self._behind_drop(image, rng)
        if what.defocus_px > 0.0:
            image = _filtered(image, _disc(what.defocus_px))
        if what.motion_px > 0.0:
            image = _filtered(image, _line(what.motion_px, what.motion_rad))
        return image

    def recorded(self, light: Float32Array) -> Float32Array:
        """The picture of interlaced video: even lines are half the motion early, odd ones half of it late."""
        if self.what.interlace_px == 0.0:
            return light
        height, width = light.shape
        half = 0.5 * self.what.interlace_px * np.array([np.cos(self.what.motion_rad), np.sin(self.what.motion_rad)])
        out = np.empty_like(light)
        for first, move in ((0, -half), (1, half)):
            moved = cv2.warpAffine(
                light,
                np.column_stack([np.eye(2), move]),
                (width, height),
                flags=cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REPLICATE,
            )
            out[first::2] = moved[first::2]
        return out

    def compressed(self, picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """An 8-bit picture as the decoder of an MJPEG stream gives it."""
        if self.what.jpeg_quality is None:
            return picture
        _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, self.what.jpeg_quality])
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)

    def _blob(self, image: Float32Array, centre: FloatArray, radius: float, rim: float = 0.0) -> Float32Array:
        """Cover (h, w) of a round spot on the tag; ``rim``: width over which its border fades (one pixel at least)."""
        height, width = image.shape
        tag_from_image = np.linalg.inv(self.image_from_tag)
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        h = tag_from_image.astype(np.float32)
        scale = h[2, 0] * x + h[2, 1] * y + h[2, 2]
        u = (h[0, 0] * x + h[0, 1] * y + h[0, 2]) / scale - np.float32(centre[0])
        v = (h[1, 0] * x + h[1, 1] * y + h[1, 2]) / scale - np.float32(centre[1])
        pixel = 1.0 / self._side_px()
        cover = np.clip((radius - np.hypot(u, v)) / max(rim, pixel) + 0.5, 0.0, 1.0)
        return np.asarray(cover, dtype=np.float32)

    def _side_px(self) -> float:
        ends = np.array([[-0.5, 0.5, 0.0, 0.0], [0.0, 0.0, -0.5, 0.5], np.ones(4)])
        px = self.image_from_tag @ ends
        px = px[:2] / px[2]
        return float(0.5 * np.linalg.norm(px[:, 1::2] - px[:, ::2], axis=0).sum())

    def _smoky(self, image: Float32Array, rng: np.random.Generator) -> Float32Array:
        height, width = image.shape
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        waves = np.zeros_like(image)
        for _ in range(4):
            turn, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
            wave = 2.0 * np.pi / rng.uniform(0.2 * width, 0.8 * width)
            waves += np.cos(np.float32(wave * np.cos(turn)) * x + np.float32(wave * np.sin(turn)) * y + phase)
        veil = np.float32(self.what.smoke) * (1.0 + 0.1 * waves)
        return np.asarray(image * (1.0 - veil) + np.float32(0.6 * self.white) * veil)

    def _behind_drop(self, image: Float32Array, rng: np.random.Generator) -> Float32Array:
        side = self._side_px()
        middle = self.image_from_tag[:2, 2] / self.image_from_tag[2, 2]
        centre = (middle + rng.uniform(-0.8, 0.8, 2) * side).astype(np.float32)
        radius = float(rng.uniform(0.15, 0.35)) * side
        height, width = image.shape
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        dx, dy = x - centre[0], y - centre[1]
        inside = np.clip(1.0 - (dx * dx + dy * dy) / np.float32(radius**2), 0.0, 1.0)
        nearer = 1.0 - 0.3 * inside
        behind = cv2.remap(
            cv2.GaussianBlur(image, (0, 0), 0.08 * radius),
            centre[0] + nearer * dx,
            centre[1] + nearer * dy,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        cover = np.clip(8.0 * inside, 0.0, 1.0)
        return np.asarray((1.0 - cover) * image + cover * behind)


def _filtered(image: Float32Array, kernel: Float32Array) -> Float32Array:
    return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE))


def _disc(radius_px: float) -> Float32Array:
    """Kernel of a uniform disc, centred."""
    n = int(np.ceil(radius_px + 0.5))
    at = (np.arange((2 * n + 1) * SUBPIXELS) + 0.5) / SUBPIXELS - n - 0.5
    inside = (at[:, None] ** 2 + at**2 <= radius_px**2).astype(np.float64)
    kernel = inside.reshape(2 * n + 1, SUBPIXELS, 2 * n + 1, SUBPIXELS).sum(axis=(1, 3))
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)


def _line(length_px: float, turn_rad: float) -> Float32Array:
    """Kernel of a uniform line, centred, each of its points spread over four pixels."""
    n = int(np.ceil(0.5 * length_px)) + 1
    along = (np.arange(SUBPIXELS * 4 * n) + 0.5) / (SUBPIXELS * 4 * n) - 0.5
    x, y = (n + along * length_px * turn for turn in (np.cos(turn_rad), np.sin(turn_rad)))
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    kernel = np.zeros((2 * n + 2, 2 * n + 2))
    for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
        np.add.at(kernel, (j + dj, i + di), np.abs(1 - di - (x - i)) * np.abs(1 - dj - (y - j)))
    kernel = kernel[:-1, :-1]
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)
