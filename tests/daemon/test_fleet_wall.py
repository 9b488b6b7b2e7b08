"""One simulator process with one world, two daemon processes: what `simulate --robots --run` starts."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.yaml_files import yaml_text
from monstertruckd.tools.demo.runs import free_endpoint
from tests.daemon.wall_kit import ROOT, Robot, command, end

pytestmark = [pytest.mark.wall, pytest.mark.timeout(180)]


async def test_two_daemons_in_one_world(tmp_path: Path):
    endpoints, files = {}, []
    for name in ("leader", "second"):
        endpoints[name] = free_endpoint()
        ports = {role: {"port": {"path": str(tmp_path / "{robot}" / role)}} for role in ("lidar", "drive", "compass")}
        ports |= {
            role: {"port": {"path": str(tmp_path / name / role)}}
            for role in {"leader": ["steering"]}.get(name, ["drive_2"])
        }
        files.append(tmp_path / f"{name}.yaml")
        files[-1].write_text(
            yaml_text(
                {
                    "include": str(ROOT / "configs" / "fleet" / f"{name}.yaml"),
                    "version": 2,
                    "devices": ports,
                    "state_directory": str(tmp_path / "{robot}" / "state"),
                    "recorder": {"directory": str(tmp_path / "{robot}" / "logs")},
                    "zenoh": {"listen": [endpoints[name]]},
                }
            )
        )
    fleet = Robot(tmp_path, endpoints["second"], files[0])
    truth = tmp_path / "t.npz"
    robots = ",".join(map(str, files))
    fleet.simulator = await fleet.spawn("simulate", "--robots", robots, "--run", "--truth", str(truth))
    try:
        async with asyncio.timeout(60):
            for name in ("leader", "second"):
                wait = ("echo", "health/loop", "-n", "3", "--robot", name, "-e", endpoints[name])
                while (await command(*wait)).returncode:
                    await asyncio.sleep(0.5)
        ahead = ("move", "--length", "0.2", "--arm", "--json", "--robot", "second", "-e", endpoints["second"])
        async with asyncio.timeout(90):  # a busy computer makes feedback late, and the robot is armed again
            while (moved := await command(*ahead)).returncode:
                await asyncio.sleep(0.5)
        assert json.loads(moved.stdout)["values"]["covered"] == pytest.approx(0.2, abs=0.01)
        seen = await command("echo", "stand/pose", "-n", "1", "--robot", "leader", "-e", endpoints["leader"])
        assert seen.returncode == 0, seen.stderr
        assert json.loads(seen.stdout)["pose"]["x"] == pytest.approx(-1.0, abs=0.02)
    finally:
        await end(fleet.simulator)
    with np.load(truth) as archive:
        assert set(archive) == {"leader", "second"}
        assert not archive["second"][:, 5].any()
        assert archive["second"][-1, 1] > archive["second"][0, 1] + 0.15
    assert list((tmp_path / "second" / "logs").glob("*.mcap"))
