"""Every device on the hubs of an emulated computer, simulator and daemon as processes: real ptys, files, Zenoh."""

import asyncio
from pathlib import Path

import pytest

from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas import topics
from monstertruck_schemas.health import HealthTable, ServiceState
from tests.daemon.wall_kit import ROOT, end, robot

pytestmark = [pytest.mark.wall, pytest.mark.timeout(120)]

FULL = ROOT / "configs" / "full.yaml"
DEVICES = {"lidar", "drive", "steering", "compass", "stabiliser", "camera"}


def up(health: Mailbox[HealthTable]) -> set[str]:
    rows = health.latest.services if health.latest is not None else ()
    return {row.name for row in rows if row.state is ServiceState.READY}


def waiting(health: Mailbox[HealthTable]) -> set[str]:
    """Services that say that they wait for their hub."""
    rows = health.latest.services if health.latest is not None else ()
    return {row.name for row in rows if row.detail == "waits for hub 1-2"}


async def until(health: Mailbox[HealthTable], ready: set[str], down: set[str], seconds: float) -> None:
    async with asyncio.timeout(seconds):
        while not (ready <= up(health) and not down & up(health)):
            await asyncio.sleep(0.05)


async def test_the_whole_truck_loses_a_hub_and_gets_it_back(tmp_path: Path):
    async with robot(tmp_path, base=FULL) as truck:
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client() as client:
            health = client.subscribe(topics.HEALTH, latest())
            link = client.subscribe(topics.LINK, latest())
            await until(health, DEVICES | {"usb", "link", "host"}, set(), 30)
            await truck.fault("usb lose 1-2")
            await until(health, {"drive", "steering"}, {"lidar", "camera"}, 20)
            async with asyncio.timeout(20):
                while waiting(health) != {"lidar", "camera"}:
                    await asyncio.sleep(0.05)
            await truck.fault("usb return 1-2")
            await until(health, DEVICES, set(), 30)
            await truck.fault("link cable on")
            async with asyncio.timeout(30):
                while link.latest is None or link.latest.interface is None:
                    await asyncio.sleep(0.1)
        assert await end(truck.daemon) == 0
        assert (tmp_path / "machine").is_symlink()
        await end(truck.simulator)
        assert not (tmp_path / "machine").exists()
