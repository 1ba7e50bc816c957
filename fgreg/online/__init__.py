"""Registration while the session goes on: events in, estimates out, by incremental smoothing (iSAM2)."""

from fgreg.online.engine import OnlineRegistration
from fgreg.online.estimate import OnlineEstimate
from fgreg.online.events import CameraMoved, OnlineEvent, StaticTags

__all__ = ["CameraMoved", "OnlineEstimate", "OnlineEvent", "OnlineRegistration", "StaticTags"]
