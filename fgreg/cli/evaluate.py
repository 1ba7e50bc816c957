"""The commands ``fgreg evaluate`` and ``fgreg advise``."""

import json
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fgreg.cli.options import ExecutorOption, JobsOption, processes, refuse_stale, warn, warn_of_leftovers
from fgreg.errors import InputError

if TYPE_CHECKING:
    from fgreg.evaluation.case import Case
    from fgreg.registration.verdict import Condition

Progress = Callable[[str, int, int], None]
ProgressBar = Callable[[bool], AbstractContextManager[Progress]]
EXIT_REFUSED = 1


def add_commands(app: typer.Typer, progress_bar: ProgressBar) -> None:
    """Register the commands of this module; ``progress_bar(quiet)`` shows progress on standard error."""

    @app.command()
    def evaluate(
        sessions: Annotated[list[Path], typer.Argument(metavar="SESSION", help="Folders of sessions.")],
        folds: Annotated[int, typer.Option("--folds", help="Folds of the cross-validation; 0: none.")] = 5,
        one_by_one: Annotated[
            bool, typer.Option("--leave-one-out/--no-leave-one-out", help="Also leave out each PM alone.")
        ] = True,
        subsets: Annotated[
            int, typer.Option("--subsets", help="Most subsets of each number of pairs; 0: no such curve.")
        ] = 20,
        sizes: Annotated[
            str | None, typer.Option("--sizes", metavar="N,N,...", help="Numbers of pairs, such as 4,6,10.")
        ] = None,
        seed: Annotated[int, typer.Option("--seed", help="Of folds and subsets; same seed, same figures.")] = 1,
        jobs: JobsOption = None,
        executor: ExecutorOption = "local",
        csv: Annotated[
            Path | None, typer.Option("--csv", metavar="FILE", help="Also write all figures, one a line.")
        ] = None,
        plots: Annotated[
            Path | None, typer.Option("--plots", metavar="DIR", help="Also write plots into this folder.")
        ] = None,
        force: Annotated[
            bool, typer.Option("--force", help="Evaluate also where a session's result.yaml is of other events.")
        ] = False,
        plot_format: Annotated[str, typer.Option("--plot-format", help="png or svg.")] = "png",
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress, and no tables.")] = False,
    ) -> None:
        """Evaluate sessions: errors against the truth, cross-validation, number of pairs, influence of each.

        Solves each SESSION repeatedly from subsets of its pairs. With a ground_truth.yaml: TRE, tracking and beam
        errors. Without: how well the pairs predict each other; the pair residual (the publication's Eq. 12) is not a
        TRE. A session whose result.yaml was made from other files is refused: solve it again. Exit status 1 where a
        verdict is refused.
        """
        from fgreg.cli.executors import open_executor
        from fgreg.evaluation.case import EvaluationConfig
        from fgreg.evaluation.export import CSV_FILE, as_csv, as_dict
        from fgreg.evaluation.plots import FORMATS, check_plots, plot_files, save_plots
        from fgreg.evaluation.run import evaluate as run
        from fgreg.evaluation.tables import print_evaluation
        from fgreg.model.estimate import Verdict
        from fgreg.output.atomic_file import check_outputs, write_file

        for option, value, least in (("--folds", folds, 0), ("--subsets", subsets, 0), ("--seed", seed, 0)):
            if value < least:
                raise InputError(option, str(value), f"a number >= {least}")
        workers = processes(jobs)
        if folds == 1:
            raise InputError("--folds", "1", "0 or at least 2")
        if plot_format not in FORMATS:
            raise InputError("--plot-format", plot_format, "one of " + ", ".join(FORMATS))
        if plots is not None:
            check_plots(plots, plot_format)
        pictures = [] if plots is None else plot_files(plots, plot_format)
        outputs = [("--plots", path, FORMATS[plot_format]) for path in pictures if path.parent.is_dir()]
        check_outputs([("--csv", csv, CSV_FILE), *outputs])
        warn_of_leftovers(*sessions, csv, plots)
        for folder in () if force else sessions:
            refuse_stale(folder)
        config = EvaluationConfig(
            folds=folds,
            leave_one_out=one_by_one,
            curve=subsets > 0,
            sizes=_sizes(sizes),
            subsets=max(subsets, 1),
            seed=seed,
        )
        with progress_bar(quiet or as_json) as progress:
            read = [read_case(folder, progress) for folder in sessions]
            cases, conditions = named_apart([case for case, _ in read], sessions), [found for _, found in read]
            with open_executor(executor) as where:
                found = run(cases, config, jobs=workers, executor=where, progress=progress, conditions=conditions)
        if csv is not None:
            write_file(csv, as_csv(found), CSV_FILE)
        written = save_plots(found, plots, plot_format, config.solve.limit_mm) if plots is not None else []
        if as_json:
            typer.echo(json.dumps(as_dict(found), indent=2))
        elif not quiet:
            print_evaluation(found)
            for path in [*([csv] if csv is not None else []), *written]:
                typer.echo(f"written: {path}")
        if any(item.whole.verdict is Verdict.REFUSED for item in found):
            raise typer.Exit(EXIT_REFUSED)

    @app.command()
    def advise(
        session: Annotated[Path, typer.Argument(metavar="SESSION", help="Folder of the session.")],
        count: Annotated[int, typer.Option("--count", "-n", help="How many shots to list.")] = 5,
        one_look: Annotated[
            bool, typer.Option("--one-look", help="One look at each spot, from the side used less, instead of two.")
        ] = False,
        as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")] = False,
        quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
    ) -> None:
        """Where the next shot helps most: spots and beam directions, ranked by the predicted TRE after them.

        A shot is two looks at one spot (one pm): sweep up to the first detection, and down to the first one from the
        other side. Uses all shots up to now; at least 4 pairs. The advice is for the last camera epoch. Exit status 1
        where there is no registration.
        """
        from fgreg.errors import EstimationError
        from fgreg.evaluation.advised import advice_dict, print_advice
        from fgreg.model.solve_config import SolveConfig
        from fgreg.registration.next_shot import advise as run
        from fgreg.registration.solve import solve

        if count < 1:
            raise InputError("--count", str(count), "a number >= 1")
        with progress_bar(quiet or as_json) as progress:
            case, conditions = read_case(session, progress)
            try:
                found = solve(case.measurements, (), case.model, SolveConfig(), conditions)
                if found.registration is None:
                    raise EstimationError(found.reasons[0])
                means = {e.index: e.predicted_tre.mean_mm for e in found.epochs if e.predicted_tre is not None}
                advice = run(found.registration, predicted_mm=means, count=count, both_sides=not one_look)
            except EstimationError as error:
                if as_json:
                    typer.echo(json.dumps({"session": case.name, "shots": [], "notes": [str(error)]}, indent=2))
                else:
                    sys.stderr.write(f"fgreg: no advice: {error}\n")
                raise typer.Exit(EXIT_REFUSED) from error
        if as_json:
            typer.echo(json.dumps(advice_dict(case.name, advice), indent=2))
        else:
            print_advice(case.name, advice)


def _sizes(text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    try:
        sizes = tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise InputError("--sizes", text, "numbers of pairs, such as 4,6,10") from error
    if min(sizes) < 3:
        raise InputError("--sizes", text, "numbers of pairs of at least 3")
    return sizes


def named_apart(cases: "list[Case]", folders: list[Path]) -> "list[Case]":
    """Rename sessions that share a name to their folders."""
    names = [case.name for case in cases]
    return [
        replace(case, name=str(folder)) if names.count(case.name) > 1 else case
        for case, folder in zip(cases, folders, strict=True)
    ]


def read_case(folder: Path, progress: Progress) -> "tuple[Case, list[Condition]]":
    """A session as a case, with detection in its frames done once, and the conditions from the detection."""
    from fgreg.camera_moves.recorded_tags import with_tag_moves
    from fgreg.detection.events_to_measurements import extract_measurements
    from fgreg.evaluation.case import Case, Truth
    from fgreg.pipeline.solve import detection_conditions
    from fgreg.session.session_reader import read_ground_truth, read_session

    session = with_tag_moves(read_session(folder))
    known = read_ground_truth(folder)
    for warning in session.warnings:
        warn(warning)
    step = f"looking at frames of {session.model.name}"
    extracted = extract_measurements(
        session.events, session.model, progress=lambda done, total: progress(step, done, total)
    )
    truth = None
    if known is not None:
        stage = {round(track.t, 6): track.stage_rad for track in known.tracks}
        answers = tuple(stage.get(round(track.t, 6)) for track in extracted.tracks)
        truth = Truth(known.trus_T_camera, known.marker_T_laser, answers)
    case = Case(session.model.name, session.model, extracted.measurements, extracted.tracks, truth)
    return case, detection_conditions(extracted)
