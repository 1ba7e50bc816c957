"""While a session runs: events in, estimates out."""
