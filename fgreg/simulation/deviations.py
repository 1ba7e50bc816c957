"""How far the rig's constants are from what the session declares: true less declared, by name or drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fgreg.geometry.rig import Constant
from fgreg.geometry.transforms import FloatArray
from fgreg.model.systematic import TEXTS
from fgreg.simulation.config import SimulationConfig

NAMES: dict[str, Constant] = {text.name: constant for constant, text in zip(Constant, TEXTS, strict=True)}
"""Constants by the name that files have for their standard deviation: a key of ``systematic``, with an index."""
OTHERS: dict[str, tuple[str, float]] = {
    "water_mm": ("water_mm", 1.0),
    "beam_offset_mm": ("beam_offset_mm", 1.0),
    "window_deg": ("edge_jitter_rad", math.radians(1.0)),
    "slip_deg": ("stage_slip_rad", math.radians(1.0)),
    "camera_move_mm": ("camera_move_mm", 1.0),
}
"""What else may differ from the declaration, by name: field of the configuration, and its unit in that of the name."""


def with_deviations(config: SimulationConfig, values: Mapping[str, float]) -> SimulationConfig:
    """A configuration whose truth differs by values that are named as in :data:`NAMES` or :data:`OTHERS`.

    Raises:
        ValueError: nothing has a name.
    """
    fields = {OTHERS[name][0]: value * OTHERS[name][1] for name, value in values.items() if name in OTHERS}
    constants = deviations_of({name: value for name, value in values.items() if name not in OTHERS})
    return replace(config, deviations={**config.deviations, **constants}, **fields)  # type: ignore[arg-type]


def deviations_of(values: Mapping[str, float]) -> dict[Constant, float]:
    """Deviations by the names and in the units of files (degrees).

    Raises:
        ValueError: there is no constant of a name.
    """
    out: dict[Constant, float] = {}
    for name, value in values.items():
        if name not in NAMES:
            raise ValueError(f"{name} is nothing that may be off; there are {', '.join([*NAMES, *OTHERS])}")
        out[NAMES[name]] = value / TEXTS[NAMES[name]].per_unit
    return out


def named(deviations: Mapping[Constant, float]) -> dict[str, float]:
    """The same the other way round: names and units of files."""
    return {TEXTS[constant].name: value * TEXTS[constant].per_unit for constant, value in sorted(deviations.items())}


def drawn_deviations(sigmas: FloatArray, rng: np.random.Generator) -> dict[Constant, float]:
    """All constants, drawn from their standard deviations (COUNT,), as ``SessionModel.constant_sigmas`` has them."""
    values = np.asarray(sigmas) * rng.standard_normal(len(Constant))
    return {constant: float(value) for constant, value in zip(Constant, values, strict=True)}
