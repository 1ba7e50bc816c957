"""From frames to numbers: markers and boards in camera images, photoacoustic arrivals in ultrasound frames."""
