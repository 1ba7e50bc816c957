"""The set-up of a session: probe, stage, cameras, marker, board, noise. Frozen; lengths mm, angles rad.

The classes also describe ``session.yaml``: their types have the keys, bounds and units of the file
(fgreg.schema.record). Each raises ValueError on values that do not fit together; the session reader makes that a line
that names the key.
"""

import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from fgreg.geometry.rig import COUNT
from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.model.camera_model import STEREO_RIG, StereoRig
from fgreg.model.commissioned_rig import CommissionedRig
from fgreg.model.probe_model import ProbeModel, check_positive
from fgreg.model.static_tags import StaticTag, check_static_tags
from fgreg.model.systematic import CAREFUL_LAB, SYSTEMATIC, Systematic
from fgreg.schema.files import FileName
from fgreg.schema.kinds import (
    NOISE_MM,
    POINT_MM,
    POSITIVE_MM,
    SCAN_DEG,
    Integer,
    ListOf,
    Number,
    NumberTuple,
    Text,
    in_radians,
    points,
)
from fgreg.schema.matrices import Transform
from fgreg.schema.problems import FieldError, shown
from fgreg.schema.record import Key, NotStored, record

SESSION_FORMAT = "fgreg-session/1"

DICTIONARY_SIZES = {
    **{f"DICT_{n}X{n}_{count}": count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": 1024,
    **dict.fromkeys(("DICT_ARUCO_MIP_36h12", "DICT_ARUCO_MIP_36H12"), 250),
    **dict.fromkeys(("DICT_APRILTAG_16h5", "DICT_APRILTAG_16H5"), 30),
    **dict.fromkeys(("DICT_APRILTAG_25h9", "DICT_APRILTAG_25H9"), 35),
    **dict.fromkeys(("DICT_APRILTAG_36h10", "DICT_APRILTAG_36H10"), 2320),
    **dict.fromkeys(("DICT_APRILTAG_36h11", "DICT_APRILTAG_36H11"), 587),
}
"""OpenCV's predefined dictionaries and how many tags each has."""

DICTIONARY = Text("an OpenCV dictionary such as DICT_4X4_50", tuple(DICTIONARY_SIZES))


@dataclass(frozen=True, slots=True)
class StageModel:
    """The rotation stage. ``scan`` angles inside are the plane's (TRUS convention); files hold device angles.

    ``scan = direction * (device - zero)``.
    """

    step_rad: Annotated[float, Key("of a sweep", Number(0.0, 180.0, above=True, unit="deg", degrees=True))]
    limits_device_rad: Annotated[
        tuple[float, float], Key("of the device", NumberTuple(2, in_radians(SCAN_DEG)), name="limits_deg")
    ] = (math.radians(-60.0), math.radians(60.0))
    direction: Annotated[
        int,
        Key(
            "-1: the device's positive turn is the other way; +1 turns the plane from +z towards +y",
            Integer(allowed=(1, -1)),
        ),
    ] = 1
    zero_device_rad: Annotated[
        float, Key("device angle at which the plane points along +z", in_radians(SCAN_DEG), name="zero_deg")
    ] = 0.0

    def __post_init__(self) -> None:
        check_positive(step=self.step_rad)
        if self.direction not in (-1, 1):
            raise ValueError(f"direction is {self.direction}, expected 1 or -1")
        if self.limits_device_rad[0] >= self.limits_device_rad[1]:
            limits_deg = [round(math.degrees(limit), 9) for limit in self.limits_device_rad]
            raise FieldError.of(shown(limits_deg), "the lower limit, then the upper one", "limits_deg")

    def scan_from_device(self, device_rad: float) -> float:
        """Plane angle (rad, TRUS convention) of a device angle (rad)."""
        return self.direction * (device_rad - self.zero_device_rad)

    def device_from_scan(self, scan_rad: float) -> float:
        """Device angle (rad) of a plane angle (rad, TRUS convention)."""
        return self.direction * scan_rad + self.zero_device_rad


@dataclass(frozen=True, slots=True, eq=False)
class TagModel:
    """One square tag: id, outer edge of its black border (mm), and its pose on the marker body."""

    id: Annotated[int, Key("in the dictionary", Integer(0, max(DICTIONARY_SIZES.values()) - 1))]
    size_mm: Annotated[float, Key("outer edge of the black border", POSITIVE_MM)]
    marker_T_tag: Annotated[
        FloatArray, Key("where it sits on the marker body", Transform(), default="identity", brief=True)
    ] = field(default_factory=lambda: as_float_array(np.eye(4)))

    def __post_init__(self) -> None:
        check_positive(size_mm=self.size_mm)

    @property
    def marker_p_corners_mm(self) -> FloatArray:
        """(4, 3) corners in the marker frame, in the detector order: top left, top right, bottom right, bottom left."""
        h = self.size_mm / 2.0
        tag_p = np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])
        return np.asarray(tag_p @ self.marker_T_tag[:3, :3].T + self.marker_T_tag[:3, 3])


@dataclass(frozen=True, slots=True, eq=False)
class MarkerModel:
    """The fibre's fiducial: a rigid body of one or many square tags of one OpenCV dictionary."""

    dictionary: Annotated[str, Key("OpenCV's name of it", DICTIONARY)]
    tags: Annotated[tuple[TagModel, ...], Key("one or several on a rigid body")]

    def __post_init__(self) -> None:
        if not self.tags:
            raise ValueError("a marker needs at least one tag")
        largest = DICTIONARY_SIZES.get(self.dictionary, 1_000_000) - 1
        for i, tag in enumerate(self.tags):
            if tag.id > largest:
                raise FieldError.of(str(tag.id), f"an integer from 0 to {largest}", "tags", i, "id")
            if any(other.id == tag.id for other in self.tags[:i]):
                raise FieldError.of(f"{tag.id} again", "each id once", "tags", i, "id")


@dataclass(frozen=True, slots=True)
class CharucoModel:
    """The markers of a ChArUco board: OpenCV dictionary, marker edge (mm), and the pattern.

    The legacy pattern differs where the rows of squares are even: its top left square is white.
    """

    dictionary: Annotated[str, Key("OpenCV's name of it", DICTIONARY)]
    marker_mm: Annotated[float, Key("outer edge of a marker's black border", POSITIVE_MM)]
    legacy: Annotated[bool, Key("the pattern of OpenCV before 4.6", brief=True)] = False


@dataclass(frozen=True, slots=True)
class BoardModel:
    """The calibration board; columns and rows count inner corners."""

    columns: Annotated[int, Key("inner corners along x", Integer(2, 200))]
    rows: Annotated[int, Key("inner corners along y", Integer(2, 200))]
    square_mm: Annotated[float, Key("edge of a square", POSITIVE_MM)]
    charuco: Annotated[CharucoModel | None, Key("absent: a plain chessboard")] = None

    def __post_init__(self) -> None:
        check_positive(square_mm=self.square_mm)
        if self.charuco is None:
            # OpenCV detects plain chessboards of at least 3 x 3 inner corners.
            for key, count in (("columns", self.columns), ("rows", self.rows)):
                if count < 3:
                    raise FieldError.of(str(count), "an integer from 3 to 200", key)
            if (self.columns + self.rows) % 2 == 0:
                # The square at the opposite end of a black corner square is columns + rows squares away: also black.
                found = f"{self.columns} x {self.rows} inner corners, the same when turned by half a turn"
                raise FieldError.of(found, "columns + rows odd, or a charuco board")
        else:
            if self.columns < 2 or self.rows < 2:
                raise ValueError("a board needs at least 2 x 2 inner corners")
            if not self.charuco.marker_mm < self.square_mm:
                expected = f"less than square_mm, {self.square_mm:g} mm"
                raise FieldError.of(shown(self.charuco.marker_mm), expected, "charuco", "marker_mm")
            if self.markers > DICTIONARY_SIZES.get(self.charuco.dictionary, 1_000_000):
                expected = f"one of at least {self.markers} markers, as the board has"
                raise FieldError.of(self.charuco.dictionary, expected, "charuco", "dictionary")

    @property
    def markers(self) -> int:
        """Of a ChArUco board of (columns + 1) x (rows + 1) squares: one on every white square."""
        return (self.columns + 1) * (self.rows + 1) // 2


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Standard deviations to assume where an observation brings no covariance of its own (sessions/README.md)."""

    marker_translation_mm: Annotated[
        tuple[float, float, float], Key("along the camera's x, y, z", NumberTuple(3, NOISE_MM))
    ] = (0.1, 0.1, 0.8)
    marker_rotation_rad: Annotated[
        tuple[float, float, float],
        Key(
            "about axes parallel to the camera's, through the marker's origin",
            NumberTuple(3, Number(0.0, math.pi, unit="rad")),
        ),
    ] = (0.01, 0.01, 0.01)
    marker_bias_mm: Annotated[
        float, Key("per camera axis: one unknown offset of all marker poses of the session", NOISE_MM)
    ] = 0.0
    aim_mm: Annotated[
        tuple[float, float, float],
        Key(
            "beam against spot: board axes for a `corner`, camera axes for `camera_p_spot_mm`", NumberTuple(3, NOISE_MM)
        ),
    ] = (1.0, 1.0, 0.1)
    lateral_mm: Annotated[float, Key("x of a PM", NOISE_MM)] = 0.3
    range_mm: Annotated[float, Key("its range", NOISE_MM)] = 0.2
    scan_rad: Annotated[float, Key("reading of the stage", Number(0.0, 180.0, unit="deg", degrees=True))] = (
        math.radians(0.1)
    )
    beam_offset_mm: Annotated[
        float, Key("per PM: of the sound's origin beside the beam, each axis", NOISE_MM, brief=True)
    ] = 0.15
    spot_mm: Annotated[
        tuple[float, float, float],
        Key(
            "per PM: of the sound's origin against the visible spot, along the camera's x, y, z",
            NumberTuple(3, NOISE_MM),
            brief=True,
        ),
    ] = (0.3, 0.3, 1.0)
    window_rad: Annotated[
        float, Key("per PM: of the window's half width", Number(0.0, 45.0, unit="deg", degrees=True), brief=True)
    ] = math.radians(0.4)


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


def _check_name(name: str) -> None:
    if not re.fullmatch(r"\S(.{0,198}\S)?", name) or not name.isprintable():
        raise FieldError.of(shown(name), "a name of at most 200 printable characters")


NAME = Text(check=_check_name)
"""A session's name."""


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """A named TRUS point at which the error matters."""

    name: Annotated[str, Key("in results and reports", NAME)]
    trus_p_mm: Annotated[FloatArray, Key("where it is", POINT_MM)]


@dataclass(frozen=True, slots=True, eq=False)
class SessionModel:
    """The set-up of a session: the contents of ``session.yaml``; ``targets_mm`` (n, 3)."""

    name: Annotated[str, Key("of the session", NAME, default="the folder's")]
    probe: Annotated[ProbeModel, Key("the TRUS probe")]
    stage: Annotated[StageModel, Key("the stage that turns it")]
    camera: Annotated[StereoRig | None, Key("the endoscope", STEREO_RIG)] = None
    marker: Annotated[MarkerModel | None, Key("the fibre's fiducial")] = None
    board: Annotated[BoardModel | None, Key("the calibration board")] = None
    noise: Annotated[
        NoiseModel, Key("standard deviations where an observation brings no covariance", default="those below")
    ] = field(default_factory=NoiseModel)
    initial_trus_T_camera: Annotated[
        FloatArray | None, Key("a guess of the registration", Transform(), name="initial.trus_T_camera")
    ] = None
    initial_marker_T_laser: Annotated[
        FloatArray | None, Key("a guess of the beam on the marker", Transform(), name="initial.marker_T_laser")
    ] = None
    targets_mm: Annotated[
        FloatArray,
        Key(
            "TRUS points at which the error matters",
            points(POINT_MM),
            default="27 points: x -20, 0, 20; stage angle -30, 0, 30 deg; 22, 32, 42 mm beyond the probe's radius",
        ),
    ] = field(default_factory=lambda: as_float_array(np.zeros((0, 3))))
    targets: Annotated[
        tuple[Target, ...],
        Key("the same with names, instead of `targets_mm`", ListOf(record(Target)), brief=True),
    ] = ()
    static_tags: Annotated[
        tuple[StaticTag, ...],
        Key(
            "fixed to patient or table, for camera moves; where they are is learnt from the views",
            ListOf(record(StaticTag)),
            brief=True,
        ),
    ] = ()
    systematic: Annotated[
        Systematic,
        Key(
            "standard deviations of the constants above, or `none`",
            SYSTEMATIC,
            default="those of a careful lab",
            brief=True,
        ),
    ] = CAREFUL_LAB

    rig_file: Annotated[
        Path | None,
        Key("rig.yaml of a commissioning, in the session's folder: replaces the above", FileName(), name="rig"),
    ] = None
    rig: Annotated[CommissionedRig | None, NotStored(None)] = None

    def __post_init__(self) -> None:
        if self.targets:
            self._take_named_targets()
        if self.static_tags:
            self._check_static_tags()
        if not len(self.targets_mm):
            object.__setattr__(self, "targets_mm", default_targets_mm(self.probe.radius_mm))
        if not self.systematic.declared and (self.rig_file is not None or self.rig is not None):
            # All constants exact, and some of them with the rig's covariance: one of the two is not meant.
            raise FieldError.of(
                "none beside a rig", "one of the two, since a rig has standard deviations", "systematic"
            )

    def _check_static_tags(self) -> None:
        if self.marker is None:
            raise FieldError.of("them without a marker", "a marker, whose dictionary they are of", "static_tags")
        taken = {tag.id: "a tag of the marker" for tag in self.marker.tags}
        charuco = None if self.board is None else self.board.charuco
        if self.board is not None and charuco is not None and charuco.dictionary == self.marker.dictionary:
            taken |= dict.fromkeys(range(self.board.markers), "a marker of the board")
        check_static_tags(self.static_tags, taken, DICTIONARY_SIZES.get(self.marker.dictionary, 1_000_000) - 1)

    def _take_named_targets(self) -> None:
        named = as_float_array([target.trus_p_mm for target in self.targets])
        if len(self.targets_mm) and not np.array_equal(self.targets_mm, named):
            raise FieldError.of("it together with targets_mm", "one of the two", "targets")
        names = self.target_names
        for i, name in enumerate(names):
            if name in names[:i]:
                raise FieldError.of(f"{shown(name)} again", "each name once", "targets", i, "name")
        object.__setattr__(self, "targets_mm", named)

    @property
    def target_names(self) -> tuple[str, ...]:
        """One per target: its name, else its number from 1."""
        if self.targets:
            return tuple(target.name for target in self.targets)
        return tuple(str(number) for number in range(1, len(self.targets_mm) + 1))

    @property
    def noise_per_pm(self) -> NoiseModel:
        """The noise, without that from PM to PM where the session declares no systematic errors at all."""
        return self.noise if self.systematic.declared else replace(self.noise, beam_offset_mm=0.0, window_rad=0.0)

    @property
    def constant_sigmas(self) -> FloatArray:
        """(COUNT,) standard deviations of the rig's constants, in the order of :class:`Constant`."""
        declared = self.systematic.sigmas(self.probe.sensitivity.edge_sigma_rad, self.noise.marker_bias_mm)
        if self.rig is not None:
            declared[list(self.rig.constants)] = self.rig.sigma
        return declared

    @property
    def constant_means(self) -> FloatArray:
        """(COUNT,) what the constants are expected to be: zero, as declared, without a commissioned rig."""
        means = np.zeros(COUNT)
        if self.rig is not None:
            means[list(self.rig.constants)] = self.rig.value
        return means

    @property
    def constant_correlation(self) -> FloatArray | None:
        """(COUNT, COUNT) correlation of the constants; None, without a commissioned rig: they are independent."""
        if self.rig is None:
            return None
        correlation = np.eye(COUNT)
        correlation[np.ix_(self.rig.constants, self.rig.constants)] = self.rig.correlation
        return correlation


SESSION = record(SessionModel, ("format", SESSION_FORMAT))
"""``session.yaml``."""
