"""``session.yaml``: how a session was set up. Degrees in the file become radians here.

Required: ``format``, ``probe`` without ``channels``, ``image`` and ``sensitivity.curve``, and ``stage.step_deg``.
Defaults: ``name`` the folder's; ``limits_deg`` [-60, 60]; ``direction`` 1; ``zero_deg`` 0; ``channels.t0_us`` and
``pulse_delay_us`` 0; ``marker_T_tag`` identity; ``noise`` as in NoiseModel; ``targets_mm`` those of
``default_targets_mm``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fgreg.errors import InputError
from fgreg.frames import FloatArray, as_float_array
from fgreg.models import (
    BoardModel,
    CameraModel,
    ChannelModel,
    CharucoModel,
    ImageModel,
    MarkerModel,
    NoiseModel,
    ProbeModel,
    SensitivityModel,
    SessionModel,
    StageModel,
    StereoRig,
    TagModel,
    default_targets_mm,
)
from fgreg.session.schema import (
    MAX_TRANSLATION_MM,
    NOISE_MM,
    NOT_NEGATIVE,
    POSITIVE_MM,
    Bounds,
    Fields,
    Place,
    read_numbers,
    shown,
)

SESSION_FORMAT = "fgreg-session/1"

SCAN_DEG = Bounds(-180.0, 180.0, unit="deg")
RANGE_MM = Bounds(0.0, 300.0, above=True, unit="mm")
LATERAL_MM = Bounds(-200.0, 200.0, unit="mm")
COORDINATE_MM = Bounds(-MAX_TRANSLATION_MM, MAX_TRANSLATION_MM, unit="mm")

_DEPTH_MM = Bounds(0.0, 300.0, unit="mm")
_HALF_WIDTH_DEG = Bounds(0.0, 45.0, above=True, unit="deg")
_POSITIVE = Bounds(0.0, 1e6, above=True)
_MICROSECONDS = Bounds(-1e6, 1e6, unit="us")
_PIXELS = Bounds(-1e5, 1e5, unit="px")

_TOP = (
    "format",
    "name",
    "probe",
    "stage",
    "camera",
    "marker",
    "board",
    "noise",
    "initial",
    "targets_mm",
)
_PROBE = ("elements", "pitch_mm", "flip", "radius_mm", "sound_speed_m_s", "sensitivity", "channels", "image")
_NOISE = (
    "marker_translation_mm",
    "marker_rotation_rad",
    "marker_bias_mm",
    "aim_mm",
    "lateral_mm",
    "range_mm",
    "scan_deg",
)

_DICTIONARY_SIZES = {
    **{f"DICT_{n}X{n}_{count}": count for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "DICT_ARUCO_ORIGINAL": 1024,
    **dict.fromkeys(("DICT_ARUCO_MIP_36h12", "DICT_ARUCO_MIP_36H12"), 250),
    **dict.fromkeys(("DICT_APRILTAG_16h5", "DICT_APRILTAG_16H5"), 30),
    **dict.fromkeys(("DICT_APRILTAG_25h9", "DICT_APRILTAG_25H9"), 35),
    **dict.fromkeys(("DICT_APRILTAG_36h10", "DICT_APRILTAG_36H10"), 2320),
    **dict.fromkeys(("DICT_APRILTAG_36h11", "DICT_APRILTAG_36H11"), 587),
}
"""OpenCV's predefined dictionaries and how many tags each has."""

_NAME = re.compile(r"\S(.{0,198}\S)?")


@dataclass(frozen=True, slots=True)
class Setup:
    """What could be read of ``session.yaml``: the model where all of it was right, else the parts that were.

    ``present`` holds the dotted names of the sections that are there, right or wrong, so that events which need one
    are not reported as well where it is only misspelt inside.
    """

    model: SessionModel | None
    present: frozenset[str]
    probe: ProbeModel | None
    camera: StereoRig | None
    board: BoardModel | None
    warnings: tuple[str, ...]


def read_setup(data: Mapping[str, object], file: str, default_name: str, problems: list[InputError]) -> Setup:
    """Reads the mapping of a ``session.yaml``; appends to ``problems`` all that is wrong with it.

    Args:
        data: as :func:`fgreg.session.safe_yaml.load_yaml` gives it.
        file: how messages name the file.
        default_name: the session's name where the file has none.
    """
    top = Fields(data, _TOP, Place(file), problems)
    top.text("format", SESSION_FORMAT, allowed=(SESSION_FORMAT,))
    name = top.text("name", "a text", default=default_name)
    if name and (not _NAME.fullmatch(name) or not name.isprintable()):
        top.fail("name" if top.has("name") else "", shown(name), "a name of at most 200 printable characters")
    probe = _probe(top)
    stage = _stage(top)
    camera = _camera(top) if top.has("camera") else None
    marker = _marker(top) if top.has("marker") else None
    board = _board(top) if top.has("board") else None
    noise = _noise(top) if top.has("noise") else NoiseModel()
    initial = top.child("initial", ("trus_T_camera", "marker_T_laser")) if top.has("initial") else None
    trus_T_camera = initial.transform("trus_T_camera") if initial and initial.has("trus_T_camera") else None
    marker_T_laser = initial.transform("marker_T_laser") if initial and initial.has("marker_T_laser") else None
    targets_mm = _targets(top) if top.has("targets_mm") else None

    def make() -> SessionModel:
        if probe is None or stage is None or noise is None:
            raise AssertionError("a part is missing without a problem")
        return SessionModel(
            name=name,
            probe=probe,
            stage=stage,
            noise=noise,
            targets_mm=default_targets_mm(probe.radius_mm) if targets_mm is None else targets_mm,
            camera=camera,
            marker=marker,
            board=board,
            initial_trus_T_camera=trus_T_camera,
            initial_marker_T_laser=marker_T_laser,
        )

    return Setup(
        model=top.build(make),
        present=_present(data) | top.misspelt,
        probe=probe,
        camera=camera,
        board=board,
        warnings=tuple(_warnings(file, probe, camera, marker, board)),
    )


def _present(data: Mapping[str, object]) -> frozenset[str]:
    names = set(data)
    for section in ("probe", "camera"):
        inner = data.get(section)
        if isinstance(inner, Mapping):
            names |= {f"{section}.{key}" for key in inner}
    # A section that is not there or no section is one problem, not one more for each event that needs a part of it.
    if not isinstance(data.get("probe"), Mapping):
        names.add("probe.channels")
    if not isinstance(data.get("camera"), Mapping):
        names.add("camera.right")
    return frozenset(names)


def _probe(top: Fields) -> ProbeModel | None:
    fields = top.child("probe", _PROBE)
    if fields is None:
        return None
    elements = fields.integer("elements", 1, 65536)
    pitch_mm = fields.number("pitch_mm", Bounds(1e-3, 100.0, unit="mm"))
    flip = fields.boolean("flip")
    radius_mm = fields.number("radius_mm", POSITIVE_MM)
    sound_speed = fields.number("sound_speed_m_s", Bounds(0.0, 1e5, above=True, unit="m/s"))
    sensitivity = _sensitivity(fields)
    channels = _channels(fields) if fields.has("channels") else None
    image = _image(fields) if fields.has("image") else None

    def make() -> ProbeModel:
        if sensitivity is None:
            raise AssertionError("a part is missing without a problem")
        return ProbeModel(elements, pitch_mm, flip, radius_mm, sound_speed, sensitivity, channels, image)

    return fields.build(make)


def _sensitivity(probe: Fields) -> SensitivityModel | None:
    fields = probe.child("sensitivity", ("depth_mm", "half_width_deg", "edge_sigma_deg", "curve"))
    if fields is None:
        return None
    depth_mm = fields.numbers("depth_mm", None, _DEPTH_MM)
    half_width_deg = fields.numbers("half_width_deg", None, _HALF_WIDTH_DEG)
    edge_sigma_deg = fields.number("edge_sigma_deg", Bounds(0.0, 45.0, unit="deg"))
    if fields.ok:
        _check_table(fields, "depth_mm", depth_mm, "half_width_deg", half_width_deg)
    curve = fields.child("curve", ("rotation_deg", "amplitude")) if fields.has("curve") else None
    rotation_deg = amplitude = None
    if curve is not None:
        rotation_deg = curve.numbers("rotation_deg", None, Bounds(-90.0, 90.0, unit="deg"))
        amplitude = curve.numbers("amplitude", None, NOT_NEGATIVE)
        if curve.ok:
            _check_table(curve, "rotation_deg", rotation_deg, "amplitude", amplitude)
            if not amplitude.any():
                curve.fail("amplitude", "only zeros", "at least one number > 0")
    return fields.build(
        lambda: SensitivityModel(
            depth_mm=depth_mm,
            half_width_rad=as_float_array(np.radians(half_width_deg)),
            edge_sigma_rad=math.radians(edge_sigma_deg),
            curve_rotation_rad=None if rotation_deg is None else as_float_array(np.radians(rotation_deg)),
            curve_amplitude=amplitude,
        )
    )


def _check_table(fields: Fields, over: str, abscissa: FloatArray, key: str, ordinate: FloatArray) -> None:
    if (np.diff(abscissa) <= 0).any():
        fields.fail(over, "numbers that do not increase", "each number larger than the one before")
    if abscissa.size != ordinate.size:
        fields.fail(key, f"{ordinate.size} numbers", f"{abscissa.size}, one for each in {over}")


def _channels(probe: Fields) -> ChannelModel | None:
    fields = probe.child("channels", ("sampling_mhz", "t0_us", "pulse_delay_us"))
    if fields is None:
        return None
    sampling_mhz = fields.number("sampling_mhz", Bounds(0.1, 1e4, unit="MHz"))
    t0_us = fields.number("t0_us", _MICROSECONDS, default=0.0)
    pulse_delay_us = fields.number("pulse_delay_us", _MICROSECONDS, default=0.0)
    return fields.build(lambda: ChannelModel(sampling_mhz, t0_us, pulse_delay_us))


def _image(probe: Fields) -> ImageModel | None:
    fields = probe.child("image", ("pixel_mm", "origin_mm"))
    if fields is None:
        return None
    pixel = fields.numbers("pixel_mm", 2, POSITIVE_MM)
    origin = fields.numbers("origin_mm", 2, COORDINATE_MM)
    return fields.build(
        lambda: ImageModel((float(pixel[0]), float(pixel[1])), (float(origin[0]), float(origin[1]))),
    )


def _stage(top: Fields) -> StageModel | None:
    fields = top.child("stage", ("step_deg", "limits_deg", "direction", "zero_deg"))
    if fields is None:
        return None
    step_deg = fields.number("step_deg", Bounds(0.0, 180.0, above=True, unit="deg"))
    limits_deg = as_float_array([-60.0, 60.0])
    if fields.has("limits_deg"):
        limits_deg = fields.numbers("limits_deg", 2, SCAN_DEG)
        if fields.ok and limits_deg[0] >= limits_deg[1]:
            fields.fail("limits_deg", shown(limits_deg.tolist()), "the lower limit, then the upper one")
    direction = fields.choice("direction", (1, -1), default=1)
    zero_deg = fields.number("zero_deg", SCAN_DEG, default=0.0)
    return fields.build(
        lambda: StageModel(
            step_rad=math.radians(step_deg),
            limits_device_rad=(math.radians(limits_deg[0]), math.radians(limits_deg[1])),
            direction=direction,
            zero_device_rad=math.radians(zero_deg),
        )
    )


def _camera(top: Fields) -> StereoRig | None:
    fields = top.child("camera", ("image_size", "left", "right", "right_T_left"))
    if fields is None:
        return None
    size = (1, 1)
    width_height = [_pixel_count(entry, place, fields) for entry, place in fields.items("image_size", _IMAGE_SIZE)]
    if len(width_height) == 2:
        size = (width_height[0], width_height[1])
    elif width_height:
        fields.fail("image_size", f"{len(width_height)} entries", _IMAGE_SIZE)
    left = _one_camera(fields, "left", size)
    right = _one_camera(fields, "right", size) if fields.has("right") else None
    right_T_left = fields.transform("right_T_left") if fields.has("right_T_left") else None
    if fields.has("right") != fields.has("right_T_left"):
        absent = "right" if fields.has("right_T_left") else "right_T_left"
        fields.fail(absent, "nothing", "right and right_T_left together")

    def make() -> StereoRig:
        if left is None:
            raise AssertionError("a part is missing without a problem")
        return StereoRig(left, right, right_T_left)

    return fields.build(make)


_IMAGE_SIZE = "[width, height], two integers from 1 to 32768"


def _pixel_count(value: object, place: Place, fields: Fields) -> int:
    if type(value) is not int or not 1 <= value <= 32768:
        fields.problems.append(InputError(str(place), shown(value), "an integer from 1 to 32768"))
        return 1
    return value


def _one_camera(camera: Fields, key: str, size: tuple[int, int]) -> CameraModel | None:
    fields = camera.child(key, ("matrix", "distortion"))
    if fields is None:
        return None
    matrix = fields.matrix("matrix", 3)
    if matrix is not None and not _is_pinhole(matrix):
        fields.fail("matrix", _rows_shown(matrix), "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px with fx, fy > 0")
    distortion = fields.numbers("distortion", 5, Bounds(-1e4, 1e4))
    return fields.build(lambda: CameraModel(size, as_float_array(matrix), distortion))


def _is_pinhole(matrix: FloatArray) -> bool:
    zeros = (matrix[0, 1], matrix[1, 0], matrix[2, 0], matrix[2, 1])
    return bool(
        matrix[0, 0] > 0
        and matrix[1, 1] > 0
        and all(abs(v) <= 1e-9 for v in zeros)
        and abs(matrix[2, 2] - 1.0) <= 1e-9
        and np.abs(matrix).max() <= _PIXELS.high
    )


def _rows_shown(matrix: FloatArray) -> str:
    return "[" + ", ".join("[" + ", ".join(f"{v:g}" for v in row) + "]" for row in matrix) + "]"


def _dictionary(fields: Fields) -> str:
    return fields.text("dictionary", "an OpenCV dictionary such as DICT_4X4_50", allowed=tuple(_DICTIONARY_SIZES))


def _marker(top: Fields) -> MarkerModel | None:
    fields = top.child("marker", ("dictionary", "tags"))
    if fields is None:
        return None
    dictionary = _dictionary(fields)
    largest = _DICTIONARY_SIZES.get(dictionary, 1_000_000) - 1
    tags: list[TagModel] = []
    for tag in fields.children("tags", ("id", "size_mm", "marker_T_tag")):
        identity = tag.integer("id", 0, largest)
        size_mm = tag.number("size_mm", POSITIVE_MM)
        marker_T_tag = tag.transform("marker_T_tag") if tag.has("marker_T_tag") else as_float_array(np.eye(4))
        if tag.ok and any(other.id == identity for other in tags):
            tag.fail("id", f"{identity} again", "each id once")
        if tag.ok:
            tags.append(TagModel(identity, size_mm, marker_T_tag))
    return fields.build(lambda: MarkerModel(dictionary, tuple(tags)))


def _board(top: Fields) -> BoardModel | None:
    fields = top.child("board", ("columns", "rows", "square_mm", "charuco"))
    if fields is None:
        return None
    # OpenCV finds plain chessboards from 3 x 3 inner corners on.
    smallest = 2 if fields.has("charuco") else 3
    columns = fields.integer("columns", smallest, 200)
    rows = fields.integer("rows", smallest, 200)
    square_mm = fields.number("square_mm", POSITIVE_MM)
    if fields.ok and not fields.has("charuco") and (columns + rows) % 2 == 0:
        found = f"{columns} x {rows} inner corners, the same when turned by half a turn"
        fields.fail("", found, "columns + rows odd, or a charuco board")
    charuco = None
    if fields.has("charuco"):
        inner = fields.child("charuco", ("dictionary", "marker_mm"))
        if inner is not None:
            dictionary = _dictionary(inner)
            marker_mm = inner.number("marker_mm", POSITIVE_MM)
            if inner.ok and fields.ok:
                if marker_mm >= square_mm:
                    inner.fail("marker_mm", shown(marker_mm), f"less than square_mm, {square_mm:g} mm")
                needed = _charuco_markers(columns, rows)
                if needed > _DICTIONARY_SIZES[dictionary]:
                    inner.fail("dictionary", dictionary, f"one of at least {needed} markers, as the board has")
            charuco = inner.build(lambda: CharucoModel(dictionary, marker_mm))
    return fields.build(lambda: BoardModel(columns, rows, square_mm, charuco))


def _charuco_markers(columns: int, rows: int) -> int:
    """Markers on a board of (columns + 1) x (rows + 1) squares: one on every white square."""
    return (columns + 1) * (rows + 1) // 2


def _noise(top: Fields) -> NoiseModel | None:
    fields = top.child("noise", _NOISE)
    if fields is None:
        return None
    default = NoiseModel()

    def three(key: str, bounds: Bounds, otherwise: tuple[float, float, float]) -> tuple[float, float, float]:
        if not fields.has(key):
            return otherwise
        values = fields.numbers(key, 3, bounds)
        return float(values[0]), float(values[1]), float(values[2])

    translation = three("marker_translation_mm", NOISE_MM, default.marker_translation_mm)
    rotation = three("marker_rotation_rad", Bounds(0.0, math.pi, unit="rad"), default.marker_rotation_rad)
    aim = three("aim_mm", NOISE_MM, default.aim_mm)
    bias = fields.number("marker_bias_mm", NOISE_MM, default=default.marker_bias_mm)
    lateral = fields.number("lateral_mm", NOISE_MM, default=default.lateral_mm)
    range_mm = fields.number("range_mm", NOISE_MM, default=default.range_mm)
    scan_deg = fields.number("scan_deg", Bounds(0.0, 180.0, unit="deg"), default=math.degrees(default.scan_rad))
    return fields.build(
        lambda: NoiseModel(translation, rotation, bias, aim, lateral, range_mm, math.radians(scan_deg)),
    )


def _targets(top: Fields) -> FloatArray | None:
    entries = top.items("targets_mm", "a list of points [x, y, z] in mm")
    rows = [read_numbers(entry, place, top.problems, 3, COORDINATE_MM) for entry, place in entries]
    return as_float_array(rows, -1, 3) if rows else None


def _warnings(
    file: str,
    probe: ProbeModel | None,
    camera: StereoRig | None,
    marker: MarkerModel | None,
    board: BoardModel | None,
) -> list[str]:
    """What is allowed but hardly meant."""
    out = []
    if probe is not None and not 1300.0 <= probe.sound_speed_m_s <= 1700.0:
        out.append(
            f"{file}: probe.sound_speed_m_s is {probe.sound_speed_m_s:g}; in tissue and water it is 1300 to 1700"
        )
    for side in ("left", "right"):
        model = getattr(camera, side, None)
        if model is not None:
            (width, height), (cx, cy) = model.image_size, model.matrix[:2, 2]
            if not (0 <= cx <= width and 0 <= cy <= height):
                out.append(
                    f"{file}: camera.{side}.matrix has its centre ({cx:g}, {cy:g}) outside {width} x {height} px"
                )
    if marker is not None and board is not None and board.charuco is not None:
        on_board = _charuco_markers(board.columns, board.rows)
        if board.charuco.dictionary == marker.dictionary and any(tag.id < on_board for tag in marker.tags):
            out.append(f"{file}: marker.tags share ids with the board: one may be taken for the other")
    return out
