"""Changed inputs for the fuzzers: bytes, numbers, words, lines, nesting and structure of valid ones."""

from __future__ import annotations

import copy
import gzip
import json
import re
from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum
from typing import Any

import numpy as np
import yaml


class Form(StrEnum):
    """What the inputs of a target are."""

    BYTES = "bytes"
    TEXT = "text"
    YAML = "yaml"
    LINES = "lines"
    """JSON documents, one a line."""


NUMBERS = [
    *("0", "-0", "-1", "1", "2", "7", "255", "256", "65535", "65536", "2147483647", "2147483648", "-2147483649"),
    *("4294967296", "9223372036854775807", "9223372036854775808", "18446744073709551616", "1e30", "-1e30", "1e308"),
    *("-1e308", "1e309", "5e-324", "1e-320", "1e-9", "0.1", "-0.0", "nan", "NaN", "inf", "-inf", "Infinity", "1_0"),
    *("0x10", "010", "1e", ".", "1.5.2", "9" * 400, "0." + "0" * 400 + "1", "true", "null", '""', "[]", "{}"),
]
WORDS = [
    *("", "\0", "\ufeff", "\u2028", "\x1b[31m", "\udcff", "..", "../../x", "/", "/dev/zero", "/dev/stdin", "~", "%s"),
    *(
        "a" * 300,
        "a" * 70_000,
        "\u00e9",
        "\U0001f600",
        "-",
        "--help",
        "&a",
        "*a",
        "<<",
        "!!python/name:os",
        "---",
        "...",
    ),
]
TOKEN = re.compile(r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|[A-Za-z_][A-Za-z_0-9]*|\s+|.", re.DOTALL)
NUMBER = re.compile(r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?")
OPENING = {"[": "]", "{": "}", "(": ")"}
DEPTHS = (2, 10, 60, 1000, 20_000)

Change = Callable[[bytes, np.random.Generator], bytes]


def changed(valid: Sequence[bytes], form: Form, rng: np.random.Generator) -> bytes:
    """One of the valid inputs with one to four changes; rarely the two ends of two of them, or noise."""
    data = valid[int(rng.integers(len(valid)))]
    if rng.random() < 0.02:
        return rng.bytes(int(rng.integers(0, 300)))
    if form in (Form.YAML, Form.LINES) and rng.random() < 0.5:
        return document(data, form, rng)
    if rng.random() < 0.05:
        other = valid[int(rng.integers(len(valid)))]
        data = data[: _place(data, rng)] + other[_place(other, rng) :]
    changes = OF_BYTES if form is Form.BYTES else (*OF_TEXT, *OF_TEXT, *OF_BYTES)
    for _ in range(int(rng.integers(1, 5))):
        data = changes[int(rng.integers(len(changes)))](data, rng)
    return data


def _place(data: bytes, rng: np.random.Generator) -> int:
    """A place in the data; in every other case near its beginning, where headers are."""
    end = len(data) if rng.random() < 0.5 else min(len(data), 120)
    return int(rng.integers(0, end + 1))


def _one(items: Sequence[str], rng: np.random.Generator) -> str:
    return items[int(rng.integers(len(items)))]


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    """Some bits."""
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        if out:
            out[min(_place(data, rng), len(out) - 1)] ^= 1 << int(rng.integers(8))
    return bytes(out)


def overwrite(data: bytes, rng: np.random.Generator) -> bytes:
    """A few bytes by extreme ones or noise."""
    at, count = _place(data, rng), int(rng.choice([1, 2, 4, 8]))
    new = (b"\x00" * count, b"\xff" * count, b"\x7f" + b"\xff" * (count - 1), rng.bytes(count))[int(rng.integers(4))]
    return data[:at] + new + data[at + count :]


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    """A range, or the end."""
    at = _place(data, rng)
    return data[:at] if rng.random() < 0.3 else data[:at] + data[at + int(rng.integers(1, 40)) :]


def double(data: bytes, rng: np.random.Generator) -> bytes:
    """A range once or many times more."""
    at = _place(data, rng)
    part = data[at : at + int(rng.integers(1, 60))]
    return data[:at] + part * int(rng.choice([2, 2, 3, 50, 1000])) + data[at:]


def insert(data: bytes, rng: np.random.Generator) -> bytes:
    """Noise."""
    at = _place(data, rng)
    return data[:at] + rng.bytes(int(rng.integers(1, 20))) + data[at:]


def number(data: bytes, rng: np.random.Generator) -> bytes:
    """A number of a text by an extreme one."""
    text = data.decode("utf-8", "surrogateescape")
    found = list(NUMBER.finditer(text))
    if not found:
        return data
    one = found[int(rng.integers(len(found)))]
    return _encoded(text[: one.start()] + _one(NUMBERS, rng) + text[one.end() :])


def word(data: bytes, rng: np.random.Generator) -> bytes:
    """A token of a text by another of the text, or by an odd word, or by nothing."""
    text = data.decode("utf-8", "surrogateescape")
    found = list(TOKEN.finditer(text))
    if not found:
        return data
    one = found[int(rng.integers(len(found)))]
    new = (found[int(rng.integers(len(found)))].group(), _one(WORDS, rng), "")[int(rng.integers(3))]
    return _encoded(text[: one.start()] + new + text[one.end() :])


def lines(data: bytes, rng: np.random.Generator) -> bytes:
    """A line removed, doubled, exchanged with another, or indented; or other line ends."""
    parts = data.split(b"\n")
    a, b = int(rng.integers(len(parts))), int(rng.integers(len(parts)))
    match int(rng.integers(5)):
        case 0:
            del parts[a]
        case 1:
            parts.insert(b, parts[a])
        case 2:
            parts[a], parts[b] = parts[b], parts[a]
        case 3:
            parts[a] = b"  " * int(rng.integers(1, 4)) + parts[a]
        case _:
            return data.replace(b"\n", (b"\r", b"\r\n", b"\n\n", b"\x0b")[int(rng.integers(4))])
    return b"\n".join(parts)


def nest(data: bytes, rng: np.random.Generator) -> bytes:
    """Deep brackets in place of a number."""
    text = data.decode("utf-8", "surrogateescape")
    found = list(NUMBER.finditer(text))
    if not found:
        return data
    one = found[int(rng.integers(len(found)))]
    opening = _one(list(OPENING), rng)
    depth = int(rng.choice(DEPTHS, p=[0.4, 0.3, 0.2, 0.08, 0.02]))
    key = '"a":' if opening == "{" and rng.random() < 0.8 else ""
    inside = (opening + key) * depth + one.group() + OPENING[opening] * depth
    return _encoded(text[: one.start()] + inside + text[one.end() :])


def encoded_otherwise(data: bytes, rng: np.random.Generator) -> bytes:
    """The text in another encoding, or compressed."""
    text = data.decode("utf-8", "replace")
    match int(rng.integers(4)):
        case 0:
            return text.encode("utf-16")
        case 1:
            return b"\xef\xbb\xbf" + data
        case 2:
            return gzip.compress(data, mtime=0)
        case _:
            return text.encode("latin-1", "replace")


def document(data: bytes, form: Form, rng: np.random.Generator) -> bytes:
    """The same documents with one to three changes of their structure."""
    try:
        whole = yaml.safe_load(data) if form is Form.YAML else [json.loads(line) for line in data.splitlines()]
    except (ValueError, yaml.YAMLError):
        return data
    for _ in range(int(rng.integers(1, 4))):
        whole = _restructured(whole, rng)
    if form is Form.LINES:
        return "".join(json.dumps(one) + "\n" for one in (whole if isinstance(whole, list) else [whole])).encode()
    return yaml.safe_dump(whole, sort_keys=False, allow_unicode=True).encode("utf-8", "surrogatepass")


def _restructured(whole: Any, rng: np.random.Generator) -> Any:
    """One place removed, doubled, renamed, exchanged, or replaced by an odd value or a tree of its own words."""
    places = [*_places(whole)]
    if not places:
        return whole
    container, key = places[int(rng.integers(len(places)))]
    other, at = places[int(rng.integers(len(places)))]
    match int(rng.integers(7)):
        case 0:
            del container[key]
        case 1 if isinstance(container, list):
            container.insert(key, copy.deepcopy(container[key]))
        case 2 if isinstance(container, dict):
            container[str(at) if rng.random() < 0.5 else _one(WORDS[:10], rng)] = container.pop(key)
        case 3:
            container[key] = copy.deepcopy(other[at])
        case 4:
            container[key] = _tree([str(k) for _, k in places], rng, int(rng.integers(1, 5)))
        case 5 if isinstance(container[key], int | float):
            container[key] *= float(rng.choice([-1.0, 0.0, 1e-3, 1e3, 1e9]))
        case _:
            container[key] = _value(rng)
    return whole


def _tree(words: Sequence[str], rng: np.random.Generator, depth: int) -> Any:
    """Lists and mappings of the document's own keys."""
    if depth == 0:
        return _value(rng)
    if rng.random() < 0.5:
        return [_tree(words, rng, depth - 1) for _ in range(int(rng.integers(0, 4)))]
    return {_one(words, rng): _tree(words, rng, depth - 1) for _ in range(int(rng.integers(0, 4)))}


def _value(rng: np.random.Generator) -> Any:
    text = _one((*NUMBERS, *WORDS[:12]), rng)
    match int(rng.integers(3)):
        case 0:
            return text
        case 1:
            try:
                return float(text)
            except ValueError:
                return None
        case _:
            return int(rng.integers(-(2**62), 2**62)) if rng.random() < 0.3 else int(rng.integers(-3, 12))


def _places(data: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key) of nested data."""
    keys = list(data) if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
    for key in keys:
        yield data, key
        yield from _places(data[key])


def _encoded(text: str) -> bytes:
    return (
        text.encode("utf-8", "surrogatepass")
        if any("\ud800" <= c <= "\udbff" for c in text)
        else text.encode("utf-8", "surrogateescape")
    )


OF_BYTES: tuple[Change, ...] = (flip, overwrite, cut, double, insert)
OF_TEXT: tuple[Change, ...] = (number, number, word, word, lines, nest, encoded_otherwise)
