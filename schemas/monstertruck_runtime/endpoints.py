"""Zenoh endpoints, such as ``tcp/127.0.0.1:7447``, and the Unix socket of a daemon on the same machine."""

import os
import socket
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final, NamedTuple

SERVICE_FOLDER: Final = Path("/run/monstertruckd")
"""Folder of the service's sockets."""
DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
LOCAL_HOSTS: Final = ("127.0.0.1", "localhost", "::1")
UNIX: Final = "unixsock-stream/"
_ADDRESSED: Final = ("tcp", "tls", "udp", "quic", "ws")
"""Protocols whose addresses are a host and a port."""
_OTHERS: Final = ("unixsock-stream", "unixpipe", "vsock", "serial")
ANNOUNCED: Final = "monstertruckd/"
"""Prefix of the abstract Unix socket that announces a daemon to all users; followed by its ports, protocol and
robot.
"""
EVERYWHERE: Final = ("0.0.0.0", "::")  # noqa: S104
"""Addresses that mean all interfaces."""
ANSWERS_WITHIN: Final = 0.2
"""Timeout of a connection to a program on this machine (s)."""


def is_endpoint(text: str) -> bool:
    """Whether ``text`` has the form of an endpoint: a protocol supported by Zenoh, and an address."""
    if protocol_of(text) in _ADDRESSED:
        port = port_of(text)
        return bool(host_of(text)) and port is not None and port <= 65_535
    return protocol_of(text) in _OTHERS and bool(_address(text))


def endpoint_of(protocol: str, host: str, port: int) -> str:
    """Return the endpoint of a host name or address; IPv6 addresses are put in brackets."""
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
    """Folder of sockets and emulated ports: created by systemd for the service, or a folder of the user."""
    if given := environment.get("RUNTIME_DIRECTORY"):
        return Path(given.partition(":")[0])
    runtime = environment.get("XDG_RUNTIME_DIR")
    return Path(runtime) / "monstertruckd" if runtime else Path(f"/tmp/monstertruckd-{os.getuid()}")  # noqa: S108


def emulated_ports(robot: str, environment: Mapping[str, str] = os.environ) -> Path:
    """Folder of the emulated devices of a robot, private to this user; used if a configuration sets no ports."""
    return runtime_folder(environment) / "ports" / robot


def local_endpoint(listen: Iterable[str], environment: Mapping[str, str] = os.environ) -> str | None:
    """Unix socket of a daemon listening there, named after the first port; None without a port."""
    port = next((port for endpoint in listen if (port := port_of(endpoint))), None)
    return None if port is None else f"{UNIX}{runtime_folder(environment)}/{port}.sock"


def nearest(endpoint: str, environment: Mapping[str, str] = os.environ) -> str:
    """Return the Unix socket of the daemon behind a TCP endpoint of this machine, if it answers.

    The socket has its own connections, so the daemon answers even if stations use all TCP connections.
    """
    port = port_of(endpoint)
    if protocol_of(endpoint) != "tcp" or host_of(endpoint) not in LOCAL_HOSTS or port is None:
        return endpoint
    for folder in (runtime_folder(environment), SERVICE_FOLDER):
        path = folder / f"{port}.sock"
        if _answers(path):
            return f"{UNIX}{path}"
    return endpoint


class Announced(NamedTuple):
    """A daemon as announced to all users of this computer."""

    port: int
    protocol: str
    """``tls`` if it requires a certificate."""
    robot: str
    others: tuple[int, ...] = ()
    """Ports of its other endpoints."""

    @property
    def endpoint(self) -> str:
        """Address for connections from this computer."""
        return endpoint_of(self.protocol, LOCAL_HOSTS[0], self.port)


def local_endpoints(environment: Mapping[str, str] = os.environ, *, near: str = DEFAULT_ENDPOINT) -> list[str]:
    """Return one endpoint of each daemon that answers on this machine, sorted by port, the port of ``near`` first.

    Only Unix sockets of this user and of the service are tried; a daemon of another user is reached by its port. Among
    several endpoints of a daemon ``near`` is preferred, then its Unix socket.
    """
    folders = runtime_folder(environment), SERVICE_FOLDER
    daemons = announced()
    known = {one.port: one.endpoint for one in daemons}
    sockets = {int(path.stem) for folder in folders for path in folder.glob("*.sock") if path.stem.isdecimal()}
    usual = port_of(public(near)) or 0
    found = {}
    for port in (usual, *sorted((sockets | known.keys()) - {usual})):
        plain = endpoint_of("tcp", LOCAL_HOSTS[0], port)
        socket_or_plain = nearest(plain, environment)
        end = known.get(port, plain) if socket_or_plain == plain else socket_or_plain
        if end.startswith(UNIX) or _listens(LOCAL_HOSTS[0], port):
            found[port] = end
    for one in daemons:
        ports = [port for port in (one.port, *one.others) if port in found]
        for port in sorted(ports, key=lambda port: (port != usual, not found[port].startswith(UNIX)))[1:]:
            del found[port]
    return list(found.values())


def announce(robot: str, listen: Iterable[str]) -> socket.socket | None:
    """Announce a daemon to all users of this computer until the socket is closed.

    Args:
        robot: name of the robot.
        listen: endpoints of the daemon; the first one reachable from this computer is announced.

    Returns:
        Socket that holds the name; the kernel removes it when the process ends. None if the endpoints are on other
        computers, or another program holds the name.
    """
    hosts, listen = (*LOCAL_HOSTS, *EVERYWHERE), tuple(listen)
    for endpoint in listen:
        protocol, port = protocol_of(endpoint), port_of(endpoint)
        if protocol in ("tcp", "tls") and host_of(endpoint) in hosts and port is not None:
            ports = dict.fromkeys((port, *filter(None, map(port_of, listen))))
            name = socket.socket(socket.AF_UNIX)
            try:
                name.bind(f"\0{ANNOUNCED}{','.join(map(str, ports))}/{protocol}/{robot}")
            except OSError:
                name.close()
                return None
            return name
    return None


def announced(table: Path = Path("/proc/net/unix")) -> list[Announced]:
    """Return the announced daemons of all users."""
    try:
        names = [line.rpartition(" @")[2] for line in table.read_text(errors="replace").splitlines()]
    except OSError:
        return []
    found = []
    for name in names:
        ports, _, rest = name.removeprefix(ANNOUNCED).partition("/")
        protocol, _, robot = rest.partition("/")
        numbers = ports.split(",")
        if name.startswith(ANNOUNCED) and all(map(str.isdecimal, numbers)) and protocol in ("tcp", "tls") and robot:
            port, *others = map(int, numbers)
            found.append(Announced(port, protocol, robot, tuple(others)))
    return found


def public(endpoint: str) -> str:
    """Return the endpoint as shown to users: a Unix socket as the port on this machine that it belongs to."""
    if not endpoint.startswith(UNIX):
        return endpoint
    port = Path(endpoint.removeprefix(UNIX)).stem
    return endpoint_of("tcp", LOCAL_HOSTS[0], int(port)) if port.isdecimal() else endpoint


def robot_on_host(robot: str, endpoint: str) -> str:
    """Return robot and computer for messages, such as ``truck on rover``."""
    host = host_of(endpoint) if protocol_of(endpoint) in _ADDRESSED else LOCAL_HOSTS[0]
    return f"{robot} on {socket.gethostname() if host in LOCAL_HOSTS else host}"


def make_private(folder: Path) -> None:
    """Create the folder of sockets and ports.

    An existing one must belong to this user and be writable by this user only.

    Raises:
        OSError: it cannot be created, or others may put sockets into it.
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
    """Return the endpoint without protocol, metadata and configuration."""
    return endpoint.partition("/")[2].partition("?")[0].partition("#")[0]
