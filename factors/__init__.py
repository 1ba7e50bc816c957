"""The factors of the graph: one file each, with a pure ``residual`` and a builder; ``adapter`` makes GTSAM factors."""
