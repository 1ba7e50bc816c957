"""The Rerun recording of a session: what is drawn, where, and the blueprint that shows it."""
