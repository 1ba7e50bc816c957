"""Results in the files of other programs, each read back by something else than what wrote it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
import pytest
import yaml
from typer.testing import CliRunner

from fgreg.cli.main import app
from fgreg.convert.export import WRITERS
from fgreg.errors import FgregError, InputError
from fgreg.geometry.transforms import exp_so3
from tests import session_files

RUNNER = CliRunner()
# A turn of 0.6 rad about (1, 2, 2) / 3, then (12.5, -34.25, 81) mm: no symmetry that could hide a wrong direction.
TURN = np.array([0.2, 0.4, 0.4])
MATRIX = np.eye(4)
MATRIX[:3, :3] = exp_so3(TURN)
MATRIX[:3, 3] = (12.5, -34.25, 81.0)
ROWS = MATRIX.tolist()
CAMERA_P = np.array([3.0, -7.0, 95.0])
TRUS_P = (MATRIX @ [*CAMERA_P, 1.0])[:3]


def result(folder: Path, *, verdict: str = "ok", matrix: Any = ROWS, reasons: Any = ("plain words",)) -> Path:
    """A session's folder with a result of two epochs, the second the one to export."""
    data = session_files.result()
    last = {**data["epochs"][0], "index": 1, "start_s": 50.0, "trus_T_camera": matrix, "verdict": verdict}
    data |= {"epochs": [data["epochs"][0], last], "verdict": verdict, "reasons": list(reasons)}
    folder.mkdir(exist_ok=True)
    session_files.write(folder)
    (folder / "result.yaml").write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return folder


def convert(*words: object) -> Any:
    return RUNNER.invoke(app, ["convert", *map(str, words)])


def refused(*words: object) -> str:
    """The one line of an input error."""
    done = convert(*words)
    assert isinstance(done.exception, FgregError), done.output
    assert str(done.exception).isprintable()
    return str(done.exception)


def test_plus_maps_camera_points_to_trus_in_millimetres(tmp_path: Path) -> None:
    out = tmp_path / "registration.xml"
    done = convert(result(tmp_path / "s"), out)
    assert done.exit_code == 0, done.output
    found = ElementTree.parse(out).getroot().find("CoordinateDefinitions/Transform")
    assert found is not None
    assert (found.get("From"), found.get("To")) == ("Camera", "Trus")
    matrix = np.array([float(word) for word in str(found.get("Matrix")).split()]).reshape(4, 4)
    np.testing.assert_allclose(matrix @ [*CAMERA_P, 1.0], [*TRUS_P, 1.0], atol=1e-5)
    assert found.get("Error") == "0.710"
    assert found.get("Date")


def test_ros_has_trus_as_parent_and_metres(tmp_path: Path) -> None:
    out = tmp_path / "registration.yaml"
    assert convert(result(tmp_path / "s"), out).exit_code == 0
    found = yaml.safe_load(out.read_text(encoding="utf-8"))
    assert (found["header"]["frame_id"], found["child_frame_id"]) == ("trus", "camera")
    shift, turn = found["transform"]["translation"], found["transform"]["rotation"]
    assert [shift[key] for key in "xyz"] == pytest.approx([0.0125, -0.03425, 0.081])
    # Half angle 0.3 about (1, 2, 2) / 3, by hand.
    expected = [math.sin(0.3) / 3, 2 * math.sin(0.3) / 3, 2 * math.sin(0.3) / 3, math.cos(0.3)]
    assert [turn[key] for key in "xyzw"] == pytest.approx(expected, abs=1e-8)


def test_slicers_transform_file_read_by_simpleitk_takes_trus_points_back_to_camera_points(tmp_path: Path) -> None:
    sitk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed")
    out = tmp_path / "registration.tfm"
    assert convert(result(tmp_path / "s"), out).exit_code == 0
    transform = sitk.ReadTransform(str(out))

    def lps(point: npt.NDArray[np.float64]) -> list[float]:
        return [float(v) for v in point * [-1, -1, 1]]

    # A resampling transform: from the parent's (TRUS) points to the node's (camera), all in LPS.
    np.testing.assert_allclose(transform.TransformPoint(lps(TRUS_P)), lps(CAMERA_P), atol=1e-5)
    np.testing.assert_allclose(transform.GetInverse().TransformPoint(lps(CAMERA_P)), lps(TRUS_P), atol=1e-5)


def test_json_has_the_covariance_the_verdict_and_its_reasons(tmp_path: Path) -> None:
    out = tmp_path / "registration.json"
    assert convert(result(tmp_path / "s", verdict="warning"), out).exit_code == 0
    found = json.loads(out.read_text(encoding="utf-8"))
    assert (found["from"], found["to"], found["epoch"], found["verdict"]) == ("camera", "trus", 1, "warning")
    np.testing.assert_allclose(found["trus_T_camera"], MATRIX, atol=1e-5)
    assert found["covariance"][3][3] == 0.01
    assert found["reasons"] == ["plain words"]
    assert found["predicted_tre_mm"] == {"mean": 0.71, "worst": 1.4}
    assert found["forced"] is False


def test_another_epoch_is_exported_where_it_is_asked_for(tmp_path: Path) -> None:
    out = tmp_path / "r.json"
    folder = result(tmp_path / "s")
    assert convert(folder / "result.yaml", out, "--epoch", 0).exit_code == 0
    found = json.loads(out.read_text(encoding="utf-8"))
    np.testing.assert_allclose(found["trus_T_camera"], np.array(session_files.QUARTER))
    assert "expected one of 0, 1" in refused(folder, tmp_path / "o.json", "--epoch", 7)


@pytest.mark.parametrize("suffix", ["xml", "yaml", "tfm", "json"])
def test_a_refused_result_is_exported_with_force_only_and_the_file_says_so(tmp_path: Path, suffix: str) -> None:
    reason = "ambiguous -- two minima <fit> alike\nby 40 mm"
    folder = result(tmp_path / "s", verdict="refused", reasons=[reason])
    out = tmp_path / f"r.{suffix}"
    assert "the verdict refused (ambiguous" in refused(folder, out)
    assert not out.exists()
    done = convert(folder, out, "--force")
    assert done.exit_code == 0, done.output
    assert "REFUSED" in done.stdout
    text = out.read_text(encoding="utf-8")
    if suffix == "json":
        found = json.loads(text)
        assert found["verdict"] == "refused"
        assert found["forced"] is True
        assert found["reasons"] == [reason]
    else:
        assert "DO NOT USE" in text
        assert "two minima <fit> alike\\nby 40 mm" in text
    # Still what its reader takes.
    if suffix == "xml":
        assert ElementTree.fromstring(text).find("CoordinateDefinitions/Transform") is not None
    if suffix == "yaml":
        assert yaml.safe_load(text)["child_frame_id"] == "camera"
    if suffix == "tfm":
        sitk = pytest.importorskip("SimpleITK", reason="SimpleITK is not installed")
        assert sitk.ReadTransform(str(out)).TransformPoint((0.0, 0.0, 0.0))


def test_a_good_result_with_a_refused_epoch_is_refused_for_that_epoch(tmp_path: Path) -> None:
    folder = result(tmp_path / "s")
    data = yaml.safe_load((folder / "result.yaml").read_text(encoding="utf-8"))
    data["epochs"][1]["verdict"] = "refused"
    (folder / "result.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    assert "epoch 1: found the verdict refused" in refused(folder, tmp_path / "r.tfm")
    assert convert(folder, tmp_path / "r.tfm", "--epoch", 0).exit_code == 0


def test_an_epoch_without_a_transform_is_not_exported_even_by_force(tmp_path: Path) -> None:
    folder = result(tmp_path / "s", verdict="refused", matrix=None)
    data = yaml.safe_load((folder / "result.yaml").read_text(encoding="utf-8"))
    data["epochs"][1]["covariance"] = data["epochs"][1]["predicted_tre_mm"] = None
    (folder / "result.yaml").write_text(yaml.safe_dump(data), encoding="utf-8")
    assert "found no transform" in refused(folder, tmp_path / "r.tfm", "--force")


def test_what_is_there_stays_there_unless_overwriting_is_asked_for(tmp_path: Path) -> None:
    folder, out = result(tmp_path / "s", verdict="warning"), tmp_path / "r.json"
    out.write_text("mine", encoding="utf-8")
    assert "found a file of this name" in refused(folder, out)
    assert out.read_text(encoding="utf-8") == "mine"
    assert "a file that is not a JSON file of fgreg" in refused(folder, out, "--overwrite")
    assert out.read_text(encoding="utf-8") == "mine"
    out.unlink()
    for suffix in WRITERS:
        for _ in range(2):  # its own older file is told by its content, whatever the verdict says at its head
            assert convert(folder, tmp_path / f"r{suffix}", "--overwrite").exit_code == 0
        (tmp_path / f"r{suffix}").unlink()
    assert convert(folder, out).exit_code == 0
    assert "own file" in refused(folder, folder / "session.yaml", "--overwrite")
    assert "own file" in refused(folder, folder / "result.yaml", "--overwrite")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r.json", "s"]


def test_what_cannot_be_converted_is_reported_in_one_line(tmp_path: Path) -> None:
    folder = result(tmp_path / "s")
    assert "expected one in .xml" in refused(folder, tmp_path / "r.stl")
    assert "found nothing, expected a recording" in refused(tmp_path / "nowhere", tmp_path / "r.xml")
    assert "--setup: found it with a result" in refused(folder, tmp_path / "r.xml", "--setup", folder)
    (folder / "result.yaml").unlink()
    assert "fgreg solve first" in refused(folder, tmp_path / "r.xml")
    (tmp_path / "e").mkdir()
    assert "a folder of another kind" in refused(tmp_path / "e", tmp_path / "r.xml")
    (tmp_path / "r.yaml").write_text("format: other\n", encoding="utf-8")
    assert "fgreg-result/1" in refused(tmp_path / "r.yaml", tmp_path / "r.xml")
    assert isinstance(convert(folder, "nowhere/x/r.xml").exception, InputError)
