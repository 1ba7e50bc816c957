"""What spoils a picture: smoke, blood, drops on the lens, spots, blur, a moving hand, fields, the video's curve, MJPEG.

Smoke is a veil (Koschmieder 1924): of a point at distance d, exp(-beta d) of its light is left, and 1 - exp(-beta d) of
the veil's own is added; beta varies from place to place. Blood absorbs (blood.py), wet things mirror (highlights.py).
All of it acts on the light before the sensor but for exposure, curve, fields and compression. Nothing here is shared
with the detectors.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.geometry.transforms import FloatArray
from fgreg.simulation.blood import transmission
from fgreg.simulation.textures import Float32Array

SUBPIXELS = 16
"""Of a blur's kernel."""
FILM_MM = 0.02, 0.15
"""Thickness of films of blood."""
COUNTS = "blood", "drops", "specks", "glare", "stains"
MOST, MOST_SMOKE = 1000.0, 0.95
UNEVEN, SWIRL = 0.5, (0.2, 1.5)
"""Standard deviation of the logarithm of beta, and lengths of its waves as shares of the picture's width."""
FIELD_RATES = 0.0, 50.0, 60.0
CHROMA = {420: 0x221111, 422: 0x211111, 444: 0x111111}
"""Colour subsampling of JPEG, as OpenCV has it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Disturbances:
    """The default spoils nothing. Spots lie on the first tag; sizes are shares of its side.

    Attributes:
        smoke: share of the light from the marker's distance that comes from smoke, 0 to 0.95.
        blood: films of blood of radius 10 to 25 % with soft rims, 0.02 to 0.15 mm thick, the same in both views.
        drops: water drops on each lens, over the tag or beside it: behind them the picture is blurred and enlarged.
        specular: share of the light that wet tissue and tag mirror where there is liquid, on a third of them.
        specks: white blobs of radius 5 to 14 %, anywhere on the tag and a margin of 20 %, up to 8 % elsewhere in the
            right view: beads of liquid in the light.
        glare: the same with a halo that brightens what is around.
        stains: corners under a dark blob of radius 12 %, the same in both views.
        defocus_px: radius of the disc that a point becomes.
        motion_px, motion_rad: straight uniform motion of the whole picture during the exposure: length, direction from
            x to y.
        hand_mm_s: speed of the hand that holds the fibre, in a random direction, with a turn about a point 100 mm away.
        shutter_ms: how long the sensor is exposed.
        field_hz: 50 or 60: interlaced, the even lines first, the odd ones this much later; the marker's pose is that
            halfway between. 0: progressive.
        deinterlace: the even lines alone are recorded, as pictures of half the height; the pose is that of their time.
        exposure: factor on all light. Above about 1.4 the white of tags is cut off.
        video_curve: levels by the transfer function of video (ITU-R BT.709), else linear in the light.
        noise_gain: the sensor's noise is larger by this factor.
        jpeg_quality: each picture is compressed as in an MJPEG stream, 1 to 100; 0: it is not.
        chroma: colour subsampling of that: 420, 422, 444.
        drawn: each shot has its own amounts, whose means are those given: smoke, with many clear shots and a few dense
            ones, is exponential, numbers are Poisson, the hand's speed is Rayleigh.
    """

    smoke: float = 0.0
    blood: float = 0
    drops: float = 0
    specular: float = 0.0
    specks: float = 0
    glare: float = 0
    stains: float = 0
    defocus_px: float = 0.0
    motion_px: float = 0.0
    motion_rad: float = 0.0
    hand_mm_s: float = 0.0
    shutter_ms: float = 10.0
    field_hz: float = 0.0
    deinterlace: bool = False
    exposure: float = 1.0
    video_curve: bool = False
    noise_gain: float = 1.0
    jpeg_quality: int = 0
    chroma: int = 420
    drawn: bool = False

    def __post_init__(self) -> None:
        for name in (
            "blood",
            "drops",
            "specular",
            "specks",
            "glare",
            "defocus_px",
            "motion_px",
            "hand_mm_s",
            "shutter_ms",
        ):
            if not 0.0 <= getattr(self, name) <= MOST:
                raise ValueError(f"{name} is {getattr(self, name):g}, expected 0 to {MOST:g}")
        if not (0.0 <= self.smoke <= MOST_SMOKE and 0 <= self.stains <= 4):
            raise ValueError(f"smoke {self.smoke:g}, stains {self.stains:g}, expected 0 to {MOST_SMOKE} and 0 to 4")
        if not (0.0 < self.noise_gain <= MOST and 0.0 < self.exposure <= MOST):
            raise ValueError(
                f"noise_gain {self.noise_gain:g}, exposure {self.exposure:g}, expected above 0 to {MOST:g}"
            )
        if self.jpeg_quality not in range(101) or self.chroma not in CHROMA:
            raise ValueError(
                f"jpeg_quality {self.jpeg_quality:g}, chroma {self.chroma:g}, expected 0 to 100 and 420, 422 or 444"
            )
        if self.field_hz not in FIELD_RATES or (self.deinterlace and not self.field_hz):
            raise ValueError(f"field_hz is {self.field_hz:g}, expected 50 or 60, or 0 (which cannot be deinterlaced)")
        if not self.drawn and any(getattr(self, name) % 1 for name in COUNTS):
            raise ValueError(f"{', '.join(COUNTS)} are whole numbers where they are the same in each shot")

    def of_shot(self, seed: tuple[int, ...]) -> Disturbances:
        """Those of the shot with this seed."""
        if not self.drawn:
            return self
        rng = np.random.default_rng((*seed, 73))
        smoke = min(float(self.smoke * rng.exponential()), MOST_SMOKE)
        counts = {name: float(rng.poisson(getattr(self, name))) for name in COUNTS}
        counts["stains"] = min(counts["stains"], 4.0)
        hand = float(self.hand_mm_s * rng.rayleigh(np.sqrt(2.0 / np.pi)))
        turn = float(rng.uniform(0.0, np.pi))
        return replace(self, drawn=False, smoke=smoke, hand_mm_s=hand, motion_rad=turn, **counts)  # type: ignore[arg-type]

    def named(self) -> dict[str, float]:
        """What is not the default, by name."""
        plain = Disturbances()
        names = [field.name for field in fields(self) if getattr(self, field.name) != getattr(plain, field.name)]
        return {name: round(float(getattr(self, name)), 4) for name in names}


def with_values(base: Disturbances, values: dict[str, float]) -> Disturbances:
    """Disturbances with some of them changed by name; switches are 0 or 1.

    Raises:
        ValueError: there is no such disturbance, or a value that it cannot have.
    """
    known = {field.name: getattr(base, field.name) for field in fields(base)}
    for name, value in values.items():
        if name not in known:
            raise ValueError(f"{name} is no disturbance; there are {', '.join(known)}")
        kind = type(getattr(Disturbances(), name))
        if kind is not float and name not in COUNTS and (value % 1 or (kind is bool and value not in (0, 1))):
            raise ValueError(f"{name} is {value:g}, expected {'0 or 1' if kind is bool else 'a whole number'}")
        known[name] = value if name in COUNTS else kind(value)
    return Disturbances(**known)


@dataclass(frozen=True, slots=True, eq=False)
class SpoiltView:
    """Disturbances as one view of one shot has them.

    Attributes:
        what: the disturbances, of this shot.
        image_from_tag: (3, 3) homography: tag coordinates, in sides from its centre, x right and y up, to pixels.
        right: the right view.
        seed: of the shot.
        white: grey level of white paper.
        distance_mm: of the marker.
    """

    what: Disturbances
    image_from_tag: FloatArray
    right: bool
    seed: tuple[int, ...]
    white: float
    distance_mm: float

    def light(self, planes: list[Float32Array], distance_mm: Float32Array) -> list[Float32Array]:
        """The light that reaches the sensor, from that of a clean scene behind a clean lens in focus.

        Args:
            planes: grey, or blue, green and red, (h, w) each.
            distance_mm: (h, w) of what is seen.
        """
        what, rng = self.what, np.random.default_rng((*self.seed, 71))
        for _ in range(int(what.blood)):
            centre, radius, thickness = rng.uniform(-0.6, 0.6, 2), rng.uniform(0.10, 0.25), rng.uniform(*FILM_MM)
            film = transmission(thickness * self._blob(planes[0], centre, radius, 0.25 * radius), len(planes))
            planes = [plane * left for plane, left in zip(planes, film, strict=True)]
        for corner in rng.permutation(4)[: int(what.stains)]:
            centre = 0.5 * np.array([(-1.0, 1.0), (1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)][corner])
            planes = _covered(planes, self._blob(planes[0], centre, 0.12), 0.06 * self.white)
        for number in range(int(what.specks + what.glare)):
            centre, radius, shift = rng.uniform(-0.7, 0.7, 2), rng.uniform(0.05, 0.14), rng.uniform(-0.08, 0.08, 2)
            centre = centre + shift * self.right
            if number >= what.specks:
                halo = np.float32(0.7 * self.white) * self._blob(planes[0], centre, 0.5 * radius, 1.2 * radius)
                planes = [plane + halo for plane in planes]
            planes = _covered(planes, self._blob(planes[0], centre, radius), 1.4 * self.white)
        if what.smoke > 0.0:
            planes = self._smoky(planes, distance_mm, rng)
        rng = np.random.default_rng((*self.seed, 72, int(self.right)))  # each lens has its own drops
        for _ in range(int(what.drops)):
            planes = self._behind_drop(planes, rng)
        if what.defocus_px > 0.0:
            planes = [_filtered(plane, _disc(what.defocus_px)) for plane in planes]
        if what.motion_px > 0.0:
            planes = [_filtered(plane, _line(what.motion_px, what.motion_rad)) for plane in planes]
        return planes

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

    def _smoky(
        self, planes: list[Float32Array], distance_mm: Float32Array, rng: np.random.Generator
    ) -> list[Float32Array]:
        height, width = planes[0].shape
        x, y = np.meshgrid(np.linspace(0.0, 1.0, 160), np.linspace(0.0, height / width, 90))
        rough, waves = np.zeros(x.shape), 14
        for _ in range(waves):
            turn, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
            wave = 2.0 * np.pi / np.exp(rng.uniform(*np.log(SWIRL)))
            rough += np.cos(wave * (np.cos(turn) * x + np.sin(turn) * y) + phase) * UNEVEN * np.sqrt(2.0 / waves)
        swirl = cv2.resize(rough.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
        beta = np.float32(-np.log(1.0 - self.what.smoke) / self.distance_mm) * np.exp(swirl)
        left = np.exp(-beta * distance_mm)
        veil = np.float32(0.6 * self.white) * (1.0 - left)
        return [np.asarray(plane * left + veil) for plane in planes]

    def _behind_drop(self, planes: list[Float32Array], rng: np.random.Generator) -> list[Float32Array]:
        side = self._side_px()
        middle = self.image_from_tag[:2, 2] / self.image_from_tag[2, 2]
        centre = (middle + rng.uniform(-0.8, 0.8, 2) * side).astype(np.float32)
        radius = float(rng.uniform(0.15, 0.35)) * side
        height, width = planes[0].shape
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        dx, dy = x - centre[0], y - centre[1]
        inside = np.clip(1.0 - (dx * dx + dy * dy) / np.float32(radius**2), 0.0, 1.0)
        nearer = 1.0 - 0.3 * inside
        at = centre[0] + nearer * dx, centre[1] + nearer * dy
        cover = np.clip(8.0 * inside, 0.0, 1.0)
        out = []
        for plane in planes:
            blurred = cv2.GaussianBlur(plane, (0, 0), 0.08 * radius)
            behind = cv2.remap(blurred, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            out.append(np.asarray((1.0 - cover) * plane + cover * behind))
        return out


def compressed(picture: npt.NDArray[np.uint8], what: Disturbances) -> npt.NDArray[np.uint8]:
    """A picture, (h, w) grey or (h, w, 3), of 8 bits as the decoder of an MJPEG stream gives it."""
    if not what.jpeg_quality:
        return picture
    settings = [cv2.IMWRITE_JPEG_QUALITY, what.jpeg_quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, CHROMA[what.chroma]]
    _, data = cv2.imencode(".jpg", picture, settings)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), dtype=np.uint8)


def video_levels(level: Float32Array) -> Float32Array:
    """Levels 0 to 255 of video (ITU-R BT.709) for levels 0 to 255 that are linear in the light."""
    share = np.clip(level / np.float32(255.0), 0.0, 1.0)
    return np.asarray(255.0 * np.where(share < 0.018, 4.5 * share, 1.099 * share**0.45 - 0.099), dtype=np.float32)


def _covered(planes: list[Float32Array], cover: Float32Array, level: float) -> list[Float32Array]:
    """Planes under a spot of this level."""
    return [np.asarray((1.0 - cover) * plane + cover * np.float32(level)) for plane in planes]


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
