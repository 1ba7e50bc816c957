"""What a caller sees of a command, whatever happens: exit status, and nothing on standard error but its own words."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typer

import fgreg.cli.main as command_line
from fgreg.errors import InputError


def _status(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> int:
    """Exit status of a command that meets an error."""
    app = typer.Typer()

    @app.command()
    def fails() -> None:
        raise error

    monkeypatch.setattr(command_line, "app", app)
    monkeypatch.setattr(sys, "argv", ["fgreg"])
    with pytest.raises(SystemExit) as end:
        command_line.main()
    assert isinstance(end.value.code, int)
    return end.value.code


class _Panic(BaseException):
    """As a library in Rust raises."""


@pytest.mark.parametrize(
    "error",
    [
        ValueError("two\nlines"),
        RecursionError("deep"),
        EOFError(),
        BrokenPipeError(32, "Broken pipe"),
        FileNotFoundError("x"),
        _Panic("x"),
    ],
)
def test_a_defect_is_a_crash_with_its_traceback(
    error: BaseException, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _status(monkeypatch, error) == 70
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback")
    assert lines[-1].startswith(f"fgreg: crash: {type(error).__name__}")
    assert "defect of fgreg" in lines[-1]


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (InputError("a", "b", "c"), 2, "fgreg: error: a: found b, expected c\n"),
        (MemoryError("Unable to allocate"), 2, "fgreg: error: not enough memory (Unable to allocate)\n"),
        (OSError(28, "No space left on device"), 2, "fgreg: error: this machine: No space left on device\n"),
        (OSError(36, "File name too long", "aaa"), 2, "fgreg: error: aaa: File name too long\n"),
        (KeyboardInterrupt(), 130, ""),
    ],
)
def test_what_is_no_defect_is_one_line(
    error: BaseException, status: int, line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _status(monkeypatch, error) == status
    assert capsys.readouterr().err == line


_PROGRAM = """
import ctypes, os, sys, time, warnings
import typer
import fgreg.cli.main as command_line

@command_line.app.command()
def act(how: str):
    if how in ("wait", "changed"):
        print("ready", flush=True)
        try:
            time.sleep(60)
        except KeyboardInterrupt:
            if how == "changed":
                raise ImportError("initialization failed") from None
            raise
    if how == "noisy":
        import multiprocessing, threading
        import numpy as np
        ctypes.CDLL(None).perror(b"libpng warning: iCCP")
        np.float64(1e308) * 10
        thread = threading.Thread(target=sys.stderr.write, args=("fgreg: warning: a thread's\\n",))
        thread.start()
        thread.join()
        os.system("echo child >&2")
    for i in range(20000):
        print("line", i)
    if how == "refuse":
        raise command_line.InputError("a", "b", "c")

command_line.main()
"""


def _start(how: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", _PROGRAM, "act", how], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def test_a_closed_pipe_keeps_the_status() -> None:
    with _start("refuse") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        said = process.stderr.read()
    assert process.returncode == 2
    assert said == b"fgreg: error: a: found b, expected c\n"


def test_libraries_say_nothing_and_threads_are_heard() -> None:
    with _start("noisy") as process:
        said = process.communicate(timeout=60)[1]
    assert process.returncode == 0
    assert said == b"fgreg: warning: a thread's\n"


@pytest.mark.parametrize("how", ["wait", "changed"])
def test_an_interrupt_ends_without_a_word_also_where_a_library_makes_another_error_of_it(how: str) -> None:
    with _start(how) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[1]
    assert process.returncode == 130
    assert said == b""


def test_output_that_cannot_be_written_is_one_line() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full")
    with full.open("wb") as stream:
        done = subprocess.run(
            [sys.executable, "-m", "fgreg", "schema", "session"], stdout=stream, stderr=subprocess.PIPE, check=False
        )
    assert done.returncode == 2
    assert done.stderr == b"fgreg: error: standard output: No space left on device\n"


def test_errors_that_cannot_be_told_keep_their_status() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full")
    with full.open("wb") as stream:
        done = subprocess.run([sys.executable, "-m", "fgreg", "solve", "absent"], stderr=stream, check=False)
    assert done.returncode == 2


def test_an_interrupt_while_modules_are_loaded_ends_without_a_word() -> None:
    program = "import fgreg.cli, os, signal, sys; import fgreg.__main__ as m; os.kill(os.getpid(), signal.SIGINT)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=False, timeout=60)
    assert done.returncode == -signal.SIGINT
    assert done.stderr == b""


def test_a_working_folder_that_was_removed_is_one_line(tmp_path: Path) -> None:
    program = "import os, sys; from fgreg.cli.main import main; os.mkdir('a'); os.chdir('a'); os.rmdir('../a'); main()"
    done = subprocess.run(
        [sys.executable, "-c", program, "solve", "s"], cwd=tmp_path, capture_output=True, check=False, timeout=60
    )
    assert done.returncode == 2
    assert done.stderr == b"fgreg: error: the working folder: found none: it was removed, expected one that exists\n"
