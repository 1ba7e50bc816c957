"""The command ``fgreg live``."""

import json
import math
import signal
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fgreg.cli.options import LimitOption, solve_config, warn, warn_of_leftovers
from fgreg.errors import InputError

if TYPE_CHECKING:
    from fgreg.cli.live_display import LiveDisplay
    from fgreg.live.launch import LiveSetup
    from fgreg.live.status import Figures, Status
    from fgreg.model.solve_config import SolveConfig
    from fgreg.pipeline.solve import SolveReport

MakeExtras = Callable[["SolveReport"], Any]
Progress = Callable[[str, int, int], None]
ProgressBar = Callable[[bool], AbstractContextManager[Progress]]
EXIT_REFUSED = 1
IN_CONFIG = {
    "seed": "room.seed",
    "aims": "settings.aims",
    "bumps": "room.bump_every_s",
    "width": "room.width",
    "static_tags": "room.static_tags",
    "limit_mm": "settings.limit_mm",
}
"""Parameters of the command, and their keys in CONFIG.yaml."""


def add_live(app: typer.Typer, make_extras: MakeExtras, progress_bar: ProgressBar) -> None:
    """Register the command; ``make_extras`` gives what a summary has besides the estimate.

    ``progress_bar(quiet)`` shows progress on standard error.
    """

    @app.command()
    def live(
        context: typer.Context,
        config: Annotated[
            Path | None,
            typer.Argument(metavar="CONFIG", help="A driver per role (CONFIG.yaml). Default: a simulated room."),
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
            float | None, typer.Option("--duration", metavar="S", help="End after this time. Default: at Ctrl-C.")
        ] = None,
        no_viewer: Annotated[
            bool,
            typer.Option(
                "--no-viewer", help="Show the session in the terminal only, not in Rerun: where there is no screen."
            ),
        ] = False,
        rrd: Annotated[
            Path | None,
            typer.Option("--rrd", metavar="FILE", help="Also write a Rerun recording."),
        ] = None,
        seed: Annotated[int, typer.Option("--seed", help="Random seed of the simulated room.")] = 1,
        aims: Annotated[int, typer.Option("--aims", help="Calibration shots in the simulated room.")] = 8,
        bumps: Annotated[
            float,
            typer.Option("--bump-every", metavar="S", help="Mean time between moves of the simulated camera."),
        ] = 240.0,
        static_tags: Annotated[
            int,
            typer.Option("--static-tags", help="Tags beside the simulated tissue that show camera moves; 0 to 3."),
        ] = 3,
        width: Annotated[
            int,
            typer.Option(
                "--width", metavar="PX", help="Of the simulated camera's images; below 640 boards may not be found."
            ),
        ] = 640,
        limit_mm: LimitOption = 3.0,
        certify: Annotated[
            bool,
            typer.Option(
                "--certify",
                help="Prove after each full solve that no other registration explains the pairs; nothing waits for it.",
            ),
        ] = False,
        example_config: Annotated[
            bool, typer.Option("--example-config", help="Print a CONFIG.yaml with every driver and key, explained.")
        ] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document at the end.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
    ) -> None:
        """Run a live session: devices in, registration and stage angle out, everything recorded.

        Without CONFIG a simulated operating room runs: a surgeon calibrates the fibre at a board, points at tissue, the
        stage searches for the PM, the registration improves, and the stage follows the beam. Now and then the camera
        is moved. With CONFIG your devices are used, each with the driver that it names.

        Lost devices are reported within a second and used again after they reconnect. A stage that stopped on a fault
        is latched: it reports the cause, and moves again after `reset` and a new request.

        \b
          fgreg live --aims 6 --duration 120 --no-viewer  the room, in the terminal
          fgreg live --rrd session.rrd             in Rerun's viewer, and recorded
          fgreg live --example-config > room.yaml  a CONFIG with every key to choose
          fgreg devices room.yaml                  which of its devices answer
          fgreg live room.yaml --out SESSION       a session with your devices

        Ctrl-C ends it: the stage stops first, the session in FOLDER is complete and solved once more as a whole.
        Replay it: fgreg replay FOLDER. Exit status 1 where the verdict is refused.
        """
        if example_config:
            from fgreg.live.config_keys import example_config as example

            typer.echo(example(), nl=False)
            return
        from fgreg.cli.live_display import LiveDisplay
        from fgreg.cli.report import print_summary
        from fgreg.cli.report_document import summary_dict
        from fgreg.live.launch import default_folder
        from fgreg.model.estimate import Verdict
        from fgreg.output.atomic_file import check_outputs
        from fgreg.pipeline.solve import SolveRequest, solve_session
        from fgreg.session.result_file import RESULT_FILE, RESULT_KIND
        from fgreg.viewer.recording_file import RECORDING

        if duration is not None and not 0 < duration < math.inf:
            raise InputError("--duration", str(duration), "seconds > 0")
        if config is not None:
            _alone(context)
        settings = solve_config(limit_mm, "", certify=certify)
        folder = default_folder() if out is None else out
        silent = as_json or quiet
        result = folder / RESULT_FILE if folder.is_dir() else None
        check_outputs([("the result", result, RESULT_KIND), ("--rrd", rrd, RECORDING)])
        warn_of_leftovers(folder, rrd)
        with ExitStack() as stack:
            viewer, display = not (no_viewer or silent), LiveDisplay(silent)
            seen = viewer or rrd is not None
            if config is None:
                setup = _room(stack, seed, aims, bumps, width, static_tags, seen=seen)
            else:
                setup, found = _configured(stack, config, display, seen=seen)
                settings = replace(found, certificate_budget=settings.certificate_budget)
            figures = _conduct(setup, folder, settings, duration, rrd, display, viewer=viewer)
        with progress_bar(silent) as progress:
            report = solve_session(SolveRequest(folder, None, None), settings, progress)
        extras = make_extras(report)
        if as_json:
            document = summary_dict(report.session.model, report.estimate, extras)
            typer.echo(json.dumps({**document, "live": figures_dict(figures)}, indent=2))
        elif not quiet:
            print_summary(report.session.model, report.estimate, extras)
            typer.echo(figures_line(figures))
        if report.estimate.verdict is Verdict.REFUSED:
            raise typer.Exit(EXIT_REFUSED)


def _alone(context: typer.Context) -> None:
    """Refuse options whose keys are in the CONFIG.yaml: they would have no effect. Raises InputError."""
    for name, key in IN_CONFIG.items():
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            option = "--" + {"bumps": "bump-every"}.get(name, name.replace("_", "-"))
            raise InputError(option, "it, and a CONFIG.yaml", f"{key} in the CONFIG.yaml instead")


def _room(
    stack: ExitStack, seed: int, aims: int, bump_every_s: float, width_px: int, static_tags: int, *, seen: bool
) -> "LiveSetup":
    from fgreg.live.simulated_room import simulated_room

    if not 0 <= seed < 2**31:
        raise InputError("--seed", str(seed), "0 to 2147483647")
    if not 160 <= width_px <= 1920:
        raise InputError("--width", str(width_px), "160 to 1920")
    if not 0 <= aims <= 100:
        raise InputError("--aims", str(aims), "0 to 100")
    if not bump_every_s >= 1:
        raise InputError("--bump-every", str(bump_every_s), "1 s or more, or inf")
    if not 0 <= static_tags <= 3:
        raise InputError("--static-tags", str(static_tags), "0 to 3")
    return simulated_room(stack, seed, aims, bump_every_s, width_px, static_tags=static_tags, seen=seen)


def _configured(stack: ExitStack, path: Path, display: "LiveDisplay", *, seen: bool) -> "tuple[LiveSetup, SolveConfig]":
    from fgreg.live.config import read_config

    found = read_config(path)
    for warning in found.warnings:
        warn(warning)
    return found.live_setup(stack, display.say, seen=seen, typing=display.typing), found.solve


def _conduct(
    setup: "LiveSetup",
    folder: Path,
    config: "SolveConfig",
    duration_s: float | None,
    rrd: Path | None,
    display: "LiveDisplay",
    *,
    viewer: bool,
) -> "Figures":
    from fgreg.live.launch import running
    from fgreg.live.viewer_feed import viewer_feed
    from fgreg.stage.stop_on_exit import emergency_stop_all

    ended = False

    def end(_number: int, _frame: object) -> None:
        nonlocal ended
        ended = True
        emergency_stop_all()  # the stage stops now; the loop ends after its current turn

    with display, viewer_feed(rrd, folder.name, live=viewer, say=display.say) as feed:
        before = {number: signal.signal(number, end) for number in (signal.SIGTERM, signal.SIGHUP)}
        try:
            with running(setup, folder, config, feed.taken, display.say) as session:
                feed.session(session.model, config.limit_mm)
                until = math.inf if duration_s is None else time.monotonic() + duration_s

                def on_status(status: "Status") -> None:
                    feed.status(status)
                    display.show(session.loop.figures, session.model.stage, status)

                display.say(f"recording to {folder}", lasting=True)
                try:
                    session.loop.run(lambda: not ended and time.monotonic() < until, on_status)
                except KeyboardInterrupt:
                    display.say("ending")
                return session.loop.figures
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def figures_dict(figures: "Figures") -> dict[str, Any]:
    """The loop's statistics as plain types."""
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


def figures_line(figures: "Figures") -> str:
    """The loop's statistics on one line."""
    found = figures_dict(figures)
    latency = found["latency_ms"]
    return (
        f"Live: {found['frames']} frames used, {found['skipped']} skipped, {found['pulses']} pulses, "
        f"{found['stage_orders']} orders to the stage; from frame to angle: median {latency['p50']:.0f}, "
        f"99 % {latency['p99']:.0f}, longest {latency['max']:.0f} ms"
    )
