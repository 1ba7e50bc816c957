"""What is cut out of the paper: each piece in millimetres from its lower left corner, x right, y up.

The black of a pattern is its outline, filled by the even-odd rule: neighbouring cells have no seam between them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fgreg.detection.board import charuco_squares
from fgreg.detection.tags import black_cells
from fgreg.geometry.transforms import BoolArray, FloatArray, IntArray
from fgreg.model.session_model import BoardModel, MarkerModel, TagModel
from fgreg.printing.bodies import SQUARE, in_planes, on_plane, prism_apothem, side_mm

FLAP_MM = 8.0
"""Widest flap to glue, of at most one side."""


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """A flat piece of paper.

    Attributes:
        width_mm, height_mm: of its outline, along which it is cut.
        black_mm: outlines of what is black, each (n, 2).
        captions: beneath it, each with the x (mm) of its middle.
        folds_mm: x of the lines to fold along; what is beyond the last one is the flap to glue.
    """

    width_mm: float
    height_mm: float
    black_mm: tuple[FloatArray, ...]
    captions: tuple[tuple[float, str], ...]
    folds_mm: tuple[float, ...] = ()


def outlines(black: BoolArray) -> list[IntArray]:
    """Outlines of the black cells (rows, columns): each (n, 2) corners, column and row, without those on a line."""
    padded = np.pad(black, 1)
    ends: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for row, column in np.argwhere(black).tolist():
        around = ((0, 1), (1, 2), (2, 1), (1, 0))  # above, right, below, left in the padded cells
        corners = ((column, row), (column + 1, row), (column + 1, row + 1), (column, row + 1))
        for side, (down, right) in enumerate(around):
            if not padded[row + down, column + right]:
                ends.setdefault(corners[side], []).append(corners[(side + 1) % 4])
    loops = []
    while ends:
        start = next(iter(ends))
        loop, here = [start], start
        while True:
            following = ends[here].pop()
            if not ends[here]:
                del ends[here]
            here = following
            if here == start:
                break
            loop.append(here)
        points = np.array(loop, dtype=np.int64)
        straight = ((points == np.roll(points, 1, axis=0)) & (points == np.roll(points, -1, axis=0))).any(axis=1)
        loops.append(points[~straight])
    return loops


def _placed(cells: Iterable[IntArray], cell_mm: float, left_mm: float, top_mm: float) -> list[FloatArray]:
    """Outlines in cells as outlines in mm."""
    return [np.column_stack([left_mm + cell_mm * loop[:, 0], top_mm - cell_mm * loop[:, 1]]) for loop in cells]


def board_piece(board: BoardModel, quiet_mm: float) -> Piece:
    """A chessboard or ChArUco board within a white margin."""
    square = board.square_mm
    columns, rows = board.columns + 1, board.rows + 1
    top = quiet_mm + rows * square
    if board.charuco is None:
        black = (np.add.outer(np.arange(rows), np.arange(columns)) % 2) == 0
        markers: list[FloatArray] = []
    else:
        black = np.ones((rows, columns), dtype=bool)
        places = charuco_squares(board)
        black[places[:, 1], places[:, 0]] = False
        marker = board.charuco.marker_mm
        inset = (square - marker) / 2
        markers = []
        for tag_id, (column, row) in enumerate(places.tolist()):
            cells = black_cells(board.charuco.dictionary, tag_id)
            left = quiet_mm + column * square + inset
            markers += _placed(outlines(cells), marker / len(cells), left, top - row * square - inset)
    squares = _placed(outlines(black), square, quiet_mm, top)
    width, height = columns * square + 2 * quiet_mm, rows * square + 2 * quiet_mm
    caption = f"{columns} x {rows} squares: {columns * square:g} x {rows * square:g} mm from edge to edge"
    return Piece(width, height, (*squares, *markers), ((width / 2, caption),))


def marker_pieces(marker: MarkerModel, quiet_mm: float | None) -> list[Piece]:
    """A marker body: one strip for a prism, else one piece for each plane with tags.

    Args:
        quiet_mm: white around the black borders; None: one cell of the tag.
    """
    apothem = prism_apothem(marker)
    if apothem is not None:
        return [_strip(marker, apothem, quiet_mm)]
    return [_plane(marker.dictionary, tags, quiet_mm) for tags in in_planes(marker)]


def quiet_zone(dictionary: str, size_mm: float, quiet_mm: float | None) -> float:
    """White around a tag: one of its cells, where nothing else is wanted."""
    return size_mm / len(black_cells(dictionary, 0)) if quiet_mm is None else quiet_mm


def _strip(marker: MarkerModel, apothem_mm: float, quiet_mm: float | None) -> Piece:
    """A prism's sides side by side, each with its tag in the middle, and a flap."""
    side, size = side_mm(apothem_mm, len(marker.tags)), marker.tags[0].size_mm
    height = size + 2 * quiet_zone(marker.dictionary, size, quiet_mm)
    black, captions = list[FloatArray](), list[tuple[float, str]]()
    for k, tag in enumerate(marker.tags):
        cells = black_cells(marker.dictionary, tag.id)
        black += _placed(outlines(cells), size / len(cells), k * side + (side - size) / 2, (height + size) / 2)
        captions.append(((k + 0.5) * side, str(tag.id)))
    folds = tuple((k + 1) * side for k in range(len(marker.tags)))
    return Piece(folds[-1] + min(FLAP_MM, 0.9 * side), height, tuple(black), tuple(captions), folds)


def _plane(dictionary: str, tags: list[TagModel], quiet_mm: float | None) -> Piece:
    """Tags of one plane where they lie on it; the first one is upright."""
    black, reach = list[FloatArray](), list[FloatArray]()
    for tag in tags:
        cells = black_cells(dictionary, tag.id)
        cell, half = tag.size_mm / len(cells), tag.size_mm / 2
        wide = half + quiet_zone(dictionary, tag.size_mm, quiet_mm)
        black += [on_plane(tags[0], tag, loop) for loop in _placed(outlines(cells), cell, -half, half)]
        reach.append(on_plane(tags[0], tag, wide * SQUARE))
    low, high = np.concatenate(reach).min(axis=0), np.concatenate(reach).max(axis=0)
    width, height = (high - low).tolist()
    names = ", ".join(str(tag.id) for tag in tags)
    caption = f"tag {names}" if len(tags) == 1 else f"tags {names}" if len(tags) < 10 else f"{len(tags)} tags"
    return Piece(width, height, tuple(loop - low for loop in black), ((width / 2, caption),))
