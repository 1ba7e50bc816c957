"""Search for a PM: plans each next stage position from the looks up to now. No devices, no motion."""
