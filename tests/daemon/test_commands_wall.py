"""Commands that need real processes: emulate and probe, the demo, status, echo, replay, logs."""

import asyncio
import csv
import itertools
import json
from pathlib import Path

import pytest

from monstertruck_runtime.mailbox import fifo
from monstertruck_runtime.yaml_files import yaml_text
from monstertruck_schemas import topics
from monstertruckd.tools.demo.runs import free_endpoint
from tests.daemon import forked
from tests.daemon.wall_kit import DEMO, ROOT, Robot, command, end

pytestmark = [pytest.mark.wall, pytest.mark.timeout(120)]


@pytest.mark.parametrize(
    ("device", "expected"),
    [
        ("lidar", "URG-04LX"),
        ("drive", "software"),
        ("steering", "errors"),
        ("compass", "heading"),
        ("stabiliser", "AX-12A"),
    ],
)
async def test_every_emulator_answers_its_probe(device: str, expected: str, tmp_path: Path):
    link = tmp_path / device
    said = tmp_path / "said.txt"
    emulator = await forked.started("emulate", device, "--link", str(link), folder=ROOT, errors=said)
    try:
        async with asyncio.timeout(40):
            while device not in said.read_text():
                await asyncio.sleep(0.02)
        probed = await command("probe", device, "--port", str(link), "--json")
        assert probed.returncode == 0, probed.stderr
        assert expected in json.dumps(json.loads(probed.stdout))
        emulator.stdin.write(b"no-such-fault\nunplug\n")
        await emulator.stdin.drain()
        assert (await emulator.stdout.readline()).decode().startswith("error: ")
        assert (await emulator.stdout.readline()).decode() == "ok\n"
        gone = await command("probe", device, "--port", str(link))
        assert gone.returncode == 20, "DEVICE_LOST"
        assert "not plugged in" in gone.stderr
    finally:
        await end(emulator)


def short_lap(folder: Path) -> Path:
    """A demo of a metre instead of a lap."""
    with (ROOT / "configs" / "paths" / "loop.csv").open() as lap, (folder / "short.csv").open("w") as short:
        csv.writer(short).writerows(row for row, _ in zip(csv.reader(lap), range(22), strict=False))
    config = folder / "short.yaml"
    overlay = {"include": str(DEMO), "version": 1, "path": {"file": str(folder / "short.csv"), "closed": False}}
    config.write_text(yaml_text(overlay))
    return config


@pytest.mark.parametrize(
    ("device", "expected"),
    [("camera", "nodes"), ("battery", "converters"), ("link", "interfaces"), ("host", "cores")],
)
async def test_what_hangs_on_no_line_is_probed_without_one(device: str, expected: str):
    probed = await command("probe", device, "--json")
    assert probed.returncode == 0, probed.stderr
    assert expected in json.loads(probed.stdout)


async def test_a_probe_that_needs_a_port_and_an_emulator_that_needs_none_say_so(tmp_path: Path):
    probed = await command("probe", "lidar")
    assert (probed.returncode, probed.stderr) == (3, "lidar: pass its port with --port\n")
    emulated = await command("emulate", "host", "--link", str(tmp_path / "host"))
    assert emulated.returncode == 3
    assert "not a device on a port" in emulated.stderr


async def test_the_demo_drives_prints_and_leaves_log_and_picture(tmp_path: Path):
    run = tmp_path / "run"
    done = await command("demo", "--real-time", "-c", str(short_lap(tmp_path)), "-o", str(run), "--json", timeout=90)
    assert done.returncode == 0, done.stderr + (run / "daemon.txt").read_text()
    figures = json.loads(done.stdout)
    assert figures["outcome"] == "goal_reached"
    assert not figures["collided"]
    assert figures["cross_track_rms_m"] < 0.05
    assert figures["messages"]["sensor/scan"] > 50
    assert (run / "map.png").read_bytes().startswith(b"\x89PNG")
    (log,) = (run / "logs").glob("*.mcap")
    shown = await command("log", "info", str(log), "--json")
    assert json.loads(shown.stdout)["damage"] is None
    exported = await command("log", "export", str(log), str(tmp_path / "csv"))
    assert exported.returncode == 0, exported.stderr
    with (tmp_path / "csv" / "state_pose.csv").open() as rows:
        assert sum(1 for _ in rows) - 1 == figures["messages"]["state/pose"]
    await _replay(log, tmp_path, figures["messages"]["sensor/scan"])


async def _replay(log: Path, folder: Path, scans: int) -> None:
    """The log played back: another process sees its messages, `status` and `echo` work on it."""
    endpoint = free_endpoint()
    robot = Robot(folder, endpoint, log)
    chosen = [word for topic in ("sensor/scan", "state/gate", "health/services") for word in ("--topic", topic)]
    player = await robot.spawn("replay", str(log), "--endpoint", endpoint, "--speed", "0.5", *chosen)
    try:
        async with robot.client() as client:
            with client.subscribe(topics.SCAN, fifo(1000)) as received:
                seen = [await received.next() for _ in range(scans // 6)]
            assert all(later.seq == earlier.seq + 1 for earlier, later in itertools.pairwise(seen))
            said = await command("echo", "state/gate", "--endpoint", endpoint, "--count", "2")
            assert [json.loads(line)["mode"] for line in said.stdout.splitlines()]
            once = await command("status", "--endpoint", endpoint)
            assert once.returncode == 0, once.stderr
            assert once.stdout.startswith("gate ")
        assert await end(player) == 0, "SIGTERM is its ordinary end"
    finally:
        await end(player)


async def test_status_of_nobody_says_so():
    nobody = await command("status", "--endpoint", free_endpoint())
    assert nobody.returncode == 4
    assert "no robot answers at" in nobody.stderr
