"""The one graph, twice: explicit over GTSAM (the reference), and reduced to the shared variables (the fast path)."""
