"""The fuzzers: each valid input is read, and 500 changed ones find nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from fuzz import main, make_input, read
from fuzz_inputs import Form
from fuzz_targets import TARGETS


@pytest.mark.parametrize("name", list(TARGETS))
def test_what_the_fuzzers_change_is_valid(name: str, tmp_path: Path) -> None:
    inputs = TARGETS[name].valid()
    assert inputs
    for data in inputs:
        assert read(TARGETS[name], data, tmp_path)


def test_inputs_are_the_same_for_the_same_seed_and_differ_otherwise() -> None:
    target = TARGETS["events"]
    assert target.form is Form.LINES
    inputs = [make_input(target, 0, index) for index in range(50)]
    assert inputs == [make_input(target, 0, index) for index in range(50)]
    assert len(set(inputs)) > 40
    assert inputs != [make_input(target, 1, index) for index in range(50)]


def test_five_hundred_changed_inputs_find_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [name for name in TARGETS if name != "matlab"]  # its own process is not started from a fork of this one
    words = ["fuzz", "--inputs", "500", "--seed", "3", "--findings", str(tmp_path), "--targets", *names]
    monkeypatch.setattr("sys.argv", words)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0, capsys.readouterr().out
    assert not list(tmp_path.iterdir())
