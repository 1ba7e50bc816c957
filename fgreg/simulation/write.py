"""Writes a simulated session as a folder in the session format."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from fgreg.output.session_folder import new_session
from fgreg.schema.yaml_writer import yaml_text
from fgreg.simulation.simulate import Frame, SimulatedSession

Progress = Callable[[int, int], None]
"""Called with the number of frames written so far and in all."""


def write_session(
    simulated: SimulatedSession, folder: Path, overwrite: bool = False, progress: Progress | None = None
) -> None:
    """Write ``session.yaml``, ``events.jsonl``, ``frames/`` and ``ground_truth.yaml``.

    The folder is complete or absent: it is written under another name beside it first. The bytes depend on the
    configuration and the seed only.

    Args:
        folder: made where it does not exist.
        overwrite: replace a folder that holds a session; otherwise the folder has to be new or empty.
        progress: called after each frame.

    Raises:
        InputError: as :func:`fgreg.output.session_folder.new_session`.
    """
    with new_session(folder, overwrite=overwrite) as part:
        (part / "session.yaml").write_text(yaml_text(simulated.session), encoding="utf-8")
        lines = [json.dumps(event, separators=(", ", ": ")) + "\n" for event in simulated.events]
        (part / "events.jsonl").write_text("".join(lines), encoding="utf-8")
        (part / "ground_truth.yaml").write_text(yaml_text(simulated.truth), encoding="utf-8")
        for done, (name, frame) in enumerate(simulated.frames.items(), start=1):
            path = part / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(encoded(name, frame()))
            if progress is not None:
                progress(done, len(simulated.frames))


def encoded(name: str, frame: Frame) -> bytes:
    """The bytes of a frame's file: PNG for images, NPY for channel data.

    Raises:
        ValueError: its name is neither.
    """
    if name.endswith(".png"):
        done, data = cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 7])
        if not done:
            raise ValueError(f"{name} could not be encoded")
        return data.tobytes()
    if name.endswith(".npy"):
        buffer = io.BytesIO()
        np.save(buffer, np.ascontiguousarray(frame), allow_pickle=False)
        return buffer.getvalue()
    raise ValueError(f"{name} is neither .png nor .npy")
