"""Trouble of the computer under a driving daemon: full disk, no descriptors, no memory, real time set, files edited."""

import asyncio
import contextlib
import mmap
import os
import resource
import shutil
import signal
import struct
import subprocess
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode
from monstertruckd.tools.simulation.config import DEADMAN_LINE
from tests.daemon.wall_kit import Robot, end, robot

pytestmark = [pytest.mark.wall, pytest.mark.timeout(120)]

REAL_TIME = """
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>
static volatile int64_t *seconds;
__attribute__((constructor)) static void begin(void) {
    seconds = mmap(0, 8, PROT_READ, MAP_SHARED, open(getenv("REAL_TIME_OFFSET"), O_RDONLY), 0);
}
int clock_gettime(clockid_t clock, struct timespec *time) {
    int result = syscall(SYS_clock_gettime, clock, time);
    if (!result && clock == CLOCK_REALTIME && seconds) time->tv_sec += *seconds;
    return result;
}
"""
"""For LD_PRELOAD: CLOCK_REALTIME is as many seconds apart as a file says."""


@contextmanager
def small_disk(folder: Path, megabytes: int) -> Iterator[None]:
    """A file system of so many megabytes; skipped where nothing may be mounted."""
    folder.mkdir()
    options = ("-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(folder))
    try:
        done = subprocess.run(["mount", *options], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        pytest.skip("there is no mount")
    if done.returncode:
        pytest.skip(f"nothing may be mounted here: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(folder: Path) -> None:
    """Write until nothing more goes onto the disk."""
    with (folder / "filler").open("wb", buffering=0) as file, contextlib.suppress(OSError):
        while True:
            file.write(bytes(4096))


@contextmanager
def real_time(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    """Sets the real time of the processes that start meanwhile, in seconds against this computer's."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no C compiler")
    source, library, offset = folder / "real_time.c", folder / "real_time.so", folder / "offset"
    source.write_text(REAL_TIME)
    offset.write_bytes(bytes(8))
    subprocess.run([compiler, "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    with monkeypatch.context() as environment, offset.open("r+b") as file, mmap.mmap(file.fileno(), 8) as shared:
        environment.setenv("LD_PRELOAD", str(library))
        environment.setenv("REAL_TIME_OFFSET", str(offset))
        yield lambda seconds: shared.__setitem__(slice(0, 8), struct.pack("=q", seconds))


@contextmanager
def limited(pid: int, what: int, limit: int) -> Iterator[None]:
    """A process may have no more of a resource."""
    before = resource.prlimit(pid, what)
    resource.prlimit(pid, what, (limit, before[1]))
    try:
        yield
    finally:
        resource.prlimit(pid, what, before)


LATE = frozenset(
    {Reason.TICK_STALLED, Reason.DRIVE_STALE, Reason.STEERING_STALE, Reason.SCAN_STALE, Reason.ATTITUDE_STALE}
)
"""Why a busy computer may stop the truck for a moment."""


@asynccontextmanager
async def drives_on(truck: Robot, client: TruckClient) -> AsyncIterator[None]:
    """What is done meanwhile is no reason to stop."""
    with client.subscribe(topics.STOP, fifo(4096)) as stops:
        yield
        await asyncio.sleep(0.5)
        reasons = {stop.reason for stop in stops.drain()}
    assert reasons <= LATE
    await truck.drive(client)


async def until(condition: Callable[[], bool], seconds: float = 15.0) -> None:
    async with asyncio.timeout(seconds):
        while not condition():
            await asyncio.sleep(0.02)


def process(truck: Robot) -> int:
    assert truck.daemon is not None
    return truck.daemon.pid


async def test_real_time_descriptors_and_edited_files_stop_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    async with robot(tmp_path) as truck, AsyncExitStack() as stack:
        await truck.start_simulator()
        set_real_time = stack.enter_context(real_time(tmp_path, monkeypatch))
        await truck.start_daemon()
        async with truck.client() as client:
            await truck.drive(client)
            with client.subscribe(topics.EVENT, fifo(4096)) as events:
                for seconds in (3600, -86_400, 0):
                    async with drives_on(truck, client):
                        set_real_time(seconds)
                        await asyncio.sleep(1.2)
                steps = [event for event in events.drain() if event.reason is Reason.CLOCK_STEPPED]
            assert len(steps) >= 3

            written = truck.config.read_text()
            async with drives_on(truck, client):
                truck.config.write_text("]" * 100)
                await asyncio.sleep(0.5)
            truck.config.write_text(written)

            used = len(list(Path(f"/proc/{process(truck)}/fd").iterdir()))
            async with drives_on(truck, client):
                with limited(process(truck), resource.RLIMIT_NOFILE, used), contextlib.suppress(TruckError):
                    async with TruckClient(endpoint=truck.endpoint, clock=truck.clock, timeout=1.0) as other:
                        await other.alive()
            state = await client.estop()
            assert state.mode is GateMode.ESTOPPED
            await asyncio.sleep(0.8)
        assert await end(truck.daemon) == 0
        truth = await truck.truth()
    assert not truth[:, 5].any(), "touched nothing"
    assert abs(truth[-1, 4]) < 0.01


async def test_an_emergency_stop_outlasts_kill_9_on_a_full_disk(tmp_path: Path):
    disk, runtime = tmp_path / "disk", tmp_path / "runtime"
    runtime.mkdir()
    overlay = {
        "recorder": {"directory": str(disk / "logs")},
        "state_directory": str(disk / "state"),
        "runtime_directory": str(runtime),
    }
    with small_disk(disk, megabytes=64):
        async with robot(tmp_path, overlay) as truck:
            await truck.start_simulator()
            await truck.start_daemon()
            async with truck.client() as client:
                await truck.drive(client)
                with client.subscribe(topics.EVENT, fifo(4096)) as events:
                    full = lambda: Reason.DISK_FULL in {event.reason for event in events.drain()}  # noqa: E731
                    async with drives_on(truck, client):
                        fill(disk)
                        await until(full)
                state = await client.estop()
                assert (state.mode, state.latched) == (GateMode.ESTOPPED, False)
                stopped = truck.clock.now() / SECOND
                await asyncio.sleep(1.0)
            await end(truck.daemon, signal.SIGKILL)
            await truck.start_daemon()
            async with truck.client() as client:
                with client.subscribe(topics.GATE, latest()) as gate:
                    await until(lambda: gate.latest is not None)
                    assert gate.latest.mode is GateMode.ESTOPPED
                    (disk / "filler").unlink()
                    await until(lambda: gate.latest.latched)
            assert await end(truck.daemon) == 0
            truth = await truck.truth()
    assert np.abs(truth[truth[:, 0] > stopped + 0.8, 4]).max() < 0.01


async def test_a_daemon_without_memory_goes_on_or_ends_with_a_truck_that_stands(tmp_path: Path):
    """Neutral is its last word; if it cannot say it, the deadman line falls."""
    async with robot(tmp_path, DEADMAN_LINE) as truck:
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client() as client:
            await truck.drive(client)
        assert truck.daemon is not None
        pages = int(Path(f"/proc/{truck.daemon.pid}/statm").read_text().split()[0])
        resource.prlimit(truck.daemon.pid, resource.RLIMIT_AS, (pages * os.sysconf("SC_PAGE_SIZE"), -1))
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(6.0):
                await truck.daemon.wait()
        ended = truck.daemon.returncode is not None
        await asyncio.sleep(0.8)
        truth = await truck.truth()
    assert not truth[:, 5].any(), "touched nothing"
    assert not ended or abs(truth[-1, 4]) < 0.01
