"""Processes of a measurement, and the orders that prepare it."""

import asyncio
import os
import resource
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from benchmarks import ROOT
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.errors import TruckError
from monstertruck_schemas.req import Order

TO_AND_FRO = {"gate": {"obstacle": {"unseen": "slow"}}}
"""Overlay of a truck that drives to and fro: it has not seen the ground behind it, and stops before that otherwise."""
ORDER_TIMEOUT = 40.0
"""Seconds for which an order that is refused is given again."""


def on_stderr(line: str) -> None:
    """Print a line of the simulator to standard error, which benchmarks do not read."""
    print(line, file=sys.stderr, flush=True)


@asynccontextmanager
async def process(core: int | None, output: Path, *arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a Python process for the duration of the context, on one core if given."""
    pipe = asyncio.subprocess.PIPE
    with output.open("ab") as errors:
        running = await asyncio.create_subprocess_exec(
            sys.executable, *arguments, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=errors
        )
    if core is not None:
        os.sched_setaffinity(running.pid, {core})
    try:
        yield running
    finally:
        if running.returncode is None:
            running.terminate()
        await running.wait()


async def order(client: TruckClient, what: Order) -> None:
    """Send an order until it is carried out; no tracker drives.

    Raises:
        TruckError, TimeoutError: it was not carried out.
    """
    end = time.monotonic() + ORDER_TIMEOUT
    while True:
        try:
            await client.order(what, hold=what is Order.ARM)
        except (TruckError, TimeoutError):
            if time.monotonic() > end:
                raise
            await asyncio.sleep(0.05)
        else:
            return


class OtherLoad:
    """Processor time used by other programs on the cores of this process since its creation, without its children.

    Latencies of milliseconds are only valid on a quiet computer: another program's time slice takes as long.
    """

    def __init__(self) -> None:
        self._began, self._busy, self._own = time.monotonic(), _busy(), _own()

    def cores(self) -> float:
        """Return the mean number of cores used by other programs; children count once they have ended."""
        others = (_busy() - self._busy) - (_own() - self._own)
        return max(0.0, others) / (time.monotonic() - self._began)


def processor_seconds(pid: int) -> float:
    """Return the processor time of a process so far, s (proc(5))."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def set_scheduler(pid: int, policy: int) -> None:
    """Set the scheduling policy of all threads of a process (sched(7)); threads that have ended are skipped.

    Only root may revoke ``SCHED_IDLE``; other users' processes keep it.
    """
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(ProcessLookupError, PermissionError):
            os.sched_setscheduler(int(task.name), policy, os.sched_param(0))


def _busy() -> float:
    """Return the seconds for which the cores of this process have not been idle (proc(5), ``/proc/stat``)."""
    cores = {f"cpu{core}" for core in os.sched_getaffinity(0)}
    rows = (line.split() for line in Path("/proc/stat").read_text().splitlines())
    ticks = sum(sum(map(int, row[1:4])) + sum(map(int, row[6:9])) for row in rows if row[0] in cores)
    return ticks / os.sysconf("SC_CLK_TCK")


def _own() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)
