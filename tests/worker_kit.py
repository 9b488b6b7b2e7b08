"""Workers that count, sleep, hang, raise and die, for tests of the actor."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np


class Counter:
    """State that grows with every step, and an order for everything that can go wrong."""

    built = 0

    def __init__(self):
        self.steps = 0
        Counter.built += 1

    def step(self, inputs):
        self.steps += 1
        match inputs:
            case {"sleep": seconds}:
                time.sleep(seconds)
            case {"die": code}:
                os._exit(code)
            case {"raise": text}:
                raise ValueError(text)
            case {"double": array}:
                return np.asarray(array) * 2
            case "facts":
                return {
                    "pid": os.getpid(),
                    "name": Path("/proc/self/comm").read_text().strip(),
                    "built": self.built,
                    "folder": str(Path.cwd()),
                    "environment": dict(os.environ),
                    "nice": os.nice(0),
                    "threads": os.environ["OMP_NUM_THREADS"],
                    "modules": sorted(sys.modules),
                }
        return self.steps


class Hanging:
    """Never comes back from its first step."""

    def step(self, inputs):
        time.sleep(600)


class Stopping:
    """Stops in the middle of its first answer."""

    def step(self, inputs):
        opened = {path.name: path.readlink().name for path in Path("/proc/self/fd").iterdir() if path.is_symlink()}
        connection = max(int(number) for number, name in opened.items() if name.startswith("socket:"))
        os.write(connection, (1000).to_bytes(4, "big") + b"part")
        os.kill(os.getpid(), signal.SIGSTOP)


def broken():
    msg = "no model file"
    raise OSError(msg)


def slow_to_build():
    time.sleep(60)


def slow_to_build_once():
    time.sleep(0.5)
    return Counter()


def runs_a_program():
    with subprocess.Popen(["true"]) as program:
        os.waitid(os.P_PID, program.pid, os.WEXITED | os.WNOWAIT)
    return Counter()


def ends_itself():
    raise SystemExit("no licence")
