"""How smoothly the station's page is drawn, and whether its memory stays flat.

    python -m benchmarks.page [--plots 20] [--seconds 20] [--minutes 0]

A robot that only publishes (10 Hz scans, 2 Hz map, 50 Hz poses, pictures) and a station, each a process; Debian's
chromium shows plots of as many numbers with its processor slowed down four times, as a phone's. Counted are the frames
in which the page's own drawing was finished. ``--minutes`` goes on for as long, with messages eight times as fast, and
prints how much the page's heap grows behind the first quarter, after a collection of garbage. The last line is JSON.
"""

import argparse
import asyncio
import json
import os
import sys
from contextlib import AsyncExitStack
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from playwright.async_api import CDPSession, Page

from benchmarks.station import ended, spawned
from monstertruckd.station.plots import numbers
from monstertruckd.tools.demo.runs import free_endpoint
from tests.daemon.browser_kit import chromium, opened

SLOWER = 4
TIMES = 8
GOALS = {"frames_s": 60.0, "busy_share": 1.0, "growth_mb": 5.0}
TOPICS = ("sensor/battery", "sensor/compass", "state/pose", "state/odometry", "state/gate", "health/")
FRAMES = """
(seconds) => new Promise((done) => {
  const times = [];
  const frame = (now) => {
    times.push(now);
    if (now - times[0] < 1000 * seconds) requestAnimationFrame(frame);
    else done(times);
  };
  requestAnimationFrame(frame);
})
"""


async def published(endpoint: str, times: int) -> asyncio.subprocess.Process:
    """Start the robot that only publishes, with messages ``times`` as fast."""
    return await spawned("benchmarks.station_parts.published", endpoint, "truck", str(times), ready="ready")


async def smoothness(page: Page, session: CDPSession, seconds: float) -> dict[str, float]:
    """Frames a second, the 99 % gap between two (ms), and how much of the slower processor the page's thread needs.

    The share is of the thread's own time: other programs of the computer do not count.
    """
    before = await thread_seconds(session)
    await asyncio.sleep(seconds)
    share = SLOWER * (await thread_seconds(session) - before) / seconds
    await session.send("Emulation.setCPUThrottlingRate", {"rate": SLOWER})
    times: list[float] = await page.evaluate(FRAMES, seconds)
    await session.send("Emulation.setCPUThrottlingRate", {"rate": 1})
    gaps = [after - before for before, after in pairwise(times)]
    long = sorted(gaps)[round(0.99 * len(gaps)) - 1]
    rate = round(1000 * len(gaps) / (times[-1] - times[0]), 1)
    return {"frames_s": rate, "gap_p99_ms": round(long, 1), "busy_share": round(share, 2)}


async def thread_seconds(session: CDPSession) -> float:
    """Processor time of the page's thread (s)."""
    rows = (await session.send("Performance.getMetrics"))["metrics"]
    return next(float(row["value"]) for row in rows if row["name"] == "TaskDuration")


async def heap(session: CDPSession) -> float:
    """Bytes of the page's heap in use after a collection, MB."""
    await session.send("HeapProfiler.collectGarbage")
    metrics = {row["name"]: row["value"] for row in (await session.send("Performance.getMetrics"))["metrics"]}
    return round(metrics["JSHeapUsedSize"] / 1e6, 2)


async def main(plots: int, seconds: float, minutes: float) -> int:
    """Measure."""
    port = free_endpoint().rpartition(":")[2]
    endpoint, url = free_endpoint(), f"http://127.0.0.1:{port}/"
    pinned = [[name] for name in numbers() if name.startswith(TOPICS)][:plots]
    async with AsyncExitStack() as stack:
        folder = stack.enter_context(TemporaryDirectory())
        robot = await published(endpoint, 1)
        stack.push_async_callback(ended, robot)
        words = ("--robot", f"truck@{endpoint}", "--port", port)
        stack.push_async_callback(ended, await spawned("monstertruckd", "station", *words, ready="station:"))
        browser = await stack.enter_async_context(chromium(Path(folder)))
        state: Any = {
            "origins": [{"origin": url[:-1], "localStorage": [{"name": "plots", "value": json.dumps(pinned)}]}]
        }
        page = await opened(browser, url, viewport={"width": 390, "height": 844}, storage_state=state)
        session = await page.context.new_cdp_session(page)
        await session.send("Performance.enable", {"timeDomain": "threadTicks"})
        await page.click("#tab-plots")
        await page.locator(".plot canvas").nth(len(pinned) - 1).wait_for()
        await asyncio.sleep(3.0)
        figures: dict[str, Any] = {"load_average": round(os.getloadavg()[0], 1), "plots": len(pinned)}
        figures |= await smoothness(page, session, seconds)
        if minutes:
            await ended(robot)
            stack.push_async_callback(ended, await published(endpoint, TIMES))
            await asyncio.sleep(3.0)
            heaps = []
            for _ in range(20):
                await asyncio.sleep(3 * minutes)
                heaps.append(await heap(session))
            figures |= {"heap_mb": heaps[4::5], "growth_mb": round(max(heaps[5:]) - max(heaps[:5]), 2)}
    met = figures["frames_s"] >= GOALS["frames_s"] - 1 and figures.get("growth_mb", 0.0) <= GOALS["growth_mb"]
    print(json.dumps({"bench": "page", "figures": figures, "goals": GOALS, "met": met}))
    return 0 if met else 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plots", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--minutes", type=float, default=0.0)
    options = parser.parse_args()
    sys.exit(asyncio.run(main(options.plots, options.seconds, options.minutes)))
