"""Whatever is done to a valid session, reading it either succeeds or raises InputError with one line. Never more."""

from __future__ import annotations

import copy
import json
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fgreg.errors import InputError
from fgreg.session import yaml_loader
from fgreg.session.result_file import read_result
from fgreg.session.session_reader import Session, check_session, read_ground_truth, read_session
from fgreg.session.yaml_loader import parse_yaml
from tests import session_files

Read = TypeVar("Read")

QUICK = settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))

NUMBERS = st.one_of(
    st.integers(),
    st.integers(min_value=-(10**400), max_value=10**400),
    st.floats(),
    st.sampled_from([0, -1, 1, 1e308, -1e308, 5e-324, 1e-300, 2**63, 10**30, 180.0, 300.0, 2000.0]),
)
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    NUMBERS,
    st.text(max_size=12),
    st.sampled_from(
        ["frames/a.png", "../x", "/", "", "~", "yes", "1e-3", "x_", "pair", "DICT_4X4_50", "\ud800", "a\0"]
    ),
)
ANYTHING = st.recursive(
    SCALARS,
    lambda inner: st.one_of(st.lists(inner, max_size=7), st.dictionaries(st.text(max_size=6), inner, max_size=4)),
    max_leaves=12,
)


def places(data: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key) of nested data."""
    keys: Any = list(data) if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
    for key in keys:
        yield data, key
        yield from places(data[key])


@st.composite
def mutated(draw: st.DrawFn, make: Callable[[], Any]) -> Any:
    """Valid data with one to three places replaced, removed, doubled, renamed or exchanged for another."""
    data = copy.deepcopy(make())
    for _ in range(draw(st.integers(1, 3))):
        every = list(places(data))
        if not every:
            break
        container, key = draw(st.sampled_from(every))
        match draw(st.sampled_from(["replace", "nudge", "remove", "double", "rename", "exchange"])):
            case "replace":
                container[key] = draw(ANYTHING)
            case "nudge":
                container[key] = draw(NUMBERS)
            case "remove":
                del container[key]
            case "double" if isinstance(container, list):
                container.insert(key, copy.deepcopy(container[key]))
            case "rename" if isinstance(container, dict):
                container[draw(st.text(max_size=8))] = container.pop(key)
            case _:
                other, at = draw(st.sampled_from(every))
                container[key] = copy.deepcopy(other[at])
    return data


@st.composite
def damaged(draw: st.DrawFn, valid: bytes) -> bytes:
    """Bytes with a few ranges cut out, doubled or overwritten."""
    data = bytearray(valid)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        end = min(len(data), at + draw(st.integers(0, 40)))
        data[at:end] = draw(
            st.one_of(
                st.binary(max_size=6),
                st.sampled_from([b"", b"\n", b"{", b"[", b"&a ", b"*a", b"- ", b": ", b"\t", b"1e9", b"!!", b"---\n"]),
                st.just(bytes(data[at:end] * 2)),
            )
        )
    return bytes(data)


def outcome(read: Callable[[], Read]) -> Read | InputError:
    """The result of reading, or the error, which is one line. Any other exception fails the test."""
    try:
        return read()
    except InputError as error:
        one_short_line(error)
        return error


def one_short_line(error: InputError) -> None:
    assert str(error).isprintable()
    assert len(str(error)) < 500


def accepted(folder: Path) -> Session | None:
    """The session, or None where it was refused as it should be."""
    problems, warnings = check_session(folder)
    for problem in problems:
        one_short_line(problem)
    assert all(warning.isprintable() for warning in warnings)
    session = outcome(lambda: read_session(folder))
    if isinstance(session, InputError):
        # What reading refuses, checking reports; and first what reading raises.
        assert str(session) == str(problems[0])
        return None
    return session


def dumped(data: Any) -> bytes:
    """Data as YAML, in the styles and with the aliases that PyYAML likes."""
    return yaml.dump(data, sort_keys=False, allow_unicode=False).encode("utf-8", "backslashreplace")


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        session_files.write(Path(name))
        session_files.write_frames(Path(name))
        yield Path(name)


@pytest.fixture(autouse=True)
def _valid_files(folder: Path) -> None:
    session_files.write(folder)
    (folder / "ground_truth.yaml").unlink(missing_ok=True)


@QUICK
@given(data=mutated(session_files.setup))
def test_a_mutated_setup(folder: Path, data: Any) -> None:
    (folder / "session.yaml").write_bytes(dumped(data))
    session = accepted(folder)
    if session is not None:
        # What was accepted is usable: everything that is derived from it is finite.
        assert abs(session.model.probe.element_x_mm).max() < 1e9
        assert 0 < session.model.probe.sensitivity.half_width_at(30.0) < 0.79
        assert session.model.targets_mm.shape[1] == 3


@QUICK
@given(data=mutated(session_files.events))
def test_mutated_events(folder: Path, data: Any) -> None:
    lines = data if isinstance(data, list) else [data]
    (folder / "events.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    session = accepted(folder)
    if session is not None:
        assert len(session.events) == len(lines)
        times = [event.t for event in session.events]
        assert times == sorted(times)


@QUICK
@given(data=st.data())
def test_damaged_bytes_of_either_file(folder: Path, data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(["session.yaml", "events.jsonl"]))
    session_files.write(folder)
    path = folder / name
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    session = accepted(folder)
    assert session is None or all(math.isfinite(event.t) for event in session.events)
    session_files.write(folder)


@QUICK
@given(data=mutated(session_files.truth))
def test_a_mutated_ground_truth(folder: Path, data: Any) -> None:
    (folder / "ground_truth.yaml").write_bytes(dumped(data))
    truth = outcome(lambda: read_ground_truth(folder))
    assert truth is not None
    problems, _ = check_session(folder)
    assert (str(truth) in map(str, problems)) if isinstance(truth, InputError) else not problems


@QUICK
@given(data=mutated(session_files.result))
def test_a_mutated_result(folder: Path, data: Any) -> None:
    path = folder / "result.yaml"
    path.write_bytes(dumped(data))
    estimate = outcome(lambda: read_result(path))
    if not isinstance(estimate, InputError):
        assert all(pair.epoch < max(1, len(estimate.epochs)) for pair in estimate.pairs)


def test_the_result_that_is_mutated_is_valid(folder: Path) -> None:
    (folder / "result.yaml").write_bytes(dumped(session_files.result()))
    assert len(read_result(folder / "result.yaml").pairs) == 2


@pytest.mark.parametrize("loader", [yaml.SafeLoader, yaml_loader._LOADER])
def test_any_text_as_yaml(loader: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yaml_loader, "_LOADER", loader)

    @QUICK
    @given(text=st.one_of(st.text(), st.text(alphabet="ab:-[]{}&*!|>?'\"#%@,1 \n\t.e~<=\\")))
    def read(text: str) -> None:
        assert isinstance(outcome(lambda: parse_yaml(text, "f")), dict | InputError)

    read()


PLAIN = st.recursive(
    st.one_of(
        st.none(), st.booleans(), NUMBERS, st.text(alphabet=st.characters(exclude_categories=["Cs"]), max_size=9)
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=5), st.dictionaries(st.text("abc:# ", max_size=5), inner)),
    max_leaves=8,
)


@settings(QUICK, max_examples=40)
@given(data=st.dictionaries(st.text("abc-", min_size=1), PLAIN, min_size=1, max_size=4))
def test_data_that_another_writer_wrote_reads_as_the_same(data: dict[str, Any]) -> None:
    def same(read: Any, written: Any) -> bool:
        if isinstance(written, dict):
            return set(read) == set(written) and all(same(read[key], value) for key, value in written.items())
        if isinstance(written, list):
            return len(read) == len(written) and all(map(same, read, written))
        if isinstance(written, bool) or written is None:
            return read is written
        if isinstance(written, int | float) and abs(written) >= 1e29:
            return bool(read == pytest.approx(float(written) if abs(written) < 1e308 else read))
        if isinstance(written, str) and isinstance(read, float):
            return float(written) == read  # 1e5 without quotes is a text in YAML 1.1 and a number in 1.2
        return bool(read == written or (read != read and written != written))

    assert same(parse_yaml(yaml.safe_dump(data), "f"), data)
