"""Memory settings of the garbage collector, the C library and the kernel for this process."""

import ctypes
import gc
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

_LIBRARY: Final = ctypes.CDLL(None)


def settle() -> None:
    """Make the loaded objects permanent: the garbage collector skips them, and they move to huge pages.

    A full collection of them takes tens of milliseconds, repeatedly. Fewer pages also save a few hundredths of the
    processor time of a loop that sleeps between short callbacks and so runs with cold caches. Takes up to a third of a
    second: call it at the end of start-up, before the robot can move.
    """
    gc.collect()
    gc.freeze()
    huge = 2 * 1024 * 1024  # size of a huge page, bytes; if it differs the kernel refuses, without harm
    with suppress(OSError):  # /proc may be hidden
        for begin, end in _heaps():
            for page in range(-(-begin // huge) * huge, end - huge + 1, huge):
                # 25: see madvise(2), Linux 6.1 and later; the C library's headers came later
                _LIBRARY.madvise(ctypes.c_void_p(page), ctypes.c_size_t(huge), 25)


def give_back() -> None:
    """Return free memory pages, including those between used ones, to the system; otherwise the heap keeps them.

    Takes about a millisecond for 200 MB; no effect without glibc's ``malloc_trim``.
    """
    trim = getattr(_LIBRARY, "malloc_trim", None)
    if trim is not None:
        trim(0)


def _heaps() -> Iterator[tuple[int, int]]:
    """Address ranges of the heaps of the C library and of Python."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        span, rights, _, _, _, *name = line.split()
        if rights.startswith("rw") and name in ([], ["[heap]"]):
            begin, _, end = span.partition("-")
            yield int(begin, 16), int(end, 16)
