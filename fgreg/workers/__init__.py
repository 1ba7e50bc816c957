"""Child processes that work for this one, and how many threads each of them takes."""
