"""Signed words: who has the key said this word, now, and for the first time. Pure but for :func:`read_key`.

A signed word is one line, ``WORD;COUNTER;TIME;SIGNATURE``: the word as it is said otherwise (``search``), a number that
is larger than in the line before, seconds since 1970 (UTC), and the HMAC-SHA256 of all before the last semicolon, in
UTF-8, as 64 hexadecimal digits in lower case. The key is the content of a file without the newline at its end.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import stat
from dataclasses import dataclass
from pathlib import Path

from fgreg.drivers.operator_words import MOST_AGE_S
from fgreg.errors import InputError

LEAST_KEY_BYTES, MOST_KEY_BYTES = 32, 4096
EXPECTED_KEY = (
    f"a file of {LEAST_KEY_BYTES} to {MOST_KEY_BYTES} bytes that only its owner can read: "
    "openssl rand -hex 32 > FILE; chmod 600 FILE"
)
_READ = os.O_RDONLY | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NONBLOCK", 0)
"""Without waiting, where it is a pipe that no one writes to."""
_SIGNED = re.compile(r"([^;]*);([0-9]{1,19});([0-9]{1,12}(?:\.[0-9]{1,9})?);([0-9a-f]{64})\s*")


@dataclass(frozen=True, slots=True)
class SignedWord:
    """A line ``WORD;COUNTER;TIME;SIGNATURE`` in its parts: ``time_s`` since 1970; ``signed``: what was signed."""

    word: str
    counter: int
    time_s: float
    signed: str
    signature: str


def sign(word: str, key: bytes, counter: int, time_s: float) -> str:
    """The signed line of a word.

    Args:
        word: e.g. ``search``; without a semicolon.
        key: as :func:`read_key` reads it.
        counter: larger than in the line before, also after a restart of the sender: ``time.time_ns()`` is.
        time_s: ``time.time()``.
    """
    signed = f"{word};{counter};{time_s:.6f}"
    return f"{signed};{_signature(signed, key)}"


def signed_word(line: str) -> SignedWord | None:
    """The parts of a signed line; None for another line."""
    found = _SIGNED.fullmatch(line)
    if found is None:
        return None
    word, counter, time_s, signature = found.groups()
    return SignedWord(word, int(counter), float(time_s), line[: found.start(4) - 1], signature)


def why_not(said: SignedWord, key: bytes, last_counter: int, now_s: float, began_s: float = 0.0) -> str:
    """Why a signed word does not count; empty if it does.

    Args:
        said: the word.
        key: of the peer.
        last_counter: of the last word that counted; -1 before the first.
        now_s: seconds since 1970.
        began_s: the same from which on words count, since earlier counters are not known: MOST_AGE_S after the start,
            as the word of a clock that is ahead may have counted before.
    """
    if not hmac.compare_digest(_signature(said.signed, key), said.signature):
        return "its signature is wrong: has the sender the same key?"
    age_s = now_s - said.time_s
    if abs(age_s) > MOST_AGE_S:
        ahead = "ahead of" if age_s < 0.0 else "behind"
        return (
            f"its time is {abs(age_s):.1f} s {ahead} this machine's, and {MOST_AGE_S:g} s is the limit: set the clocks"
        )
    if said.time_s < began_s:
        return "it was signed before this session began: say it again"
    if said.counter <= last_counter:
        return f"its counter {said.counter} was used before: each has to be larger than the last, {last_counter}"
    return ""


def _signature(signed: str, key: bytes) -> str:
    return hmac.new(key, signed.encode("utf-8"), hashlib.sha256).hexdigest()


def read_key(path: Path) -> bytes:
    """The key in a file: its bytes without the newline at the end.

    Raises:
        InputError: no such file, or one that others can read, that is too short or too long.
    """

    def refused(found: str) -> InputError:
        return InputError(str(path), found, EXPECTED_KEY)

    try:
        with os.fdopen(os.open(path, _READ), "rb") as file:
            kept = os.fstat(file.fileno())
            if not stat.S_ISREG(kept.st_mode):
                raise refused("no ordinary file")
            if os.name == "posix" and kept.st_mode & 0o077:
                raise refused(f"a key that others can read (mode {stat.S_IMODE(kept.st_mode):o})")
            key = file.read(MOST_KEY_BYTES + 2)
    except OSError as error:
        raise refused(error.strerror or str(error)) from None
    key = key.removesuffix(b"\n").removesuffix(b"\r")
    if not LEAST_KEY_BYTES <= len(key) <= MOST_KEY_BYTES:
        raise refused(f"a key of {len(key)} bytes" if len(key) <= MOST_KEY_BYTES else "a longer one")
    if len(set(key)) < 8:
        raise refused("a key of hardly any different characters")
    return key
