"""Frames to measurements: pose of markers and boards in camera images, photoacoustic arrivals in ultrasound frames."""
