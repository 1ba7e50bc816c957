"""Corners of the board in pictures of one or two cameras, as one table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.model.session_model import BoardModel

MIN_CORNERS = 8
"""Of a board in one picture: six numbers of its pose, and something left for the lens."""
SIDES = ("left", "right")


@dataclass(frozen=True, slots=True, eq=False)
class SeenCorners:
    """Corners in one picture: ``pixels`` (n, 2), ``ids`` (n,) as row * columns + column."""

    pixels: FloatArray
    ids: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """One place of the board: its name for messages, and its corners in either picture, None where it was not found."""

    name: str
    left: SeenCorners | None
    right: SeenCorners | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CornerTable:
    """Corners of all views, sorted by view.

    Attributes:
        names: (V,) of the views.
        view: (n,) index of the view. side: (n,) 0 left, 1 right.
        board_p_mm: (n, 3). pixels: (n, 2).
    """

    names: tuple[str, ...]
    view: IntArray
    side: IntArray
    board_p_mm: FloatArray
    pixels: FloatArray

    @classmethod
    def of(cls, views: Sequence[BoardView], board: BoardModel) -> CornerTable:
        """The table of views; pictures with fewer than ``MIN_CORNERS`` corners are left out."""
        view, side, points, pixels = [], [], [], []
        for v, one in enumerate(views):
            for s, seen in enumerate((one.left, one.right)):
                if seen is None or len(seen.ids) < MIN_CORNERS:
                    continue
                view.append(np.full(len(seen.ids), v, dtype=np.int64))
                side.append(np.full(len(seen.ids), s, dtype=np.int64))
                column, row = seen.ids % board.columns, seen.ids // board.columns
                points.append(np.column_stack([column, row, np.zeros(len(column))]) * board.square_mm)
                pixels.append(seen.pixels)
        if not view:
            none = np.zeros(0, dtype=np.int64)
            return cls((), none, none, np.zeros((0, 3)), np.zeros((0, 2)))
        table = cls(
            tuple(one.name for one in views),
            np.concatenate(view),
            np.concatenate(side),
            np.concatenate(points),
            np.concatenate(pixels),
        )
        return table.of_views(np.unique(table.view))

    def of_views(self, chosen: IntArray) -> CornerTable:
        """The views ``chosen`` (increasing indices), numbered anew."""
        keep = np.isin(self.view, chosen)
        names = tuple(self.names[v] for v in chosen)
        view = np.searchsorted(chosen, self.view[keep])
        return CornerTable(names, view, self.side[keep], self.board_p_mm[keep], self.pixels[keep])

    def subset(self, keep: BoolArray) -> CornerTable:
        """The corners for which ``keep`` (n,) holds; the views stay."""
        return CornerTable(self.names, self.view[keep], self.side[keep], self.board_p_mm[keep], self.pixels[keep])


def spread_views(views: Sequence[BoardView], board: BoardModel, count: int) -> list[BoardView]:
    """At most ``count`` views, as different from one another as can be (farthest first), in their order.

    Views differ by where the board's middle is and how its sides lie in the picture, px.
    """
    if len(views) <= count:
        return list(views)
    places = np.array([_place(one, board) for one in views])
    chosen = [int(np.argmin(np.linalg.norm(places - np.median(places, axis=0), axis=1)))]
    nearest = np.full(len(views), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.linalg.norm(places - places[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(nearest)))
    return [views[i] for i in sorted(chosen)]


def _place(view: BoardView, board: BoardModel) -> FloatArray:
    """(6,) the affine map from the board, of unit size about its middle, to a picture."""
    seen = view.left if view.left is not None else view.right
    assert seen is not None
    half = 0.5 * np.array([board.columns - 1, board.rows - 1])
    grid = np.column_stack([seen.ids % board.columns, seen.ids // board.columns]) / half - 1.0
    return np.asarray(np.linalg.lstsq(np.column_stack([grid, np.ones(len(grid))]), seen.pixels, rcond=None)[0].ravel())
