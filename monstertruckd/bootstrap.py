"""Set up everything on a bare machine, then run the demo or the tests.

Uses nothing but Python's standard library: no pip, no venv module, no root. It fetches the pinned ``uv`` from the
package index (checked by sha256), lets it build ``.venv`` next to ``pyproject.toml`` from the committed lock file,
and runs the command there. A second run finds everything in place.

    python3 -m monstertruckd.bootstrap demo     the truck maps an unknown room, finds a tag and drives home
    python3 -m monstertruckd.bootstrap try      emulated truck, mapping, planner and page at once
    python3 -m monstertruckd.bootstrap check    lint, types, import contracts, all tests
    python3 -m monstertruckd.bootstrap sync     all packages, nothing run
"""

import hashlib
import io
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import urllib.parse
import urllib.request
import zipfile
from pathlib import Path

if sys.version_info < (3, 11):  # noqa: UP036  # here, because older versions cannot evaluate the annotations below
    print(f"Python 3.11 or newer is needed; this is {platform.python_version()}.", file=sys.stderr)
    sys.exit(2)

UV_VERSION = "0.13.8"
WHEEL_SHA256 = {
    "x86_64": "e18a57b8b352eb7c8feb317b9f6f533c8f0ad9673fd6cf34bbe3cf1a9f6a8984",
    "aarch64": "0b3e8b1a4f5e405e31e2ff33de8af4744831e9f7338539671efbd8c3c94e791d",
}
PROGRAM_SHA256 = {
    "x86_64": "4a7607589912d9c20e86b860b032f7c7f2913c9a3e76f46aef136885387452b8",
    "aarch64": "5aa4427bd923cfdca2d56a3577f60d8fa7825aa3b496fef975dfd6f03db57d28",
}
"""Hash of the program in the wheel, from the wheel's RECORD; compared before it is run."""
ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
TRACED = ("tests/unit/schemas", "tests/unit/gate", "tests/unit/runtime/wire", "tests/unit/drivers")
"""Folders of the tests with a coverage gate (marked in tests/conftest.py)."""
TESTS = ("--dist", "worksteal", "--hypothesis-profile", "ci", "--assert", "plain", "--showlocals", "--durations", "30")
"""Neighbours run in one process, which caches their shared data; property tests have the same examples every time, and
no time limit. Plain pytest draws new ones. Values of local variables stand for those in assertions, whose rewriting
would take as long as a thousand tests. The slowest tests are listed."""
TWO = ("-n", "2")
"""Tests at a time on the two cores of a small computer: one more process would import everything once more, and trucks
and daemons on the wall clock would be late."""
THREE = ("-n", "3")
"""Other tests at a time: some wait for a process or a time-out."""
WALL = (*TWO, *TESTS, "-m", "wall and not long", "-o", "cache_dir=.pytest_cache/wall")
"""Tests on the wall clock. They run together with the other tests, and need a separate cache for failed tests."""
LESS_URGENT = (Path("nice"), "-n", "5")
"""Start of the command of the other tests: tests on the wall clock get the processor first."""
FAILED_ALONE = ("-n", "0", "--last-failed", "--last-failed-no-failures", "none", "--cov-append", "--assert", "rewrite")
KERNELS: tuple[Path, str, str] = (VENV / "bin" / "python", "-m", "monstertruckd.tools.install.kernels")
"""Compiles the kernels of goals and maps, and names each part."""
BYTECODE = ("-m", "compileall", "-q", "-j", "2", "monstertruckd", "drivers", "planners", "schemas", "tests")
"""Python's arguments that compile our own packages and the tests, once for the hundreds of processes that the tests
start: where PYTHONDONTWRITEBYTECODE is set none of them would leave its work to the next."""
EXTRAS = {
    "demo": ("sim", "slam", "planning", "vision"),
    "try": ("sim", "slam", "planning", "station"),
    "check": ("dev",),
    "sync": ("dev",),
}
OWN_CONFIG = frozenset({"--config", "-c"})
"""Options of a demo of another configuration: a lap starts at once, for it needs no kernels."""


def main(arguments: list[str]) -> int:
    """Entry point; returns the exit code of the command."""
    if not arguments or arguments[0] not in EXTRAS:
        print(__doc__)
        return 0 if arguments[:1] in ([], ["-h"], ["--help"]) else 2
    command, *rest = arguments
    sync(EXTRAS[command])
    if command == "check":
        return check(rest)
    if command == "sync":
        return compile_kernels()
    if command == "try" or not OWN_CONFIG.intersection(rest):
        compile_kernels()
    print(f"Step 3 of 3: monstertruckd {' '.join((command, *rest))}", file=sys.stderr)
    return run(VENV / "bin" / "monstertruckd", command, *rest)


def compile_kernels() -> int:
    """Compile the kernels of goals and maps; return the exit code."""
    print(
        "Step 2 of 3: compiling the kernels of planners and mapping: seconds, a minute or two the first time ...",
        file=sys.stderr,
    )
    return run(*KERNELS)


def sync(extras: tuple[str, ...]) -> None:
    """Create or update ``.venv`` with the locked packages of ``extras``; leaves other extras in place.

    Bytecode is compiled here, once: where Python may not write it (PYTHONDONTWRITEBYTECODE, another user's
    environment), every process would compile the libraries again, two seconds of each start that plans a route.
    """
    flags = [flag for extra in extras for flag in ("--extra", extra)]
    command = [
        find_uv(),
        "sync",
        "--frozen",
        "--inexact",
        "--compile-bytecode",
        "--system-certs",
        "--python",
        sys.executable,
        *flags,
    ]
    environment = {name: value for name, value in os.environ.items() if name != "VIRTUAL_ENV"}
    if not VENV.exists():
        size = "a gigabyte or two" if extras == EXTRAS["sync"] else "about 800 MB"
        print(f"Step 1 of 3: installing packages into {VENV}: {size}, the first time only ...", file=sys.stderr)
    code = subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode
    if code:
        raise SystemExit(f"uv could not set up {VENV} for the reason above; run the command again.")


def find_uv() -> str:
    """Path of the pinned ``uv``: in the user's cache, or the machine's own if it is that very program, else fetched."""
    machine = platform.machine()
    if machine not in PROGRAM_SHA256 or platform.libc_ver()[0] != "glibc":
        raise SystemExit(f"{machine} is not supported: expected x86_64 or aarch64 Linux with glibc >= 2.28.")
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "monstertruckd"
    target = cache / f"uv-{UV_VERSION}"
    own = shutil.which("uv")
    for place in (target, *([] if own is None else [Path(own)])):
        if place.is_file() and sha256(place.read_bytes()) == PROGRAM_SHA256[machine]:
            return str(place)
    print(f"Fetching uv {UV_VERSION} ...", file=sys.stderr)
    try:
        program = fetch_uv(machine)
    except OSError as error:
        raise SystemExit(
            f"uv {UV_VERSION} cannot be fetched: {error}. Check that the package index is reachable."
        ) from None
    if sha256(program) != PROGRAM_SHA256[machine]:
        raise SystemExit(f"uv {UV_VERSION}: the program in the wheel has a different sha256 and is not used.")
    try:
        cache.mkdir(parents=True, exist_ok=True)
        scratch = target.with_suffix(f".{os.getpid()}")
        scratch.write_bytes(program)
        scratch.chmod(0o755)
        scratch.replace(target)
    except OSError as error:
        reason = f"{cache} cannot be written: {error.strerror}"
        raise SystemExit(f"{reason}. Choose a folder of yours: XDG_CACHE_HOME=FOLDER") from None
    return str(target)


def sha256(data: bytes) -> str:
    """Hexadecimal digest."""
    return hashlib.sha256(data).hexdigest()


def fetch_uv(machine: str) -> bytes:
    """Download the pinned wheel from the package index, compare its sha256, and take the program out of it."""
    index = os.environ.get("UV_DEFAULT_INDEX") or os.environ.get("PIP_INDEX_URL") or "https://pypi.org/simple"
    page_url = f"{index.rstrip('/')}/uv/"
    with urllib.request.urlopen(page_url, timeout=60) as reply:
        page = reply.read().decode()
    pattern = rf'href="([^"#]*/uv-{re.escape(UV_VERSION)}-[^"#]*)#sha256={WHEEL_SHA256[machine]}"'
    found = re.search(pattern, page)
    if found is None:
        raise SystemExit(f"{page_url} does not list the pinned uv {UV_VERSION} for {machine}.")
    with urllib.request.urlopen(urllib.parse.urljoin(page_url, found[1]), timeout=300) as reply:
        wheel = reply.read()
    if sha256(wheel) != WHEEL_SHA256[machine]:
        raise SystemExit(f"uv {UV_VERSION}: the file from {found[1]} has a different sha256 and is not used.")
    with zipfile.ZipFile(io.BytesIO(wheel)) as archive:
        name = next(name for name in archive.namelist() if name.endswith("/scripts/uv"))
        return archive.read(name)


def run(program: Path, *arguments: str) -> int:
    """Run a program of the environment from the project's root."""
    return subprocess.run([str(program), *arguments], cwd=ROOT, check=False).returncode


def check(arguments: list[str]) -> int:
    """All checks but the long tests, fastest first; stops at the first failure, but for the last two steps.

    ``arguments`` go to pytest. Tests on the wall clock mostly wait: they run together with the tests that compute.

    Failed tests are run once more, one at a time: on a busy computer some miss a time-out while others run.
    Both results are printed; one that fails again fails the check.
    """
    tools = VENV / "bin"
    pytest = tools / "pytest"
    run(KERNELS[0], *BYTECODE)
    compiling = subprocess.Popen(KERNELS, cwd=ROOT)  # while checks without it run: it keeps one core busy for a minute
    try:
        code = steps(
            (Path(find_uv()), ["lock", "--check", "--quiet", "--system-certs"]),
            (tools / "ruff", ["check", "."]),
            (tools / "ruff", ["format", "--check", "."]),
            (tools / "lint-imports", []),
            (tools / "mypy", []),
            (pytest, [*TWO, *TESTS, "-m", "traced and not wall", "--cov", "--cov-report=", *TRACED]),
            (tools / "coverage", ["report"]),
        )
        if code:
            return code
        print(f"==> {' '.join(map(str, KERNELS))}", flush=True)
        code = compiling.wait()  # no test's time-out counts a compilation
        if code:
            return code
    finally:
        compiling.kill()
        compiling.wait()
    return both(pytest, [*WALL, *arguments], [*THREE, *TESTS, "-m", "not wall and not traced and not long", *arguments])


def both(pytest: Path, wall: list[str], others: list[str]) -> int:
    """Run the tests on the wall clock and all others at once, then failed tests alone; return the exit code, or 0.

    The output of the tests on the wall clock is printed at their end.
    """
    with tempfile.TemporaryFile() as output:
        other = subprocess.Popen([str(pytest), *wall], cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)
        try:
            nice, *niceness = LESS_URGENT
            code = step(nice, [*niceness, str(pytest), *others])
            print(f"==> pytest {' '.join(wall)}", flush=True)
            wall_code = other.wait()
        finally:
            other.terminate()
            other.wait()
            output.seek(0)
            sys.stdout.flush()
            shutil.copyfileobj(output, sys.stdout.buffer)  # whatever the encoding of the terminal
            sys.stdout.flush()
    return retried(pytest, others, code) or retried(pytest, wall, wall_code)


def steps(*programs: tuple[Path, list[str]]) -> int:
    """Run the checks in order; return the exit code of the first that fails, or 0."""
    for program, arguments in programs:
        code = retried(program, arguments, step(program, arguments))
        if code:
            return code
    return 0


def retried(program: Path, arguments: list[str], code: int) -> int:
    """Run failed tests once more, alone, if ``code`` is that of failed tests; return the exit code."""
    if program.name == "pytest" and code == 1:  # exit code of pytest; others mean that it did not run them
        return step(program, [*arguments, *FAILED_ALONE])
    return code


def step(program: Path, arguments: list[str]) -> int:
    """Run one check and print its name; return its exit code."""
    print(f"==> {program.name} {' '.join(arguments)}", flush=True)
    return run(program, *arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
