"""Motion of the rotation stage, such that it cannot hurt anyone.

One way leads from a planner to a stage: ``link`` (main program) -> ``watchdog`` (a process of its own, which owns the
connection to the device) -> ``gate`` (pure, decides) -> ``device`` (the driver). Nothing else may hold a driver.
"""
