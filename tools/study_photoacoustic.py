"""Detection of photoacoustic sources: every required figure against its target.

Frames are simulated (fgreg.simulation.acoustics) with sources at x -20 to 20 mm and range 15 to 60 mm, pulses of 3 to
7 MHz with 50 to 80 % bandwidth, 128 elements of 0.43 mm, 800 samples at 40 MHz that begin shortly before the wave does.
The signal-to-noise ratio is the peak amplitude / sqrt(2) over the noise's standard deviation, per sample, on the
element with the largest amplitude. Frames of the section "artefacts" hold a reflection of the source behind it, or
pick-up of the trigger or sound of the probe's face before it.

Exit status is 1 if a target is missed.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fgreg.detection.channels import prepare_channels
from fgreg.detection.envelope import locate_in_image
from fgreg.detection.photoacoustic import locate_in_channels
from fgreg.detection.results import NoSignal, PaFind
from fgreg.detection.wavefront_fit import fit_wavefront
from fgreg.geometry.transforms import FloatArray, as_float_array
from fgreg.model.probe_model import ChannelModel, ImageModel, ProbeModel, SensitivityModel
from fgreg.simulation.acoustics import (
    Artefact,
    FaceSound,
    Hearing,
    PickUp,
    Pulse,
    Reflection,
    noise_channels,
    simulate_channels,
    simulate_envelope_image,
)

ASSUMED_M_S = 1540.0
SAMPLES = 800
WRONG_MM = 1.0
"""A find farther than this from the source is a false find."""
RANGES_MM = (15.0, 60.0)


@dataclass
class Tally:
    """Results of many frames of one kind."""

    frames: int = 0
    wrong: int = 0
    error_mm: list[FloatArray] = field(default_factory=list)
    mahalanobis2: list[float] = field(default_factory=list)
    finds: list[PaFind] = field(default_factory=list)

    def add(self, answer: PaFind | NoSignal, x_mm: float, range_mm: float) -> None:
        self.frames += 1
        if isinstance(answer, NoSignal):
            return
        error = np.array([answer.x_mm - x_mm, answer.range_mm - range_mm])
        if np.abs(error).max() > WRONG_MM:
            self.wrong += 1
            return
        self.error_mm.append(error)
        self.mahalanobis2.append(float(error @ np.linalg.solve(answer.covariance, error)))
        self.finds.append(answer)

    def summary(self) -> dict[str, float]:
        error = np.array(self.error_mm).reshape(-1, 2)
        if not len(error):
            return {"frames": self.frames, "found": 0, "wrong": self.wrong}
        rms = np.sqrt((error**2).mean(axis=0))
        return {
            "frames": self.frames,
            "found": len(error),
            "wrong": self.wrong,
            "x_rms_mm": round(float(rms[0]), 5),
            "range_rms_mm": round(float(rms[1]), 5),
            "x_worst_mm": round(float(np.abs(error[:, 0]).max()), 5),
            "range_worst_mm": round(float(np.abs(error[:, 1]).max()), 5),
            "mahalanobis2_mean": round(float(np.mean(self.mahalanobis2)), 3),
            "snr_db_mean": round(float(np.mean([find.snr_db for find in self.finds])), 2),
        }


def probe_for(t0_us: float, pulse_delay_us: float = 0.2) -> ProbeModel:
    sensitivity = SensitivityModel(as_float_array([30.0]), as_float_array([0.1]), 0.005)
    channels = ChannelModel(40.0, t0_us, pulse_delay_us)
    image = ImageModel((0.1, 0.15), (8.0, -25.0))
    return ProbeModel(128, 0.43, False, 10.0, ASSUMED_M_S, sensitivity, channels, image)


def channel_frames(
    frames: int,
    seed: int,
    snr_db: float,
    x_mm: float = 20.0,
    speed_m_s: float = ASSUMED_M_S,
    asymmetry: float = 0.0,
    locate: Callable[[npt.NDArray[Any], ProbeModel], PaFind | NoSignal] = locate_in_channels,
) -> Tally:
    """Simulated sources, one per frame; the range counted as true is the assumed speed times the arrival's time."""
    tally = Tally()
    for number in range(frames):
        rng = np.random.default_rng([seed, number])
        x, r = rng.uniform(-x_mm, x_mm), rng.uniform(*RANGES_MM)
        pulse = Pulse(rng.uniform(3.0, 7.0), rng.uniform(0.5, 0.8), asymmetry, rng.uniform(0.0, 2.0 * math.pi))
        # In steps, since a session has one crop: the first sample is 1.5 to 6.5 us before the arrival.
        probe = probe_for(max(0.0, 5.0 * math.floor((r / (speed_m_s * 1e-3) - 1.5) / 5.0)))
        source = np.array([x, 0.0, probe.radius_mm + r])
        hearing = Hearing(elevation=None)
        frame = simulate_channels(probe, source, 0.0, rng, pulse, snr_db, SAMPLES, speed_m_s, hearing)
        tally.add(locate(frame, probe), x, r * ASSUMED_M_S / speed_m_s)
        progress(number + 1, frames)
    return tally


REFLECTION_DB = (0.0, 3.0, 6.0)
BEHIND_MM = (3.0, 5.0, 8.0, 11.0, 15.0)
OTHER_WITHIN_MM = 0.3


@dataclass
class FirstWave:
    """How often the direct wave is found among others, and how often the other one is reported."""

    frames: int = 0
    found: int = 0
    wrong: int = 0
    others: int = 0
    seconds: float = 0.0

    def __add__(self, more: FirstWave) -> FirstWave:
        return FirstWave(*(getattr(self, name) + getattr(more, name) for name in self.__dataclass_fields__))

    def locate(self, frame: npt.NDArray[Any], probe: ProbeModel, at_mm: FloatArray, other_mm: FloatArray) -> None:
        """Take in one frame with its source, and its reflection, at (x, range)."""

        def near(x_mm: float, range_mm: float, there: FloatArray) -> bool:
            return bool(np.abs(np.array([x_mm, range_mm]) - there).max() < OTHER_WITHIN_MM)

        start = time.process_time()
        find = locate_in_channels(frame, probe)
        self.seconds += time.process_time() - start
        self.frames += 1
        if isinstance(find, NoSignal):
            return
        if not near(find.x_mm, find.range_mm, at_mm):
            self.wrong += 1
            return
        self.found += 1
        self.others += any(near(other.x_mm, other.range_mm, other_mm) for other in find.others)

    def figures(self) -> dict[str, float]:
        share = self.found / self.frames
        return {
            "frames": self.frames,
            "found": round(share, 4),
            "standard_error": round(math.sqrt(share * (1.0 - share) / self.frames), 4),
            "wrong": round(self.wrong / self.frames, 4),
            "other_reported": round(self.others / self.frames, 4),
            "ms": round(1e3 * self.seconds / self.frames, 1),
        }


def reflected(frames: int, seed: int, snr_db: float, gain_db: float, behind_mm: float) -> FirstWave:
    """Sources with a reflection: ``channel_frames`` with a louder copy behind, up to 2 mm aside, of any phase."""
    tally = FirstWave()
    for number in range(frames):
        rng = np.random.default_rng([seed, number])
        x, r = rng.uniform(-20.0, 20.0), rng.uniform(*RANGES_MM)
        pulse = Pulse(rng.uniform(3.0, 7.0), rng.uniform(0.5, 0.8), 0.0, rng.uniform(0.0, 2.0 * math.pi))
        probe = probe_for(max(0.0, 5.0 * math.floor((r / (ASSUMED_M_S * 1e-3) - 1.5) / 5.0)))
        aside = rng.uniform(-2.0, 2.0)
        copy = Reflection(behind_mm, aside, gain_db, rng.uniform(0.0, 2.0 * math.pi))
        source, hearing = np.array([x, 0.0, probe.radius_mm + r]), Hearing(elevation=None)
        frame = simulate_channels(probe, source, 0.0, rng, pulse, snr_db, SAMPLES, None, hearing, artefacts=(copy,))
        tally.locate(frame, probe, np.array([x, r]), np.array([x + aside, r + behind_mm]))
        progress(number + 1, frames)
    return tally


def pick_up(rng: np.random.Generator, snr_db: float, range_mm: float) -> tuple[Artefact, ...]:
    """Of the trigger, at any time before the direct wave, in all channels or in 15 to 40 % of them."""
    share = 1.0 if rng.random() < 0.5 else rng.uniform(0.15, 0.4)
    first = rng.uniform(0.0, 1.0 - share)
    pulse = Pulse(rng.uniform(1.0, 8.0), rng.uniform(0.3, 0.8))
    at_us = rng.uniform(0.5, range_mm / (ASSUMED_M_S * 1e-3) - 2.0)
    return (PickUp(at_us, snr_db, 0.3, (first, first + share), pulse),)


def face_area(rng: np.random.Generator, snr_db: float, _: float) -> tuple[Artefact, ...]:
    """Light on the face, 5 to 30 mm (standard deviation) wide."""
    return (FaceSound(snr_db, rng.uniform(0.2, 2.0), rng.uniform(-25.0, 25.0), rng.uniform(5.0, 30.0)),)


def face_spot(rng: np.random.Generator, snr_db: float, _: float) -> tuple[Artefact, ...]:
    """A spot of light on the face."""
    return (FaceSound(snr_db, rng.uniform(0.2, 2.0), rng.uniform(-25.0, 25.0)),)


def all_three(rng: np.random.Generator, snr_db: float, range_mm: float) -> tuple[Artefact, ...]:
    """Pick-up, a spot of light on the face, and a reflection."""
    copy = Reflection(rng.uniform(3.0, 15.0), rng.uniform(-2.0, 2.0), rng.uniform(0.0, 6.0), rng.uniform(0.0, 6.28))
    return (*pick_up(rng, snr_db, range_mm), *face_spot(rng, snr_db, range_mm), copy)


EARLY = {"pick-up": pick_up, "face, area": face_area, "face, spot": face_spot, "all and reflection": all_three}


def early(frames: int, seed: int, snr_db: float, louder_db: float, kind: str, *, silent: bool = False) -> FirstWave:
    """Whole records with a signal before the direct wave, this much louder; ``silent``: without a source."""
    tally, probe = FirstWave(), probe_for(0.0)
    for number in range(frames):
        rng = np.random.default_rng([seed, number])
        x, r = rng.uniform(-20.0, 20.0), rng.uniform(*RANGES_MM)
        pulse = Pulse(rng.uniform(3.0, 7.0), rng.uniform(0.5, 0.8), 0.0, rng.uniform(0.0, 2.0 * math.pi))
        artefacts = EARLY[kind](rng, snr_db + louder_db, r)
        if silent:
            artefacts = tuple(artefact for artefact in artefacts if not isinstance(artefact, Reflection))
        source, samples = np.array([x, 0.0, probe.radius_mm + r]), 200 * math.ceil((r / 1.54 + 18.0) / 5.0)
        frame = simulate_channels(
            probe,
            source,
            0.0,
            rng,
            pulse,
            -300.0 if silent else snr_db,
            samples,
            None,
            Hearing(elevation=None),
            artefacts=artefacts,
        )
        tally.locate(frame, probe, np.array([x, r]), np.array([np.inf, np.inf]))
        progress(number + 1, frames)
    return tally


def artefacts(study: Study, options: argparse.Namespace) -> None:
    """The first wave, not the strongest; nothing that comes before it."""

    def text(figures: dict[str, float]) -> str:
        return (
            f"found {figures['found']:.3f} +- {figures['standard_error']:.3f}, wrong {figures['wrong']:.3f}, "
            f"other reported {figures['other_reported']:.3f}, {figures['ms']:.0f} ms"
        )

    limits = {10.0: 0.99, 0.0: 0.97}
    for snr_db, limit in limits.items():
        for gain_db in REFLECTION_DB:
            whole = FirstWave()
            for behind_mm in BEHIND_MM:
                tally = reflected(options.frames, options.seed + 7, snr_db, gain_db, behind_mm)
                name = f"reflection {gain_db:+.0f} dB, {behind_mm:.0f} mm, {snr_db:g} dB"
                study.note(name, tally.figures(), text(tally.figures()))
                whole += tally
            name = f"reflection {gain_db:+.0f} dB, {snr_db:g} dB"
            study.note(name, whole.figures(), study.target(name, whole.found / whole.frames, 1.0, limit))
        for kind in EARLY:
            for louder_db in (0.0, 20.0):
                tally = early(options.frames, options.seed + 8, snr_db, louder_db, kind)
                name = f"{kind} {louder_db:+.0f} dB, {snr_db:g} dB"
                study.note(name, tally.figures(), text(tally.figures()))
                print("    found", study.target(name, tally.found / tally.frames, 1.0, limit), end="; ")
                none = early(options.frames, options.seed + 9, snr_db, louder_db, kind, silent=True)
                study.note(name + ", no source", none.figures(), f"{none.wrong + none.found} finds in {none.frames}")


def with_ratio_fixed(frame: npt.NDArray[Any], probe: ProbeModel) -> PaFind | NoSignal:
    """The same result with the sound speed fixed: what does estimating it cost?"""
    free = locate_in_channels(frame, probe)
    if isinstance(free, NoSignal) or probe.channels is None:
        return free
    channels = prepare_channels(frame, probe.channels)
    speed_mm_us = probe.sound_speed_m_s * 1e-3
    fit = fit_wavefront(channels, probe.element_x_mm, speed_mm_us, free.x_mm, free.range_mm, 1.0, ratio_sigma=1e-6)
    return replace(free, x_mm=fit.x_mm, range_mm=fit.range_mm, covariance=fit.covariance)


def band_limited(rng: np.random.Generator, shape: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Noise between 2 and 8 MHz, standard deviation 1: what an amplifier's filter leaves."""
    spectrum = np.fft.rfft(rng.standard_normal(shape), axis=1)
    frequency = np.fft.rfftfreq(shape[1], 1.0 / 40.0)
    spectrum *= (frequency > 2.0) & (frequency < 8.0)
    noise = np.fft.irfft(spectrum, shape[1], axis=1)
    return np.asarray(noise / noise.std(), dtype=np.float32)


def flash(rng: np.random.Generator, shape: tuple[int, int]) -> npt.NDArray[np.float32]:
    """Noise and a flash at the same time on all channels, up to 100 times the noise, channels unequal."""
    at = rng.uniform(0.0, 3.0) if rng.random() < 0.7 else rng.uniform(0.0, 20.0)
    time_us = np.arange(shape[1]) / 40.0
    bell = np.exp(-0.5 * ((time_us - at) / rng.uniform(0.08, 0.4)) ** 2)
    wave = bell * np.cos(2.0 * np.pi * rng.uniform(1.0, 8.0) * (time_us - at))
    gain = 10.0 ** rng.uniform(0.0, 2.0) * (1.0 + rng.uniform(0.0, 0.3) * rng.standard_normal((shape[0], 1)))
    return np.asarray(rng.standard_normal(shape) + gain * wave, dtype=np.float32)


def speckle(rng: np.random.Generator, shape: tuple[int, int], grain: float) -> npt.NDArray[np.float32]:
    """Envelope of noise with grains of this size in pixels (0: every pixel for itself)."""
    noise = rng.standard_normal((2, *shape))
    if grain:
        f = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :])
        noise = np.fft.irfft2(np.fft.rfft2(noise) * np.exp(-2.0 * (np.pi * grain * f) ** 2), shape)
    return np.asarray(np.hypot(noise[0], noise[1]), dtype=np.float32)


def image_frames(frames: int, seed: int, snr_db: float, asymmetry: float = 0.0) -> Tally:
    tally = Tally()
    probe = probe_for(0.0)
    for number in range(frames):
        rng = np.random.default_rng([seed, number])
        x, r = rng.uniform(-20.0, 20.0), rng.uniform(15.0, 50.0)
        pulse = Pulse(rng.uniform(3.0, 7.0), rng.uniform(0.5, 0.8), asymmetry)
        source = np.array([x, 0.0, probe.radius_mm + r])
        hearing = Hearing(elevation=None)
        shape = (512, 336)
        image = simulate_envelope_image(probe, source, 0.0, rng, shape, pulse, snr_db, None, hearing)
        tally.add(locate_in_image(image, probe), x, r)
        progress(number + 1, frames)
    return tally


def progress(done: int, of: int) -> None:
    if sys.stderr.isatty() and (done % 20 == 0 or done == of):
        print(f"\r  {done}/{of} ", end="" if done < of else "\r", file=sys.stderr, flush=True)


class Study:
    """Collects figures and compares them with targets."""

    def __init__(self) -> None:
        self.figures: dict[str, Any] = {}
        self.missed: list[str] = []

    def note(self, name: str, figures: dict[str, Any], text: str) -> None:
        self.figures[name] = figures
        print(f"{name:34s} {text}", flush=True)

    def target(self, name: str, value: float, limit: float, low: float = -math.inf) -> str:
        met = low <= value <= limit
        if not met:
            self.missed.append(f"{name}: {value:g}, target {low:g} to {limit:g}")
        return f"{value:.4g} ({'ok' if met else 'MISSED'}, {'' if math.isinf(low) else f'{low:g} to '}{limit:g})"


def line(figures: dict[str, float]) -> str:
    if not figures["found"]:
        return f"found 0 of {figures['frames']}, wrong {figures['wrong']}"
    return (
        f"found {figures['found']} of {figures['frames']}, wrong {figures['wrong']}, x {figures['x_rms_mm']:.4f} range "
        f"{figures['range_rms_mm']:.4f} mm RMS, Mahalanobis^2 {figures['mahalanobis2_mean']:.2f}"
    )


def accuracy(study: Study, options: argparse.Namespace) -> None:
    """RMS errors at 20, 10 and 0 dB."""
    limits = {20.0: (0.03, 0.02), 10.0: (0.1, 0.05), 0.0: (0.1, 0.05)}
    for snr_db, (x_limit, range_limit) in limits.items():
        figures = channel_frames(options.frames, options.seed, snr_db).summary()
        name = f"accuracy {snr_db:g} dB"
        study.note(name, figures, line(figures))
        print("    x", study.target(name + " x", figures["x_rms_mm"], x_limit), end="; ")
        print("range", study.target(name + " range", figures["range_rms_mm"], range_limit), end="; ")
        print("found", study.target(name + " found", figures["found"] / figures["frames"], 1.0, 0.99))
    for snr_db in (20.0, 0.0):
        figures = channel_frames(options.frames, options.seed + 1, snr_db, x_mm=27.0).summary()
        study.note(f"array's end (|x| to 27) {snr_db:g} dB", figures, line(figures))
        figures = channel_frames(options.frames, options.seed + 2, snr_db, asymmetry=0.5).summary()
        study.note(f"pulse falls 1.5 times as slowly {snr_db:g} dB", figures, line(figures))
        figures = channel_frames(options.frames, options.seed, snr_db, locate=with_ratio_fixed).summary()
        study.note(f"sound speed fixed {snr_db:g} dB", figures, line(figures))


def curve(study: Study, options: argparse.Namespace) -> None:
    """Detection and honesty of the covariance against the signal-to-noise ratio."""
    distances: list[float] = []
    for snr_db in (25.0, 20.0, 15.0, 10.0, 5.0, 2.5, 0.0, -2.5, -5.0, -7.5, -10.0, -12.5, -15.0):
        tally = channel_frames(options.frames, options.seed + 3, snr_db)
        figures = tally.summary()
        study.note(f"curve {snr_db:+.1f} dB", figures, line(figures))
        if snr_db >= -5.0:
            distances += tally.mahalanobis2
    mean = float(np.mean(distances))
    # 2 is expected; the allowance for pulses that are not symmetric makes it less where there is little noise.
    text = study.target("honesty", mean, 3.0, 1.5)
    study.note("mean squared Mahalanobis, -5..25 dB", {"mean": round(mean, 3), "finds": len(distances)}, text)


def false_finds(study: Study, options: argparse.Namespace) -> None:
    """Frames without a source."""
    probe = probe_for(5.0)
    shape = (probe.elements, SAMPLES)
    kinds: dict[str, Callable[[np.random.Generator], npt.NDArray[Any]]] = {
        "white noise": lambda rng: noise_channels(probe, rng, SAMPLES),
        "band-limited noise": lambda rng: band_limited(rng, shape),
        "flash on all channels": lambda rng: flash(rng, shape),
        "zeros": lambda _: np.zeros(shape, dtype=np.int16),
    }
    for name, make in kinds.items():
        frames = min(options.noise_frames, 10) if name == "zeros" else options.noise_frames
        found = 0
        for number in range(frames):
            found += isinstance(locate_in_channels(make(np.random.default_rng([options.seed, number])), probe), PaFind)
            progress(number + 1, frames)
        name = f"false finds, {name}"
        text = study.target(name, found / frames, 1e-3)
        study.note(name, {"frames": frames, "found": found}, f"{found} in {frames} frames: {text}")


def image_false_finds(study: Study, options: argparse.Namespace) -> None:
    """Images without a source."""
    probe = probe_for(0.0)
    for grain in (0.0, 1.5, 3.0):
        found = 0
        for number in range(options.noise_frames):
            image = speckle(np.random.default_rng([options.seed, number]), (512, 336), grain)
            found += isinstance(locate_in_image(image, probe), PaFind)
            progress(number + 1, options.noise_frames)
        name = f"image false finds, grain {grain:g} px"
        text = study.target(name, found / options.noise_frames, 1e-3)
        figures = {"frames": options.noise_frames, "found": found}
        study.note(name, figures, f"{found} in {options.noise_frames} images: {text}")


def sound_speed(study: Study, options: argparse.Namespace) -> None:
    """A speed 2 % off has to be detected."""
    for ratio in (1.02, 0.98, 1.0):
        for snr_db in (20.0, 10.0, 0.0):
            tally = channel_frames(options.frames, options.seed + 5, snr_db, speed_m_s=ratio * ASSUMED_M_S)
            ratios = np.array([find.sound_speed_ratio for find in tally.finds], dtype=np.float64)
            sigmas = np.array([find.sound_speed_ratio_sigma for find in tally.finds], dtype=np.float64)
            shows = int(np.sum(np.abs(ratios - 1.0) > np.maximum(3.0 * sigmas, 0.005)))
            weight = sigmas**-2.0
            pooled = float(weight @ ratios / weight.sum()), float(weight.sum() ** -0.5)
            summary = tally.summary()
            figures = {
                **summary,
                "shows": shows,
                "ratio_rms": round(float(np.sqrt(np.mean((ratios - ratio) ** 2))), 6),
                "ratio_z_rms": round(float(np.sqrt(np.mean(((ratios - ratio) / sigmas) ** 2))), 3),
                "pooled": [round(value, 6) for value in pooled],
            }
            name = f"sound speed x {ratio:g}, {snr_db:g} dB"
            text = f"shows in {shows} of {summary['found']}; pooled {pooled[0]:.5f} +- {pooled[1]:.5f}; {line(summary)}"
            study.note(name, figures, text)
            if ratio != 1.0:
                print("    share:", study.target(name, shows / len(ratios), 1.0, 0.95 if snr_db < 5 else 0.99))


def images(study: Study, options: argparse.Namespace) -> None:
    """Envelope images."""
    for snr_db in (30.0, 20.0, 15.0, 12.5, 10.0):
        figures = image_frames(options.frames, options.seed + 6, snr_db).summary()
        study.note(f"image {snr_db:g} dB", figures, line(figures))


def timing(study: Study, options: argparse.Namespace) -> None:
    """Time per frame, one geometry, first frame apart."""
    probe = probe_for(10.0)
    hearing = Hearing(elevation=None)
    rng = np.random.default_rng(options.seed)
    source = np.array([3.0, 0.0, 35.0])
    made = [simulate_channels(probe, source, 0.0, rng, None, 10.0, SAMPLES, None, hearing) for _ in range(20)]
    laps = []
    for frame in made:
        start = time.perf_counter()
        locate_in_channels(frame, probe)
        laps.append(1e3 * (time.perf_counter() - start))
    middle = float(np.median(laps[1:]))
    figures = {"first_ms": round(laps[0], 1), "median_ms": round(middle, 1), "best_ms": round(min(laps), 1)}
    study.note("time, 128 x 800 samples", figures, f"{figures}")


SECTIONS = {
    "accuracy": accuracy,
    "curve": curve,
    "false-finds": false_finds,
    "sound-speed": sound_speed,
    "artefacts": artefacts,
    "images": images,
    "image-false-finds": image_false_finds,
    "timing": timing,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=300, help="frames per signal-to-noise ratio (default 300)")
    parser.add_argument("--noise-frames", type=int, default=2000, help="frames per kind of noise (default 2000)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help=f"of {', '.join(SECTIONS)}")
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    options = parser.parse_args()
    study = Study()
    for name, section in SECTIONS.items():
        if not options.only or name in options.only:
            section(study, options)
    if options.json:
        options.json.write_text(json.dumps({"figures": study.figures, "missed": study.missed}, indent=1) + "\n")
    print("all targets met" if not study.missed else "missed:\n  " + "\n  ".join(study.missed))
    return 1 if study.missed else 0


if __name__ == "__main__":
    sys.exit(main())
