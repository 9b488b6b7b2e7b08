"""``monstertruckd try`` as a person meets it: one command, and the page maps, fails and is driven by clicks."""

import asyncio
import re
import signal
import sys
from pathlib import Path

import pytest
from playwright.async_api import expect

from tests.daemon.browser_kit import NEEDS_CHROMIUM, PATIENCE, chromium, opened
from tests.daemon.wall_kit import ROOT, end

pytestmark = [pytest.mark.wall, pytest.mark.timeout(240), NEEDS_CHROMIUM]


async def test_one_command_shows_map_faults_and_obstacles_and_ends_by_a_signal(tmp_path: Path):
    said = tmp_path / "said.txt"
    with said.open("wb") as output:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "monstertruckd", "try", "--no-browser", "--output", str(tmp_path / "try")),
            cwd=ROOT,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=output,
            stderr=output,
        )
    try:
        async with asyncio.timeout(60):
            while (found := re.search(r"http://127\.0\.0\.1:\d+/", said.read_text())) is None:
                await asyncio.sleep(0.1)
        url = found[0]
        async with chromium(tmp_path) as browser:
            page = await opened(browser, url)
            await page.wait_for_selector("#map[data-drawn=true]", timeout=4 * PATIENCE)
            await page.click("#tab-tryout")
            await page.select_option("#fault-compass", "unplugged")
            await expect(page.locator("#reasons")).to_contain_text("attitude", timeout=PATIENCE)
            await page.select_option("#fault-compass", "none")
            await expect(page.locator("#reasons")).not_to_contain_text("attitude", timeout=PATIENCE)
            await page.click("#obstacle-add")
            await page.click("#map", position={"x": 560, "y": 300})
            await expect(page.locator("#obstacle-clear")).to_be_enabled(timeout=PATIENCE)
            assert await page.inner_text("#refusal") == ""
    finally:
        code = await end(process, signal.SIGINT)
    assert code == 0
    assert list((tmp_path / "try" / "logs").glob("*.mcap"))
