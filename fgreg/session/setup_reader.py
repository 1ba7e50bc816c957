"""Reads ``session.yaml``, the set-up of a session, described by fgreg.model.session_model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from fgreg.errors import InputError
from fgreg.model.session_model import NAME, SESSION, BoardModel, MarkerModel, ProbeModel, SessionModel, StereoRig
from fgreg.schema.problems import FieldError, Problem, input_error

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


def read_setup(data: Mapping[str, object], file: str, default_name: str, problems: list[InputError]) -> Setup:
    """Check a ``session.yaml``; appends all problems to ``problems``.

    Args:
        data: its content.
        file: how messages name the file.
        default_name: the session's name where the file has none.
    """
    model, found, parts = None, list[Problem](), dict[str, object]()
    try:
        given = {} if "name" in data else {"name": NAME.read(default_name)}
        model = SESSION.read(data, **given)
    except FieldError as error:
        found, parts = list(error.problems), error.values
    problems += [input_error(problem, file, data) for problem in found]

    def part(name: str, cls: type[Part]) -> Part | None:
        value = parts.get(name) if model is None else getattr(model, name)
        return value if isinstance(value, cls) else None

    probe, camera, board = part("probe", ProbeModel), part("camera", StereoRig), part("board", BoardModel)
    marker = part("marker", MarkerModel)
    return Setup(
        model=model,
        present=_present(data) | {problem.meant for problem in found if problem.meant and len(problem.path) == 1},
        probe=probe,
        camera=camera,
        board=board,
        warnings=tuple(_warnings(file, probe, camera, marker, board)),
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


def _warnings(
    file: str, probe: ProbeModel | None, camera: StereoRig | None, marker: MarkerModel | None, board: BoardModel | None
) -> list[str]:
    """Warnings about values that are allowed but implausible."""
    out = []
    if probe is not None and not 1300.0 <= probe.sound_speed_m_s <= 1700.0:
        out.append(
            f"{file}: probe.sound_speed_m_s is {probe.sound_speed_m_s:g}; in tissue and water it is 1300 to 1700"
        )
    for side in ("left", "right"):
        model = getattr(camera, side, None)
        if model is not None:
            (width, height), (cx, cy) = model.image_size, model.matrix[:2, 2]
            if not (0 <= cx <= width and 0 <= cy <= height):
                out.append(
                    f"{file}: camera.{side}.matrix has its centre ({cx:g}, {cy:g}) outside {width} x {height} px"
                )
    if marker is not None and board is not None and board.charuco is not None:
        on_board = board.markers
        if board.charuco.dictionary == marker.dictionary and any(tag.id < on_board for tag in marker.tags):
            out.append(f"{file}: marker.tags share ids with the board: one may be taken for the other")
    return out
