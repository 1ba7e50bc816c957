"""The Rerun recording of a session: its entities and its blueprint."""
