"""``python -m fgreg``, and the command ``fgreg``."""

import signal

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(
        signal.SIGINT, signal.SIG_DFL
    )  # an interrupt while modules are loaded ends the process without a word

from fgreg.cli.main import main

if __name__ == "__main__":
    main()
