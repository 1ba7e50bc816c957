"""Whatever is done to a valid CONFIG.yaml, reading it either succeeds or raises one line; nothing is opened."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fgreg.errors import InputError
from fgreg.live.config import LiveConfig, read_config
from fgreg.live.config_keys import example_config
from fgreg.stage.limits import MotionLimits
from tests import live_configs
from tests.test_bad_input_anything import QUICK, damaged, dumped, mutated, outcome

pytest.importorskip("pyigtl", reason="pyigtl is not installed: pip install 'fgreg[igtl]'")
pytest.importorskip("serial", reason="pyserial is not installed: pip install 'fgreg[stage]'")


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        live_configs.write(Path(name))
        yield Path(name)


def read(folder: Path, content: bytes) -> LiveConfig | None:
    """What was read, where it was; then it is usable."""
    threads = threading.active_count()
    path = folder / "live.yaml"
    path.write_bytes(content)
    found = outcome(lambda: read_config(path))
    assert threading.active_count() == threads
    if isinstance(found, InputError):
        return None
    limits = MotionLimits.of_session(found.model.stage, **found.stage_limits)
    assert 0 < limits.track_speed_rad_s < 0.53
    assert limits.marker_age_s <= 0.2
    assert found.settings.hearing_threshold > 0
    for several in found.devices.values():
        for chosen in several:
            assert isinstance(chosen.options, chosen.entry.options)
    return found


@QUICK
@given(data=mutated(live_configs.config))
def test_a_mutated_config(folder: Path, data: Any) -> None:
    found = read(folder, dumped(data))
    assert found is None or found.path == folder / "live.yaml"


@QUICK
@given(data=mutated(lambda: yaml.safe_load(example_config())))
def test_a_mutated_example(folder: Path, data: Any) -> None:
    found = read(folder, dumped(data))
    assert found is None or found.path == folder / "live.yaml"


@QUICK
@given(data=damaged(example_config().encode()))
def test_damaged_bytes(folder: Path, data: bytes) -> None:
    found = read(folder, data)
    assert found is None or found.path == folder / "live.yaml"


@QUICK
@given(text=st.text(max_size=80))
def test_any_text(folder: Path, text: str) -> None:
    assert read(folder, text.encode("utf-8", "replace")) is None


def test_the_config_that_is_mutated_is_valid(folder: Path) -> None:
    assert read(folder, dumped(live_configs.config())) is not None
