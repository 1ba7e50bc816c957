"""``python -m fgreg``."""

from fgreg.cli.main import main

main()
