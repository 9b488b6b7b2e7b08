"""``monstertruckd try`` as a person meets it: one command, and the page maps, fails and is driven by clicks."""

from pathlib import Path

import pytest
from playwright.async_api import expect

from tests.daemon.browser_kit import NEEDS_CHROMIUM, PATIENCE, chromium, opened
from tests.daemon.page_tasks import TASKS, timed, tried

pytestmark = [pytest.mark.wall, pytest.mark.timeout(240), NEEDS_CHROMIUM]


async def test_one_command_shows_map_faults_and_obstacles_and_ends_by_a_signal(tmp_path: Path):
    async with tried(tmp_path) as url, chromium(tmp_path) as browser:
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
    assert list((tmp_path / "try" / "logs").glob("*.mcap"))


@pytest.mark.parametrize("size", [(1440, 900), (390, 844)])
async def test_somebody_new_carries_out_six_tasks_with_the_page_alone(tmp_path: Path, size: tuple[int, int]):
    async with tried(tmp_path) as url, chromium(tmp_path) as browser:
        page = await opened(browser, url, viewport={"width": size[0], "height": size[1]})
        await page.wait_for_selector("#map[data-drawn=true]", timeout=4 * PATIENCE)
        for name, task in TASKS.items():
            assert await timed(page, task) <= 60, name
