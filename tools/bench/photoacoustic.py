"""One frame of channel data: the source by this package, by delay and sum, and with a matched filter before it."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.signal import fftconvolve, hilbert

from bench.compare import Row, Section, Target, in_turn, rows_of, say
from fgreg.detection.photoacoustic import locate_in_channels
from fgreg.detection.results import PaFind
from fgreg.geometry.transforms import FloatArray
from fgreg.model.probe_model import ProbeModel
from fgreg.simulation.acoustics import Hearing, Pulse, simulate_channels
from study_photoacoustic import probe_for

FRAMES, SNR_DB, SAMPLES = 10, 5.0, 800
T0_US, RANGES_MM = 15.0, (27.0, 48.0)
GRID_X_MM, GRID_RANGE_MM = 0.3, 0.1

Frame = tuple[Any, FloatArray]
"""Channel data and the source's (x, range), mm."""


def make_frames(probe: ProbeModel, pulse: Pulse, seed: int) -> list[Frame]:
    frames = []
    for number in range(FRAMES):
        rng = np.random.default_rng([seed, number])
        x, r = rng.uniform(-20.0, 20.0), rng.uniform(*RANGES_MM)
        source = np.array([x, 0.0, probe.radius_mm + r])
        hearing = Hearing(elevation=None)
        data = simulate_channels(probe, source, 0.0, rng, pulse, SNR_DB, SAMPLES, None, hearing)
        frames.append((data, np.array([x, r])))
    return frames


class DelayAndSum:
    """The peak of the image that pymust's delay-and-sum matrix forms (passive), refined by a parabola.

    ``kernel``: the pulse, for a matched filter before it; None: none.
    """

    def __init__(self, probe: ProbeModel, kernel: FloatArray | None) -> None:
        from pymust.dasmtx import dasmtx
        from pymust.utils import Param

        assert probe.channels is not None
        self._kernel = kernel
        self._x = np.arange(-25.0, 25.01, GRID_X_MM)
        self._z = np.arange(RANGES_MM[0] - 3.0, RANGES_MM[1] + 3.0, GRID_RANGE_MM)
        param = Param()
        param.fs, param.pitch = 1e6 * probe.channels.sampling_mhz, 1e-3 * probe.pitch_mm
        param.fc, param.c, param.passive, param.fnumber = 5e6, probe.sound_speed_m_s, True, 0.5
        param.Nelements = probe.elements
        param.t0 = np.full((1, 1), 1e-6 * (probe.channels.t0_us - probe.channels.pulse_delay_us))
        param.bandwidth = 70.0
        x, z = np.meshgrid(1e-3 * self._x, 1e-3 * self._z)
        delays = np.zeros((1, probe.elements))
        self._matrix = dasmtx(np.array([SAMPLES, probe.elements]), x, z, delays, param)
        self._matrix = getattr(self._matrix, "tocsr", lambda: self._matrix)()

    def __call__(self, data: Any) -> FloatArray:
        signals = np.asarray(data, dtype=np.float64)
        if self._kernel is not None:
            signals = fftconvolve(signals, self._kernel[None, ::-1], mode="same", axes=1)
        image = (self._matrix @ signals.ravel()).reshape(len(self._z), len(self._x), order="F")
        envelope = np.abs(hilbert(image, axis=0))
        row, column = np.unravel_index(int(np.argmax(envelope)), envelope.shape)
        return np.array(
            [
                self._x[column] + GRID_X_MM * _parabola(envelope[row], int(column)),
                self._z[row] + GRID_RANGE_MM * _parabola(envelope[:, column], int(row)),
            ]
        )


def _parabola(values: FloatArray, at: int) -> float:
    """Place of the peak beside ``at``, in steps."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, here, after = values[at - 1 : at + 2]
    return float(0.5 * (before - after) / (before - 2.0 * here + after))


def bench_photoacoustic(repeats: int, seed: int) -> Section:
    """All on the same frames; matrices of the image are made before."""
    probe, pulse = probe_for(T0_US), Pulse(5.0, 0.7)
    frames = make_frames(probe, pulse, seed)
    case = f"frame of {probe.elements} channels, {SAMPLES} samples, {SNR_DB:g} dB"

    def own(data: Any) -> FloatArray | None:
        found = locate_in_channels(data, probe)
        return np.array([found.x_mm, found.range_mm]) if isinstance(found, PaFind) else None

    locators: dict[str, Callable[[Any], FloatArray | None]] = {"this package": own}
    names = ("delay and sum (pymust)", "matched filter, then delay and sum (pymust)")
    absent: list[Row] = []
    if importlib.util.find_spec("pymust") is None:
        absent = [Row("photoacoustic", case, name, note="not installed") for name in names]
    else:
        say("photoacoustic: matrices")
        assert probe.channels is not None
        t = np.arange(-40, 41) / probe.channels.sampling_mhz
        kernel = np.exp(-0.5 * (t / pulse.sigma_us) ** 2) * np.cos(2.0 * np.pi * pulse.centre_mhz * t + pulse.phase_rad)
        locators |= {names[0]: DelayAndSum(probe, None), names[1]: DelayAndSum(probe, kernel)}
    notes = {}
    for name, locate in locators.items():
        errors = [np.full(2, np.inf) if (at := locate(data)) is None else at - true for data, true in frames]
        rms = np.sqrt(np.mean(np.square([e for e in errors if np.abs(e).max() < 1.0]), axis=0))
        within = sum(bool(np.abs(e).max() < 1.0) for e in errors)
        notes[name] = f"{within} of {FRAMES} within 1 mm, RMS of these x {rms[0]:.3f}, range {rms[1]:.3f} mm"
    runs = {name: (lambda f=locate: [f(data) for data, _ in frames]) for name, locate in locators.items()}
    rows = rows_of("photoacoustic", case, in_turn(runs, repeats), notes, ms_of=FRAMES)
    others = [row.ratio for row in rows[1:] if row.ratio is not None]
    targets = (
        [Target("a photoacoustic source over the fastest of the others", 1.0 / min(others), 1.0)] if others else []
    )
    return Section((*rows, *absent), tuple(targets))
