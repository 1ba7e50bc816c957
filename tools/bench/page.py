"""The tables of docs/performance.md."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bench.compare import Row, Target

PAGE = Path(__file__).resolve().parents[2] / "docs" / "performance.md"
BEGIN, END = "<!-- tables: python -m tools.bench --docs -->", "<!-- end of tables -->"


def tables(machine: str, rows: Sequence[Row], targets: Sequence[Target]) -> str:
    """Machine, limits, and a table for each case."""
    out = [*machine.splitlines()[:1], "", machine.splitlines()[1] + ".", "", "## Limits", ""]
    out += ["| ratio of times | measured | limit |", "|---|---|---|"]
    out += [f"| {t.text} | {t.ratio:.2f}{'' if t.met else ' **(missed)**'} | {t.limit:g} |" for t in targets]
    last = ""
    for row in rows:
        title = f"{row.section}: {row.case}"
        if title != last:
            out += [
                "",
                f"## {title[0].upper()}{title[1:]}",
                "",
                "| | ms | ratio | quartiles | |",
                "|---|---|---|---|---|",
            ]
            last = title
        if row.ms is None or row.ratio is None or row.low is None or row.high is None:
            out.append(f"| {row.name} | | | | {row.note} |")
        else:
            spread = f"{row.low:.3g} to {row.high:.3g}" if row.runs > 1 else "1 run"
            out.append(f"| {row.name} | {row.ms:.3g} | {row.ratio:.3g} | {spread} | {row.note} |")
    return "\n".join(out)


def write_tables(page: Path, machine: str, rows: Sequence[Row], targets: Sequence[Target]) -> None:
    """Replace the tables of a page.

    Raises:
        ValueError: the page has no place for them.
    """
    before, begin, rest = page.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{page}: no lines {BEGIN} and {END}")
    page.write_text(f"{before}{BEGIN}\n\n{tables(machine, rows, targets)}\n\n{END}{after}")
