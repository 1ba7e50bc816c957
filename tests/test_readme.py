"""README's tour of five minutes: its commands run, and do what stands beside them."""

from __future__ import annotations

import shlex
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fgreg.cli.main import app

CHECKOUT = Path(__file__).resolve().parents[1]


def test_the_tour_does_what_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tour = (CHECKOUT / "README.md").read_text(encoding="utf-8").split("## Five minutes\n")[1].split("\n## ")[0]
    lines = [line.partition("#")[::2] for line in tour.splitlines() if line.startswith("    fgreg ")]
    shutil.copytree(CHECKOUT / "sessions" / "paper", tmp_path / "sessions" / "paper")
    (tmp_path / "out").mkdir()  # make demo makes it
    monkeypatch.chdir(tmp_path)
    for command, comment in lines:
        said = CliRunner().invoke(app, shlex.split(command)[1:])
        assert said.exit_code == ("refused" in comment), (command, said.output)
    assert "1 of 32 shots was left out by hand (PM 3)" in " ".join(said.output.split())
