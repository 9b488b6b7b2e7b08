"""Draws the pictures of the station's page: every view, light and dark, and on a phone.

    python -m docs.pictures.station

A recorded drive to a goal is published slowly, a station shows it, and Debian's chromium takes the pictures; views that
ask the robot for something are those of an emulated truck that explores.
"""

import asyncio
import contextlib
import re
import sys
import tempfile
from pathlib import Path

from playwright.async_api import Browser, Page

from monstertruckd.tools.demo.runs import free_endpoint
from tests.daemon.browser_kit import chromium, new_tab, station
from tests.daemon.wall_kit import ROOT, Robot, end, robot

HERE = Path(__file__).parent
LOG = ROOT / "tests" / "data" / "replay" / "goals.mcap"
DESK = {"width": 1280, "height": 800}
PHONE = {"width": 360, "height": 740}
EXPLORING = {
    "path": None,
    "map": None,
    "planner": {"map": None},
    "tracker": {"kind": "lqr"},
    "slam": {
        "mode": "mapping",
        "tiles_period": 0.5,
        "map_period": 2.0,
        "grid": {"passed": 5.6, "free_footprint": True},
    },
    "explorer": {"kind": "information"},
    "odometry": {"start": {"x": 1.0, "y": 3.95, "yaw": 0.0}},
    "sim": {"world": {"map": "rooms"}},
}
"""The whole emulated truck in rooms that it does not know."""


async def main() -> None:
    """Everything."""
    with tempfile.TemporaryDirectory() as name:
        made = Robot(Path(name), free_endpoint(), LOG)
        async with station(made) as url, chromium(made.folder) as browser:
            for theme in ("light", "dark"):
                for view, size in (("", DESK), ("-phone", PHONE)):
                    await pictures(made, browser, url, theme, view, size)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        overlay = EXPLORING | {"machine": str(folder / "machine"), "recorder": {"directory": str(folder / "logs")}}
        async with robot(folder, overlay, ROOT / "configs" / "full.yaml") as made:
            await made.start_simulator()
            await made.start_daemon()
            async with station(made) as url, chromium(made.folder) as browser:
                for theme, view, size in (("light", "", DESK), ("dark", "", DESK), ("dark", "-phone", PHONE)):
                    await asking(browser, url, theme, view, size)
    with tempfile.TemporaryDirectory() as name:
        await tried(Path(name))


async def tried(folder: Path) -> None:
    """The page of ``monstertruckd try``, with an obstacle and a device that was unplugged."""
    said = folder / "said.txt"
    with said.open("wb") as output:
        words = ("-m", "monstertruckd", "try", "--no-browser", "--output", str(folder / "try"))
        process = await asyncio.create_subprocess_exec(sys.executable, *words, stdout=output, stderr=output)
    try:
        while (found := re.search(r"http://127[0-9.:]+/", said.read_text())) is None:
            await asyncio.sleep(0.1)
        async with chromium(folder) as browser:
            page = await new_tab(browser, viewport=DESK)
            await page.goto(found[0])
            await page.wait_for_selector("#map[data-drawn=true]", timeout=60_000)
            await page.click("#tab-tryout")
            await page.click("#obstacle-add")
            await page.click("#map", position={"x": 560, "y": 330})
            await page.select_option("#fault-compass", "unplugged")
            await asyncio.sleep(3.0)
            await page.evaluate("document.querySelectorAll('#banners button').forEach((button) => button.click())")
            await page.screenshot(path=HERE / "station-try.png")
    finally:
        await end(process)


async def asking(browser: Browser, url: str, theme: str, view: str, size: dict[str, int]) -> None:
    """Views of a robot that is there: tasks, settings, recordings, a replay, a path that is drawn."""
    page = await new_tab(browser, viewport=size, color_scheme=theme, has_touch=bool(view))
    page.set_default_timeout(60_000)
    await page.goto(url)
    await page.wait_for_selector("html[data-ready=true]")
    await page.wait_for_selector("#authority:not([data-mode=unknown])")
    await asyncio.sleep(5.0)
    for tab in ("tasks", "settings", "recordings"):
        await page.evaluate(f"document.querySelector('#tab-{tab}').click()")
        await asyncio.sleep(1.5)
        await picture(page, f"station{view}-{theme}-{tab}", tab)
    await page.evaluate("window.scrollTo(0, 0)")
    await page.click("#tool-draw")
    box = await page.locator("#map").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    await page.mouse.move(x, y)
    await page.mouse.down()
    for dx, dy in ((60, 0), (90, -10), (120, -30)):
        await page.mouse.move(x + dx, y + dy, steps=5)
    await page.mouse.up()
    await page.evaluate("document.querySelectorAll('#banners button').forEach((button) => button.click())")
    await page.screenshot(path=HERE / f"station{view}-{theme}-path.png")
    await page.click("#goal-drop")
    await page.locator("#recordings button").first.click()
    await page.wait_for_selector("#replay:not([hidden])")
    await asyncio.sleep(1.0)
    await page.evaluate(
        "const bar = document.querySelector('#replay-at'); bar.value = 0.9 * bar.max;"
        "bar.dispatchEvent(new Event('change'));"
        "document.querySelector('#tab-truck').click(); window.scrollTo(0, 0)"
    )
    await asyncio.sleep(1.5)
    await page.screenshot(path=HERE / f"station{view}-{theme}-replay.png")
    await page.context.close()


async def pictures(made: Robot, browser: Browser, url: str, theme: str, view: str, size: dict[str, int]) -> None:
    """All tabs of one theme and size, during one replay."""
    page = await new_tab(browser, viewport=size, color_scheme=theme, has_touch=bool(view))
    await page.goto(url)
    await page.wait_for_selector("html[data-ready=true]")
    for _ in range(4):
        await page.click("#tool-in")
    replaying = await made.spawn("replay", str(LOG), "--endpoint", made.endpoint, "--speed", "0.25")
    try:
        await page.wait_for_selector("#authority[data-mode=driving]", timeout=60_000)
        await asyncio.sleep(2.0)
        for tab in ("drive", "truck", "system", "events"):
            await picture(page, f"station{view}-{theme}-{tab}", tab)
    finally:
        await page.context.close()
        with contextlib.suppress(ProcessLookupError):
            await end(replaying)


async def picture(page: Page, name: str, tab: str) -> None:
    """One picture of one tab, without what a busy computer is warned of."""
    await page.evaluate("document.querySelectorAll('#banners button').forEach((button) => button.click())")
    await page.evaluate(
        f"document.querySelector('#tab-{tab}').click(); window.scrollTo(0, {'0' if tab == 'drive' else '1e6'})"
    )
    await asyncio.sleep(0.4)
    await page.screenshot(path=HERE / f"{name}.png")


if __name__ == "__main__":
    asyncio.run(main())
