"""Rigid transforms, quaternions, and errors at target points."""
