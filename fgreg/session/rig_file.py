"""``rig.yaml``: reading, writing, and whether a session has the rig that it describes."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from fgreg.errors import InputError
from fgreg.model.commissioned_rig import RIG, SHARED_SECTIONS, CommissionedRig
from fgreg.model.session_model import SESSION, SessionModel
from fgreg.output.atomic_file import FileKind, why_refused, write_file
from fgreg.schema.problems import FieldError, input_error
from fgreg.schema.yaml_writer import yaml_text
from fgreg.session.file_hash import file_hash
from fgreg.session.yaml_loader import load_yaml

RIG_FILE = FileKind("a commissioned rig", (b"format: fgreg-rig/",))
_ABSENT = ""


def read_rig(path: Path, label: str | None = None) -> CommissionedRig:
    """Read a rig; ``label``: how messages name the file.

    Raises:
        InputError: the first problem of the file.
    """
    label = label or str(path)
    data = load_yaml(path, label)
    try:
        rig: CommissionedRig = RIG.read(data)
    except FieldError as error:
        raise input_error(error.problems[0], label, data) from None
    return rig


def write_rig(rig: CommissionedRig, path: Path) -> None:
    """Write a rig, replacing an older one when it is complete.

    Raises:
        InputError: the file cannot be written, or there is another file.
    """
    document = RIG.write(rig)
    write_file(path, f"format: {document.pop('format')}\n" + yaml_text(document, {"sessions"}), RIG_FILE)


def copy_rig(rig_file: Path, target: Path) -> None:
    """Copy a session's rig into another session's folder.

    Raises:
        InputError: it cannot be copied.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(rig_file, target)
    except OSError as error:
        raise InputError(str(rig_file), f"a file that cannot be copied ({why_refused(error)})", "a rig") from None


def sections(model: SessionModel) -> dict[str, object]:
    """The sections of a session's file as plain data, without the rig that it takes up."""
    return SESSION.write(replace(model, rig_file=None))


def section_hashes(model: SessionModel) -> dict[str, str]:
    """SHA-256 of the sections that a rig's values are deviations from; a session may lack some."""
    document = sections(model)
    return {
        name: hashlib.sha256(json.dumps(document[name], sort_keys=True).encode()).hexdigest()
        for name in SHARED_SECTIONS
        if name in document
    }


def not_made_from(rig: CommissionedRig, events: Path, label: str) -> None:
    """Whether a session may take up, or be compared with, a rig: its shots would count twice if it is part of it.

    Args:
        rig: commissioned.
        events: the session's ``events.jsonl``; without any it is part of no rig.
        label: what messages name.

    Raises:
        InputError: the rig was made from the session.
    """
    if events.is_file() and file_hash(events) in [session.get(events.name) for session in rig.sessions]:
        expected = "one of other sessions: its shots would count twice"
        raise InputError(label, "a rig that was made from this session", expected)


def same_rig(model: SessionModel, others: Iterable[Mapping[str, str]], label: str) -> None:
    """Whether a session has the same probe, cameras and prints as the sessions of a rig.

    A board may be absent: only aims need it. Files' hashes alone, without those of sections, are not compared.

    Args:
        model: of the session.
        others: hashes of sections, as :func:`section_hashes` has them.
        label: how messages name the session's file.

    Raises:
        InputError: a section differs.
    """
    mine = section_hashes(model)
    for other in others:
        if "probe" not in other:
            continue
        for name in SHARED_SECTIONS:
            here, there = mine.get(name, _ABSENT), other.get(name, _ABSENT)
            if here != there and not (name == "board" and _ABSENT in (here, there)):
                found = "nothing" if here == _ABSENT else "another one"
                expected = "none" if there == _ABSENT else "the same as in the sessions that the rig is of"
                raise InputError(f"{label}: {name}", found, expected)
