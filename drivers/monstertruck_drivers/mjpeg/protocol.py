"""Parsers for pictures in a byte stream, and for the HTTP response that carries them.

Sources: ITU-T T.81, annex B (markers); RFC 9112 (message format, chunked coding); RFC 2046, 5.1 (multipart, whose
headers are skipped as bytes between pictures).
"""

import re
from dataclasses import dataclass, field
from typing import Final

SOI: Final = b"\xff\xd8"
EOI: Final = b"\xff\xd9"
_SOS: Final = 0xDA
_FRAME: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
HEAD_END: Final = b"\r\n\r\n"
HEAD_MOST: Final = 8192
"""Maximum length of the head of an answer (bytes)."""


@dataclass(slots=True)
class PictureSplitter:
    """Incremental picture parser; it also returns truncated pictures, which the caller must reject.

    Args:
        most: maximum length of a picture (bytes).
    """

    most: int
    _buffer: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[bytes]:
        """Return the pictures completed by ``data``; a truncated or oversized picture does not end with FF D9."""
        self._buffer += data
        found: list[bytes] = []
        while True:
            start = self._buffer.find(SOI)
            del self._buffer[: max(len(self._buffer) - 1, 0) if start < 0 else start]
            end = self._end() if start >= 0 else None
            if end is None and len(self._buffer) > self.most:
                end = len(self._buffer)
            if end is None:
                return found
            found.append(bytes(self._buffer[:end]))
            del self._buffer[:end]

    def _end(self) -> int | None:
        """End offset of the first picture; None if it has not arrived yet."""
        buffer, at = self._buffer, len(SOI)
        while at + 4 <= len(buffer):
            if buffer[at] != 0xFF:
                return at
            marker = buffer[at + 1]
            at += 2 + int.from_bytes(buffer[at + 2 : at + 4], "big")
            if marker == _SOS:
                end, following = buffer.find(EOI, at), buffer.find(SOI, at)
                if following >= 0 and not 0 <= end < following:
                    return following
                return None if end < 0 else end + len(EOI)
        return None


def size_of(picture: bytes) -> tuple[int, int] | None:
    """Return width and height (pixels) from the frame header; None if there is none."""
    at = len(SOI)
    while at + 9 <= len(picture) and picture[at] == 0xFF:
        if picture[at + 1] in _FRAME:
            height, width = (int.from_bytes(picture[at + i : at + i + 2], "big") for i in (5, 7))
            return width, height
        at += 2 + int.from_bytes(picture[at + 2 : at + 4], "big")
    return None


def request(path: str, host: str) -> bytes:
    """Return a GET request that asks the server to close the connection at the end."""
    lines = (
        f"GET {path} HTTP/1.1",
        f"Host: {host}",
        "Accept: image/jpeg, multipart/x-mixed-replace",
        "Connection: close",
    )
    return "\r\n".join(lines).encode() + HEAD_END


@dataclass(frozen=True, slots=True)
class HttpHead:
    """Head of an HTTP response."""

    status: int
    reason: str
    kind: str
    """Content type, lower case, without parameters."""
    chunked: bool
    length: int | None
    """Length of the content (bytes); None if not given."""

    @classmethod
    def of(cls, head: bytes) -> "HttpHead":
        """Decode a head without its final empty line.

        Raises:
            ValueError: the head is not from an HTTP response.
        """
        first, *lines = head.decode("latin-1").split("\r\n")
        if (status := re.fullmatch(r"HTTP/1\.[01] (\d{3})(?: (.*))?", first)) is None:
            raise ValueError(f"begins with {first[:40]!r}")
        fields = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
        kind = fields.get("content-type", "").partition(";")[0].strip().lower()
        chunked = "chunked" in fields.get("transfer-encoding", "").lower()
        length = fields.get("content-length", "")
        return cls(int(status[1]), status[2] or "", kind, chunked, int(length) if length.isdecimal() else None)


@dataclass(slots=True)
class Dechunker:
    """Incremental decoder for the chunked transfer coding."""

    ended: bool = False
    """Whether the last chunk has arrived."""
    _buffer: bytes = b""
    _left: int = 0
    """Remaining bytes of the chunk, including its line end."""

    def feed(self, data: bytes) -> bytes:
        """Decode ``data``.

        Raises:
            ValueError: a chunk length is missing.
        """
        self._buffer += data
        out = b""
        while self._buffer:
            if self._left:
                part, self._buffer = self._buffer[: self._left], self._buffer[self._left :]
                self._left -= len(part)
                out += part[: len(part) - max(2 - self._left, 0)]
                continue
            line, end, rest = self._buffer.partition(b"\r\n")
            if not end and len(line) < HEAD_MOST:
                break
            if not re.fullmatch(rb"[0-9a-fA-F]{1,8}(;.*)?", line):
                raise ValueError(f"expected the length of a chunk, got {line[:20]!r}")
            self._left, self._buffer = int(line.partition(b";")[0], 16) + 2, rest
            self.ended |= self._left == 2
        return out
