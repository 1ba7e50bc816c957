"""Calibration of the endoscope's cameras from views of a board."""
