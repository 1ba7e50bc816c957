"""Tracking queries: where to turn the stage for a beam, from a snapshot of the estimate."""
