"""Settings of the garbage collector, the C library and the kernel for a process's memory."""

import ctypes
import gc
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

_LIBRARY: Final = ctypes.CDLL(None)


def settle() -> None:
    """Declare the loaded objects permanent: the collector skips them, and they move into huge pages.

    A full collection over it takes tens of milliseconds, again and again. And a loop that sleeps between short
    callbacks finds caches and address translation cold: fewer pages save it a few hundredths of its processor time.
    Takes up to a third of a second: for the end of start-up, before anything moves.
    """
    gc.collect()
    gc.freeze()
    huge = 2 * 1024 * 1024  # bytes of a huge page; where it is another size the kernel refuses, and nothing is lost
    with suppress(OSError):  # /proc may be hidden
        for begin, end in _heaps():
            for page in range(-(-begin // huge) * huge, end - huge + 1, huge):
                # 25: see madvise(2), Linux 6.1 and later; the C library's headers came later
                _LIBRARY.madvise(ctypes.c_void_p(page), ctypes.c_size_t(huge), 25)


def give_back() -> None:
    """Return free pages to the system, also between used ones; the heap keeps them otherwise.

    About a millisecond for 200 MB; nothing where the C library cannot (it is glibc's ``malloc_trim``).
    """
    trim = getattr(_LIBRARY, "malloc_trim", None)
    if trim is not None:
        trim(0)


def _heaps() -> Iterator[tuple[int, int]]:
    """Address ranges of the C library's and Python's own memory."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        span, rights, _, _, _, *name = line.split()
        if rights.startswith("rw") and name in ([], ["[heap]"]):
            begin, _, end = span.partition("-")
            yield int(begin, 16), int(end, 16)
