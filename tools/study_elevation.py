"""How much one frame tells of the arc angle off the plane: Fisher's information in the channel data.

    python tools/study_elevation.py
    python tools/study_elevation.py --heights 2 5 --centre 7.5 --waveform known
    python tools/study_elevation.py --bound 0.3 --sessions 60

An element of some height receives a source off the plane over a time H sin(delta) / c: the wave's shape tells |delta|,
where its amplitude alone tells nothing, since the source's is not known. The derivatives of noise-free channel data
(fgreg.simulation.acoustics) by delta, x, range, amplitude and waveform, white noise of known level; the standard
deviation of delta is that of the inverse information (Cramer-Rao), all others free. ``known``: the pulse is that of the
receiver. ``pm``: centre frequency and bandwidth differ from PM to PM by 20 % (the size of the light's spot does
that), and the phase is free. ``any``: besides, amplitude and phase of its spectrum are off by 0.3 (1 sigma; factor e,
rad) at every megahertz, independently. The sign of delta is not told: the element is the same above and below.

``--bound``: the least error of a registration of 15 pairs, and that were its looks' rotations measured so well (deg)
besides what the windows tell: the Cramer-Rao bound (tools/cramer_rao_bound.py) in labs as of study_more_data.py.

Beside it, what is known without it (1 sigma, arc angle): a window of 6 deg of stage rotation, a first hit in steps of 2
deg with 0.4 deg of scatter from PM to PM.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np

from cramer_rao_bound import truth_covariance
from fgreg.geometry.target_error import expected_tre_mm
from fgreg.geometry.transforms import FloatArray
from fgreg.model.probe_model import ChannelModel
from fgreg.simulation.acoustics import ElementHeight, Hearing, Pulse, noise_channels, simulate_channels
from fgreg.simulation.config import default_probe
from paper_sessions import simulated
from study_more_data import SWEEPS, Job
from systematic_cells import NOISES

PROBE = replace(default_probe(), channels=ChannelModel(40.0, 0.0, 0.0))
SAMPLES = 1400
STEPS = {"delta": math.radians(0.02), "x": 0.01, "range": 0.002, "amplitude": 0.01, "centre": 0.002, "width": 0.005}
"""Steps of the numerical derivatives: rad, mm, mm, relative."""
UNKNOWN_PULSE = {"known": 1e-6, "pm": 0.2, "any": 0.2}
"""Standard deviation of centre frequency and bandwidth, relative."""
KNOTS_MHZ = np.arange(0.0, 20.5, 1.0)
UNKNOWN_SPECTRUM = 0.3
"""Of ``any``: of the logarithm of the spectrum's amplitude, and of its phase, at each knot."""


def frame(
    height_mm: float, focus_mm: float, centre_mhz: float, range_mm: float, snr_db: float, off: dict[str, float]
) -> FloatArray:
    """(elements, samples) without noise, of a source at delta ``off["delta"]``, all else off by some amounts."""
    r, delta = range_mm + off.get("range", 0.0), off.get("delta", 0.0)
    trus_p = np.array([off.get("x", 0.0), r * math.sin(delta), PROBE.radius_mm + r * math.cos(delta)])
    pulse = Pulse(
        centre_mhz * (1.0 + off.get("centre", 0.0)),
        0.7 * (1.0 + off.get("width", 0.0)),
        phase_rad=off.get("phase", 0.6),
    )
    hearing = Hearing(elevation=None, element=ElementHeight(height_mm, focus_mm))
    rng = (np.random.default_rng(0), np.random.default_rng(0))
    heard = simulate_channels(PROBE, trus_p, 0.0, rng[0], pulse, snr_db, SAMPLES, hearing=hearing)
    wave = heard.astype(np.float64) - noise_channels(PROBE, rng[1], SAMPLES)
    return np.asarray(wave * (1.0 + off.get("amplitude", 0.0)))


def sigma_deg(
    height_mm: float,
    focus_mm: float,
    centre_mhz: float,
    range_mm: float,
    snr_db: float,
    delta_deg: float,
    waveform: str,
) -> tuple[float, float]:
    """Standard deviation of the arc angle at ``delta_deg``, deg; and the frame's own level below the plane's, dB."""
    here, args = {"delta": math.radians(delta_deg)}, (height_mm, focus_mm, centre_mhz, range_mm, snr_db)

    def by(name: str, step: float) -> FloatArray:
        at = here.get(name, 0.6 if name == "phase" else 0.0)
        ends = [frame(*args, {**here, name: at + sign * step}) for sign in (1.0, -1.0)]
        return np.asarray((ends[0] - ends[1]).ravel() / (2.0 * step))

    rows = [*(by(name, step) for name, step in STEPS.items()), by("phase", 0.01)]
    if waveform == "any":
        rows += _spectral(frame(*args, here))
    information = np.array(rows) @ np.array(rows).T
    information += np.diag([0.0] * (len(STEPS) + 1) + [UNKNOWN_SPECTRUM**-2] * (len(rows) - len(STEPS) - 1))
    places = [*STEPS]
    for name in ("centre", "width"):
        information[places.index(name), places.index(name)] += UNKNOWN_PULSE[waveform] ** -2
    if waveform == "known":
        information[len(STEPS), len(STEPS)] += 1e12
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-12))
    covariance = np.linalg.pinv(information * scale * scale[:, None], rcond=1e-12) * scale * scale[:, None]
    level = [float(np.abs(frame(*args, {"delta": d})).max()) for d in (here["delta"], 0.0)]
    return math.degrees(math.sqrt(covariance[0, 0])), 20.0 * math.log10(level[0] / level[1])


def _spectral(wave: FloatArray) -> list[FloatArray]:
    """Derivatives of a frame by amplitude and phase of the waveform's spectrum at each knot, linear between."""
    channels = PROBE.channels
    assert channels is not None
    frequency = np.fft.rfftfreq(wave.shape[1], 1.0 / channels.sampling_mhz)
    spectrum = np.fft.rfft(wave, axis=1)
    hats = [np.maximum(1.0 - np.abs(frequency - knot), 0.0) for knot in KNOTS_MHZ]
    return [
        np.asarray(np.fft.irfft(spectrum * factor * hat, n=wave.shape[1], axis=1).ravel())
        for hat in hats
        for factor in (1.0, 1j)
    ]


def least_mm(sweep: str, noise: str, sessions: int, rotation_deg: float | None) -> float:
    """RMS of the Cramer-Rao bound at the targets over sessions of 15 pairs."""
    squares = []
    for seed in range(sessions):
        made = simulated(Job("none", noise, sweep, 15, 120.0, seed).config, seed)
        known = None if rotation_deg is None else math.radians(rotation_deg)
        covariance = truth_covariance(made.measurements, made.model, made.truth, known)
        at = made.truth.trus_T_camera[0]
        squares.append(float(np.mean(expected_tre_mm(covariance[:6, :6], at, made.model.targets_mm) ** 2)))
    return math.sqrt(float(np.mean(squares)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--heights", type=float, nargs="+", default=[1.5, 3.0, 5.0, 10.0], help="of an element, mm")
    parser.add_argument("--focus", type=float, default=30.0, help="of the lens, mm")
    parser.add_argument("--range", type=float, default=30.0, help="of the source, mm")
    parser.add_argument("--centre", type=float, nargs="+", default=[5.0, 7.5], help="centre frequency, MHz")
    parser.add_argument("--snr", type=float, default=15.0, help="of the loudest element in the plane, dB")
    parser.add_argument("--angles", type=float, nargs="+", default=[1.0, 2.0, 4.0, 6.7], help="delta, arc angle, deg")
    parser.add_argument("--waveform", choices=UNKNOWN_PULSE, nargs="+", default=["known", "pm", "any"])
    parser.add_argument("--bound", type=float, help="rotation known to this, deg: what the registration gains")
    parser.add_argument("--sessions", type=int, default=60, help="of --bound")
    args = parser.parse_args()
    if args.bound is not None:
        print("| noise | sweeps | bound, mm | with the rotation known |\n| --- | --- | ---: | ---: |")
        for noise in NOISES:
            for sweep in SWEEPS:
                without, besides = (least_mm(sweep, noise, args.sessions, known) for known in (None, args.bound))
                print(f"| {noise} | {sweep} | {without:.2f} | {besides:.2f} |", flush=True)
        return
    arc = (PROBE.radius_mm + args.range) / args.range
    window, hit = 6.0 / math.sqrt(3.0) * arc, math.hypot(2.0 / math.sqrt(12.0), 0.4) * arc
    print(f"without: window {window:.1f} deg, first hit {hit:.1f} deg (1 sigma, arc angle)")
    heads = ["element, mm", "MHz", "waveform", *(f"{angle:g} deg: sigma (level)" for angle in args.angles)]
    print("| " + " | ".join(heads) + " |\n|" + " ---: |" * len(heads))
    for height in args.heights:
        for centre in args.centre:
            for waveform in args.waveform:
                found = [
                    sigma_deg(height, args.focus, centre, args.range, args.snr, angle, waveform)
                    for angle in args.angles
                ]
                cells = [f"{height:g}", f"{centre:g}", waveform, *(f"{s:.2g} ({db:.0f} dB)" for s, db in found)]
                print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
