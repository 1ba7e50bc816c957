"""Worker processes, and the number of threads of each process."""
