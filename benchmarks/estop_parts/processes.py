"""Processes of a measurement, and the orders that prepare it."""

import asyncio
import os
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.errors import TruckError
from monstertruck_schemas.req import Order

ROOT = Path(__file__).resolve().parents[2]
ORDER_TIMEOUT = 40.0
"""Seconds for which an order that is refused is given again."""


@asynccontextmanager
async def process(core: int | None, output: Path, *arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """A Python process while the context lasts; on one core, if one is named."""
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
    """Give an order until it is carried out; no tracker drives.

    Raises:
        TruckError, TimeoutError: why it was not carried out in the end.
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
