"""The message of a daemon whose port is taken: by which process, and by which robot."""

import os
import pwd
import socket
from pathlib import Path
from types import SimpleNamespace

import pytest

from monstertruckd.bus.port_holder import holder_of


def test_a_process_is_named_by_its_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.0)
        port = server.getsockname()[1]
        said = holder_of([f"tcp/192.0.2.7:{port}"])  # no address of this computer: nobody is asked
    assert said.startswith(f"process {os.getpid()} (")
    assert "python" in said


def test_a_process_is_named_by_its_unix_socket(tmp_path: Path):
    path = tmp_path / "7447.sock"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        rows = Path("/proc/net/unix").read_text()
        assert str(path) in rows
        assert f"process {os.getpid()} (" in holder_of([f"unixsock-stream/{path}"])


def table(proc: Path, *rows: str) -> None:
    (proc / "net").mkdir()
    (proc / "net" / "tcp").write_text("\n".join(("  sl  local_address rem_address   st", *rows, "")))


ROW = "0: 0100007F:0001 00000000:0000 {state} 00000000:00000000 00:00000000 00000000  1000        0 4711 1"


def test_of_what_cannot_be_seen_its_user_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pwd, "getpwuid", {1000: SimpleNamespace(pw_name="ann")}.__getitem__)
    table(tmp_path, ROW.format(state="0A"), ROW.format(state="0A").replace("1000", "1001"))
    said = "a program of user 'ann', a program of user '1001'"
    assert holder_of(["tcp/192.0.2.7:1"], tmp_path) == said


def test_only_who_listens_counts(tmp_path: Path):
    table(tmp_path, ROW.format(state="0A"))
    fds = tmp_path / "52" / "fd"
    fds.mkdir(parents=True)
    (fds / "3").symlink_to("socket:[4711]")
    (tmp_path / "52" / "cmdline").write_bytes(b"monstertruckd\0run\0--config\0a.yaml\0")
    assert holder_of(["tcp/192.0.2.7:1"], tmp_path) == "process 52 (monstertruckd run --config a.yaml)"
    (tmp_path / "net" / "tcp").write_text(f"sl\n{ROW.format(state='01')}\n")
    assert holder_of(["tcp/192.0.2.7:1"], tmp_path) == "another program"
    assert holder_of(["tcp/192.0.2.7:2"], tmp_path) == "another program"
