"""Start and end of a live session: folder, engine, devices, stage, loop."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from fgreg.drivers.base import host_now
from fgreg.errors import FgregError, InputError
from fgreg.geometry.transforms import FloatArray
from fgreg.live.loop import LiveLoop
from fgreg.live.overlay_feed import OverlayFeed
from fgreg.live.recorder import OnTaken, Recorded, Recorder
from fgreg.live.scope_holder import HolderSettings
from fgreg.live.status import Devices
from fgreg.live.workflow import Workflow, WorkflowSettings
from fgreg.model.session_model import SessionModel
from fgreg.model.solve_config import SolveConfig
from fgreg.model.time_sync import Latencies
from fgreg.online.engine_process import After, Call, EngineGone, EngineProcess, start_process
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.live_session import Engine, LiveSession
from fgreg.online.shared_snapshot import NoSnapshotError, Received, SnapshotReader
from fgreg.output.session_folder import STAGE_LOG, new_session
from fgreg.session.rig_file import copy_rig
from fgreg.session.session_reader import EVENTS_FILE, SETUP_FILE
from fgreg.session.yaml_loader import parse_yaml
from fgreg.stage.client import StageLink, StageRecord
from fgreg.stage.limits import MotionLimits
from fgreg.stage.reconnect import ReconnectingStage
from fgreg.stage.stop_on_exit import emergency_stop_all
from fgreg.workers.progress import Progress
from fgreg.workers.threads import undisturbed
from fgreg.workers.worker_process import WorkerProcess

MOST_WORK_S = 10.0
"""A registration without a new snapshot for longer is lost, also where its process still works: camera moves would go
undetected."""

PING_ANSWER_S = 0.5
"""A spare process that takes longer to answer is not used."""

OpenDevices = Callable[[ExitStack, SessionModel], Devices]
"""Opens all devices except the stage; they are closed with the stack."""


WriteTruth = Callable[[Path, float, float], None]
"""Writes a session's ground truth, from its folder, the host time of session time 0, and the session time after which
its events are this run's."""


@dataclass(frozen=True, slots=True, eq=False)
class StageSetup:
    """The stage's driver (``package.module:factory``), its options, and limits beyond the session's."""

    driver: str
    options: Mapping[str, Any]
    limits: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class LiveSetup:
    """Set-up of a live session.

    Attributes:
        setup: the text of its ``session.yaml``.
        open_devices: opens all devices except the stage.
        stage: None if there is no stage.
        settings: of the workflow.
        holder: accuracy of the endoscope's holder, if there is one.
        latencies: of the devices.
        write_truth: called after the last event is recorded, if the ground truth is known.
        rig_file: the commissioned rig that ``setup`` names.
    """

    setup: str
    open_devices: OpenDevices
    stage: StageSetup | None
    settings: WorkflowSettings
    holder: HolderSettings = field(default_factory=HolderSettings)
    latencies: Latencies = field(default_factory=Latencies)
    write_truth: WriteTruth | None = None
    rig_file: Path | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Running:
    """A running session."""

    folder: Path
    model: SessionModel
    loop: LiveLoop
    recorder: Recorder
    session: LiveSession


class EngineProcesses:
    """Starts engine processes, one at a time: starting one ends the one before.

    From any thread; after :meth:`close` no process is started for the next engine any more.
    """

    def __init__(self) -> None:
        self._engine: EngineProcess | None = None
        self._spare: tuple[SessionModel, SolveConfig, WorkerProcess[Call, After]] | None = None
        self._turn = threading.Lock()  # for _spare and _closed
        self._closed = False

    def __call__(self, model: SessionModel, config: SolveConfig) -> EngineProcess:
        if self._engine is not None:
            self._engine.close()
            self._engine = None
        spare = self._take_spare(model, config)
        if spare is not None:
            with suppress(EngineGone):  # it has ended just now
                self._engine = EngineProcess(model, config, spare)
        if self._engine is None:
            self._engine = EngineProcess(model, config)
        return self._engine

    def keep_spare(self, model: SessionModel, config: SolveConfig) -> None:
        """Have a process ready for the next engine: its start, mostly imports, takes a second or two. Call it often."""
        with self._turn:
            if self._closed:
                return
            if self._spare is not None:
                process = self._spare[2]
                process.check()
                if process.alive and not process.trouble:
                    return
                process.kill()
            self._spare = model, config, start_process(model, config)

    def _take_spare(self, model: SessionModel, config: SolveConfig) -> WorkerProcess[Call, After] | None:
        """The spare process, if it is healthy and has this model and configuration."""
        with self._turn:
            spare, self._spare = self._spare, None
        if spare is None:
            return None
        of_model, of_config, process = spare
        fits = of_model is model and of_config == config
        if fits and process.alive and (not process.ready or process.answers(PING_ANSWER_S)):
            return process
        process.kill()
        return None

    def close(self) -> None:
        """End the processes."""
        with self._turn:
            self._closed = True
            spare, self._spare = self._spare, None
        try:
            if spare is not None:
                spare[2].kill()
        finally:
            if self._engine is not None:
                self._engine.close()


class NewestSnapshots:
    """Snapshots of a session's current engine process; for one thread.

    While a new process takes in the recorded events, the last snapshot of the process before stays valid.
    """

    def __init__(self, session: LiveSession) -> None:
        self._session = session
        self._engine: Engine | None = None
        self._reader: SnapshotReader | None = None
        self._progress: Progress | None = None

    def read(self) -> Received:
        """As :meth:`fgreg.online.shared_snapshot.SnapshotReader.read`; also ``closed`` if the process was killed.

        ``silent_s`` is 0 while the process works: one that takes seconds for a solve is slow and not dead.
        """
        engine = self._session.engine
        if engine is not self._engine and isinstance(engine, EngineProcess):
            with suppress(FileNotFoundError):  # the new process has ended as well
                self._reader = engine.reader()
                self._progress = Progress(engine.pid or 0)
            self._engine = engine
        if self._reader is None:
            raise NoSnapshotError("the registration's process has ended")
        received = self._reader.read()
        if self._progress is not None and received.silent_s < MOST_WORK_S:
            received = replace(received, silent_s=min(received.silent_s, self._progress.idle_s()))
        alive = isinstance(self._engine, EngineProcess) and self._engine.alive
        return received if alive else replace(received, closed=True)


def make_folder(folder: Path, setup: str, rig_file: Path | None = None) -> None:
    """Make a new session's folder with its ``session.yaml``; an existing session is resumed if its file is the same.

    ``rig_file``: the commissioned rig that the file names, which is copied.

    Raises:
        InputError: the folder holds something else, or cannot be made.
    """
    path = folder / SETUP_FILE
    try:
        if path.is_file():
            if path.read_text(encoding="utf-8") != setup:
                raise InputError(str(path), "another set-up", f"the same as now, or a new folder for {EVENTS_FILE}")
            return
    except OSError as error:
        raise InputError(str(folder), f"a place that refuses files ({error.strerror})", "a writable one") from None
    with new_session(folder) as part:
        if rig_file is not None:
            copy_rig(rig_file, part / str(parse_yaml(setup, SETUP_FILE)["rig"]))
        (part / SETUP_FILE).write_text(setup, encoding="utf-8")


def setup_text(document: Mapping[str, Any]) -> str:
    """The mapping as text of a ``session.yaml``."""
    return str(yaml.safe_dump(dict(document), sort_keys=False, width=200, default_flow_style=None))


@contextmanager
def running(
    live: LiveSetup,
    folder: Path,
    config: SolveConfig | None = None,
    on_taken: OnTaken | None = None,
    say: Callable[[str], None] = lambda _text: None,
) -> Iterator[Running]:
    """Start a session; leaving the block ends everything, the stage first.

    Args:
        live: set-up of the session.
        folder: of the session; made if it does not exist.
        config: of the estimate.
        on_taken: called on the recorder's thread after each event that was taken in.
        say: gets a line for each part that is started.

    Raises:
        InputError: bad input.
        FgregError: a part did not start.
    """
    make_folder(folder, live.setup, live.rig_file)
    with ExitStack() as stack:
        say("starting the registration")
        make_engine = EngineProcesses()
        stack.callback(make_engine.close)  # runs after the recorder has closed
        session = stack.enter_context(LiveSession.open(folder, config, make_engine, late=True))
        model = session.journal.model
        last_t = session.journal.last_t
        start_s = host_now() - (0.0 if last_t is None else max(last_t, 0.0) + 1.0)
        stack.callback(_write_truth, live.write_truth, folder, start_s, -1.0 if last_t is None else last_t, say)
        say("opening the devices")
        devices = live.open_devices(stack, model)
        if live.stage is not None:
            say("starting the stage's watchdog")
            devices.stage = stack.enter_context(_open_stage(live.stage, model, session, start_s, folder))
        overlay = None
        if devices.overlay:
            overlay = OverlayFeed(model, devices.overlay)
            stack.callback(overlay.close)

        def on_event(event: Recorded, estimate: OnlineEstimate | None, marker_T_laser: FloatArray | None) -> None:
            if overlay is not None:
                overlay.taken(event, estimate, marker_T_laser)
            if on_taken is not None:
                on_taken(event, estimate, marker_T_laser)
            make_engine.keep_spare(model, session.config)

        recorder = Recorder(session, on_event)
        stack.callback(_end_recording, recorder, say)
        taken = session.measurements()
        workflow = Workflow(model, live.settings, 1 + max((pair.pm for pair in taken.pairs), default=-1))
        snapshots = NewestSnapshots(session)
        loop = LiveLoop(model, devices, recorder, snapshots, workflow, start_s, live.holder, live.latencies, overlay)
        stack.callback(loop.close)
        stack.enter_context(undisturbed())
        try:
            yield Running(folder, model, loop, recorder, session)
        except BaseException:
            emergency_stop_all()
            raise
        finally:
            if devices.stage is not None:
                devices.stage.close()  # first; the rest follows in the stack's order


def _end_recording(recorder: Recorder, say: Callable[[str], None]) -> None:
    recorder.close()
    if recorder.state.waiting:
        say(f"the last {recorder.state.waiting} events could not be recorded: {recorder.state.blocked}")


def _write_truth(
    write: WriteTruth | None, folder: Path, start_s: float, begin_t: float, say: Callable[[str], None]
) -> None:
    """Write the ground truth; a failure is reported and leaves the session as it is."""
    if write is not None:
        try:
            write(folder, start_s, begin_t)
        except FgregError as error:
            say(f"no ground truth: {error}")


def _open_stage(
    stage: StageSetup, model: SessionModel, session: LiveSession, start_s: float, folder: Path
) -> ReconnectingStage:
    def log(record: StageRecord) -> None:
        t = max(0.0, record.host_s - start_s)
        session.journal.append(record.event(t, model.stage), durable=False, late=True)

    limits = MotionLimits.of_session(model.stage, **stage.limits)
    return ReconnectingStage(lambda: StageLink.open(stage.driver, stage.options, limits, log, folder / STAGE_LOG))


def default_folder() -> Path:
    """A new folder in the working directory, named by the time."""
    return Path(time.strftime("fgreg-live-%Y%m%d-%H%M%S"))
