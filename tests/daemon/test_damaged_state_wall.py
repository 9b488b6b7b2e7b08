"""A daemon whose own files are all damaged: it starts, stopped, says so in its status, and keeps them."""

import asyncio
from pathlib import Path

import pytest

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.health import ServiceHealth
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode
from monstertruckd.recorder.reader import open_log
from tests.daemon.wall_kit import ROOT, end, robot
from tests.unit.config.test_corrupt_calibration import saved

pytestmark = [pytest.mark.wall, pytest.mark.timeout(120)]

STATE = ("settings-truck.yaml", "odometer.json", "mission.json")
ZONES = "zones.json"
DAMAGED = {"gate": "settings-truck.yaml", "calibration": "odometer.json", "missions": "mission.json"}


async def named(client: TruckClient, *names: str) -> dict[str, ServiceHealth]:
    """Rows of these services once each has a reason."""
    with client.subscribe(topics.HEALTH, latest()) as health:
        async with asyncio.timeout(40):
            while True:
                rows = {row.name: row for row in health.latest.services} if health.latest else {}
                if all(name in rows and rows[name].reason is not Reason.OK for name in names):
                    return rows
                await asyncio.sleep(0.1)


async def test_a_daemon_with_damaged_files_starts_stopped_and_says_so(tmp_path: Path):
    async with robot(tmp_path, base=ROOT / "configs" / "goals.yaml") as truck:
        state, logs = tmp_path / "state", tmp_path / "logs"
        logs.mkdir(exist_ok=True)
        zeros = logs / "run-000001-000.mcap"
        zeros.write_bytes(bytes(4096))
        calibration = saved(state / "calibration")
        calibration.write_bytes(bytes(500))
        for name in STATE:
            (state / name).write_bytes(bytes(40))
        (state / ZONES).write_bytes(bytes(40))
        await truck.start_daemon()
        async with truck.client() as client:
            rows = await named(client, *DAMAGED, "recorder", "zones")
            with client.subscribe(topics.GATE, latest()) as gate:
                async with asyncio.timeout(10):
                    while gate.latest is None:
                        await asyncio.sleep(0.05)
                assert gate.latest.mode is GateMode.ESTOPPED
        assert await end(truck.daemon) == 0
        for name, file in DAMAGED.items():
            assert rows[name].reason is Reason.FILE_DAMAGED
            assert file in rows[name].detail
            assert (state / f"{file}.damaged").read_bytes() == bytes(40)
        assert rows["zones"].reason is Reason.FILE_DAMAGED
        assert ZONES in rows["zones"].detail
        assert "at rest" in rows["zones"].detail
        assert (state / ZONES).read_bytes() == bytes(40)  # a next start must not forget the stairs
        assert calibration.with_name(calibration.name + ".damaged").read_bytes() == bytes(500)
        assert rows["recorder"].reason is Reason.LOG_DAMAGED
        assert (logs / f"{zeros.name}.damaged").read_bytes() == bytes(4096)
        log = next(file for file in truck.logs() if file != zeros)
        events = [one.decode() for one in open_log(log) if one.topic == topics.EVENT.name]
        said = {(event.source, event.reason) for event in events}
        assert {(name, Reason.FILE_DAMAGED) for name in DAMAGED} | {("recorder", Reason.LOG_DAMAGED)} <= said
        texts = " ".join(event.text for event in events)
        assert all(name in texts for name in (*STATE, ZONES, calibration.name, zeros.name))
