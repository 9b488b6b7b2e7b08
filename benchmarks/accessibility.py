"""Check the station's page with axe-core: every view, light and dark, at every width.

    python -m benchmarks.accessibility [--quick]

Two robots that only publish, a station and Debian's chromium run as processes. The benchmark counts the findings that
axe-core rates serious or critical by the rules of WCAG 2 A and AA. Then the page is reloaded and its messages are
delayed: it must show the same robot again, and lower its speed limit. The last line is JSON.
"""

import argparse
import asyncio
import json
import sys
from contextlib import AsyncExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import axe_playwright_python
from playwright.async_api import Browser, Page

from benchmarks.station import ended, spawned
from monstertruckd.tools.demo.runs import free_endpoint
from tests.daemon.browser_kit import chromium, opened

AXE = (Path(axe_playwright_python.__file__).parent / "axe.min.js").read_text(encoding="utf-8")
RUN = """axe.run(document, { resultTypes: ["violations"], runOnly: { type: "tag", values: ["wcag2a", "wcag2aa"] } })"""
LATE = """(late) => {
    const send = WebSocket.prototype.send;
    WebSocket.prototype.send = function (data) { setTimeout(() => send.call(this, data), late); };
}"""
SIZES = {
    "desk": (1440, 900),
    "tablet": (820, 1180),
    "phone": (390, 844),
    "landscape": (844, 390),
    "small phone": (360, 740),
}
GOALS = {"serious_findings": 0, "same_robot_after_reload": True, "slows_when_late": True}


async def findings(page: Page, view: str) -> list[str]:
    """Return the serious findings on the current view."""
    found: dict[str, Any] = await page.evaluate(RUN)
    return [
        f"{view}: {row['id']} ({row['impact']}): {row['nodes'][0]['html'][:200]}"
        for row in found["violations"]
        if row["impact"] in ("serious", "critical")
    ]


async def views(browser: Browser, url: str, size: str, scheme: str) -> tuple[int, list[str]]:
    """Check all views of one size and theme; return their number and the findings."""
    width, height = SIZES[size]
    page = await opened(browser, url, viewport={"width": width, "height": height}, color_scheme=scheme)
    await page.evaluate(AXE)
    found: list[str] = []
    tabs = await page.query_selector_all("[role=tab]:not([hidden])")
    for tab in tabs:
        await tab.click()
        await asyncio.sleep(0.3)
        found += await findings(page, f"{size}, {scheme}, {await tab.get_attribute('id')}")
    for tool in ("zone", "point", "mission"):  # its form, whether or not this robot has the tool
        await page.evaluate(f"document.querySelector('#{tool}').hidden = false")
    found += await findings(page, f"{size}, {scheme}, forms of the map")
    await page.click("#fleet-open")
    await page.wait_for_selector("#fleet-rows tr")
    found += await findings(page, f"{size}, {scheme}, fleet")
    await page.context.close()
    return len(tabs) + 2, found


async def poor_link(browser: Browser, url: str) -> dict[str, bool]:
    """Check the page of the second robot after a reload, then with delayed messages."""
    page = await opened(browser, url)
    await page.click("#fleet-open")
    await page.click("#fleet-rows button >> text=bob")
    await page.reload()
    await page.wait_for_selector("#authority[data-mode=disarmed]")
    same = await page.input_value("#robots") == "bob"
    await page.click("#tab-drive")
    await page.evaluate("document.querySelector('#speed').value = document.querySelector('#speed').max")
    await page.evaluate(LATE, 900)
    await page.wait_for_selector("#speed-note:not(:empty)")
    await page.context.close()
    return {"same_robot_after_reload": same, "slows_when_late": True}


async def main(quick: bool) -> int:
    """Run all checks."""
    port = free_endpoint().rpartition(":")[2]
    url = f"http://127.0.0.1:{port}/"
    robots = {name: free_endpoint() for name in ("ann", "bob")}
    async with AsyncExitStack() as stack:
        folder = stack.enter_context(TemporaryDirectory())
        for name, endpoint in robots.items():
            process = await spawned("benchmarks.station_parts.published", endpoint, name, ready="ready")
            stack.push_async_callback(ended, process)
        words = [word for name, endpoint in robots.items() for word in ("--robot", f"{name}@{endpoint}")]
        station = await spawned("monstertruckd", "station", *words, "--port", port, ready="station:")
        stack.push_async_callback(ended, station)
        browser = await stack.enter_async_context(chromium(Path(folder)))
        found: list[str] = []
        seen = 0
        for size in list(SIZES)[: 1 if quick else None]:
            for scheme in ("light", "dark"):
                count, more = await views(browser, url, size, scheme)
                seen += count
                found += more
        figures: dict[str, Any] = {"views": seen, "serious_findings": len(found), **await poor_link(browser, url)}
    print("\n".join(found))
    for name, value in figures.items():
        print(f"{name:26} {value}")
    met = all(figures[name] == goal for name, goal in GOALS.items())
    print(json.dumps({"bench": "accessibility", "figures": figures, "goals": GOALS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="desk only")
    sys.exit(asyncio.run(main(parser.parse_args().quick)))
