"""The command ``fgreg live``."""

from __future__ import annotations

import json
import math
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fgreg.cli_options import LimitOption, solve_config
from fgreg.errors import InputError

if TYPE_CHECKING:
    from fgreg.config import SolveConfig
    from fgreg.operation.loop import Figures, LiveLoop, Status
    from fgreg.operation.start import LiveSetup
    from fgreg.pipeline import SolveReport

MakeExtras = Callable[["SolveReport"], Any]
EXIT_REFUSED = 1
SHOW_S = 0.25


def add_live(app: typer.Typer, make_extras: MakeExtras) -> None:
    """Register the command; ``make_extras`` gives what a summary tells besides the estimate."""

    @app.command()
    def live(
        config: Annotated[
            Path | None,
            typer.Argument(metavar="[CONFIG]", help="A driver per role (CONFIG.yaml). Default: a simulated room."),
        ] = None,
        out: Annotated[
            Path | None,
            typer.Option(
                "--out",
                metavar="FOLDER",
                help="The session to record: a new folder, or one to go on with. Default: fgreg-live-DATE-TIME here.",
            ),
        ] = None,
        duration: Annotated[
            float | None, typer.Option("--duration", metavar="S", help="End after so many seconds. Default: at Ctrl-C.")
        ] = None,
        no_viewer: Annotated[
            bool, typer.Option("--no-viewer", help="Show the session in the terminal only, not in Rerun.")
        ] = False,
        rrd: Annotated[
            Path | None,
            typer.Option("--rrd", metavar="FILE", help="Record what a viewer would show."),
        ] = None,
        seed: Annotated[int, typer.Option("--seed", help="Of the simulated room.")] = 1,
        aims: Annotated[int, typer.Option("--aims", help="Calibration shots in the simulated room.")] = 8,
        bumps: Annotated[
            float,
            typer.Option("--bump-every", metavar="S", help="Mean time between moves of the simulated camera."),
        ] = 240.0,
        limit_mm: LimitOption = 3.0,
        example_config: Annotated[
            bool, typer.Option("--example-config", help="Print a CONFIG.yaml with every driver and key, explained.")
        ] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document at the end.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
    ) -> None:
        """Register while it happens: devices in, registration and stage angle out, everything recorded.

        Without CONFIG a simulated operating room runs: a surgeon calibrates the fibre at a board, points at tissue, the
        stage searches the sound, the registration forms, and the stage follows the beam. Now and then somebody bumps
        into the camera. With CONFIG your devices are used, each by the driver that it names.

        Devices that disappear are told within a second and used again when they are back. A stage that stopped for
        trouble is latched: it says why, and moves again after `reset` and a new request.

        Ctrl-C ends it: the stage stops first, the session in FOLDER is complete and solved once more as a whole.
        Replay it: fgreg replay FOLDER. Exit status 1 where the verdict is refused.
        """
        if example_config:
            from fgreg.operation.config_keys import example_config as example

            typer.echo(example(), nl=False)
            return
        from fgreg.estimate import Verdict
        from fgreg.operation.start import default_folder
        from fgreg.pipeline import SolveRequest, solve_session
        from fgreg.report import print_summary, summary_dict

        if duration is not None and not 0 < duration < math.inf:
            raise InputError("--duration", str(duration), "seconds > 0")
        settings = solve_config(limit_mm, "")
        folder = default_folder() if out is None else out
        silent = as_json or quiet
        with ExitStack() as stack:
            if config is None:
                setup = _room(stack, seed, aims, bumps)
            else:
                setup, settings = _configured(stack, config, silent=silent)
            viewer = not (no_viewer or silent)
            figures = _conduct(setup, folder, settings, duration, rrd, viewer=viewer, silent=silent)
        report = solve_session(SolveRequest(folder, None, None), settings, None)
        extras = make_extras(report)
        if as_json:
            document = summary_dict(report.session.model, report.estimate, extras)
            typer.echo(json.dumps({**document, "live": figures_dict(figures)}, indent=2))
        elif not quiet:
            print_summary(report.session.model, report.estimate, extras)
            typer.echo(figures_line(figures))
        if report.estimate.verdict is Verdict.REFUSED:
            raise typer.Exit(EXIT_REFUSED)


def _room(stack: ExitStack, seed: int, aims: int, bump_every_s: float) -> LiveSetup:
    from fgreg.operation.rooms import simulated_room

    if not 0 <= aims <= 100:
        raise InputError("--aims", str(aims), "0 to 100")
    if not bump_every_s > 0:
        raise InputError("--bump-every", str(bump_every_s), "seconds > 0, or inf")
    return simulated_room(stack, seed, aims, bump_every_s)


def _configured(stack: ExitStack, path: Path, *, silent: bool) -> tuple[LiveSetup, SolveConfig]:
    from fgreg.operation.config import read_config

    found = read_config(path)
    for warning in found.warnings:
        sys.stderr.write(f"fgreg: warning: {warning}\n")
    return found.live_setup(stack, (lambda _line: None) if silent else typer.echo), found.solve


def _conduct(
    setup: LiveSetup,
    folder: Path,
    config: SolveConfig,
    duration_s: float | None,
    rrd: Path | None,
    *,
    viewer: bool,
    silent: bool,
) -> Figures:
    from fgreg.motion.guard import emergency_stop_all
    from fgreg.operation.painter import painted
    from fgreg.operation.start import running

    ended = False

    def end(_number: int, _frame: object) -> None:
        nonlocal ended
        ended = True
        emergency_stop_all()  # the loop ends after its turn; the stage does not wait for that

    with _display(silent) as (say, show), painted(rrd, folder.name, live=viewer, say=say) as painter:
        before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGHUP)}
        try:
            with running(setup, folder, config, painter.taken, say) as session:
                painter.session(session.model)
                until = math.inf if duration_s is None else time.monotonic() + duration_s
                shown = -math.inf

                def on_status(status: Status) -> None:
                    nonlocal shown
                    painter.status(status)
                    if status.now_s - shown > SHOW_S:
                        shown = status.now_s
                        show(session.loop, status)

                say(f"recording to {folder}")
                try:
                    session.loop.run(lambda: not ended and time.monotonic() < until, on_status)
                except KeyboardInterrupt:
                    say("ending")
                return session.loop.figures
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def figures_dict(figures: Figures) -> dict[str, Any]:
    """What the loop measured of itself."""
    import numpy as np

    latency = np.array(figures.latency_ms)
    quantiles = np.percentile(latency, (50, 99, 100)) if latency.size else (math.nan,) * 3
    return {
        "frames": figures.frames,
        "skipped": figures.skipped,
        "marker_found": figures.found,
        "pulses": figures.pulses,
        "stage_orders": figures.orders,
        "latency_ms": dict(zip(("p50", "p99", "max"), (round(float(q), 2) for q in quantiles), strict=True)),
    }


def figures_line(figures: Figures) -> str:
    """The same on one line."""
    found = figures_dict(figures)
    latency = found["latency_ms"]
    return (
        f"Live: {found['frames']} frames looked into, {found['skipped']} skipped, {found['pulses']} pulses, "
        f"{found['stage_orders']} orders to the stage; from frame to angle: median {latency['p50']:.0f}, "
        f"99 % {latency['p99']:.0f}, longest {latency['max']:.0f} ms"
    )


Say = Callable[[str], None]
Show = Callable[["LiveLoop", "Status"], None]


@contextmanager
def _display(silent: bool) -> Iterator[tuple[Say, Show]]:
    """A panel that changes on a terminal, else a line whenever something new is told."""
    if silent:
        yield lambda _text: None, lambda _loop, _status: None
        return
    from rich.console import Console
    from rich.live import Live

    console = Console(highlight=False, emoji=False)
    if not sys.stdout.isatty():
        last: list[str] = [""]

        def line(_loop: LiveLoop, status: Status) -> None:
            if status.text != last[0]:
                last[0] = status.text
                console.print(status_line(status), soft_wrap=True)

        yield lambda text: console.print(text, style="dim"), line
        return
    with Live(console=console, refresh_per_second=4, transient=True) as area:

        def panel(loop: LiveLoop, status: Status) -> None:
            area.update(status_panel(loop, status))

        yield lambda text: console.print(text, style="dim"), panel


def status_line(status: Status) -> str:
    """One line: how far, the estimate, what was told last."""
    known = status.recorder.known
    lost = f"  lost: {', '.join(status.lost)}" if status.lost else ""
    verdict = known.verdict.value if known.registered else "no registration"
    state = f"epoch {known.epoch}, {known.pairs} looks, {verdict}"
    return f"{status.stage:<11} {state:<36} {status.text}{lost}"


def status_panel(loop: LiveLoop, status: Status) -> Any:
    """The session as a panel."""
    from rich.panel import Panel
    from rich.table import Table

    from fgreg.report import STYLES

    state, plane, answer = status.recorder, status.plane, status.answer
    known, estimate = state.known, state.estimate
    table = Table.grid(padding=(0, 2))
    table.add_row("stage of the session", status.stage)
    verdict = known.verdict.value if known.registered else "no registration yet"
    worst = "" if estimate is None or estimate.predicted_tre is None else f"{estimate.predicted_tre.worst_mm:.2f} mm"
    looks = f"epoch {known.epoch}, {known.pairs} looks"
    table.add_row("registration", f"[{STYLES[known.verdict]}]{verdict}[/]  {looks}  {worst}")
    for reason in known.reasons[:2]:
        table.add_row("", reason)
    if plane is None:
        table.add_row("stage", "not there")
    else:
        told = None if answer is None else answer.stage_rad
        wanted = "" if told is None else f"  beam at {math.degrees(told):.1f} deg"
        asked = f"  ({plane.requested})" if plane.requested is not None else ""
        table.add_row("stage", f"{math.degrees(plane.scan_rad):.1f} deg{asked}{wanted}  {status.latched}")
    figures = loop.figures
    latency = f"  {figures.latency_ms[-1]:.0f} ms" if figures.latency_ms else ""
    table.add_row("camera", f"{figures.frames} frames, {figures.skipped} skipped, marker in {figures.found}{latency}")
    events = f"{state.aims} aims, {state.pairs} looks, {state.refused} refused, {state.waiting} waiting"
    table.add_row("recorded", events)
    if status.lost or state.trouble:
        troubles = [*(f"{role} lost" for role in status.lost), *filter(None, [state.trouble])]
        table.add_row("[red]trouble[/]", "; ".join(troubles))
    table.add_row("now", f"[bold]{status.text}[/]")
    return Panel(table, title="fgreg live", subtitle="Ctrl-C ends the session", expand=True)
