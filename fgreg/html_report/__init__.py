"""The report of a solved session as one HTML file."""
