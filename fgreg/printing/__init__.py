"""Markers and boards on paper: their geometry, and a PDF of them, true to size."""
