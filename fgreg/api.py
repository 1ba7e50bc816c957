"""The public names of fgreg; ``import fgreg`` hands them on. What is not here may change without notice."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fgreg.errors import EventRefused as EventRefused
from fgreg.errors import FgregError as FgregError
from fgreg.errors import InputError as InputError
from fgreg.errors import JournalError as JournalError
from fgreg.model.estimate import EpochEstimate as EpochEstimate
from fgreg.model.estimate import SessionEstimate as SessionEstimate
from fgreg.model.estimate import TrackEstimate as TrackEstimate
from fgreg.model.estimate import Verdict as Verdict
from fgreg.model.events import AimEvent as AimEvent
from fgreg.model.events import CameraMovedEvent as CameraMovedEvent
from fgreg.model.events import CheckEvent as CheckEvent
from fgreg.model.events import ExcludeEvent as ExcludeEvent
from fgreg.model.events import IncludeEvent as IncludeEvent
from fgreg.model.events import MarkerRecord as MarkerRecord
from fgreg.model.events import PairEvent as PairEvent
from fgreg.model.events import PointEvent as PointEvent
from fgreg.model.events import SpotRecord as SpotRecord
from fgreg.model.events import TrackEvent as TrackEvent
from fgreg.model.events import TrusRecord as TrusRecord
from fgreg.model.known_points import data_at
from fgreg.model.measurement_checks import problems_of_all
from fgreg.model.measurements import Aim as Aim
from fgreg.model.measurements import Check as Check
from fgreg.model.measurements import EpochStart as EpochStart
from fgreg.model.measurements import KnownPoint as KnownPoint
from fgreg.model.measurements import Look as Look
from fgreg.model.measurements import MarkerObservation as MarkerObservation
from fgreg.model.measurements import Measurements as Measurements
from fgreg.model.measurements import Pair as Pair
from fgreg.model.measurements import Track as Track
from fgreg.model.measurements import VisibleSpot as VisibleSpot
from fgreg.model.session_model import SessionModel as SessionModel
from fgreg.model.solve_config import SolveConfig as SolveConfig
from fgreg.online.engine import OnlineRegistration as OnlineRegistration
from fgreg.online.estimate import OnlineEstimate as OnlineEstimate
from fgreg.online.events import CameraMoved as CameraMoved
from fgreg.online.events import StaticTags as StaticTags
from fgreg.online.live_session import LiveSession as LiveSession
from fgreg.pipeline.exclude import ShotNames
from fgreg.pipeline.replay import ReplayRequest, replay_session
from fgreg.pipeline.solve import SolveReport as SolveReport
from fgreg.pipeline.solve import SolveRequest, solve_session
from fgreg.pipeline.verify import VerifyReport as VerifyReport
from fgreg.pipeline.verify import verify_session
from fgreg.registration.checks import not_compared, with_checks
from fgreg.registration.rig_at_checks import rig_at_checks
from fgreg.registration.solve import solve as solve_batch
from fgreg.session.session_reader import Session as Session
from fgreg.session.session_reader import read_session as read_session
from fgreg.viewer.picker import picked_pm as picked_pm


def solve(
    session: str | Path,
    config: SolveConfig | None = None,
    *,
    out: str | Path | None = None,
    rrd: str | Path | None = None,
    redetect: bool = False,
    detect_moves: bool = True,
    without_pms: Sequence[int] = (),
    without_aims: Sequence[int] = (),
    without_points: Sequence[int] = (),
) -> SolveReport:
    """Solve a recorded session as a whole, as ``fgreg solve`` does.

    Args:
        session: its folder.
        config: limit of the verdict, and settings of the estimate.
        out: where the result is written; ``result.yaml`` in the session's folder where None.
        rrd: where a Rerun recording is written; none where None.
        redetect: look at the frames even where events bring poses.
        detect_moves: look for unreported camera moves.
        without_pms, without_aims, without_points: left out by hand; aims and known points by their place among the
            session's, from 0.

    Raises:
        InputError: bad input; no result is left behind, not even an older one.
    """
    without = ShotNames(tuple(without_pms), tuple(without_aims), tuple(without_points))
    return solve_session(SolveRequest(Path(session), _path(out), _path(rrd), redetect, detect_moves, without), config)


def replay(
    session: str | Path,
    config: SolveConfig | None = None,
    *,
    out: str | Path | None = None,
    rrd: str | Path | None = None,
    redetect: bool = False,
) -> SolveReport:
    """Give a recorded session to the online registration event by event, as ``fgreg replay`` does.

    Tracking queries are answered from what was known at their time. Unreported camera moves are looked for.

    Args:
        session, config, out, rrd, redetect: as of :func:`solve`.

    Raises:
        InputError: bad input; no result is left behind, not even an older one.
    """
    request = ReplayRequest(Path(session), _path(out), _path(rrd), redetect=redetect)
    return replay_session(request, config).solved


def verify(session: str | Path, new: str | Path, config: SolveConfig | None = None) -> VerifyReport:
    """Whether a session's finished registration is still valid, by new shots, as ``fgreg verify`` does.

    Args:
        session: its folder, with ``result.yaml``.
        new: a session's folder, or a file of JSON lines with ``pair`` events; nothing is added to the registration.
        config: as it was solved with.

    Raises:
        InputError: bad input, or no registration that may be used.
    """
    return verify_session(Path(session), Path(new), config)


def solve_measurements(
    measurements: Measurements,
    model: SessionModel,
    config: SolveConfig | None = None,
    *,
    tracks: Sequence[Track] = (),
    checks: Sequence[Check] = (),
) -> SessionEstimate:
    """Solve measurements of your own, without files.

    Args:
        measurements: aims, pairs, known points and camera epochs. Without a registration the verdict is ``refused``,
            and says why.
        model: how the session was set up.
        config: limit of the verdict, and settings of the estimate.
        tracks: queries, answered from all measurements; they never enter the estimate.
        checks: points known to both devices; nor do they. One that is a point of ``measurements`` is not compared.

    Raises:
        InputError: a number that is no measurement: not finite, no covariance, beyond reason.
    """
    for where, problem in problems_of_all(measurements, checks):
        raise InputError(where, problem, "numbers that are a measurement")
    config = config or SolveConfig()
    solution = solve_batch(measurements, tracks, model, config)
    data = [data_at(check, measurements.points) for check in checks]
    compared = [c if why is None else not_compared(c.t, why) for c, why in zip(checks, data, strict=True)]
    rigs = rig_at_checks(model, solution.snapshot, checks)
    return with_checks(solution.as_session(model.name), compared, config.limit_mm, model.targets_mm, rigs)


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)
