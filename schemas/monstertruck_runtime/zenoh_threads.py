"""In which of Zenoh's threads messages are taken."""

import ctypes
import threading
from collections.abc import Callable

import zenoh
from zenoh import handlers


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
