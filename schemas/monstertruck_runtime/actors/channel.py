"""Pickled objects over a stream socket, each behind its length; both ends block."""

import pickle
import socket
import struct
from typing import Any

_LENGTH = struct.Struct("<Q")


def send(end: socket.socket, message: Any) -> None:
    """Write one object.

    Raises:
        OSError: the other end is gone, or the socket's time-out passed.
    """
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    end.sendall(_LENGTH.pack(len(data)) + data)


def receive(end: socket.socket) -> Any:
    """Read one object; the peer is trusted, being our own child or parent.

    Raises:
        EOFError: the other end is gone.
        OSError: it went in a bad way, or the socket's time-out passed.
    """
    (length,) = _LENGTH.unpack(_exactly(end, _LENGTH.size))
    return pickle.loads(_exactly(end, length))  # noqa: S301  # own process


def _exactly(end: socket.socket, size: int) -> bytearray:
    data = bytearray(size)
    view = memoryview(data)
    while view:
        count = end.recv_into(view)
        if count == 0:
            raise EOFError
        view = view[count:]
    return data
