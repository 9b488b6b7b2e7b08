"""What a terminal sends for keys: bytes in, names of keys out. Pure."""

from typing import Final

ESCAPE: Final = b"\x1b"
PASTE: Final = b"\x1b[200~"
PASTE_END: Final = b"\x1b[201~"

_FINALS: Final = {
    "A": "up",
    "B": "down",
    "C": "right",
    "D": "left",
    "I": "focus in",
    "O": "focus out",
}
"""Last character of a control sequence (ECMA-48 section 5.4; xterm's arrow keys and focus reports)."""

_NAMES: Final = {"\r": "enter", "\n": "enter", " ": "space", "\x1b": "escape", "\x04": "end"}


class KeyReader:
    """Cuts a stream of bytes into keys; what was pasted is no key."""

    def __init__(self) -> None:
        self._rest = b""
        self._pasting = False

    def feed(self, data: bytes) -> list[str]:
        """Names of the keys that ``data`` completes; letters come as lower case."""
        self._rest += data
        keys = []
        while (part := self._next()) is not None:
            if part == PASTE:
                self._pasting = True
            elif part == PASTE_END:
                self._pasting = False
            elif not self._pasting and (name := _name(part)) is not None:
                keys.append(name)
        return keys

    def flush(self) -> list[str]:
        """The escape key, if that was all: to be called when nothing has followed for a moment."""
        rest, self._rest = self._rest, b""
        return ["escape"] if rest == ESCAPE and not self._pasting else []

    def clear(self) -> None:
        """Forget what has come so far."""
        self._rest, self._pasting = b"", False

    def _next(self) -> bytes | None:
        """Cut the first whole key off; None if there is none yet."""
        length = _length(self._rest)
        if length is None:
            return None
        part, self._rest = self._rest[:length], self._rest[length:]
        return part


def _length(data: bytes) -> int | None:
    """Bytes of the first key; None while it may go on."""
    if not data or data == ESCAPE:
        return None
    if not data.startswith(ESCAPE):
        return 1
    if data[1:2] == b"O":
        return 3 if len(data) >= 3 else None
    if data[1:2] != b"[":
        return 1 if data[1:2] == ESCAPE else 2
    for index, byte in enumerate(data[2:], start=3):
        if 0x40 <= byte <= 0x7E:
            return index
    return None


def _name(part: bytes) -> str | None:
    if not part.isascii():
        return None
    text = part.decode("ascii")
    if part.startswith((b"\x1b[", b"\x1bO")):
        return _FINALS.get(text[-1])
    if len(part) > 1:
        return None
    return _NAMES.get(text, text.lower() if text.isprintable() else None)
