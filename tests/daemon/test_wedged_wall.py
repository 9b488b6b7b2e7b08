"""A device of a driving robot takes no bytes, and the kernel does not let go of its port: nothing else waits for it."""

import asyncio
import itertools
import sys
from pathlib import Path

import pytest

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode
from tests.daemon.wall_kit import ROOT, Robot, end, robot

pytestmark = [pytest.mark.wall, pytest.mark.timeout(150)]

STILL = 0.5
"""Seconds between two messages, and until an answer; a blocked event loop would stand for as long as the port does, and
a computer that runs all tests at once stands for 0.2."""
OTHERS = {"drive": topics.STEERING, "steering": topics.DRIVE}
"""Feedback of the device that goes on."""


async def start_daemon(truck: Robot, role: str) -> Path:
    """The daemon on a kernel that waits for one device while the file that is returned exists."""
    flag = truck.folder / "wedged"
    with (truck.folder / "run.txt").open("ab") as errors:
        truck.daemon = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "tests.daemon.wedged_port", flag, truck.folder / "dev" / role),
            *("run", "--config", truck.config),
            cwd=ROOT,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=errors,
        )
    return flag


def row(health: Mailbox[HealthTable], role: str) -> ServiceHealth | None:
    rows = health.latest.services if health.latest is not None else ()
    return next((row for row in rows if row.name == role), None)


def longest_gap(messages: list[Message]) -> float:
    stamps = [message.received for message in messages]
    return max(b - a for a, b in itertools.pairwise(stamps)) / SECOND


async def wedged(health: Mailbox[HealthTable], role: str) -> None:
    async with asyncio.timeout(10):
        while (found := row(health, role)) is None or found.reason is not Reason.DEVICE_WEDGED:
            await asyncio.sleep(0.02)


async def ready(health: Mailbox[HealthTable], role: str) -> None:
    async with asyncio.timeout(20):
        while (found := row(health, role)) is None or found.state is not ServiceState.READY:
            await asyncio.sleep(0.05)


async def stopped(truck: Robot, client: TruckClient) -> float:
    """Stop the robot in an emergency; seconds until the gate has latched it."""
    with client.subscribe(topics.GATE, latest()) as gate:
        began = truck.clock.now()
        await client.order(Order.ESTOP)
        while gate.latest is None or gate.latest.mode is not GateMode.ESTOPPED:
            await asyncio.sleep(0.005)
        return (truck.clock.now() - began) / SECOND


@pytest.mark.parametrize("role", OTHERS)
async def test_a_wedged_port_stops_nothing_but_its_device(tmp_path: Path, role: str):
    async with robot(tmp_path) as truck:
        await truck.start_simulator()
        flag = await start_daemon(truck, role)
        async with truck.client() as client:
            health = client.subscribe(topics.HEALTH, latest())
            gate, other = client.subscribe(topics.GATE, fifo(4096)), client.subscribe(OTHERS[role], fifo(4096))
            await truck.drive(client)
            gate.drain(), other.drain()
            flag.touch()
            await wedged(health, role)
            assert await stopped(truck, client) < STILL
            await asyncio.sleep(3.0)  # ports that stay wedged are tried again and again
            assert row(health, role).reason is Reason.DEVICE_WEDGED
            assert longest_gap(gate.drain()) < STILL
            assert longest_gap(other.drain()) < STILL
            flag.unlink()
            await ready(health, role)
            flag.touch()
            await wedged(health, role)
        began = truck.clock.now()
        assert await end(truck.daemon) == 0
        assert (truck.clock.now() - began) / SECOND < 8
