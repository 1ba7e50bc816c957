"""YAML from untrusted files: plain data only, bounded in size, depth and nodes, keys with their lines.

It uses the parser's events, so no constructor of PyYAML runs. Differences from ``yaml.safe_load``:

- a key may occur once; keys are texts; merge keys and tags are refused;
- every use of an alias counts as new nodes, and an alias inside its own anchor is refused, so that a few lines cannot
  expand to billions of nodes;
- numbers are those of YAML 1.2 (``1e-3`` is one; ``010``, ``1_000`` and ``1:30``, on which versions disagree, are
  texts and fail where a number is expected), truth values are ``true`` and ``false``, dates are texts.
"""

from __future__ import annotations

import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import yaml

from fgreg.errors import InputError, one_line
from fgreg.schema.limits import DIGITS, NESTING, SETUP_BYTES, SETUP_NODES

_NUMBER = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_LEADING_ZERO = re.compile(r"[-+]?0[0-9]+")
_OLD_NUMBER = re.compile(r"([-+]?[0-9]+\.[0-9]*|\.[0-9]+)([eE][-+][0-9]+)?")
_SPECIAL = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_TRUTH = {"true": True, "True": True, "TRUE": True, "false": False, "False": False, "FALSE": False}
_NULLS = frozenset({"", "~", "null", "Null", "NULL"})

# libyaml's parser where the wheel includes it (ten times faster); the pure one raises the same errors.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class YamlMapping(dict[str, object]):
    """A mapping with the 1-based line of each key.

    ``texts`` has the written form of numbers that YAML 1.1 reads as texts (``1e5``), for keys that expect a text:
    writers of 1.1 leave such texts without quotes.
    """

    __slots__ = ("lines", "texts")

    def __init__(self) -> None:
        super().__init__()
        self.lines: dict[str, int] = {}
        self.texts: dict[str, str] = {}


class YamlSequence(list[object]):
    """A list with the 1-based line of each item."""

    __slots__ = ("lines",)

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[int] = []


def open_file(path: Path, label: str) -> IO[bytes]:
    """A regular file, opened for reading; pipes and devices are refused before they can block.

    Raises:
        InputError: absent, not a regular file, or not readable. ``label`` is its name in messages.
    """
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            kind = "a folder" if stat.S_ISDIR(mode) else "something that is not a regular file"
            raise InputError(label, kind, "a file")
        return path.open("rb")
    except FileNotFoundError:
        raise InputError(label, "nothing", "a file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(label, f"no access ({reason})", "a file that can be read") from None


def read_bounded(path: Path, label: str, max_bytes: int) -> bytes:
    """All bytes of a regular file of at most ``max_bytes``.

    Raises:
        InputError: as :func:`open_file`, or larger.
    """
    with open_file(path, label) as file:
        try:
            size = os.fstat(file.fileno()).st_size
            data = b"" if size > max_bytes else file.read(size + 1)  # reserves a buffer of this size at once
            if len(data) > size:  # it grows
                data += file.read(max_bytes + 1 - len(data))
        except OSError as error:
            raise InputError(label, f"no access ({error.strerror})", "a file that can be read") from None
    if max(size, len(data)) > max_bytes:
        raise InputError(label, f"more than {max_bytes} bytes", f"a file of at most {max_bytes} bytes")
    return data


def load_yaml(path: Path, label: str, *, max_bytes: int = SETUP_BYTES, max_nodes: int = SETUP_NODES) -> YamlMapping:
    """Read the top mapping of a YAML file.

    Args:
        path: the file.
        label: its name in messages.
        max_bytes, max_nodes: bounds on size and on nodes after expansion of aliases.

    Raises:
        InputError: not readable, not UTF-8, not YAML, out of bounds, or not a mapping at the top.
    """
    data = read_bounded(path, label, max_bytes)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(f"{label}: line {line}", "bytes that are not UTF-8", "UTF-8 text") from None
    return parse_yaml(text, label, max_nodes=max_nodes)


def parse_yaml(text: str, label: str, *, max_nodes: int = SETUP_NODES) -> YamlMapping:
    """As :func:`load_yaml`, from a text."""
    builder = _Builder(label, max_nodes)
    try:
        for event in yaml.parse(text, Loader=_LOADER):
            builder.take(event)
    except yaml.MarkedYAMLError as error:
        where = f"{label}: line {error.problem_mark.line + 1}" if error.problem_mark else label
        if "nesting" in (error.problem or ""):  # libyaml may reach its own nesting limit first
            raise InputError(where, "nesting too deep", f"at most {NESTING} levels") from None
        raise InputError(where, f"bad YAML ({_problem(error.problem)})", "YAML") from None
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(label, f"bad YAML ({_problem(getattr(error, 'reason', None))})", "YAML") from None
    if not isinstance(builder.root, YamlMapping):
        found = "an empty file" if builder.root is None else "no mapping at the top"
        raise InputError(label, found, "a mapping (key: value)")
    return builder.root


def _problem(text: str | None) -> str:
    return one_line(text or "not readable as YAML", 100)


@dataclass(slots=True)
class _Open:
    """A collection under construction; ``key`` waits for its value."""

    node: YamlMapping | YamlSequence
    anchor: str | None
    line: int
    size: int = 1
    key: str | None = None
    key_line: int = 0


class _Builder:
    """Turns parser events into plain data, and counts the nodes, those of aliases at each use."""

    def __init__(self, label: str, max_nodes: int) -> None:
        self.root: object = None
        self._label = label
        self._max_nodes = max_nodes
        self._stack: list[_Open] = []
        self._anchors: dict[str, tuple[object, int, int] | None] = {}
        self._documents = 0
        self._nodes = 0

    def take(self, event: yaml.Event) -> None:
        line = event.start_mark.line + 1 if event.start_mark else 1
        if isinstance(event, yaml.DocumentStartEvent):
            self._documents += 1
            if self._documents > 1:
                raise self._error(line, "a second document", "one document")
        elif isinstance(event, yaml.ScalarEvent):
            self._refuse_tag(event.tag, line)
            self._scalar(event, line)
        elif isinstance(event, yaml.AliasEvent):
            self._alias(str(event.anchor), line)
        elif isinstance(event, yaml.CollectionStartEvent):
            self._refuse_tag(event.tag, line)
            self._start(isinstance(event, yaml.MappingStartEvent), event.anchor, line)
        elif isinstance(event, yaml.CollectionEndEvent):
            self._end()

    def _error(self, line: int, found: str, expected: str) -> InputError:
        return InputError(f"{self._label}: line {line}", found, expected)

    def _refuse_tag(self, tag: str | None, line: int) -> None:
        if tag is not None:
            raise self._error(line, f"the tag {one_line(tag, 60)}", "plain values without tags")

    def _count(self, nodes: int, line: int) -> None:
        self._nodes += nodes
        if self._nodes > self._max_nodes:
            raise self._error(line, "more nodes than a file may hold", f"at most {self._max_nodes}, aliases expanded")

    def _scalar(self, event: yaml.ScalarEvent, line: int) -> None:
        self._count(1, line)
        top = self._stack[-1] if self._stack else None
        if top is not None and isinstance(top.node, YamlMapping) and top.key is None:
            self._key(top, event.value, line)
            return
        value = _plain_value(event.value) if event.implicit[0] else event.value
        if event.anchor is not None:
            self._anchors[event.anchor] = (value, 1, 0)
        if isinstance(value, float) and not _OLD_NUMBER.fullmatch(event.value):
            self._note_text(top, event.value)
        self._put(value, 1, line)

    @staticmethod
    def _note_text(top: _Open | None, text: str) -> None:
        if top is not None and isinstance(top.node, YamlMapping) and top.key is not None:
            top.node.texts[top.key] = text

    def _key(self, top: _Open, key: str, line: int) -> None:
        if key in top.node:
            shown = one_line(key, 60)
            first = top.node.lines[key] if isinstance(top.node, YamlMapping) else line
            raise self._error(line, f"the key {shown} again (first on line {first})", "each key once")
        top.key, top.key_line = key, line

    def _alias(self, anchor: str, line: int) -> None:
        known = self._anchors.get(anchor)
        if known is None:
            raise self._error(line, f"the alias *{one_line(anchor, 60)} inside its own anchor", "data without loops")
        value, size, height = known
        if len(self._stack) + height > NESTING:
            raise self._error(line, "nesting too deep", f"at most {NESTING} levels")
        self._count(size, line)
        top = self._stack[-1] if self._stack else None
        if top is not None and isinstance(top.node, YamlMapping) and top.key is None:
            raise self._error(line, "an alias as a key", "a text as a key")
        self._put(value, size, line)

    def _start(self, mapping: bool, anchor: str | None, line: int) -> None:
        self._count(1, line)
        top = self._stack[-1] if self._stack else None
        if top is not None and isinstance(top.node, YamlMapping) and top.key is None:
            raise self._error(line, "a list or mapping as a key", "a text as a key")
        if len(self._stack) >= NESTING:
            raise self._error(line, "nesting too deep", f"at most {NESTING} levels")
        if anchor is not None:
            self._anchors[anchor] = None
        self._stack.append(_Open(YamlMapping() if mapping else YamlSequence(), anchor, line))

    def _end(self) -> None:
        done = self._stack.pop()
        if done.anchor is not None:
            self._anchors[done.anchor] = (done.node, done.size, _height(done.node))
        self._put(done.node, done.size, done.line)

    def _put(self, value: object, size: int, line: int) -> None:
        if not self._stack:
            self.root = value
            return
        top = self._stack[-1]
        top.size += size
        if isinstance(top.node, YamlSequence):
            top.node.append(value)
            top.node.lines.append(line)
        elif top.key is not None:
            top.size += 1
            top.node[top.key] = value
            top.node.lines[top.key] = top.key_line
            top.key = None


def _height(node: object) -> int:
    """Levels of nesting of a built value: at most ``NESTING``, so recursion is safe."""
    children = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    return 1 + max((_height(child) for child in children if isinstance(child, dict | list)), default=0)


def _plain_value(text: str) -> object:
    """The value of an unquoted scalar."""
    if text in _NULLS:
        return None
    if text in _TRUTH:
        return _TRUTH[text]
    if _INTEGER.fullmatch(text):
        # Python refuses to convert thousands of digits; no field here needs more than a double holds.
        return int(text) if len(text) <= DIGITS else float(text)
    if _LEADING_ZERO.fullmatch(text):
        return text
    if _NUMBER.fullmatch(text):
        return float(text)
    if _SPECIAL.fullmatch(text):
        return float(text.replace(".", ""))
    return text
