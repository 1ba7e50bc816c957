"""The factors of the graph: one file each, a pure ``residual`` and a builder; ``adapter`` makes them GTSAM's."""
