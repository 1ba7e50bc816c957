"""Results as files that other programs read: PLUS, ROS 2, 3D Slicer, and JSON.

The transform is always ``trus_T_camera``, which maps camera coordinates to TRUS coordinates; each program has its own
convention:

- PLUS: ``<Transform From="Camera" To="Trus" Matrix=...>``, millimetres, rows one after another.
- ROS 2: a ``TransformStamped`` with the target as ``header.frame_id`` and the source as ``child_frame_id``, metres.
- Slicer: a node ``CameraToTrus`` whose matrix *to its parent* is ``trus_T_camera`` in RAS coordinates, as sent by
  OpenIGTLink. An ITK transform file holds the *resampling* direction, parent to node, in LPS: ``F inverse(M) F``
  with ``F = diag(-1, -1, 1)``.
- JSON: with the covariance, the verdict and its reasons.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from fgreg.errors import InputError, one_line
from fgreg.geometry.quaternions import quaternion_from_rotation
from fgreg.geometry.transforms import FloatArray, inverse
from fgreg.model.estimate import SessionEstimate, Verdict
from fgreg.output.atomic_file import FileKind
from fgreg.version import __version__

JSON_FORMAT = "fgreg-transform/1"
_PLUS_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<PlusConfiguration version="2.9">\n'
_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Exported:
    """One epoch of a result for export.

    Attributes:
        session: its name.
        epoch: index.
        verdict: the worse of the result's and the epoch's.
        reasons: plain sentences.
        trus_T_camera: (4, 4), mm.
        covariance: (6, 6) right tangent, or None.
        tre_mm: predicted error at the targets, mean and 95 % at the worst one; None where there is none.
        solved: when the result was written.
        stale: that the session has changed since; empty where it has not.
    """

    session: str
    epoch: int
    verdict: Verdict
    reasons: tuple[str, ...]
    trus_T_camera: FloatArray
    covariance: FloatArray | None
    tre_mm: tuple[float, float] | None
    solved: datetime
    stale: str = ""

    @property
    def refused(self) -> bool:
        """Whether the verdict is refused, so that the registration must not be used."""
        return self.verdict is Verdict.REFUSED

    @property
    def warning_lines(self) -> list[str]:
        """Warning at the top of the file: stale, verdict and reasons; empty where the verdict is ``ok``."""
        if self.stale:
            return [f"STALE, exported with --force: {self.stale}", *replace(self, stale="").warning_lines]
        if self.verdict is Verdict.OK:
            return []
        forced = "REFUSED by fgreg, exported with --force: DO NOT USE for navigation"
        heading = forced if self.refused else "verdict: warning"
        return [heading, *(one_line(reason, 300) for reason in self.reasons)]


def registration_of(
    estimate: SessionEstimate, path: Path, *, epoch: int | None = None, force: bool = False, stale: str = ""
) -> Exported:
    """The epoch of a result for export.

    Args:
        estimate: the result in ``path``.
        path: the result's file; its time of change becomes ``solved``.
        epoch: index; None: the last one.
        force: export also where the verdict is ``refused``, or the result is stale.
        stale: why it is; empty where it is not.

    Raises:
        InputError: no such epoch, no transform in it, or refused or stale without ``force``.
    """
    if stale and not force:
        raise InputError(path.name, stale, "one of the session as it is (fgreg solve), or --force to export it")
    known = {entry.index: entry for entry in estimate.epochs}
    if not known:
        raise InputError(f"{path.name}: epochs", "none", "a result with at least one")
    chosen = known.get(max(known) if epoch is None else epoch)
    if chosen is None:
        raise InputError("--epoch", str(epoch), f"one of {', '.join(str(index) for index in sorted(known))}")
    order = [Verdict.OK, Verdict.WARNING, Verdict.REFUSED]
    verdict = max(estimate.verdict, chosen.verdict, key=order.index)
    where = f"{path.name}: epoch {chosen.index}"
    if verdict is Verdict.REFUSED and not force:
        why = f" ({one_line(estimate.reasons[0], 160)})" if estimate.reasons else ""
        raise InputError(where, f"the verdict refused{why}", "ok or warning, or --force to export it")
    if chosen.trus_T_camera is None:
        raise InputError(where, "no transform", "one that could be computed")
    tre = chosen.predicted_tre
    return Exported(
        session=estimate.session,
        epoch=chosen.index,
        verdict=verdict,
        reasons=estimate.reasons,
        trus_T_camera=chosen.trus_T_camera,
        covariance=chosen.covariance,
        tre_mm=None if tre is None else (tre.mean_mm, tre.worst_mm),
        solved=datetime.fromtimestamp(path.stat().st_mtime, UTC).replace(microsecond=0),
        stale=stale,
    )


def plus_xml(found: Exported) -> str:
    """A PLUS configuration with the transform; ``Error`` is the mean predicted error at the session's targets, mm."""
    error = "" if found.tre_mm is None else f' Error="{found.tre_mm[0]:.3f}"'
    matrix = " ".join(_number(value) for value in found.trus_T_camera.ravel())
    notes = [f"Registration of session {found.session}, epoch {found.epoch}, by fgreg {__version__}; mm"]
    comments = "".join(f"  <!-- {_comment(line)} -->\n" for line in [*notes, *found.warning_lines])
    return (
        f"{_PLUS_HEAD}{comments}  <CoordinateDefinitions>\n"
        f'    <Transform From="Camera" To="Trus" Matrix={quoteattr(matrix)}{error}'
        f' Date="{found.solved:%Y.%m.%d %H:%M:%S}" />\n'
        "  </CoordinateDefinitions>\n</PlusConfiguration>\n"
    )


def ros_yaml(found: Exported) -> str:
    """A ``geometry_msgs/TransformStamped``: metres, unit quaternion, the target frame as parent."""
    x, y, z = (float(value) / 1000.0 for value in found.trus_T_camera[:3, 3])
    qx, qy, qz, qw = quaternion_from_rotation(found.trus_T_camera[:3, :3])
    numbers = f"--x {x:.9f} --y {y:.9f} --z {z:.9f} --qx {qx:.12f} --qy {qy:.12f} --qz {qz:.12f} --qw {qw:.12f}"
    lines = [
        *(f"# {line}" for line in found.warning_lines),
        f"# {one_line(found.session)}, epoch {found.epoch}, solved {_iso(found.solved)}, fgreg {__version__}",
        f"# ros2 run tf2_ros static_transform_publisher {numbers} --frame-id trus --child-frame-id camera",
        "header:",
        f"  stamp: {{sec: {int(found.solved.timestamp())}, nanosec: 0}}",
        "  frame_id: trus",
        "child_frame_id: camera",
        "transform:",
        f"  translation: {{x: {x:.9f}, y: {y:.9f}, z: {z:.9f}}}",
        f"  rotation: {{x: {qx:.12f}, y: {qy:.12f}, z: {qz:.12f}, w: {qw:.12f}}}",
    ]
    return "\n".join(lines) + "\n"


def slicer_tfm(found: Exported) -> str:
    """An ITK transform file; Slicer shows it as a linear transform from Camera to Trus."""
    stored = _LPS @ inverse(found.trus_T_camera) @ _LPS
    parameters = [*stored[:3, :3].ravel(), *stored[:3, 3]]
    notes = [f"fgreg {__version__}: session {one_line(found.session)}, epoch {found.epoch}: CameraToTrus, mm"]
    return "\n".join(
        [
            "#Insight Transform File V1.0",
            *(f"# {line}" for line in [*notes, *found.warning_lines]),
            "#Transform 0",
            "Transform: AffineTransform_double_3_3",
            "Parameters: " + " ".join(_number(value) for value in parameters),
            "FixedParameters: 0 0 0",
            "",
        ]
    )


def as_json(found: Exported) -> str:
    """The registration with covariance, verdict and predicted error as JSON, units in the names."""
    document: dict[str, Any] = {
        "format": JSON_FORMAT,
        "fgreg": __version__,
        "session": found.session,
        "epoch": found.epoch,
        "solved": _iso(found.solved),
        "verdict": found.verdict.value,
        "reasons": [*([found.stale] if found.stale else []), *found.reasons],
        "forced": found.refused or bool(found.stale),
        "from": "camera",
        "to": "trus",
        "trus_T_camera": found.trus_T_camera.tolist(),
        "covariance": None if found.covariance is None else found.covariance.tolist(),
        "predicted_tre_mm": None if found.tre_mm is None else {"mean": found.tre_mm[0], "worst": found.tre_mm[1]},
    }
    return json.dumps(document, indent=2) + "\n"


_PLUS = FileKind("a PLUS file of fgreg", (_PLUS_HEAD.encode() + b"  <!-- Registration of session ",))
_ROS = FileKind("a ROS file of fgreg", (b"# ",), (b", fgreg ", b"\n# ros2 run tf2_ros static_transform_publisher "))
_SLICER = FileKind("a transform file of fgreg", (b"#Insight Transform File V1.0\n# fgreg ",))
_JSON = FileKind("a JSON file of fgreg", (f'{{\n  "format": "{JSON_FORMAT}",\n  "fgreg": '.encode(),))

WRITERS: dict[str, tuple[Callable[[Exported], str], FileKind]] = {
    ".xml": (plus_xml, _PLUS),
    ".yaml": (ros_yaml, _ROS),
    ".yml": (ros_yaml, _ROS),
    ".tfm": (slicer_tfm, _SLICER),
    ".txt": (slicer_tfm, _SLICER),
    ".json": (as_json, _JSON),
}
"""The writer of each file suffix, and how its older files are told."""


def _iso(moment: datetime) -> str:
    return f"{moment:%Y-%m-%dT%H:%M:%SZ}"


def _number(value: float) -> str:
    return repr(float(value))


def _comment(text: str) -> str:
    """A text inside an XML comment, which must not hold two hyphens or end with one."""
    return one_line(text).replace("--", "- -").rstrip("-")
