"""The guide: its commands run, it has every sentence that fgreg can say, and every public name."""

from __future__ import annotations

import json
import re
import runpy
import shlex
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

import fgreg
from fgreg.cli.main import main
from fgreg.errors import InputError
from fgreg.model.probe_model import ChannelModel
from fgreg.model.session_model import SESSION, SessionModel
from fgreg.schema.yaml_writer import yaml_text
from fgreg.session.setup_reader import read_setup
from fgreg.session.yaml_loader import parse_yaml
from fgreg.simulation.config import default_probe, default_stage
from study_setup import draw_rig, write_recordings
from tests import rigs, test_convert_bags

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "docs" / "guide"
SYMPTOMS = runpy.run_path(str(ROOT / "tools" / "make_symptoms.py"))
BLOCK = re.compile(r"(?:<!-- needs ([a-z ]+) -->\n)?```console\n(.*?)```", re.DOTALL)
NOT_FGREG = {"pip"}
SAYS = re.compile(
    r"(?<!class )\b(Condition|EstimationError|NotFound|EventRefused|PairRefused|JournalError|ViewerError|EngineGone|"
    r"StageError|StageLost|DeviceLost|Tell|Halt|Refusal)\(f?\"|Condition\("
)
"""What makes a reason, a refusal, a stop or a prompt."""


@dataclass(frozen=True, slots=True)
class Shown:
    """A command of the guide: its page, what it needs beside a session, its words."""

    page: str
    needs: str
    words: list[str]


def commands() -> list[Shown]:
    """Each command of fgreg; of those that need what no test has, with --help."""
    found = []
    for page in sorted(GUIDE.glob("*.md")):
        for needs, block in BLOCK.findall(page.read_text(encoding="utf-8")):
            for line in block.splitlines():
                prompt, name, *words = shlex.split(line)
                assert prompt == "$", f"{page.name}: {line}"
                assert name == "fgreg" or name in NOT_FGREG, f"{page.name}: {line}"
                if name == "fgreg":
                    words = [words[0], "--help"] if needs and needs not in MADE else words
                    found.append(Shown(page.name, needs, words))
    return found


def _recordings(folder: Path, session: Path) -> None:
    """Of a rig, for ``fgreg setup``; one of its sweeps."""
    rng = np.random.default_rng((1, 8))
    write_recordings(folder, draw_rig(rng).rig, rng)
    (folder / "sweep-1.jsonl").rename(folder / "sweep.jsonl")
    model = SessionModel("rig", default_probe(ChannelModel(40.0)), default_stage())
    (folder / "session.yaml").write_text(yaml_text(SESSION.write(model)), encoding="utf-8")
    (folder / "new").mkdir()
    shutil.copytree(session, folder / session.name)


def _sessions(folder: Path, _: Path) -> None:
    """Four of one rig, for ``fgreg commission``."""
    for number in range(1, 5):
        rigs.write(folder / f"session-0{number}", number)


def _shots(folder: Path, _: Path) -> None:
    """An MCAP file and a table, for ``fgreg convert``."""
    test_convert_bags.mcap_of(folder / "recording.mcap", test_convert_bags.shots())
    test_convert_bags.setup(folder).rename(folder / "session.yaml")
    pose = "1 0 0 10  0 0 -1 20  0 1 0 150  0 0 0 1"
    head = "t,type,pm,camera_T_marker,scan_deg,x_mm,range_mm\n"
    (folder / "shots.csv").write_text(f"{head}1,pair,0,{pose},0,2,30\n", encoding="utf-8")


MADE = {"recordings": _recordings, "sessions of one rig": _sessions, "a recording": _shots}
"""What a command needs, and how it is made; other commands are run with --help."""


def test_the_session_yaml_to_begin_with_is_one() -> None:
    """Alone, and with what fgreg print and calibrate-camera add below it."""
    page = (GUIDE / "set-up.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    printed = "board: {columns: 9, rows: 6, square_mm: 10.0}\nmarker:\n  dictionary: DICT_4X4_50\n"
    printed += "  tags:\n    - id: 0\n      size_mm: 12.0\n"
    for text in (block, block + printed):
        problems: list[InputError] = []
        setup = read_setup(parse_yaml(text, "session.yaml"), "session.yaml", "mine", problems)
        assert not problems
        assert not setup.warnings
        assert setup.model is not None


def test_every_command_of_the_guide_runs(
    pose_session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one folder, by the pages' names, after session-01 was solved: ten PMs, and four as the new shots."""
    session = pose_session.rename(pose_session.with_name("session-01"))
    monkeypatch.chdir(session.parent)
    lines = [
        (json.loads(line).get("pm", 0), f"{line}\n") for line in (session / "events.jsonl").read_text().splitlines()
    ]
    (session / "events.jsonl").write_text("".join(line for pm, line in lines if pm < 10))
    Path("new-shots.jsonl").write_text("".join(line for pm, line in lines if pm >= 16))
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0}, raising=False)
    folders = {"": session.parent}
    for needs, make in MADE.items():
        folders[needs] = session.parent / "made" / needs
        folders[needs].mkdir(parents=True)
        make(folders[needs], session)
    listed = commands()
    assert len(listed) > 20
    assert MADE.keys() <= {shown.needs for shown in listed}
    for shown in [Shown("", "", ["solve", "session-01"]), *listed]:
        monkeypatch.chdir(folders.get(shown.needs, session.parent))
        monkeypatch.setattr(sys, "argv", ["fgreg", *shown.words])
        with pytest.raises(SystemExit) as done:
            main()
        said = capsys.readouterr().err
        assert done.value.code == 0, f"{shown.page}: fgreg {shlex.join(shown.words)}: {said}"


def test_every_sentence_has_its_cause() -> None:
    page = (GUIDE / "symptoms.md").read_text(encoding="utf-8")
    assert SYMPTOMS["with_sentences"](page) == page, "run python tools/make_symptoms.py"
    sections = yaml.safe_load((ROOT / "tools" / "symptoms.yaml").read_text(encoding="utf-8"))
    assert set(re.findall(r"<!-- sentences: (\w+) -->", page)) == set(sections)
    listed = {module for section in sections.values() for module in section["modules"]}
    sources = [path for folder in ("fgreg", "drivers") for path in (ROOT / folder).rglob("*.py")]
    says = {str(path.relative_to(ROOT)) for path in sources if SAYS.search(path.read_text(encoding="utf-8"))}
    assert says <= listed, "a module that says something to the user is not in tools/symptoms.yaml"
    verdict = sections["verdict"]
    del verdict["says"]["two registrations explain the"]
    with pytest.raises(ValueError, match=r"without a cause:\n.*verdict\.py: two registrations explain the … pairs"):
        SYMPTOMS["table_of"](verdict)
    verdict["says"] |= {"two registrations explain the": "", "what nobody says": ""}
    with pytest.raises(ValueError, match="no longer said:\nwhat nobody says"):
        SYMPTOMS["table_of"](verdict)


def test_every_public_name_is_in_the_reference() -> None:
    names = re.search(r"members: \[(.*?)\]", (GUIDE / "api.md").read_text(encoding="utf-8"), re.DOTALL)
    assert names is not None
    assert sorted(names[1].replace("\n", " ").replace(" ", "").split(",")) == sorted(fgreg.__all__)
