"""Values that the formats allow and no rig has: another unit is the likely cause (metres for mm, radians for degrees).

A probe whose radius is given in metres solves without complaint and puts the targets centimetres off. So each value has
a range in which every rig that makes sense lies, and a value outside gives a sentence with the unit that would fit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from fgreg.geometry.transforms import FloatArray
from fgreg.model.camera_model import StereoRig
from fgreg.model.commissioned_rig import CommissionedRig
from fgreg.model.lens import blind_px
from fgreg.model.measurements import Aim, Measurements, Pair
from fgreg.model.probe_model import ProbeModel
from fgreg.model.session_model import BoardModel, MarkerModel, NoiseModel, SessionModel, StageModel
from fgreg.model.systematic import Systematic

_LENGTHS = (("metres", 1000.0), ("cm", 10.0), ("micrometres", 1e-3))
_ANGLES = (("radians", math.degrees(1.0)),)
_FRACTIONS = (("per cent", 0.01),)


@dataclass(frozen=True, slots=True)
class Plausible:
    """Values that make sense.

    Attributes:
        low, high: ends of the range, in the file's unit.
        unit: of the file; empty for ratios.
        what: what a value outside hardly is.
        others: units that people use instead, with the factor to the file's.
    """

    low: float
    high: float
    unit: str
    what: str
    others: tuple[tuple[str, float], ...] = ()

    def doubt(self, key: str, value: float) -> list[str]:
        """A sentence about a value outside the range, with the unit in which it would be inside; else nothing."""
        if self.low <= abs(value) <= self.high:
            return []
        unit = f" {self.unit}" if self.unit else ""
        text = f"{key}: {value:g}{unit} is hardly {self.what} ({self.low:g} to {self.high:g}{unit})"
        for other, factor in self.others:
            if value and self.low <= abs(value) * factor <= self.high:
                return [f"{text}; in {other} it would be {value * factor:.4g}{unit}"]
        return [text]


def _mm(low: float, high: float, what: str) -> Plausible:
    return Plausible(low, high, "mm", what, _LENGTHS)


def _deg(low: float, high: float, what: str) -> Plausible:
    return Plausible(low, high, "deg", what, _ANGLES)


RADIUS = _mm(1.0, 50.0, "a probe's radius")
PITCH = _mm(0.03, 3.0, "an array's pitch")
SOUND_SPEED = Plausible(
    1300.0, 1700.0, "m/s", "the speed of sound in tissue or water", (("mm/us", 1000.0), ("cm/s", 0.01), ("km/s", 1e3))
)
WINDOW = _deg(0.2, 30.0, "the half width of a sensitivity window")
DEPTH = _mm(3.0, 300.0, "a depth")
SAMPLING = Plausible(1.0, 500.0, "MHz", "a sampling rate", (("Hz", 1e-6), ("kHz", 1e-3)))
TRIGGER = Plausible(0.0, 1000.0, "us", "a time after the laser's trigger", (("ns", 1e-3),))
PIXEL = _mm(1e-3, 5.0, "a pixel of an ultrasound image")
STEP = _deg(0.01, 20.0, "a step of a sweep")
TRAVEL = _deg(5.0, 360.0, "the travel of a stage")
FOCAL = Plausible(0.2, 30.0, "", "a focal length over the image's width")
BASELINE = _mm(0.5, 500.0, "the distance of two cameras")
TAG = _mm(1.0, 200.0, "the size of a tag")
ARM = _mm(0.0, 500.0, "the distance of a tag from its marker's origin")
SQUARE = _mm(0.5, 100.0, "a square of a board")
TARGET = _mm(5.0, 300.0, "the distance of the targets from the probe's axis")
DISTANCE = _mm(5.0, 1500.0, "the distance from the camera")
RANGE = _mm(2.0, 250.0, "the range of a PM")
FROM_AXIS = _mm(3.0, 300.0, "the distance of a point from the probe's axis")
NOISE_LENGTH = _mm(0.0, 20.0, "a standard deviation")
NOISE_ANGLE = Plausible(0.0, 10.0, "deg", "a standard deviation")
NOISE_RADIANS = Plausible(0.0, 0.3, "rad", "a standard deviation", (("degrees", math.radians(1.0)),))
SMALL_RATIO = Plausible(0.0, 0.1, "", "a relative standard deviation", _FRACTIONS)
NOISE_PIXELS = Plausible(0.0, 100.0, "px", "a standard deviation")


def implausible_probe(probe: ProbeModel) -> Iterator[str]:
    """Doubts about the probe."""
    yield from RADIUS.doubt("probe.radius_mm", probe.radius_mm)
    yield from PITCH.doubt("probe.pitch_mm", probe.pitch_mm)
    yield from SOUND_SPEED.doubt("probe.sound_speed_m_s", probe.sound_speed_m_s)
    window = probe.sensitivity
    yield from _worst(WINDOW, "probe.sensitivity.half_width_deg", np.degrees(window.half_width_rad))
    yield from DEPTH.doubt("probe.sensitivity.depth_mm", float(np.max(window.depth_mm)))
    yield from NOISE_ANGLE.doubt("probe.sensitivity.edge_sigma_deg", math.degrees(window.edge_sigma_rad))
    if probe.channels is not None:
        yield from SAMPLING.doubt("probe.channels.sampling_mhz", probe.channels.sampling_mhz)
        yield from TRIGGER.doubt("probe.channels.t0_us", probe.channels.t0_us)
    if probe.image is not None:
        yield from _worst(PIXEL, "probe.image.pixel_mm", np.array(probe.image.pixel_mm))


def implausible_stage(stage: StageModel) -> Iterator[str]:
    """Doubts about the stage."""
    yield from STEP.doubt("stage.step_deg", math.degrees(stage.step_rad))
    lower, upper = stage.limits_device_rad
    yield from TRAVEL.doubt("stage.limits_deg", math.degrees(upper - lower))


def implausible_camera(rig: StereoRig) -> Iterator[str]:
    """Doubts about the cameras."""
    for side, camera in (("left", rig.left), ("right", rig.right)):
        if camera is None:
            continue
        (width, height), (cx, cy) = camera.image_size, camera.matrix[:2, 2]
        yield from FOCAL.doubt(f"camera.{side}.matrix", float(camera.matrix[0, 0]) / width)
        if not (0 <= cx <= width and 0 <= cy <= height):
            yield f"camera.{side}.matrix has its centre ({cx:g}, {cy:g}) outside {width} x {height} px"
        blind = blind_px(camera)
        if blind is not None:
            yield (
                f"camera.{side}.distortion cannot be inverted {blind:.0f} px from the image's centre and beyond: "
                "nothing is found there; its coefficients are hardly this lens', or of another model"
            )
    if rig.right_T_left is not None:
        yield from BASELINE.doubt("camera.right_T_left", float(np.linalg.norm(rig.right_T_left[:3, 3])))


def implausible_marker(marker: MarkerModel) -> Iterator[str]:
    """Doubts about the marker."""
    yield from _worst(TAG, "marker.tags.size_mm", np.array([tag.size_mm for tag in marker.tags]))
    yield from _worst(ARM, "marker.tags.marker_T_tag", np.array([_length(tag.marker_T_tag) for tag in marker.tags]))


def implausible_board(board: BoardModel) -> Iterator[str]:
    """Doubts about the board."""
    yield from SQUARE.doubt("board.square_mm", board.square_mm)


def implausible_noise(noise: NoiseModel) -> Iterator[str]:
    """Doubts about standard deviations of observations."""
    for key, value in (
        ("marker_translation_mm", max(noise.marker_translation_mm)),
        ("marker_bias_mm", noise.marker_bias_mm),
        ("aim_mm", max(noise.aim_mm)),
        ("lateral_mm", noise.lateral_mm),
        ("range_mm", noise.range_mm),
        ("beam_offset_mm", noise.beam_offset_mm),
        ("spot_mm", max(noise.spot_mm)),
    ):
        yield from NOISE_LENGTH.doubt(f"noise.{key}", value)
    yield from NOISE_RADIANS.doubt("noise.marker_rotation_rad", max(noise.marker_rotation_rad))
    yield from NOISE_ANGLE.doubt("noise.scan_deg", math.degrees(noise.scan_rad))
    yield from NOISE_ANGLE.doubt("noise.window_deg", math.degrees(noise.window_rad))


def implausible_systematic(systematic: Systematic) -> Iterator[str]:
    """Doubts about standard deviations of the rig's constants."""
    for each in fields(systematic):
        if each.name == "declared":
            continue
        largest = float(np.max(getattr(systematic, each.name)))
        key, factor = (f"{each.name[:-4]}_deg", math.degrees(1.0)) if each.name.endswith("_rad") else (each.name, 1.0)
        yield from _of_constant(key).doubt(f"systematic.{key}", largest * factor)


def implausible_rig(rig: CommissionedRig, label: str = "rig") -> Iterator[str]:
    """Doubts about a commissioned rig, by constant; ``label``: how sentences name its file."""
    for what, values in (
        ("values", rig.stored_values),
        ("covariance (its root)", np.sqrt(np.diag(rig.stored_covariance))),
        ("prior_sigmas", rig.prior_sigmas),
    ):
        for name, value in zip(rig.names, values.tolist(), strict=True):
            plausible = _of_constant(name)
            if what == "values":
                plausible = replace(plausible, what="the difference of a constant from what is declared")
            yield from plausible.doubt(f"{label}: {what}, {name}", value)


def _of_constant(key: str) -> Plausible:
    """Of a standard deviation of one of the rig's constants, by the unit of its key (which may have an index)."""
    units = (("_deg", NOISE_ANGLE), ("_mm", NOISE_LENGTH), ("_px", NOISE_PIXELS))
    return next((plausible for unit, plausible in units if key.split("[")[0].endswith(unit)), SMALL_RATIO)


def implausible_targets(targets_mm: FloatArray) -> Iterator[str]:
    """Doubts about targets (n, 3)."""
    if len(targets_mm):
        yield from TARGET.doubt("targets_mm", float(np.median(np.linalg.norm(targets_mm[:, 1:], axis=1))))


_DOUBTS: dict[type, Callable[..., Iterator[str]]] = {
    ProbeModel: implausible_probe,
    StageModel: implausible_stage,
    StereoRig: implausible_camera,
    MarkerModel: implausible_marker,
    BoardModel: implausible_board,
    NoiseModel: implausible_noise,
    Systematic: implausible_systematic,
}


def implausible(*parts: object) -> tuple[str, ...]:
    """Doubts about sections of a session's set-up, one sentence each."""
    return tuple(text for part in parts if type(part) in _DOUBTS for text in _DOUBTS[type(part)](part))


def implausible_setup(model: SessionModel) -> tuple[str, ...]:
    """Doubts about a session's set-up."""
    parts = (model.probe, model.stage, model.camera, model.marker, model.board, model.noise, model.systematic)
    return (*implausible(*parts), *implausible_targets(model.targets_mm), *_of_rig(model))


def _of_rig(model: SessionModel) -> Iterator[str]:
    if model.rig is not None:
        yield from implausible_rig(model.rig, "rig" if model.rig_file is None else model.rig_file.name)


def implausible_measurements(measurements: Measurements) -> tuple[str, ...]:
    """Doubts about the unit of poses, spots, ranges and known points, by their medians."""
    shots: tuple[Aim | Pair, ...] = (*measurements.aims, *measurements.pairs)
    seen = [pair.spot.camera_p_mm for pair in measurements.pairs if pair.spot is not None]
    points, shown = ([getattr(point, name) for point in measurements.points] for name in ("camera_p_mm", "trus_p_mm"))
    return (
        *implausible_distances(
            [shot.marker.camera_T_marker for shot in shots],
            [aim.camera_p_spot_mm for aim in measurements.aims],
            [pair.look.range_mm for pair in measurements.pairs],
        ),
        *_behind("visible spots", [float(point[2]) for point in seen]),
        *_behind("known points", [float(point[2]) for point in points]),
        *_median(DISTANCE, "spot.camera_p_mm", (float(np.linalg.norm(point)) for point in seen)),
        *_median(DISTANCE, "point.camera_p_mm", (float(np.linalg.norm(point)) for point in points)),
        *_median(FROM_AXIS, "point.trus_p_mm", (float(np.linalg.norm(point[1:])) for point in shown)),
    )


def implausible_distances(
    camera_T_marker: Sequence[FloatArray], camera_p_spot_mm: Sequence[FloatArray], range_mm: Sequence[float]
) -> tuple[str, ...]:
    """Doubts about the unit of marker poses (4, 4), spots (3,) and ranges, by their medians, and about their side."""
    return (
        *_behind("marker poses", [float(pose[2, 3]) for pose in camera_T_marker]),
        *_behind("spots", [float(spot[2]) for spot in camera_p_spot_mm]),
        *_median(DISTANCE, "camera_T_marker", (_length(pose) for pose in camera_T_marker)),
        *_median(DISTANCE, "camera_p_spot_mm", (float(np.linalg.norm(spot)) for spot in camera_p_spot_mm)),
        *_median(RANGE, "range_mm", range_mm),
    )


def _behind(what: str, depth_mm: Sequence[float]) -> list[str]:
    """Points behind the camera, which it cannot have seen."""
    count = sum(depth < 0.0 for depth in depth_mm)
    if not count:
        return []
    return [f"{count} of {len(depth_mm)} {what} lie behind the camera: check the direction of the transforms, and z"]


def _length(a_T_b: FloatArray) -> float:
    return float(np.linalg.norm(a_T_b[:3, 3]))


def _median(plausible: Plausible, key: str, values: Iterable[float]) -> list[str]:
    listed = list(values)
    return plausible.doubt(f"median of {key}", float(np.median(listed))) if listed else []


def _worst(plausible: Plausible, key: str, values: FloatArray) -> list[str]:
    """The first doubt of several values of one key."""
    return next((found for value in values.ravel().tolist() if (found := plausible.doubt(key, value))), [])
