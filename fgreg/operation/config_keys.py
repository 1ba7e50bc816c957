"""The keys of a CONFIG.yaml that are no driver's, and a commented example of all keys."""

from __future__ import annotations

from collections.abc import Iterator

from fgreg.drivers.options import REQUIRED, Key, Kind
from fgreg.drivers.registry import DriverEntry, Role, drivers_of
from fgreg.session.schema import ANY, Bounds
from fgreg.simulation.room import BUMP_EVERY_S

LIVE_FORMAT = "fgreg-live/1"
_DEG_S = Bounds(0.0, 30.0, above=True, unit="deg/s")

ROOM_KEYS = (
    Key("seed", Kind.INTEGER, "of everything random in it", 1, Bounds(0, 2**31 - 1)),
    Key("bump_every_s", Kind.NUMBER, "mean time between moves of the camera", BUMP_EVERY_S, Bounds(1.0, 1e9, unit="s")),
    Key("width", Kind.INTEGER, "of its camera's images, px", 640, Bounds(160, 1920)),
)
CALIBRATION_KEYS = (
    Key("left", Kind.FILE, "ROS camera_info, OpenCV FileStorage or Kalibr camchain", example="calibration.yaml"),
    Key("right", Kind.FILE, "the right camera's, or OpenCV's extrinsics", None, example="right.yaml"),
    Key("unit", Kind.CHOICE, "of its lengths; m for ROS and Kalibr, mm for OpenCV", None, ANY, ("m", "mm"), "m"),
    Key(
        "pictures",
        Kind.CHOICE,
        "rectified: they come rectified with it; rectify: do that here",
        "raw",
        choices=("raw", "rectified", "rectify"),
    ),
    Key("of_fields", Kind.TRUTH, "it is that of the single fields of interlaced frames", False),
)
LIMIT_KEYS = (
    Key("home_speed_deg_s", Kind.NUMBER, "highest speed to the zero position", 10.0, _DEG_S),
    Key("search_speed_deg_s", Kind.NUMBER, "highest speed of a search", 10.0, _DEG_S),
    Key("track_speed_deg_s", Kind.NUMBER, "highest speed after the beam", 10.0, _DEG_S),
    Key("track_sigma_deg", Kind.NUMBER, "least certain answer that is followed", 2.0, Bounds(0.0, 10.0, True, "deg")),
    Key("marker_age_s", Kind.NUMBER, "oldest marker that is followed", 0.2, Bounds(0.0, 0.2, True, "s")),
    Key("request_s", Kind.NUMBER, "an operator's request ends after", 600.0, Bounds(1.0, 3600.0, unit="s")),
)
"""Besides these: ``sweep_deg``, and what session.yaml says of the stage."""
SETTING_KEYS = (
    Key("aims", Kind.INTEGER, "calibration shots", 8, Bounds(0, 1000)),
    Key("pms", Kind.INTEGER, "PMs after which the stage may follow", 8, Bounds(1, 1000)),
    Key("most_pms", Kind.INTEGER, "the same where the verdict is a warning", 15, Bounds(1, 1000)),
    Key("follow", Kind.TRUTH, "whether the stage follows the beam at all", True),
    Key("holder_sigma_mm", Kind.NUMBER, "of a move, by motion's account", 2.0, Bounds(0.0, 100.0, True, "mm")),
    Key("holder_sigma_deg", Kind.NUMBER, "the same, of its rotation", 1.0, Bounds(0.0, 30.0, True, "deg")),
    Key("holder_least_mm", Kind.NUMBER, "a smaller shift of the view is none", 1.0, Bounds(0.0, 10.0, True, "mm")),
    Key("camera_latency_s", Kind.NUMBER, "from exposure to arrival, at best", 0.0, Bounds(0.0, 1.0, unit="s")),
    Key("pulse_latency_s", Kind.NUMBER, "from laser pulse to arrival, at best", 0.0, Bounds(0.0, 1.0, unit="s")),
    Key("holder_latency_s", Kind.NUMBER, "the same of motion's samples", 0.0, Bounds(0.0, 1.0, unit="s")),
    Key("limit_mm", Kind.NUMBER, "predicted error up to which the verdict is ok", 3.0, Bounds(0.0, 100.0, True, "mm")),
)
THRESHOLD = Key(
    "hearing_threshold",
    Kind.NUMBER,
    "least amplitude that counts as heard, in the source's unit",
    bounds=Bounds(0.0, 1e12, above=True),
    example="20.0",
)

_ROLES = {
    Role.CAMERA: "The endoscope.",
    Role.PHOTOACOUSTIC: "What the probe hears, once for each laser pulse.",
    Role.STAGE: "The stage that turns the probe; without it nothing turns.",
    Role.MOTION: "What the endoscope's holder knows of its motion.",
    Role.BMODE: "Pictures of a scanner, to show with the rest.",
    Role.SINKS: "Who is told the registration; any number.",
    Role.OPERATOR: "Who says what is to be done; a list where there are several.",
}
_ABSENT = (Role.MOTION, Role.BMODE)
"""Not in the example but as comments."""


def example_config() -> str:
    """A CONFIG.yaml with every key of every driver; what has a default, or is an alternative, is commented out."""
    return "\n".join(_lines()) + "\n"


def _lines() -> Iterator[str]:
    yield "# Devices of a live session: fgreg live CONFIG.yaml; fgreg devices CONFIG.yaml asks each of them."
    yield "# Paths are relative to this file's folder. What is commented out is the default, or an alternative."
    yield f"format: {LIVE_FORMAT}"
    yield "session: session.yaml  # how things are set up; copied into the new session's folder"
    yield ""
    yield "# calibration:  # of the endoscope, where session.yaml has no camera"
    yield from (f"#   {key.line()}" for key in CALIBRATION_KEYS)
    yield ""
    yield "# room:  # the simulated room: camera, photoacoustic and stage have the driver simulated; no session then"
    yield from (f"#   {key.line()}" for key in ROOM_KEYS)
    for role, text in _ROLES.items():
        yield ""
        yield f"# {text}"
        first, *others = drivers_of(role).values()
        yield from _entry(role, first, commented=role in _ABSENT)
        for other in others:
            yield from _entry(role, other, commented=True)
    yield ""
    yield "settings:"
    yield f"  {THRESHOLD.line()}"
    yield from (f"  # {key.line()}" for key in SETTING_KEYS)


def _entry(role: Role, entry: DriverEntry, commented: bool) -> Iterator[str]:
    """A driver's keys."""
    extra = f"; pip install 'fgreg[{entry.extra}]'" if entry.extra else ""
    dash, indent = ("- ", "    ") if role is Role.SINKS else ("", "  ")
    lines = [f"{role}:", f"  {dash}driver: {entry.name}  # {entry.help}{extra}"]
    for key in entry.keys:
        shown = key.default is REQUIRED or (role is Role.CAMERA and key.name == "right" and not commented)
        lines.append(f"{indent}{'' if shown else '# '}{key.line()}")
    if role is Role.STAGE and not commented:
        lines.append("  limits:  # besides those of session.yaml")
        lines.append("    # sweep_deg: [-60, 60]  # plane angles that a search may use; all that session.yaml allows")
        first, *rest = LIMIT_KEYS
        lines.append(f"    {first.line()}")
        lines += [f"    # {key.line()}" for key in rest]
    for line in lines:
        yield f"# {line}" if commented else line
