"""Registration while the session goes on: events in, estimates out, by incremental smoothing (iSAM2)."""
