"""One simulator process with one world, two daemon processes: what `simulate --robots --run` starts."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.yaml_files import yaml_text
from monstertruckd.tools.demo.runs import free_endpoint
from tests.daemon.wall_kit import ROOT, Robot, command, end

pytestmark = [pytest.mark.wall, pytest.mark.timeout(300)]


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
        for name, x in (("leader", -1.0), ("second", -2.2)):
            wait = ("echo", "state/odometry", "-n", "1", "--timeout", "5", "--robot", name, "-e", endpoints[name])
            async with asyncio.timeout(120):
                while (seen := await command(*wait)).returncode:
                    await asyncio.sleep(0.5)
            assert json.loads(seen.stdout)["pose"]["x"] == pytest.approx(x, abs=0.02)
        assert fleet.simulator.stdin is not None
        fleet.simulator.stdin.write(b"second lidar unplug\n")
        async with asyncio.timeout(20):
            while (await fleet.said()).strip() != "ok":  # behind what the simulator said of its start
                pass
    finally:
        await end(fleet.simulator)
    with np.load(truth) as archive:
        assert set(archive) == {"leader", "second"}
        assert archive["second"][-1, 1] == pytest.approx(-2.2, abs=0.01)
    assert list((tmp_path / "second" / "logs").glob("*.mcap"))
