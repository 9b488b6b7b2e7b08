"""Start the daemon and stop the drives after each of its deaths, on a computer or in a container without systemd.

    python3 supervise.py [--watchdog SECONDS] COMMAND... [-- STOP...]

It does what ``monstertruckd.service`` asks of systemd: COMMAND gets a notification socket and a watchdog, fed only
while the control tick advances. A command that falls silent is aborted (SIGABRT, SIGKILL a second later). Whenever the
command ends, STOP runs, for instance ``python3 neutral.py /dev/truck/drive``, and a second later the command is started
again. SIGTERM and SIGINT end the command, then this program, with the command's exit code. Uses nothing but Python's
standard library.
"""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

WATCHDOG = 3.0
"""Seconds without a ping after which a ready command is aborted; WatchdogSec of the unit."""
START = 30.0
"""Seconds in which a command gets ready; TimeoutStartSec of the unit."""
ABORT = 1.0
"""Seconds from SIGABRT to SIGKILL; TimeoutAbortSec of the unit."""
STOP = 30.0
"""Seconds from SIGTERM to SIGKILL; TimeoutStopSec of the unit."""
PAUSE = 1.0
"""Seconds from the end of the command to its next start; RestartSec of the unit."""


class Supervisor:
    """Runs a command until it has to end.

    Args:
        command: its words.
        stop: words of the command that runs after each end; none if empty.
        watchdog: s.
    """

    def __init__(self, command: Sequence[str], stop: Sequence[str], watchdog: float = WATCHDOG) -> None:
        self._command, self._stop, self._watchdog = list(command), list(stop), watchdog
        self._ending = False

    def end(self, *_: object) -> None:
        """End the command, then the supervision."""
        self._ending = True

    def run(self) -> int:
        """Return the exit code of the command that had to end."""
        code = 0
        while not self._ending:
            code = self._once()
            if self._stop:
                subprocess.run(self._stop, check=False)
            if not self._ending:
                print(f"supervise: {self._command[0]} ended with {code}: next start in {PAUSE:g} s", flush=True)
                time.sleep(PAUSE)
        return code

    def _once(self) -> int:
        with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as news:
            place = str(Path(folder) / "notify")
            news.bind(place)
            news.settimeout(0.1)
            environment = {"NOTIFY_SOCKET": place, "WATCHDOG_USEC": str(round(self._watchdog * 1e6))}
            with subprocess.Popen(self._command, env=os.environ | environment, start_new_session=True) as process:
                try:
                    self._watch(process, news)
                finally:
                    self._sweep(process.pid)
                return process.wait()

    def _watch(self, process: "subprocess.Popen[bytes]", news: socket.socket) -> None:
        """Return once the process has ended or was killed."""
        due, ending = time.monotonic() + START, False
        while process.poll() is None:
            words = _words(news)
            if not ending and words & {b"READY=1", b"WATCHDOG=1"}:
                due = time.monotonic() + self._watchdog
            if self._ending and not ending:
                ending, due = True, time.monotonic() + STOP
                process.terminate()
            if time.monotonic() < due:
                continue
            if not ending:
                print(f"supervise: {self._command[0]} is silent: aborted", flush=True)
                process.send_signal(signal.SIGABRT)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(ABORT)
            process.kill()
            process.wait()

    @staticmethod
    def _sweep(group: int) -> None:
        """Kill the worker processes that the command has left."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(group, signal.SIGKILL)


def _words(news: socket.socket) -> set[bytes]:
    try:
        return set(news.recv(4096).split(b"\n"))
    except TimeoutError:
        return set()


def main(words: list[str]) -> int:
    """Entry point; returns the exit code."""
    watchdog = WATCHDOG
    if words[:1] == ["--help"]:
        print(__doc__)
        return 0
    if words[:1] == ["--watchdog"]:
        try:
            watchdog, words = float(words[1]), words[2:]
        except (IndexError, ValueError):
            print("supervise: --watchdog: expected seconds, such as 3", file=sys.stderr)
            return 2
    at = words.index("--") if "--" in words else len(words)
    if not words[:at]:
        print(__doc__, file=sys.stderr)
        return 2
    command, stop = words[:at], words[at + 1 :]
    for program in (command[0], *stop[:1]):
        if shutil.which(program) is None:
            print(f"supervise: {program}: no such program, or it is not executable", file=sys.stderr)
            return 2
    supervisor = Supervisor(command, stop, watchdog)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, supervisor.end)
    return supervisor.run()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
