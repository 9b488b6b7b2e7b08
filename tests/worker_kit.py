"""Workers that count, sleep, hang, raise and die, for tests of the actor."""

import os
import signal
import sys
import time

import numpy as np


class Counter:
    """State that grows with every step, and an order for everything that can go wrong."""

    def __init__(self):
        self.steps = 0

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
        os.write(int(sys.argv[1]), (1000).to_bytes(4, "big") + b"part")
        os.kill(os.getpid(), signal.SIGSTOP)


def broken():
    msg = "no model file"
    raise OSError(msg)


def slow_to_build():
    time.sleep(60)
