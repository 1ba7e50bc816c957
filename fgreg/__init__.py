"""fgreg: factor-graph registration of a stereo endoscope to a rotating TRUS probe."""

from fgreg.version import __version__ as __version__
