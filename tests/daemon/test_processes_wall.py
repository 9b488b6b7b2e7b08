"""The daemon as a process on the wall clock: signals, crashes, second starts. Real ptys, Zenoh and MCAP."""

import asyncio
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from monstertruck_runtime.clock import SECOND
from monstertruck_schemas import topics
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.reasons import Reason
from monstertruckd.recorder.reader import open_log
from monstertruckd.recorder.repair import recover
from monstertruckd.tools.demo.runs import free_endpoint
from monstertruckd.tools.logs.summary import info
from monstertruckd.tools.simulation.config import DEADMAN_LINE
from tests.daemon.wall_kit import ROOT, end, robot

pytestmark = [pytest.mark.wall, pytest.mark.timeout(120)]


def speed_after(truth: np.ndarray, instant: float, seconds: float) -> float:
    """Greatest true speed from ``seconds`` after ``instant`` on."""
    return float(np.abs(truth[truth[:, 0] > instant + seconds, 4]).max())


def metres_after(truth: np.ndarray, instant: float) -> float:
    later = truth[truth[:, 0] >= instant]
    return float(np.hypot(*np.diff(later[:, 1:3], axis=0).T).sum())


STAGE = """
import functools, importlib, os, signal, sys
from importlib.machinery import PathFinder

def term(*_):
    print("reached", flush=True)
    os.kill(os.getpid(), signal.SIGTERM)

class InACallback:
    # an exception that is raised here is lost, as in the callbacks of imports
    def __del__(self):
        term()

class Imported(PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        if name == stage:
            InACallback()

stage = sys.argv.pop(1)
where, _, function = stage.partition(":")
if function:
    owner = importlib.import_module(where)
    *classes, name = function.split(".")
    owner = functools.reduce(getattr, classes, owner)
    def reached(*arguments, before=getattr(owner, name), **named):
        term()
        return before(*arguments, **named)
    setattr(owner, name, reached)
else:
    sys.meta_path.insert(0, Imported)
from monstertruckd.__main__ import main
main()
"""
"""The command line in a process that gets SIGTERM when it reaches a stage: an import, or a function's call."""


@pytest.mark.parametrize(
    "stage",
    [
        "monstertruckd.tools.cli.entry",
        "monstertruckd.config.load:load_config",
        "zenoh:open",
        "monstertruckd.gate.service:GateService.run",
        "monstertruck_runtime.actors.process:WorkerProcess.__init__",
        *(
            pytest.param(stage, marks=pytest.mark.long)
            for stage in (
                "monstertruckd.tools.cli.entry:mounted",
                "monstertruckd.run",
                "monstertruckd.run:run_wall",
                "monstertruckd.gate.latch:EstopLatch.prepare",
                "monstertruckd.bus.zenoh_session:ZenohBridge._declare_inputs",
                "monstertruck_drivers.epos.driver:EposDriver.run",
            )
        ),
    ],
)
async def test_sigterm_at_any_stage_of_the_start_is_an_ordinary_end(stage: str, tmp_path: Path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "numba")}  # the worker compiles its kernels anew
    async with robot(tmp_path, base=ROOT / "configs" / "slam.yaml") as truck:
        daemon = await asyncio.create_subprocess_exec(
            *(sys.executable, "-c", STAGE, stage, "run", "--config", str(truck.config)),
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        try:
            async with asyncio.timeout(30):
                out, errors = await daemon.communicate()
        finally:
            if daemon.returncode is None:
                daemon.kill()
    assert (out[:7], daemon.returncode) == (b"reached", 0), errors.decode()
    assert b"Traceback" not in errors


def catches_sigterm(process: int) -> bool:
    (caught,) = re.findall(r"SigCgt:\s*(\w+)", Path(f"/proc/{process}/status").read_text())
    return bool(int(caught, 16) & 1 << (signal.SIGTERM - 1))


@pytest.mark.long
async def test_sigterm_at_any_moment_of_the_start_is_an_ordinary_end(tmp_path: Path):
    async with robot(tmp_path, base=ROOT / "configs" / "slam.yaml") as truck:
        await truck.start_simulator()
        for seconds in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.2, 1.5, 2.0, 3.0):
            await truck.start_daemon()
            assert truck.daemon is not None
            while not catches_sigterm(truck.daemon.pid):  # Python itself takes as long to start as the computer is busy
                await asyncio.sleep(0.002)
            await asyncio.sleep(seconds)
            assert await end(truck.daemon) == 0, seconds
    assert "Traceback" not in (tmp_path / "run.txt").read_text()


async def test_sigterm_stops_the_truck_first_and_closes_the_log(tmp_path: Path):
    async with robot(tmp_path) as truck:
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client() as client:
            await truck.drive(client)
        asked = truck.clock.now() / SECOND
        assert await end(truck.daemon) == 0
        took = truck.clock.now() / SECOND - asked
        await asyncio.sleep(0.5)
        truth = await truck.truth()
    assert took < 5
    assert speed_after(truth, asked, 0.6) < 0.01
    (log,) = truck.logs()
    assert info(log)["damage"] is None
    last = [m for m in open_log(log) if m.topic == "cmd/drive"][-1].decode()
    assert isinstance(last, DriveCommand)
    assert last.action is not DriveAction.RUN
    assert last.motor_velocity == 0.0


async def test_kill_9_loses_at_most_a_second_of_log_and_the_next_start_stops_the_truck(tmp_path: Path):
    async with robot(tmp_path) as truck:
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client() as client:
            await truck.drive(client)
            await asyncio.sleep(1.0)
        killed = truck.clock.now()
        await end(truck.daemon, signal.SIGKILL)
        (log,) = truck.logs()
        damaged = tmp_path / "damaged.mcap"
        damaged.write_bytes(log.read_bytes())
        restarted = truck.clock.now()
        await truck.start_daemon()
        async with truck.client():
            await asyncio.sleep(1.0)
            async with asyncio.timeout(40):
                while info(log)["damage"] is not None:  # the next start repairs it in place
                    await asyncio.sleep(0.1)
        assert await end(truck.daemon) == 0
        truth = await truck.truth()
    recovery = recover(damaged, tmp_path / "repaired.mcap")
    assert recovery.damage is not None
    newest = max(message.log_time for message in open_log(tmp_path / "repaired.mcap"))
    assert killed - newest < SECOND
    # The drive controller keeps its last speed while nobody talks to it; the first thing it then hears is a stop.
    before = truth[(truth[:, 0] > killed / SECOND + 0.1) & (truth[:, 0] < restarted / SECOND)]
    assert np.all(before[:, 4] > 0.1)
    assert abs(truth[-1, 4]) < 0.01


async def test_sigstop_is_caught_by_the_deadman_line_where_wired(tmp_path: Path):
    async with robot(tmp_path, DEADMAN_LINE) as truck:
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client() as client:
            await truck.drive(client)
        assert truck.daemon is not None
        stopped = truck.clock.now() / SECOND
        truck.daemon.send_signal(signal.SIGSTOP)
        await asyncio.sleep(1.5)
        truck.daemon.send_signal(signal.SIGCONT)
        truth = await truck.truth()
        await end(truck.daemon)
    assert speed_after(truth, stopped, 0.75) < 0.01
    assert metres_after(truth, stopped) < 0.15


async def test_sigstop_without_the_line_lets_the_truck_drive_on_and_going_on_stops_it(tmp_path: Path):
    async with robot(tmp_path) as truck:
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client() as client:
            await truck.drive(client)
            assert truck.daemon is not None
            stopped = truck.clock.now() / SECOND
            truck.daemon.send_signal(signal.SIGSTOP)
            await asyncio.sleep(1.5)
            continued = truck.clock.now() / SECOND
            truck.daemon.send_signal(signal.SIGCONT)
            await asyncio.sleep(4.0)
        truth = await truck.truth()
        await end(truck.daemon)
    frozen = truth[(truth[:, 0] > stopped + 0.2) & (truth[:, 0] < continued)]
    assert np.all(frozen[:, 4] > 0.1), "documented: without the deadman line nothing stops it"
    # Some 0.3 s on a quiet computer; the limit leaves room for a busy one.
    assert speed_after(truth, continued, 3.0) < 0.01, "the stalled tick stops the truck as soon as it runs again"


async def test_a_second_daemon_is_refused_clearly(tmp_path: Path):
    async with robot(tmp_path) as truck:
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client() as client:
            second = await asyncio.to_thread(_run, truck.config)
            assert second.returncode == Reason.BUSY.exit_code
            assert truck.endpoint.removeprefix("tcp/") in second.stderr
            assert truck.daemon is not None
            holder = rf"process {truck.daemon.pid} \(.* run --config {re.escape(str(truck.config))}\)"
            assert re.search(rf"in use by robot 'truck', {holder}", second.stderr), second.stderr
            assert "Traceback" not in second.stderr
            # Another robot name and endpoint, but the same ports: refused before anything is touched.
            other = tmp_path / "other.yaml"
            text = truck.config.read_text().replace(truck.endpoint, free_endpoint())
            other.write_text(text.replace(str(tmp_path / "logs"), str(tmp_path / "logs2")) + "robot: intruder\n")
            third = await asyncio.to_thread(_run, other)
            assert third.returncode == Reason.DEVICE_BUSY.exit_code
            held = re.search(rf"^(drive|steering): .*: held by .*{holder}", third.stderr, re.MULTILINE)
            assert held, third.stderr
            assert "Traceback" not in third.stderr
            health = await client.get_retained(topics.HEALTH)
            assert health is not None
            assert [row for row in health.services if row.restarts] == []


async def test_one_terminal_holds_truck_and_daemon_and_the_daemon_ends_first(tmp_path: Path):
    async with robot(tmp_path) as truck:
        truck.simulator = await truck.spawn("simulate", "--run", "--config", str(truck.config))
        async with truck.client() as client:
            health = await client.get_retained(topics.HEALTH)
        assert health is not None
        assert await end(truck.simulator) == 0
        said = (tmp_path / "simulate.txt").read_text()
        assert "bug" not in said
        assert "lost" not in said
        assert "ready" not in said.splitlines(), "the daemon says when all of it is"
        assert info(truck.logs()[0])["damage"] is None


async def test_a_daemon_that_cannot_start_ends_the_truck_with_its_exit_code(tmp_path: Path):
    async with robot(tmp_path) as truck:
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client():
            other = tmp_path / "other.yaml"
            other.write_text(truck.config.read_text().replace(f"{tmp_path}/", f"{tmp_path}/other/"))
            second = await truck.spawn("simulate", "--run", "--config", str(other))
            assert await asyncio.wait_for(second.wait(), 30) == Reason.BUSY.exit_code


def _run(config: Path) -> subprocess.CompletedProcess[str]:
    arguments = [sys.executable, "-m", "monstertruckd", "run", "--config", str(config)]
    return subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True, timeout=30, check=False)


async def test_the_stop_script_stops_the_truck_after_the_daemon_was_killed(tmp_path: Path):
    async with robot(tmp_path) as truck:
        await truck.start_simulator()
        await truck.start_daemon()
        async with truck.client() as client:
            await truck.drive(client)
        await end(truck.daemon, signal.SIGKILL)
        started = truck.clock.now() / SECOND
        script = [sys.executable, "-I", str(ROOT / "systemd" / "neutral.py"), str(tmp_path / "dev" / "drive")]
        done = await asyncio.to_thread(subprocess.run, script, capture_output=True, text=True, timeout=20, check=False)
        assert done.returncode == 0, done.stderr
        await asyncio.sleep(0.5)
        truth = await truck.truth()
    moving = truth[(truth[:, 0] > started) & (np.abs(truth[:, 4]) > 0.01)]
    assert len(moving) == 0 or moving[-1, 0] - started < 2.0
    assert np.abs(truth[-5:, 4]).max() < 0.01


async def test_the_stop_script_says_so_when_the_controller_refuses(tmp_path: Path):
    async with robot(tmp_path) as truck:
        await truck.start_simulator()
        script = [sys.executable, "-I", str(ROOT / "systemd" / "neutral.py"), f"{tmp_path / 'dev' / 'drive'}=5@38400"]
        done = await asyncio.to_thread(subprocess.run, script, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 1
    assert "refused with error 0x0F00FFB9" in done.stderr
    assert "stopped" not in done.stdout
