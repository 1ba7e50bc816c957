"""What the rig's constants do to check points: both devices show a point where their constants have it.

A camera that is calibrated wrongly locates the check wrongly, and a scanner with another radius shows it elsewhere. The
constants' estimate moves the points; its covariance, joint with the registration's, is part of what is expected there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgreg.geometry.rig import CAMERA
from fgreg.geometry.transforms import FloatArray
from fgreg.graph.columns import Columns
from fgreg.graph.shared_state import SharedState
from fgreg.model.camera_dependence import nominal_point_gain
from fgreg.model.measurements import Check
from fgreg.model.scanner_dependence import scanner_gain
from fgreg.model.session_model import SessionModel
from fgreg.tracking.snapshot import Snapshot


@dataclass(frozen=True, slots=True, eq=False)
class RigAtChecks:
    """The K constants that are variables, in one camera epoch.

    Attributes:
        covariance: (6 + K, 6 + K) of the registration (right tangent) and the constants.
        value: (K,) their estimate.
    """

    model: SessionModel
    state: SharedState
    columns: Columns
    covariance: FloatArray
    value: FloatArray

    def seen(self, camera_p_mm: FloatArray) -> FloatArray:
        """(n, 3, K) by how much points (n, 3) truly lie elsewhere than the camera locates them; camera axes."""
        out = np.zeros((len(camera_p_mm), 3, len(self.columns.constants)))
        of_camera = self.columns.of_camera
        if of_camera:
            gain = nominal_point_gain(self.model, camera_p_mm)
            out[:, :, -len(of_camera) :] = gain[:, :, [constant - CAMERA.start for constant in of_camera]]
        return out

    def shown(self, trus_p_mm: FloatArray) -> FloatArray:
        """(n, 3, K) by how much points (n, 3) truly lie elsewhere than the scanner shows them; TRUS axes."""
        return scanner_gain(self.model.probe.radius_mm, trus_p_mm)[..., list(self.columns.constants)]


def rig_at_checks(model: SessionModel, snapshot: Snapshot | None, checks: Sequence[Check]) -> dict[int, RigAtChecks]:
    """The constants in each registered epoch that has checks, by its number."""
    found: dict[int, RigAtChecks] = {}
    for number in {check.epoch for check in checks} if snapshot is not None else ():
        epoch = snapshot.epoch(number) if snapshot is not None else None
        if snapshot is None or epoch is None or not epoch.covariance.any():
            continue
        state, columns, covariance = snapshot.shared(epoch)
        kept = np.r_[0:6, columns.first_constant : columns.size]
        value = state.constants[0, list(columns.constants)]
        found[number] = RigAtChecks(model, state, columns, covariance[np.ix_(kept, kept)], value)
    return found
