"""Pieces and text on pages of a PDF, true to size, each page with two scale bars; the same bytes for the same sheet."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fgreg.errors import InputError, MissingExtraError
from fgreg.output.atomic_file import FileKind
from fgreg.printing.paper import Paper
from fgreg.printing.pieces import Piece

if TYPE_CHECKING:
    from reportlab.pdfgen.canvas import Canvas

CREATOR = "fgreg print"
PRINT_FILE = FileKind("a PDF of fgreg print", (b"%PDF-",), (f"/Creator ({CREATOR})".encode(),))

POINTS = 72 / 25.4
"""PDF's unit in a millimetre."""
MARGIN_MM = 10.0
"""Printers leave up to 6 mm of a page's edge white."""
BAR_MM, MOST_OFF_MM = 100.0, 0.3
"""Length of a scale bar, and its error that the default of ``systematic.tag_size`` stands for."""
CUT_GAP_MM, CUT_MM = 1.0, 4.0
"""Cut marks: distance from the corner, length."""
CAPTION_MM = 5.0
"""Height of the captions beneath a piece."""
BAR_WIDTH_MM, TITLE_MM = 9.0, 8.0
"""Of the band with a scale bar, and of the title."""
CODE_PT, LINE_PT, CODE_LINE_MM, LINE_MM = 7.5, 8.5, 3.2, 4.0

HOW_TO_PRINT = (
    f"Print at 100 % (actual size), not fitted to the page. Measure both bars, {BAR_MM:g} mm from end to end: where "
    f"they are off by {MOST_OFF_MM:g} mm or more, print again, or multiply each length below by measured / {BAR_MM:g}. "
    "Where the two differ by as much, squares are not square: use another printer."
)


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """What is printed.

    Attributes:
        title: at the head of each page.
        notes: paragraphs beneath the title, before how to print.
        pieces: to cut out.
        yaml: lines of session.yaml that describe them.
        paper: of all pages; all are turned where a piece fits in no other way.
        cut_marks: at the corners of the pieces.
    """

    title: str
    notes: tuple[str, ...]
    pieces: tuple[Piece, ...]
    yaml: tuple[str, ...]
    paper: Paper = Paper.A4
    cut_marks: bool = True

    @property
    def around_mm(self) -> float:
        """Around a piece: room for its cut marks."""
        return CUT_GAP_MM + CUT_MM + 1.0 if self.cut_marks else 1.0


def pdf_of(sheet: Sheet) -> tuple[bytes, int]:
    """The sheet as a PDF, and the number of its pages.

    Raises:
        MissingExtraError: reportlab is not installed.
        InputError: a piece is larger than a page.
    """
    try:
        from reportlab.pdfgen.canvas import Canvas
    except ImportError as error:
        raise MissingExtraError("reportlab", "print") from error
    width, height = _page(sheet)
    file = io.BytesIO()
    canvas = Canvas(file, (width * POINTS, height * POINTS), pageCompression=1, invariant=1)
    canvas.setCreator(CREATOR)
    canvas.setTitle(sheet.title)
    canvas.setViewerPreference("PrintScaling", "None")
    writer = _Pages(canvas, sheet, width, height)
    for piece in sheet.pieces:
        writer.add(piece)
    writer.add_code(("In session.yaml:", "", *sheet.yaml))
    canvas.save()
    return file.getvalue(), writer.pages


def _notes(sheet: Sheet, width: float) -> list[str]:
    """The lines beneath the title of a page so wide (mm)."""
    from reportlab.lib.utils import simpleSplit

    room = (width - 2 * MARGIN_MM - BAR_WIDTH_MM) * POINTS
    texts = (*sheet.notes, HOW_TO_PRINT)
    return [line for text in texts for line in simpleSplit(text, "Helvetica", LINE_PT, room)]


def _area(sheet: Sheet, width: float, height: float) -> tuple[float, float, float, float]:
    """Left, right, bottom and top (mm) of a page's part for pieces and code."""
    top = height - MARGIN_MM - TITLE_MM - LINE_MM * len(_notes(sheet, width))
    return MARGIN_MM + BAR_WIDTH_MM, width - MARGIN_MM, MARGIN_MM + BAR_WIDTH_MM, top


def _page(sheet: Sheet) -> tuple[float, float]:
    """Width and height (mm) of the pages, turned where that alone makes room.

    Raises:
        InputError: a piece is larger than a page either way.
    """
    upright = sheet.paper.size_mm
    around = 2 * sheet.around_mm
    rooms = []
    for width, height in (upright, upright[::-1]):
        left, right, bottom, top = _area(sheet, width, height)
        room = right - left - around, top - bottom - around - CAPTION_MM
        if all(piece.width_mm <= room[0] and piece.height_mm <= room[1] for piece in sheet.pieces):
            return width, height
        rooms.append(room)
    largest = max(sheet.pieces, key=lambda piece: max(piece.width_mm - room[0], piece.height_mm - room[1]))
    found = f"a piece of {largest.width_mm:.1f} x {largest.height_mm:.1f} mm with its white margin"
    expected = " or ".join(f"{room[0]:.1f} x {room[1]:.1f}" for room in rooms)
    raise InputError(f"--paper {sheet.paper}", found, f"at most {expected} mm (smaller tags or squares, or fewer)")


class _Pages:
    """Pages under construction; pieces go side by side in rows from the top left."""

    def __init__(self, canvas: Canvas, sheet: Sheet, width: float, height: float) -> None:
        self._canvas, self._sheet, self._width, self._height = canvas, sheet, width, height
        self.pages = 0
        self._left, self._right, self._bottom, self._top = _area(sheet, width, height)
        self._begin()

    def _begin(self) -> None:
        """The next page, with title, notes and bars."""
        if self.pages:
            self._canvas.showPage()
        self.pages += 1
        self._x, self._y, self._row = self._left, self._top, 0.0
        top = self._height - MARGIN_MM
        self._text(self._left, top - 4.0, self._sheet.title, size=12, font="Helvetica-Bold")
        for k, line in enumerate(_notes(self._sheet, self._width)):
            self._text(self._left, top - TITLE_MM - 1.5 - LINE_MM * k, line)
        self._bar(self._left, MARGIN_MM + 1.0, upright=False)
        self._bar(MARGIN_MM + 5.0, self._bottom, upright=True)

    def _bar(self, x: float, y: float, *, upright: bool) -> None:
        """A scale bar of ``BAR_MM`` from a place on; measured between the middles of its end lines."""
        c = self._canvas
        c.saveState()
        c.translate(x * POINTS, y * POINTS)
        if upright:
            c.rotate(90)
        c.scale(POINTS, POINTS)
        c.setLineWidth(0.1)
        c.line(0, 0, BAR_MM, 0)
        for k in range(11):
            c.line(BAR_MM * k / 10, 0, BAR_MM * k / 10, 4.0 if k in (0, 10) else 2.0)
        c.setFont("Helvetica", LINE_PT / POINTS)
        c.drawCentredString(BAR_MM / 2, 2.8, f"{BAR_MM:g} mm")
        c.restoreState()

    def add(self, piece: Piece) -> None:
        """Draw a piece in the next free place."""
        around = self._sheet.around_mm
        width, height = piece.width_mm + 2 * around, piece.height_mm + 2 * around + CAPTION_MM
        if self._x > self._left and self._x + width > self._right + 1e-6:
            self._next_row()
        if self._y - height < self._bottom - 1e-6:
            self._begin()
        self._draw(piece, self._x + around, self._y - around - piece.height_mm)
        self._x += width
        self._row = max(self._row, height)

    def _next_row(self) -> None:
        self._x, self._y, self._row = self._left, self._y - self._row, 0.0

    def _draw(self, piece: Piece, x: float, y: float) -> None:
        """A piece with its lower left corner at a place (mm)."""
        c = self._canvas
        c.saveState()
        c.translate(x * POINTS, y * POINTS)
        c.scale(POINTS, POINTS)
        path = c.beginPath()
        for loop in piece.black_mm:
            (first_x, first_y), *rest = loop.tolist()
            path.moveTo(first_x, first_y)
            for point in rest:
                path.lineTo(*point)
            path.close()
        c.drawPath(path, stroke=0, fill=1, fillMode=0)
        c.setLineWidth(0.1)
        near, far = CUT_GAP_MM, CUT_GAP_MM + CUT_MM
        w, h = piece.width_mm, piece.height_mm
        if self._sheet.cut_marks:
            for side, edge in ((-1, 0.0), (1, w)):
                for end in (0.0, h):
                    c.line(edge + side * near, end, edge + side * far, end)
            for side, edge in ((-1, 0.0), (1, h)):
                for end in (0.0, w):
                    c.line(end, edge + side * near, end, edge + side * far)
        c.setDash(0.8, 0.6)
        for fold in piece.folds_mm:
            c.line(fold, -near, fold, -far)
            c.line(fold, h + near, fold, h + far)
        c.setDash()
        if piece.folds_mm:
            c.saveState()
            c.translate((piece.folds_mm[-1] + w) / 2 + 0.8, h / 2)
            c.rotate(90)
            self._caption(0.0, 0.0, "glue")
            c.restoreState()
        for middle, text in piece.captions:
            self._caption(middle, -self._sheet.around_mm - 2.5, text)
        c.restoreState()

    def _caption(self, x: float, y: float, text: str) -> None:
        self._canvas.setFont("Helvetica", CODE_PT / POINTS)
        self._canvas.drawCentredString(x, y, text)

    def _text(self, x: float, y: float, text: str, *, size: float = LINE_PT, font: str = "Helvetica") -> None:
        self._canvas.setFont(font, size)
        self._canvas.drawString(x * POINTS, y * POINTS, text)

    def add_code(self, lines: Sequence[str]) -> None:
        """Lines in type of one width, below the pieces; together on one page where they fit on one."""
        self._next_row()
        if self._y - CODE_LINE_MM * (len(lines) + 1) < self._bottom:
            self._begin()
        for line in lines:
            if self._y - CODE_LINE_MM < self._bottom:
                self._begin()
            self._y -= CODE_LINE_MM
            self._text(self._left, self._y, line, size=CODE_PT, font="Courier")
