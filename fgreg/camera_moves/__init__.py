"""Whether the camera has moved without report, since when, and whether it is back: one test for batch and online."""
