"""The command ``fgreg setup``."""

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fgreg.cli.options import warn, warn_of_leftovers
from fgreg.errors import InputError

if TYPE_CHECKING:
    from fgreg.model.estimate import SystematicEstimate
    from fgreg.pipeline.setup import Compared, SessionFindings, SetupConfig

Progress = Callable[[str, int, int], None]
ProgressBar = Callable[[bool], AbstractContextManager[Progress]]
EXIT_CONTRADICTED = 1
SHOWN_SCORE = 2.0
"""Score from which a constant of a session is listed."""

NOT_SHOWN = """no session shows stage.zero_deg, direction and flip where both are wrong, flip where looks have x_mm, or
  a constant that it sees less well than declared: for these, record targets that stand still"""

RECORDINGS = """Take these recordings, each a file of JSON lines (t: arrival at the host, s, one clock):
1. Still targets: two or three beads or knots in water (no wires along the axis: these have no x),
   or the fibre's tip held still at two or three places, 20 to 60 deg apart. At each, turn the
   stage in steps of 1 deg past it, always from the same side; a few pulses at each stop. Measure
   the depth of one from the element faces, and the distance between two: these show range offset
   and radius.
     {"type": "medium", "t": 0, "sound_speed_m_s": 1482}
     {"type": "target", "t": 0, "target": 0, "depth_mm": 25.1}
     {"type": "target", "t": 0, "target": 1, "from": 0, "apart_mm": 41.2, "towards": ["+y", "+x"]}
     {"type": "pulse", "t": 0.1, "target": 0, "scan_deg": -26, "x_mm": -4.1, "range_mm": 25.6, "amplitude": 31}
   towards: to which side of the other target it lies. Choose +x along the axis; seen along +x
   with the image plane of stage angle 0 upwards, +y is to the left.
2. A sweep: the fibre held still, the stage turned past its PM at constant speed, from silence to
   silence, to and fro, at two speeds. A pulse without x_mm and range_mm heard nothing.
     {"type": "stage", "t": 0.04, "scan_deg": -11.9}
     {"type": "pulse", "t": 0.1, "x_mm": 2.0, "range_mm": 25.3, "amplitude": 24}
   One past a near and one past a deep PM give the window's table.
3. A movement: the stage stands at the PM, the fibre is moved to and fro along the probe by 2 cm or
   more for 20 s, turned as little as can be.
     {"type": "marker", "t": 0.03, "camera_T_marker": [[...], [...], [...], [0, 0, 0, 1]]}
     {"type": "pulse", "t": 0.1, "x_mm": 2.0, "range_mm": 25.3}
Then: fgreg setup CONFIG.yaml points.jsonl sweep.jsonl moved.jsonl --out session.yaml"""

_HELP = """Find signs and constants of probe and stage from a few recordings, or what a session contradicts.

\b
Say what to record:
  fgreg setup session.yaml
From recordings, told apart by what they contain; all of one kind count together:
  fgreg setup session.yaml points.jsonl sweep-near.jsonl sweep-deep.jsonl moved.jsonl
  ... --out new/session.yaml     session.yaml with what was found, every line commented
Of an ordinary session: which declared constants and signs it contradicts.
  fgreg setup my-session/
\b
CONFIG is a session.yaml, or a CONFIG.yaml of fgreg live: then latencies and hearing
threshold are compared as well.
\b
What each recording shows:
  targets that stand still      probe.radius_mm, range offset, stage.direction, probe.flip
  sweeps past a PM              half width of the window and both edges, latency of the
                                stage against the pulses, backlash, hearing threshold
  a fibre that is moved         latency of the camera against the pulses
Of each value: 1 sigma, how it was found, and what is declared. agrees: within 3 sigmas of
both; not seen: these recordings say nothing of it, and how to show it.
\b
A session is solved, and its result is not written. A constant that it contradicts has a
score beyond 3.5; signs are found by the mirrored hypothesis. That it contradicts nothing
does not make it right: zero, both signs wrong together, and what few pairs show badly pass.
\b
Exit status 0 done, 1 a session contradicts what is declared, 2 bad input.
"""


def add_setup(app: typer.Typer, progress_bar: ProgressBar) -> None:
    """Register the command; ``progress_bar(quiet)`` shows progress on standard error."""

    @app.command(name="setup", help=_HELP)
    def setup_(
        paths: Annotated[
            list[Path],
            typer.Argument(
                metavar="[CONFIG.yaml] RECORDING...",
                help="What is declared (session.yaml or CONFIG.yaml); recordings (.jsonl) or folders of sessions.",
            ),
        ],
        out: Annotated[
            Path | None,
            typer.Option("--out", metavar="FILE", help="session.yaml to write: what is declared, with what was found."),
        ] = None,
        force: Annotated[bool, typer.Option("--force", help="Replace the session.yaml of --out.")] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, and no text.")] = False,
    ) -> None:
        from fgreg.pipeline.setup import contradictions, find_constants, is_session
        from fgreg.pipeline.setup_file import check_setup_output, write_setup

        config, recordings = _config(paths)
        sessions = [path for path in recordings if is_session(path)]
        files = [path for path in recordings if not is_session(path)]
        if out is not None and not files:
            raise InputError("--out", "no recording", "recordings to write a session.yaml from")
        if files and config is None:
            raise InputError(str(files[0]), "a recording without a set-up", "a session.yaml or CONFIG.yaml before it")
        if out is not None:
            warn_of_leftovers(out)
            check_setup_output(out, force=force)
        found = find_constants(files, config) if config is not None and files else []
        told = []
        with progress_bar(quiet or as_json) as progress:
            for number, folder in enumerate(sessions):
                told.append(contradictions(folder))
                progress("solving sessions", number + 1, len(sessions))
        if out is not None and config is not None:
            write_setup(out, config, found)
        if as_json:
            typer.echo(json.dumps(_document(config, found, told, out), indent=2))
        elif not quiet:
            _print(config, found, told, out)
        if any(one.contradicts for one in told):
            raise typer.Exit(EXIT_CONTRADICTED)


def _config(paths: Sequence[Path]) -> tuple["SetupConfig | None", list[Path]]:
    """What is declared, and the recordings."""
    named = [path for path in paths if path.suffix.lower() in (".yaml", ".yml")]
    if len(named) > 1:
        raise InputError(str(named[1]), "a second set-up", "one session.yaml or CONFIG.yaml")
    recordings = [path for path in paths if path not in named]
    twice = next((path for i, path in enumerate(recordings) if path in recordings[:i]), None)
    if twice is not None:
        raise InputError(str(twice), "a recording given twice", "each one once")
    return (_read_config(named[0]) if named else None), recordings


def _read_config(path: Path) -> "SetupConfig":
    from fgreg.pipeline.setup import SetupConfig
    from fgreg.session.session_reader import SETUP_FILE
    from fgreg.session.setup_reader import read_setup
    from fgreg.session.yaml_loader import load_yaml, parse_yaml

    data = load_yaml(path, str(path))
    if str(data.get("format", "")).startswith("fgreg-live"):
        from fgreg.live.config import read_config

        live = read_config(path)
        for warning in live.warnings:
            warn(warning)
        own = _own(parse_yaml(live.setup, SETUP_FILE))
        return SetupConfig(path.name, live.model, live.settings.hearing_threshold, live.latencies, own)
    problems: list[InputError] = []
    setup = read_setup(data, str(path), path.resolve().parent.name or SETUP_FILE, problems, path.resolve().parent)
    if problems:
        raise problems[0]
    assert setup.model is not None
    for warning in setup.warnings:
        warn(warning)
    return SetupConfig(path.name, setup.model, own=_own(data))


def _own(data: Mapping[str, Any]) -> dict[str, Any]:
    """The user's own keys of a session.yaml."""
    return {key: value for key, value in data.items() if key.startswith("x_")}


def _print(
    config: "SetupConfig | None", found: Sequence["Compared"], told: Sequence["SessionFindings"], out: Path | None
) -> None:
    if not found and not told:
        typer.echo(RECORDINGS)
        return
    if config is not None and found:
        _print_constants(config.label, found)
    for one in told:
        _print_session(one)
    if out is not None:
        typer.echo(f"\n{out}: written; next: fgreg check, then a session, and fgreg setup SESSION")


def _print_constants(label: str, found: Sequence["Compared"]) -> None:
    from fgreg.pipeline.setup_file import declared_text, figure

    rows = [(name_of(one), figure(one), declared_text(one), one.verdict) for one in found]
    heads = ("", "found (+- 1 sigma)", f"{label} (+- 1 sigma)", "")
    wide = [max(len(row[i]) for row in (heads, *rows)) for i in range(3)]
    for row in (heads, *rows):
        typer.echo("  ".join(cell.ljust(width) for cell, width in zip(row, (*wide, 0), strict=True)).rstrip())
    typer.echo("\nHow")
    for how in dict.fromkeys(one.found.how for one in found):
        names = ", ".join(dict.fromkeys(name_of(one) for one in found if one.found.how == how))
        typer.echo(f"  {names}: {how}")


def name_of(one: "Compared") -> str:
    """A constant's name, with the depth that it is for."""
    depth = one.found.depth_mm
    return one.found.name if depth is None else f"{one.found.name} at {depth:.0f} mm"


def _print_session(one: "SessionFindings") -> None:
    typer.echo(f"{one.folder}: {one.says} (verdict {one.verdict.value})")
    for text in one.contradicts:
        typer.echo(f"  - {text}")
    if not one.contradicts:
        typer.echo(f"  {NOT_SHOWN}")
    doubtful = sorted((c for c in one.constants if abs(c.score) >= SHOWN_SCORE), key=lambda c: -abs(c.score))
    if doubtful:
        typer.echo("  score beyond 2: " + ", ".join(f"{c.name} {c.score:+.1f} ({_value(c)})" for c in doubtful))
    for reason in one.reasons:
        typer.echo(f"  besides: {reason}")


def _value(constant: "SystematicEstimate") -> str:
    return f"{constant.value:+.2g} +- {constant.sigma:.2g}, 1 sigma"


def _document(
    config: "SetupConfig | None", found: Sequence["Compared"], told: Sequence["SessionFindings"], out: Path | None
) -> dict[str, Any]:
    """All as plain data."""
    return {
        "config": None if config is None else config.label,
        "constants": [
            {
                "name": one.found.name,
                "depth_mm": one.found.depth_mm,
                "value": one.found.value,
                "sigma": one.found.sigma,
                "unit": one.found.unit,
                "z": one.found.z,
                "how": one.found.how,
                "declared": one.declared,
                "declared_sigma": one.declared_sigma,
                "verdict": one.verdict,
            }
            for one in found
        ],
        "sessions": [
            {
                "session": str(one.folder),
                "verdict": one.verdict.value,
                "says": one.says,
                "contradicts": list(one.contradicts),
                "other_reasons": list(one.reasons),
                "constants": [
                    {
                        "name": c.name,
                        "value": c.value,
                        "sigma": c.sigma,
                        "prior_sigma": c.prior_sigma,
                        "observed": c.observed,
                        "score": c.score,
                    }
                    for c in one.constants
                ],
            }
            for one in told
        ],
        "out": None if out is None else str(out),
    }
