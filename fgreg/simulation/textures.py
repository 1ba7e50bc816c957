"""Printed patterns as piecewise constant textures: tags, chessboards, ChArUco boards, plain patches.

A texture is a grid of equal squares; a square can contain a block of equal modules at a fixed inset. So it describes a
tag (one square, its modules inside the quiet zone), a chessboard (no modules) and a ChArUco board.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from fgreg.model.session_model import BoardModel

Float32Array = npt.NDArray[np.float32]
LabelArray = npt.NDArray[np.uint8]

OUTSIDE, BLACK, WHITE = 0, 1, 2


@dataclass(frozen=True, slots=True, eq=False)
class CellTexture:
    """Labels over texture coordinates (u to the right, v down, mm, origin at the top left of square [0, 0]).

    Attributes:
        square_mm: edge of a square.
        inset_mm, module_mm, modules: where the block of modules starts in a square, edge of a module, modules a side.
        table: (rows, columns, modules + 2, modules + 2) labels; states 0 and modules + 1 are the frame of the block.
        u_mm, v_mm: extent of the sheet; outside it the label is ``OUTSIDE``.
    """

    square_mm: float
    inset_mm: float
    module_mm: float
    modules: int
    table: LabelArray
    u_mm: tuple[float, float]
    v_mm: tuple[float, float]

    def labels(self, u_mm: Float32Array, v_mm: Float32Array) -> LabelArray:
        """Label at each point; any shape."""
        rows, columns, states, _ = self.table.shape
        column, module_column = self._cell(u_mm, columns)
        row, module_row = self._cell(v_mm, rows)
        index = ((row * columns + column) * states + module_row) * states + module_column
        inside = (u_mm >= self.u_mm[0]) & (u_mm < self.u_mm[1])
        inside &= v_mm >= self.v_mm[0]
        inside &= v_mm < self.v_mm[1]
        return np.asarray(self.table.ravel().take(index) * inside)

    def _cell(self, w_mm: Float32Array, squares: int) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        # Clipped before the conversion: far from the sheet the coordinate may be too large for an integer.
        scaled = np.clip(w_mm * np.float32(1.0 / self.square_mm), 0.0, np.float32(squares - 1e-3))
        square = scaled.astype(np.int32)
        if self.modules == 0:
            return square, np.zeros((), dtype=np.int32)
        scaled -= square
        scaled *= np.float32(self.square_mm / self.module_mm)
        scaled += np.float32(1.0 - self.inset_mm / self.module_mm)  # state 0 below 1, state 1 in [1, 2) and so on
        np.clip(scaled, 0.0, np.float32(self.modules + 1.5), out=scaled)
        return square, scaled.astype(np.int32)


def dictionary_named(name: str) -> cv2.aruco.Dictionary:
    """The OpenCV dictionary of that name.

    Raises:
        ValueError: no such dictionary.
    """
    if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
        raise ValueError(f"dictionary is {name}, expected the name of an OpenCV dictionary, e.g. DICT_4X4_50")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def tag_modules(dictionary: str, tag_id: int) -> LabelArray:
    """(n, n) labels of a tag's modules with its black border of one module, first row at the printed top."""
    book = dictionary_named(dictionary)
    if not 0 <= tag_id < book.bytesList.shape[0]:
        raise ValueError(f"tag id is {tag_id}, expected 0 to {book.bytesList.shape[0] - 1} in {dictionary}")
    pixels = cv2.aruco.generateImageMarker(book, tag_id, book.markerSize + 2)
    return np.where(np.asarray(pixels) > 127, WHITE, BLACK).astype(np.uint8)


@lru_cache(maxsize=64)
def tag_texture(dictionary: str, tag_id: int, size_mm: float, quiet_modules: float) -> CellTexture:
    """A tag with its white quiet zone; the top left of the sheet is at (0, 0)."""
    bits = tag_modules(dictionary, tag_id)
    n = bits.shape[0]
    module_mm = size_mm / n
    quiet_mm = quiet_modules * module_mm
    table = np.full((1, 1, n + 2, n + 2), WHITE, dtype=np.uint8)
    table[0, 0, 1:-1, 1:-1] = bits
    sheet_mm = size_mm + 2.0 * quiet_mm
    return CellTexture(sheet_mm, quiet_mm, module_mm, n, table, (0.0, sheet_mm), (0.0, sheet_mm))


@lru_cache(maxsize=8)
def board_texture(board: BoardModel, margin_squares: float = 0.5) -> CellTexture:
    """A chessboard or ChArUco board inside a white margin of up to one square.

    Square [0, 0] of the table belongs to the margin: the board's own top left square starts at (square, square) and the
    inner corner [0, 0] is at (2 square, 2 square).
    """
    rows, columns = board.rows + 1, board.columns + 1
    # Black at the top left, but for the pattern of OpenCV before 4.6 with an even number of rows.
    first = int(board.charuco is not None and board.charuco.legacy and rows % 2 == 0)
    black = (np.add.outer(np.arange(rows), np.arange(columns)) % 2) == first
    modules = 0
    inset_mm = module_mm = board.square_mm
    if board.charuco is not None:
        modules = dictionary_named(board.charuco.dictionary).markerSize + 2
        inset_mm = (board.square_mm - board.charuco.marker_mm) / 2.0
        module_mm = board.charuco.marker_mm / modules
    states = modules + 2 if modules else 1
    table = np.full((rows + 2, columns + 2, states, states), WHITE, dtype=np.uint8)
    table[1:-1, 1:-1][black] = BLACK
    if board.charuco is not None:
        # Markers are in the white squares, numbered along the rows.
        for tag_id, (row, column) in enumerate(np.argwhere(~black)):
            table[row + 1, column + 1, 1:-1, 1:-1] = tag_modules(board.charuco.dictionary, tag_id)
    start = (1.0 - margin_squares) * board.square_mm
    return CellTexture(
        board.square_mm,
        inset_mm,
        module_mm,
        modules,
        table,
        (start, (columns + 1.0 + margin_squares) * board.square_mm),
        (start, (rows + 1.0 + margin_squares) * board.square_mm),
    )


@lru_cache(maxsize=64)
def plain_texture(width_mm: float, height_mm: float) -> CellTexture:
    """A sheet of one colour."""
    table = np.full((1, 1, 1, 1), WHITE, dtype=np.uint8)
    edge_mm = max(width_mm, height_mm)
    return CellTexture(edge_mm, edge_mm, edge_mm, 0, table, (0.0, width_mm), (0.0, height_mm))
