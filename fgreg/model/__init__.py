"""The types that all packages use: the session's model, events, measurements, and the estimate."""
