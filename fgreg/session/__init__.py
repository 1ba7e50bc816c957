"""Sessions and results on disk: read, checked, written. The contract is in sessions/README.md."""
