"""The bootstrap runs the pinned uv and no other, wherever it comes from."""

from pathlib import Path

import pytest

from monstertruckd import bootstrap

PINNED = b"the pinned program"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine of a known kind, without uv; where its cache is."""
    monkeypatch.setattr(bootstrap.platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(bootstrap.platform, "libc_ver", lambda: ("glibc", "2.36"))
    monkeypatch.setitem(bootstrap.PROGRAM_SHA256, "x86_64", bootstrap.sha256(PINNED))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    monkeypatch.setattr(bootstrap, "fetch_uv", lambda _: PINNED)
    return tmp_path / "cache" / "monstertruckd" / f"uv-{bootstrap.UV_VERSION}"


def program(folder: Path, content: bytes) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "uv"
    file.write_bytes(content)
    file.chmod(0o755)
    return file


def test_another_uv_on_the_path_is_not_run(cache: Path, tmp_path: Path):
    program(tmp_path / "bin", b"another version")
    assert bootstrap.find_uv() == str(cache)
    assert cache.read_bytes() == PINNED
    assert cache.stat().st_mode & 0o777 == 0o755


def test_the_pinned_uv_on_the_path_needs_no_network(cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(bootstrap, "fetch_uv", lambda _: pytest.fail("fetched"))
    own = program(tmp_path / "bin", PINNED)
    assert bootstrap.find_uv() == str(own)
    assert not cache.exists()


def test_a_changed_file_in_the_cache_is_replaced(cache: Path):
    bootstrap.find_uv()
    cache.write_bytes(b"changed")
    assert bootstrap.find_uv() == str(cache)
    assert cache.read_bytes() == PINNED


def test_a_fetched_program_that_is_not_the_pinned_one_is_never_stored(cache: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(bootstrap, "fetch_uv", lambda _: b"another")
    with pytest.raises(SystemExit, match="another sha256; not used"):
        bootstrap.find_uv()
    assert not cache.exists()


def test_every_supported_machine_has_both_digests():
    assert bootstrap.WHEEL_SHA256.keys() == bootstrap.PROGRAM_SHA256.keys() == {"x86_64", "aarch64"}


def test_bytecode_is_compiled_with_the_environment(monkeypatch: pytest.MonkeyPatch):
    """Where Python may not write it, every process would compile all libraries anew."""
    commands: list[list[str]] = []
    monkeypatch.setattr(bootstrap, "find_uv", lambda: "uv")
    monkeypatch.setattr(bootstrap.subprocess, "run", lambda command, **_: commands.append(command))
    bootstrap.sync(("dev",))
    assert "--compile-bytecode" in commands[0]
