"""Diagnosis of a stalled control tick: a thread dumps all tracebacks."""

import asyncio
import faulthandler
import logging
import os
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.ports import Ready
from monstertruck_runtime.threads import in_thread
from monstertruck_schemas.roles import ServiceName

log = logging.getLogger(__name__)

KEPT_DUMPS: Final = 20
"""Maximum number of dumps kept in the folder."""

_NAME: Final = re.compile(r"stall-(\d{6,})\.txt")


class StallWatch:
    """Service that watches the control tick from a separate thread.

    A dump goes to a file and to the log, which another thread writes; on a terminal the log shows only the file name.
    The dump is made with the interpreter lock held. An extension that never releases the lock is left to systemd's
    watchdog, whose SIGABRT stops the process without a dump. ``faulthandler.dump_traceback_later`` is not used: it
    walks the stacks of running threads, which crashed a daemon that was merely stopped and continued.

    Args:
        clock: time source; readable from any thread.
        ticks: number of ticks so far; readable from any thread.
        folder: folder of the dumps.
        stall: time without a tick that triggers a dump (s).
        interval: minimum interval between dumps (s).
    """

    name = ServiceName.STALLS.value

    def __init__(
        self,
        clock: Clock,
        ticks: Callable[[], int],
        folder: Path,
        *,
        stall: float = 0.2,
        interval: float = 60.0,
    ) -> None:
        self._clock = clock
        self._ticks = ticks
        self._folder = folder
        self._stall = round(stall * SECOND)
        self._interval = round(interval * SECOND)
        self._ending = threading.Event()
        self._dumped: int | None = None

    async def run(self, ready: Ready) -> None:
        """Watch until cancelled."""
        self._ending.clear()
        thread = threading.Thread(target=self._watch, name=self.name, daemon=True)
        thread.start()
        ready()
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            self._ending.set()
            await in_thread(thread.join)

    def _watch(self) -> None:
        """Watch the ticks; runs in the thread."""
        seen, since, looked = 0, self._clock.now(), self._clock.now()
        stalled = False
        while not self._ending.wait(0.05):  # interval between checks (s)
            now, ticks = self._clock.now(), self._ticks()
            if now - looked > self._stall:
                since = now  # this thread did not run either: the whole process was stopped, or the lock was held
            looked = now
            if ticks != seen:
                if stalled:
                    log.warning("the control tick is back after %.2f s", (now - since) / SECOND)
                seen, since, stalled = ticks, now, False
            elif seen and not stalled and now - since > self._stall:
                stalled = True
                self._dump(now - since)

    def _dump(self, silent: int) -> None:
        """Dump now, unless the last dump was less than the interval ago."""
        now = self._clock.now()
        if self._dumped is not None and now - self._dumped < self._interval:
            return
        self._dumped = now
        what, text = f"no control tick for {silent / SECOND:.2f} s", _tracebacks()
        brief = None
        try:
            number = self._make_room()
            path = self._folder / f"stall-{number:06d}.txt"
            path.write_text(f"{what}\n{text}")
        except OSError as error:
            log.warning("tracebacks are in the log only: %s", error)
        else:
            brief = f"{what}; the tracebacks of all threads at that time are in {path}"
        log.error("%s; all threads:\n%s", what, text, extra={"brief": brief})

    def _make_room(self) -> int:
        """Remove the oldest dumps; return the number of the next one."""
        self._folder.mkdir(parents=True, exist_ok=True)
        found = sorted((int(name[1]), path) for path in self._folder.iterdir() if (name := _NAME.fullmatch(path.name)))
        for _, path in found[: max(0, len(found) - KEPT_DUMPS + 1)]:
            path.unlink(missing_ok=True)
        return found[-1][0] + 1 if found else 1


def _tracebacks() -> str:
    """Return the tracebacks of all threads."""
    with os.fdopen(os.memfd_create("stall"), "w+b") as memory:
        faulthandler.dump_traceback(file=memory)
        memory.seek(0)
        return memory.read().decode(errors="backslashreplace")
