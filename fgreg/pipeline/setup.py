"""Finds signs and constants of probe and stage: the steps of ``fgreg setup`` on one page.

read the recordings -> what each one is, by what it contains -> all of one kind in one least squares -> compare with
what is declared -> session.yaml. An ordinary session is solved instead, and says which declared constants it
contradicts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fgreg.detection.events_to_measurements import extract_measurements
from fgreg.errors import EstimationError, InputError
from fgreg.model.estimate import SystematicEstimate, Verdict
from fgreg.model.session_model import SessionModel
from fgreg.model.setup_recording import MarkerLine, MediumLine, PulseLine, ReadingLine, SetupLine, TargetLine
from fgreg.model.solve_config import SolveConfig
from fgreg.model.time_sync import Latencies
from fgreg.pipeline.solve import detection_conditions
from fgreg.registration.camera_conditions import camera_conditions
from fgreg.registration.error_budget import conflicts
from fgreg.registration.solve import solve
from fgreg.registration.verdict import hypotheses, mirrored
from fgreg.session.recording_reader import read_recording
from fgreg.session.session_reader import read_session
from fgreg.setup.constants import Declared, Found
from fgreg.setup.moving_fibre import Movement, camera_latency
from fgreg.setup.still_targets import Medium, TargetLooks, still_targets
from fgreg.setup.sweeps import Sweep, window_of

DIFFERS_Z = 3.0
"""A value differs from the declared one beyond this many standard deviations of both."""


@dataclass(frozen=True, slots=True, eq=False)
class SetupConfig:
    """What is declared, and the name of the file that declares it.

    ``hearing_threshold`` and ``latencies`` are those of a CONFIG.yaml of ``fgreg live``; None: a session.yaml. ``own``:
    the user's own top keys of the set-up (``x_...``), a calibration's among them.
    """

    label: str
    model: SessionModel
    hearing_threshold: float | None = None
    latencies: Latencies | None = None
    own: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """A constant that was found, beside what is declared.

    Attributes:
        declared, declared_sigma: None where it is declared nowhere, or without a sigma.
        verdict: ``agrees``, ``differs``, ``new`` (declared nowhere) or ``not seen`` (by these recordings).
    """

    found: Found
    declared: float | bool | None
    declared_sigma: float | None
    verdict: str

    @property
    def taken(self) -> bool:
        """Whether it is better than what is declared: known better, or different from it."""
        found, sigma = self.found, self.declared_sigma
        known_better = found.sigma is None or sigma is None or found.sigma <= sigma
        return found.seen and (known_better or self.verdict == "differs")


@dataclass(frozen=True, slots=True, eq=False)
class SessionFindings:
    """What an ordinary session says of the declared constants.

    Attributes:
        constants: of its result: score and value of each. contradicts: sentences.
        reasons: the other ones of its verdict.
    """

    folder: Path
    verdict: Verdict
    constants: tuple[SystematicEstimate, ...]
    contradicts: tuple[str, ...]
    reasons: tuple[str, ...]

    @property
    def says(self) -> str:
        """What it says of them, in words. A refused session that contradicts nothing could not have."""
        if self.contradicts:
            return "contradicts what is declared"
        return "cannot tell" if self.verdict is Verdict.REFUSED else "contradicts nothing that is declared"


def is_session(path: Path) -> bool:
    """Whether a recording is a session's folder; all else is a set-up recording."""
    return path.is_dir()


def find_constants(recordings: Sequence[Path], config: SetupConfig) -> list[Compared]:
    """Signs and constants from set-up recordings.

    Raises:
        InputError: one of them cannot be used.
    """
    still: list[tuple[Path, tuple[SetupLine, ...]]] = []
    sweeps: list[tuple[Path, tuple[SetupLine, ...]]] = []
    moving: list[tuple[Path, tuple[SetupLine, ...]]] = []
    for path in recordings:
        lines = read_recording(path)
        {"still": still, "sweep": sweeps, "moving": moving}[_kind(path, lines)].append((path, lines))
    declared = Declared.of(config.model)
    found: list[Found] = []
    with_names: list[tuple[Sequence[tuple[Path, tuple[SetupLine, ...]]], Callable[[], list[Found]], str]] = [
        (still, lambda: still_targets(*_still(still, declared), declared), "a target heard from one side to the other"),
        (sweeps, lambda: window_of([_sweep(*one, declared) for one in sweeps], declared), "a sweep past a PM"),
        (
            moving,
            lambda: [camera_latency([_movement(*one) for one in moving], declared.noise)],
            "a fibre moved along the probe",
        ),
    ]
    for given, estimate, expected in with_names:
        if not given:
            continue
        try:
            found += estimate()
        except EstimationError as error:
            raise InputError(", ".join(str(path) for path, _ in given), str(error), expected) from None
    return [compare(one, config) for one in found]


def _kind(path: Path, lines: Sequence[SetupLine]) -> str:
    pulses = [line for line in lines if isinstance(line, PulseLine)]
    if not any(line.x_mm is not None for line in pulses):
        found = f"{len(lines)} lines, {len(pulses)} pulses" + (
            ", in none of which anything was heard" if pulses else ""
        )
        raise InputError(str(path), found, "pulses with x_mm and range_mm")
    if any(isinstance(line, MarkerLine) for line in lines):
        return "moving"
    if any(isinstance(line, ReadingLine) for line in lines):
        return "sweep"
    missing = next((line for line in pulses if line.scan_deg is None), None)
    if missing is not None:
        expected = "scan_deg where the stage stands, stage lines where it turns, or marker lines where the fibre moves"
        raise InputError(f"{path}: line {missing.line}: scan_deg", "nothing", expected)
    return "still"


def _heard(lines: Sequence[SetupLine]) -> list[PulseLine]:
    return [line for line in lines if isinstance(line, PulseLine) and line.x_mm is not None]


def _numbers(values: Sequence[float | None]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def _medium(path: Path, lines: Sequence[SetupLine], declared: Declared) -> Medium:
    media = [line for line in lines if isinstance(line, MediumLine)]
    if len(media) > 1:
        raise InputError(f"{path}: line {media[1].line}", "a second medium", "one for each recording")
    if not media:
        return Medium(1.0, declared.sound_speed_sigma)
    return Medium(media[0].sound_speed_m_s / declared.sound_speed_m_s, media[0].sigma_m_s / media[0].sound_speed_m_s)


def _still(
    recordings: Sequence[tuple[Path, tuple[SetupLine, ...]]], declared: Declared
) -> tuple[list[TargetLooks], list[Medium]]:
    targets, media = [], []
    for index, (path, lines) in enumerate(recordings):
        media.append(_medium(path, lines, declared))
        facts = [line for line in lines if isinstance(line, TargetLine)]
        heard = _heard(lines)
        numbers = {line.target for line in heard}
        if absent := [fact for fact in facts if fact.target not in numbers]:
            where = f"{path}: line {absent[0].line}: target"
            raise InputError(where, f"{absent[0].target}, which no pulse heard", "a target that is heard")
        for number in sorted(numbers):
            of = [line for line in heard if line.target == number]
            targets.append(
                TargetLooks(
                    number,
                    index,
                    np.radians(_numbers([line.scan_deg for line in of])),
                    _numbers([line.x_mm for line in of]),
                    _numbers([line.range_mm for line in of]),
                    _numbers([line.amplitude for line in of]),
                    tuple(fact for fact in facts if fact.target == number),
                )
            )
    return targets, media


def _sweep(path: Path, lines: Sequence[SetupLine], declared: Declared) -> Sweep:
    pulses = [line for line in lines if isinstance(line, PulseLine)]
    readings = [line for line in lines if isinstance(line, ReadingLine)]
    return Sweep(
        path.name,
        np.array([line.t for line in pulses]),
        np.array([line.x_mm is not None for line in pulses]),
        _numbers([line.amplitude for line in pulses]),
        _medium(path, lines, declared).ratio * _numbers([line.range_mm for line in pulses]),
        np.array([line.t for line in readings]),
        np.radians([line.scan_deg for line in readings]),
    )


def _movement(path: Path, lines: Sequence[SetupLine]) -> Movement:
    heard, poses = _heard(lines), [line for line in lines if isinstance(line, MarkerLine)]
    return Movement(
        path.name,
        np.array([line.t for line in heard]),
        _numbers([line.x_mm for line in heard]),
        np.array([line.t for line in poses]),
        np.stack([line.camera_T_marker for line in poses]),
    )


def compare(found: Found, config: SetupConfig) -> Compared:
    """A constant beside what is declared of it."""
    declared, sigma = _declared(found, config)
    if not found.seen:
        verdict = "not seen"
    elif declared is None:
        verdict = "new"
    elif found.sigma is None:
        verdict = "agrees" if found.value == declared else "differs"
    else:
        apart = abs(float(found.value) - float(declared))
        verdict = "differs" if apart > DIFFERS_Z * math.hypot(found.sigma, sigma or 0.0) else "agrees"
    return Compared(found, declared, sigma, verdict)


def _declared(found: Found, config: SetupConfig) -> tuple[float | bool | None, float | None]:
    model, systematic = config.model, config.model.systematic
    window = model.probe.sensitivity
    edge = math.degrees(window.edge_sigma_rad)
    half = math.degrees(float(window.half_width_at(found.depth_mm or 0.0)))
    either = math.hypot(edge, math.degrees(systematic.window_centre_rad))
    latencies = config.latencies
    known: dict[str, tuple[float | bool | None, float | None]] = {
        "probe.radius_mm": (model.probe.radius_mm, systematic.radius_mm),
        "probe.flip": (model.probe.flip, None),
        "stage.direction": (model.stage.direction, None),
        "range_offset_mm": (0.0, systematic.range_offset_mm),
        "probe.sensitivity.half_width_deg": (half, edge),
        "lower_edge_deg": (-half, either),
        "upper_edge_deg": (half, either),
        "backlash_deg": (0.0, math.degrees(systematic.backlash_rad)),
        "settings.hearing_threshold": (config.hearing_threshold, None),
        "camera_less_pulse_latency_s": (None if latencies is None else latencies.camera_s - latencies.pulse_s, None),
    }
    return known.get(found.name, (None, None))


def contradictions(folder: Path) -> SessionFindings:
    """Which declared constants and signs an ordinary session contradicts: by the tests of its solve.

    Raises:
        InputError: the session is not valid, or nothing can be computed from it.
    """
    session = read_session(folder)
    extracted = extract_measurements(session.events, session.model)
    config = SolveConfig()
    solution = solve(extracted.measurements, (), session.model, config, detection_conditions(extracted))
    if solution.registration is None:
        raise InputError(
            str(folder), f"no registration: {'; '.join(solution.reasons)}", "aims, and pairs of 6 PMs or more"
        )
    registrations = [epoch.trus_T_camera for epoch in solution.epochs if epoch.trus_T_camera is not None]
    found = [c for of in solution.registration.searches for c in (*mirrored(of, config), *hypotheses(of, config))]
    pictures = camera_conditions(extracted.measurements, session.model, config, registrations)
    # Cameras or prints that are not as declared make the shots contradict any other constant, too (as in a solve).
    found += pictures or conflicts(solution.systematic)
    told = tuple(dict.fromkeys(condition.text for condition in found))
    others = tuple(reason for reason in solution.reasons if not any(text in reason for text in told))
    return SessionFindings(folder, solution.verdict, solution.systematic, told, others)
