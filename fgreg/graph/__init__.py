"""The graph in two forms: explicit in GTSAM (the reference), and reduced to the shared variables (the fast path)."""
