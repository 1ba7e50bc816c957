"""The simulated operating room as something to conduct a session with: what ``fgreg live`` runs without a CONFIG."""

from __future__ import annotations

import math
import os
from contextlib import ExitStack
from functools import partial

from fgreg.drivers.simulated import RoomProcess, SimulatedCamera, SimulatedOperator, SimulatedProbe, ask_truth
from fgreg.models import SessionModel
from fgreg.operation.conductor import ConductorSettings
from fgreg.operation.loop import Devices
from fgreg.operation.room_truth import write_room_truth
from fgreg.operation.start import LiveSetup, StageSetup, setup_text
from fgreg.simulation.documents import session_document
from fgreg.simulation.room import BUMP_EVERY_S, room_config

HEARING_THRESHOLD = 20.0
"""Amplitude in the room's units: well above what its noise makes, half of what is heard at the window's edge."""
SPEED_RAD_S = math.radians(20.0)


def simulated_room(
    stack: ExitStack, seed: int = 1, aims: int = 8, bump_every_s: float = BUMP_EVERY_S, width_px: int = 640
) -> LiveSetup:
    """A room that runs until the stack is left.

    Args:
        stack: ends the room's process.
        seed: of everything random in it.
        aims: calibration shots before the surgeon turns to the tissue.
        bump_every_s: mean time between moves of the camera.
        width_px: of its images.

    Raises:
        FgregError: it did not start.
    """
    room = stack.enter_context(RoomProcess(seed, width_px, aims, bump_every_s))

    def open_devices(devices: ExitStack, _model: SessionModel) -> Devices:
        found = Devices(SimulatedCamera(room.path), SimulatedProbe(room.path), SimulatedOperator(room.path))
        for device in found.roles().values():
            devices.callback(device.close)
        return found

    document = session_document(room_config(seed, width_px, aims=aims, bump_every_s=bump_every_s).scene)
    stage = StageSetup(
        "fgreg.drivers.simulated:open_stage",
        {"path": os.fspath(room.path)},
        {"search_speed": SPEED_RAD_S, "track_speed": SPEED_RAD_S, "home_speed": SPEED_RAD_S},
    )
    settings = ConductorSettings(aims=aims, hearing_threshold=HEARING_THRESHOLD)
    truth = partial(write_room_truth, partial(ask_truth, room.path))
    return LiveSetup(setup_text(document), open_devices, stage, settings, truth)
