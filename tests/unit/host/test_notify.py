"""What systemd hears: nothing before the first tick, pings while the tick advances, the state in one line."""

import asyncio
import contextlib
import os
import socket
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from monstertruck_runtime.clock import VirtualClock, run_virtual
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.state import GateMode
from monstertruckd.config.load import load_truck
from monstertruckd.daemon import Daemon
from monstertruckd.host.notify import NotifyService, notify_from, notify_socket, status_line, watchdog_seconds

DEMO = Path(__file__).resolve().parents[3] / "configs" / "demo.yaml"


class Systemd:
    """Keeps every message with the time it came; ``deaf`` takes none."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock = clock
        self.heard: list[tuple[float, list[str]]] = []
        self.deaf = False

    def __call__(self, *lines: str) -> bool:
        if not self.deaf:
            self.heard.append((round(self.clock.now() / 1e9, 1), list(lines)))
        return not self.deaf

    def times(self, line: str) -> list[float]:
        return [at for at, lines in self.heard if line in lines]


class Bench:
    """A gate that should tick at 50 Hz and does so every ``pause`` seconds unless ``stalled``, and the service."""

    def __init__(self, clock: VirtualClock, watchdog: float | None) -> None:
        self.clock = clock
        self.systemd = Systemd(clock)
        self.ticks = 0
        self.stalled = False
        self.pause = 0.02
        self.status = "disarmed"
        self.service = NotifyService(self.systemd, watchdog, clock, lambda: self.ticks, 50.0, lambda: self.status)

    async def tick(self) -> None:
        while True:
            self.ticks += not self.stalled
            await self.clock.sleep(self.pause)


def play(scene: Callable[[Bench], Coroutine[Any, Any, None]], watchdog: float | None = 3.0) -> Bench:
    async def main(clock: VirtualClock) -> Bench:
        bench = Bench(clock, watchdog)
        tasks = [asyncio.create_task(bench.tick()), asyncio.create_task(bench.service.run(lambda: None))]
        await scene(bench)
        for task in tasks:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        return bench

    return run_virtual(main, start=0)


def test_ready_waits_for_the_whole_daemon_and_for_the_tick():
    async def scene(bench: Bench) -> None:
        bench.stalled = True
        await bench.clock.sleep(1.0)
        bench.service.up()
        await bench.clock.sleep(1.0)
        bench.stalled = False
        await bench.clock.sleep(1.0)

    assert play(scene).systemd.times("READY=1") == [2.0]

    async def not_up(bench: Bench) -> None:
        await bench.clock.sleep(5.0)

    assert play(not_up).systemd.heard == []


def test_a_third_of_the_watchdogs_time_between_pings_and_none_while_the_tick_stands():
    async def scene(bench: Bench) -> None:
        bench.service.up()
        await bench.clock.sleep(4.7)
        bench.stalled = True
        await bench.clock.sleep(3.6)
        bench.stalled = False
        await bench.clock.sleep(2.0)

    # The look at 5 s still sees most ticks since the one at 4 s.
    assert play(scene).systemd.times("WATCHDOG=1") == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 9.0, 10.0]


@pytest.mark.parametrize(("pause", "alive"), [(1.0, False), (0.06, False), (0.025, True)])
def test_a_gate_that_limps_at_less_than_half_its_pace_is_no_sign_of_life(pause: float, alive: bool):
    async def scene(bench: Bench) -> None:
        bench.service.up()
        await bench.clock.sleep(2.5)
        bench.pause = pause
        await bench.clock.sleep(40.0)

    late = [at for at in play(scene).systemd.times("WATCHDOG=1") if at > 3.5]
    assert late == ([float(at) for at in range(4, 43)] if alive else [])


def test_without_a_watchdog_only_changes_of_the_status_are_reported():
    async def scene(bench: Bench) -> None:
        bench.service.up()
        await bench.clock.sleep(2.5)
        bench.status = "driving"
        await bench.clock.sleep(2.0)
        bench.service.stopping()

    heard = play(scene, watchdog=None).systemd.heard
    assert heard == [
        (0.0, ["READY=1", "STATUS=disarmed"]),
        (3.0, ["STATUS=driving"]),
        (4.5, ["STOPPING=1", "STATUS=stopping"]),
    ]


def test_what_systemd_did_not_take_is_reported_again():
    async def scene(bench: Bench) -> None:
        bench.systemd.deaf = True
        bench.service.up()
        await bench.clock.sleep(1.0)
        bench.systemd.deaf = False
        await bench.clock.sleep(1.0)
        bench.systemd.deaf, bench.status = True, "driving"
        await bench.clock.sleep(1.0)
        bench.systemd.deaf = False
        await bench.clock.sleep(1.0)

    heard = play(scene).systemd.heard
    assert heard[0] == (1.0, ["READY=1", "WATCHDOG=1", "STATUS=disarmed"])
    assert heard[-1] == (3.0, ["WATCHDOG=1", "STATUS=driving"])


@pytest.mark.parametrize("abstract", [False, True])
def test_both_kinds_of_sockets(abstract: bool, tmp_path: Path):
    address = f"@monstertruckd-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind("\0" + address[1:] if abstract else address)
        assert notify_socket(address)("READY=1", "STATUS=so")
        assert systemd.recv(99) == b"READY=1\nSTATUS=so"
    assert not notify_socket(address)("WATCHDOG=1")


def test_a_full_socket_neither_blocks_nor_counts_as_reported(tmp_path: Path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        send = notify_socket(str(tmp_path / "notify"))
        reported = [send("WATCHDOG=1") for _ in range(10_000)]
    assert reported[0]
    assert not reported[-1]


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "3000000"}, 3.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "7"}, 3.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "8"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
    ],
)
def test_the_watchdogs_time(environment: dict[str, str], expected: float | None):
    assert watchdog_seconds(environment, pid=7) == expected


@pytest.mark.parametrize("address", [None, "", "vsock:2:1"])
def test_nothing_to_tell_without_a_socket(address: str | None):
    environment = {} if address is None else {"NOTIFY_SOCKET": address}
    assert run_virtual(_of(environment)) is None


def _of(environment: dict[str, str]) -> Callable[[VirtualClock], Coroutine[Any, Any, NotifyService | None]]:
    async def main(clock: VirtualClock) -> NotifyService | None:
        return notify_from(environment, clock, int, 50.0, str)

    return main


def test_the_status_names_what_does_not_work():
    rows = [
        ServiceHealth(name="gate", state=ServiceState.READY, since=0),
        ServiceHealth(name="lidar", state=ServiceState.BACKOFF, since=0),
    ]
    assert status_line(GateMode.DRIVING, rows[:1]) == "driving"
    assert status_line(GateMode.DISARMED, rows) == "disarmed; not ready: lidar (backoff)"


def test_the_daemon_tells_from_its_first_tick_to_its_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))  # not the devices of a `simulate` that runs on this computer

    async def main(clock: VirtualClock) -> list[str]:
        config, _ = load_truck(DEMO)
        quiet = config.model_copy(update={"state_directory": tmp_path, "recorder": None})
        environment = {"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "3000000"}
        stop = asyncio.Event()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as systemd:
            systemd.bind(environment["NOTIFY_SOCKET"])
            daemon = asyncio.create_task(Daemon(quiet, clock, seed=1, environment=environment).run(stop))
            await clock.sleep(3.5)
            stop.set()
            await daemon
            heard = []
            with contextlib.suppress(BlockingIOError):
                while True:
                    heard.append(systemd.recv(999).decode())
        return heard

    heard = run_virtual(main)
    assert heard[0].startswith("READY=1\nWATCHDOG=1\nSTATUS=disarmed; not ready: ")
    assert "drive (" in heard[0]
    assert sum("WATCHDOG=1" in message for message in heard) == 4
    assert heard[-1].startswith("STOPPING=1")
