"""A marker body or a board as a sheet: its pieces, what to know about them, and their lines of session.yaml."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from fgreg.model.session_model import BoardModel, MarkerModel
from fgreg.printing.bodies import prism_apothem
from fgreg.printing.options import SECTIONS
from fgreg.printing.paper import Paper
from fgreg.printing.pieces import board_piece, marker_pieces
from fgreg.printing.sheets import Sheet
from fgreg.schema.yaml_writer import yaml_text

_DECIMALS = 6


def marker_sheet(marker: MarkerModel, quiet_mm: float | None, paper: Paper, cut_marks: bool) -> Sheet:
    """A page or more with a marker body, and what session.yaml says of it."""
    pieces = marker_pieces(marker, quiet_mm)
    sizes = sorted({tag.size_mm for tag in marker.tags})
    size = f"{sizes[0]:g} mm" if len(sizes) == 1 else f"{sizes[0]:g} to {sizes[-1]:g} mm"
    tags = f"tag {marker.tags[0].id}" if len(marker.tags) == 1 else f"{len(marker.tags)} tags"
    notes = [f"Size: outer edge of the black border, {size}. The white around it is part of the tag. Use matt paper."]
    if "APRILTAG" in marker.dictionary:
        notes.append("Drawn as OpenCV draws it; pictures of AprilTags by their makers are turned by half a turn.")
    apothem = prism_apothem(marker)
    if apothem is not None:
        sides = len(marker.tags)
        across = 2 * apothem if sides % 2 == 0 else apothem * (1 + 1 / math.cos(math.pi / sides))
        ends = "one side to the opposite one" if sides % 2 == 0 else "a side to the opposite edge"
        notes.append(
            "Score along the dashed marks, cut, fold with the print outwards, glue the flap under the first side. "
            f"Then measure from {ends}: {across:.2f} mm; where it is not, print again with the rod as measured. "
            "Marker frame: z along the rod, up as printed; x out of the first tag; origin in the middle of the tags."
        )
    elif len(pieces) > 1:
        notes.append("marker_T_tag below says where each tag is: glue it there, within 0.05 mm.")
    return Sheet(
        f"Marker: {marker.dictionary}, {tags}, {size}",
        tuple(notes),
        tuple(pieces),
        tuple(setup_lines("marker", marker)),
        paper,
        cut_marks,
    )


def board_sheet(board: BoardModel, quiet_mm: float | None, paper: Paper, cut_marks: bool) -> Sheet:
    """A page with a calibration board, and what session.yaml says of it."""
    quiet = quiet_mm if quiet_mm is not None else board.square_mm / (1 if board.charuco is None else 2)
    charuco = board.charuco
    if charuco is None:
        kind = f"Chessboard: {board.columns} x {board.rows} inner corners, {board.square_mm:g} mm"
    else:
        pattern = charuco.dictionary + (", legacy pattern" if charuco.legacy else "")
        kind = f"ChArUco board: {board.columns} x {board.rows} inner corners, {board.square_mm:g} mm, {pattern}"
    notes = ("Matt paper, glued to glass or a metal plate, flat to 0.1 mm. The white margin is part of the board.",)
    return Sheet(kind, notes, (board_piece(board, quiet),), tuple(setup_lines("board", board)), paper, cut_marks)


def setup_lines(name: str, part: MarkerModel | BoardModel) -> Iterable[str]:
    """The lines of session.yaml that describe a marker or board."""
    document = {name: _rounded(SECTIONS[name].write(part))}
    return yaml_text(document, flow=("charuco", "board")).splitlines()


def _rounded(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return round(value, _DECIMALS) + 0.0 if isinstance(value, float) else value
