"""Digest of a run: what two runs of one seed must share."""

import hashlib
import struct

_FRAME = struct.Struct("<qII")


class LogDigest:
    """SHA-256 over (key, stamp, payload) of every logged message, in order."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def update(self, key: str, stamp: int, payload: bytes) -> None:
        """Add one message; lengths are part of the digest, so no two runs share one by shifted borders."""
        name = key.encode()
        self._hash.update(_FRAME.pack(stamp, len(name), len(payload)) + name + payload)

    def hexdigest(self) -> str:
        """64 hexadecimal digits of all messages so far."""
        return self._hash.hexdigest()
