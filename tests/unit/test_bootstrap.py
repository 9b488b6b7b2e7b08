"""The bootstrap runs the pinned uv and no other, wherever it comes from."""

import ast
import subprocess
import urllib.error
from collections.abc import Sequence
from pathlib import Path
from typing import Any

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
    with pytest.raises(SystemExit, match="a different sha256 and is not used"):
        bootstrap.find_uv()
    assert not cache.exists()


def test_every_supported_machine_has_both_digests():
    assert bootstrap.WHEEL_SHA256.keys() == bootstrap.PROGRAM_SHA256.keys() == {"x86_64", "aarch64"}


def test_bytecode_is_compiled_with_the_environment(monkeypatch: pytest.MonkeyPatch):
    """Where Python may not write it, every process would compile all libraries anew."""
    commands: list[list[str]] = []
    monkeypatch.setattr(bootstrap, "find_uv", lambda: "uv")

    def run(command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        commands.append(command)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(bootstrap.subprocess, "run", run)
    bootstrap.sync(("dev",))
    assert "--compile-bytecode" in commands[0]
    assert "--quiet" not in commands[0], "minutes without a word look like a hang"


def test_packages_that_cannot_be_had_are_one_sentence(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(bootstrap, "find_uv", lambda: "uv")
    failed = subprocess.CompletedProcess([], 2)
    monkeypatch.setattr(bootstrap.subprocess, "run", lambda *_, **__: failed)
    with pytest.raises(SystemExit, match=r"^uv could not set up .*run the command again\.$"):
        bootstrap.sync(("dev",))


def test_without_a_network_the_error_is_one_sentence(cache: Path, monkeypatch: pytest.MonkeyPatch):
    def offline(_: str) -> bytes:
        raise urllib.error.URLError(ConnectionRefusedError(111, "Connection refused"))

    monkeypatch.setattr(bootstrap, "fetch_uv", offline)
    with pytest.raises(SystemExit, match=r"^uv .* cannot be fetched: .*refused.*is reachable\.$"):
        bootstrap.find_uv()


def test_a_home_that_cannot_be_written_is_named_with_a_way_out(cache: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc/nobody")
    with pytest.raises(SystemExit, match=r"^/proc/nobody/monstertruckd cannot be written: .*XDG_CACHE_HOME=FOLDER$"):
        bootstrap.find_uv()


def test_python_3_6_reads_as_far_as_the_message_about_its_version(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    source = Path(bootstrap.__file__).read_text()
    body = ast.parse(source, feature_version=(3, 6)).body
    check = next(index for index, node in enumerate(body) if isinstance(node, ast.If))
    assert all(isinstance(node, ast.Expr | ast.Import | ast.ImportFrom) for node in body[:check])
    monkeypatch.setattr(bootstrap.sys, "version_info", (3, 6, 15))
    with pytest.raises(SystemExit) as end:
        exec(compile(source, "bootstrap.py", "exec"), {"__name__": "bootstrap", "__file__": bootstrap.__file__})
    assert end.value.code == 2
    assert "Python 3.11 or newer is needed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("sync", ["compile"]),
        ("demo", ["compile", "demo"]),
        ("try", ["compile", "try"]),
        ("check", ["check"]),
    ],
)
def test_kernels_are_compiled_at_installation(command: str, expected: list[str], monkeypatch: pytest.MonkeyPatch):
    done: list[str] = []

    def run(program: Path, *arguments: str) -> int:
        done.append(arguments[0] if arguments[1:] == ("--fast",) else "compile")
        return 3

    monkeypatch.setattr(bootstrap, "sync", lambda _: None)
    monkeypatch.setattr(bootstrap, "run", run)
    monkeypatch.setattr(bootstrap, "check", lambda _: done.append("check") or 3)
    assert bootstrap.main([command, "--fast"]) == 3
    assert done == expected


def test_a_lap_waits_for_no_kernels_and_every_step_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    ran: list[tuple[str, ...]] = []
    monkeypatch.setattr(bootstrap, "sync", lambda _: None)
    monkeypatch.setattr(bootstrap, "run", lambda _, *words: ran.append(words) or 0)
    bootstrap.main(["demo", "--config", "lap"])
    assert ran == [("demo", "--config", "lap")]
    bootstrap.main(["demo"])
    shown = capsys.readouterr().err
    assert "Step 2 of 3: compiling the kernels" in shown
    assert shown.endswith("Step 3 of 3: monstertruckd demo\n")


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch):
    """Arguments of every check that was run, and the exit codes of those of pytest, which a test fills."""
    ran: list[tuple[str, ...]] = []
    codes: list[int] = []

    def run(program: Path, *arguments: str) -> int:
        if program.name == "nice":
            program, arguments = Path(arguments[2]), arguments[3:]
        if program.name != "pytest":
            return 0
        ran.append(arguments)
        return codes.pop(0) if codes else 0

    monkeypatch.setattr(bootstrap, "find_uv", lambda: "uv")
    monkeypatch.setattr(bootstrap, "run", run)
    monkeypatch.setattr(bootstrap.subprocess, "Popen", lambda *words, **more: Beside.started(ran, *words, **more))
    return ran, codes


class Compiling:
    """The process that compiles the kernels."""

    code, waited, killed = 0, False, False

    def wait(self) -> int:
        type(self).waited = True
        return self.code

    def kill(self) -> None:
        type(self).killed = True


class Beside:
    """The process that runs the tests on the wall clock beside the others."""

    code, ended = 0, 0

    @classmethod
    def started(cls, ran: list[tuple[str, ...]], command: Sequence[str], **more: Any) -> "Compiling | Beside":
        if command == bootstrap.KERNELS:
            return Compiling()
        assert Path(command[0]).name == "pytest"
        ran.append(tuple(command[1:]))
        more["stdout"].write(b"those on the wall clock\n")
        return cls()

    def wait(self) -> int:
        return self.code

    def terminate(self) -> None:
        type(self).ended += 1


def test_tests_that_failed_beside_others_are_run_once_more_alone(steps):
    ran, codes = steps
    codes += [0, 1, 0]
    assert bootstrap.check([]) == 0
    assert len(ran) == 4
    assert ran[3] == (*ran[2], *bootstrap.FAILED_ALONE)


@pytest.mark.parametrize(("again", "code"), [(0, 0), (1, 1)])
def test_so_are_those_on_the_wall_clock_which_run_beside_the_others_and_are_shown_behind(
    steps, again: int, code: int, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    ran, codes = steps
    monkeypatch.setattr(Beside, "code", 1)
    codes += [0, 0, again]
    assert bootstrap.check([]) == code
    assert ran[1] == bootstrap.WALL
    assert ran[3] == (*bootstrap.WALL, *bootstrap.FAILED_ALONE)
    lines = [line.partition(" -")[0] for line in capfd.readouterr().out.splitlines()]
    assert lines[-4:] == ["==> nice", "==> pytest", "those on the wall clock", "==> pytest"]


def test_those_on_the_wall_clock_end_with_the_check(steps, monkeypatch: pytest.MonkeyPatch):
    def interrupt(program: Path, *_: str) -> int:
        if program.name == "nice":
            raise KeyboardInterrupt
        return 0

    monkeypatch.setattr(Beside, "ended", 0)
    monkeypatch.setattr(bootstrap, "run", interrupt)
    with pytest.raises(KeyboardInterrupt):
        bootstrap.check([])
    assert Beside.ended == 1


@pytest.mark.parametrize("again", [1, 5])
def test_tests_that_fail_twice_or_are_not_found_again_fail_the_check(steps, again: int):
    ran, codes = steps
    codes += [1, again]
    assert bootstrap.check([]) == again
    assert len(ran) == 2


def test_a_step_that_ran_no_tests_is_not_tried_again(steps):
    ran, codes = steps
    codes += [2]
    assert bootstrap.check([]) == 2
    assert len(ran) == 1


def test_every_test_but_the_long_ones_belongs_to_one_step(steps):
    ran, _ = steps
    bootstrap.check([])
    chosen = [arguments[arguments.index("-m") + 1] for arguments in ran]
    for wall in (True, False):
        for traced in (True, False):
            marks = {"wall": wall, "traced": traced, "long": False}
            assert sum(eval(expression, {}, marks) for expression in chosen) == 1
            assert traced or not any(eval(expression, {}, marks | {"long": True}) for expression in chosen)


def test_kernels_are_compiled_before_any_test_that_needs_them(steps, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Compiling, "waited", False)
    early: list[str] = []

    def run(program: Path, *arguments: str) -> int:
        if program.name == "pytest" and not Compiling.waited:
            early.append(arguments[arguments.index("-m") + 1])
        return 0

    monkeypatch.setattr(bootstrap, "run", run)
    assert bootstrap.check([]) == 0
    assert Compiling.waited
    assert early == ["traced and not wall"], "gate, codecs and messages compute without"


def test_kernels_that_do_not_compile_fail_the_check_before_any_test_that_needs_them(
    steps, monkeypatch: pytest.MonkeyPatch
):
    ran, _ = steps
    monkeypatch.setattr(Compiling, "code", 1)
    assert bootstrap.check([]) == 1
    assert len(ran) == 1


def test_our_bytecode_is_compiled_before_any_process_needs_it(steps, monkeypatch: pytest.MonkeyPatch):
    ran: list[tuple[str, ...]] = []
    monkeypatch.setattr(bootstrap, "run", lambda _, *words: ran.append(words) or 0)
    bootstrap.check([])
    assert ran[0] == bootstrap.BYTECODE
    assert all((bootstrap.ROOT / folder).is_dir() for folder in ran[0][5:])


def test_the_compilation_ends_with_the_check(steps, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Compiling, "killed", False)
    monkeypatch.setattr(bootstrap, "run", lambda program, *_: 4 if program.name == "mypy" else 0)
    assert bootstrap.check([]) == 4
    assert Compiling.killed
