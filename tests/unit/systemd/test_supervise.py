"""The supervisor for computers without systemd: restarts, watchdog, stop command, orderly end."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.wall

SCRIPT = Path(__file__).resolve().parents[3] / "systemd" / "supervise.py"
READY = "import os, socket, sys, time; s = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM); "
READY += "s.connect(os.environ['NOTIFY_SOCKET']); s.send(b'READY=1\\nSTATUS=x'); "


def supervised(code: str, folder: Path, watchdog: str = "3"):
    """A supervised Python program; it and the stop command write a line each into ``folder / "lines"``."""
    note = f"open({str(folder / 'lines')!r}, 'a').write"
    command = (sys.executable, "-c", f"{note}('start\\n'); {code}")
    stop = (sys.executable, "-c", f"{note}('stop\\n')")
    words = (sys.executable, str(SCRIPT), "--watchdog", watchdog, *command, "--", *stop)
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True)


def lines(folder: Path, count: int) -> list[str]:
    """Lines, once there are so many."""
    file, until = folder / "lines", time.monotonic() + 20.0
    while time.monotonic() < until:
        found = file.read_text().splitlines() if file.exists() else []
        if len(found) >= count:
            return found
        time.sleep(0.02)
    raise AssertionError(found)


def ended(running, number=signal.SIGTERM) -> tuple[int, str]:
    """Exit code and output after a signal."""
    running.send_signal(number)
    text, _ = running.communicate(timeout=20)
    return running.returncode, text


def test_a_command_that_dies_is_started_again_after_the_stop_command(tmp_path: Path):
    running = supervised("sys = __import__('sys'); sys.exit(3)", tmp_path)
    assert lines(tmp_path, 3)[:3] == ["start", "stop", "start"]
    assert "ended with 3: next start in 1 s" in ended(running)[1]


def test_a_silent_command_is_aborted_and_one_that_pings_is_not(tmp_path: Path):
    running = supervised(
        READY + "[(time.sleep(0.1), s.send(b'WATCHDOG=1')) for _ in range(8)]; time.sleep(60)", tmp_path, "0.4"
    )
    begin = time.monotonic()
    assert lines(tmp_path, 2)[:2] == ["start", "stop"]
    assert time.monotonic() - begin > 0.8
    lines(tmp_path, 3)
    assert f"is silent: aborted\nsupervise: {sys.executable} ended with -6" in ended(running)[1]


def test_a_signal_ends_the_command_then_the_supervision_with_its_code(tmp_path: Path):
    running = supervised(READY + "import signal; signal.signal(15, lambda *_: sys.exit(7)); time.sleep(60)", tmp_path)
    assert lines(tmp_path, 1) == ["start"]
    time.sleep(0.5)  # until it has its handler
    assert ended(running, signal.SIGINT)[0] == 7
    assert lines(tmp_path, 2) == ["start", "stop"]


def test_without_a_command_it_explains_itself():
    done = subprocess.run([sys.executable, str(SCRIPT)], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "supervise.py [--watchdog SECONDS] COMMAND" in done.stderr


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["no-such-daemon"], "supervise: no-such-daemon: no such program, or it is not executable"),
        (["true", "--", "no-such-stop"], "supervise: no-such-stop: no such program, or it is not executable"),
        (["--watchdog", "soon", "true"], "supervise: --watchdog: expected seconds, such as 3"),
        (["--watchdog"], "supervise: --watchdog: expected seconds, such as 3"),
    ],
)
def test_a_wrong_command_line_is_refused_before_anything_starts(words: list[str], text: str):
    done = subprocess.run([sys.executable, str(SCRIPT), *words], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.strip()) == (2, text)


def test_help_explains_it():
    done = subprocess.run([sys.executable, str(SCRIPT), "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "COMMAND... [-- STOP...]" in done.stdout
