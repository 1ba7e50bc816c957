"""YAML that is broken, hostile or ambiguous is refused in one line, in bounded time and memory."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path

import pytest
import yaml

from fgreg.errors import InputError
from fgreg.session import yaml_loader
from fgreg.session.yaml_loader import load_yaml, parse_yaml
from tests import session_files
from tests.session_files import error_of

BILLION_LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 25)
)


def refusal(text: str) -> str:
    with pytest.raises(InputError) as caught:
        parse_yaml(text, "f")
    assert str(caught.value).isprintable()
    return str(caught.value)


@pytest.fixture(params=["with libyaml", "pure Python"])
def _parser(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "pure Python":
        monkeypatch.setattr(yaml_loader, "_LOADER", yaml.SafeLoader)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "f: found an empty file, expected a mapping"),
        ("# only a comment\n", "f: found an empty file, expected a mapping"),
        ("- 1\n", "f: found no mapping at the top"),
        ("text", "f: found no mapping at the top"),
        ("a: 1\na: 2\n", "f: line 2: found the key a again (first on line 1), expected each key once"),
        ('1: 1\n"1": 2\n', "f: line 2: found the key 1 again (first on line 1)"),
        ("a: {b: 1, c: 2, b: 3}", "f: line 1: found the key b again"),
        ("a: [1, 2\nb: 3\n", "f: line 2: found bad YAML"),
        ("a: b: c\n", "f: line 1: found bad YAML"),
        ("a:\n\t- 1\n", "f: line 2: found bad YAML"),
        ("a: 'unfinished", "f: line 1: found bad YAML"),
        ("a: \x07\n", "f: found bad YAML"),
        ("a: *nowhere\n", "f: line 1: found"),
        ("a: 1\n---\nb: 2\n", "f: line 2: found a second document, expected one document"),
        ("a: &a [1, *a]\n", "f: line 1: found the alias *a inside its own anchor, expected data without loops"),
        ("a: &a {b: *a}\n", "f: line 1: found the alias *a inside its own anchor"),
        ("? [1, 2]\n: 3\n", "f: line 1: found a list or mapping as a key, expected a text as a key"),
        ("? {a: 1}\n: 3\n", "f: line 1: found a list or mapping as a key"),
        ("a: &a x\n*a : 3\n", "f: line 2: found an alias as a key"),
        ("a: !!python/object/apply:os.system ['true']\n", "f: line 1: found the tag tag:yaml.org,2002:python/object"),
        ("a: !!float 1\n", "f: line 1: found the tag"),
        ("a: !mine {}\n", "f: line 1: found the tag !mine"),
        ("a: ! 12\n", "f: line 1: found the tag !"),
        ("a: " + "[" * 33 + "]" * 33, "f: line 1: found nesting too deep, expected at most 32 levels"),
        ("a: " + "[" * 100_000, "f: line 1: found nesting too deep"),
        ("a: " + "{a: " * 100_000, "f: line 1: found nesting too deep"),
        ("- " * 100_000, "f: line 1: found nesting too deep"),
        (
            "".join(f"a{i}: &a{i} [{f'*a{i - 1}' if i else 'x'}]\n" for i in range(40)),
            "f: line 32: found nesting too deep",
        ),
        (BILLION_LAUGHS, "f: line 6: found more nodes than a file may hold, expected at most 200000"),
    ],
    ids=lambda value: value[:20] if isinstance(value, str) else None,
)
@pytest.mark.usefixtures("_parser")
def test_refused(text: str, words: str) -> None:
    assert refusal(text).startswith(words)


def test_nodes_are_counted_without_aliases_too() -> None:
    assert parse_yaml("a: [1, 2, 3]", "f", max_nodes=6)["a"] == [1, 2, 3]
    with pytest.raises(InputError, match="found more nodes than a file may hold, expected at most 5"):
        parse_yaml("a: [1, 2, 3]", "f", max_nodes=5)


def test_an_alias_bomb_costs_next_to_nothing(tmp_path: Path) -> None:
    tracemalloc.start()
    text = error_of(session_files.write(tmp_path, BILLION_LAUGHS))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "more nodes than a file may hold" in text
    # Expanded, these are 9^25 nodes: no time and no memory would do.
    assert peak < 20_000_000


def test_large_files_are_not_even_parsed(tmp_path: Path) -> None:
    path = tmp_path / "session.yaml"
    with path.open("wb") as file:
        file.truncate(5_000_000)
    with pytest.raises(InputError, match="found more than 4000000 bytes, expected a file of at most 4000000 bytes"):
        load_yaml(path, "session.yaml")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"a: 1\nb: \xff\n", "f: line 2: found bytes that are not UTF-8, expected UTF-8 text"),
        ("a: 1\n".encode("utf-16"), "f: line 1: found bytes that are not UTF-8"),
        (b"\0\0\0\0", "f: found bad YAML"),
        (bytes(range(128)), "f: found bad YAML"),
    ],
)
def test_other_encodings_and_no_text_at_all(tmp_path: Path, data: bytes, words: str) -> None:
    (tmp_path / "f").write_bytes(data)
    with pytest.raises(InputError) as caught:
        load_yaml(tmp_path / "f", "f")
    assert str(caught.value).startswith(words)


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("12", 12),
        ("-7", -7),
        ("+7", 7),
        ("0", 0),
        ("1.5", 1.5),
        ("1.", 1.0),
        (".5", 0.5),
        ("1e-3", 1e-3),
        ("1E3", 1000.0),
        ("1.0e+3", 1000.0),
        ("00.5", 0.5),
        (".inf", math.inf),
        ("-.inf", -math.inf),
        ("1e999", math.inf),
        ("9" * 5000, math.inf),
        ("true", True),
        ("False", False),
        ("null", None),
        ("~", None),
        ("", None),
        # Those on which versions of YAML disagree are texts, and so fail where a number or truth value is expected.
        ("010", "010"),
        ("0x1F", "0x1F"),
        ("1_000", "1_000"),
        ("1:30", "1:30"),
        ("yes", "yes"),
        ("off", "off"),
        ("2024-01-01", "2024-01-01"),
        ("'12'", "12"),
        ('"true"', "true"),
        ("'null'", "null"),
        ("1e", "1e"),
        ("e3", "e3"),
        ("-", [None]),
    ],
)
@pytest.mark.usefixtures("_parser")
def test_plain_values(written: str, value: object) -> None:
    read = parse_yaml(f"a:\n  {written}\n", "f")["a"]
    assert read == value
    assert type(read) is type(value) or value == [None]


@pytest.mark.usefixtures("_parser")
def test_lines_of_keys_and_items() -> None:
    top = parse_yaml("a: 1\n\nb:\n  - 2\n  - {c: 3,\n     d: 4}\n", "f")
    items = top["b"]
    assert isinstance(items, yaml_loader.YamlSequence)
    assert (top.lines, items.lines) == ({"a": 1, "b": 3}, [4, 5])
    inner = items[1]
    assert isinstance(inner, yaml_loader.YamlMapping)
    assert inner.lines == {"c": 5, "d": 6}
