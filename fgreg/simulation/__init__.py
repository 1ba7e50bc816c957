"""Forward model: sessions with known truth, camera images and channel data. Shares no code with the estimator.

``simulate(PRESETS["paper"], seed)`` gives a session in memory, ``write_session`` puts it in a folder.
"""

from fgreg.simulation.config import SimulationConfig, Sweep
from fgreg.simulation.presets import PRESETS
from fgreg.simulation.simulate import SimulatedSession, simulate
from fgreg.simulation.write import write_session

__all__ = ["PRESETS", "SimulatedSession", "SimulationConfig", "Sweep", "simulate", "write_session"]
