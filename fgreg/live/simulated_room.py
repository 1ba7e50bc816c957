"""Set-up of a live session in the simulated operating room, which ``fgreg live`` runs without a CONFIG."""

from __future__ import annotations

import math
import os
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from fgreg.drivers.simulated import (
    RoomProcess,
    SimulatedCamera,
    SimulatedOperator,
    SimulatedProbe,
    SimulatedScanner,
    ask_truth,
)
from fgreg.live.launch import LiveSetup, StageSetup, WriteTruth, setup_text
from fgreg.live.room_truth import write_room_truth
from fgreg.live.status import Devices
from fgreg.live.workflow import WorkflowSettings
from fgreg.model.session_model import SessionModel
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import BUMP_EVERY_S, RoomConfig, room_config

HEARING_THRESHOLD = 20.0
"""Amplitude in the room's units: well above the noise, and half the amplitude at the sensitivity window's edge."""
SPEED_RAD_S = math.radians(20.0)


def simulated_room(
    stack: ExitStack,
    seed: int = 1,
    aims: int = 8,
    bump_every_s: float = BUMP_EVERY_S,
    width_px: int = 640,
    *,
    static_tags: int = 0,
    seen: bool = True,
) -> LiveSetup:
    """A room that runs until the stack is left.

    Args:
        stack: ends the room's process.
        seed: of everything random in it.
        aims: calibration shots before the surgeon turns to the tissue.
        bump_every_s: mean time between moves of the camera.
        width_px: of its images.
        static_tags: beside the tissue.
        seen: whether pictures that are only displayed are wanted.

    Raises:
        FgregError: the room did not start.
    """
    room = stack.enter_context(RoomProcess(seed, width_px, aims, bump_every_s, static_tags=static_tags))
    config = room_config(seed, width_px, aims=aims, bump_every_s=bump_every_s, static_tags=static_tags)
    return room_setup(room.path, config, seen=seen)


def room_setup(path: Path, config: RoomConfig, *, seen: bool = False) -> LiveSetup:
    """Set-up of a session in the room whose socket is at ``path``; ``seen`` as in :func:`simulated_room`."""

    def open_devices(devices: ExitStack, _model: SessionModel) -> Devices:
        found = Devices(
            SimulatedCamera(path),
            SimulatedProbe(path),
            SimulatedOperator(path),
            bmode=SimulatedScanner(path) if seen else None,
        )
        for device in found.roles().values():
            devices.callback(device.close)
        return found

    document = session_document(config.scene)
    stage = StageSetup(
        "fgreg.drivers.simulated:open_stage",
        {"path": os.fspath(path)},
        {"search_speed_rad_s": SPEED_RAD_S, "track_speed_rad_s": SPEED_RAD_S, "home_speed_rad_s": SPEED_RAD_S},
    )
    return LiveSetup(
        setup_text(document),
        open_devices,
        stage,
        WorkflowSettings(aims=config.aims, hearing_threshold=HEARING_THRESHOLD),
        write_truth=room_truth(path),
    )


def room_truth(path: Path) -> WriteTruth:
    """Writer of the ground truth of a session in the room whose socket is at ``path``."""
    return partial(write_room_truth, partial(ask_truth, path))
