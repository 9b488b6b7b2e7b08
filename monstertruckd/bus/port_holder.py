"""Robots and processes that hold a port of this computer, by Zenoh's liveliness and the kernel's tables."""

import pwd
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from monstertruck_runtime.endpoints import (
    EVERYWHERE,
    LOCAL_HOSTS,
    UNIX,
    announced,
    host_of,
    port_of,
    protocol_of,
)
from monstertruck_runtime.open_files import PROC, holders
from monstertruck_runtime.robots import robots_at

LISTENING: Final = "0A"
"""State of a listening socket in ``/proc/net/tcp`` (Linux, include/net/tcp_states.h)."""


def holder_of(endpoints: Iterable[str], proc: Path = PROC) -> str:
    """Describe the programs that listen at one of ``endpoints``: robots by name, processes by number and command line.

    Returns:
        For example ``robot 'truck', process 4711 (monstertruckd run --config demo.yaml)``; for a process that this user
        may not inspect, ``a program of user 'ann'`` or ``another program``.
    """
    places = list(endpoints)
    processes = [*_processes(places, proc)] or [*_owners(places, proc)]
    return ", ".join((*_robots(places), *processes)) or "another program"


def _robots(endpoints: list[str]) -> Iterator[str]:
    """Yield robots that answer, and robots that announce the port but answer only clients with a certificate."""
    names: dict[str, None] = {}
    for endpoint in endpoints:
        local = protocol_of(endpoint) == "tcp" and host_of(endpoint) in (*LOCAL_HOSTS, *EVERYWHERE)
        if endpoint.startswith(UNIX) or local:
            names |= dict.fromkeys(robots_at(f"tcp/127.0.0.1:{port_of(endpoint)}" if local else endpoint))
        names |= dict.fromkeys(one.robot for one in announced() if one.port == port_of(endpoint))
    yield from (f"robot {name!r}" for name in names)


def _processes(endpoints: list[str], proc: Path) -> Iterator[str]:
    return holders({f"socket:[{inode}]" for endpoint in endpoints for inode in _inodes(endpoint, proc)}, proc)


def _owners(endpoints: list[str], proc: Path) -> Iterator[str]:
    """Return the users whose programs listen at one of the ports."""
    users = dict.fromkeys(int(row[7]) for endpoint in endpoints for row in _listening(endpoint, proc))
    yield from (f"a program of user {_user(number)!r}" for number in users)


def _user(number: int) -> str:
    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)


def _inodes(endpoint: str, proc: Path) -> Iterator[str]:
    """Yield the kernel's inode numbers of the sockets that listen at an endpoint."""
    if endpoint.startswith(UNIX):
        path = endpoint.removeprefix(UNIX)
        rows = _rows(proc / "net" / "unix")
        yield from (row[6] for row in rows if len(row) > 7 and row[7] == path)
    else:
        yield from (row[9] for row in _listening(endpoint, proc))


def _listening(endpoint: str, proc: Path) -> Iterator[list[str]]:
    """Rows of the kernel's tables for listeners at a port."""
    port = port_of(endpoint)
    for table in ("tcp", "tcp6"):
        rows = _rows(proc / "net" / table)
        yield from (row for row in rows if row[3] == LISTENING and int(row[1].rpartition(":")[2], 16) == port)


def _rows(table: Path) -> list[list[str]]:
    try:
        return [line.split() for line in table.read_text().splitlines()[1:]]
    except OSError:
        return []
