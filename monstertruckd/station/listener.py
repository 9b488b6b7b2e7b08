"""Connections to the page's server, with limits during their setup, because the TLS handshake is expensive."""

import asyncio
import socket
import ssl
from collections import Counter
from collections.abc import Callable, Coroutine
from contextlib import ExitStack
from typing import Any, Final

from monstertruckd.station.users import network_of

HANDSHAKE_LIMIT: Final = 5.0
"""Maximum duration of a TLS handshake (s)."""
MOST_OF_NETWORK: Final = 32
"""Maximum number of connections of one network during setup; further connections are closed at once."""


class WebListener:
    """Accepts connections to an address within its context.

    Args:
        host: name or address to listen on.
        port: port to listen on.
        tls: certificate and key; None for plain connections.
        inside: creates the protocol of a connection after its handshake.
        refused: called with the peer's address and the reason for each refused connection.
    """

    def __init__(
        self,
        host: str,
        port: int,
        tls: ssl.SSLContext | None,
        inside: Callable[[], asyncio.Protocol],
        refused: Callable[[str, str], None],
    ) -> None:
        self._host, self._port, self._tls = host, port, tls
        self._inside = inside
        self._refused = refused
        self._under_way: Counter[str] = Counter()
        self._tasks: set[asyncio.Task[None]] = set()
        self._sockets = ExitStack()

    async def __aenter__(self) -> None:
        """Start to listen.

        Raises:
            OSError: the port is in use, or this machine has no such address.
        """
        loop = asyncio.get_running_loop()
        found = await loop.getaddrinfo(self._host, self._port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        with ExitStack() as made:
            # 128: maximum number of connections waiting for accept
            sockets = [
                made.enter_context(socket.create_server(address[:2], family=family, backlog=128))
                for family, address in dict.fromkeys((row[0], row[4]) for row in found)
            ]
            self._sockets = made.pop_all()
        for sock in sockets:
            sock.setblocking(False)
            self._begin(self._accept(sock))

    async def __aexit__(self, *_: object) -> None:
        """Stop accepting connections; abort those during setup."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        self._sockets.close()

    def _begin(self, job: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(job)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _accept(self, sock: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                taken, name = await loop.sock_accept(sock)
            except OSError as error:  # too many open files, or the peer is already gone
                self._refused("?", f"a connection cannot be accepted: {error.strerror or error}")
                # Pause before the next accept after running out of file descriptors (s).
                descriptor_pause = 0.2
                await asyncio.sleep(descriptor_pause)
                continue
            address = str(name[0])
            network = network_of(address)
            if self._under_way[network] < MOST_OF_NETWORK:
                self._under_way[network] += 1
                self._begin(self._greet(taken, address, network))
            else:
                taken.close()
                self._refused(address, f"{MOST_OF_NETWORK} connections from {network} are being set up: refused")

    async def _greet(self, taken: socket.socket, address: str, network: str) -> None:
        longest = None if self._tls is None else HANDSHAKE_LIMIT
        try:
            await asyncio.get_running_loop().connect_accepted_socket(
                self._inside, taken, ssl=self._tls, ssl_handshake_timeout=longest
            )
        except OSError as error:
            self._refused(address, f"connection of {address} failed: {error.strerror or error}")
        finally:
            self._under_way[network] -= 1
            if not self._under_way[network]:
                del self._under_way[network]
