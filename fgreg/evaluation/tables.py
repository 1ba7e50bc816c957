"""Evaluations as tables: in colour in a terminal, plain text of 80 columns elsewhere."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from fgreg.evaluation.run import SessionEvaluation
from fgreg.evaluation.summary import (
    CurvePoint,
    Spread,
    all_track_errors_deg,
    all_tre_mm,
    curve_of,
    pooled_curve,
    prediction_of,
    spread_of,
)
from fgreg.model.estimate import Verdict

MOST_ROWS = 40
MOST_INFLUENCES = 4
"""Tables of influence are printed for up to this many sessions."""
STYLES = {Verdict.OK: "bold green", Verdict.WARNING: "bold yellow", Verdict.REFUSED: "bold red"}
NOT_A_TRE = (
    "pair residual: line to arc of a pair held out, lambda and theta refitted (Eq. 12 of the publication). It is not a "
    "TRE: both refits absorb error."
)


def print_evaluation(evaluations: Sequence[SessionEvaluation], console: Console | None = None) -> None:
    """Print all tables; in colour in a terminal, without trailing blanks elsewhere."""
    console = console or Console(highlight=False, emoji=False)
    tables = Group(*_everything(evaluations))
    if console.is_terminal:
        console.print(tables)
        return
    with console.capture() as capture:
        console.print(tables)
    console.file.write("".join(line.rstrip() + "\n" for line in capture.get().splitlines()))


def _everything(evaluations: Sequence[SessionEvaluation]) -> Iterator[RenderableType]:
    yield _heading("Sessions")
    yield _indented(_sessions(evaluations))
    for evaluation in evaluations:
        if evaluation.whole.verdict is not Verdict.OK:
            for reason in evaluation.whole.reasons:
                yield Text(f"  {_clean(evaluation.name)}: {_clean(reason)}")
    if all_tre_mm(evaluations).size:
        yield Text()
        yield _heading("Against the truth")
        yield _indented(_against_truth(evaluations))
    cross = _cross_validation(evaluations)
    if cross.row_count:
        yield Text()
        yield _heading("PMs held out, predicted from the others")
        yield _indented(cross)
        yield Padding(Text(NOT_A_TRE, style="dim"), (0, 0, 0, 2))
    curve = pooled_curve(evaluations) if len(evaluations) > 1 else curve_of(evaluations[0]) if evaluations else ()
    if curve:
        yield Text()
        yield _heading("Error against number of pairs" + (f", {len(evaluations)} sessions" * (len(evaluations) > 1)))
        yield _indented(_curve(curve))
    if len(evaluations) > MOST_INFLUENCES:
        yield Text(
            f"\n  influence of each pair: for up to {MOST_INFLUENCES} sessions, or in --csv and --json", style="dim"
        )
    for evaluation in evaluations[: MOST_INFLUENCES * (len(evaluations) <= MOST_INFLUENCES)]:
        if evaluation.whole.influence:
            yield Text()
            yield _heading(f"What changes if a pair is left out: {_clean(evaluation.name)}")
            yield _indented(_influence(evaluation))
            if len(evaluation.whole.influence) > MOST_ROWS:
                yield Text(f"  the {MOST_ROWS} of largest influence; all are in --csv and --json", style="dim")


def _clean(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)


def _heading(text: str) -> Text:
    return Text(text, style="bold")


def _indented(table: Table) -> RenderableType:
    return Padding(table, (0, 0, 0, 2))


def _table(*columns: tuple[str, str]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    for title, unit in columns:
        left = title in ("session", "what", "held out")
        table.add_column(f"{title}\n{unit}", justify="left" if left else "right", overflow="fold")
    return table


def number(value: float | None, decimals: int = 2) -> str:
    """A figure for a table; a dash where there is none."""
    if value is None or math.isnan(value):
        return "-"
    return f"{value:.{decimals}f}" if math.isfinite(value) else "inf"


def _sessions(evaluations: Sequence[SessionEvaluation]) -> Table:
    several = any(len(item.whole.epoch_pms) > 1 for item in evaluations)
    table = _table(
        ("session", ""),
        *([("epoch", "")] if several else []),
        ("pairs", ""),
        ("verdict", ""),
        ("predicted TRE", "mean, mm"),
        ("95 % bound", "mean, mm"),
        ("", "worst, mm"),
    )
    for item in evaluations:
        for k, pms in enumerate(item.whole.epoch_pms):
            tre = item.whole.predicted[k]
            table.add_row(
                _clean(item.name) if k == 0 else "",
                *([str(k)] if several else []),
                str(pms),
                Text(item.whole.verdict.value, style=STYLES[item.whole.verdict]) if k == 0 else "",
                number(tre.mean_mm if tre else None),
                number(tre.p95_mm if tre else None),
                number(tre.worst_mm if tre else None),
            )
    return table


def _spread_cells(figures: Spread | None, decimals: int = 2) -> list[str]:
    if figures is None:
        return ["-"] * 4
    return [number(v, decimals) for v in (figures.mean, figures.std, figures.p95, figures.worst)]


def _against_truth(evaluations: Sequence[SessionEvaluation]) -> Table:
    table = _table(("what", ""), ("n", ""), ("mean", ""), ("std", ""), ("95 % quantile", ""), ("worst", ""))

    def row(what: str, figures: Spread | None, decimals: int = 2) -> None:
        if figures is not None:
            table.add_row(what, str(figures.count), *_spread_cells(figures, decimals))

    if len(evaluations) > 1:
        for item in evaluations[:MOST_ROWS]:
            row(f"TRE, mm: {_clean(item.name)}", spread_of(all_tre_mm([item])))
    row("TRE over targets, mm", spread_of(all_tre_mm(evaluations)))
    row("tracking error, deg", spread_of(all_track_errors_deg(evaluations)))
    angles = [math.degrees(a) for e in evaluations if (a := e.whole.beam_angle_rad) is not None]
    offsets = [o for e in evaluations if (o := e.whole.beam_offset_mm) is not None]
    row("beam direction, deg", spread_of(angles))
    row("beam at the fibre's tip, mm", spread_of(offsets))
    return table


def _cross_validation(evaluations: Sequence[SessionEvaluation]) -> Table:
    table = _table(
        ("held out", ""),
        ("PMs", ""),
        ("pair residual", "mean, mm"),
        ("", "std"),
        ("95 %", "below"),
        ("", "worst"),
        ("NIS per degree", "of freedom"),
        ("beyond", "95 %"),
    )
    folds = max((len(item.k_fold) for item in evaluations), default=0)
    for name, solves in (
        ("one by one", [s for e in evaluations for s in e.leave_one_out]),
        (f"{folds} folds", [s for e in evaluations for s in e.k_fold]),
    ):
        figures = prediction_of(solves)
        if figures is not None:
            table.add_row(
                name,
                str(figures.pair_residual_mm.count),
                *_spread_cells(figures.pair_residual_mm),
                number(figures.nis_per_degree),
                f"{100 * figures.beyond_95:.0f} %",
            )
    return table


def _curve(points: Sequence[CurvePoint]) -> Table:
    known = any(point.tre_mm is not None for point in points)
    table = _table(
        ("pairs", ""),
        ("subsets", ""),
        ("ambi-", "guous"),
        *([("TRE", "mean, mm"), ("95 %", "below"), ("", "worst")] if known else []),
        ("predicted TRE", "mean, mm"),
        ("pair residual", "mean, mm"),
        ("95 %", "below"),
    )
    for point in points:
        tre, residual = point.tre_mm, point.pair_residual_mm
        table.add_row(
            str(point.pairs),
            str(point.subsets),
            "-" if math.isnan(point.ambiguous) else f"{100 * point.ambiguous:.0f} %",
            *([number(v) for v in ((tre.mean, tre.p95, tre.worst) if tre else (None,) * 3)] if known else []),
            number(point.expected_mm),
            number(residual.mean if residual else None),
            number(residual.p95 if residual else None),
        )
    return table


def _influence(evaluation: SessionEvaluation) -> Table:
    several = len(evaluation.whole.epoch_pms) > 1
    table = _table(
        ("PM", ""),
        *([("epoch", "")] if several else []),
        ("targets move", "mean, mm"),
        ("", "worst, mm"),
        ("predicted TRE", "with, mm"),
        ("", "without"),
        ("pair residual", "held out, mm"),
        ("NIS", "held out"),
    )
    held = {pm.pm: pm for solve in evaluation.leave_one_out for pm in solve.held_out}
    items = list(evaluation.whole.influence)
    if len(items) > MOST_ROWS:
        items = sorted(sorted(items, key=lambda i: -i.moved_mm)[:MOST_ROWS], key=lambda i: i.pm)
    for item in items:
        left = held.get(item.pm)
        table.add_row(
            str(item.pm),
            *([str(item.epoch)] if several else []),
            number(item.moved_mm),
            number(item.worst_moved_mm),
            number(item.expected_mm),
            number(item.expected_without_mm),
            number(left.pair_residual_mm if left else None),
            number(left.nis if left else None, 1),
        )
    return table
