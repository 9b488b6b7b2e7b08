"""`monstertruckd calibrate` as a process next to the daemon: killed and interrupted half-way, scripted to the end."""

import asyncio
import json
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.mailbox import latest
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode
from monstertruckd.config.calibration import CalibrationStore, Estimate, Result
from tests.daemon import forked
from tests.daemon.wall_kit import ROOT, Robot, end, robot

pytestmark = [pytest.mark.wall, pytest.mark.timeout(180)]

YARD = ROOT / "configs" / "yard.yaml"
BATTERY = Result(
    wizard="battery",
    measured="long ago",
    estimates=(
        Estimate(name="gain", value=1.01, samples=2, meaning="test", key="devices.steering.driver.battery.gain"),
    ),
)
LONG_WAITS = {
    "gate": {sensor: {"stale_after": 1.5} for sensor in ("scan", "drive", "steering", "attitude")}
    | {"max_latency": 1.0, "tick_stall": 1.0, "leases": {"station": 1.0}}
}
"""A busy computer shall not end what a signal is to end."""


@asynccontextmanager
async def truck_with_a_calibration(folder: Path) -> AsyncIterator[tuple[Robot, TruckClient, dict[Path, bytes]]]:
    async with robot(folder, LONG_WAITS, YARD) as truck:
        CalibrationStore(folder / "state" / "calibration", "truck").save(BATTERY, 0)
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client() as client:
            yield truck, client, files(folder)


def files(folder: Path) -> dict[Path, bytes]:
    found = {path: path.read_bytes() for path in (folder / "state" / "calibration").iterdir()}
    assert found
    return found


async def command(truck: Robot, *words: str) -> subprocess.CompletedProcess[str]:
    return await asyncio.to_thread(
        forked.run, "calibrate", *words, "--endpoint", truck.endpoint, folder=ROOT, timeout=90
    )


async def drive_away(truck: Robot, client: TruckClient) -> asyncio.subprocess.Process:
    """A drive wizard in the middle of its first run."""
    words = ("drive", "--yes", "--answer", "forward=yes", "--metres", "5", "--endpoint", truck.endpoint)
    wizard = await truck.spawn("calibrate", *words)
    with client.subscribe(topics.ODOMETRY, latest()) as odometry:
        async with asyncio.timeout(60):
            while odometry.latest is None or odometry.latest.twist.vx < 0.1:
                assert wizard.returncode is None, (truck.folder / "calibrate.txt").read_text()
                await asyncio.sleep(0.05)
    return wizard


@pytest.mark.long
async def test_a_wizard_that_is_killed_leaves_truck_neutral_and_file_intact(tmp_path: Path):
    """By Ctrl-C, which it says, by kill -9, and at last because the daemon is killed."""
    async with truck_with_a_calibration(tmp_path) as (truck, client, before):
        ended = []
        for number, expected in ((signal.SIGINT, Reason.CANCELLED.exit_code), (signal.SIGKILL, -signal.SIGKILL)):
            wizard = await drive_away(truck, client)
            ended.append(truck.clock.now() / 1e9)
            assert await end(wizard, number) == expected
            with client.subscribe(topics.GATE, latest()) as gate:
                async with asyncio.timeout(10):
                    while gate.latest is None or gate.latest.mode is not GateMode.DISARMED:
                        await asyncio.sleep(0.05)
            assert files(tmp_path) == before, "the old file is intact, and no other one is there"
            await asyncio.sleep(2.0)
        assert Reason.CANCELLED.text in (tmp_path / "calibrate.txt").read_text()
        wizard = await drive_away(truck, client)
        await end(truck.daemon, signal.SIGKILL)
        script = [sys.executable, "-I", str(ROOT / "systemd" / "neutral.py"), str(tmp_path / "dev" / "drive")]
        stopped = await asyncio.to_thread(
            subprocess.run, script, capture_output=True, text=True, timeout=20, check=False
        )
        assert stopped.returncode == 0, f"what the unit does after the daemon's death: {stopped.stderr}"
        async with asyncio.timeout(30):
            code = await wizard.wait()
        assert code not in (0, Reason.INTERNAL.exit_code)
        said = (tmp_path / "calibrate.txt").read_text()
        assert "Traceback" not in said
        assert files(tmp_path) == before
        truth = await truck.truth()
    for instant in ended:
        after = truth[(truth[:, 0] > instant + 1.5) & (truth[:, 0] < instant + 2.0)]
        assert abs(after[:, 4]).max() < 0.01
    assert abs(truth[-5:, 4]).max() < 0.01


async def test_scripted_shown_undone_and_applied_by_the_next_start(tmp_path: Path):
    async with robot(tmp_path, LONG_WAITS, YARD) as truck:
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client():
            pass
        unanswered = await command(truck, "drive", "--yes", "--sign-only")
        assert unanswered.returncode == Reason.BAD_INPUT.exit_code
        assert "forward: no answer on standard input; pass --answer forward=VALUE" in unanswered.stderr
        assert unanswered.stdout == ""
        refused = await command(truck, "battery", "--answer", "meter=240")
        assert refused.returncode == Reason.BAD_INPUT.exit_code
        assert "meter: 240 is not within 5 to 70" in refused.stderr
        assert not (tmp_path / "state" / "calibration").exists()
        done = await command(truck, "battery", "--json", "--answer", "meter=24.6", "--answer", "another=no")
        assert done.returncode == 0, done.stderr
        saved = json.loads(done.stdout)
        assert saved["result"]["estimates"][0]["key"] == "devices.steering.driver.battery.gain"
        before = files(tmp_path)
        shown = await command(truck, "show")
        assert shown.returncode == 0
        assert "battery.gain" in shown.stdout
        assert "the daemon still uses no calibration: restart it" in shown.stderr
        assert await end(truck.daemon) == 0
        await truck.start_daemon()
        async with truck.client() as client:
            reported: dict[str, Any] = await client.call("calibration")
            config = await client.call("config")
        gain = json.loads(next(iter(before.values())))["results"]["battery"]["estimates"][0]["value"]
        assert config["devices"]["steering"]["driver"]["battery"]["gain"] == gain != 1.0
        assert reported["loaded"] == reported["newest"] == str(next(iter(before)))
        undone = await command(truck, "battery", "--undo", "--json")
        assert undone.returncode == 0, undone.stderr
        newest = Path(json.loads(undone.stdout)["file"])
        assert json.loads(newest.read_text())["results"] == {}
        again = await command(truck, "battery", "--undo", "--config", str(truck.config))
        assert again.returncode == 0, "without the daemon too"
        assert len(files(tmp_path)) == 3


async def test_what_the_tracker_proposed_before_a_restart_is_shown_and_accepted(tmp_path: Path):
    centre = Estimate(
        name="front_centre", value=1480.0, low=1470.0, high=1490.0, unit="us", samples=9, meaning="test",
        key="devices.steering.driver.front.centre_us",
    )  # fmt: skip
    proposed = Result(wizard="steering", measured="front steers to the left", estimates=(centre,), partial=True)
    async with robot(tmp_path, LONG_WAITS, YARD) as truck:
        file = tmp_path / "state" / "proposed_calibration.json"
        file.parent.mkdir(exist_ok=True)
        file.write_text(json.dumps({"base": "", "result": proposed.model_dump(mode="json")}))
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client():
            pass  # it answers
        shown, accepted, again = [await command(truck, word) for word in ("show", "accept", "accept")]
    assert "proposed, not used: front steers to the left" in shown.stderr
    assert accepted.returncode == 0, accepted.stderr
    assert not file.exists()
    saved = CalibrationStore(tmp_path / "state" / "calibration", "truck").current()
    assert saved is not None
    assert [estimate.value for estimate in saved.results["steering"].estimates] == [1480.0]
    assert again.returncode == Reason.NOT_FOUND.exit_code
    assert "no calibration is proposed" in again.stderr
