"""The null viewer, which takes the same calls and does nothing, and the choice between the two.

A run without a recording does not import Rerun or the code that draws.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from fgreg.geometry.transforms import FloatArray
    from fgreg.model.estimate import SessionEstimate
    from fgreg.model.measurements import Measurements, Track
    from fgreg.model.session_model import ProbeModel, SessionModel
    from fgreg.viewer.live import Moment
    from fgreg.viewer.recording import Viewer
    from fgreg.viewer.result import Truth
    from fgreg.viewer.scene import ShotKind
    from fgreg.viewer.shapes import Image8
    from fgreg.viewer.status_line import BmodePicture


class NullViewer:
    """Takes every call of :class:`fgreg.viewer.recording.Viewer` and does nothing, for runs without a recording."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing to close."""

    def session(self, model: SessionModel) -> None:
        """Nothing is drawn."""

    def shot_images(
        self,
        t: float,
        kind: ShotKind,
        index: int,
        left: Image8 | None,
        right: Image8 | None = None,
        marker_outlines_px: Iterable[FloatArray] | None = None,
        corner_px: FloatArray | None = None,
    ) -> None:
        """Nothing is drawn."""

    def pa_frame(
        self,
        t: float,
        index: int,
        frame: npt.NDArray[np.generic],
        x_mm: float | None,
        range_mm: float | None,
        covariance: FloatArray | None,
        probe: ProbeModel,
    ) -> None:
        """Nothing is drawn."""

    def bmode(self, t: float, index: int, picture: BmodePicture | None) -> None:
        """Nothing is drawn."""

    def moment(self, moment: Moment) -> None:
        """Nothing is drawn."""

    def result(
        self,
        model: SessionModel,
        measurements: Measurements,
        estimate: SessionEstimate,
        truth: Truth | None = None,
        tracks: Sequence[Track] = (),
    ) -> None:
        """Nothing is drawn."""


def open_viewer(rrd: Path | None, session_name: str, url: str | None = None) -> Viewer | NullViewer:
    """A viewer that records to ``rrd`` and shows in the running viewer at ``url``; the null viewer where both are None.

    Raises:
        InputError: the folder of ``rrd`` does not exist or cannot be written to, or ``rrd`` is a folder.
    """
    if rrd is None and url is None:
        return NullViewer()
    from fgreg.viewer.recording import Viewer

    return Viewer(rrd, session_name, url)
