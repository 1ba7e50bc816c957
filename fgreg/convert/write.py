"""Write events and frames of a recording as a checked session, whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from fgreg.convert.drafts import Draft, Imported
from fgreg.errors import InputError, one_line
from fgreg.model.camera_model import STEREO_RIG, StereoRig
from fgreg.output.session_folder import new_session
from fgreg.schema.limits import EVENT_LINES, SETUP_BYTES
from fgreg.schema.yaml_writer import one_line_yaml
from fgreg.session.event_reader import ShotsSeen, frames_of, read_line
from fgreg.session.event_writer import event_line
from fgreg.session.frame_files import FrameUse, check_frames
from fgreg.session.rig_file import copy_rig
from fgreg.session.session_reader import EVENTS_FILE, SETUP_FILE, check_session
from fgreg.session.setup_reader import Setup, read_setup
from fgreg.session.yaml_loader import load_yaml, read_bounded

MOST_SAID = 20
"""Sentences about what was left out, in the terminal and in the session's first note."""


@dataclass(frozen=True, slots=True)
class Written:
    """Result of a conversion: number of events by type and of frames; sentences on what was left out or is doubtful."""

    events: Mapping[str, int]
    frames: int
    left_out: tuple[str, ...]
    warnings: tuple[str, ...]


def write_session(
    imported: Imported,
    setup: Path,
    out: Path,
    *,
    rig: StereoRig | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Written:
    """Write a session folder.

    Args:
        imported: the recording.
        setup: a ``session.yaml``, or a folder with one. It is copied unchanged.
        out: the folder.
        rig: the endoscope's calibration, where the setup has none.
        overwrite: replace an existing session.
        progress: called with (events done, events) after each.

    Raises:
        InputError: an event that the format does not allow, with its place in the recording; nothing is written.
    """
    if not imported.drafts:
        why = f"; {imported.left_out[0]}" if imported.left_out else ""
        raise InputError(imported.source, f"no events{why}", "at least one")
    if len(imported.drafts) >= EVENT_LINES:
        raise InputError(imported.source, f"{len(imported.drafts)} events", f"fewer than {EVENT_LINES}: a part of it")
    file = setup / SETUP_FILE if setup.is_dir() else setup
    text = read_bounded(file, str(file), SETUP_BYTES).decode("utf-8", errors="replace")
    rig = rig or imported.rig
    if rig is not None and "camera" not in load_yaml(file, str(file)):
        text = text.rstrip("\n") + "\n" + camera_yaml(rig)
    with new_session(out, overwrite=overwrite) as folder:
        (folder / SETUP_FILE).write_text(text, encoding="utf-8")
        read = _read_setup(folder / SETUP_FILE, str(file), out.resolve().name, file.parent.resolve())
        if read.model is not None and read.model.rig_file is not None:
            copy_rig(read.model.rig_file, folder / read.model.rig_file.relative_to(file.parent.resolve()))
        if read.probe is not None:
            if imported.images is not None:
                imported.images.check(read.probe)
            for declared in imported.declared:
                imported.told += declared.check(read.probe)
        imported.write_frames(folder)
        lines, frames = _lines(imported.drafts, folder, read, progress)
        note = {"type": "note", "t": imported.drafts[0].t, "text": _summary(imported)}
        (folder / EVENTS_FILE).write_bytes(b"".join([event_line(note, "note"), *lines]))
        problems, warnings = check_session(folder)
        if problems:
            raise problems[0]
    counts: dict[str, int] = {}
    for draft in imported.drafts:
        kind = str(draft.document["type"])
        counts[kind] = counts.get(kind, 0) + 1
    return Written(counts, frames, tuple(imported.left_out), (*imported.told, *warnings))


def _summary(imported: Imported) -> str:
    """Text of the first note: source of the session, what was taken for granted, and what was left out."""
    said = [*imported.told, *imported.left_out]
    missing = "; ".join(one_line(reason, 200) for reason in said[:MOST_SAID])
    more = len(said) - MOST_SAID
    tail = f" and {more} more" if more > 0 else ""
    return f"converted from {one_line(imported.source, 300)}" + (f"; {missing}{tail}" if missing else "")


def _read_setup(path: Path, name: str, session: str, source: Path) -> Setup:
    """The set-up at ``path``, copied from the folder ``source``, in which its rig is."""
    problems: list[InputError] = []
    found = read_setup(load_yaml(path, name), name, session or "session", problems, source)
    if problems:
        raise problems[0]
    return found


def _lines(
    drafts: list[Draft], folder: Path, setup: Setup, progress: Callable[[int, int], None] | None
) -> tuple[list[bytes], int]:
    """The events' lines, each checked by reading it back, and the number of frames."""
    out: list[bytes] = []
    uses: dict[Path, FrameUse] = {}
    seen = ShotsSeen()
    for draft in drafts:
        line = event_line(draft.document, draft.where)
        read = read_line(line, len(out) + 2, EVENTS_FILE, folder.resolve(), setup, seen)
        if read.event is None:
            problem = read.problems[0]
            raise InputError(_place(draft, problem), problem.found, problem.expected)
        seen.add(read.event)
        out.append(line)
        size = None if setup.camera is None else setup.camera.left.image_size
        uses_here = frames_of(read.event, EVENTS_FILE, folder.resolve())
        fresh = [use for use in uses_here if use.path not in uses]
        if wrong := check_frames(fresh, setup.probe, size):
            raise InputError(_place(draft, wrong[0]), wrong[0].found, wrong[0].expected)
        uses |= {use.path: use for use in fresh}
        if progress is not None:
            progress(len(out), len(drafts))
    return out, len(uses)


def _place(draft: Draft, problem: InputError) -> str:
    """The place of a problem in the recording, in place of the line in events.jsonl."""
    inner = problem.where.split(": ", 2)
    return f"{draft.where}: {inner[2]}" if len(inner) == 3 else draft.where


def camera_yaml(rig: StereoRig) -> str:
    """The ``camera`` section of a ``session.yaml``."""
    section = STEREO_RIG.write(rig)
    return "".join(["camera:\n", *(f"  {key}: {one_line_yaml(value)}\n" for key, value in section.items())])
