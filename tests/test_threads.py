"""Settings of the interpreter and of linear algebra in a live session, and their restoration."""

from __future__ import annotations

import gc
import os
import subprocess
import sys

import pytest

from fgreg.cli import main
from fgreg.workers.threads import NAMES, SWITCH_S, one_thread_each, undisturbed


def test_processes_get_one_thread_each_unless_the_user_has_said_how_many(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(NAMES[1], "3")
    with one_thread_each():
        assert [os.environ[name] for name in NAMES] == ["1", "3", *["1"] * (len(NAMES) - 2)]
    assert [os.environ.get(name) for name in NAMES] == [None, "3", *[None] * (len(NAMES) - 2)]


def test_commands_run_with_one_thread_for_linear_algebra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in NAMES:
        monkeypatch.delenv(name, raising=False)
    seen: list[str | None] = []

    def run(_: list[str]) -> int:
        seen.extend(os.environ.get(name) for name in NAMES)
        return 0

    monkeypatch.setattr(main, "_run", run)
    with pytest.raises(SystemExit) as ended:
        main.main()
    assert ended.value.code == 0
    assert seen == ["1"] * len(NAMES)
    assert [os.environ.get(name) for name in NAMES] == [None] * len(NAMES)


def test_the_interpreter_is_as_before_when_a_session_ends_however_it_does() -> None:
    before = sys.getswitchinterval()

    @undisturbed()
    def session() -> None:
        assert sys.getswitchinterval() == pytest.approx(SWITCH_S)
        assert gc.get_freeze_count() > 0
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        session()
    assert sys.getswitchinterval() == before
    assert gc.get_freeze_count() == 0


@pytest.mark.skipif(sys.platform != "linux", reason="glibc")
def test_freed_memory_is_used_again_without_page_faults() -> None:
    code = """
from resource import RUSAGE_SELF, getrusage
from fgreg.workers.memory import keep_freed_memory

def faults():
    before = getrusage(RUSAGE_SELF).ru_minflt
    for _ in range(50):
        blocks = [bytearray(400_000) for _ in range(20)]
        del blocks
    return getrusage(RUSAGE_SELF).ru_minflt - before

before = faults()
print(keep_freed_memory(), before, faults())
"""
    kept, before, after = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    ).stdout.split()
    if kept == "True":  # another C library keeps its own ways
        assert int(after) < 0.2 * int(before)
