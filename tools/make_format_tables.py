"""Write the tables of docs/devices.md, sessions/README.md and docs/setup.md from the described classes.

    python tools/make_format_tables.py

A table stands between ``<!-- table: NAME -->`` and ``<!-- end -->``.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

from fgreg.convert.mapping import MAPPING
from fgreg.drivers.registry import ENTRIES
from fgreg.model.commissioned_rig import RIG
from fgreg.model.estimate import RESULT
from fgreg.model.events import EVENTS, MarkerRecord, PlaneRecord, SpotRecord, TrusRecord
from fgreg.model.session_model import SESSION
from fgreg.model.setup_recording import SETUP_LINES
from fgreg.schema.kinds import Converted, Kind, ListOf
from fgreg.schema.record import Field, Record, record
from fgreg.schema.yaml_writer import one_line_yaml
from fgreg.session.ground_truth import GROUND_TRUTH

ROOT = Path(__file__).parents[1]
PAGES = (ROOT / "docs" / "devices.md", ROOT / "sessions" / "README.md", ROOT / "docs" / "setup.md")
_LINES = {"events": EVENTS, "recording": SETUP_LINES}
_PARTS = {MarkerRecord: "marker", TrusRecord: "trus", PlaneRecord: "plane", SpotRecord: "spot"}
_TABLE = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def with_tables(page: str) -> str:
    """The page with all its tables made again."""
    return _TABLE.sub(lambda found: found[1] + _table(found[2]) + found[3], page)


def _table(name: str) -> str:
    if name == "drivers":
        drivers = [(f"`{e.role}`", f"`{e.name}`", e.help, f"`{e.extra}`" if e.extra else "") for e in ENTRIES]
        lines = [f"| {' | '.join(cells)} |" for cells in drivers]
        return "\n".join(["| role | driver | device | extra |", "|---|---|---|---|", *lines]) + "\n"
    if name in _LINES:
        lines = [
            f"| `{kind}` | {line}" for kind, of in _LINES[name].records.items() for line in _rows(of, nested=False)
        ]
        lines = [line for line in lines if "| `t` |" not in line]
        return "\n".join(["| `type` | key | | value | default |", "|---|---|---|---|---|", *lines]) + "\n"
    records = {
        "session": SESSION,
        **{name: record(cls) for cls, name in _PARTS.items()},
        "truth": GROUND_TRUTH,
        "result": RESULT,
        "rig": RIG,
        "mapping": MAPPING,
    }
    lines = [f"| {line}" for line in _rows(records[name])]
    return "\n".join(["| key | | value | default |", "|---|---|---|---|", *lines]) + "\n"


def _rows(of: Record, prefix: str = "", nested: bool = True) -> Iterator[str]:
    """A row for each key; those of mappings below follow theirs, where ``nested``."""
    for name, value in of.constants.items():
        if name != "type":
            yield f"`{prefix}{name}` | | `{value}` | required |"
    for field in of.fields:
        inner, many = _inner(field.kind)
        value = field.kind.expected if inner is None else "a list of mappings" if many else "a mapping"
        if not nested and inner is not None:
            value = f"{'a list of ' if many else ''}`{_PARTS[inner.cls]}`, below"
        value += ", or null" if field.key.null else ""
        cells = (field.key.help, value, _default(field))
        yield " | ".join([f"`{prefix}{field.name}`", *(cell.replace("|", "\\|") for cell in cells)]) + " |"
        if inner is not None and nested:
            yield from _rows(inner, f"{prefix}{field.name}{'[]' if many else ''}.")


def _inner(kind: Kind) -> tuple[Record | None, bool]:
    """The record of a mapping below, where its keys are all known by name; whether there is a list of them."""
    if isinstance(kind, Converted):
        return _inner(kind.stored)
    if isinstance(kind, ListOf):
        return _inner(kind.each)[0], True
    return (kind if isinstance(kind, Record) and any(field.key.help for field in kind.fields) else None), False


def _default(field: Field) -> str:
    if field.key.requires:
        return f"only with `{field.key.requires}`"
    if field.required:
        return "required"
    if field.key.required_if:
        key, value = field.key.required_if
        return f"required where `{key}` is {one_line_yaml(value)}"
    if field.key.default or field.default in (None, (), ""):
        return field.key.default
    if dataclasses.is_dataclass(field.default) or isinstance(field.default, dict):
        return ""
    written = field.kind.write(field.default)
    if isinstance(written, list):
        return f"`[{', '.join(f'{entry:g}' for entry in written)}]`"
    return f"`{one_line_yaml(round(written, 9) if isinstance(written, float) else written)}`".replace('"', "")


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")
