"""``fgreg calibrate-camera`` from rendered pictures to a session, and its messages."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from fgreg.cli.main import _exit_status
from fgreg.convert.camera_file import read_camera
from fgreg.geometry.transforms import make_transform
from fgreg.simulation.config import default_rig
from fgreg.simulation.render import Optics, render_frame
from fgreg.simulation.surfaces import Background, BoardSurface
from tests.calibration_views import BOARD, board_poses

RIG = default_rig(640)
OPTIONS = ["--columns", "9", "--rows", "6", "--square-mm", "9", "--marker-mm", "6.5", "--dictionary", "DICT_5X5_100"]
VIEWS = 10


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders left and right of rendered views, odd with them paired wrongly, both.avi with the views side by side."""
    folder = tmp_path_factory.mktemp("pictures")
    rng = np.random.default_rng(3)
    video = cv2.VideoWriter(str(folder / "both.avi"), cv2.VideoWriter.fourcc(*"FFV1"), 5.0, (1280, 360))
    assert RIG.right_T_left is not None
    far = Background(make_transform(np.eye(3), np.array([0.0, 0.0, 250.0])))
    for i, pose in zip(range(VIEWS), board_poses(rng, 35.0, 20.0), strict=False):
        frames = []
        for side, camera, camera_T_left in (("left", RIG.left, np.eye(4)), ("right", RIG.right, RIG.right_T_left)):
            assert camera is not None
            board = BoardSurface(BOARD, camera_T_left @ pose)
            frames.append(render_frame(camera, [board], rng, Optics(), far.seen_from(camera_T_left)))
            (folder / side).mkdir(exist_ok=True)
            cv2.imwrite(str(folder / side / f"{i:03d}.png"), frames[-1])
            (folder / "odd" / side).mkdir(parents=True, exist_ok=True)  # each right picture beside the left one before
            number = (i + 1) % VIEWS if side == "right" else i
            (folder / "odd" / side / f"{number:03d}.png").write_bytes((folder / side / f"{i:03d}.png").read_bytes())
        video.write(cv2.cvtColor(np.hstack(frames), cv2.COLOR_GRAY2BGR))
    video.release()
    return folder


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    status = _exit_status(["calibrate-camera", *map(str, arguments)])
    said = capsys.readouterr()
    return status, said.out, said.err


def test_pictures_become_the_camera_of_a_session(
    pictures: Path, pose_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.yaml"
    status, text, _ = run(capsys, pictures, *OPTIONS, "--out", out, "--json")
    assert status == 0
    report = json.loads(text)
    assert report["pictures"] == len(report["views"]) == VIEWS
    assert report["corners"]["sigma_px"] < 0.1
    for side, camera in (("left", RIG.left), ("right", RIG.right)):
        assert camera is not None
        found = np.array(report["camera"][side]["matrix"])[[0, 1, 0, 1], [0, 1, 2, 2]]
        true = camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        sigma = np.array([report["sigma"][f"{side}.{name}"] for name in ("fx", "fy", "cx", "cy")])
        assert (np.abs(found - true) < 4.0 * sigma).all()
    # What is written is what a session reads, and what a check starts from.
    session = tmp_path / "session"
    session.mkdir()
    (session / "events.jsonl").write_bytes((pose_session / "events.jsonl").read_bytes())
    setup = yaml.safe_load((pose_session / "session.yaml").read_text(encoding="utf-8"))
    for key in ("camera", "systematic"):
        setup.pop(key, None)
    (session / "session.yaml").write_text(yaml.safe_dump(setup) + out.read_text(encoding="utf-8"), encoding="utf-8")
    assert _exit_status(["check", str(session)]) == 0
    capsys.readouterr()
    for file in (out, session / "session.yaml"):
        again = read_camera(file)
        assert again.rig.right_T_left is not None
        np.testing.assert_allclose(again.rig.right_T_left, report["camera"]["right_T_left"], atol=1e-9)
        assert np.sqrt(np.diag(again.covariance))[:18] == pytest.approx(list(report["sigma"].values())[:18])
    status, text, _ = run(capsys, pictures, "--check", out, "--limit-mm", "5")
    assert status == 0
    assert text.startswith("HOLDS")
    assert f"{VIEWS} views" in text
    # Exchanged pictures fit as well, but the cameras are on the wrong sides.
    status, _, error = run(capsys, pictures / "right", pictures / "left", *OPTIONS, "--out", tmp_path / "other.yaml")
    assert status == 0
    assert "were left and right pictures exchanged?" in error
    # A calibration whose principal point is off is told.
    wrong = tmp_path / "wrong.yaml"
    document = yaml.safe_load(out.read_text(encoding="utf-8"))
    document["camera"]["left"]["matrix"][0][2] += 4.0
    wrong.write_text(yaml.safe_dump(document), encoding="utf-8")
    status, text, _ = run(capsys, pictures, "--check", wrong)
    assert status == 1
    assert text.startswith("CHANGED")
    assert "left principal point's x by -4" in text


def test_a_video_with_both_views_gives_the_same(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = []
    for source in ([pictures / "left", pictures / "right"], [pictures / "both.avi", "--layout", "side-by-side"]):
        status, _, _ = run(capsys, *source, *OPTIONS, "--out", tmp_path / "camera.yaml", "--quiet")
        assert status == 0
        found.append(read_camera(tmp_path / "camera.yaml").rig)
    np.testing.assert_allclose(found[0].left.matrix, found[1].left.matrix, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["left", *OPTIONS, "--out", "x.yaml"], "RIGHT: found nothing"),
        (["left", "nowhere", *OPTIONS, "--out", "x.yaml"], "nowhere: found nothing, expected a folder of pictures"),
        (["left", "both.avi", *OPTIONS, "--out", "x.yaml"], "a folder beside a video"),
        ([".", *OPTIONS], "--out, --check: found nothing"),
        ([".", *OPTIONS, "--out", "x.yaml", "--model", "thick"], "expected one of pinhole5, pinhole8, fisheye"),
        ([".", "--columns", "9", "--rows", "7", "--square-mm", "9", "--out", "x.yaml"], "--columns: found 9 x 7"),
        ([".", "--out", "x.yaml"], "--setup: found nothing"),
        ([".", *OPTIONS[:-1], "DICT_6X6_100", "--out", "x.yaml"], "the board in 0 of 10 pictures"),
        (["odd", *OPTIONS, "--out", "x.yaml"], "left and right pictures of one moment"),
        ([".", *OPTIONS, "--out", "left/000.png"], "a file that is not a camera calibration"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str],
    said: str,
    pictures: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(pictures)
    status, _, error = run(capsys, *arguments)
    assert status == 2
    assert said in error
    assert error.count("\n") == 1
    assert not Path("x.yaml").exists()
