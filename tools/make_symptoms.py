"""Write the tables of docs/guide/symptoms.md: every sentence that fgreg can say, from its code, with cause and remedy.

    python tools/make_symptoms.py

A table stands between ``<!-- sentences: NAME -->`` and ``<!-- end -->``. The sentences are the text constants of the
modules that tools/symptoms.yaml names for it, which also has the causes. Values within a sentence are shown as an
ellipsis. A sentence without a cause is an error, and so is a cause without a sentence.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "guide" / "symptoms.md"
CAUSES = ROOT / "tools" / "symptoms.yaml"
NOT_SAID = {"AssertionError", "InputError", "ValueError", "TypeError", "RuntimeError", "Key"}
"""Calls whose texts are not these: input errors explain themselves, the others are defects, and help of keys."""
LEAST_WORDS = 3
_TABLE = re.compile(r"(<!-- sentences: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def sentences(source: str) -> Iterator[str]:
    """The texts of a module that may be sentences, in its order."""
    for text in _texts(ast.parse(source)):
        if len(re.findall(r"[A-Za-z]{2,}", text)) >= LEAST_WORDS and " " in text:
            yield " ".join(text.split())


def _texts(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in NOT_SAID:
        return
    if isinstance(node, ast.Assert) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
        return  # a defect, or a docstring
    if isinstance(node, ast.arg | ast.AnnAssign) and isinstance(node.annotation, ast.Constant):
        return
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        yield node.value
    if isinstance(node, ast.JoinedStr):
        yield "".join(str(p.value) if isinstance(p, ast.Constant) else _value(p) for p in node.values)
        inner: list[ast.AST] = [part.value for part in node.values if isinstance(part, ast.FormattedValue)]
    else:
        inner = list(ast.iter_child_nodes(node))
    for child in inner:
        yield from _texts(child)


def _value(node: ast.expr) -> str:
    """What stands for a value: an ellipsis, or the two words of a choice."""
    choice = node.value if isinstance(node, ast.FormattedValue) else node
    if not isinstance(choice, ast.IfExp):
        return "…"
    words = [word.value for word in (choice.body, choice.orelse) if isinstance(word, ast.Constant)]
    if len(words) < 2 or not all(isinstance(word, str) for word in words):
        return "…"
    shown = [str(word) for word in words if word]
    return "/".join(shown) if len(shown) > 1 else f"({shown[0].strip()})" + " " * shown[0].endswith(" ")


def table_of(section: dict[str, Any], name: str = "") -> str:
    """The table of a section.

    Raises:
        ValueError: a sentence without a cause, or a cause without a sentence.
    """
    says, parts, used = section["says"], section["parts"], set()
    rows, missing = [], []
    for module in section["modules"]:
        for text in sentences((ROOT / module).read_text(encoding="utf-8")):
            keys = [key for key in (*says, *parts) if key in text]
            if not keys:
                missing.append(f"{module}: {text}")
                continue
            used.update(keys)
            key = max(keys, key=len)
            if key in says:
                rows.append(f"| {text.replace('|', chr(92) + '|')} | {says[key]} |")
    stale = [key for key in (*says, *parts) if key not in used]
    if missing or stale:
        raise ValueError(
            "\n".join([f"{name}: tools/symptoms.yaml", "without a cause:", *missing, "no longer said:", *stale])
        )
    return "\n".join(["| It says | What is behind it, and what to do |", "|---|---|", *dict.fromkeys(rows)]) + "\n"


def with_sentences(page: str) -> str:
    """The page with all its tables made again."""
    sections = yaml.safe_load(CAUSES.read_text(encoding="utf-8"))
    return _TABLE.sub(lambda found: found[1] + table_of(sections[found[2]], found[2]) + found[3], page)


if __name__ == "__main__":
    PAGE.write_text(with_sentences(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
