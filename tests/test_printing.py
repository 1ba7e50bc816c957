"""Printed markers and boards: each page is rendered, and what fgreg's detectors see in it is as large as declared."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pypdfium2
import pytest

from fgreg.cli.main import main
from fgreg.detection.board import detect_board, find_board_corners
from fgreg.detection.edge_pixels import Image
from fgreg.detection.marker import view_corners
from fgreg.detection.results import NotFound
from fgreg.geometry.transforms import FloatArray, inverse, make_transform
from fgreg.model.camera_model import CameraModel, StereoRig
from fgreg.model.session_model import BoardModel, CharucoModel, MarkerModel, TagModel
from fgreg.printing.bodies import prism, side_mm
from fgreg.printing.compose import setup_lines
from fgreg.printing.options import section_of
from fgreg.printing.pieces import marker_pieces, outlines
from fgreg.schema.yaml_writer import yaml_text

TOLERANCE = 1e-3
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """``fgreg print`` with these words, in a folder of its own: exit status, standard output and error."""
    monkeypatch.chdir(tmp_path)

    def command(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["fgreg", "print", *map(str, words)])
        with pytest.raises(SystemExit) as exit_:
            main()
        out, err = capsys.readouterr()
        return int(exit_.value.code or 0), out, err

    return command


@dataclass(frozen=True)
class Page:
    """A rendered page: grey (h, w), and how many pixels a millimetre has along x and y."""

    image: Image
    px_mm: FloatArray


def rendered(path: Path | str, dpi: int = 300) -> Page:
    """The first page; the renderer stretches it to whole pixels."""
    document = pypdfium2.PdfDocument(path)
    try:
        page = document[0]
        bitmap = page.render(scale=dpi / 72, grayscale=True)
        image = np.array(bitmap.to_numpy()).reshape(bitmap.height, bitmap.width)
        return Page(image, np.array([bitmap.width, bitmap.height]) / np.array(page.get_size()) * 72 / 25.4)
    finally:
        document.close()


def scanner(image: Image) -> CameraModel:
    height, width = image.shape
    matrix = np.array([[1e3, 0.0, width / 2], [0.0, 1e3, height / 2], [0.0, 0.0, 1.0]])
    return CameraModel((width, height), matrix, np.zeros(5))


def seen_tags(page: Page, marker: MarkerModel) -> dict[int, FloatArray]:
    """Corners (4, 2) of each tag on the page by its id, mm, x right, y up, from the detector."""
    found = view_corners(page.image, scanner(page.image), 0, np.eye(4), marker)
    assert found.corners is not None
    assert found.left_out == ()
    corners = found.corners.ideal_px.reshape(-1, 4, 2) / page.px_mm * np.array([1.0, -1.0])
    assert sorted(found.ids) == sorted(tag.id for tag in marker.tags)
    return dict(zip(found.ids, corners, strict=True))


def printed_marker(out: str, folder: Path) -> MarkerModel:
    """The body of the lines of session.yaml that the command printed."""
    (folder / "printed.yaml").write_text(out)
    marker = section_of(folder / "printed.yaml", "marker")
    assert isinstance(marker, MarkerModel)
    return marker


@pytest.mark.parametrize(
    "words",
    [
        "--dictionary DICT_4X4_50 --id 7 --size-mm 25",
        "--dictionary DICT_APRILTAG_36h11 --id 0-2,9,20 --size-mm 12 --paper letter --quiet-mm 4",
        "--dictionary DICT_7X7_50 --id 3 --size-mm 9.3 --no-cut-marks",
    ],
)
def test_tags_are_where_the_printed_yaml_says_and_as_large(run: Run, tmp_path: Path, words: str) -> None:
    status, out, err = run("marker", "m.pdf", *words.split())
    assert (status, err) == (0, "")
    marker = printed_marker(out, tmp_path)
    by_id = seen_tags(rendered("m.pdf", 600), marker)
    for tag in marker.tags:
        sides = np.linalg.norm(np.roll(by_id[tag.id], -1, axis=0) - by_id[tag.id], axis=1)
        assert sides == pytest.approx(tag.size_mm, rel=TOLERANCE)
    seen = np.concatenate([by_id[tag.id] for tag in marker.tags])
    said = np.concatenate([tag.marker_p_corners_mm[:, :2] for tag in marker.tags])
    off = (seen - seen.mean(axis=0)) - (said - said.mean(axis=0))
    assert np.abs(off).max() < TOLERANCE * np.ptp(said, axis=0).max() / 2


@pytest.mark.parametrize("sides", [3, 6])
def test_the_strip_folds_into_the_body_that_its_yaml_describes(run: Run, tmp_path: Path, sides: int) -> None:
    status, out, _ = run("marker", "m.pdf", "--dictionary", "DICT_4X4_50", "--id", f"10-{9 + sides}", "--rod-mm", 20)
    assert status == 0
    marker = printed_marker(out, tmp_path)
    size, apothem = marker.tags[0].size_mm, 20 / 2 + 0.1  # paper of 0.1 mm
    side = 2 * apothem * math.tan(math.pi / sides)
    assert side * 4 / 6 - 0.2 < size * 6 / 6 <= side * 6 / 8 < side  # white of a cell, 1/6 of the tag, on both sides
    seen = seen_tags(rendered("m.pdf"), marker)
    start = seen[10].mean(axis=0)
    for k, tag in enumerate(marker.tags):
        along, up = (seen[tag.id] - start).T
        assert np.abs(along - k * side).max() == pytest.approx(size / 2, rel=TOLERANCE, abs=1e-3 * k * side)
        # Folded: side k faces the angle 2 pi k / sides about z, and what was right on it goes on around.
        angle, right = 2 * math.pi * k / sides, along - k * side
        x = apothem * math.cos(angle) - right * math.sin(angle)
        y = apothem * math.sin(angle) + right * math.cos(angle)
        assert np.abs(np.column_stack([x, y, up]) - tag.marker_p_corners_mm).max() < TOLERANCE * sides * side


def test_a_prism_in_session_yaml_is_printed_as_the_same_strip(run: Run, tmp_path: Path) -> None:
    body = prism("DICT_4X4_50", [4, 1, 2, 8], 8.0, 7.0)
    turned = make_transform(np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), np.array([3.0, -2.0, 50.0]))
    moved = MarkerModel(
        body.dictionary, tuple(TagModel(tag.id, tag.size_mm, turned @ tag.marker_T_tag) for tag in body.tags)
    )
    strips = [marker_pieces(each, None) for each in (body, moved)]
    assert [len(pieces) for pieces in strips] == [1, 1]
    assert strips[0][0].folds_mm == pytest.approx([side_mm(7.0, 4) * k for k in (1, 2, 3, 4)])
    assert strips[1][0].folds_mm == pytest.approx(strips[0][0].folds_mm)
    # In another order, neighbours on the paper would not be so on the rod: single labels.
    assert len(marker_pieces(MarkerModel(body.dictionary, body.tags[::-1]), None)) == 4
    (tmp_path / "session.yaml").write_text("\n".join(setup_lines("marker", moved)))
    assert run("marker", "m.pdf", "--setup", tmp_path)[0] == 0
    assert len(seen_tags(rendered("m.pdf"), moved)) == 4
    first = Path("m.pdf").read_bytes()
    assert run("marker", "m.pdf", "--setup", "session.yaml")[0] == 0  # an older one of ours is replaced
    assert Path("m.pdf").read_bytes() == first


def test_tags_of_one_plane_are_one_piece_as_they_lie(run: Run) -> None:
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    plane = make_transform(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([5.0, 0.0, 0.0]))
    places = [np.eye(4), make_transform(turn, np.array([22.0, 3.0, 0.0]))]
    tags = [TagModel(k, 20.0 - 10 * k, plane @ place) for k, place in enumerate(places)]
    marker = MarkerModel("DICT_6X6_250", (*tags, TagModel(2, 20.0)))
    Path("s.yaml").write_text("\n".join(setup_lines("marker", marker)))
    assert run("marker", "m.pdf", "--setup", "s.yaml")[0] == 0
    seen = seen_tags(rendered("m.pdf"), marker)
    said = [(tag.marker_p_corners_mm - plane[:3, 3]) @ inverse(plane)[:3, :3].T for tag in tags]
    for tag, corners in zip(tags, said, strict=True):
        assert np.abs(seen[tag.id] - seen[0].mean(axis=0) - corners[:, :2]).max() < TOLERANCE * 22


@pytest.mark.parametrize(
    "board",
    [
        BoardModel(9, 6, 10.0, CharucoModel("DICT_5X5_100", 7.0)),
        BoardModel(9, 5, 18.0, CharucoModel("DICT_5X5_100", 13.0, legacy=True)),
        BoardModel(8, 5, 10.0),
    ],
    ids=["charuco", "legacy", "plain"],
)
def test_all_corners_of_a_board_are_where_they_should_be(run: Run, board: BoardModel) -> None:
    words = ["--columns", board.columns, "--rows", board.rows, "--square-mm", board.square_mm]
    if board.charuco is not None:
        words += ["--dictionary", board.charuco.dictionary, "--marker-mm", board.charuco.marker_mm]
        words += ["--legacy"] if board.charuco.legacy else []
    assert run("board", "b.pdf", *words) == (0, *run_text("b.pdf", board))
    page = rendered("b.pdf")
    found = find_board_corners(page.image, board)
    assert found is not None
    pixels, ids = found
    assert sorted(ids.tolist()) == list(range(board.columns * board.rows))
    said = np.column_stack([ids % board.columns, ids // board.columns]) * board.square_mm
    off = (pixels - pixels.mean(axis=0)) / page.px_mm - (said - said.mean(axis=0))
    assert np.abs(off).max() < TOLERANCE * board.square_mm * (board.columns - 1) / 2
    if board.charuco is not None and board.charuco.legacy:
        other = BoardModel(9, 5, 18.0, CharucoModel("DICT_5X5_100", 13.0))
        fit = detect_board(page.image, None, StereoRig(scanner(page.image), None, None), other)
        assert isinstance(fit, NotFound)
        assert fit.reason.endswith("board.charuco.legacy: true")


def run_text(name: str, board: BoardModel) -> tuple[str, str]:
    """What the command prints for a board that fits on one page."""
    head = f"# {name}: 1 page of A4; print at 100 %, measure both bars of 100 mm. In session.yaml:\n"
    return head + "\n".join(setup_lines("board", board)) + "\n", ""


@pytest.mark.parametrize("paper", [(210.0, 297.0), (215.9, 279.4)], ids=["a4", "letter"])
def test_the_page_has_its_size_and_two_bars_of_100_mm(
    run: Run, paper: tuple[float, float], request: pytest.FixtureRequest
) -> None:
    name = request.node.callspec.id
    assert run("marker", "m.pdf", "--dictionary", "DICT_4X4_50", "--id", 0, "--size-mm", 20, "--paper", name)[0] == 0
    page = rendered("m.pdf")
    assert np.array(page.image.shape[::-1]) / page.px_mm == pytest.approx(paper, rel=1e-5)
    dark = 255.0 - page.image.astype(np.float64)

    def between_ends(profile: FloatArray) -> float:
        """Pixels between the first and the last line across a profile."""
        marks = np.flatnonzero(profile > 0)
        first, last = (g[np.abs(g - end) < 4] for g, end in ((marks, marks[0]), (marks, marks[-1])))
        return float(np.average(last, weights=profile[last]) - np.average(first, weights=profile[first]))

    # Across the long end lines: 3.5 mm above the bar at the foot of the page, and to the left of that at its side.
    along_x = between_ends(dark[round(page.image.shape[0] - 14.5 * page.px_mm[1])])
    along_y = between_ends(dark[:, round(11.5 * page.px_mm[0])])
    assert along_x / page.px_mm[0] == pytest.approx(100.0, rel=TOLERANCE)
    assert along_y / page.px_mm[1] == pytest.approx(100.0, rel=TOLERANCE)


def test_outlines_enclose_all_black_cells_and_nothing_else() -> None:
    cells = np.random.default_rng(5).random((9, 12)) < 0.5
    area = 0.0
    for loop in outlines(cells):
        x, y = loop.T
        area += 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))  # holes run the other way round
        steps = np.sign(np.roll(loop, -1, axis=0) - loop)
        assert (np.abs(steps).sum(axis=1) == 1).all()
        assert (steps != np.roll(steps, 1, axis=0)).any(axis=1).all()  # no corner on a straight line
    assert area == cells.sum()


TAG = "--dictionary DICT_4X4_50 --id 0 --size-mm 25"
BOARD = "--columns 9 --rows 6 --square-mm 10 --dictionary DICT_5X5_100 --marker-mm 7"
MARKER = "marker m.pdf --dictionary DICT_4X4_50"
BAD = {
    "marker m.pdf": "--dictionary: found nothing, expected an OpenCV dictionary",
    f"{MARKER}": "--id: found nothing, expected the tag's id",
    f"{MARKER} --id 0": "--size-mm: found nothing, expected a number > 0",
    f"{MARKER} --id 50 --size-mm 25": "--id: found '50', expected ids of DICT_4X4_50, 0 to 49",
    f"{MARKER} --id 1-3,2 --size-mm 25": "--id: found '1-3,2', expected each id once",
    f"{MARKER} --id 3-1 --size-mm 25": "--id: found '3-1'",
    "marker m.pdf --dictionary 4x4 --id 1 --size-mm 25": "--dictionary: found '4x4'",
    f"{MARKER} --id 0 --size-mm nan": "--size-mm: found nan, expected a number > 0",
    f"{MARKER} --id 0 --size-mm 200": "--paper a4: found a piece of 266.7 x 266.7 mm",
    f"{MARKER} --id 0-1 --rod-mm 20": "--id: found 2 of them around a rod, expected 3 or more",
    f"{MARKER} --id 0-5 --rod-mm 20 --size-mm 12": "expected at least 27.6 for tags of 12 mm",
    f"{MARKER} --id 0-5 --rod-mm 0.01 --thickness-mm 0": "--rod-mm: found 0.01",
    f"marker m.pdf {TAG} --thickness-mm 1": "--thickness-mm: found it alone, expected it with --rod-mm",
    f"marker m.pdf {TAG} --quiet-mm -1": "--quiet-mm: found -1.0, expected a number >= 0",
    f"marker m.pdf {TAG} --columns 3": "--columns: found it with a marker, expected it with a board only",
    f"marker m.pdf {TAG} --setup s.yaml": "found it, and a marker in s.yaml, expected one of the two",
    f"marker m.png {TAG}": "m.png: found a name that ends in .png, expected one in .pdf",
    f"marker foreign.pdf {TAG}": "foreign.pdf: found a file that is not a PDF of fgreg print",
    "marker m.pdf --setup none.yaml": "none.yaml: found nothing",
    "marker m.pdf --setup s.yaml": "s.yaml: marker.tags[1].marker_T_tag (line 6): found tag 5 on top of tag 3",
    "board m.pdf --setup s.yaml": "s.yaml: board: found nothing, expected the board to print",
    "board m.pdf": "--columns: found nothing, expected an integer from 2 to 200",
    f"board m.pdf {BOARD} --id 3": "--id: found it with a board, expected it with a marker only",
    f"board m.pdf {BOARD.replace(' 7', ' 11')}": "--marker-mm: found 11.0, expected less than square_mm",
    "board m.pdf --columns 9 --rows 6 --square-mm 10 --marker-mm 7": "--dictionary: found nothing",
    "board m.pdf --columns 9 --rows 5 --square-mm 10": "the board: found",
    f"board m.pdf {BOARD.replace('--square-mm 10', '--square-mm 30')}": "--paper a4: found a piece of 330.0 x 240.0 mm",
    f"board m.pdf {BOARD} --paper a3": "Invalid value for '--paper'",
}


@pytest.mark.parametrize("words", BAD)
def test_bad_input_is_one_line_and_nothing_is_written(run: Run, words: str) -> None:
    marker = {"dictionary": "DICT_4X4_50", "tags": [{"id": 3, "size_mm": 10.0}, {"id": 5, "size_mm": 5.0}]}
    Path("s.yaml").write_text(yaml_text({"marker": marker}))
    Path("foreign.pdf").write_bytes(b"%PDF-1.4 of somebody else")
    status, out, err = run(*words.split())
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("fgreg: error: ")
    assert BAD[words] in err
    assert sorted(path.name for path in Path().iterdir()) == ["foreign.pdf", "s.yaml"]
    assert Path("foreign.pdf").read_bytes() == b"%PDF-1.4 of somebody else"


def test_what_is_implausible_is_printed_with_a_warning(run: Run) -> None:
    status, _, err = run("marker", "m.pdf", *TAG.replace("25", "0.025").split())
    assert status == 0
    assert err.startswith("fgreg: warning: marker.tags.size_mm: 0.025 mm is hardly the size of a tag")


def test_without_reportlab_the_extra_is_named(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("reportlab")] + ["reportlab.pdfgen.canvas"]:
        monkeypatch.setitem(sys.modules, name, None)
    status, _, err = run("marker", "m.pdf", *TAG.split())
    assert (status, err) == (
        2,
        "fgreg: error: reportlab is not installed; install it with: pip install 'fgreg[print]'\n",
    )
