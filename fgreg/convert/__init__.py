"""Conversion of recordings of other programs to sessions, and of results to files for other programs."""
