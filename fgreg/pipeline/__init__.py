"""Recorded sessions, solved as a whole or replayed event by event."""
