"""OpenIGTLink messages of a registration.

| message | device | when | content |
|---|---|---|---|
| STATUS | `RegistrationStatus` | usable; once refused | code 1, `OK` or `WARNING`; code 13, `REFUSED`; the reasons |
| STRING | `RegistrationVerdict` | always | JSON: `verdict`, `reasons`, `stage_deg`, `plane_deg`, `sigma_deg` or null |
| TRANSFORM | `CameraToTrus` | usable | maps camera points to TRUS points, mm; metadata below |
| TRANSFORM | `PlaneToTrus` | usable, angle known | the image plane (its z axis) turned to where the beam points |

**Refused means no TRANSFORM at all.** 3D Slicer puts the matrix of every TRANSFORM into its node, whatever the status
in the metadata, so a matrix that must not be used must not be sent; PLUS with `SendValidTransformsOnly` does the same.
Receivers keep the last valid matrix meanwhile.

SlicerIGT's Watchdog takes a node for valid as long as it was modified within a tolerance (1 s unless set otherwise).
Slicer modifies a node at every message of its name, whatever the message says. So a refusal is said in STATUS only for
``REFUSED_SAID_S`` after the registration became refused, and to receivers that come later: then `RegistrationStatus`,
like `CameraToTrus`, is modified while the registration is usable, and goes stale when it is not. The STRING is always
sent.

Metadata (header version 2 only): `TransformStatus`, the key that PLUS reads and Slicer hands on (`OK`; `INVALID` on the
STATUS and STRING of a refused registration), `Verdict`, `Reasons`, and for a transform `Covariance` (36 numbers, row by
row, rad and mm, over the right tangent: rotation, then translation) with `CovarianceFrame`; `StageDeg`, `PlaneDeg`,
`SigmaDeg`. `stage_deg` is the stage's reading, with its own zero and direction as in result files, at which the beam
is in the plane; `plane_deg` is the plane's angle there in the TRUS frame, (0, sin, cos).
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import numpy as np

from fgreg.drivers.base import Registration
from fgreg.drivers.igtl_contents import Status
from fgreg.drivers.igtl_messages import (
    STATUS_NOT_READY,
    STATUS_OK,
    check_name,
    pack_status,
    pack_text,
    pack_transform,
)
from fgreg.geometry.transforms import FloatArray, exp_so3, is_rigid, make_transform

USABLE = ("ok", "warning")
TEXT_CHARACTERS = 4000
"""Reasons are cut to this length, since a receiver shows them in one line."""
REFUSED_SAID_S = 0.5
"""For this long after a registration became refused its STATUS is sent, so that none but a stuck receiver misses it."""
SUMMARY_BYTES = 60_000
"""Largest JSON text; a STRING holds 65,535 bytes."""


@dataclass(frozen=True, slots=True)
class DeviceNames:
    """Device names of the messages, each 1 to 20 ASCII characters. Raises InputError."""

    registration: str = "CameraToTrus"
    plane: str = "PlaneToTrus"
    status: str = "RegistrationStatus"
    verdict: str = "RegistrationVerdict"

    def __post_init__(self) -> None:
        for name in (self.registration, self.plane, self.status, self.verdict):
            check_name(name)


def trus_T_plane(scan_rad: float) -> FloatArray:
    """The image plane at a stage angle: turned about x so that its z axis is (0, sin t, cos t)."""
    return make_transform(exp_so3(np.array([-scan_rad, 0.0, 0.0])), np.zeros(3))


def usable_verdict(registration: Registration) -> tuple[str, tuple[str, ...]]:
    """The verdict, ``refused`` where there is no matrix or none that is rigid, and its reasons."""
    matrix, reasons = registration.trus_T_camera, registration.reasons
    if registration.verdict not in USABLE or matrix is None:
        return "refused", reasons
    if not (np.isfinite(matrix).all() and is_rigid(matrix)):
        return "refused", ("the transform is not rigid", *reasons)
    return registration.verdict, reasons


def registration_messages(
    registration: Registration, sent_s: float, names: DeviceNames, version: int = 2
) -> dict[tuple[str, str], bytes]:
    """All messages for one registration by type and device: STATUS first, no TRANSFORM where it is refused.

    Args:
        registration: without a matrix, or with one that is not rigid, it counts as refused.
        sent_s: of the data behind it, s since 1970.
        version: of the header; 1 for receivers of OpenIGTLink 1 and 2, without metadata.
    """
    verdict, reasons = usable_verdict(registration)
    usable, matrix = verdict in USABLE, registration.trus_T_camera
    text = "; ".join(reasons)[:TEXT_CHARACTERS]
    common = {"TransformStatus": "OK" if usable else "INVALID", "Verdict": verdict, "Reasons": text}
    status = Status(STATUS_OK if usable else STATUS_NOT_READY, 0, verdict.upper(), text)
    angles = angles_deg(registration) if usable else {}
    summary = verdict_text(verdict, angles, reasons)
    messages = {
        ("STATUS", names.status): pack_status(names.status, status, sent_s, common, version),
        ("STRING", names.verdict): pack_text(names.verdict, summary, sent_s, common, version),
    }
    if usable and matrix is not None:
        with_covariance = {**common, **_covariance(registration.covariance)}
        packed = pack_transform(names.registration, matrix, sent_s, with_covariance, version)
        messages["TRANSFORM", names.registration] = packed
        if registration.scan_rad is not None and "PlaneDeg" in angles:
            told_angles = {**common, **{key: f"{value:.6f}" for key, value in angles.items()}}
            plane = trus_T_plane(registration.scan_rad)
            messages["TRANSFORM", names.plane] = pack_transform(names.plane, plane, sent_s, told_angles, version)
    return messages


def verdict_text(verdict: str, angles: dict[str, float], reasons: tuple[str, ...]) -> str:
    """JSON text, ASCII, with as many reasons as fit."""
    cut = [reason[:TEXT_CHARACTERS] for reason in reasons]
    told = {f"{what.lower()}_deg": angles.get(f"{what}Deg") for what in ("Stage", "Plane", "Sigma")}
    while True:
        text = json.dumps({"verdict": verdict, **told, "reasons": cut})
        if len(text) <= SUMMARY_BYTES:
            return text
        cut.pop()


def angles_deg(registration: Registration) -> dict[str, float]:
    """``StageDeg``, ``PlaneDeg``, ``SigmaDeg``, as far as they are known."""
    given = {"StageDeg": registration.stage_rad, "PlaneDeg": registration.scan_rad, "SigmaDeg": registration.sigma_rad}
    return {key: math.degrees(value) for key, value in given.items() if value is not None and math.isfinite(value)}


def _covariance(covariance: FloatArray | None) -> dict[str, str]:
    if covariance is None:
        return {}
    numbers = " ".join(f"{value:.9g}" for value in np.asarray(covariance).ravel())
    return {"Covariance": numbers, "CovarianceFrame": "right tangent, rad and mm"}
