"""Devices with a network socket, reached over TCP."""

import asyncio
import os
import re
import socket
from typing import Final, cast

from monstertruck_drivers.link import STREAM_LIMIT, Link
from monstertruck_runtime.errors import DeviceLostError

CONNECT_TIMEOUT: Final = 2.0
"""Maximum time for a device to accept the connection (s)."""


def parse_address(text: str) -> tuple[str, int] | None:
    """Parse an address and TCP port such as ``192.168.0.10:10940``; None if the text has another form."""
    found = re.fullmatch(r"(\d{1,3}(?:\.\d{1,3}){3}):(\d{1,5})", text)
    return None if found is None else (found[1], int(found[2]))


class TcpPort:
    """A TCP socket at an IPv4 address; without a name look-up, connecting does not block.

    Args:
        address: IPv4 address.
        number: TCP port.
    """

    def __init__(self, address: str, number: int) -> None:
        self.name = f"{address}:{number}"
        self._address, self._number = address, number

    async def open(self) -> Link:
        """Open a connection.

        Raises:
            DeviceLostError: there is no route or no answer, or the connection is refused.
        """
        try:
            async with asyncio.timeout(CONNECT_TIMEOUT):
                _, protocol = await asyncio.get_running_loop().create_connection(
                    lambda: _TcpProtocol(self.name), self._address, self._number
                )
        except TimeoutError as error:
            raise DeviceLostError(f"{self.name}: no answer within {CONNECT_TIMEOUT:g} s") from error
        except ConnectionRefusedError as error:
            raise DeviceLostError(f"{self.name}: refused, or another program is connected") from error
        except OSError as error:
            raise DeviceLostError(f"{self.name}: {_why(error)}") from error
        return protocol.link


class _TcpProtocol(asyncio.Protocol):
    """Feeds a ``Link`` from a connection.

    Args:
        name: name for error messages.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport."""
        line: socket.socket = transport.get_extra_info("socket")
        # Age at which unacknowledged bytes end the connection (s): more than two retransmissions on a local network.
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(0.5 * 1000))
        stream = cast("asyncio.Transport", transport)
        self.link = Link(self._name, stream.write, stream.abort, limit=STREAM_LIMIT)

    def data_received(self, data: bytes) -> None:
        """Pass received bytes to the link."""
        self.link.feed(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Report the loss of the connection."""
        self.link.lose(
            f"connection lost ({_why(exc)})" if isinstance(exc, OSError) else "the device closed the connection"
        )


def _why(error: OSError) -> str:
    return str(error) if error.errno is None else os.strerror(error.errno)
