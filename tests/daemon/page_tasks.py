"""Six tasks that a new user carries out on the station's page, each up to the feedback that it worked."""

import asyncio
import re
import signal
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from playwright.async_api import Locator, Page, expect

from tests.daemon.browser_kit import PATIENCE
from tests.daemon.wall_kit import ROOT, end

PRESS = 2.65
"""Seconds to decide on, point at and press a control: 1.35 + 1.1 + 0.2 s (keystroke-level model of Card et al.)."""
TYPED = 0.28
"""Seconds to type a character, average non-secretary typist of the same model."""


class Hand:
    """Presses and types in a page, and counts the time that a person takes for it."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.seconds = 0.0

    async def press(self, target: str | Locator) -> None:
        """Press a control."""
        self.seconds += PRESS
        await (self.page.locator(target) if isinstance(target, str) else target).click(timeout=PATIENCE)

    async def press_map(self, across: float, down: float) -> None:
        """Press the map at a fraction of its width and height."""
        box = await self.page.locator("#map").bounding_box()
        assert box is not None
        self.seconds += PRESS
        await self.page.mouse.click(box["x"] + across * box["width"], box["y"] + down * box["height"])

    async def type(self, field: str, text: str) -> None:
        """Type into a field."""
        self.seconds += PRESS + TYPED * len(text)
        await self.page.fill(field, text)

    async def button(self, name: str) -> None:
        """Press the first button of that name."""
        await self.press(self.page.get_by_role("button", name=name, exact=True).first)


async def add_zone(hand: Hand) -> None:
    """Draw a keepout zone ahead of the robot, and see it in the list."""
    await hand.press("#tab-tasks")
    await hand.press("#zone-draw")
    for place in ((0.55, 0.7), (0.9, 0.7), (0.9, 0.82)):
        await hand.press_map(*place)
    await hand.type("#zone-name", "My zone")
    await hand.press("#zone-add")
    await expect(hand.page.locator("#zones")).to_contain_text("my-zone", timeout=PATIENCE)


async def run_mission(hand: Hand) -> None:
    """Draw a mission of one waypoint ahead of the robot, run it until the robot drives, and stop it."""
    page = hand.page
    await hand.press("#tab-tasks")
    await hand.press("#mission-draw")
    await hand.press_map(0.68, 0.5)
    async with asyncio.timeout(PATIENCE / 1000):
        while await page.locator("#mission").is_visible():  # a busy computer may refuse to arm once
            await hand.press("#mission-run")
            await asyncio.sleep(1.0)
    await expect(page.locator("#mission-state")).to_contain_text("step 1", timeout=PATIENCE)
    await hand.press("#mission-stop")
    await expect(page.locator("#mission-start")).to_be_visible(timeout=PATIENCE)


async def plot_battery(hand: Hand) -> None:
    """Plot the battery's voltage by the word for it, until the curve has a value."""
    await hand.press("#tab-plots")
    await hand.type("#plot-name", "battery")
    await hand.press("#plot-add")
    await hand.button("Add battery voltage")
    await expect(hand.page.locator(".legend output")).to_contain_text(" V", timeout=PATIENCE)


async def calibrate_compass(hand: Hand) -> None:
    """Start the wizard of the compass, confirm the floor, see its first order to move, and cancel it."""
    page = hand.page
    await hand.press("#tab-system")
    await hand.press("#wizards-list")
    await hand.button("Calibrate compass")
    await expect(page.locator("#wizard-question")).to_contain_text("floor clear", timeout=PATIENCE)
    await expect(page.locator("#wizard-yes"), "the question is in view").to_be_in_viewport()
    await hand.press("#wizard-yes")
    await expect(page.locator("#wizard-said")).to_contain_text("moving", timeout=PATIENCE)
    await hand.press("#wizard-discard")
    await expect(page.locator("#wizards")).to_be_visible(timeout=PATIENCE)


async def download_log(hand: Hand) -> None:
    """Download the log that is being written."""
    await hand.press("#tab-recordings")
    async with hand.page.expect_download(timeout=PATIENCE) as download:
        await hand.press(hand.page.locator("#recordings a").first)
    assert (await download.value).suggested_filename.endswith(".mcap")


async def replay_log(hand: Hand) -> None:
    """Replay the log that is being written, and go back to the robot."""
    page = hand.page
    await hand.press("#tab-recordings")
    await hand.button("Replay")
    await expect(page.locator("#replay-time")).to_contain_text(" s", timeout=3 * PATIENCE)
    await expect(page.locator("#replay-fault")).not_to_contain_text("damaged")
    await expect(page.locator("[role=tabpanel]:visible"), "beside the map is a pane").to_have_count(1)
    await hand.press("#replay-end")
    await expect(page.locator("#replay")).to_be_hidden(timeout=PATIENCE)


TASKS: dict[str, Callable[[Hand], Awaitable[None]]] = {
    "add_zone": add_zone,
    "run_mission": run_mission,
    "plot_battery": plot_battery,
    "calibrate_compass": calibrate_compass,
    "download_log": download_log,
    "replay_log": replay_log,
}


async def timed(page: Page, task: Callable[[Hand], Awaitable[None]]) -> float:
    """Carry out a task; return the seconds that the page took, and a person takes to press and type."""
    hand, began = Hand(page), time.monotonic()
    await task(hand)
    return time.monotonic() - began + hand.seconds


@asynccontextmanager
async def tried(folder: Path) -> AsyncIterator[str]:
    """URL of the page of ``monstertruckd try``, which a signal ends without an error."""
    said = folder / "said.txt"
    with said.open("wb") as output:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "monstertruckd", "try", "--no-browser", "--output", str(folder / "try")),
            cwd=ROOT,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=output,
            stderr=output,
        )
    try:
        async with asyncio.timeout(60):
            while (found := re.search(r"http://127\.0\.0\.1:\d+/", said.read_text())) is None:
                await asyncio.sleep(0.1)
        yield found[0]
    finally:
        code = await end(process, signal.SIGINT)
    assert code == 0
