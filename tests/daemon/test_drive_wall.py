"""Driving by keyboard: a terminal, a truck, and what silence does."""

import asyncio
import contextlib
import os
import pty
import signal
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.fuzz_requests import call_names
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.endpoints import robot_on_host
from monstertruck_runtime.errors import RequestRefusedError, TruckError
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveForm, Order, Role
from monstertruck_schemas.state import GateMode, GateState, Odometry
from tests.daemon.wall_kit import ROOT, Robot, command, end, robot

pytestmark = [pytest.mark.wall, pytest.mark.timeout(180)]


@dataclass
class Terminal:
    """A user before a terminal in which `drive` runs."""

    user: int
    process: asyncio.subprocess.Process
    shown: bytes = b""

    def read(self) -> None:
        try:
            self.shown += os.read(self.user, 65536)
        except OSError:
            self.close()

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self.user)
        with contextlib.suppress(OSError):
            os.close(self.user)

    async def hold(self, key: bytes, until: Callable[[], bool]) -> None:
        """Let a key repeat until something is so."""
        async with asyncio.timeout(20):
            while not until():
                os.write(self.user, key)
                await asyncio.sleep(0.04)


@asynccontextmanager
async def driving(made: Robot) -> AsyncIterator[Terminal]:
    user, program = pty.openpty()
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        *("-m", "monstertruckd", "drive", "--endpoint", made.endpoint, "--mode", "counter"),
        cwd=ROOT,
        stdin=program,
        stdout=program,
        stderr=program,
        start_new_session=True,
        env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "100", "LINES": "30"},
    )
    os.close(program)
    terminal = Terminal(user, process)
    asyncio.get_running_loop().add_reader(user, terminal.read)
    try:
        async with asyncio.timeout(30):
            while b"disarmed: Enter arms" not in terminal.shown:
                await asyncio.sleep(0.05)
        yield terminal
    finally:
        terminal.close()
        await end(process)


async def becomes(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(20):
        while not condition():
            await asyncio.sleep(0.02)


async def _wrong_requests_move_nothing(
    made: Robot, client: TruckClient, gate: Mailbox[GateState], odometry: Mailbox[Odometry]
) -> None:
    """Three hundred on every key, from another process; `benchmarks/fuzz_requests.py` sends more."""
    before = await odometry.next()
    names = ",".join(await call_names(client))
    fuzzer = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "benchmarks.fuzz_requests",
        "--fuzzer",
        made.endpoint,
        names,
        "300",
        "1",
        "2000",
        cwd=ROOT,
    )
    while fuzzer.returncode is None:
        assert _mode(gate) in (None, GateMode.DISARMED, GateMode.ESTOPPED)
        await asyncio.sleep(0.02)
    assert fuzzer.returncode == 0
    after = await odometry.next()
    assert (after.pose.x, after.pose.y) == pytest.approx((before.pose.x, before.pose.y), abs=0.005)
    async with asyncio.timeout(20):
        while _mode(gate) is not GateMode.DISARMED:
            with contextlib.suppress(TruckError):
                await client.order(Order.RESET)


async def test_the_truck_moves_while_a_key_is_held_and_silence_stops_it(tmp_path: Path):
    async with robot(tmp_path) as made:
        await made.start_simulator()
        await made.start_daemon()
        async with made.client() as client:
            gate = client.subscribe(topics.GATE, latest())
            odometry = client.subscribe(topics.ODOMETRY, latest())
            await _wrong_requests_move_nothing(made, client, gate, odometry)
            async with driving(made) as terminal:
                assert robot_on_host("truck", made.endpoint).encode() in terminal.shown
                await _drive_off(terminal, gate, odometry)
                await _stopped_and_disarmed(gate, odometry)

                await _drive_off(terminal, gate, odometry)
                terminal.process.send_signal(signal.SIGSTOP)
                await becomes(lambda: _mode(gate) is not GateMode.DRIVING)
                os.write(terminal.user, b"w" * 50)
                await _stopped_and_disarmed(gate, odometry)
                terminal.process.send_signal(signal.SIGCONT)

                await _drive_off(terminal, gate, odometry)
                os.write(terminal.user, b"e")
                await becomes(lambda: _mode(gate) is GateMode.ESTOPPED)
                await becomes(lambda: abs(_speed(odometry)) < 0.005)
                await terminal.hold(b"r", lambda: _mode(gate) is GateMode.DISARMED)

                await _drive_off(terminal, gate, odometry)
                terminal.close()
                await _stopped_and_disarmed(gate, odometry)
                assert await end(terminal.process, 0) == 0, "a terminal that is gone is an ordinary end"
            await _orders(made.endpoint)


async def test_the_keyboard_and_a_client_turn_a_robot_on_the_spot_by_twist(tmp_path: Path):
    overlay = {"robot": "truck", "tracker": None, "path": None}
    async with robot(tmp_path, overlay, base=ROOT / "configs/robots/differential.yaml") as made:
        await made.start_simulator()
        await made.start_daemon()
        async with made.client() as client:
            gate = client.subscribe(topics.GATE, latest())
            odometry = client.subscribe(topics.ODOMETRY, latest())
            async with driving(made) as terminal:
                os.write(terminal.user, b"6")
                await terminal.hold(b"\r", lambda: _mode(gate) is GateMode.DRIVING)
                await terminal.hold(b"d", lambda: _turning(odometry) < -0.2)
                assert gate.latest is not None
                assert (gate.latest.role, gate.latest.form) == (Role.KEYBOARD, DriveForm.TWIST)
                assert abs(_speed(odometry)) < 0.05
                await _stopped_and_disarmed(gate, odometry)
            async with asyncio.timeout(40):
                while _turning(odometry) < 0.3:
                    if _mode(gate) is GateMode.DISARMED:  # at first, and where a busy machine made samples stale
                        with contextlib.suppress(RequestRefusedError):  # the terminal has stopped it meanwhile
                            await client.arm()
                    await client.drive_twist(0.0, wz=0.5)
                    await asyncio.sleep(0.05)
            await client.stop()
            events = client.subscribe(topics.EVENT, fifo(100))
            await client.drive_twist(0.0, vy=0.1)
            async with asyncio.timeout(10):
                while (event := await events.next()).reason is not Reason.IMPOSSIBLE_MOTION:
                    pass
            assert "cannot move sideways" in event.text
        x, y, yaw = (await made.truth())[-1, 1:4]
        assert abs(x - 1.0) + abs(y - 3.95) < 0.1
        assert yaw != 0.0


async def _orders(endpoint: str) -> None:
    """Every order answered by the gate; asked again where a busy machine made a sample stale."""
    place = robot_on_host("truck", endpoint)
    for order, code, words in (
        ("disarm", 0, "disarmed"),
        ("arm", 0, "armed"),
        ("estop", 0, "estopped"),
        ("arm", Reason.ESTOPPED.exit_code, ""),
        ("reset", 0, "disarmed"),
    ):
        answers = []
        while (code, words) not in answers:
            done = await command(order, "--endpoint", endpoint)
            answers.append((done.returncode, done.stdout.strip().removeprefix(f"{place}: ")))
            assert len(answers) < 5, f"{order}: {answers}, {done.stderr}"
    done = await command("arm", "--robot", "nobody", "--endpoint", endpoint)
    assert done.returncode == Reason.NOT_FOUND.exit_code
    silent = await command("echo", "sensor/drive_4", "--timeout", "3", "--endpoint", endpoint)
    assert silent.returncode == Reason.TIMEOUT.exit_code
    assert silent.stderr.splitlines() == [
        "robot 'truck' is running but does not publish sensor/drive_4 yet; waiting",
        "no message of sensor/drive_4 received within 3 s",
    ]


async def _drive_off(terminal: Terminal, gate: Mailbox[GateState], odometry: Mailbox[Odometry]) -> None:
    await terminal.hold(b"\r", lambda: _mode(gate) is GateMode.DRIVING)
    assert gate.latest is not None
    assert gate.latest.role is Role.KEYBOARD, "the tracker does not drive off when the keyboard arms"
    await terminal.hold(b"w", lambda: _speed(odometry) > 0.08)


async def _stopped_and_disarmed(gate: Mailbox[GateState], odometry: Mailbox[Odometry]) -> None:
    await becomes(lambda: abs(_speed(odometry)) < 0.005)
    await becomes(lambda: _mode(gate) is GateMode.DISARMED)
    assert gate.latest is not None
    assert gate.latest.holder is None


def _mode(gate: Mailbox[GateState]) -> GateMode | None:
    return None if gate.latest is None else gate.latest.mode


def _turning(odometry: Mailbox[Odometry]) -> float:
    return 0.0 if odometry.latest is None else odometry.latest.twist.wz


def _speed(odometry: Mailbox[Odometry]) -> float:
    return 0.0 if odometry.latest is None else odometry.latest.twist.vx
