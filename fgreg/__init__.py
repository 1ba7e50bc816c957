"""fgreg: factor-graph registration of a stereo endoscope to a rotating TRUS probe.

The public names. Each is loaded when it is first used: ``import fgreg`` itself loads no library.
"""

from typing import TYPE_CHECKING, Any

from fgreg.version import __version__ as __version__

if TYPE_CHECKING:
    from fgreg.api import *  # noqa: F403

__all__ = [  # noqa: F405
    "Aim",
    "AimEvent",
    "CameraMoved",
    "CameraMovedEvent",
    "Check",
    "CheckEvent",
    "EpochEstimate",
    "EpochStart",
    "EventRefused",
    "ExcludeEvent",
    "FgregError",
    "IncludeEvent",
    "InputError",
    "JournalError",
    "KnownPoint",
    "LiveSession",
    "Look",
    "MarkerObservation",
    "MarkerRecord",
    "Measurements",
    "OnlineEstimate",
    "OnlineRegistration",
    "Pair",
    "PairEvent",
    "PointEvent",
    "Session",
    "SessionEstimate",
    "SessionModel",
    "SolveConfig",
    "SolveReport",
    "SpotRecord",
    "StaticTags",
    "Track",
    "TrackEstimate",
    "TrackEvent",
    "TrusRecord",
    "Verdict",
    "VerifyReport",
    "VisibleSpot",
    "picked_pm",
    "read_session",
    "replay",
    "solve",
    "solve_measurements",
    "verify",
]


if not TYPE_CHECKING:  # a type checker would take any name for one of the package's

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from fgreg import api

        value = globals()[name] = getattr(api, name)
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
