"""Signs and constants of probe and stage from a few simple recordings: pure functions (docs/setup.md)."""
