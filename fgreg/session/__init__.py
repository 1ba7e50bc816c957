"""Read, check and write sessions and results on disk. The format is in sessions/README.md."""
