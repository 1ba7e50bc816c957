"""Plain data as readable YAML: matrices row by row, small mappings on one line, every float with a dot."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping

_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_NOT_PLAIN = frozenset({"null", "true", "false", "yes", "no", "on", "off", "y", "n"})


def yaml_text(document: Mapping[str, object], flow: Collection[str] = ()) -> str:
    """A document as text.

    Args:
        document: mappings, lists, texts, numbers, truth values, None.
        flow: keys whose mappings (or lists of mappings) are written on one line each.
    """
    return "".join(f"{line}\n" for line in _mapping(document, flow))


def one_line_yaml(value: object) -> str:
    """A value on one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {one_line_yaml(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(one_line_yaml, value)) + "]"
    if isinstance(value, str):
        return _quoted(value)
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    return _float(value) if isinstance(value, float) else str(value)


def _mapping(document: Mapping[str, object], flow: Collection[str]) -> Iterator[str]:
    for key, value in document.items():
        if isinstance(value, Mapping) and value and key not in flow:
            yield f"{key}:"
            yield from (f"  {line}" for line in _mapping(value, flow))
        elif isinstance(value, list) and value and not isinstance(value[0], int | float):
            yield f"{key}:"
            yield from (f"  {line}" for entry in value for line in _item(entry, key in flow, flow))
        else:
            plain = isinstance(value, str) and _PLAIN.fullmatch(value) and value.lower() not in _NOT_PLAIN
            yield f"{key}: {value if plain else one_line_yaml(value)}"


def _item(entry: object, one_line: bool, flow: Collection[str]) -> Iterator[str]:
    """An item of a list that is not on one line; rows of a matrix are."""
    if not isinstance(entry, Mapping) or one_line:
        yield f"- {one_line_yaml(entry)}"
        return
    first, *rest = _mapping(entry, flow)
    yield f"- {first}"
    yield from (f"  {line}" for line in rest)


def _float(value: float) -> str:
    """A float that every YAML reader reads as one: with a dot, and a sign in the exponent."""
    mantissa, exponent, power = repr(value).partition("e")
    if "." not in mantissa:
        mantissa += ".0"
    return mantissa + (exponent + (power if power[0] in "+-" else "+" + power) if exponent else "")


def _quoted(text: str) -> str:
    """A scalar in double quotes that reads back as ``text``."""
    return '"' + "".join(map(_escaped, text)) + '"'


def _escaped(c: str) -> str:
    code = ord(c)
    if c in '"\\':
        return "\\" + c
    if c.isprintable():
        return c
    if 0xD800 <= code <= 0xDFFF:
        return "\\uFFFD"  # half a surrogate pair cannot be written to a file
    return f"\\U{code:08X}"
