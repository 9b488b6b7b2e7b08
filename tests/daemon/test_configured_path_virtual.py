"""A path of the configuration: with real ports an operator starts it by name; in emulation arming is enough."""

import asyncio
import itertools
import math
from pathlib import Path
from typing import Any

import pytest

from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.drives import drive_configured
from monstertruck_runtime.errors import NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruckd.config.load import load_config
from monstertruckd.config.truck import TruckConfig
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.daemon.local_client import LocalClient

pytestmark = [pytest.mark.virtual, pytest.mark.timeout(300)]

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
LENGTH = 2.0
"""Of the path, m."""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The beginning of the demo's lap."""
    rows = (CONFIGS / "paths" / "loop.csv").read_text().splitlines(keepends=True)
    (tmp_path / "loop.csv").write_text("".join(rows[: round(LENGTH / 0.05) + 2]))
    return tmp_path / "loop.csv"


def test_a_path_that_cannot_be_read_is_left_out_and_said(path: Path):
    path.write_bytes(bytes(100))
    overlay = {"recorder": None, "blackbox": None, "map": None, "path": {"file": path, "closed": False}}
    config = with_overlay(load_config(CONFIGS / "demo.yaml", SimulatedTruckConfig)[0], overlay)
    found: list[ServiceHealth] = []

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            with rig.bus.subscribe(topics.HEALTH, latest()) as health:
                await clock.sleep(3.0)
                assert health.latest is not None
                found.extend(row for row in health.latest.services if row.name == "path")

    run_virtual(main)
    (row,) = found
    assert (row.state, row.reason) == (ServiceState.READY, Reason.FILE_DAMAGED)
    assert str(path) in row.detail


def driven(path: Path, scenario: Any) -> float:
    """Run a scenario on the demo's truck with this path; returns how far it went, m."""
    overlay = {"recorder": None, "blackbox": None, "map": None, "path": {"file": path, "closed": False}}
    config = with_overlay(load_config(CONFIGS / "demo.yaml", SimulatedTruckConfig)[0], overlay)
    moved = []

    async def main(clock: VirtualClock) -> None:
        rig = VirtualRig(config, clock)
        async with rig.running():
            client = LocalClient(rig.daemon, clock)
            await clock.sleep(4.0)
            await scenario(client, clock)
            truth = rig.truth.array()
            moved.append(sum(math.dist(a[1:3], b[1:3]) for a, b in itertools.pairwise(truth)))

    run_virtual(main, start=SECOND)
    return moved[0]


@pytest.fixture
def real_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TruckConfig, "emulated", property(lambda _: False))


async def arm_alone(client: LocalClient, clock: VirtualClock) -> None:
    await client.arm()
    await clock.sleep(5.0)


def test_arming_alone_drives_it_in_emulation(path: Path):
    assert driven(path, arm_alone) > 0.5


@pytest.mark.usefixtures("real_ports")
def test_arming_alone_moves_nothing_with_real_ports(path: Path):
    assert driven(path, arm_alone) < 0.005


@pytest.mark.usefixtures("real_ports")
def test_it_is_started_by_name_and_over_once_the_robot_is_disarmed(path: Path):
    async def scenario(client: LocalClient, clock: VirtualClock) -> None:
        with pytest.raises(RequestRefusedError) as refused:
            await drive_configured(client, clock, "loop", arm=False)
        assert refused.value.refusal is Reason.DISARMED
        with pytest.raises(NotFoundError, match="the configuration has the path 'loop'"):
            await drive_configured(client, clock, "lap", arm=True)
        driving = asyncio.create_task(drive_configured(client, clock, "loop", arm=True))
        await clock.sleep(4.0)
        assert not driving.done()
        await client.disarm()
        end = await driving
        assert (end.reason, end.text.partition(":")[0]) == (Reason.DISARMED, "disarmed on the way")
        await arm_alone(client, clock)

    assert 0.2 < driven(path, scenario) < 0.9, "arming again did not go on"


@pytest.mark.usefixtures("real_ports")
def test_it_is_driven_to_its_end_and_by_a_command_that_is_given_up_no_further(path: Path):
    async def scenario(client: LocalClient, clock: VirtualClock) -> None:
        driving = asyncio.create_task(drive_configured(client, clock, "loop", arm=True))
        await clock.sleep(4.0)
        driving.cancel()
        await asyncio.wait([driving])
        await clock.sleep(3.0)
        await client.disarm()
        end = await drive_configured(client, clock, "loop", arm=True)
        assert end.reason is Reason.GOAL_REACHED, end.text

    assert LENGTH - 0.1 < driven(path, scenario) < LENGTH + 0.2
