"""``fgreg schema``: what the reader takes, the JSON Schemas take; they refuse wrong keys, types and bounds."""

from __future__ import annotations

import json
import runpy
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft202012Validator

from fgreg.cli.schema import Document, document_schema
from fgreg.drivers.registry import ENTRIES
from fgreg.errors import InputError
from fgreg.live.config import read_config
from fgreg.live.config_keys import example_config
from fgreg.session.result_file import read_result
from fgreg.session.session_reader import check_session
from tests import live_configs, session_files
from tests.session_files import ABSENT, change
from tests.test_bad_input_anything import QUICK, dumped, mutated, outcome

SCHEMAS = {document: document_schema(document) for document in Document}
ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "sessions"
TABLES = runpy.run_path(str(ROOT / "tools" / "make_format_tables.py"))
PAGE: Path = TABLES["PAGES"][1]


def accepts(document: Document, value: Any) -> bool:
    return bool(Draft202012Validator(SCHEMAS[document]).is_valid(value))


@pytest.mark.parametrize("document", Document)
def test_it_is_a_schema_with_words_for_each_key(document: Document) -> None:
    Draft202012Validator.check_schema(SCHEMAS[document])
    definitions: Any = SCHEMAS[document]["$defs"]
    for definition in definitions.values():
        for name, schema in definition["properties"].items():
            described = "description" in schema or "const" in schema or "$ref" in schema
            assert described or name in definition["required"] or "oneOf" in schema, name


@pytest.mark.parametrize("name", ["phantom", "paper"])
def test_the_example_sessions_are_accepted(name: str) -> None:
    assert accepts(Document.SESSION, yaml.safe_load((EXAMPLES / name / "session.yaml").read_text()))
    lines = (EXAMPLES / name / "events.jsonl").read_text().splitlines()
    assert len(lines) > 25
    assert all(accepts(Document.EVENTS, json.loads(line)) for line in lines)


def test_documents_with_every_key_are_accepted() -> None:
    assert accepts(Document.SESSION, session_files.setup())
    assert all(accepts(Document.EVENTS, event) for event in session_files.events())
    assert accepts(Document.RESULT, session_files.result())
    for config in (live_configs.config(), live_configs.room(), yaml.safe_load(example_config())):
        assert accepts(Document.LIVE, config)


def test_names_of_the_users_own_are_accepted() -> None:
    setup = session_files.setup()
    setup["x_mine"] = setup["probe"]["x_mine"] = {"anything": [1]}
    assert accepts(Document.SESSION, setup)


WRONG: list[tuple[Document, str, Any]] = [
    (Document.SESSION, "format", "fgreg-session/2"),
    (Document.SESSION, "stage", ABSENT),
    (Document.SESSION, "probe.pich_mm", 1),
    (Document.SESSION, "probe.elements", 1.5),
    (Document.SESSION, "probe.radius_mm", 0),
    (Document.SESSION, "probe.flip", "no"),
    (Document.SESSION, "probe.sensitivity.half_width_deg", [46]),
    (Document.SESSION, "probe.sensitivity.curve.amplitude", ABSENT),
    (Document.SESSION, "stage.direction", 0),
    (Document.SESSION, "camera.right_T_left", ABSENT),
    (Document.SESSION, "camera.left.distortion", [0, 0, 0]),
    (Document.SESSION, "camera.left.model", "fisheye"),
    (Document.SESSION, "marker.tags.0.marker_T_tag", [[1, 0, 0, 0]] * 3),
    (Document.SESSION, "marker.dictionary", "DICT_4x4_50"),
    (Document.SESSION, "targets_mm", []),
    (Document.EVENTS, "3.type", "pairs"),
    (Document.EVENTS, "3.t", ABSENT),
    (Document.EVENTS, "3.pm", -1),
    (Document.EVENTS, "3.marker", {}),
    (Document.EVENTS, "3.marker", {"right": "frames/b.png"}),
    (Document.EVENTS, "4.marker.covariance", session_files.diagonal(1, 1, 1, 1, 1, 1)),
    (Document.EVENTS, "3.trus.range_mm", 301),
    (Document.EVENTS, "3.trus.x_mm", ABSENT),
    (Document.EVENTS, "3.trus.frame", "frames/c.npy"),
    (Document.EVENTS, "1.corner", [0, 0]),
    (Document.EVENTS, "1.camera_p_spot_mm", ABSENT),
    (Document.EVENTS, "8.looks", ABSENT),
    (Document.EVENTS, "11.detected", ABSENT),
    (Document.EVENTS, "12.reason", ""),
    (Document.EVENTS, "14.camera_p_mm", ABSENT),
    (Document.EVENTS, "14.left", [1, 2]),
    (Document.EVENTS, "14.trus", {"scan_deg": 0, "x_mm": 0, "range_mm": 20}),
    (Document.EVENTS, "15.right", ABSENT),
    (Document.EVENTS, "15.trus.range_mm", ABSENT),
    (Document.EVENTS, "15.trus", ABSENT),
    (Document.RESULT, "fgreg", ABSENT),
    (Document.RESULT, "verdict", "fine"),
    (Document.RESULT, "epochs.0.predicted_tre_mm.mean", -1),
    (Document.RESULT, "pairs.0.lambda_mm", ABSENT),
    (Document.RESULT, "pairs.1.reason", ABSENT),
    (Document.RESULT, "tracks.0.stage_deg", None),
    (Document.LIVE, "camera", ABSENT),
    (Document.LIVE, "camera.driver", "endoscop"),
    (Document.LIVE, "camera.path", "bag"),
    (Document.LIVE, "photoacoustic.port", 70000),
    (Document.LIVE, "stage.limits.home_speed_deg_s", 31),
    (Document.LIVE, "sinks", {"driver": "igtl"}),
    (Document.LIVE, "settings.hearing_threshold", ABSENT),
]


@pytest.mark.parametrize(("document", "path", "value"), WRONG)
def test_what_is_wrong_is_refused(document: Document, path: str, value: Any) -> None:
    make: Any = {
        Document.SESSION: session_files.setup,
        Document.EVENTS: session_files.events,
        Document.RESULT: session_files.result,
        Document.LIVE: live_configs.config,
    }
    data = make[document]()
    change(data, path, value)
    data = data[int(path.split(".")[0])] if document is Document.EVENTS else data
    assert not accepts(document, data)


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        session_files.write(Path(name))
        session_files.write_frames(Path(name))
        yield Path(name)


def taken(data: Any, text: bytes) -> bool:
    """Whether the file says what the data are: YAML has numbers that JSON writes otherwise."""
    return bool(yaml.safe_load(text) == data)


@QUICK
@given(data=mutated(session_files.setup))
def test_no_setup_that_the_reader_takes_is_refused(folder: Path, data: Any) -> None:
    session_files.write(folder, None, "")
    (folder / "session.yaml").write_bytes(dumped(data))
    if not check_session(folder)[0] and taken(data, dumped(data)):
        assert accepts(Document.SESSION, data)


@QUICK
@given(data=mutated(lambda: session_files.events()[3]), other=st.sampled_from(range(19)), more=st.data())
def test_no_event_that_the_reader_takes_is_refused(folder: Path, data: Any, other: int, more: st.DataObject) -> None:
    session_files.write(folder)
    event = more.draw(mutated(lambda: session_files.events()[other]))
    for one in (data, event):
        (folder / "events.jsonl").write_text(json.dumps(one) + "\n", encoding="utf-8")
        if not check_session(folder)[0]:
            assert accepts(Document.EVENTS, one)
    session_files.write(folder)


@QUICK
@given(data=mutated(session_files.result))
def test_no_result_that_the_reader_takes_is_refused(folder: Path, data: Any) -> None:
    (folder / "result.yaml").write_bytes(dumped(data))
    read = outcome(lambda: read_result(folder / "result.yaml"))
    if not isinstance(read, InputError) and taken(data, dumped(data)):
        assert accepts(Document.RESULT, data)


@QUICK
@given(data=mutated(live_configs.config))
def test_no_config_that_the_reader_takes_is_refused(tmp_path_factory: Any, data: Any) -> None:
    path = live_configs.write(tmp_path_factory.mktemp("live"), dumped(data).decode())
    if not isinstance(outcome(lambda: read_config(path)), InputError) and taken(data, dumped(data)):
        assert accepts(Document.LIVE, data)


def test_the_page_of_devices_has_the_drivers_of_today() -> None:
    page = (ROOT / "docs" / "devices.md").read_text(encoding="utf-8")
    assert TABLES["with_tables"](page) == page, "run python tools/make_format_tables.py"
    assert all(f"| `{entry.role}` | `{entry.name}` |" in page for entry in ENTRIES)


def test_the_format_page_has_the_tables_of_today() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert TABLES["with_tables"](page) == page, "run python tools/make_format_tables.py"
    assert page.count("<!-- table: ") == 10
    recordings = TABLES["PAGES"][2].read_text(encoding="utf-8")
    assert TABLES["with_tables"](recordings) == recordings
    for key in ("probe.sensitivity.edge_sigma_deg", "camera_new_T_camera_old", "epochs[].predicted_tre_mm.p95"):
        assert f"`{key}`" in page


def test_the_example_on_the_format_page_reads(tmp_path: Path) -> None:
    block = PAGE.read_text(encoding="utf-8").split("```yaml\n")[1].split("```")[0]
    problems, _ = check_session(session_files.write(tmp_path, block, ""))
    assert problems == []
