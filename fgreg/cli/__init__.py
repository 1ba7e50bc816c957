"""The commands, and their text in the terminal."""
