"""Which of Zenoh's threads wait for a station's link, and in which messages are taken."""

import ctypes
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

import zenoh
from zenoh import handlers

VARIABLE: Final = "ZENOH_RUNTIME"
"""Where Zenoh's run-time looks, once, for how many threads do what."""


@contextmanager
def readers_watch_links() -> Iterator[None]:
    """Open a process's first Zenoh session herein, and the threads that read its links also wait for their bytes.

    By default another thread waits and wakes one of those, which takes a sixth of a round trip. It goes for links the
    process dials, and is for stations only: a robot passes messages on, and while its readers wait for room in the
    queue of one link, somebody must notice that there is room. What the user has set in the environment stands.
    """
    if VARIABLE in os.environ:
        yield
        return
    os.environ[VARIABLE] = "(app: (handover: rx))"
    try:
        yield
    finally:
        os.environ.pop(VARIABLE, None)  # not for the programs it starts later: they may be robots


def in_network_thread(take: Callable[[zenoh.Sample], None]) -> "handlers.Callback[zenoh.Sample]":
    """Handler that calls ``take`` in the thread that reads the network; zenoh-python's own way is one thread further.

    While it runs nothing else is read from that link: it must be quick, and must not use the session. The interpreter's
    state of that thread is kept; made anew for every message, it costs more than the way to another thread.
    """
    kept = threading.local()

    def receive(sample: zenoh.Sample) -> None:
        if not hasattr(kept, "state"):
            kept.state = ctypes.pythonapi.PyGILState_Ensure()  # never released
        take(sample)

    return handlers.Callback(receive, indirect=False)
