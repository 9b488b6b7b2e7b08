"""Robots and processes that hold a port of this computer, by Zenoh's liveliness and the kernel's tables."""

import json
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

import zenoh

from monstertruck_runtime.endpoints import LOCAL_HOSTS, UNIX, host_of, port_of, protocol_of
from monstertruck_runtime.stations import session_config
from monstertruck_schemas.topics import alive_key

LISTENING: Final = "0A"
"""State of a listening socket in ``/proc/net/tcp`` (Linux, include/net/tcp_states.h)."""
SOCKET: Final = "socket:["
"""Beginning of a link in ``/proc/PID/fd`` that leads to a socket; its number and a bracket follow."""
LONGEST: Final = 160
"""Characters of a command line that are shown."""
LOOK: Final = 0.5
"""Timeout of a liveliness query (s)."""


def holder_of(endpoints: Iterable[str], proc: Path = Path("/proc")) -> str:
    """Describe who listens at one of ``endpoints``: robots by name, process by number and command line.

    Returns:
        For example ``robot 'truck', process 4711 (monstertruckd run --config demo.yaml)``; ``another program`` where
        neither can be seen.
    """
    places = list(endpoints)
    return ", ".join((*_robots(places), *_processes(places, proc))) or "another program"


def robots_at(endpoint: str, timeout: float = LOOK) -> list[str]:
    """Names of the robots that answer at an endpoint; empty if nothing does, or if it requires a certificate."""
    config = session_config(endpoint, timeout, None)
    try:
        with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
            replies = session.liveliness().get(alive_key("*"), timeout=timeout)
            return sorted({str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok is not None})
    except zenoh.ZError:
        return []


def _robots(endpoints: list[str]) -> Iterator[str]:
    names: dict[str, None] = {}
    for endpoint in endpoints:
        local = protocol_of(endpoint) == "tcp" and host_of(endpoint) in (*LOCAL_HOSTS, "0.0.0.0", "::")  # noqa: S104
        if endpoint.startswith(UNIX) or local:
            names |= dict.fromkeys(robots_at(f"tcp/127.0.0.1:{port_of(endpoint)}" if local else endpoint))
    yield from (f"robot {name!r}" for name in names)


def _processes(endpoints: list[str], proc: Path) -> Iterator[str]:
    inodes = {inode for endpoint in endpoints for inode in _inodes(endpoint, proc)}
    for folder in sorted(proc.glob("[0-9]*"), key=lambda folder: int(folder.name)):
        if inodes & _sockets(folder):
            yield f"process {folder.name} ({_command_line(folder)})"


def _inodes(endpoint: str, proc: Path) -> Iterator[str]:
    """Sockets that listen at an endpoint, by the kernel's numbers."""
    if endpoint.startswith(UNIX):
        path = endpoint.removeprefix(UNIX)
        rows = _rows(proc / "net" / "unix")
        yield from (row[6] for row in rows if len(row) > 7 and row[7] == path)
    elif (port := port_of(endpoint)) is not None:
        for table in ("tcp", "tcp6"):
            rows = _rows(proc / "net" / table)
            yield from (row[9] for row in rows if row[3] == LISTENING and int(row[1].rpartition(":")[2], 16) == port)


def _rows(table: Path) -> list[list[str]]:
    try:
        return [line.split() for line in table.read_text().splitlines()[1:]]
    except OSError:
        return []


def _command_line(folder: Path) -> str:
    try:
        words = (folder / "cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return "ended"
    return " ".join(words).strip()[:LONGEST]


def _sockets(folder: Path) -> set[str]:
    """Sockets of a process; none of one that belongs to another user, or has ended."""
    found: set[str] = set()
    with suppress(OSError):
        for link in (folder / "fd").iterdir():
            with suppress(OSError):  # closed meanwhile
                target = str(link.readlink())
                if target.startswith(SOCKET):
                    found.add(target.removeprefix(SOCKET).removesuffix("]"))
    return found
