"""Where to turn the stage in search of a PM: each next position, from what was heard so far. No devices, no motion."""
