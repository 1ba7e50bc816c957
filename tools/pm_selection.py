"""Subsets of a packed problem's PMs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgreg.geometry.transforms import BoolArray, IntArray
from fgreg.graph.packing import BeamArrays, LookArrays, PackedProblem, RotationShapes
from fgreg.graph.visible_spots import SpotArrays
from fgreg.model.sensitivity import WindowShapes


def select_pms(problem: PackedProblem, index: IntArray) -> PackedProblem:
    """The problem with some of its PMs only (increasing indices)."""
    place = np.full(len(problem.pms), -1, dtype=np.int64)
    place[index] = np.arange(len(index))
    beams, looks = place[problem.beam_pm] >= 0, place[problem.look_pm] >= 0
    beam_place = np.cumsum(beams) - 1
    return replace(
        problem,
        pms=tuple(problem.pms[i] for i in index),
        beam_pm=place[problem.beam_pm[beams]],
        beam_epoch=problem.beam_epoch[beams],
        beams=BeamArrays(*(getattr(problem.beams, name)[beams] for name in BeamArrays.__slots__)),
        look_pm=place[problem.look_pm[looks]],
        look_beam=beam_place[problem.look_beam[looks]],
        spots=_select_spots(problem.spots, beams, beam_place),
        looks=LookArrays(*(getattr(problem.looks, name)[looks] for name in LookArrays.__slots__)),
        shapes=None if problem.shapes is None else _select_shapes(problem.shapes, index, looks),
        log_outlier=None if problem.log_outlier is None else problem.log_outlier[index],
    )


def _select_spots(spots: SpotArrays, beams: BoolArray, beam_place: IntArray) -> SpotArrays:
    kept = spots.take(np.flatnonzero(beams[spots.beam]))
    return replace(kept, beam=beam_place[kept.beam])


def _select_shapes(shapes: RotationShapes, index: IntArray, looks: BoolArray) -> RotationShapes:
    look_place = np.cumsum(looks) - 1
    stands = shapes.amplitude_look[index]
    return RotationShapes(
        WindowShapes(*(getattr(shapes.windows, name)[looks] for name in WindowShapes.__slots__)),
        shapes.plane_rad[index],
        shapes.amplitude_log[index],
        np.where(stands >= 0, look_place[stands], -1),
    )
