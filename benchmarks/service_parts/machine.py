"""A Debian that boots: made by mmdebstrap, run by systemd-nspawn, both installed from Debian if missing."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from time import monotonic, sleep

SUITE = "bookworm"
PACKAGES = ("systemd", "systemd-sysv", "dbus", "udev", "python3", "ca-certificates")
TOOLS = {"mmdebstrap": "mmdebstrap", "systemd-nspawn": "systemd-container", "nsenter": "util-linux"}
"""Programs, and the Debian packages they are in."""
CERTIFICATES = Path("/etc/ssl/certs")
PASSED_ON = ("http_proxy", "https_proxy", "no_proxy", "UV_DEFAULT_INDEX", "PIP_INDEX_URL")
"""Settings of this computer's environment by which the package index is reached."""
Output = subprocess.CompletedProcess[str]


class NotBootedError(Exception):
    """The machine did not boot."""


def install_tools() -> None:
    """Install missing programs.

    Raises:
        NotBootedError: not root, or Debian's packages are not available.
    """
    missing = sorted({package for program, package in TOOLS.items() if shutil.which(program) is None})
    if os.geteuid() != 0:
        raise NotBootedError(f"needs root, for systemd-nspawn and mmdebstrap (missing packages: {missing or 'none'})")
    if missing:
        print(f"apt-get install {' '.join(missing)}", file=sys.stderr)
        for command in (["apt-get", "update"], ["apt-get", "install", "-y", "--no-install-recommends", *missing]):
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                raise NotBootedError(f"{' '.join(command)}: {(done.stderr or done.stdout).strip()}")


class Machine:
    """A root folder and, while it is booted, the container on it.

    Args:
        root: folder of the system.
        log: receives the console's output.
    """

    def __init__(self, root: Path, log: Path) -> None:
        self.root = root
        self._log = log
        self._leader = 0

    def build(self) -> None:
        """Make a new minimal Debian in the root folder, which must be empty.

        Raises:
            NotBootedError: mmdebstrap failed.
        """
        packages = f"--include={','.join(PACKAGES)}"
        done = subprocess.run(
            ["mmdebstrap", "--variant=minbase", packages, SUITE, str(self.root)],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise NotBootedError(f"mmdebstrap: {done.stderr.strip()[-2000:]}")

    def prepare(self, folder: Path, command: Sequence[str], caches: Mapping[Path, str]) -> None:
        """Run a command in the system before its boot, with this computer's network.

        Args:
            folder: working directory in the system.
            command: program and arguments.
            caches: folders of this computer, and their paths in the system.

        Raises:
            NotBootedError: it failed.
        """
        binds = [f"--bind={here}:{there}" for here, there in caches.items() if here.is_dir()]
        settings = [f"--setenv={name}={os.environ[name]}" for name in PASSED_ON if name in os.environ]
        done = subprocess.run(
            [
                *("systemd-nspawn", "--quiet", "--register=no", "--keep-unit", "--pipe", f"--directory={self.root}"),
                *("--resolv-conf=bind-host", f"--bind-ro={CERTIFICATES}", f"--chdir={folder}", *binds, *settings),
                f"--setenv=SSL_CERT_FILE={CERTIFICATES / 'ca-certificates.crt'}",
                *command,
            ],
            capture_output=True,
            text=True,
            check=False,
            stdin=subprocess.DEVNULL,
        )
        if done.returncode:
            raise NotBootedError(f"{' '.join(command)} in {self.root}: {(done.stderr or done.stdout).strip()[-2000:]}")

    @contextmanager
    def booted(self, within: float = 60.0) -> Iterator[None]:
        """Run the container, with a separate network, and /sys writable for its udev.

        Raises:
            NotBootedError: its systemd did not start; the text is the end of its console.
        """
        with self._log.open("ab") as log:
            container = subprocess.Popen(
                [
                    *("systemd-nspawn", "--boot", "--register=no", "--keep-unit", "--private-network"),
                    *("--machine=truck", "--console=pipe", f"--directory={self.root}"),
                ],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=os.environ | {"SYSTEMD_NSPAWN_API_VFS_WRITABLE": "1"},
            )
        try:
            self._leader = self._find_leader(container, within)
            if not until(self._up, within):
                state = self.run("sh", "-c", "systemctl is-system-running; systemctl list-jobs --no-pager", check=False)
                raise NotBootedError(self._why(f"systemd did not come up: {state.stdout}{state.stderr}"))
            yield
        finally:
            container.send_signal(signal.SIGTERM)  # an orderly power-off
            try:
                container.wait(90)
            except subprocess.TimeoutExpired:
                container.kill()
                container.wait()
            self._leader = 0

    def run(self, *command: str, check: bool = True) -> Output:
        """Run a command as root inside.

        Raises:
            NotBootedError: it failed, unless ``check`` is off.
        """
        done = subprocess.run(
            ["nsenter", f"--target={self._leader}", *("--mount", "--uts", "--ipc", "--net", "--pid"), "--", *command],
            capture_output=True,
            text=True,
            check=False,
            stdin=subprocess.DEVNULL,
            cwd="/",
            env={"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LANG": "C.UTF-8", "HOME": "/root"},
        )
        if check and done.returncode:
            raise NotBootedError(f"{' '.join(command)}: ended with {done.returncode}: {done.stdout}{done.stderr}")
        return done

    def show(self, unit: str, *names: str) -> dict[str, str]:
        """Return properties of a unit from systemd; "": of systemd itself."""
        units = [unit] if unit else []
        lines = self.run("systemctl", "show", f"--property={','.join(names)}", *units).stdout.splitlines()
        return dict(line.split("=", 1) for line in lines if "=" in line)

    def _up(self) -> bool:
        state = self.run("systemctl", "is-system-running", check=False).stdout.strip()
        return state in ("running", "degraded")

    def _find_leader(self, container: subprocess.Popen[bytes], within: float) -> int:
        children = Path(f"/proc/{container.pid}/task/{container.pid}/children")
        leaders: list[int] = []

        def found() -> bool:
            if container.poll() is not None:
                raise NotBootedError(self._why(f"systemd-nspawn ended with {container.returncode}"))
            leaders[:] = filter(_is_first, map(int, children.read_text().split()))
            return bool(leaders)

        if not until(found, within):
            raise NotBootedError(self._why("systemd-nspawn started nothing"))
        return leaders[0]

    def _why(self, what: str) -> str:
        said = self._log.read_text(errors="replace").strip().splitlines()[-20:]
        return "\n".join([what, *said])


def _is_first(pid: int) -> bool:
    """Whether a process is the init process of a container."""
    with suppress(OSError):
        status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
        return any(line.startswith("NSpid:") and line.endswith("\t1") for line in status.splitlines())
    return False


def until(condition: Callable[[], bool], within: float, every: float = 0.05) -> bool:
    """Whether the condition becomes true within this time (s)."""
    end = monotonic() + within
    while not condition():
        if monotonic() > end:
            return False
        sleep(every)
    return True
