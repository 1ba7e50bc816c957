"""Safe motion of the rotation stage.

Commands reach the stage in one way only: ``client`` (main program) -> ``watchdog`` (a process of its own, which owns
the connection to the device) -> ``safety_gate`` (pure; decides) -> the driver (``interface``). Nothing else may hold a
driver.
"""
