"""Other commands of this program as processes."""

import asyncio
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager, suppress
from pathlib import Path


@asynccontextmanager
async def program(output: Path | None, *arguments: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run ``monstertruckd arguments`` while the context is open; SIGTERM ends it.

    Args:
        output: file for its output; None for this program's output.
        arguments: command and options.
    """
    with ExitStack() as stack:
        stream = None if output is None else stack.enter_context(output.open("wb"))
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "monstertruckd",
            *arguments,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=stream,
            stderr=stream,
        )
    ended = asyncio.create_task(process.wait())
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            process.send_signal(signal.SIGTERM)
        done, _ = await asyncio.wait([ended], timeout=15.0)  # seconds that a program may take to end
        if not done:
            process.kill()
            await ended
