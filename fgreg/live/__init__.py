"""A live session: turns devices' data into events, and estimates into prompts and stage orders."""
