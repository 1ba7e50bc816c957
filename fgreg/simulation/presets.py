"""Ready-made configurations, by the name that the command line takes."""

from __future__ import annotations

from dataclasses import replace

from fgreg.model.probe_model import ChannelModel, ImageModel
from fgreg.model.session_model import BoardModel, CharucoModel, NoiseModel
from fgreg.simulation.config import SimulationConfig, Sweep, default_probe, default_rig
from fgreg.simulation.disturbances import Disturbances

_CHANNELS = ChannelModel(sampling_mhz=40.0, t0_us=13.0, pulse_delay_us=0.4)

PHANTOM = SimulationConfig(
    name="phantom",
    frames=True,
    aims=14,
    pairs=15,
    tracks_heard=2,
    tracks_silent=2,
    noise=NoiseModel(aim_mm=(0.3, 0.3, 0.1)),
    probe=default_probe(_CHANNELS),
    samples=1160,
)
"""Raw frames: 14 aims at a ChArUco board, 15 PMs found by sweeps from either side, 4 tracks, 15 dB."""

PAPER = SimulationConfig(
    name="paper",
    aims=12,
    pairs=10,
    tracks_heard=3,
    tracks_silent=3,
    sweep=Sweep.WINDOW,
    noise=NoiseModel(marker_bias_mm=0.1),
)
"""Poses, with the published noise: marker bias 0.1 mm, sigmas 0.1, 0.1, 0.8 mm and 0.01 rad, aim 1 mm; window only."""

FIRST_HIT = SimulationConfig(name="first-hit", aims=12, pairs=15, tracks_heard=2, tracks_silent=2)
"""Poses; each PM found by stepping from alternating sides up to the first detection."""

RAW_SMALL = replace(
    PHANTOM,
    name="raw-small",
    aims=6,
    pairs=6,
    tracks_heard=1,
    tracks_silent=1,
    camera=default_rig(800),
    board=BoardModel(6, 4, 13.0, CharucoModel("DICT_5X5_100", 9.75)),
)
"""Raw frames, few and small."""

THEATRE = replace(
    PHANTOM,
    name="theatre",
    optics=replace(PHANTOM.optics, colour=True, white_level=200.0),
    disturbances=Disturbances(
        drawn=True,
        smoke=0.2,
        blood=1,
        drops=0.5,
        specular=1.0,
        specks=1,
        hand_mm_s=5.0,
        shutter_ms=8.0,
        field_hz=50.0,
        video_curve=True,
        jpeg_quality=80,
    ),
)
"""The phantom's shots as a theatre shows them: in colour, with smoke, blood, drops, wet tissue, a hand that is not
quite still, interlaced video and MJPEG."""

PRESETS: dict[str, SimulationConfig] = {
    "phantom": PHANTOM,
    "theatre": THEATRE,
    "paper": PAPER,
    "first-hit": FIRST_HIT,
    "one-way": replace(FIRST_HIT, name="one-way", sweep=Sweep.ONE_WAY),
    "camera-move": replace(FIRST_HIT, name="camera-move", pairs=24, epochs=2, tracks_heard=2, tracks_silent=2),
    "many-looks": replace(PAPER, name="many-looks", looks_per_pm=4, amplitudes=True),
    "raw-small": RAW_SMALL,
    "log-images": replace(
        RAW_SMALL,
        name="log-images",
        probe=replace(default_probe(), image=ImageModel((0.1, 0.2), (5.0, -25.5), log_db=60.0)),
        snr_db=25.0,
    ),
}
