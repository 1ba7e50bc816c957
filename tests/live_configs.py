"""A complete, valid CONFIG.yaml of a live session as plain data, to write beside a session.yaml and to break."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from tests import session_files


def config() -> dict[str, Any]:
    """Every role; none of the devices exists."""
    return {
        "format": "fgreg-live/1",
        "session": "session.yaml",
        "camera": {"driver": "endoscope", "left": "/dev/video90", "right": 91, "fps": 25, "fourcc": "MJPG"},
        "photoacoustic": {"driver": "igtl", "host": "192.0.2.7", "port": 18944, "device": "Image_Pa"},
        "stage": {
            "driver": "thorlabs",
            "port": "/dev/ttyUSB9",
            "limits": {"sweep_deg": [-40, 30.5], "search_speed_deg_s": 20, "track_sigma_deg": 1.5},
        },
        "motion": {"driver": "igtl", "host": "192.0.2.7", "inverted": True, "silent_s": None},
        "bmode": {"driver": "bk", "host": "192.0.2.8", "rate_hz": 10},
        "sinks": [{"driver": "igtl"}, {"driver": "igtl", "listen": False, "port": 18946, "registration": "CamToTrus"}],
        "operator": [{"driver": "keyboard"}, {"driver": "igtl", "host": "192.0.2.9", "device": "FootSwitch"}],
        "settings": {"hearing_threshold": 12.5, "aims": 6, "pms": 5, "most_pms": 9, "limit_mm": 2.0},
    }


def room() -> dict[str, Any]:
    """The simulated room."""
    return {
        "format": "fgreg-live/1",
        "room": {"seed": 3, "width": 320},
        "camera": {"driver": "simulated"},
        "photoacoustic": {"driver": "simulated"},
        "stage": {"driver": "simulated"},
        "operator": {"driver": "simulated"},
        "settings": {"aims": 3},
    }


def write(folder: Path, data: Any = None, session: Any = None, name: str = "live.yaml") -> Path:
    """Writes the file and a session.yaml beside it; data, text or the valid ones."""
    session_files.write(folder, session)
    (folder / "events.jsonl").unlink()
    data = config() if data is None else data
    path = folder / name
    text = data if isinstance(data, str) else yaml.safe_dump(data, sort_keys=False)
    path.write_text(text, encoding="utf-8")
    return path
