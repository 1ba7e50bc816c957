"""fgreg: factor-graph registration of a stereo endoscope to a rotating TRUS probe."""

__version__ = "0.1.0"
