"""The cells of tools/study_systematics.py: in what a lab differs from what its session declares."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, replace

import numpy as np

from fgreg.geometry.rig import CAMERA, Constant
from fgreg.geometry.transforms import as_float_array
from fgreg.model.camera_model import StereoRig
from fgreg.model.session_model import NoiseModel
from fgreg.model.systematic import Systematic
from fgreg.simulation.config import SimulationConfig, Sweep, default_rig
from fgreg.simulation.deviations import NAMES, deviations_of, drawn_deviations
from fgreg.simulation.presets import FIRST_HIT, PHANTOM

LIMIT_MM = 3.0
WITHIN = ("as-declared", "drawn", "drawn-poses", "drawn-checks")
"""Kinds of a lab that is within its budget."""
NOISES = {
    "frames": NoiseModel((0.001, 0.001, 0.002), (5e-5, 5e-5, 5e-5), 0.0, (0.3, 0.3, 0.1), 0.24, 0.16),
    "published": NoiseModel(marker_bias_mm=0.1),
}
"""Bounds of 1.3 mm with 15 pairs (frames) and 2.2 mm with 25 (published) at the worst target, nothing off (RMS)."""
RAW = "raw"
POSES = replace(FIRST_HIT, camera_distance_mm=(105.0, 135.0), marker_distance_mm=(45.0, 160.0))
"""Errors that grow with distance (scales) are those of a camera some 120 mm off; raw frames are from 155."""
PAIRS = (10, 15, 25)
CAREFUL = {
    "radius_mm": 0.2,
    "range_offset_mm": 0.15,
    "sound_speed": 0.005,
    "array_tilt_deg[0]": 0.2,
    "array_tilt_deg[1]": 0.2,
    "array_tilt_deg[2]": 0.2,
    "array_offset_mm": 0.15,
    "window_centre_deg": 0.3,
    "tag_size": 0.002,
    "focal[0]": 0.002,
    "focal[1]": 0.002,
    "backlash_deg": 0.1,
}


@dataclass(frozen=True, slots=True)
class Row:
    """One thing that is wrong.

    Attributes:
        off: constants by name, in the files' units; with a random sign where ``either``.
        changes: further fields of the simulation.
        camera: the session has the camera, whose errors act through the detection's corners.
        most: aim, of the share ``ok`` beyond its bound (and beyond 3 mm where ``far``), in percent.
        far: its error exceeds 3 mm.
        limit_mm: of the verdict.
    """

    off: dict[str, float]
    changes: dict[str, object]
    camera: bool = False
    either: bool = False
    most: float = 20.0
    far: bool = False
    limit_mm: float = LIMIT_MM


def _off(camera: bool = False, most: float = 20.0, far: bool = False, **off: float) -> Row:
    return Row(off, {}, camera, either=True, most=most, far=far)


def _without_distortion() -> StereoRig:
    rig = default_rig()
    assert rig.right is not None
    left, right = (replace(camera, distortion=as_float_array(np.zeros(5))) for camera in (rig.left, rig.right))
    return replace(rig, left=left, right=right)


ROWS: dict[str, Row] = {
    "radius-1mm": _off(radius_mm=1.0),
    "range-1mm": _off(range_offset_mm=1.0),
    "sound-speed-2%": _off(sound_speed=0.02),
    "array-1mm": _off(array_offset_mm=1.0),
    "tilt-1deg": Row({"array_tilt_deg[0]": 1.0}, {}, either=True),
    "skew-1deg": Row({"array_tilt_deg[1]": 1.0}, {}, either=True),
    "backlash-1deg": _off(backlash_deg=1.0),
    "camera-scale-1%": _off(camera_scale=0.01, most=50.0),
    "tag-1%": _off(tag_size=0.01),
    "tag-3%": Row({"tag_size": -0.03}, {}, most=10.0, far=True),
    "print-3%": Row({"tag_size": -0.03, "board_size": -0.03}, {}, camera=True, most=2.0, far=True),
    "print-4%": Row({"tag_size": -0.04, "board_size": -0.04}, {}, camera=True, most=2.0, far=True),
    "print+4%": Row({"tag_size": 0.04, "board_size": 0.04}, {}, camera=True, most=2.0, far=True),
    "focal-0.5%": Row({"focal[0]": 0.005, "focal[1]": 0.005}, {}, camera=True, either=True),
    "focal-1%": Row({"focal[0]": 0.01, "focal[1]": 0.01}, {}, camera=True, either=True),
    "centre-5px": Row({f"principal_point_px[{i}]": 5.0 for i in range(4)}, {}, camera=True, either=True),
    "no-distortion": Row({}, {"declared_camera": _without_distortion()}, camera=True, most=2.0, far=True),
    "stereo-0.2deg": Row({"stereo_rotation_deg[1]": 0.2}, {}, camera=True, either=True),
    "window-5-7": _off(window_centre_deg=1.0),
    "water-10mm": Row({}, {"water_mm": 10.0}, far=True, most=100.0),
    "water-10mm-3-checks": Row({}, {"water_mm": 10.0, "checks": 3}, far=True, most=10.0),
    "water-10mm-6-checks": Row({}, {"water_mm": 10.0, "checks": 6}, far=True, most=10.0),
    "as-declared-3-checks": Row({}, {"checks": 3}),
    "jump-3mm": Row({}, {"epochs": 2, "camera_move_mm": 3.0, "camera_moves_reported": False}, far=True, most=2.0),
    "jump-3mm-reported": Row({}, {"epochs": 2, "camera_move_mm": 3.0}),
    "move-deleted": Row({}, {"epochs": 2, "camera_moves_reported": False}, far=True, most=2.0),
    "slip-1deg": Row({}, {"stage_slip_rad": math.radians(1.0)}),
    "radius-in-metres": Row({}, {"declared": {"probe.radius_mm": 0.01}}, far=True, most=2.0, limit_mm=10.0),
}
TABLE = (
    "careful/frames/15",
    "radius-1mm/frames/15",
    "range-1mm/frames/15",
    "camera-scale-1%/frames/15",
    "tag-1%/frames/15",
    "tag-3%/published/25",
    "print-3%/frames/15",
    "print-4%/frames/15",
    "print+4%/frames/15",
    "focal-0.5%/frames/15",
    "focal-1%/frames/15",
    "centre-5px/frames/15",
    "stereo-0.2deg/frames/15",
    "window-5-7/frames/15",
    "water-10mm/published/25",
    "jump-3mm/published/25",
    "move-deleted/published/25",
    "radius-in-metres/published/10",
)
"""The cells of the table in docs: what each error costs where constants are taken as exact."""


@dataclass(frozen=True, slots=True)
class Cell:
    """What to simulate."""

    kind: str
    noise: str
    pairs: int
    two_sided: bool = False

    @property
    def name(self) -> str:
        return f"{self.kind}/{self.noise}/{self.pairs}{'/two-sided' if self.two_sided else ''}"

    @property
    def limit_mm(self) -> float:
        return ROWS[self.kind].limit_mm if self.kind in ROWS else LIMIT_MM


def parsed(name: str) -> Cell:
    """A cell by its name.

    Raises:
        SystemExit: it is none.
    """
    kind, _, rest = name.partition("/")
    parts = rest.split("/")
    known = kind in (*WITHIN, "careful") or kind in ROWS or kind[3:] in NAMES
    good = (
        len(parts) in (2, 3) and parts[0] in (*NOISES, RAW) and parts[1].isdigit() and parts[2:] in ([], ["two-sided"])
    )
    if not known or not good:
        raise SystemExit(f"--cells: {name} is no cell; --list names them")
    return Cell(kind, parts[0], int(parts[1]), len(parts) == 3)


def all_cells() -> list[str]:
    """Names of all cells of alternating sweeps, and of the drawn ones two-sided."""
    kinds = [*WITHIN, "careful", *(f"3s-{name}" for name in NAMES), *ROWS]
    names = [f"{kind}/{noise}/{pairs}" for kind in kinds for noise in NOISES for pairs in PAIRS]
    names += [f"drawn/{noise}/{pairs}/two-sided" for noise in NOISES for pairs in PAIRS]
    return names + [
        f"{kind}/raw/15" for kind in ("as-declared", "drawn", *(k for k, row in ROWS.items() if row.camera))
    ]


def configuration(cell: Cell, seed: int, systematic: Systematic) -> SimulationConfig:
    """The simulation of a session of a cell."""
    rng = np.random.default_rng([zlib.crc32(cell.kind.encode()), seed])
    config = replace(
        PHANTOM if cell.noise == RAW else POSES,
        pairs=cell.pairs,
        tracks_heard=0,
        tracks_silent=0,
        noise=NOISES.get(cell.noise, PHANTOM.noise),
        sweep=Sweep.TWO_SIDED if cell.two_sided else Sweep.ALTERNATING,
        systematic=systematic,
    )
    per_pm = replace(config, beam_offset_mm=config.noise.beam_offset_mm, edge_jitter_rad=config.noise.window_rad)
    # The truth is drawn from the defaults whatever the session says of itself.
    sigmas = Systematic().sigmas(config.probe.sensitivity.edge_sigma_rad, config.noise.marker_bias_mm)
    if cell.kind == "as-declared":
        return config
    if cell.kind.startswith("drawn"):
        checks = 3 if cell.kind == "drawn-checks" else 0
        declared = cell.kind != "drawn-poses"
        return replace(per_pm, deviations=drawn_deviations(sigmas, rng), camera_declared=declared, checks=checks)
    if cell.kind == "careful":
        signs = rng.choice([-1.0, 1.0], len(CAREFUL))
        off = {name: float(sign * value) for (name, value), sign in zip(CAREFUL.items(), signs, strict=True)}
        return replace(per_pm, deviations=deviations_of(off), camera_declared=True)
    sign = float(rng.choice([-1.0, 1.0]))
    if cell.kind.startswith("3s-"):
        constant = NAMES[cell.kind[3:]]
        through_camera = constant in list(Constant)[CAMERA]
        value = 3.0 * sign * float(sigmas[constant])
        return replace(config, deviations={constant: value}, camera_declared=through_camera)
    row = ROWS[cell.kind]
    off = {name: value * (sign if row.either else 1.0) for name, value in row.off.items()}
    return replace(config, deviations=deviations_of(off), camera_declared=row.camera, **row.changes)  # type: ignore[arg-type]
