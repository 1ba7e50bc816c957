"""What all else speaks of: the session's model, events, measurements, and the estimate."""
