"""Plots of evaluations, by matplotlib (extra ``plots``), without a display."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri, gammaln, xlogy

from fgreg.errors import InputError, MissingExtraError
from fgreg.evaluation.run import SessionEvaluation
from fgreg.evaluation.summary import all_tre_mm, pooled_curve
from fgreg.geometry.transforms import FloatArray
from fgreg.output.atomic_file import FileKind, write_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = {
    "png": FileKind("a plot of fgreg", (b"\x89PNG\r\n",), (b"tEXtSoftware\0fgreg",)),
    "svg": FileKind("a plot of fgreg", (b"<?xml",), (b"<dc:title>fgreg</dc:title>",)),
}
PLOTS = ("error-against-pairs", "held-out-pairs", "influence", "tre")
BLUE, ORANGE, GREY, RED = "#2a6f97", "#d97706", "#6b7280", "#b91c1c"
MOST_BARS = 60


def new_figure(width: float = 6.4, height: float = 4.0) -> Figure:
    """An empty figure without a display or global state.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("matplotlib", "plots") from error
    return Figure(figsize=(width, height), dpi=150, layout="constrained")


def save_plots(evaluations: Sequence[SessionEvaluation], folder: Path, file_format: str = "png") -> list[Path]:
    """Write the plots for which these evaluations have figures; returns the files.

    Raises:
        MissingExtraError: matplotlib is not installed.
        InputError: the folder cannot be written to, or another format than ``FORMATS``.
    """
    check_plots(folder, file_format)
    makers = (curve_figure, held_out_figure, influence_figure, tre_figure)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(str(folder), f"no access ({error.strerror})", "a folder that can be written to") from error
    written = []
    for path, make in zip(plot_files(folder, file_format), makers, strict=True):
        figure = make(evaluations)
        if figure is not None:
            data = io.BytesIO()
            # No date in the file, so that the same figures give the same bytes.
            about = {"Software": "fgreg"} if file_format == "png" else {"Date": None, "Creator": "fgreg"}
            figure.savefig(data, format=file_format, metadata=about)
            write_file(path, data.getvalue(), FORMATS[file_format])
            written.append(path)
    return written


def plot_files(folder: Path, file_format: str) -> list[Path]:
    """The files that :func:`save_plots` may write."""
    return [folder / f"{name}.{file_format}" for name in PLOTS]


def check_plots(folder: Path, file_format: str) -> None:
    """Whether plots can be made and written, to be asked before the work begins.

    Raises:
        MissingExtraError: matplotlib is not installed.
        InputError: another format than ``FORMATS``, or the folder cannot be made or written to.
    """
    if file_format not in FORMATS:
        raise InputError("--plot-format", file_format, "one of " + ", ".join(FORMATS))
    new_figure()
    above = next((place for place in (folder, *folder.absolute().parents) if os.path.lexists(place)), folder)
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise InputError(str(folder), f"{above}, where no file can be made", "a folder that can be written to")


def _dress(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color="#e5e7eb", linewidth=0.8)
    axes.set_axisbelow(True)


def curve_figure(evaluations: Sequence[SessionEvaluation]) -> Figure | None:
    """TRE, predicted TRE and pair residual against the number of pairs."""
    points = pooled_curve(evaluations)
    if not points:
        return None
    figure = new_figure()
    axes = figure.subplots()
    known = [p for p in points if p.tre_mm is not None]
    if known:
        pairs = [p.pairs for p in known]
        axes.fill_between(
            pairs,
            [p.tre_mm.mean for p in known if p.tre_mm],
            [p.tre_mm.p95 for p in known if p.tre_mm],
            color=BLUE,
            alpha=0.15,
            linewidth=0,
            label="true TRE, mean to 95 %",
        )
        axes.plot(pairs, [p.tre_mm.mean for p in known if p.tre_mm], "o-", color=BLUE, label="true TRE, mean")
    expected = [(p.pairs, p.expected_mm) for p in points if p.expected_mm is not None]
    axes.plot(*zip(*expected, strict=True), "--", color=GREY, label="predicted TRE, mean")
    residual = [(p.pairs, p.pair_residual_mm.mean) for p in points if p.pair_residual_mm is not None]
    if residual:
        axes.plot(*zip(*residual, strict=True), "s-", color=ORANGE, label="pair residual, mean (Eq. 12, not a TRE)")
    axes.set(xlabel="pairs used", ylabel="mm", ylim=(0, None))
    axes.set_xticks([p.pairs for p in points])
    _dress(axes)
    axes.legend(frameon=False, fontsize=8)
    sessions = "" if len(evaluations) == 1 else f", {len(evaluations)} sessions"
    axes.set_title(f"Error against number of pairs{sessions}", fontsize=10, loc="left")
    return figure


def _chi_square_density(value: FloatArray, degrees_of_freedom: int) -> FloatArray:
    half = 0.5 * degrees_of_freedom
    return np.asarray(np.exp(xlogy(half - 1.0, value) - 0.5 * value - half * np.log(2.0) - gammaln(half)))


def held_out_figure(evaluations: Sequence[SessionEvaluation]) -> Figure | None:
    """Pair residual and NIS of PMs held out one by one."""
    held = [pm for e in evaluations for solve in (e.leave_one_out or e.k_fold) for pm in solve.held_out]
    if not held:
        return None
    bars = len(evaluations) == 1 and len(held) <= MOST_BARS
    figure = new_figure(6.4, 4.6)
    upper, lower = figure.subplots(2, 1, sharex=bars)
    residual, nis = [pm.pair_residual_mm for pm in held], [pm.nis for pm in held]
    limit = float(chdtri(held[0].degrees_of_freedom, 0.05))
    if bars:
        place = np.arange(len(held))
        upper.bar(place, residual, color=ORANGE, width=0.7)
        lower.bar(place, nis, color=[RED if v > limit else BLUE for v in nis], width=0.7)
        lower.axhline(limit, color=GREY, linestyle="--", linewidth=1)
        lower.annotate("95 %", (1.0, limit), xycoords=("axes fraction", "data"), fontsize=8, color=GREY, va="bottom")
        lower.set_xticks(place, [str(pm.pm) for pm in held], fontsize=7, rotation=90 if len(held) > 25 else 0)
        upper.margins(x=0.01)
        upper.set(ylabel="pair residual, mm")
        lower.set(xlabel="PM held out", ylabel="NIS")
    else:
        upper.hist(residual, bins=40, color=ORANGE)
        upper.set(xlabel="pair residual, mm", ylabel="PMs")
        lower.hist(nis, bins=40, range=(0, max(12.0, float(np.quantile(nis, 0.99)))), density=True, color=BLUE)
        grid = np.linspace(0, lower.get_xlim()[1], 200)
        lower.plot(grid, _chi_square_density(grid, held[0].degrees_of_freedom), color=GREY, label="chi square")
        lower.legend(frameon=False, fontsize=8)
        lower.set(xlabel="NIS", ylabel="density")
    for axes in (upper, lower):
        _dress(axes)
    upper.set_title("PMs predicted from the others (Eq. 12: not a TRE)", fontsize=10, loc="left")
    return figure


def influence_figure(evaluations: Sequence[SessionEvaluation]) -> Figure | None:
    """Distance by which the targets move if a PM is left out, in the session with the largest influence."""
    chosen = [e for e in evaluations if any(np.isfinite(i.moved_mm) for i in e.whole.influence)]
    if not chosen:
        return None

    def largest(evaluation: SessionEvaluation) -> float:
        return max(i.moved_mm for i in evaluation.whole.influence if np.isfinite(i.moved_mm))

    evaluation = max(chosen, key=largest)
    items = [i for i in evaluation.whole.influence if np.isfinite(i.moved_mm)]
    if len(items) > MOST_BARS:
        items = sorted(sorted(items, key=lambda i: -i.moved_mm)[:MOST_BARS], key=lambda i: i.pm)
    figure = new_figure()
    axes = figure.subplots()
    place = np.arange(len(items))
    axes.bar(place, [i.worst_moved_mm for i in items], color=BLUE, alpha=0.3, width=0.7, label="worst target")
    axes.bar(place, [i.moved_mm for i in items], color=BLUE, width=0.7, label="mean over targets")
    axes.set_xticks(place, [str(i.pm) for i in items], fontsize=7, rotation=90 if len(items) > 25 else 0)
    axes.set(xlabel="PM left out", ylabel="targets move, mm")
    _dress(axes)
    axes.legend(frameon=False, fontsize=8)
    axes.set_title(f"Influence of each pair: {evaluation.name}", fontsize=10, loc="left", parse_math=False)
    return figure


def tre_figure(evaluations: Sequence[SessionEvaluation]) -> Figure | None:
    """Cumulative distribution of the TRE over targets and sessions."""
    errors = np.sort(all_tre_mm(evaluations))
    if errors.size == 0:
        return None
    figure = new_figure()
    axes = figure.subplots()
    axes.step(errors, 100 * np.arange(1, errors.size + 1) / errors.size, where="post", color=BLUE)
    p95 = float(np.quantile(errors, 0.95))
    for value, name in ((float(errors.mean()), "mean"), (p95, "95 %")):
        axes.axvline(value, color=GREY, linestyle="--", linewidth=1)
        axes.annotate(f"{name} {value:.2f}", (value, 3), fontsize=8, color=GREY, rotation=90, ha="right")
    axes.set(xlabel="TRE, mm", ylabel="targets, %", xlim=(0, None), ylim=(0, 101))
    _dress(axes)
    axes.set_title(f"TRE of {errors.size} targets, {len(evaluations)} session(s)", fontsize=10, loc="left")
    return figure
