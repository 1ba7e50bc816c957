"""What a session is made of: probe, stage, cameras, marker, board, noise. Frozen; lengths mm, angles rad.

Each raises ValueError on a value that cannot be; the session reader turns that into a line that names the key.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from fgreg.frames import FloatArray, as_float_array


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"{name} is {value}, expected a number > 0")


@dataclass(frozen=True, slots=True, eq=False)
class SensitivityModel:
    """Half width of the window in which the probe hears a source, as *stage rotation*, against depth.

    Attributes:
        depth_mm: (n,) increasing, from the element.
        half_width_rad: (n,), in (0, pi/4].
        edge_sigma_rad: how well the half width is known; one unknown of the session.
        curve_rotation_rad, curve_amplitude: optional (m,), amplitude against rotation offset.
    """

    depth_mm: FloatArray
    half_width_rad: FloatArray
    edge_sigma_rad: float
    curve_rotation_rad: FloatArray | None = None
    curve_amplitude: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.depth_mm.shape != self.half_width_rad.shape or self.depth_mm.ndim != 1 or self.depth_mm.size == 0:
            raise ValueError("depth_mm and half_width need the same number of entries, at least one")
        if (np.diff(self.depth_mm) <= 0).any():
            raise ValueError("depth_mm has to increase")

    def half_width_at(self, depth_mm: FloatArray | float) -> FloatArray:
        """Half width (rad) at depths from the element (mm), linear between and constant beyond the table."""
        return np.asarray(np.interp(depth_mm, self.depth_mm, self.half_width_rad))


@dataclass(frozen=True, slots=True)
class ChannelModel:
    """Sampling of channel data: rate (MHz), time of sample 0 after the laser pulse (us), delay of the pulse (us)."""

    sampling_mhz: float
    t0_us: float = 0.0
    pulse_delay_us: float = 0.0

    def __post_init__(self) -> None:
        _positive(sampling_mhz=self.sampling_mhz)


@dataclass(frozen=True, slots=True)
class ImageModel:
    """Scan-converted envelope images (depth, lateral): pixel pitch and centre of pixel [0, 0], (range, x) in mm."""

    pixel_mm: tuple[float, float]
    origin_mm: tuple[float, float]

    def __post_init__(self) -> None:
        _positive(dz=self.pixel_mm[0], dx=self.pixel_mm[1])


@dataclass(frozen=True, slots=True, eq=False)
class ProbeModel:
    """The TRUS probe: linear array parallel to the rotation axis at ``radius_mm`` from it."""

    elements: int
    pitch_mm: float
    flip: bool
    radius_mm: float
    sound_speed_m_s: float
    sensitivity: SensitivityModel
    channels: ChannelModel | None = None
    image: ImageModel | None = None

    def __post_init__(self) -> None:
        _positive(elements=self.elements, pitch_mm=self.pitch_mm, radius_mm=self.radius_mm)
        _positive(sound_speed_m_s=self.sound_speed_m_s)

    def is_channel_data(self, frame: npt.NDArray[np.generic]) -> bool:
        """Whether a frame is channel data; of a probe with ``image``, too, all others are images."""
        return self.holds_channels(frame.shape, frame.dtype)

    def holds_channels(self, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> bool:
        """Whether an array of this shape and type is channel data: (elements, samples), float32 or int16."""
        is_type = (dtype.kind, dtype.itemsize) in (("f", 4), ("i", 2))
        return self.channels is not None and is_type and len(shape) == 2 and shape[0] == self.elements

    @property
    def element_x_mm(self) -> FloatArray:
        """TRUS x of each element, (elements,), in the order of the channel data's rows."""
        x = (np.arange(self.elements) - (self.elements - 1) / 2.0) * self.pitch_mm
        return np.asarray(-x if self.flip else x)


@dataclass(frozen=True, slots=True)
class StageModel:
    """The rotation stage. ``scan`` angles inside are the plane's (TRUS convention); files hold device angles.

    ``scan = direction * (device - zero)``.
    """

    step_rad: float
    limits_device_rad: tuple[float, float]
    direction: int = 1
    zero_device_rad: float = 0.0

    def __post_init__(self) -> None:
        _positive(step=self.step_rad)
        if self.direction not in (-1, 1):
            raise ValueError(f"direction is {self.direction}, expected 1 or -1")
        if self.limits_device_rad[0] >= self.limits_device_rad[1]:
            raise ValueError("limits have to increase")

    def scan_from_device(self, device_rad: float) -> float:
        """Plane angle (rad, TRUS convention) of a device angle (rad)."""
        return self.direction * (device_rad - self.zero_device_rad)

    def device_from_scan(self, scan_rad: float) -> float:
        """Device angle (rad) of a plane angle (rad, TRUS convention)."""
        return self.direction * scan_rad + self.zero_device_rad


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    """Pinhole camera with OpenCV's five-parameter distortion: matrix (3, 3) px, distortion (5,), size (w, h) px."""

    image_size: tuple[int, int]
    matrix: FloatArray
    distortion: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class StereoRig:
    """The endoscope: left camera (frame ``camera``) and, where there is one, the right with ``right_T_left``."""

    left: CameraModel
    right: CameraModel | None = None
    right_T_left: FloatArray | None = None

    def __post_init__(self) -> None:
        if (self.right is None) != (self.right_T_left is None):
            raise ValueError("right and right_T_left go together")


@dataclass(frozen=True, slots=True, eq=False)
class TagModel:
    """One square tag: id, outer edge of its black border (mm), and where it sits on the marker body."""

    id: int
    size_mm: float
    marker_T_tag: FloatArray = field(default_factory=lambda: as_float_array(np.eye(4)))

    def __post_init__(self) -> None:
        _positive(size_mm=self.size_mm)

    @property
    def marker_p_corners_mm(self) -> FloatArray:
        """(4, 3) corners in the marker frame, in the detector order: top left, top right, bottom right, bottom left."""
        h = self.size_mm / 2.0
        tag_p = np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])
        return np.asarray(tag_p @ self.marker_T_tag[:3, :3].T + self.marker_T_tag[:3, 3])


@dataclass(frozen=True, slots=True, eq=False)
class MarkerModel:
    """The fibre's fiducial: a rigid body of one or many square tags of one OpenCV dictionary."""

    dictionary: str
    tags: tuple[TagModel, ...]

    def __post_init__(self) -> None:
        if not self.tags:
            raise ValueError("a marker needs at least one tag")
        if len({tag.id for tag in self.tags}) != len(self.tags):
            raise ValueError("two tags have the same id")


@dataclass(frozen=True, slots=True)
class CharucoModel:
    """The markers of a ChArUco board: OpenCV dictionary and marker edge (mm)."""

    dictionary: str
    marker_mm: float


@dataclass(frozen=True, slots=True)
class BoardModel:
    """The calibration board; columns and rows count inner corners."""

    columns: int
    rows: int
    square_mm: float
    charuco: CharucoModel | None = None

    def __post_init__(self) -> None:
        _positive(square_mm=self.square_mm)
        if self.columns < 2 or self.rows < 2:
            raise ValueError("a board needs at least 2 x 2 inner corners")
        if self.charuco is not None and not 0 < self.charuco.marker_mm < self.square_mm:
            raise ValueError("charuco.marker_mm has to be smaller than square_mm")


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Standard deviations to assume where an observation brings no covariance of its own (session-format)."""

    marker_translation_mm: tuple[float, float, float] = (0.1, 0.1, 0.8)
    marker_rotation_rad: tuple[float, float, float] = (0.01, 0.01, 0.01)
    marker_bias_mm: float = 0.0
    aim_mm: tuple[float, float, float] = (1.0, 1.0, 0.1)
    lateral_mm: float = 0.3
    range_mm: float = 0.2
    scan_rad: float = math.radians(0.1)


def default_targets_mm(radius_mm: float) -> FloatArray:
    """(27, 3) TRUS points: x -20, 0, 20; stage angle -30, 0, 30 deg; 22, 32, 42 mm beyond the probe's radius."""
    return as_float_array(
        [
            [x, (radius_mm + depth) * math.sin(a), (radius_mm + depth) * math.cos(a)]
            for x in (-20.0, 0.0, 20.0)
            for a in (math.radians(-30.0), 0.0, math.radians(30.0))
            for depth in (22.0, 32.0, 42.0)
        ]
    )


@dataclass(frozen=True, slots=True, eq=False)
class SessionModel:
    """How a session was set up: everything ``session.yaml`` says."""

    name: str
    probe: ProbeModel
    stage: StageModel
    noise: NoiseModel
    targets_mm: FloatArray
    camera: StereoRig | None = None
    marker: MarkerModel | None = None
    board: BoardModel | None = None
    initial_trus_T_camera: FloatArray | None = None
    initial_marker_T_laser: FloatArray | None = None
