"""The command line: ``fgreg solve``, ``check``, ``simulate``; the other commands have modules of their own.

Exit status: 0 done; 1 done, but the verdict is ``refused``; 2 bad input or usage, with one line on standard error that
starts with ``fgreg: error:``; 70 a crash, with its traceback; 130 interrupted. A closed pipe changes none of them.

Heavy modules are imported by the command that needs them. The annotations of the command modules are objects, not
strings (no ``from __future__``): Typer would evaluate each string twice, a tenth of ``fgreg --help``.
"""

import errno
import gc
import json
import math
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from fgreg.cli.calibrate_camera import add_calibrate_camera
from fgreg.cli.commission import add_commission
from fgreg.cli.convert import add_convert
from fgreg.cli.devices import add_devices
from fgreg.cli.evaluate import add_commands
from fgreg.cli.exclude import add_exclude, shot_names
from fgreg.cli.html_report import add_report
from fgreg.cli.live import add_live
from fgreg.cli.options import EstimateOption, LimitOption, progress_columns, solve_config, warn, warn_of_leftovers
from fgreg.cli.print import add_print
from fgreg.cli.replay import add_replay
from fgreg.cli.schema import add_schema
from fgreg.cli.setup import add_setup
from fgreg.cli.streams import print_crash, take_streams
from fgreg.cli.verify import add_verify
from fgreg.errors import FgregError, InputError
from fgreg.schema.limits import tell_libraries
from fgreg.version import __version__
from fgreg.workers.memory import keep_freed_memory
from fgreg.workers.threads import one_thread_each

if TYPE_CHECKING:
    from fgreg.pipeline.solve import SolveReport

EXIT_REFUSED, EXIT_BAD_INPUT, EXIT_CRASH, EXIT_INTERRUPTED = 1, 2, 70, 130
OUT_OF_MEMORY = ("failed to map segment", "annot allocate memory")
"""What the loader of libraries says where memory is short."""
COMPLETE = "_FGREG_COMPLETE"
"""By this variable a shell asks for completions."""
GARBAGE_THRESHOLD = 50_000
"""New objects between garbage collections: imports leave no garbage, and the default 700 costs 5 % of a command."""

OUT_OF = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EROFS, errno.EIO}
"""What a machine can run out of or fail at; an error of these is no defect of fgreg's."""

app = typer.Typer(
    name="fgreg",
    add_completion=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Register a stereo endoscope to a rotating transrectal ultrasound probe by photoacoustic markers.\n\n"
    "A session is a folder with session.yaml, events.jsonl and frames/ (sessions/README.md describes it). Try: "
    "fgreg simulate demo --preset phantom && fgreg solve demo --rrd demo.rrd",
)

UsageError: type[Exception] = cast("type[Exception]", typer.BadParameter.__mro__[1])
"""The usage error of typer, which has no public name in all its versions."""

SessionArgument = Annotated[Path, typer.Argument(metavar="SESSION", help="Folder of the session.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, and no summary.")]


def main() -> None:
    """Entry point: known errors become one line and exit status 2."""
    gc.set_threshold(GARBAGE_THRESHOLD)
    keep_freed_memory()
    take_streams()
    tell_libraries()
    sys.exit(_exit_status(sys.argv[1:]))


def _exit_status(arguments: list[str]) -> int:
    interrupted = _watch_interrupts()
    try:
        with one_thread_each():  # parallel work is over frames, solves or devices, not in matrices
            status = _run(arguments)
        sys.stdout.flush()
        return status
    except FgregError as error:
        return _fail(str(error))
    except UsageError as error:
        return _fail(str(getattr(error, "format_message", error.__str__)()) + _usage(error))
    except (KeyboardInterrupt, typer.Abort):
        return EXIT_INTERRUPTED
    except MemoryError as error:
        return _fail(f"not enough memory ({error})" if str(error) else "not enough memory")
    except BaseException as error:  # also what is no Exception: a panic of a library in Rust
        if isinstance(error, OSError) and (error.filename is not None or error.errno in OUT_OF):
            return _fail(f"{error.filename or 'this machine'}: {error.strerror}")
        if isinstance(error, SystemExit):
            raise
        if isinstance(error, ImportError) and any(word in str(error) for word in OUT_OF_MEMORY):
            return _fail(f"not enough memory to load a library ({error})")
        if interrupted:  # a library has made another error of it, as gtsam does while it is loaded
            return EXIT_INTERRUPTED
        print_crash(error)
        return EXIT_CRASH


def _watch_interrupts() -> list[int]:
    """Handle Ctrl-C as Python does, and note it in the list. Another program's handler, or none, is left alone."""
    noted: list[int] = []

    def on_interrupt(number: int, _frame: FrameType | None) -> None:
        noted.append(number)
        raise KeyboardInterrupt

    if signal.getsignal(signal.SIGINT) in (signal.default_int_handler, signal.SIG_DFL):
        signal.signal(signal.SIGINT, on_interrupt)
    return noted


def _run(arguments: list[str]) -> int:
    """Run a command. Not by Typer's own call, which makes status 1 of a broken pipe, be it of a device."""
    try:
        Path.cwd()
    except OSError:
        raise InputError("the working folder", "none: it was removed", "one that exists") from None
    command = typer.main.get_command(app)
    if COMPLETE in os.environ:  # the shell asks what may follow; else heavy to load
        command.main(arguments, "fgreg", COMPLETE)
    try:
        with command.make_context("fgreg", arguments) as context:
            command.invoke(context)
    except typer.Exit as done:
        return done.exit_code
    return 0


def _fail(message: str) -> int:
    line = " ".join(message.split())
    sys.stderr.write(f"fgreg: error: {line}\n")
    return EXIT_BAD_INPUT


def _usage(error: Exception) -> str:
    """How the command that an error of usage is about is called, as its help says; on the error's one line."""
    context: typer.Context | None = getattr(error, "ctx", None)
    if context is None:
        return ""
    usage = " ".join(context.get_usage().split()).removeprefix("Usage: ")
    return f" (usage: {usage}; help: {context.command_path} -h)"


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"fgreg {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _top(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options before the command; without any, the help."""
    del version
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def _no_progress(_step: str, _done: int, _total: int) -> None:
    """Ignore progress."""


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """Progress on standard error: a bar on a terminal, nothing elsewhere."""
    if quiet or not sys.stderr.isatty():
        yield _no_progress
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(*progress_columns(), console=Console(stderr=True), transient=True) as bar:
        tasks: dict[str, Any] = {}

        def report(step: str, done: int, total: int) -> None:
            if step not in tasks:
                tasks[step] = bar.add_task(step, total=total)
            bar.update(tasks[step], completed=done, total=total)

        yield report


@app.command()
def solve(
    session: SessionArgument,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Result file. Default: SESSION/result.yaml.")
    ] = None,
    rrd: Annotated[
        Path | None,
        typer.Option("--rrd", metavar="FILE", help="Also write a Rerun recording; open it with: rerun FILE."),
    ] = None,
    limit_mm: LimitOption = 3.0,
    redetect: Annotated[
        bool, typer.Option("--redetect", help="Detect in the frames even where events have poses.")
    ] = False,
    estimate: EstimateOption = "",
    detect_moves: Annotated[
        bool,
        typer.Option("--detect-moves/--no-detect-moves", help="Find unreported camera moves, by the pairs."),
    ] = True,
    without_pm: Annotated[
        str | None, typer.Option("--without-pm", metavar="N,N", help="Leave out these PMs, in this solve only.")
    ] = None,
    without_aim: Annotated[
        str | None, typer.Option("--without-aim", metavar="N,N", help="Leave out these aims, counted from 0.")
    ] = None,
    without_point: Annotated[
        str | None, typer.Option("--without-point", metavar="N,N", help="Leave out these known points, from 0.")
    ] = None,
    certify: Annotated[
        bool,
        typer.Option("--certify", help="Prove that no other registration explains the pairs (up to some seconds)."),
    ] = False,
    as_json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Calibrate the fibre, register camera to TRUS, answer the session's tracking queries.

    Reads SESSION, detects in its frames, writes result.yaml and prints a summary: verdict first, with the remedy where
    it is not ok. No initial guess is needed. Exit status 1 where the verdict is refused.
    """
    from fgreg.model.estimate import Verdict
    from fgreg.pipeline.solve import SolveRequest, solve_session

    config = solve_config(limit_mm, estimate, certify=certify)
    without = shot_names(without_pm, without_aim, without_point, "--without-")
    warn_of_leftovers(session, out, rrd)
    with _progress(quiet or as_json) as progress:
        report = solve_session(SolveRequest(session, out, rrd, redetect, detect_moves, without), config, progress)
    if as_json or not quiet:
        _show(report, as_json)
    if report.estimate.verdict is Verdict.REFUSED:
        raise typer.Exit(EXIT_REFUSED)


def _show(report: "SolveReport", as_json: bool) -> None:
    """Print the summary of a solve, with the reader's warnings."""
    from fgreg.cli.report import print_summary
    from fgreg.cli.report_document import summary_dict

    extras = _summary_extras(report)
    if as_json:
        typer.echo(json.dumps(summary_dict(report.session.model, report.estimate, extras), indent=2))
    else:
        for warning in report.session.warnings:
            warn(warning)
        print_summary(report.session.model, report.estimate, extras)


def _summary_extras(report: "SolveReport") -> Any:
    """The parts of the summary besides the estimate."""
    from fgreg.cli.report import DetectionFigures, SummaryExtras, TruthFigures
    from fgreg.detection.results import MarkerFit, PaFind
    from fgreg.model.events import PairEvent

    extracted, errors = report.extracted, report.errors
    looks = dict(zip(extracted.pair_events, report.looks, strict=True))
    pair_events = [index for index, event in enumerate(report.session.events) if isinstance(event, PairEvent)]
    detections = None
    if extracted.markers or extracted.finds:
        detections = DetectionFigures(
            markers_found=sum(isinstance(fit, MarkerFit) for fit in extracted.markers.values()),
            markers_total=len(extracted.markers),
            sources_found=sum(isinstance(find, PaFind) for find in extracted.finds.values()),
            sources_total=len(extracted.finds),
        )
    truth = None
    if errors is not None:
        truth = TruthFigures(
            tre_mean_mm=tuple(None if tre is None else float(tre.mean()) for tre in errors.tre_mm),
            tre_worst_mm=tuple(None if tre is None else float(tre.max()) for tre in errors.tre_mm),
            track_error_rad=errors.track_rad,
        )
    return SummaryExtras(
        rrd=report.rrd_path,
        result=report.result_path,
        elapsed_s=report.elapsed_s,
        detections=detections,
        looks=tuple(looks.get(index) for index in pair_events),
        truth=truth,
    )


@app.command()
def check(
    session: SessionArgument,
    frames: Annotated[
        bool, typer.Option("--frames/--headers-only", help="Detect in the frames, or read only their headers.")
    ] = True,
    as_json: JsonOption = False,
) -> None:
    """Check a session's files and report all problems at once.

    Checks session.yaml, events.jsonl, ground_truth.yaml and all frames, and detects in the frames as solve does: each
    shot that a solve would leave out is named with the reason, and so is a result.yaml that was made from other files.
    Exit status 2 where there are problems; warnings alone are 0.
    """
    from fgreg.pipeline.check import check as check_all

    with _progress(as_json) as progress:
        found = check_all(session, frames=frames, progress=progress)
    if as_json:
        problems = [{"where": p.where, "found": p.found, "expected": p.expected} for p in found.problems]
        unused = [{"line": u.line, "type": u.kind, "reason": u.reason} for u in found.unused]
        document = {"session": str(session), "problems": problems, "warnings": [*found.warnings], "unused": unused}
        typer.echo(json.dumps(document, indent=2))
    else:
        for problem in found.problems:
            sys.stderr.write(f"fgreg: error: {' '.join(str(problem).split())}\n")
        warnings = [*found.warnings, *(shot.text for shot in found.unused)]
        for warning in warnings:
            warn(warning)
        if not found.problems:
            typer.echo(f"{session}: no problems" + (f", {len(warnings)} warnings" if warnings else ""))
            if found.markers:
                typer.echo(found.markers)
    if found.problems:
        raise typer.Exit(EXIT_BAD_INPUT)


def _named_values(option: str, texts: list[str] | None) -> list[tuple[str, str]]:
    """NAME=VALUE texts in two."""
    parts = [text.partition("=") for text in texts or []]
    for name, sign, value in parts:
        if not (name and sign and value):
            raise InputError(option, f"{name}{sign}{value}", "NAME=VALUE")
    return [(name, value) for name, _, value in parts]


def _number(option: str, text: str) -> float:
    """A finite number of an option."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(option, text, "a number")
    return value


@app.command()
def simulate(
    out: Annotated[Path | None, typer.Argument(metavar="OUT", help="Folder to write; new or empty.")] = None,
    preset: Annotated[str, typer.Option("--preset", help="What to simulate; --list names them.")] = "phantom",
    seed: Annotated[int, typer.Option("--seed", help="Same seed, same session, byte by byte.")] = 1,
    pairs: Annotated[int | None, typer.Option("--pairs", help="Number of photoacoustic markers.")] = None,
    aims: Annotated[int | None, typer.Option("--aims", help="Number of calibration shots.")] = None,
    sweep: Annotated[
        str | None, typer.Option("--sweep", help="How PMs are found: window, alternating, one-way or two-sided.")
    ] = None,
    off: Annotated[
        list[str] | None,
        typer.Option(
            "--off",
            metavar="NAME=VALUE",
            help="True less declared: a key of systematic (radius_mm=1, tag_size=-0.03, array_tilt_deg[0]=1), or "
            "water_mm, beam_offset_mm, window_deg, slip_deg, camera_move_mm. Repeatable.",
        ),
    ] = None,
    declare: Annotated[
        list[str] | None,
        typer.Option("--declare", metavar="KEY=VALUE", help="What session.yaml has instead: probe.flip=true."),
    ] = None,
    disturb: Annotated[
        list[str] | None,
        typer.Option(
            "--disturb",
            metavar="NAME=VALUE",
            help="What spoils the pictures, each shot drawing its own: smoke=0.3, blood=2, drops=1, specular=1, "
            "hand_mm_s=10, field_hz=50, deinterlace=1, jpeg_quality=60 (docs/simulate.md has all). Repeatable.",
        ),
    ] = None,
    camera: Annotated[bool, typer.Option("--camera", help="Poses, of a session that has camera and board.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing session.")] = False,
    list_presets: Annotated[bool, typer.Option("--list", help="List the presets and end.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Write a simulated session with its ground truth: poses only, or raw stereo and channel data frames.

    The forward model shares no code with the estimator.
    """
    from dataclasses import replace

    from fgreg.output.session_folder import check_folder
    from fgreg.schema.yaml_writer import yaml_text
    from fgreg.session.setup_reader import read_setup
    from fgreg.session.yaml_loader import parse_yaml
    from fgreg.simulation.config import Sweep
    from fgreg.simulation.deviations import with_deviations
    from fgreg.simulation.disturbances import with_values
    from fgreg.simulation.presets import PRESETS
    from fgreg.simulation.simulate import simulate as run
    from fgreg.simulation.write import write_session

    if list_presets:
        for name, config in PRESETS.items():
            kind = "raw frames" if config.frames else "poses"
            typer.echo(f"{name:12s} {config.aims} aims, {config.pairs} PMs, sweeps {config.sweep.value}, {kind}")
        return
    if out is None:
        raise InputError("OUT", "nothing", "the folder to write")
    if preset not in PRESETS:
        raise InputError("--preset", preset, "one of " + ", ".join(PRESETS))
    config = PRESETS[preset]
    for key, value in (("pairs", pairs), ("aims", aims)):
        if value is not None:
            if value < 0:
                raise InputError(f"--{key}", str(value), "a number >= 0")
            config = replace(config, **{key: value})  # type: ignore[arg-type]
    if seed < 0:
        raise InputError("--seed", str(seed), "a number >= 0")
    if sweep is not None:
        if sweep not in list(Sweep):
            raise InputError("--sweep", sweep, "one of " + ", ".join(Sweep))
        config = replace(config, sweep=Sweep(sweep))
    values = {name: _number("--off", value) for name, value in _named_values("--off", off)}
    try:
        config = with_deviations(config, values)
    except ValueError as error:
        raise InputError("--off", str(error), "a name among these") from error
    declared = {
        key: parse_yaml(f"value: {value}", f"--declare {key}")["value"]
        for key, value in _named_values("--declare", declare)
    }
    config = replace(config, declared=declared, camera_declared=camera)
    if spoils := {name: _number("--disturb", value) for name, value in _named_values("--disturb", disturb)}:
        if not config.frames:
            raise InputError("--disturb", f"preset {preset}, which has no pictures", "a preset with raw frames")
        try:
            disturbances = with_values(config.disturbances, {"drawn": 1.0, **spoils})
        except ValueError as error:
            raise InputError("--disturb", str(error), "a name and a value among these") from error
        config = replace(config, disturbances=disturbances)
    warn_of_leftovers(out)
    check_folder(out, overwrite=overwrite)
    with _progress(quiet) as progress:
        try:
            simulated = run(config, seed)
        except ValueError as error:
            raise InputError("the simulation", str(error), "a session that can be realised") from error
        if declared:
            problems: list[InputError] = []
            read_setup(parse_yaml(yaml_text(simulated.session), "session.yaml"), "session.yaml", out.name, problems)
            if problems:
                raise InputError("--declare", f"a session.yaml with a fault: {problems[0]}", "one that can be read")
        write_session(simulated, out, overwrite, lambda done, total: progress("rendering", done, total))
    if not quiet:
        typer.echo(f"{out}: {config.aims} aims, {config.pairs} PMs, {len(simulated.frames)} frames, seed {seed}")
        if config.frames:
            name = shlex.quote(str(out))
            typer.echo("What to expect of it:")
            typer.echo(f"  fgreg check {name}     how many shots can be used, and why others cannot")
            typer.echo(f"  fgreg solve {name}     the verdict")
            typer.echo(f"  fgreg evaluate {name}  the true error")


add_commands(app, _progress)
add_calibrate_camera(app, _progress)
add_commission(app, _progress)
add_exclude(app)
add_live(app, _summary_extras, _progress)
add_replay(app, _summary_extras)
add_verify(app, _progress)
add_convert(app, _progress)
add_devices(app)
add_print(app)
add_report(app, _progress)
add_schema(app)
add_setup(app, _progress)


if __name__ == "__main__":
    main()
