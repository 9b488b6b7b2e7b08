"""Draws the pictures of the station's page: every view, light and dark, and on a phone.

    python -m docs.pictures.station

A recorded drive to a goal is published slowly, a station shows it, and Debian's chromium takes the pictures.
"""

import asyncio
import contextlib
import tempfile
from pathlib import Path

from playwright.async_api import Browser, Page

from monstertruckd.tools.demo.runs import free_endpoint
from tests.daemon.browser_kit import chromium, station
from tests.daemon.wall_kit import ROOT, Robot, end

HERE = Path(__file__).parent
LOG = ROOT / "tests" / "data" / "replay" / "goals.mcap"
DESK = {"width": 1280, "height": 800}
PHONE = {"width": 360, "height": 740}


async def main() -> None:
    """Everything."""
    with tempfile.TemporaryDirectory() as name:
        made = Robot(Path(name), free_endpoint(), LOG)
        async with station(made) as url, chromium(made.folder) as browser:
            for theme in ("light", "dark"):
                for view, size in (("", DESK), ("-phone", PHONE)):
                    await pictures(made, browser, url, theme, view, size)


async def pictures(made: Robot, browser: Browser, url: str, theme: str, view: str, size: dict[str, int]) -> None:
    """All tabs of one theme and size, during one replay."""
    page = await (await browser.new_context(viewport=size, color_scheme=theme, has_touch=bool(view))).new_page()
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
    """One picture of one tab."""
    await page.evaluate(
        f"document.querySelector('#tab-{tab}').click(); window.scrollTo(0, {'0' if tab == 'drive' else '1e6'})"
    )
    await asyncio.sleep(0.4)
    await page.screenshot(path=HERE / f"{name}.png")


if __name__ == "__main__":
    asyncio.run(main())
