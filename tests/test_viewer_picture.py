"""The headless picture of a recording, where this machine can make one."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

from fgreg.viewer.null_viewer import open_viewer
from tests.answers import answer_from_truth
from tests.forward import make_measurements

TOOL = Path(__file__).parents[1] / "tools" / "render_recording.py"


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("render_recording", TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_world_is_seen_with_its_beams_and_sources(tool: ModuleType, tmp_path: Path) -> None:
    rng = np.random.default_rng(31)
    model, measurements, truth = make_measurements(rng, aims=0, pairs=8, noise=False)
    recording, picture = tmp_path / "a.rrd", tmp_path / "a.png"
    with open_viewer(recording, model.name) as viewer:
        viewer.session(model, 3.0)
        viewer.result(model, measurements, answer_from_truth(rng, model, measurements, truth))
    try:
        tool.render(recording, picture, size=(900, 600), view="Scene", settle_s=1.0)
    except tool.RenderError as error:
        if str(error) != tool.NO_DRIVER:
            raise
        pytest.skip(str(error))
    pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    red, green, blue = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    assert ((green > 110) & (red < 0.4 * green) & (blue < 0.9 * green)).sum() > 100  # beams
    assert ((red > 180) & (green > 0.5 * red) & (blue < 0.5 * green)).sum() > 20  # sources
    assert ((np.ptp(pixels, axis=-1) < 25) & (red > 100)).sum() > 1000  # probe
    # What is drawn fills most of the height and of the width.
    drawn = np.abs(pixels - [18, 20, 24]).max(axis=-1)[30:] > 40
    for axis, share in ((0, 0.6), (1, 0.75)):
        places = np.flatnonzero(drawn.any(axis=axis))
        assert np.ptp(places) > share * drawn.shape[1 - axis]


def test_what_cannot_be_rendered_is_one_line_and_status_2(
    tool: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tool.main([str(tmp_path / "absent.rrd"), str(tmp_path / "a.png")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "absent.rrd does not exist" in line


def test_a_viewer_that_finds_no_driver_is_named_as_that(
    tool: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = tmp_path / "rerun"
    fake.write_text(f"#!{sys.executable}\nimport sys\nsys.exit('No graphics adapter was found')\n")
    fake.chmod(0o755)
    monkeypatch.setattr(tool, "viewer_executable", lambda: fake)
    with pytest.raises(tool.RenderError, match="mesa-vulkan-drivers"):
        tool.render(tmp_path / "a.rrd", tmp_path / "a.png", timeout_s=20.0)


@pytest.mark.parametrize("text", ["12", "axb", "10x10", "1600x99999"])
def test_a_size_that_is_none_is_refused(
    tool: ModuleType, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        tool.main(["a.rrd", str(tmp_path / "a.png"), "--size", text])
    assert text in capsys.readouterr().err
