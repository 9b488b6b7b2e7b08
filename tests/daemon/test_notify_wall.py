"""A real daemon process tells systemd that it lives, and falls silent when it hangs."""

import asyncio
import os
import signal
import socket
import sys
from pathlib import Path

import pytest

from monstertruckd.tools.demo.runs import free_endpoint, write_overlay
from tests.daemon.wall_kit import DEMO, ROOT, end

pytestmark = pytest.mark.wall


async def test_the_process_pings_until_it_is_frozen_and_says_when_it_ends(tmp_path: Path):
    config = write_overlay(DEMO, tmp_path, free_endpoint())
    environment = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "600000"}
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as systemd:
        systemd.bind(environment["NOTIFY_SOCKET"])

        async def hear(within: float) -> str:
            async with asyncio.timeout(within):
                return (await asyncio.get_running_loop().sock_recv(systemd, 999)).decode()

        with (tmp_path / "run.txt").open("wb") as errors:
            daemon = await asyncio.create_subprocess_exec(
                *(sys.executable, "-m", "monstertruckd", "run", "--config", str(config)),
                cwd=ROOT,
                env=environment,
                stderr=errors,
            )
        try:
            assert (await hear(30)).startswith("READY=1\nWATCHDOG=1\n")
            for _ in range(3):
                assert "WATCHDOG=1" in await hear(5)
            daemon.send_signal(signal.SIGSTOP)
            while True:
                try:
                    await hear(1)  # what was under way
                except TimeoutError:
                    break
            daemon.send_signal(signal.SIGCONT)
            while "WATCHDOG=1" not in await hear(5):
                pass  # the look after the pause saw too few ticks
            daemon.send_signal(signal.SIGTERM)
            while "STOPPING=1" not in await hear(5):
                pass
            assert await end(daemon) == 0
        finally:
            if daemon.returncode is None:
                daemon.kill()
                await daemon.wait()
