"""Takes the pictures of the station's page, from a short recorded drive and the messages that a whole robot adds to it.

    python -m docs.pictures.station [--all FOLDER]

A station in this process plays ``tests/data/replay/goals.mcap`` as a robot, ten times slower; Debian's chromium takes
the pictures that the documentation shows, each with 160 colours. What that drive lacks (camera, points, zones, USB,
recordings, settings, faults), the browser hears from ``ADDED`` and ``answers`` below. With ``--all``, every view at
every size, light and dark, goes to a folder, to be looked at. ``station.sha256`` keeps the hash of the page's files
that the pictures show; a test compares it.
"""

import argparse
import asyncio
import base64
import io
import json
import math
import tempfile
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.async_api import Browser, Page

from docs.pictures.station_hash import HASH, page_hash
from monstertruck_runtime.clock import SECOND, WallClock
from monstertruck_schemas.base import live_settings
from monstertruckd.recorder.reader import open_log
from monstertruckd.station.address import RobotAddress
from monstertruckd.station.replay import ReplayFeed
from monstertruckd.station.server import Place, Station
from monstertruckd.tools.demo.runs import free_endpoint
from monstertruckd.tools.simulation.config import load_simulated
from tests.daemon.browser_kit import chromium, new_tab

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
LOG = ROOT / "tests" / "data" / "replay" / "goals.mcap"
SIZES = {"desk": (1440, 900), "tablet": (820, 1180), "phone": (390, 844), "landscape": (844, 390)}
THEMES = ("light", "dark")
NAME = "truck"
SLOW = 0.03
"""Playback rate of the drive; no value becomes stale."""
View = Callable[[Page, ReplayFeed], Awaitable[None]]


POINTS = [("tag-3", "tag", 1.6, -1.2, 3.14), ("door", "mark", 1.0, -1.4, 0.0), ("bench", "mark", 0.6, -2.0, 1.57)]
USB = [("1-1", None, "hub", None), ("1-1.1", "1-1", "drive", "ttyUSB0"), ("1-1.2", "1-1", "steering", "ttyACM0")]
ADDED: list[dict[str, Any]] = [
    {
        "kind": "points",
        "m": {"points": [{"name": n, "kind": k, "x": x, "y": y, "yaw": a} for n, k, x, y, a in POINTS]},
    },
    {
        "kind": "zones",
        "m": {
            "inside": [],
            "zones": [
                {
                    "name": "stairs",
                    "kind": "keepout",
                    "inside": "stop",
                    "limit": None,
                    "mask": None,
                    "saved": True,
                    "off_until": None,
                    "corners": [[1.2, -1.9], [1.7, -1.9], [1.7, -1.6], [1.2, -1.6]],
                }
            ],
        },
    },
    {
        "kind": "usb",
        "m": {
            "nodes": [
                {
                    "name": name,
                    "parent": parent,
                    "role": None if role == "hub" else role,
                    "title": "USB hub",
                    "tty": tty,
                    "usb_id": "0403:6001",
                    "replugs": int(role == "steering"),
                    "state": "present",
                    "hub": role == "hub",
                }
                for name, parent, role, tty in USB
            ]
        },
    },
    {
        "kind": "host",
        "m": {"cpu": 0.31, "temperature": 52.0, "throttled": False, "memory_available": 5.1e9, "disk_free": 21e9},
    },
    {"kind": "network", "m": {"medium": "wifi", "level": "good", "signal": -58.0}},
    {
        "kind": "emulated",
        "faults": {"compass": "none", "drive": "none", "lidar": "none", "steering": "deaf"},
        "obstacles": [[1, 2]],
    },
]
"""Messages that the drive lacks, as the station sends them."""
DAY = 86_400.0


def answers() -> dict[str, Any]:
    """Values of the robot's answers, by the command that asks."""
    config = load_simulated(ROOT / "configs" / "goals.yaml")
    settings = [asdict(setting) | {"began": setting.value} for setting in live_settings(config)]
    now = (WallClock().now() + WallClock().real_offset()) / SECOND
    runs = [("run-000042-000.mcap", 8.2e6, 0.0, "run", True), ("run-000041-001.mcap", 31.5e6, 0.1, "run", False)]
    boxes = [("blackbox-000007-scan_stale.mcap", 1.9e6, 0.2, "blackbox", False)]
    recordings = [
        {"name": name, "bytes": size, "modified": now - days * DAY, "kind": kind, "open": is_open}
        for name, size, days, kind, is_open in (*runs, *boxes)
    ]
    wizards = [
        {"id": "drive.inverted", "name": "drive", "rough": True, "doc": "Which way is forward.", "due": True},
        {
            "id": "battery.gain",
            "name": "battery",
            "rough": False,
            "doc": "Scale of the measured voltage.",
            "due": False,
        },
    ]
    return {
        "settings": {"settings": settings},
        "recordings": {"recordings": recordings},
        "calibrate": {"wizards": wizards},
        "acknowledge": {},
    }


HEARS = """
(([added, answers, picture]) => {
  const Real = window.WebSocket;
  window.WebSocket = class extends Real {
    constructor(...given) {
      super(...given);
      window.heard = (message) => this.onmessage({ data: JSON.stringify(message) });
      const bytes = Uint8Array.from(atob(picture), (each) => each.charCodeAt(0));
      const head = new TextEncoder().encode(JSON.stringify({ kind: "camera", sequence: 1, stamp: 1e9 }));
      const frame = new Uint8Array(4 + head.length + bytes.length);
      new DataView(frame.buffer).setUint32(0, head.length, true);
      frame.set(head, 4);
      frame.set(bytes, 4 + head.length);
      setInterval(() => {
        if (this.readyState !== Real.OPEN || window.quiet) return;
        for (const message of added) window.heard(message);
        this.onmessage({ data: frame.buffer });
      }, 500);
    }
    send(text) {
      const { do: what, id, at } = JSON.parse(text);
      if (what === "ping") return setTimeout(() => window.heard({ kind: "pong", at, now: at }), 4);
      if (!(what in answers)) return super.send(text);
      setTimeout(() => window.heard({ kind: "answer", id, ok: true, value: answers[what] }), 0);
    }
  };
})
"""


def play_slowly(feed: ReplayFeed, at: float | None) -> None:
    """Continue playing, from a time (s), so slowly that the drive lasts until all pictures are taken."""
    feed.control(at, playing=True, rate=None)
    feed._rate = SLOW  # noqa: SLF001 - slower than a person is let play it


async def show_tab(page: Page, tab: str) -> None:
    """Choose a tab."""
    await page.evaluate(f"document.querySelector('#tab-{tab}').click(); window.scrollTo(0, 1e6)")


def tab(name: str) -> View:
    """A view that is one tab."""

    async def show(page: Page, _: ReplayFeed) -> None:
        await show_tab(page, name)
        if name == "drive":
            await page.evaluate("window.scrollTo(0, 0)")
        await asyncio.sleep(0.3)

    return show


async def plots(page: Page, feed: ReplayFeed) -> None:
    """Speed and turn rate in one plot, the voltage in another."""
    await show_tab(page, "plots")
    await page.wait_for_selector("#plot-names option", state="attached")
    for name, into in (("odometry:twist.vx", ""), ("odometry:twist.wz", "0"), ("battery:voltage", "")):
        group = "sensor" if name.startswith("battery") else "state"
        await page.select_option("#plot-into", into)
        await page.fill("#plot-name", f"{group}/{name}")
        await page.click("#plot-add")
    await page.select_option("#plot-window", "10")
    feed.control(0.5, playing=True, rate=1.0)
    await asyncio.sleep(4.0)
    play_slowly(feed, None)


async def wizard(page: Page, _: ReplayFeed) -> None:
    """A calibration that asks for a decision."""
    await show_tab(page, "system")
    await page.evaluate("document.querySelector('#wizards-list').click()")
    around, noise = np.linspace(0.0, math.tau, 97), np.random.default_rng(1).normal(0.0, 0.25, (97, 2))
    fit = np.column_stack((5.2 + 20.4 * np.cos(around), -3.1 + 18.2 * np.sin(around)))
    axes = {"name": "magnetic field on the circle", "x": "field ahead (uT)", "y": "field to the left (uT)"}
    said = ["compass: the robot's own magnetism, from a driven circle", "moving: a circle to the left"]
    said += ["moving: the same circle back", "computing: ellipse"]
    hard = {"unit": "uT", "meaning": "hard iron", "grade": "A"}
    before = {"value": 4.8, "low": 4.4, "high": 5.2}
    rows = [
        hard | {"name": "hard_x", "value": 5.2, "low": 4.9, "high": 5.5, "before": before},
        hard | {"name": "hard_y", "value": -3.1, "low": -3.4, "high": -2.8, "before": None},
    ]  # fmt: skip
    state = {"kind": "calibrating", "step": "compass.hard_x", "phase": "measured", "said": said, "text": ""}
    state |= {"progress": None, "question": None}
    state |= {"plot": axes | {"points": (fit + noise).tolist(), "curve": fit.tolist()}}
    state |= {"measured": {"rows": rows, "text": "97 readings on a circle driven forward and back"}}
    await page.evaluate("(state) => window.heard(state)", state)
    await page.evaluate("document.querySelector('#wizard').scrollIntoView({ block: 'center' })")


async def at(page: Page, across: float, down: float) -> tuple[float, float]:
    """A place of the map by its shares of width and height."""
    box = await page.locator("#map").bounding_box()
    assert box is not None
    return box["x"] + across * box["width"], box["y"] + down * box["height"]


async def draw(page: Page, _: ReplayFeed) -> None:
    """A path drawn from the middle of the map."""
    await page.evaluate("window.scrollTo(0, 0)")
    await page.click("#tool-draw")
    x, y = await at(page, 0.5, 0.45)
    await page.mouse.move(x, y)
    await page.mouse.down()
    for dx, dy in ((60, 0), (90, -10), (120, -30)):
        await page.mouse.move(x + dx, y + dy, steps=5)
    await page.mouse.up()


async def zone(page: Page, _: ReplayFeed) -> None:
    """A zone with three corners."""
    await page.click("#goal-drop")
    await page.click("#tool-zone")
    for across, down in ((0.45, 0.15), (0.7, 0.15), (0.7, 0.35)):
        await page.mouse.click(*await at(page, across, down))


async def mission(page: Page, _: ReplayFeed) -> None:
    """A mission of three waypoints."""
    await page.click("#tool-mission")
    for across, down in ((0.45, 0.2), (0.65, 0.2), (0.8, 0.35)):
        await page.mouse.click(*await at(page, across, down))


async def point(page: Page, _: ReplayFeed) -> None:
    """A place that is being marked."""
    await page.click("#mission-drop")
    await page.click("#tool-point")
    x, y = await at(page, 0.7, 0.3)
    await page.mouse.move(x, y)
    await page.mouse.down()
    await page.mouse.move(x, y - 40, steps=3)
    await page.mouse.up()


async def fleet(page: Page, _: ReplayFeed) -> None:
    """Three robots."""
    await page.click("#tool-point")
    rows = [
        ("ann", 3.0, 2.0, "driving", 25.1, "normal"),
        ("bob", 7.0, 5.5, "disarmed", 22.2, "low"),
        (NAME, 5.0, 3.0, "armed", 24.6, "normal"),
    ]
    robots = [
        {
            "name": name,
            "pose": [x, y, x],
            "mode": mode,
            "voltage": voltage,
            "level": level,
            "speed": 0.1,
            "old": False,
            "alive": True,
            "round_trip": 0.012,
            "stopping": False,
            "holder": "track" if mode == "driving" else None,
            "reasons": [],
        }
        for name, x, y, mode, voltage, level in rows
    ]
    await page.evaluate("window.quiet = true")
    await page.click("#fleet-open")
    await page.evaluate("(robots) => setInterval(() => window.heard({ kind: 'fleet', robots }), 50)", robots)
    await page.wait_for_selector("#fleet-rows tr")


VIEWS: dict[str, View] = {
    **{name: tab(name) for name in ("drive", "tasks", "truck", "system", "events", "settings", "recordings", "tryout")},
    "wizard": wizard,
    "plots": plots,
    "path": draw,
    "zone": zone,
    "mission": mission,
    "point": point,
    "fleet": fleet,
}
"""Every view, ordered so that each begins where the one before ends."""
STEPS = ("path", "zone", "mission", "point", "fleet")
"""Views that each begin where the one before ends."""
SHOWN: dict[tuple[str, str], tuple[str, ...]] = {
    ("desk", "light"): ("drive", "wizard", "mission", "tryout", "fleet"),
    ("desk", "dark"): ("plots",),
    ("tablet", "light"): ("settings",),
    ("phone", "light"): ("drive",),
    ("phone", "dark"): ("recordings",),
    ("landscape", "dark"): ("drive",),
}
"""Views that the documentation shows."""


async def main(folder: Path | None) -> None:
    """Take the pictures."""
    clock = WallClock()
    place = Place(port=int(free_endpoint().rpartition(":")[2]))
    station = Station([RobotAddress("ann", free_endpoint())], clock, place, open_log=open_log)
    feed = ReplayFeed(NAME, LOG, open_log, clock)
    feed.robot = "ann"
    station.replays[NAME] = feed
    station._follow(feed)  # noqa: SLF001 - it is a robot here
    ready = asyncio.Event()
    serves = asyncio.create_task(station.run(ready.set))
    try:
        await ready.wait()
        with tempfile.TemporaryDirectory() as name:
            async with chromium(Path(name)) as browser:
                for size in SIZES:
                    for theme in THEMES:
                        play_slowly(feed, 3.0)
                        await views(browser, place.url, feed, size, theme, folder)
    finally:
        serves.cancel()
        await asyncio.gather(serves, return_exceptions=True)
    if folder is None:
        HASH.write_text(f"{page_hash()}\n", encoding="utf-8")


async def views(browser: Browser, url: str, feed: ReplayFeed, size: str, theme: str, folder: Path | None) -> None:
    """Save the views of one size and theme to a folder: only the ones in the documentation, or all."""
    wanted = tuple(VIEWS) if folder else SHOWN.get((size, theme), ())
    if not wanted:
        return
    width, height = SIZES[size]
    touch = size in ("phone", "landscape")
    view = {"width": width, "height": height}
    page = await new_tab(browser, viewport=view, color_scheme=theme, has_touch=touch, is_mobile=touch)
    page.set_default_timeout(60_000)
    picture = base64.b64encode((HERE / "points-plane.png").read_bytes()).decode()
    await page.add_init_script(f"{HEARS}({json.dumps([ADDED, answers(), picture])})")
    await page.goto(f"{url}#{NAME}")
    await page.wait_for_selector("html[data-ready=true]")
    await page.wait_for_selector("#map[data-drawn=true]")
    for _ in range(3):
        await page.click("#tool-in")
    await asyncio.sleep(1.0)
    last = max((STEPS.index(name) for name in wanted if name in STEPS), default=-1)
    for name, show in VIEWS.items():
        if name not in wanted and name not in STEPS[:last]:
            continue
        await page.evaluate("document.querySelectorAll('#banners button').forEach((button) => button.click())")
        await show(page, feed)
        if name in wanted:
            await save(page, (folder or HERE) / f"station-{size}-{theme}-{name}.png")
    await page.context.close()


async def save(page: Page, file: Path) -> None:
    """Save a picture with 160 colours: half of the bytes, and no difference to the eye."""
    picture = Image.open(io.BytesIO(await page.screenshot())).convert("RGB")
    picture.quantize(160, dither=Image.Dither.NONE).save(file, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--all", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    if options.all is not None:
        options.all.mkdir(parents=True, exist_ok=True)
    asyncio.run(main(options.all))
