"""CSV tables as sessions: the same events as were written, other columns by a mapping, and clear refusals."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from fgreg.cli.main import app
from fgreg.errors import FgregError
from fgreg.geometry.transforms import exp_so3
from fgreg.pipeline.solve import SolveRequest, solve_session
from fgreg.session.session_reader import read_session
from tests import session_files

RUNNER = CliRunner()
POSE = "1 0 0 10  0 0 -1 20  0 1 0 150  0 0 0 1"


def convert(*words: object) -> Any:
    return RUNNER.invoke(app, ["convert", *map(str, words)])


def refused(*words: object) -> str:
    done = convert(*words)
    assert isinstance(done.exception, FgregError), done.output
    assert str(done.exception).isprintable()
    return str(done.exception)


def setup(folder: Path, **changes: Any) -> Path:
    path = folder / "setup.yaml"
    path.write_text(yaml.safe_dump(session_files.setup() | changes, sort_keys=False), encoding="utf-8")
    return path


def table(folder: Path, text: str) -> Path:
    path = folder / "shots.csv"
    path.write_text(text, encoding="utf-8")
    return path


def mapping(folder: Path, **content: Any) -> Path:
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump({"format": "fgreg-mapping/1", **content}), encoding="utf-8")
    return path


def events(folder: Path) -> list[dict[str, Any]]:
    lines = (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines[1:]]  # the first is the note on where it came from


def test_a_session_written_as_a_table_comes_back_and_is_solved_the_same(pose_session: Path, tmp_path: Path) -> None:
    recorded = [json.loads(line) for line in (pose_session / "events.jsonl").read_text().splitlines()]
    path = tmp_path / "shots.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        roles = ["t", "type", "pm", "camera_T_marker", "spot_x_mm", "spot_y_mm", "spot_z_mm"]
        roles += ["scan_deg", "x_mm", "range_mm", "sweep"]
        writer = csv.DictWriter(file, roles)
        writer.writeheader()
        for event in recorded:
            row = {"t": repr(event["t"]), "type": event["type"], "pm": event.get("pm")}
            row["camera_T_marker"] = " ".join(repr(v) for line in event["marker"]["camera_T_marker"] for v in line)
            if event["type"] == "aim":
                row |= dict(zip(("spot_x_mm", "spot_y_mm", "spot_z_mm"), event["camera_p_spot_mm"], strict=True))
            look = event.get("trus", {"scan_deg": event.get("scan_deg")})
            row |= {key: look.get(key) for key in ("scan_deg", "x_mm", "range_mm", "sweep")}
            writer.writerow(row)
    done = convert(path, tmp_path / "out", "--setup", pose_session)
    assert done.exit_code == 0, done.output
    assert "12 aim, 20 pair, 4 track; 0 frames" in done.stdout
    assert "covariance" not in json.dumps(recorded)  # a table has no place for them
    assert events(tmp_path / "out") == recorded
    first = solve_session(SolveRequest(pose_session, tmp_path / "a.yaml")).estimate.epochs[-1].trus_T_camera
    again = solve_session(SolveRequest(tmp_path / "out")).estimate.epochs[-1].trus_T_camera
    assert first is not None
    assert again is not None
    np.testing.assert_array_equal(first, again)


def test_other_columns_units_and_constants_by_a_mapping(tmp_path: Path) -> None:
    text = "# exported by a tracker\nms;Winkel;qx;qy;qz;qw;px;py;pz;lat;r;egal\n"
    text += "1500;0.5;0;0;0;1;1;2;150;3.25;31.5;9\n\n2500;-0.5;0.6;0;0;0.8;1;2;150;3.5;30;9\n"
    quaternion = {f"marker_q{axis}": f"q{axis}" for axis in "xyzw"}
    position = {f"marker_{axis}_mm": {"column": f"p{axis}", "scale": 1.0, "offset": 0.5} for axis in "xyz"}
    columns: dict[str, Any] = {**quaternion, **position, "t": {"column": "ms", "scale": 0.001}, "x_mm": "lat"}
    columns |= {"range_mm": "r", "scan_deg": {"column": "Winkel", "scale": 10.0}, "pm": {"value": 4}}
    done = convert(
        table(tmp_path, text), tmp_path / "s", "--setup", setup(tmp_path), "--map", mapping(tmp_path, columns=columns)
    )
    assert done.exit_code == 0, done.output
    first, second = events(tmp_path / "s")
    assert (first["t"], first["pm"], first["type"]) == (1.5, 4, "pair")
    assert first["trus"] == {"scan_deg": 5.0, "x_mm": 3.25, "range_mm": 31.5}
    assert [row[3] for row in first["marker"]["camera_T_marker"]] == [1.5, 2.5, 150.5, 1.0]
    # Half angle with sine 0.6: cosine of the turn 1 - 2 * 0.36 = 0.28, sine 0.96.
    turned = np.array(second["marker"]["camera_T_marker"])[:3, :3]
    np.testing.assert_allclose(turned, np.array([[1, 0, 0], [0, 0.28, -0.96], [0, 0.96, 0.28]]), atol=1e-12)
    note = json.loads((tmp_path / "s" / "events.jsonl").read_text().splitlines()[0])
    assert note["text"] == "converted from CSV table shots.csv; columns that are not used: egal"


def test_pictures_and_arrays_become_the_sessions_own_frames(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    picture = np.random.default_rng(1).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "raw" / "left 1.bmp"), picture)
    (tmp_path / "raw" / "right.png").write_bytes(session_files.png(640, 480))
    np.save(tmp_path / "raw" / "pa.npy", np.zeros((128, 16), dtype=np.float32))
    text = "t,type,pm,left,right,scan_deg,frame,corner_column,corner_row\n"
    text += "1,aim,,raw/left 1.bmp,raw/right.png,,,3,2\n2,pair,5,raw/left 1.bmp,raw/right.png,-4,raw/pa.npy,,\n"
    done = convert(table(tmp_path, text), tmp_path / "s", "--setup", setup(tmp_path))
    assert done.exit_code == 0, done.output
    aim, pair = events(tmp_path / "s")
    assert aim["corner"] == [3, 2]
    assert pair["marker"] == aim["marker"]  # one file, one observation
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "s" / pair["marker"]["left"])), picture)
    assert np.load(tmp_path / "s" / pair["trus"]["frame"]).shape == (128, 16)
    assert len(list((tmp_path / "s" / "frames").iterdir())) == 3
    assert len(read_session(tmp_path / "s").events) == 3
    cv2.imwrite(str(tmp_path / "raw" / "right.png"), np.zeros((480, 640, 4), np.uint8))
    said = refused(table(tmp_path, text), tmp_path / "t", "--setup", setup(tmp_path))
    assert "right.png: found a picture with transparent parts" in said
    assert not (tmp_path / "t").exists()


def test_moves_tracks_and_notes(tmp_path: Path) -> None:
    text = "t,type,camera_T_marker,marker_rx_rad,marker_ry_rad,marker_rz_rad,marker_x_mm,marker_y_mm,marker_z_mm,"
    text += f"scan_deg,camera_new_T_camera_old,text\n1,camera_moved,,,,,,,,,{POSE},\n2,note,,,,,,,,,,hello\n"
    text += f"3,track,{POSE},,,,,,,7.5,,\n4,track,,0.2,0.4,0.4,1,2,150,8,,\n"
    done = convert(table(tmp_path, text), tmp_path / "s", "--setup", setup(tmp_path))
    assert done.exit_code == 0, done.output
    moved, note, track, turned = events(tmp_path / "s")
    assert moved["camera_new_T_camera_old"] == session_files.QUARTER
    assert note["text"] == "hello"
    assert track["scan_deg"] == 7.5
    expected = exp_so3(np.array([0.2, 0.4, 0.4]))
    np.testing.assert_allclose(np.array(turned["marker"]["camera_T_marker"])[:3, :3], expected)


ROW = "t,camera_T_marker,scan_deg,x_mm,range_mm,pm\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "shots.csv: found nothing, expected a table"),
        ("time,scan_deg\n1,2\n", "header: found time, scan_deg, expected a column t"),
        ("t,t\n1,2\n", "header: found the column 't' twice"),
        (ROW, "no events"),
        (ROW + f"1,{POSE},2,3\n", "line 2: found 4 cells, expected 6"),
        (ROW + f"1,{POSE},2,3,x,0\n", "line 2: range_mm: found 'x', expected a finite number"),
        (ROW + f'1,{POSE},2,"3,5",30,0\n', "line 2: x_mm: found '3,5'"),
        (ROW + f"1,{POSE},2,3,nan,0\n", "line 2: range_mm: found 'nan'"),
        (ROW + f"1,{POSE},2,3,,0\n", "shots.csv: line 2: trus.range_mm: found nothing"),
        (ROW + f"1,{POSE},2,3,900,0\n", "shots.csv: line 2: trus.range_mm: found 900"),
        (ROW + f"1,{POSE},2,3,30,0.5\n", "line 2: pm: found 0.5, expected a whole number"),
        (ROW + "1,1 2 3,2,3,30,0\n", "line 2: camera_T_marker: found '1 2 3', expected a rigid 4x4 matrix"),
        (
            ROW + f"2,{POSE},2,3,30,0\n1,{POSE},2,3,30,0\n",
            "line 3: t: found 1, expected at least 2, the time on line 2",
        ),
        (ROW + "1,,2,3,30,0\n", "line 2: marker: found neither camera_T_marker nor left"),
        ("t,type\n1,sneeze\n", "line 2: type: found 'sneeze'"),
        ('t,type\n1,"x\n', "line 2"),
        ("t,scan_deg,pm,x_mm,range_mm,left\n1,2,0,3,30,gone.png\n", "left: found 'gone.png': no such file"),
    ],
)
def test_a_bad_table_is_one_line_that_names_its_own_and_leaves_nothing(tmp_path: Path, text: str, message: str) -> None:
    path = table(tmp_path, text)
    assert message in refused(path, tmp_path / "s", "--setup", setup(tmp_path))
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["setup.yaml", "shots.csv"]


def test_a_number_that_its_scale_makes_infinite_is_one_line(tmp_path: Path) -> None:
    path, mapping = table(tmp_path, ROW + f"1,{POSE},2,3,30,1e308\n"), tmp_path / "map.yaml"
    mapping.write_text("format: fgreg-mapping/1\ncolumns: {pm: {column: pm, scale: 100}}\n")
    said = refused(path, tmp_path / "s", "--setup", setup(tmp_path), "--map", str(mapping))
    assert "line 2: pm: found '1e308' times 100 plus 0, expected a finite number" in said


def test_a_bad_setup_or_mapping_is_reported_by_its_own_name(tmp_path: Path) -> None:
    path = table(tmp_path, ROW + f"1,{POSE},2,3,30,0\n")
    assert "--setup: found nothing" in refused(path, tmp_path / "s")
    bad = setup(tmp_path, stage={"step_deg": -1})
    assert "setup.yaml: stage.step_deg" in refused(path, tmp_path / "s", "--setup", bad)
    good = setup(tmp_path)
    wrong = mapping(tmp_path, columns={"t": "zeit"})
    assert "no column 'zeit', which the mapping has for t" in refused(
        path, tmp_path / "s", "--setup", good, "--map", wrong
    )
    wrong = mapping(tmp_path, colums={"t": "t"})
    assert "did you mean columns?" in refused(path, tmp_path / "s", "--setup", good, "--map", wrong)
    wrong = mapping(tmp_path, columns={"t": {"column": "t", "value": 3}})
    assert "both column and value" in refused(path, tmp_path / "s", "--setup", good, "--map", wrong)
    assert not (tmp_path / "s").exists()


def test_a_session_that_is_there_is_replaced_only_when_the_new_one_is_whole(tmp_path: Path) -> None:
    good = table(tmp_path, ROW + f"1,{POSE},2,3,30,0\n")
    where = setup(tmp_path)
    assert convert(good, tmp_path / "s", "--setup", where).exit_code == 0
    before = (tmp_path / "s" / "events.jsonl").read_bytes()
    assert "not empty" in refused(good, tmp_path / "s", "--setup", where)
    bad = table(tmp_path, ROW + f"1,{POSE},2,3,900,0\n")
    refused(bad, tmp_path / "s", "--setup", where, "--overwrite")
    assert (tmp_path / "s" / "events.jsonl").read_bytes() == before
    other = table(tmp_path, ROW + f"5,{POSE},2,3,30,0\n")
    assert convert(other, tmp_path / "s", "--setup", where, "--overwrite").exit_code == 0
    assert events(tmp_path / "s")[0]["t"] == 5.0
    (tmp_path / "s" / "shots.csv").write_bytes(other.read_bytes())
    inside = tmp_path / "s" / "shots.csv"
    assert "inside of" in refused(inside, tmp_path / "s", "--setup", where, "--overwrite")
    assert inside.is_file()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years")
    assert "no session to overwrite" in refused(good, tmp_path / "mine", "--setup", where, "--overwrite")


def test_a_calibration_becomes_the_camera_of_a_setup_that_has_none(tmp_path: Path) -> None:
    k = np.array([[9e2, 0, 320], [0, 9e2, 240], [0, 0, 1.0]])
    path = tmp_path / "stereo.yml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in {
        "M1": k,
        "D1": np.array([1e-05, 0, 0, 0]),
        "M2": k,
        "R": np.eye(3),
        "T": np.array([-5.0, 0, 0]),
    }.items():
        file.write(key, value)
    file.write("image_width", 640)
    file.write("image_height", 480)
    file.release()
    data = session_files.setup()
    del data["camera"]
    without = tmp_path / "without.yaml"
    without.write_text(yaml.safe_dump(data), encoding="utf-8")
    shots = table(tmp_path, ROW + f"1,{POSE},2,3,30,0\n")
    done = convert(shots, tmp_path / "s", "--setup", without, "--calibration", path)
    assert done.exit_code == 0, done.output
    camera = read_session(tmp_path / "s").model.camera
    assert camera is not None
    assert camera.right_T_left is not None
    assert camera.left.distortion[0] == 1e-05
    assert camera.right_T_left[0, 3] == -5.0
    message = refused(shots, tmp_path / "o", "--setup", setup(tmp_path), "--calibration", path)
    assert "it, and a camera in setup.yaml" in message
    assert "--rectified: found it alone" in refused(shots, tmp_path / "o", "--setup", without, "--rectified")
    options = ["--setup", without, "--calibration", path, "--calibration-size"]
    assert "expected 1280 x 720 px" in refused(shots, tmp_path / "o", *options, "1280x720")
    assert "such as 1280x720" in refused(shots, tmp_path / "o", *options, "1280 by 720")
    assert "--calibration-size: found it alone" in refused(
        shots, tmp_path / "o", "--setup", without, "--calibration-size", "1x1"
    )
