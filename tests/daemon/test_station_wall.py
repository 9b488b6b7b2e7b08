"""The station's page in a real browser, before an emulated truck."""

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from playwright.async_api import Browser, Page, expect

from monstertruck_runtime.clock import SECOND
from monstertruck_runtime.mailbox import Mailbox, fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.cmd import DriveAction, DriveCommand
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.station.pilot import LEASE
from monstertruckd.station.users import add_user
from tests.daemon.browser_kit import NEEDS_CHROMIUM, PATIENCE, chromium, opened, shows, station
from tests.daemon.wall_kit import ROOT, Robot, end, kept_armed, planner_ready, robot
from tests.unit.station.certificate import self_signed

pytestmark = [pytest.mark.wall, pytest.mark.timeout(240), NEEDS_CHROMIUM]

FREE = {"path": None, "map": None, "tracker": None}
"""Nothing but a hand drives."""
UNDER_WAY: Final = 0.2
"""Seconds in which a heartbeat and its command reach the other end on a busy computer."""


async def becomes(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(30):
        while not condition():
            await asyncio.sleep(0.02)


def mode(gate: Mailbox[GateState]) -> GateMode | None:
    return None if gate.latest is None else gate.latest.mode


async def started(made: Robot) -> None:
    await made.start_simulator()
    await made.start_daemon()


class Stick:
    """The joystick of a page, moved with the mouse."""

    def __init__(self, page: Page):
        self._page = page

    async def release(self) -> None:
        await self._page.mouse.up()

    async def push(self) -> None:
        box = await self._page.locator("#stick").bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        await self._page.mouse.move(x, y)
        await self._page.mouse.down()
        await self._page.mouse.move(x, y - 0.45 * box["height"], steps=3)


class Key:
    """The key that drives ahead."""

    def __init__(self, page: Page):
        self._page = page

    async def release(self) -> None:
        await self._page.keyboard.up("w")

    async def push(self) -> None:
        await self._page.keyboard.down("w")


class Pad:
    """A gamepad that the browser believes in, with its right shoulder button as the deadman."""

    def __init__(self, page: Page):
        self._page = page

    async def release(self) -> None:
        await self._say(pressed=False)

    async def push(self) -> None:
        await self._say(pressed=True)

    async def _say(self, *, pressed: bool) -> None:
        await self._page.evaluate(
            """(pressed) => {
                const buttons = Array.from({ length: 17 }, (_, i) => ({ pressed: pressed && i === 5 }));
                const pad = { connected: true, mapping: "standard", id: "synthetic", axes: [0, -0.9, 0, 0], buttons };
                navigator.getGamepads = () => [pad];
            }""",
            pressed,
        )


def moves(gate: Mailbox[GateState]) -> bool:
    return gate.latest is not None and gate.latest.twist is not None and gate.latest.twist.vx > 0.01


async def arm_and_hold(page: Page, gate: Mailbox[GateState], hand: Stick | Key | Pad | None = None) -> None:
    """Arm, and push an input forward until the truck moves; again where the busy computer itself stops it."""
    await page.click("#tab-drive")
    hand = hand or Stick(page)
    async with asyncio.timeout(90):
        while not moves(gate):
            await hand.release()
            await page.evaluate("document.querySelector('#arm').click()")
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(3):
                    while mode(gate) not in (GateMode.ARMED, GateMode.DRIVING):
                        await asyncio.sleep(0.02)
                    await hand.push()
                    while not moves(gate):
                        await asyncio.sleep(0.02)


async def hand_over(page: Page, other: Page, gate: Mailbox[GateState]) -> None:
    """From the page that drives to the other; again where the busy computer itself stops the truck meanwhile."""
    assert gate.latest is not None
    driver = gate.latest.holder
    async with asyncio.timeout(40):
        while gate.latest.holder in (driver, None):
            if not moves(gate):
                await arm_and_hold(page, gate)
            await other.evaluate("document.querySelector('#ask').click()")
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1):
                    while gate.latest.holder in (driver, None):
                        await page.evaluate("document.querySelector('#asking button')?.click()")
                        await asyncio.sleep(0.05)


async def reset(page: Page) -> None:
    """Clear the emergency stop, as often as it takes: it is refused until truck and stick are at rest."""
    async with asyncio.timeout(40):
        while await page.get_attribute("#authority", "data-mode") != "disarmed":
            await page.evaluate("document.querySelector('#reset').click()")
            await asyncio.sleep(0.5)


async def test_emergency_stop_by_button_and_space_bar_and_two_users_are_two_sources(tmp_path: Path):
    users = tmp_path / "users.yaml"
    self_signed(tmp_path)
    options = ("--certificate", tmp_path / "station.pem", "--key", tmp_path / "station.key", "--users", users)
    for name in ("ann", "bob"):
        add_user(users, name, AccessRole.PILOT, f"the password of {name}")

    async def logged_in(browser: Browser, url: str, name: str) -> Page:
        login = {"username": name, "password": f"the password of {name}"}
        return await opened(browser, url, http_credentials=login, ignore_https_errors=True)

    async with robot(tmp_path, FREE) as made:
        await started(made)
        async with (
            made.client() as client,
            station(made, *map(str, options), scheme="https") as url,
            chromium(tmp_path) as browser,
        ):
            gate = client.subscribe(topics.GATE, latest())
            stops = client.subscribe(topics.STOP, latest())
            page, other = await logged_in(browser, url, "ann"), await logged_in(browser, url, "bob")

            await arm_and_hold(page, gate)
            assert gate.latest is not None
            driver = gate.latest.holder
            assert driver is not None
            assert "ann-" in driver
            assert gate.latest.role is Role.STATION
            await expect(page.locator("#holder-name")).to_have_text("You drive", timeout=PATIENCE)
            await expect(other.locator("#holder-name")).to_contain_text(f"{driver} drives", timeout=PATIENCE)
            await hand_over(page, other, gate)
            assert "bob-" in str(gate.latest.holder)
            await page.mouse.up()
            await arm_and_hold(page, gate)
            driver = gate.latest.holder
            await other.keyboard.press("Space")
            await shows(page, "estopped")
            await page.mouse.up()
            await becomes(lambda: stops.latest is not None and stops.latest.reason is Reason.ESTOP_REQUESTED)
            assert stops.latest is not None
            assert stops.latest.causes[0].source != driver

            await reset(page)
            await page.focus("#theme")
            await page.keyboard.press("Space")
            await shows(page, "estopped")
            theme = await page.evaluate("document.documentElement.dataset.theme")
            assert theme == "light", "the space bar is nothing but the emergency stop, whatever has the focus"
            await reset(page)
            await page.click("#estop")
            await shows(other, "estopped")


async def test_a_hand_that_lets_go_and_a_browser_that_freezes_reloads_or_loses_its_network_stop_the_truck(
    tmp_path: Path,
):
    """And nothing repeats a last value; a daemon that is started anew is there on the page, and is stopped from it."""
    async with robot(tmp_path, FREE) as made:
        await started(made)
        async with made.client() as client, station(made) as url, chromium(tmp_path) as browser:
            gate = client.subscribe(topics.GATE, latest())
            commands = client.subscribe(topics.CMD_DRIVE, fifo(4096))
            page = await opened(browser, url)
            for hand, role in ((Key(page), Role.KEYBOARD), (Pad(page), Role.GAMEPAD)):
                await arm_and_hold(page, gate, hand)
                assert gate.latest is not None
                assert gate.latest.role is role
                await hand.release()
                await becomes(lambda: mode(gate) is GateMode.DISARMED)

            await arm_and_hold(page, gate)
            frozen = processes_below(os.getpid(), "chromium")
            assert frozen
            try:
                for process in frozen:
                    os.kill(process, signal.SIGSTOP)
                await _stops(gate, commands)
            finally:
                for process in frozen:
                    os.kill(process, signal.SIGCONT)
            await page.mouse.up()
            await asyncio.sleep(1.0)
            assert mode(gate) is GateMode.DISARMED
            assert all(neutral(command) for command in commands.drain())

            await arm_and_hold(page, gate, Key(page))
            await page.context.set_offline(True)  # a lid that is closed
            await _stops(gate, commands)
            await page.context.set_offline(False)
            await Key(page).release()
            await shows(page, "disarmed")

            await arm_and_hold(page, gate, Key(page))
            await page.reload()
            await _stops(gate, commands)
            await shows(page, "disarmed")

            assert await end(made.daemon) == 0
            await page.wait_for_selector("#authority[data-mode=unknown]")
            await made.start_daemon()
            await shows(page, "disarmed")
            await page.keyboard.press("Space")
            await shows(page, "estopped")


async def _stops(gate: Mailbox[GateState], commands: Mailbox[DriveCommand]) -> None:
    """Wait until the robot is disarmed; a lease after the last heartbeat the motor is asked for nothing any more.

    Within its lease a request outlives a short fault, such as the stop of a busy computer, and so drives once more.
    """
    silent = time.monotonic_ns() + round((LEASE + UNDER_WAY) * SECOND)
    await becomes(lambda: mode(gate) is GateMode.DISARMED and time.monotonic_ns() > silent + SECOND)
    later = [command for command in commands.drain() if command.stamp > silent]
    assert len(later) > 10
    assert all(neutral(command) for command in later)


def neutral(command: DriveCommand) -> bool:
    return command.action is not DriveAction.RUN or command.motor_velocity == 0.0


def processes_below(parent: int, name: str) -> list[int]:
    """Children and their children whose program is ``name``."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            head, _, tail = (folder / "stat").read_text().rpartition(")")
        except OSError:
            continue
        parents[int(folder.name)] = (int(tail.split()[1]), head.partition("(")[2])
    below, found = {parent}, []
    while more := {child for child, (above, _) in parents.items() if above in below} - below:
        below |= more
        found += [child for child in more if name in parents[child][1]]
    return found


@pytest.mark.long
async def test_a_goal_set_with_the_mouse_is_reached_in_the_world(tmp_path: Path):
    async with robot(tmp_path, base=ROOT / "configs/goals.yaml") as made:
        await started(made)
        async with made.client() as client, station(made) as url, chromium(tmp_path) as browser:
            goals = client.subscribe(topics.GOAL, latest())
            page = await opened(browser, url)
            await planner_ready(client)
            await page.click("#tab-settings")
            await page.fill("#setting-gate-speed", "9")
            await page.press("#setting-gate-speed", "Tab")
            await expect(page.locator("#refusal")).to_contain_text("at most", timeout=PATIENCE)
            await page.fill("#setting-gate-reverse_speed", "0.14")
            await page.press("#setting-gate-reverse_speed", "Tab")
            await expect(page.locator("#setting-gate-reverse_speed-note")).to_contain_text("0.15 at the start")
            assert (await client.call("config"))["gate"]["reverse_speed"] == 0.14
            await page.click("#tool-goal")
            box = await page.locator("#map").bounding_box()
            assert box is not None
            # The map follows the truck at 90 pixels a metre: 1.5 m ahead, facing as now.
            x, y = box["x"] + box["width"] / 2 + 135, box["y"] + box["height"] / 2
            await page.mouse.move(x, y)
            await page.mouse.down()
            await page.mouse.move(x + 60, y, steps=3)
            await page.mouse.up()
            await page.click("#goal-go")
            async with kept_armed(client), asyncio.timeout(120):
                while goals.latest is None or goals.latest.number == 0 or goals.latest.outcome is Reason.DRIVING:
                    await asyncio.sleep(0.1)
            assert goals.latest.outcome is Reason.GOAL_REACHED, goals.latest.text
            await expect(page.locator("#goal-text")).to_contain_text("Goal 1:", timeout=PATIENCE)
        truth = await made.truth()
        assert np.hypot(*(truth[-1, 1:3] - (2.5, 3.95))) < 0.3
