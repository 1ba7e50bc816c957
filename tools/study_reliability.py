"""What is left when a command is killed, or the machine refuses it something.

Commands (solve, replay, convert, evaluate, simulate, live) run on copies of sessions that already have an older result
and older outputs. They are killed by SIGKILL at random moments, or run under one condition. After each run:

  inputs      session.yaml, events.jsonl (live: its whole lines), frames, truth: byte for byte as before
  outputs     the older one or a whole new one, never none and never a part
  leftovers   only hidden files or folders, which the next run removes or names
  processes   none of the command's is left after 5 s
  memory      no shared memory of it is left in /dev/shm, after another run at the latest
  status      by the list: 0, 1, 2; 130 and kills apart; one line on standard error where it is 2

    python tools/study_reliability.py                          # all conditions
    python tools/study_reliability.py --conditions killed --commands solve --runs 200
    python tools/study_reliability.py --markdown               # the table of docs/reliability.md

Conditions: killed; full disk (a tmpfs of the size it needs, less some); few open files; little memory; read-only
folder; clock set back (what exists is dated a year ahead); workers stopped (SIGSTOP to the command's children, then
killed). Some need root on Linux, and say so.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import os
import random
import resource
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from fgreg.errors import FgregError
from fgreg.session.result_file import read_result
from fgreg.session.session_reader import check_session
from fgreg.simulation.presets import FIRST_HIT
from fgreg.simulation.simulate import simulate
from fgreg.simulation.write import write_session

MARK = "FGREG_STUDY"
"""Variable of the environment by which a command's processes are found."""
WAIT_S = 5.0
LONGEST_S = 180.0
SHARED = Path("/dev/shm")


@dataclass(frozen=True, slots=True)
class Command:
    """A command of fgreg.

    Attributes:
        words: with {s} for the session and {o} for the folder of outputs.
        outputs: older ones, relative to the folder of outputs, with how to tell that one is whole.
        takes_s: latest moment of a kill.
        recording: it appends to the session's events.
    """

    words: tuple[str, ...]
    outputs: dict[str, Callable[[Path], bool]]
    takes_s: float
    recording: bool = False


def _is_result(path: Path) -> bool:
    try:
        read_result(path)
    except FgregError:
        return False
    return True


def _is_session(path: Path) -> bool:
    return not check_session(path)[0]


def _is_recording(path: Path) -> bool:
    return path.read_bytes()[:4] == b"RRF2"


def _is_table(path: Path) -> bool:
    data = path.read_bytes()
    return data.startswith(b"session,") and data.endswith(b"\n")


def _is_transform(path: Path) -> bool:
    return path.read_text().rstrip().endswith(("</PlusConfiguration>", "-->"))


COMMANDS = {
    "solve": Command(
        ("solve", "{s}", "--out", "{o}/result.yaml", "--rrd", "{o}/a.rrd", "-q"),
        {"result.yaml": _is_result, "a.rrd": _is_recording},
        2.5,
    ),
    "replay": Command(("replay", "{s}", "--out", "{o}/result.yaml", "-q"), {"result.yaml": _is_result}, 2.5),
    "convert": Command(
        ("convert", "{s}", "{o}/new.xml", "--overwrite", "--force", "-q"), {"new.xml": _is_transform}, 0.8
    ),
    "evaluate": Command(
        ("evaluate", "{s}", "--csv", "{o}/figures.csv", "--subsets", "2", "--no-leave-one-out", "-q"),
        {"figures.csv": _is_table},
        4.0,
    ),
    "simulate": Command(
        ("simulate", "{o}/made", "--preset", "first-hit", "--seed", "3", "--overwrite"), {"made": _is_session}, 1.2
    ),
    "live": Command(
        ("live", "--no-viewer", "--duration", "8", "--width", "320", "--aims", "4", "--out", "{s}", "-q"),
        {},
        12.0,
        True,
    ),
}


@dataclass(slots=True)
class Tally:
    """Runs of one command under one condition: their statuses, and what went wrong."""

    runs: int = 0
    statuses: Counter[int] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class Condition:
    """How a command is run.

    Attributes:
        kill: SIGKILL at a random moment. group: to its whole process group.
        stop_children: SIGSTOP to its children before.
        limits: of the process (resource, value).
        before: prepares the folder, and gives what undoes it; None where it cannot be done here.
    """

    kill: bool = False
    group: bool = False
    stop_children: bool = False
    limits: tuple[tuple[int, int], ...] = ()
    before: Callable[[Path], contextlib.AbstractContextManager[bool]] | None = None


@contextlib.contextmanager
def _mounted(folder: Path, option: str) -> Iterator[bool]:
    done = subprocess.run(["mount", "-o", option, str(folder), str(folder)], capture_output=True, check=False)
    try:
        yield done.returncode == 0
    finally:
        if done.returncode == 0:
            subprocess.run(["umount", "-l", str(folder)], check=False)


@contextlib.contextmanager
def _read_only(folder: Path) -> Iterator[bool]:
    with _mounted(folder, "bind") as done:
        if done:
            subprocess.run(["mount", "-o", "remount,ro,bind", str(folder)], check=True)
        yield done


@contextlib.contextmanager
def _full(folder: Path) -> Iterator[bool]:
    """The folder in a file system of its own that has a few kB left."""
    copy = folder.with_name(folder.name + "-kept")
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(folder, copy)
    size = sum(path.stat().st_size // 4096 + 2 for path in copy.rglob("*"))
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size * 4 + 64}k", "tmpfs", str(folder)], capture_output=True, check=False
    )
    try:
        if done.returncode == 0:
            shutil.copytree(copy, folder, dirs_exist_ok=True)
            left = shutil.disk_usage(folder).free
            (folder / "ballast").write_bytes(b"x" * max(0, left - random.choice([0, 2000, 20_000])))
        yield done.returncode == 0
        if done.returncode == 0:
            (folder / "ballast").unlink(missing_ok=True)
            kept = folder.with_name(folder.name + "-after")
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(folder, kept, symlinks=True)
    finally:
        if done.returncode == 0:
            subprocess.run(["umount", "-l", str(folder)], check=False)
            kept = folder.with_name(folder.name + "-after")
            if kept.is_dir():
                shutil.rmtree(folder, ignore_errors=True)
                kept.rename(folder)


@contextlib.contextmanager
def _clock_back(folder: Path) -> Iterator[bool]:
    """As after a clock that was set back by a year: what exists is of next year."""
    ahead = time.time() + 365 * 86400.0
    for path in folder.rglob("*"):
        os.utime(path, (ahead, ahead))
    yield True


CONDITIONS = {
    "killed": Condition(kill=True),
    "killed with its group": Condition(kill=True, group=True),
    "workers stopped, then killed": Condition(kill=True, stop_children=True),
    "full disk": Condition(before=_full),
    "few open files": Condition(limits=((resource.RLIMIT_NOFILE, 24),)),
    "little memory": Condition(limits=((resource.RLIMIT_AS, 700_000_000),)),
    "small files only": Condition(limits=((resource.RLIMIT_FSIZE, 2000),)),
    "read-only folder": Condition(before=_read_only),
    "clock set back": Condition(before=_clock_back),
}


def _hashes(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def _processes(mark: str) -> list[int]:
    """Processes with the mark in their environment."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                if f"{MARK}={mark}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                    found.append(int(entry.name))
    return found


def _running(mark: str) -> list[int]:
    """Those that are not only waiting to be collected."""
    out = []
    for pid in _processes(mark):
        with contextlib.suppress(OSError):
            if Path("/proc", str(pid), "stat").read_text().rpartition(")")[2].split()[0] != "Z":
                out.append(pid)
    return out


def _shared() -> set[str]:
    return {path.name for path in SHARED.glob("fgreg-*")} if SHARED.is_dir() else set()


def run(
    command: Command, session: Path, outputs: Path, condition: Condition, rng: random.Random
) -> tuple[int, str, str]:
    """Run a command once; its status, standard error and mark."""
    mark = secrets.token_hex(8)
    words = [word.format(s=session, o=outputs) for word in command.words]

    def limited() -> None:
        for what, value in condition.limits:
            resource.setrlimit(what, (value, value))

    said = tempfile.TemporaryFile()  # noqa: SIM115 - closed below
    process = subprocess.Popen(
        [sys.executable, "-m", "fgreg", *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=said,  # not a pipe: whoever is left would keep it open
        env={**os.environ, MARK: mark},
        start_new_session=True,
        preexec_fn=limited,
    )
    if condition.kill:
        deadline = time.monotonic() + rng.uniform(0.0, command.takes_s)
        while process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        if condition.stop_children:
            for pid in _processes(mark):
                if pid != process.pid:
                    with contextlib.suppress(OSError):
                        os.kill(pid, signal.SIGSTOP)
            time.sleep(0.5)
        if condition.group:
            with contextlib.suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
        for pid in _processes(mark) if condition.stop_children else ():
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGCONT)
    with said:
        try:
            process.wait(timeout=LONGEST_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return -999, "", mark
        said.seek(0)
        return process.returncode, said.read().decode("utf-8", "replace"), mark


def faults(
    command: Command,
    session: Path,
    outputs: Path,
    before: dict[str, str],
    older: dict[str, bool],
    found: tuple[int, str, str],
    condition: Condition,
) -> list[str]:
    """What is wrong after a run."""
    status, said, mark = found
    out = []
    deadline = time.monotonic() + WAIT_S
    while _running(mark) and time.monotonic() < deadline:
        time.sleep(0.05)
    for pid in _running(mark):
        out.append("a process is left")
        os.kill(pid, signal.SIGKILL)
    after = _hashes(session)
    for name, digest in before.items():
        if name == "events.jsonl" and command.recording:
            continue
        if after.get(name) != digest:
            out.append(f"an input is {'changed' if name in after else 'gone'}")
    if command.recording and (problems := check_session(session)[0]):
        out.append(f"the recording: {problems[0]}"[:100])
    if not command.recording and any(not Path(name).parts[0].startswith(".") for name in after.keys() - before.keys()):
        out.append("a file is left in the session")
    for name, is_whole in command.outputs.items():
        path = outputs / name
        if not path.exists():
            if older.get(name):
                out.append(f"{name} is gone")
        elif not is_whole(path):
            out.append(f"{name} is not whole")
    known = {name.split("/")[0] for name in command.outputs}
    known.add("ballast")
    out.extend(
        f"{path.name} is left" for path in outputs.iterdir() if path.name not in known and not path.name.startswith(".")
    )
    if status == -999:
        out.append("it hangs")
    elif not condition.kill:
        if status not in (0, 1, 2):
            out.append(f"status {status}: {said.strip().splitlines()[-1][:100] if said.strip() else ''}")
        lines = said.strip().splitlines()
        if status == 2 and (len(lines) != 1 or not lines[0].startswith("fgreg: error: ")):
            out.append(f"standard error: {said.strip()[:100]}")
    return out


def study(name: str, condition: Condition, template: Path, scratch: Path, runs: int, seed: int) -> Tally:
    """Run one command under one condition."""
    command, rng, tally = COMMANDS[name], random.Random(seed), Tally()
    place = scratch / "place"
    place.mkdir()
    session, outputs = place / "session", place / "outputs"

    def fresh() -> None:
        for folder in (session, outputs):
            shutil.rmtree(folder, ignore_errors=True)
        if command.recording:
            session.mkdir()
        else:
            shutil.copytree(template, session)
        outputs.mkdir()

    fresh()
    if not command.recording:
        run(command, session, outputs, Condition(), rng)  # the older outputs
    older = {output: (outputs / output).exists() for output in command.outputs}
    if not all(older.values()):
        tally.faults["the command does not work at all"] += 1
        return tally
    before = {} if command.recording else _hashes(session)
    shared = _shared()
    for _ in range(runs):
        if command.recording:
            fresh()
        setting = condition.before(place) if condition.before is not None else contextlib.nullcontext(True)
        with setting as possible:
            if not possible:
                tally.faults["cannot be tried here (root on Linux needed)"] += 1
                break
            found = run(command, session, outputs, condition, rng)
            if condition.before is _read_only:
                found = (found[0], found[1], found[2])
        tally.runs += 1
        tally.statuses[found[0]] += 1
        if command.recording and not (session / "session.yaml").exists():
            continue  # killed before it had begun
        tally.faults.update(faults(command, session, outputs, before, older, found, condition))
    if condition.kill:
        again = run(command, session, outputs, Condition(), rng)
        if again[0] not in (0, 1):
            tally.faults[f"the next run fails: {again[1].strip()[-100:]}"] += 1
        hidden = [path.name for path in outputs.iterdir() if path.name.startswith(".")]
        if [name for name in hidden if name not in again[1]]:
            tally.faults["leftovers that the next run neither removes nor names"] += 1
        time.sleep(0.5)
        if _shared() - shared:
            tally.faults["shared memory is left"] += 1
    shutil.rmtree(place, ignore_errors=True)
    return tally


def _row(columns: Sequence[str], markdown: bool) -> str:
    if markdown:
        return "| " + " | ".join(columns) + " |"
    return f"{columns[0]:30} {columns[1]:10} {columns[2]:>5}  {columns[3]:24} {columns[4]}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--conditions", nargs="*", default=list(CONDITIONS), choices=list(CONDITIONS))
    parser.add_argument("--commands", nargs="*", default=list(COMMANDS), choices=list(COMMANDS))
    parser.add_argument("--runs", type=int, default=200, help="kills of each command; a tenth for other conditions")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--markdown", action="store_true")
    options = parser.parse_args()
    failed = 0
    print(_row(("condition", "command", "runs", "statuses", "faults"), options.markdown))
    if options.markdown:
        print("| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory() as folder:
        template = Path(folder) / "template"
        write_session(simulate(replace(FIRST_HIT, aims=8, pairs=8, tracks_heard=1, tracks_silent=0), 1), template)
        subprocess.run(
            [sys.executable, "-m", "fgreg", "solve", str(template), "-q"], check=False, stderr=subprocess.DEVNULL
        )
        for title in options.conditions:
            condition = CONDITIONS[title]
            for name in options.commands:
                runs = options.runs if condition.kill else max(2, options.runs // 10)
                tally = study(name, condition, template, Path(folder), runs, options.seed)
                statuses = ", ".join(f"{count} x {status}" for status, count in tally.statuses.most_common(4))
                said = "; ".join(f"{count} x {fault}" for fault, count in tally.faults.items()) or "none"
                failed += bool(tally.faults)
                print(_row((title, name, str(tally.runs), statuses, said), options.markdown), flush=True)
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
