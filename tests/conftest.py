"""Simulated sessions on disk that several tests read."""

from __future__ import annotations

import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import pytest

from fgreg.workers.threads import NAMES

# One thread for linear algebra, as in commands: pytest's -n gives every core a process. Set before they are loaded.
os.environ.update({name: "1" for name in NAMES if name not in os.environ})

from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Started in the background: programs that tests start would ignore Ctrl-C, too.
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def _pose_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sessions") / "poses"
    write_session(simulate(replace(PRESETS["first-hit"], pairs=20), 2), folder)
    return folder


@pytest.fixture(scope="session")
def _raw_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sessions") / "raw"
    write_session(simulate(replace(PRESETS["raw-small"], aims=6, pairs=8), 3), folder)
    return folder


@pytest.fixture
def pose_session(_pose_session: Path, tmp_path: Path) -> Path:
    """A copy of a pose-level session with 12 aims, 20 first-hit pairs and 4 tracks."""
    return Path(shutil.copytree(_pose_session, tmp_path / "poses"))


@pytest.fixture
def raw_session(_raw_session: Path, tmp_path: Path) -> Path:
    """A copy of a session of raw frames with 6 aims, 8 first-hit pairs and 2 tracks."""
    return Path(shutil.copytree(_raw_session, tmp_path / "raw"))
