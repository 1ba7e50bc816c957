"""Registration while the session goes on, and answers to tracking queries meanwhile."""
