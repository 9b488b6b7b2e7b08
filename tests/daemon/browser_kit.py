"""A real browser before the station's page: Debian's chromium, headless, driven by Playwright."""

import asyncio
import shutil
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.async_api import Browser, Page, async_playwright
from playwright.async_api import TimeoutError as PlaywrightTimeout

from monstertruckd.tools.demo.runs import free_endpoint
from tests.daemon.wall_kit import Robot, end

CHROMIUM = shutil.which("chromium")
NEEDS_CHROMIUM = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this computer (apt-get install chromium)")
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
PATIENCE = 20_000
"""Milliseconds a busy computer may take for what a page waits for."""


@asynccontextmanager
async def station(made: Robot, *options: str, scheme: str = "http") -> AsyncIterator[str]:
    """URL of a station before a robot; its process is ended at the end."""
    port = free_endpoint().rpartition(":")[2]
    process = await made.spawn("station", "--robot", f"truck@{made.endpoint}", "--port", port, *options)
    try:
        async with asyncio.timeout(40):
            while "station:" not in (made.folder / "station.txt").read_text():
                await asyncio.sleep(0.05)
        yield f"{scheme}://127.0.0.1:{port}/"
    finally:
        await end(process)


@asynccontextmanager
async def chromium(folder: Path, *flags: str) -> AsyncIterator[Browser]:
    """The browser; with a profile of its own, which Playwright makes and removes."""
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(
            executable_path=CHROMIUM, headless=True, args=[*FLAGS, *flags], env={"HOME": str(folder), "LANG": "C.UTF-8"}
        )
        try:
            yield browser
        finally:
            await browser.close()


async def new_tab(browser: Browser, **context: Any) -> Page:
    """A tab of somebody who has been here before: the page does not begin with its guide."""
    page = await (await browser.new_context(**context)).new_page()
    await page.add_init_script("localStorage.guided ??= 'yes'")
    return page


async def opened(browser: Browser, url: str, **context: Any) -> Page:
    """A tab with the page, as soon as it shows the gate's state; errors of its scripts fail the test."""
    page = await new_tab(browser, **context)
    page.set_default_timeout(PATIENCE)
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on(
        "request", lambda request: errors.append(request.url) if not request.url.startswith((url, "blob:")) else None
    )
    await page.goto(url)
    await page.wait_for_selector("#authority:is([data-mode=disarmed], [data-mode=estopped])")
    assert errors == []
    return page


async def shows(page: Page, mode: str) -> None:
    """Wait until the page shows this mode of the gate; a failure says what it shows instead."""
    try:
        await page.wait_for_selector(f"#authority[data-mode={mode}]")
    except PlaywrightTimeout:
        raise AssertionError(f"expected {mode}: {await page.inner_text('#authority')}") from None
