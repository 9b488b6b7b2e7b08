"""Endpoints and the Unix socket of a daemon on this machine."""

import os
import socket
from pathlib import Path

import pytest

from monstertruck_runtime.endpoints import (
    host_of,
    is_endpoint,
    local_endpoint,
    make_private,
    nearest,
    port_of,
    protocol_of,
    runtime_folder,
)


@pytest.mark.parametrize(
    ("endpoint", "parts"),
    [
        ("tcp/127.0.0.1:7447", ("tcp", "127.0.0.1", 7447)),
        ("tls/[::1]:7447?iface=eth0", ("tls", "::1", 7447)),
        ("udp/[fe80::1%eth0]:80#so_sndbuf=1", ("udp", "fe80::1", 80)),
        ("tcp/robot.local:7447", ("tcp", "robot.local", 7447)),
        ("unixsock-stream//run/x.sock", ("unixsock-stream", "", None)),
        ("nonsense", ("nonsense", "", None)),
    ],
)
def test_parts_of_an_endpoint(endpoint, parts):
    assert (protocol_of(endpoint), host_of(endpoint), port_of(endpoint)) == parts


def test_sockets_are_in_the_folder_of_the_service_or_of_the_user():
    assert runtime_folder({"RUNTIME_DIRECTORY": "/run/monstertruckd:/run/other"}) == Path("/run/monstertruckd")
    assert runtime_folder({"XDG_RUNTIME_DIR": "/run/user/7"}) == Path("/run/user/7/monstertruckd")
    assert runtime_folder({}) == Path(f"/tmp/monstertruckd-{os.getuid()}")
    where = {"RUNTIME_DIRECTORY": "/run/monstertruckd"}
    listen = ("unixsock-stream//run/x.sock", "tls/0.0.0.0:7448", "tcp/127.0.0.1:7447")
    assert local_endpoint(listen, where) == "unixsock-stream//run/monstertruckd/7448.sock"
    assert local_endpoint(listen[:1], where) is None


def test_a_daemon_of_this_machine_is_reached_by_its_socket(tmp_path: Path):
    where = {"RUNTIME_DIRECTORY": str(tmp_path)}
    path = tmp_path / "7447.sock"
    assert nearest("tcp/127.0.0.1:7447", where) == "tcp/127.0.0.1:7447"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        assert nearest("tcp/127.0.0.1:7447", where) == "tcp/127.0.0.1:7447"  # nobody answers there
        listener.listen()
        assert nearest("tcp/127.0.0.1:7447", where) == f"unixsock-stream/{path}"
        assert nearest("tcp/localhost:7447", where) == f"unixsock-stream/{path}"
        for other in ("tcp/192.168.1.7:7447", "tls/127.0.0.1:7447", "tcp/127.0.0.1:7448", "unixsock-stream//x"):
            assert nearest(other, where) == other


def test_a_folder_of_somebody_else_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    where = {"RUNTIME_DIRECTORY": str(tmp_path)}
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "7447.sock"))
        listener.listen()
        monkeypatch.setattr(os, "getuid", lambda: 12345)
        assert nearest("tcp/127.0.0.1:7447", where) == "tcp/127.0.0.1:7447"
        with pytest.raises(OSError, match="owned by user 12345"):
            make_private(tmp_path)


@pytest.mark.parametrize("mode", [0o777, 0o702])
def test_a_folder_that_others_may_write_is_refused(tmp_path: Path, mode: int):
    folder = tmp_path / "sockets"
    make_private(folder)
    assert folder.stat().st_mode & 0o777 & ~0o750 == 0
    folder.chmod(mode)
    with pytest.raises(OSError, match="only its owner may write"):
        make_private(folder)


@pytest.mark.parametrize(
    ("text", "is_one"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tls/[::]:7447#iface=eth0", True),
        ("tcp/robot.local:0", True),
        ("unixsock-stream//run/x.sock", True),
        ("serial//dev/ttyS0", True),
        ("nonsense", False),
        ("tcp/", False),
        ("tcp/host", False),
        ("tcp/:7447", False),
        ("tcp/host:70000", False),
        ("tcp:host:7447", False),
        ("http/host:80", False),
        ("unixsock-stream/", False),
        ("", False),
    ],
)
def test_the_form_of_an_endpoint(text: str, is_one: bool):
    assert is_endpoint(text) is is_one
