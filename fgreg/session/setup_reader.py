"""Reads ``session.yaml``, the set-up of a session, described by fgreg.model.session_model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

from fgreg.errors import InputError
from fgreg.model.camera_model import StereoRig
from fgreg.model.plausible import implausible, implausible_rig, implausible_setup
from fgreg.model.probe_model import ProbeModel
from fgreg.model.session_model import NAME, SESSION, BoardModel, MarkerModel, SessionModel
from fgreg.schema.problems import FieldError, Problem, input_error
from fgreg.session.rig_file import read_rig, same_rig

Part = TypeVar("Part")


@dataclass(frozen=True, slots=True)
class Setup:
    """Contents of ``session.yaml``: the model where all of it is valid, else the valid parts.

    ``present`` holds the dotted names of all sections in the file, valid or not, so that an error inside a section is
    not reported again for every event that needs it.
    """

    model: SessionModel | None
    present: frozenset[str]
    probe: ProbeModel | None
    camera: StereoRig | None
    board: BoardModel | None
    warnings: tuple[str, ...]


def read_setup(
    data: Mapping[str, object], file: str, default_name: str, problems: list[InputError], folder: Path | None = None
) -> Setup:
    """Check a ``session.yaml``; appends all problems to ``problems``.

    Args:
        data: its content.
        file: how messages name the file.
        default_name: the session's name where the file has none.
        folder: the session's, resolved, in which the commissioned rig is; None: the rig is not read.
    """
    model, found, parts = None, list[Problem](), dict[str, object]()
    try:
        given = {} if "name" in data else {"name": NAME.read(default_name)}
        model = SESSION.read(data, folder or Path.cwd(), **given)
    except FieldError as error:
        found, parts = list(error.problems), error.values
    problems += [input_error(problem, file, data) for problem in found]
    if model is not None and model.rig_file is not None and folder is not None:
        try:
            rig = read_rig(model.rig_file, model.rig_file.relative_to(folder).as_posix())
            same_rig(model, rig.sessions, file)
            model = replace(model, rig=rig)
        except InputError as error:
            problems.append(error)

    def part(name: str, cls: type[Part]) -> Part | None:
        value = parts.get(name) if model is None else getattr(model, name)
        return value if isinstance(value, cls) else None

    probe, camera, board = part("probe", ProbeModel), part("camera", StereoRig), part("board", BoardModel)
    marker = part("marker", MarkerModel)
    doubts = implausible(*parts.values()) if model is None else implausible_setup(replace(model, rig=None))
    rig_file = "" if model is None or model.rig_file is None else model.rig_file.name
    of_rig = () if model is None or model.rig is None else tuple(implausible_rig(model.rig, rig_file))
    return Setup(
        model=model,
        present=_present(data) | {problem.meant for problem in found if problem.meant and len(problem.path) == 1},
        probe=probe,
        camera=camera,
        board=board,
        warnings=(*(f"{file}: {text}" for text in (*doubts, *_shared_ids(marker, board))), *of_rig),
    )


def _present(data: Mapping[str, object]) -> frozenset[str]:
    names = set(data)
    for section in ("probe", "camera"):
        inner = data.get(section)
        if isinstance(inner, Mapping):
            names |= {f"{section}.{key}" for key in inner}
    # An absent or invalid section is one problem, not another one for each event that needs a part of it.
    if not isinstance(data.get("probe"), Mapping):
        names.add("probe.channels")
    if not isinstance(data.get("camera"), Mapping):
        names.add("camera.right")
    return frozenset(names)


def _shared_ids(marker: MarkerModel | None, board: BoardModel | None) -> list[str]:
    """Whether a tag of the marker may be taken for one of the board."""
    if marker is None or board is None or board.charuco is None:
        return []
    if board.charuco.dictionary != marker.dictionary or all(tag.id >= board.markers for tag in marker.tags):
        return []
    return ["marker.tags share ids with the board: one may be taken for the other"]
