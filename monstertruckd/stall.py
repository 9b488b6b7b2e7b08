"""Finds out what a control tick that does not come waits for: a thread dumps all tracebacks."""

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

log = logging.getLogger(__name__)

STALL: Final = 0.2
"""Seconds without a tick that are worth a dump."""
LOOK: Final = 0.05
"""Seconds between two looks."""
HELD: Final = 1.0
"""Seconds after which the interpreter's own watchdog, which needs no interpreter lock, dumps for this thread."""
INTERVAL: Final = 60.0
"""Least seconds between two dumps."""
KEPT: Final = 20
"""Dumps kept in the folder."""

_NAME: Final = re.compile(r"stall-(\d{6,})\.txt")
_HELD_NAME: Final = "stalling.txt"


class StallWatch:
    """Service that watches the control tick from a thread of its own.

    A dump goes to the log, which another thread writes, and into a file. While an extension holds the interpreter's
    lock no Python thread runs; then faulthandler's C thread writes the file, and the log follows once there is an end
    to it, or at the next start.

    Args:
        clock: time; readable from any thread.
        ticks: how many ticks there were; readable from any thread.
        folder: for the files.
        stall: seconds, see ``STALL``.
        held: seconds, see ``HELD``.
        interval: seconds, see ``INTERVAL``.
    """

    name = "stalls"

    def __init__(
        self,
        clock: Clock,
        ticks: Callable[[], int],
        folder: Path,
        *,
        stall: float = STALL,
        held: float = HELD,
        interval: float = INTERVAL,
    ) -> None:
        self._clock = clock
        self._ticks = ticks
        self._folder = folder
        self._stall = round(stall * SECOND)
        self._held = held
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
        """The thread."""
        file = self._open()
        try:
            self._look_for_ever(file)
        finally:
            if file is not None:
                faulthandler.cancel_dump_traceback_later()
                os.close(file)

    def _look_for_ever(self, file: int | None) -> None:
        seen, since, looked = 0, self._clock.now(), self._clock.now()
        stalled = False
        armed = 0
        while not self._ending.wait(LOOK):
            now, ticks = self._clock.now(), self._ticks()
            if file is not None:
                self._report_held(file)
                if now - armed >= self._held * SECOND / 4:
                    armed = now
                    faulthandler.dump_traceback_later(self._held, file=file)
            if now - looked > self._stall:
                since = now  # nor did this thread run: the whole process was stopped, or the lock was held
            looked = now
            if ticks != seen:
                if stalled:
                    log.warning("the control tick is back after %.2f s", (now - since) / SECOND)
                seen, since, stalled = ticks, now, False
            elif seen and not stalled and now - since > self._stall:
                stalled = True
                self._dump(now - since)

    def _dump(self, silent: int) -> None:
        """Dump now, unless that was done a moment ago."""
        if not self._due():
            return
        memory = os.memfd_create("stall")
        try:
            faulthandler.dump_traceback(file=memory)
            text = _taken(memory)
        finally:
            os.close(memory)
        self._tell(f"no control tick for {silent / SECOND:.2f} s", text)

    def _report_held(self, file: int) -> None:
        """Take over what the C thread wrote while the lock was held."""
        if os.fstat(file).st_size:
            faulthandler.cancel_dump_traceback_later()  # waits until all of it is written
            text = _taken(file)
            if self._due():
                self._tell(f"no Python thread ran for {self._held:g} s", text)

    def _due(self) -> bool:
        now = self._clock.now()
        if self._dumped is not None and now - self._dumped < self._interval:
            return False
        self._dumped = now
        return True

    def _tell(self, what: str, text: str) -> None:
        log.error("%s; all threads:\n%s", what, text)
        try:
            number = self._make_room()
            path = self._folder / f"stall-{number:06d}.txt"
            path.write_text(f"{what}\n{text}")
        except OSError as error:
            log.warning("tracebacks are in the log only: %s", error)
        else:
            log.warning("tracebacks are in %s", path)

    def _make_room(self) -> int:
        """Remove the oldest dumps; the next one's number."""
        self._folder.mkdir(parents=True, exist_ok=True)
        found = sorted((int(name[1]), path) for path in self._folder.iterdir() if (name := _NAME.fullmatch(path.name)))
        for _, path in found[: max(0, len(found) - KEPT + 1)]:
            path.unlink(missing_ok=True)
        return found[-1][0] + 1 if found else 1

    def _open(self) -> int | None:
        """File for the C thread; what it holds already is of a daemon that was killed in such a state."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            file = os.open(self._folder / _HELD_NAME, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        except OSError as error:
            log.warning("a stall with the interpreter's lock held would leave no file: %s", error)
            return None
        if os.fstat(file).st_size:
            self._tell("the daemon was killed while no Python thread ran", _taken(file))
        return file


def _taken(file: int) -> str:
    """All of the file, which is empty afterwards."""
    data = os.pread(file, os.fstat(file).st_size, 0)
    os.ftruncate(file, 0)
    os.lseek(file, 0, os.SEEK_SET)
    return data.decode(errors="replace")
