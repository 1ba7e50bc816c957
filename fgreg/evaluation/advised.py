"""The advice about the next shot as a table and as plain data."""

from __future__ import annotations

import math
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from fgreg.evaluation.export import plain
from fgreg.evaluation.tables import number
from fgreg.registration.next_shot import Advice, AdvisedLook, AdvisedShot

UPRIGHT_DEG = 1.0
"""Smaller tilts are not shown."""


def lean_in_words(shot: AdvisedShot) -> str:
    """Tilt of the beam from the mean beam, in the image, e.g. ``12 right, 6 up`` (degrees)."""
    right, down = math.degrees(shot.tilt_right_rad), math.degrees(shot.tilt_down_rad)
    words = []
    if abs(right) >= UPRIGHT_DEG:
        words.append(f"{abs(right):.0f} {'right' if right > 0 else 'left'}")
    if abs(down) >= UPRIGHT_DEG:
        words.append(f"{abs(down):.0f} {'down' if down > 0 else 'up'}")
    return ", ".join(words) or "as the mean"


def look_in_words(look: AdvisedLook) -> str:
    """Stage angle of the first detection and the sweep's direction, e.g. ``12.4 up`` (degrees)."""
    return f"{math.degrees(look.device_rad):.1f}{ {1: ' up', -1: ' down', 0: ''}[look.sweep] }"


def print_advice(name: str, advice: Advice, console: Console | None = None) -> None:
    """Print the advised shots as a table."""
    console = console or Console(highlight=False, emoji=False)
    page = Group(*_page(name, advice))
    if console.is_terminal:
        console.print(page)
        return
    with console.capture() as capture:
        console.print(page)
    console.file.write("".join(line.rstrip() + "\n" for line in capture.get().splitlines()))


def _page(name: str, advice: Advice) -> list[RenderableType]:
    shown = "".join(c if c.isprintable() else "?" for c in name)
    title = Text("Where the next shot helps most: ", style="bold").append(shown)
    now = f"{advice.pairs} pairs, predicted TRE {number(advice.expected_mm)} mm (mean over targets)"
    rival = any(shot.separation is not None for shot in advice.shots)
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim")
    columns = [
        ("", ""),
        ("spot", "camera, mm"),
        ("beam leans", "in the image, deg"),
        ("direction", "camera"),
        ("detected at", "stage, deg"),
        ("TRE then", "mm"),
        *([("tells apart", "chi square")] if rival else []),
    ]
    for heading, unit in columns:
        table.add_column(f"{heading}\n{unit}", justify="right", overflow="fold")
    for rank, shot in enumerate(advice.shots, 1):
        table.add_row(
            str(rank),
            " ".join(f"{v:.0f}" for v in shot.camera_p_spot_mm),
            lean_in_words(shot),
            " ".join(f"{v:.2f}" for v in shot.camera_d),
            "\n".join(look_in_words(look) for look in shot.looks),
            number(shot.expected_mm),
            *([number(shot.separation, 1)] if rival else []),
        )
    notes = [Text(f"  - {note}") for note in advice.notes]
    return [title, Text(f"  {now}"), *notes, Text(), Padding(table, (0, 0, 0, 2))]


def advice_dict(name: str, advice: Advice) -> dict[str, Any]:
    """The advice as plain types, for JSON."""
    out: dict[str, Any] = plain(
        {
            "session": name,
            "epoch": advice.epoch,
            "pairs": advice.pairs,
            "expected_tre_mm": advice.expected_mm,
            "notes": list(advice.notes),
            "candidates": len(advice.candidates.shots),
            "shots": [
                {
                    "camera_p_spot_mm": shot.camera_p_spot_mm,
                    "camera_d": shot.camera_d,
                    "tilt_right_deg": math.degrees(shot.tilt_right_rad),
                    "tilt_down_deg": math.degrees(shot.tilt_down_rad),
                    "trus_p_mm": shot.trus_p_mm,
                    "looks": [{"stage_deg": math.degrees(look.device_rad), "sweep": look.sweep} for look in shot.looks],
                    "expected_tre_mm": shot.expected_mm,
                    "separation_chi2": shot.separation,
                }
                for shot in advice.shots
            ],
        }
    )
    return out
