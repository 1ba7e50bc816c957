"""Recordings of other programs made sessions, and results made files that other programs read."""
