"""Plots of evaluations, by matplotlib (extra ``plots``), without a display."""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtri, gammaln, xlogy

from fgreg.errors import InputError, MissingExtraError
from fgreg.evaluation.run import SessionEvaluation
from fgreg.evaluation.summary import all_tre_mm, pooled_curve
from fgreg.geometry.transforms import FloatArray
from fgreg.output.atomic_file import FileKind, write_file
from fgreg.viewer import palette
from fgreg.viewer.palette import Color

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = {
    "png": FileKind("a plot of fgreg", (b"\x89PNG\r\n",), (b"tEXtSoftware\0fgreg",)),
    "svg": FileKind("a plot of fgreg", (b"<?xml",), (b"<dc:title>fgreg</dc:title>",)),
}
PLOTS = ("error-against-pairs", "held-out-pairs", "influence", "tre", "predicted-against-true")
MOST_BARS = 60
MARKERS = "osD^vPX*"
"""Signs of sessions, which go round where there are more."""
NAMED_SESSIONS = 6
"""In a legend; where there are more, none is named."""


def _hex(color: Color) -> str:
    return "#{:02x}{:02x}{:02x}".format(*color)


BLUE, ORANGE, RED, GREY = _hex(palette.BLUE), _hex(palette.ORANGE), _hex(palette.VERMILLION), "#6b7280"
"""Told apart by colour-blind people; what is beyond a limit has another sign or a hatch, too."""


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


def save_plots(evaluations: Sequence[SessionEvaluation], folder: Path, file_format: str, limit_mm: float) -> list[Path]:
    """Write the plots for which these evaluations have figures; returns the files.

    ``limit_mm``: predicted 95 % error at the worst target up to which the verdict is ``ok``.

    Raises:
        MissingExtraError: matplotlib is not installed.
        InputError: the folder cannot be written to, or another format than ``FORMATS``.
    """
    check_plots(folder, file_format)
    makers: tuple[Callable[[Sequence[SessionEvaluation]], Figure | None], ...] = (
        partial(curve_figure, limit_mm=limit_mm),
        held_out_figure,
        influence_figure,
        partial(tre_figure, limit_mm=limit_mm),
        partial(predicted_figure, limit_mm=limit_mm),
    )
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


def _limit(axes: Axes, limit_mm: float, *, upright: bool = False, other_end: bool = False) -> None:
    """Draw the limit as a line with its name, within the picture: at its upper or right end, or at the other one."""
    text = f"limit {limit_mm:.1f} mm"
    ground = {"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85}
    style: dict[str, Any] = {"fontsize": 8, "color": RED, "ha": "right", "bbox": ground}
    if upright:
        axes.axvline(limit_mm, color=RED, linewidth=1.4)
        end, va = (0.03, "bottom") if other_end else (0.97, "top")
        axes.text(limit_mm, end, text, transform=axes.get_xaxis_transform(), rotation=90.0, va=va, **style)
    else:
        axes.axhline(limit_mm, color=RED, linewidth=1.4)
        style["ha"] = "left" if other_end else "right"
        axes.text(
            0.01 if other_end else 0.99, limit_mm, text, transform=axes.get_yaxis_transform(), va="bottom", **style
        )


def curve_figure(evaluations: Sequence[SessionEvaluation], limit_mm: float) -> Figure | None:
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
            label="true TRE, mean to 95 % quantile",
        )
        axes.plot(pairs, [p.tre_mm.mean for p in known if p.tre_mm], "o-", color=BLUE, label="true TRE, mean")
    expected = [(p.pairs, p.expected_mm) for p in points if p.expected_mm is not None]
    axes.plot(*zip(*expected, strict=True), "--", color=GREY, label="predicted TRE, mean")
    residual = [(p.pairs, p.pair_residual_mm.mean) for p in points if p.pair_residual_mm is not None]
    if residual:
        axes.plot(*zip(*residual, strict=True), "s-", color=ORANGE, label="pair residual, mean (Eq. 12, not a TRE)")
    _limit(axes, limit_mm)
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
        beyond = [v > limit for v in nis]
        bars_drawn = lower.bar(place, nis, color=[RED if b else BLUE for b in beyond], width=0.7)
        for bar, b in zip(bars_drawn, beyond, strict=True):
            bar.set_hatch("///" if b else "")
        lower.axhline(limit, color=GREY, linestyle="--", linewidth=1)
        lower.annotate(
            "95 % bound",
            (0.99, limit),
            xycoords=("axes fraction", "data"),
            fontsize=8,
            color=GREY,
            va="bottom",
            ha="right",
        )
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


def tre_figure(evaluations: Sequence[SessionEvaluation], limit_mm: float) -> Figure | None:
    """Cumulative distribution of the TRE over targets and sessions."""
    errors = np.sort(all_tre_mm(evaluations))
    if errors.size == 0:
        return None
    figure = new_figure()
    axes = figure.subplots()
    axes.step(errors, 100 * np.arange(1, errors.size + 1) / errors.size, where="post", color=BLUE)
    p95 = float(np.quantile(errors, 0.95))
    for value, name in ((float(errors.mean()), "mean"), (p95, "95 % quantile")):
        axes.axvline(value, color=GREY, linestyle="--", linewidth=1)
        axes.annotate(f"{name} {value:.2f}", (value, 3), fontsize=8, color=GREY, rotation=90, ha="right")
    _limit(axes, limit_mm, upright=True)
    axes.set(xlabel="true TRE, mm", ylabel="targets, %", xlim=(0, None), ylim=(0, 101))
    _dress(axes)
    axes.set_title(f"TRE of {errors.size} targets, {len(evaluations)} session(s)", fontsize=10, loc="left")
    return figure


def predicted_figure(evaluations: Sequence[SessionEvaluation], limit_mm: float) -> Figure | None:
    """True error against its predicted 95 % bound, a sign per target: a cross where it is not held."""
    found = [(e.name, *_bounds_and_errors(e)) for e in evaluations]
    found = [(name, bound, error) for name, bound, error in found if bound.size]
    if not found:
        return None
    figure = new_figure(6.4, 4.8)
    axes = figure.subplots()
    bounds, errors = (np.concatenate(part) for part in ([f[1] for f in found], [f[2] for f in found]))
    end = 1.06 * max(float(bounds.max()), float(errors.max()), limit_mm)
    axes.plot([0, end], [0, end], color=GREY, linestyle="--", linewidth=1, label="true error = 95 % bound")
    named = len(found) <= NAMED_SESSIONS
    for number, (name, bound, error) in enumerate(found):
        sign, holds = MARKERS[number % len(MARKERS)], error <= bound
        label = name.replace("$", r"\$") if named else None
        axes.plot(bound[holds], error[holds], sign, color=BLUE, markersize=5, alpha=0.7, label=label)
        axes.plot(bound[~holds], error[~holds], "x", color=RED, markersize=7)
    if (beyond := int((errors > bounds).sum())) and named:
        axes.plot([], [], "x", color=RED, label=f"error beyond its bound: {beyond}")
    _limit(axes, limit_mm, other_end=True)
    _limit(axes, limit_mm, upright=True, other_end=True)
    axes.set(xlabel="predicted 95 % bound, mm", ylabel="true error, mm", xlim=(0, end), ylim=(0, end))
    _dress(axes)
    axes.legend(frameon=False, fontsize=8, loc="center left")
    held = errors.size - beyond
    axes.set_title(
        f"Predicted against true error: the 95 % bound holds at {held} of {errors.size} targets",
        fontsize=10,
        loc="left",
    )
    return figure


def _bounds_and_errors(evaluation: SessionEvaluation) -> tuple[FloatArray, FloatArray]:
    """The predicted bounds and the true errors of a session's targets, where both are known, (n,) each."""
    whole = evaluation.whole
    known = [(b, e) for b, e in zip(whole.bound_mm, whole.tre_mm, strict=True) if b is not None and e is not None]
    if not known:
        return np.zeros(0), np.zeros(0)
    return np.concatenate([b for b, _ in known]), np.concatenate([e for _, e in known])
