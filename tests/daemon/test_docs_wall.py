"""The documentation's command lines that need a running truck: all of them on one, in the order of the pages."""

import asyncio
import os
import pty
import re
import signal
import sys
from collections.abc import Callable, Coroutine
from pathlib import Path
from textwrap import indent
from typing import Any, TypeVar

import pytest

from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_schemas.base import Message
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import GOAL, ODOMETRY
from monstertruckd.station.users import add_user
from monstertruckd.tools.demo.runs import free_endpoint
from monstertruckd.tools.simulation.config import load_simulated
from tests.daemon.wall_kit import ROOT, Robot, command, planner_ready, robot
from tests.unit.docs.command_lines import INSTEAD, SERVING, Line, needs_truck, ours, starts_truck
from tests.unit.station.certificate import self_signed

M = TypeVar("M", bound=Message)

NOT_YET = {
    reason.exit_code
    for reason in (
        Reason.SCAN_STALE,
        Reason.DRIVE_STALE,
        Reason.STEERING_STALE,
        Reason.ATTITUDE_STALE,
        Reason.TICK_STALLED,
    )
}
"""What a busy computer may answer at first."""

pytestmark = [pytest.mark.wall, pytest.mark.timeout(300)]


async def test_every_line_on_a_running_truck(tmp_path: Path):
    others = {line.text for line in ours() if starts_truck(line)} - {"monstertruckd simulate --run"}
    for line in others:
        for file in re.split(r"--(?:config|robots) ", line)[1].split()[0].split(","):
            load_simulated(ROOT / file)
    async with robot(tmp_path, base=ROOT / "configs/demo.yaml") as made:
        await made.start_simulator()
        await made.start_daemon()
        async with made.client():
            pass
        for line in ours():
            if needs_truck(line):
                await _follow(line, made)


@pytest.mark.parametrize("line", SERVING)
async def test_a_line_that_serves_is_ready_and_ends_by_ctrl_c(line: str, tmp_path: Path):
    self_signed(tmp_path)
    add_user(tmp_path / "users.yaml", "ann", AccessRole.PILOT, "the password of ann")
    words = [*Line("", line).arguments, "--port", free_endpoint().rpartition(":")[2]]
    if not {"--robot", "--router"}.intersection(words):  # other tests run robots on this computer
        words += ["--robot", f"truck@{free_endpoint()}"]
    if "--foxglove" in words:
        words += ["--foxglove-port", free_endpoint().rpartition(":")[2]]
    with (tmp_path / "output.txt").open("w") as file:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "monstertruckd", *words), cwd=tmp_path, stdout=file, stderr=file
        )
    try:
        async with asyncio.timeout(60):
            while "station: http" not in (tmp_path / "output.txt").read_text():
                assert process.returncode is None, (tmp_path / "output.txt").read_text()
                await asyncio.sleep(0.1)
            process.send_signal(signal.SIGINT)
            assert await process.wait() == 0
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


async def test_samples_of_clients_drive(tmp_path: Path):
    page = (ROOT / "docs" / "zenoh.md").read_text(encoding="utf-8")
    samples = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    async with robot(tmp_path, base=ROOT / "configs/goals.yaml") as made:
        (steered,) = [text for text in samples if "async with TruckClient" in text]
        (called,) = [text for text in samples if "with Truck(" in text]
        await made.start_simulator()
        await made.start_daemon()
        async with made.client() as client:
            await planner_ready(client)
            program = f"import asyncio\nasync def main():\n{indent(steered, ' ' * 4)}\nasyncio.run(main())"
            with client.subscribe(ODOMETRY, latest()) as odometry:
                await _run_until(_arrives(odometry, lambda message: message.twist.vx > 0.05), program, made)
            with client.subscribe(GOAL, latest()) as goals:
                printed = await _run_until(_arrives(goals, lambda message: message.number > 0), called, made)
            assert float(printed) > 20


async def _arrives(box: Mailbox[M], wanted: Callable[[M], bool]) -> None:
    while not wanted(await box.next()):
        pass


async def _run_until(effect: Coroutine[Any, Any, None], sample: str, made: Robot) -> bytes:
    """Run a sample until its effect is seen, again where a busy computer disarms the truck; return its first line."""
    assert "tcp/192.168.1.7:7447" in sample
    code = sample.replace("tcp/192.168.1.7:7447", made.endpoint)
    seen, line, pipe = asyncio.create_task(effect), b"", asyncio.subprocess.PIPE
    async with asyncio.timeout(150):
        while not seen.done():
            process = await asyncio.create_subprocess_exec(sys.executable, "-u", "-c", code, stdout=pipe, stderr=pipe)
            ended = asyncio.create_task(process.communicate())
            try:
                await asyncio.wait((seen, ended), timeout=20, return_when=asyncio.FIRST_COMPLETED)
            finally:
                if process.returncode is None:
                    process.kill()
                output, errors = await ended
            assert b"Error" not in errors or b"RequestRefusedError" in errors, errors.decode()
            line = output.partition(b"\n")[0] or line
    return line


async def _follow(line: Line, made: Robot) -> None:
    instead = INSTEAD.get(line.text)
    if instead is not None and instead.line is None:
        return
    arguments = Line(line.place, instead.line if instead and instead.line else line.text).arguments
    arguments += ["--endpoint", made.endpoint]
    if arguments[0] == "drive":
        assert await _at_a_terminal(arguments, b"q") == 0
        return
    done = await command(*arguments)
    async with asyncio.timeout(60):
        while done.returncode in NOT_YET:
            done = await command(*arguments)
    assert done.returncode == 0, f"{line.place}: {line.text}: {done.stderr}"


async def _at_a_terminal(arguments: list[str], keys: bytes) -> int:
    """Start a command before a terminal, press keys once it shows something, wait for its end."""
    user, program = pty.openpty()
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "monstertruckd", *arguments),
        **dict.fromkeys(("stdin", "stdout", "stderr"), program),
        cwd=ROOT,
        env=os.environ | {"TERM": "xterm-256color", "COLUMNS": "100", "LINES": "30"},
        start_new_session=True,
    )
    os.close(program)
    shown = asyncio.to_thread(_read_all, user, keys)
    try:
        async with asyncio.timeout(60):
            await shown
            return await process.wait()
    finally:
        os.close(user)


def _read_all(terminal: int, keys: bytes) -> None:
    try:
        while os.read(terminal, 65536):
            os.write(terminal, keys)
    except OSError:  # how a pty says that the program is gone
        return
