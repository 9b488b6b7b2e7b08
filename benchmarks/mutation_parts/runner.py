"""Runs tests against mutants: two servers for each job, which fork one process for each mutant.

    python -m benchmarks.mutation_parts.runner warm|cold TEST ...      (started by ``mutation.py``; JSON lines)

The warm server has collected all tests; its fork replaces the code of the faulty functions and runs the tests that
reach them. Code that runs on import cannot be replaced in this way: a fork of the cold server imports the faulty source
itself.
"""

import contextlib
import gc
import importlib
import json
import math
import os
import resource
import signal
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from importlib.machinery import SourceFileLoader
from itertools import pairwise
from types import CodeType, FunctionType
from typing import IO, Any, Final

import pytest

from benchmarks import ROOT

IMPORTED: Final = (
    "asyncio",
    "hypothesis",
    "numpy",
    "pydantic",
    "monstertruck_schemas.topics",
    "monstertruck_runtime.clock",
    "monstertruck_runtime.requests",
    "monstertruck_runtime.actors.actor",
    "monstertruck_kinematics.chassis",
)
"""Modules below everything that is mutated; the cold server has imported them."""

OPTIONS: Final = (
    *("-q", "--no-header", "-m", "not wall", "-p", "no:cacheprovider", "-p", "no:cov", "-p", "no:xdist"),
    *("-W", "ignore::pytest.PytestAssertRewriteWarning"),  # the servers have imported some plug-ins already
)

SHARE: Final = 10
"""Times its processor time that a fork may take by the clock: the machine may be busy."""

SURVIVED, KILLED, TIMED_OUT, BROKEN, COLD = "survived", "killed", "timed out", "does not import", "cold"
ENDS: Final = {0: SURVIVED, 1: KILLED, 2: COLD}
"""Verdicts by exit code of a fork; any other: the source does not import."""


class Server:
    """A process that judges mutants.

    Args:
        kind: warm or cold.
        tests: files and folders of tests, for the warm one.
    """

    def __init__(self, kind: str, tests: Iterable[str]) -> None:
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.mutation_parts.runner", kind, *tests],
            cwd=ROOT, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def judge(self, file: str, sound: str, faulty: str, tests: dict[str, float], seconds: float) -> tuple[str, str]:
        """Return the verdict on a faulty ``file``, and the test that killed it; COLD: it cannot judge it.

        Args:
            file: path relative to the project.
            sound: unmodified source.
            faulty: source of the mutant.
            tests: tests in their order, each with its limit of processor time, s.
            seconds: limit of processor time for all of them.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        order = {"file": file, "sound": sound, "faulty": faulty, "tests": tests, "seconds": seconds}
        print(json.dumps(order), file=self._process.stdin, flush=True)
        verdict, test = json.loads(self._process.stdout.readline())
        return verdict, test

    def close(self) -> None:
        """End the server."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()


class _FirstFailure:
    """Pytest plug-in that stops at the first failed test, and runs the given tests first."""

    def __init__(self, first: list[str]) -> None:
        self.test = ""
        self._rank = {test: rank for rank, test in enumerate(first)}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items.sort(key=lambda item: self._rank.get(item.nodeid, len(self._rank)))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and not self.test:
            self.test = report.nodeid


class _Served:
    """Pytest plug-in of the warm server, whose forks run the collected tests."""

    def __init__(self, orders: Iterator[dict[str, Any]], answers: IO[str]) -> None:
        self._orders = orders
        self._answers = answers

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        items = {item.nodeid: item for item in session.items}
        functions: dict[str, list[FunctionType]] = defaultdict(list)
        gc.unfreeze()  # what the tests' own set-up has frozen is not among the objects below
        for found in gc.get_objects():
            if isinstance(found, FunctionType):
                functions[found.__code__.co_filename].append(found)
        gc.freeze()

        def run(order: dict[str, Any]) -> tuple[int, str]:
            path = str(ROOT / order["file"])
            try:
                _exchange(functions[path], order["sound"], order["faulty"], path)
            except ValueError:
                return 2, ""
            found = _FirstFailure([])
            session.config.pluginmanager.register(found)
            for item, following in pairwise([*(items[test] for test in order["tests"]), None]):
                _limit(order["tests"][item.nodeid])
                session.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                if found.test:
                    return 1, found.test
            return 0, ""

        _serve(self._orders, self._answers, run)
        return True


def _limit(seconds: float) -> None:
    """Limit the remaining processor time of this process, and its elapsed time to ``SHARE`` times as much."""
    used, hard = time.process_time(), resource.getrlimit(resource.RLIMIT_CPU)[1]
    resource.setrlimit(resource.RLIMIT_CPU, (min(math.ceil(used + seconds), hard), hard))
    signal.setitimer(signal.ITIMER_REAL, SHARE * seconds)


def _exchange(functions: Collection[FunctionType], sound: str, faulty: str, path: str) -> None:
    """Replace the code of the functions of a file by that of its faulty source.

    Raises:
        ValueError: not possible: the tests themselves import the file, or a function's free variables differ.
    """
    if not functions:
        raise ValueError(path)
    old, new = (_codes(compile(source, path, "exec", dont_inherit=True)) for source in (sound, faulty))
    names = {code: name for name, code in old.items()}
    for function in functions:
        if (name := names.get(function.__code__)) is not None and new[name] != function.__code__:
            function.__code__ = new[name]


def _codes(module: CodeType) -> dict[tuple[str, int], CodeType]:
    """Return the code objects by qualified name, numbered where several have the same."""
    found: dict[tuple[str, int], CodeType] = {}
    seen: Counter[str] = Counter()
    waiting = [module]
    while waiting:
        code = waiting.pop()
        found[code.co_qualname, seen[code.co_qualname]] = code
        seen[code.co_qualname] += 1
        waiting += [constant for constant in code.co_consts if isinstance(constant, CodeType)]
    return found


def _cold(order: dict[str, Any]) -> tuple[int, str]:
    """Import the faulty source and run tests."""
    path, source = str(ROOT / order["file"]), order["faulty"]
    sound = SourceFileLoader.get_code

    def get_code(loader: SourceFileLoader, fullname: str) -> CodeType | None:
        faulty = loader.get_filename(fullname) == path
        return compile(source, path, "exec", dont_inherit=True) if faulty else sound(loader, fullname)

    SourceFileLoader.get_code = get_code  # type: ignore[method-assign, assignment]
    found = _FirstFailure(list(order["tests"]))
    files = sorted({test.split("::")[0] for test in order["tests"]})
    return int(pytest.main(["-x", *OPTIONS, *files], plugins=[found])), found.test


def _serve(
    orders: Iterator[dict[str, Any]], answers: IO[str], run: Callable[[dict[str, Any]], tuple[int, str]]
) -> None:
    """Judge mutants until the orders end."""
    for order in orders:
        print(json.dumps(_forked(lambda order=order: run(order), order["seconds"])), file=answers, flush=True)


def _forked(run: Callable[[], tuple[int, str]], seconds: float) -> tuple[str, str]:
    """Run in a separate process group with limited processor time; return the verdict and its test."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        os.close(read)
        resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(seconds), math.ceil(seconds) + 1))
        code, test = 3, ""
        with contextlib.suppress(BaseException):
            code, test = run()
        os.write(write, test.encode()[:4000])
        os._exit(1 if test else code)
    os.close(write)
    deadline = time.monotonic() + SHARE * seconds
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
    if status is None or os.WIFSIGNALED(status):
        os.close(read)
        return TIMED_OUT, ""
    with os.fdopen(read) as reported:
        test = reported.read()
    return ENDS.get(os.waitstatus_to_exitcode(status), BROKEN), test


def main(kind: str, tests: list[str]) -> None:
    """Serve until the end of standard input."""
    orders, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1):
        os.dup2(null, stream)
    read = (json.loads(line) for line in orders)
    if kind == "warm":
        sys.exit(pytest.main([*OPTIONS, *tests], plugins=[_Served(read, answers)]))
    for name in IMPORTED:
        importlib.import_module(name)
    _serve(read, answers, _cold)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
