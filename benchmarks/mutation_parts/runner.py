"""Runs tests against mutants: a copy of the project for each job, in which a server forks one process for each mutant.

    python -m benchmarks.mutation_parts.runner FOLDER      (what ``mutation.py`` starts; speaks JSON lines)

The server has imported everything that no mutant changes, so a mutant costs the tests it is judged by and little more.
"""

import contextlib
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[2]
SOURCES: Final = ("monstertruckd", "drivers", "planners", "schemas", "tests", "systemd", "configs", "pyproject.toml")
PATHS: Final = (".", "drivers", "planners", "schemas")
IMPORTED: Final = (
    "asyncio",
    "pytest",
    "hypothesis",
    "numpy",
    "pydantic",
    "monstertruck_schemas.topics",
    "monstertruck_runtime.clock",
    "monstertruck_runtime.requests",
    "monstertruck_runtime.actors.actor",
    "monstertruck_kinematics.chassis",
)
"""Packages below everything that is mutated."""

OPTIONS: Final = (
    *("-x", "-q", "--no-header", "-p", "no:cacheprovider", "-p", "no:cov", "-p", "no:xdist"),
    *("-W", "ignore::pytest.PytestAssertRewriteWarning"),  # the server has imported them already
)

SURVIVED, KILLED, TIMED_OUT, BROKEN = "survived", "killed", "timed out", "does not import"


def copy_project(folder: Path) -> None:
    """A copy of the project's sources and tests, without compiled files."""
    skip = shutil.ignore_patterns("__pycache__", "*.nbi", "*.nbc", "*.mcap", "replay")
    for name in SOURCES:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=skip)
        else:
            shutil.copy(source, folder / name)


def environment(folder: Path) -> dict[str, str]:
    """Environment in which the copy is what is imported."""
    return os.environ | {
        "PYTHONPATH": ":".join(str(folder / path) for path in PATHS),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "OMP_NUM_THREADS": "1",
    }


class Server:
    """A process that judges mutants in a copy of the project.

    Args:
        folder: of the copy.
    """

    def __init__(self, folder: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, str(Path(__file__)), str(folder)],
            cwd=folder,
            env=environment(folder),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def judge(self, file: str, source: str, tests: list[str], seconds: float) -> tuple[str, str]:
        """What becomes of a faulty ``file`` within the time given, and the test that found it."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        order = {"file": file, "source": source, "tests": tests, "seconds": seconds}
        print(json.dumps(order), file=self._process.stdin, flush=True)
        verdict, test = json.loads(self._process.stdout.readline())
        return verdict, test

    def close(self) -> None:
        """End the server."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


class _FirstFailure:
    """Pytest plug-in: the first test that fails."""

    def __init__(self) -> None:
        self.test = ""

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed and not self.test:
            self.test = report.nodeid


def _forked(tests: list[str], seconds: float) -> tuple[str, str]:
    """Run tests in a process of its own group."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        os.close(read)
        null = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(null, stream)
        import pytest  # noqa: PLC0415 - in the child

        found = _FirstFailure()
        code = 3
        with contextlib.suppress(BaseException):
            code = int(pytest.main([*OPTIONS, *tests], plugins=[found]))
        os.write(write, found.test.encode()[:4000])
        os._exit(code)
    os.close(write)
    deadline = time.monotonic() + seconds
    status: int | None = None
    while status is None and time.monotonic() < deadline:
        ended, code = os.waitpid(child, os.WNOHANG)
        status = code if ended else None
        if status is None:
            time.sleep(0.005)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # also what it started
    if status is None:
        os.waitpid(child, 0)
        os.close(read)
        return TIMED_OUT, ""
    with os.fdopen(read) as told:
        test = told.read()
    code = os.waitstatus_to_exitcode(status)
    if code == 0:
        return SURVIVED, ""
    return (KILLED, test) if code == 1 else (BROKEN, "")


def _orders() -> Iterator[dict[str, Any]]:
    for line in sys.stdin:
        yield json.loads(line)


def serve(folder: Path) -> None:
    """Judge mutants until the end of standard input."""
    sys.path[:] = [str(folder / path) for path in PATHS] + [path for path in sys.path if path]
    os.chdir(folder)
    for name in IMPORTED:
        importlib.import_module(name)
    for order in _orders():
        file = folder / order["file"]
        sound = file.read_bytes()
        file.write_text(order["source"], encoding="utf-8")
        try:
            verdict = _forked(order["tests"], order["seconds"])
        finally:
            file.write_bytes(sound)
        print(json.dumps(verdict), flush=True)


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
