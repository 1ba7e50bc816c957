"""Lines from the bytes of a terminal that edits none itself: backspace, Ctrl-U, Ctrl-W; other keys do nothing."""

from __future__ import annotations

from fgreg.schema.limits import TYPED_LINE_BYTES

_NEWLINES, _BACKSPACES, _KILL, _KILL_WORD, _ESCAPE = b"\r\n", b"\x08\x7f", 0x15, 0x17, 0x1B


class LineEditor:
    """The line that is being typed."""

    def __init__(self) -> None:
        self._held = bytearray()
        self._sequence = b""  # what has come of an escape sequence

    @property
    def text(self) -> str:
        """The line up to now."""
        return self._held.decode("utf-8", errors="replace")

    def feed(self, data: bytes) -> list[bytes]:
        """Take in bytes; returns the lines that they end.

        Of a line that is too long the end is kept, one byte more than the limit.
        """
        lines = []
        for byte in data:
            if self._in_sequence(byte):
                continue
            if byte in _NEWLINES:
                lines.append(bytes(self._held))
                self._held.clear()
            elif byte in _BACKSPACES:
                while self._held and 0x80 <= self._held.pop() < 0xC0:  # the rest of a character of several bytes
                    pass
            elif byte == _KILL:
                self._held.clear()
            elif byte == _KILL_WORD:
                del self._held[self._held.rstrip().rfind(b" ") + 1 :]
            elif byte >= 0x20:
                self._held.append(byte)
                del self._held[: -TYPED_LINE_BYTES - 1]
        return lines

    def _in_sequence(self, byte: int) -> bool:
        """Whether a byte belongs to an escape sequence, such as that of an arrow."""
        if byte == _ESCAPE:
            self._sequence = bytes([byte])
            return True
        if not self._sequence or byte in _NEWLINES:
            self._sequence = b""
            return False
        begins = len(self._sequence) == 1 and byte in b"[O"
        ends = len(self._sequence) == 1 or 0x40 <= byte <= 0x7E
        self._sequence = b"" if ends and not begins else self._sequence + bytes([byte])
        return True
