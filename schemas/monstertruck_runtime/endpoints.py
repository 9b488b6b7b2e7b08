"""Endpoints of Zenoh, such as ``tcp/127.0.0.1:7447``, and the Unix socket of a daemon on the same machine."""

import os
import socket
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

SERVICE_FOLDER: Final = Path("/run/monstertruckd")
"""Where the service keeps its sockets."""
DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
LOCAL_HOSTS: Final = ("127.0.0.1", "localhost", "::1")
UNIX: Final = "unixsock-stream/"
_ADDRESSED: Final = ("tcp", "tls", "udp", "quic", "ws")
"""Protocols whose addresses are a host and a port."""
_OTHERS: Final = ("unixsock-stream", "unixpipe", "vsock", "serial")
ANNOUNCED: Final = "monstertruckd/"
"""Prefix of the abstract Unix socket that shows a daemon to all users of this computer; its port follows."""
EVERYWHERE: Final = ("0.0.0.0", "::")  # noqa: S104
"""Addresses at which a program listens on all interfaces."""
ANSWERS_WITHIN: Final = 0.2
"""Timeout of a connection to a program on this machine (s)."""
_LAST_PORT: Final = 65_535


def is_endpoint(text: str) -> bool:
    """Whether ``text`` has the form of an endpoint: a protocol that Zenoh knows, and an address."""
    if protocol_of(text) in _ADDRESSED:
        port = port_of(text)
        return bool(host_of(text)) and port is not None and port <= _LAST_PORT
    return protocol_of(text) in _OTHERS and bool(_address(text))


def endpoint_of(protocol: str, host: str, port: int) -> str:
    """Of a host's name or address; those of IPv6 stand in brackets."""
    return f"{protocol}/[{host}]:{port}" if ":" in host else f"{protocol}/{host}:{port}"


def protocol_of(endpoint: str) -> str:
    """Protocol of an endpoint, e.g. ``tcp``."""
    return endpoint.partition("/")[0]


def host_of(endpoint: str) -> str:
    """Host or address of an endpoint, without the brackets of IPv6."""
    return _address(endpoint).rpartition(":")[0].removeprefix("[").removesuffix("]").partition("%")[0]


def port_of(endpoint: str) -> int | None:
    """Port of an endpoint; None if it has none."""
    port = _address(endpoint).rpartition(":")[2]
    return int(port) if port.isdecimal() else None


def runtime_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Where sockets and emulated ports are kept: the folder that systemd made for it, or one of its user's own."""
    if given := environment.get("RUNTIME_DIRECTORY"):
        return Path(given.partition(":")[0])
    runtime = environment.get("XDG_RUNTIME_DIR")
    return Path(runtime) / "monstertruckd" if runtime else Path(f"/tmp/monstertruckd-{os.getuid()}")  # noqa: S108


def emulated_ports(robot: str, environment: Mapping[str, str] = os.environ) -> Path:
    """Folder of the emulated devices of a robot, for this user alone: where a configuration names no ports."""
    return runtime_folder(environment) / "ports" / robot


def local_endpoint(listen: Iterable[str], environment: Mapping[str, str] = os.environ) -> str | None:
    """Unix socket of a daemon that listens there, named after the first port; None without a port."""
    port = next((port for endpoint in listen if (port := port_of(endpoint))), None)
    return None if port is None else f"{UNIX}{runtime_folder(environment)}/{port}.sock"


def nearest(endpoint: str, environment: Mapping[str, str] = os.environ) -> str:
    """The Unix socket of the daemon behind a TCP endpoint of this machine, where there is one that answers.

    Its places are not those of stations, so it answers when all of them are taken.
    """
    port = port_of(endpoint)
    if protocol_of(endpoint) != "tcp" or host_of(endpoint) not in LOCAL_HOSTS or port is None:
        return endpoint
    for folder in (runtime_folder(environment), SERVICE_FOLDER):
        path = folder / f"{port}.sock"
        if _answers(path):
            return f"{UNIX}{path}"
    return endpoint


def local_endpoints(environment: Mapping[str, str] = os.environ) -> list[str]:
    """Endpoints of the daemons that answer on this machine, by port, the default port first.

    Unix sockets are those of this user and of the service; a daemon of another user is reached by its port.
    """
    folders = runtime_folder(environment), SERVICE_FOLDER
    ports = {path.stem for folder in folders for path in folder.glob("*.sock")} | announced_ports()
    usual = port_of(DEFAULT_ENDPOINT) or 0
    others = sorted({int(port) for port in ports if port.isdecimal()} - {usual})
    found = [(port, nearest(endpoint_of("tcp", LOCAL_HOSTS[0], port), environment)) for port in (usual, *others)]
    return [endpoint for port, endpoint in found if endpoint.startswith(UNIX) or _listens(LOCAL_HOSTS[0], port)]


def announce(listen: Iterable[str]) -> list[socket.socket]:
    """Let every user of this computer see a daemon's ports, without reading its folders, until the sockets are closed.

    Args:
        listen: endpoints of the daemon. Those that need a certificate, or are for other computers, are left out.

    Returns:
        Sockets that hold the names; the kernel drops those of a process that ends. A name that another program holds
        is left to it.
    """
    ports = {
        port_of(endpoint)
        for endpoint in listen
        if protocol_of(endpoint) == "tcp" and host_of(endpoint) in (*LOCAL_HOSTS, *EVERYWHERE)
    }
    held = []
    for port in ports:
        name = socket.socket(socket.AF_UNIX)
        try:
            name.bind(f"\0{ANNOUNCED}{port}")
        except OSError:
            name.close()
        else:
            held.append(name)
    return held


def announced_ports(table: Path = Path("/proc/net/unix")) -> set[str]:
    """Ports of the daemons that announce them, of every user."""
    try:
        names = (line.rpartition(" ")[2] for line in table.read_text(errors="replace").splitlines())
    except OSError:
        return set()
    return {name.removeprefix(f"@{ANNOUNCED}") for name in names if name.startswith(f"@{ANNOUNCED}")}


def public(endpoint: str) -> str:
    """An endpoint as a user writes it: the port of a Unix socket as an address of this machine."""
    if not endpoint.startswith(UNIX):
        return endpoint
    port = Path(endpoint.removeprefix(UNIX)).stem
    return endpoint_of("tcp", LOCAL_HOSTS[0], int(port)) if port.isdecimal() else endpoint


def robot_on_host(robot: str, endpoint: str) -> str:
    """Robot and computer for messages, such as ``truck on rover``."""
    host = host_of(endpoint) if protocol_of(endpoint) in _ADDRESSED else LOCAL_HOSTS[0]
    return f"{robot} on {socket.gethostname() if host in LOCAL_HOSTS else host}"


def make_private(folder: Path) -> None:
    """Make the folder of sockets and ports; one that is there must be this user's own and nobody else's to write.

    Raises:
        OSError: it cannot be made, or others may put sockets into it.
    """
    folder.mkdir(mode=0o750, parents=True, exist_ok=True)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & stat.S_IWOTH:
        raise OSError(f"{folder}: expected a folder that only its owner may write, owned by user {os.getuid()}")


def _listens(host: str, port: int) -> bool:
    try:
        with socket.create_connection((host, port), ANSWERS_WITHIN):
            return True
    except OSError:
        return False


def _answers(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(ANSWERS_WITHIN)
        try:
            if path.parent != SERVICE_FOLDER and path.parent.lstat().st_uid != os.getuid():
                return False
            probe.connect(str(path))
        except OSError:
            return False
    return True


def _address(endpoint: str) -> str:
    """Without protocol, metadata and configuration."""
    return endpoint.partition("/")[2].partition("?")[0].partition("#")[0]
