"""Draws the pictures of the station's page from an emulated truck that explores rooms with tags on their walls.

    python -m docs.pictures.station [--all FOLDER]

One ``monstertruckd try`` runs behind the page, and Debian's chromium takes the pictures that the documentation shows,
each with 64 colours. With ``--all``, every view at every size, light and dark, goes to a folder, to be looked at.
``station.sha256`` keeps the hash of the page's files that they show; a test compares it.
"""

import argparse
import asyncio
import hashlib
import io
import re
import sys
import tempfile
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.async_api import Browser, Page

from monstertruck_runtime.yaml_files import yaml_text
from tests.daemon.browser_kit import chromium, new_tab
from tests.daemon.wall_kit import ROOT, end

HERE = Path(__file__).parent
HASH = HERE / "station.sha256"
SIZES = {"desk": (1440, 900), "tablet": (820, 1180), "phone": (390, 844), "landscape": (844, 390)}
THEMES = ("light", "dark")
EXPLORED = "html[data-ready=true] #map[data-drawn=true]"
TAGS = [(0, 3.0, 4.695, -1.5708), (1, 8.0, 3.205, 1.5708), (2, 0.305, 2.2, 0.0), (3, 9.695, 2.2, 3.1416)]
ROBOT: dict[str, Any] = {
    "include": [str(ROOT / "configs" / "full.yaml")],
    "version": 2,
    "path": None,
    "points": {"size": 0.1},
    "odometry": {"start": {"x": 1.0, "y": 3.95, "yaw": 0.0}},
    "sim": {
        "world": {
            "map": "rooms",
            "tags": [{"tag": tag, "x": x, "y": y, "z": 0.25, "yaw": yaw} for tag, x, y, yaw in TAGS],
        }
    },
}
"""The truck with all its devices, in rooms that it does not know."""


def page_hash() -> str:
    """SHA-256 of the page's files with their names."""
    digest = hashlib.sha256()
    page = ROOT / "monstertruckd" / "station" / "page"
    for file in sorted(path for path in page.rglob("*") if path.is_file()):
        digest.update(file.relative_to(page).as_posix().encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


async def show_tab(page: Page, tab: str) -> None:
    """Choose a tab."""
    await page.evaluate(f"document.querySelector('#tab-{tab}').click()")


def tab(name: str) -> Callable[[Page], Awaitable[None]]:
    """A view that is one tab."""

    async def show(page: Page) -> None:
        await show_tab(page, name)
        await asyncio.sleep(1.0 if name in ("recordings", "settings") else 0.4)  # they ask the robot

    return show


async def plots(page: Page) -> None:
    """Speed and turn rate in one plot, the voltage in another."""
    await show_tab(page, "plots")
    await page.wait_for_function("document.querySelectorAll('#plot-names option').length > 0")
    for name in ("state/odometry:twist.vx", "state/odometry:twist.wz", "sensor/battery:voltage"):
        if await page.locator("#plots .plot").count() < (2 if "battery" in name else 1):
            await page.select_option("#plot-into", "")
        elif "wz" in name:
            await page.select_option("#plot-into", "0")
        await page.fill("#plot-name", name)
        await page.click("#plot-add")
    await asyncio.sleep(6.0)


async def draw(page: Page) -> None:
    """A path drawn from the middle of the map."""
    await page.click("#tool-draw")
    box = await page.locator("#map").bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    await page.mouse.move(x, y)
    await page.mouse.down()
    for dx, dy in ((60, 0), (90, -10), (120, -30)):
        await page.mouse.move(x + dx, y + dy, steps=5)
    await page.mouse.up()


async def zone(page: Page) -> None:
    """A zone with three corners."""
    await page.click("#goal-drop")
    await page.click("#tool-zone")
    box = await page.locator("#map").bounding_box()
    assert box is not None
    for x, y in ((0.45, 0.3), (0.7, 0.3), (0.7, 0.5)):
        await page.click("#map", position={"x": x * box["width"], "y": y * box["height"]})


async def fleet(page: Page) -> None:
    """All robots."""
    await page.click("#zone-drop")
    await page.click("#fleet-open")
    await page.wait_for_selector("#fleet-rows tr")


async def replay(page: Page) -> None:
    """A recording, near its end."""
    await page.click("#fleet-open")
    await show_tab(page, "recordings")
    await page.locator("#recordings button").first.click()
    await page.wait_for_selector("#replay:not([hidden])", timeout=60_000)
    await page.evaluate(
        "const bar = document.querySelector('#replay-at'); bar.value = 0.9 * bar.max;"
        "bar.dispatchEvent(new Event('change'))"
    )
    await show_tab(page, "truck")
    await asyncio.sleep(1.5)


VIEWS: dict[str, Callable[[Page], Awaitable[None]]] = {
    **{name: tab(name) for name in ("drive", "tasks", "truck", "system", "events", "settings", "recordings", "tryout")},
    "plots": plots,
    "path": draw,
    "zone": zone,
    "fleet": fleet,
    "replay": replay,
}
"""Every view, in an order in which each begins where the one before ends."""
SHOWN = {
    ("desk", "light"): ("drive", "path", "tryout", "replay"),
    ("desk", "dark"): ("plots", "system"),
    ("tablet", "light"): ("settings",),
    ("phone", "light"): ("drive",),
    ("phone", "dark"): ("recordings",),
    ("landscape", "dark"): ("drive",),
}
"""Views that the documentation shows."""


async def main(folder: Path | None) -> None:
    """Take the pictures."""
    with tempfile.TemporaryDirectory() as name:
        made = Path(name)
        (made / "truck.yaml").write_text(yaml_text(ROBOT), encoding="utf-8")
        said = made / "said.txt"
        with said.open("wb") as output:
            words = ("try", str(made / "truck.yaml"), "--no-browser", "--output", str(made / "try"))
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "monstertruckd", *words, stdout=output, stderr=output
            )
        try:
            while (found := re.search(r"http://127[0-9.:]+/", said.read_text())) is None:
                assert process.returncode is None, said.read_text()
                await asyncio.sleep(0.1)
            async with chromium(made) as browser:
                await explore(browser, found[0])
                for size in SIZES:
                    for theme in THEMES:
                        await views(browser, found[0], size, theme, folder)
        finally:
            await end(process)
    if folder is None:
        HASH.write_text(f"{page_hash()}\n", encoding="utf-8")


async def explore(browser: Browser, url: str) -> None:
    """Have the robot explore, and a place and a zone kept."""
    page = await new_tab(browser)
    page.set_default_timeout(120_000)
    await page.goto(url)
    await page.wait_for_selector(EXPLORED)
    await show_tab(page, "tasks")
    await page.click("#explore-start")
    await page.wait_for_selector("#authority[data-mode=driving]")
    await asyncio.sleep(20.0)  # it has driven a while
    await page.context.close()


async def views(browser: Browser, url: str, size: str, theme: str, folder: Path | None) -> None:
    """The views of one size and theme: those of the documentation, or all, to a folder."""
    wanted = VIEWS if folder else SHOWN.get((size, theme), ())
    if not wanted:
        return
    width, height = SIZES[size]
    touch = size in ("phone", "landscape")
    view = {"width": width, "height": height}
    page = await new_tab(browser, viewport=view, color_scheme=theme, has_touch=touch, is_mobile=touch)
    page.set_default_timeout(60_000)
    await page.goto(url)
    await page.wait_for_selector(EXPLORED)
    await asyncio.sleep(1.0)
    for name, show in VIEWS.items():
        if name not in wanted and name not in BEFORE:
            continue
        await page.evaluate("document.querySelectorAll('#banners button').forEach((button) => button.click())")
        await show(page)
        if name in wanted:
            await save(page, (folder or HERE) / f"station-{size}-{theme}-{name}.png")
    await page.context.close()


BEFORE = ("path", "zone", "fleet")
"""Views that others begin with."""


async def save(page: Page, file: Path) -> None:
    """Save a picture with 64 colours: a third of the bytes, and no difference to the eye."""
    picture = Image.open(io.BytesIO(await page.screenshot())).convert("RGB")
    picture.quantize(64, dither=Image.Dither.NONE).save(file, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    if options.all is not None:
        options.all.mkdir(parents=True, exist_ok=True)
    asyncio.run(main(options.all))
