"""Time until a stop over OpenIGTLink is the first word that the live loop gets, with other words behind it.

    python tools/bench_operator_stop.py [--runs 200] [--words 0 400]

A peer on this machine sends ``stop`` and that many signed words as one burst; the driver is polled every 2 ms, as the
live loop does. Times are from the call that sends to the poll that returns the stop, in ms.
"""

from __future__ import annotations

import argparse
import socket
import time

import numpy as np

from fgreg.drivers.base import CommandKind, OperatorCommand
from fgreg.drivers.igtl_messages import pack_text
from fgreg.drivers.operators import IgtlOperator
from fgreg.drivers.peer_words import PeerWords
from fgreg.drivers.tcp_link import Endpoint
from fgreg.drivers.word_keys import sign

KEY = b"only for this measurement, 32 bytes"
POLL_S = 0.002
PATIENCE_S = 10.0


def took_s(operator: IgtlOperator, peer: socket.socket, words: int) -> float:
    """Seconds from sending to the stop, which has to be the first word."""
    counter = time.time_ns()
    lines = ["stop", *(sign("search", KEY, counter + i, time.time()) for i in range(words))]
    burst = b"".join(pack_text("Operator", line, 0.0, {}, 2) for line in lines)
    begin = time.monotonic()
    peer.sendall(burst)
    while time.monotonic() < begin + PATIENCE_S:
        if found := operator.poll():
            at_s = time.monotonic() - begin
            first = found[0]
            if not (isinstance(first, OperatorCommand) and first.kind is CommandKind.STOP):
                raise SystemExit(f"the first word is {first}")
            while operator.poll() or time.monotonic() - begin < 0.1 + 1e-3 * words:  # the rest of the burst
                time.sleep(0.05)
            return at_s
        time.sleep(POLL_S)
    raise SystemExit(f"no stop within {PATIENCE_S} s")


def main() -> None:
    """Print a line for each number of words."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--words", type=int, nargs="+", default=[0, 400])
    options = parser.parse_args()
    operator = IgtlOperator(Endpoint.listening(0), words=PeerWords(key=KEY))
    try:
        with socket.create_connection(("127.0.0.1", operator.endpoint.port), timeout=PATIENCE_S) as peer:
            for words in options.words:
                took = 1e3 * np.array([took_s(operator, peer, words) for _ in range(options.runs)])
                p50, p99, most = np.percentile(took, (50, 99, 100))
                print(f"{words} words after the stop: p50 {p50:.1f}, p99 {p99:.1f}, max {most:.1f} ms")
    finally:
        operator.close()


if __name__ == "__main__":
    main()
