"""``python -m fgreg``."""

from fgreg.cli import main

main()
