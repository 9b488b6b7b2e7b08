"""The page's scripts in a real browser; the station is played by the test, message by message."""

import asyncio
import json
import math
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from playwright.async_api import Page, expect
from typer.main import get_command

from monstertruck_runtime.map_files import load_map
from monstertruck_schemas.body import LensConfig
from monstertruck_schemas.event import Cause, Stop
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.station.pilot import read_mission
from monstertruckd.tools.cli.main import app
from tests.daemon.browser_kit import NEEDS_CHROMIUM, chromium
from tests.unit.station.test_server import serving

pytestmark = NEEDS_CHROMIUM

PLAYED = """
window.sent = [];
window.WebSocket = class {
  static OPEN = 1;
  readyState = 1;
  constructor() { window.socket = this; setTimeout(() => this.onopen(), 0); }
  send(text) {
    const message = JSON.parse(text);
    window.sent.push(message);
    const answer = { kind: "pong", at: message.at, now: 5000 + message.at };
    if (message.do === "ping" && window.answers) setTimeout(() => say(answer), 0);
  }
};
window.answers = true;
const now = performance.now.bind(performance);
window.passed = 0;
performance.now = () => now() + window.passed;
localStorage.guided ??= "yes";
window.say = (...messages) => messages.forEach((m) => window.socket.onmessage({ data: JSON.stringify(m) }));
"""
"""Instead of the browser's WebSocket: what the page sends is kept, what the station would say is said by the test.

Time passes at once where the test says so.
"""

FACTS = {
    "kind": "facts",
    "robot": "truck",
    "body": "truck",
    "gate": {"speed": 0.2, "reverse_speed": 0.15, "angle": 0.36, "tilt": {}, "leases": {}},
    "devices": [],
    "behaviours": [],
    "versions": {},
}


async def say(page: Page, *messages: dict[str, Any]) -> None:
    await page.evaluate("(messages) => say(...messages)", list(messages))


def gate_says(mode: GateMode, **fields: Any) -> dict[str, Any]:
    state = GateState(stamp=10**9, received=10**9, seq=1, mode=mode, nonce="n", speed_limit=0.0, **fields)
    return {"kind": "gate", "m": state.model_dump(mode="json")}


async def beats(page: Page, seconds: float = 0.12) -> list[dict[str, Any]]:
    """Heartbeats that the page sends from now on which ask for motion."""
    await page.evaluate("void (window.sent = [])")
    await asyncio.sleep(seconds)
    sent = json.loads(await page.evaluate("JSON.stringify(window.sent)"))
    return [each for each in sent if each["do"] == "drive" and each["speed"] != 0.0]


async def nothing_drives_once_the_hand_is_gone(page: Page) -> None:
    await page.keyboard.down("w")
    assert await beats(page)
    await page.keyboard.up("w")
    assert not await beats(page)

    key = "new KeyboardEvent('{}', {{ key: '{}', code: 'KeyW', bubbles: true, {} }})"
    for release in (
        key.format("keyup", "ł", ""),  # AltGr came in between
        "new KeyboardEvent('keydown', { key: 'Meta', code: 'MetaLeft', metaKey: true, bubbles: true })",
        "new MouseEvent('contextmenu', { bubbles: true })",
        "new FocusEvent('blur')",
    ):
        await page.evaluate(f"window.dispatchEvent({key.format('keydown', 'w', '')})")
        assert await beats(page), release
        await page.evaluate(f"window.dispatchEvent({release})")
        assert not await beats(page), release

    await page.keyboard.down("w")
    assert await beats(page)
    await page.focus("#steering")  # a list may swallow the release
    assert not await beats(page)
    await page.keyboard.up("w")

    box = await page.locator("#stick").bounding_box()
    assert box is not None
    await page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 10)
    await page.mouse.down()
    assert await beats(page)
    loose = "new PointerEvent('pointermove', { pointerId: 1, buttons: 0 })"
    await page.evaluate(f"document.querySelector('#stick').dispatchEvent({loose})")
    assert not await beats(page), "a mouse without a button pressed holds no stick"
    await page.mouse.up()


async def unseen_ground_is_confirmed_only_while_the_hand_says_so(page: Page) -> None:
    async def confirmed() -> set[bool]:
        sent = {beat["unseen"] for beat in await beats(page)}
        assert (await page.get_attribute("#unseen", "aria-pressed") == "true") is (True in sent)
        return sent

    await page.focus("#stick")
    await page.keyboard.down("v")
    assert not await beats(page), "this key alone moves nothing"
    await page.keyboard.down("s")
    assert await confirmed() == {True}
    await page.keyboard.up("v")
    assert await confirmed() == {False}
    key = "new KeyboardEvent('{}', {{ key: '{}', code: 'KeyV', bubbles: true }})"
    for release in (key.format("keyup", "√"), "new FocusEvent('blur')"):
        await page.evaluate(f"window.dispatchEvent({key.format('keydown', 'v')})")
        await page.keyboard.down("s")
        assert await confirmed() == {True}, release
        await page.evaluate(f"window.dispatchEvent({release})")
        await page.keyboard.down("s")
        assert await confirmed() == {False}, release
    await page.keyboard.up("s")

    await page.click("#unseen")
    await page.wait_for_selector("#unseen[aria-pressed=true]")  # it waits for the hand
    for expected in (True, False):  # the second hand has not said so
        await page.keyboard.down("s")
        assert await confirmed() == {expected}
        await page.keyboard.up("s")
        assert not await beats(page, 0.4)
    await page.click("#unseen")
    await page.click("#unseen")
    await page.keyboard.down("s")
    assert await confirmed() == {False}, "pressed twice"
    await page.keyboard.up("s")

    await say(page, gate_says(GateMode.DRIVING, holder="ann", reasons=(Reason.UNSEEN_DRIVE,)))
    await page.locator("#reasons", has_text="unseen ground").wait_for()


async def a_robot_that_has_yet_to_stand_is_shown_stopping_and_cannot_be_armed(page: Page) -> None:
    for mode, name in ((GateMode.DISARMED, "Disarmed"), (GateMode.ESTOPPED, "Emergency stop")):
        await say(page, gate_says(mode, stopping=True))
        await page.wait_for_selector(f"#mode-name:text-is('{name}, stopping')")
        await expect(page.locator("#chip-mode")).to_have_text(f"{name}, stopping")
        assert await page.is_disabled("#arm")
        await say(page, gate_says(mode))
        await page.wait_for_selector(f"#mode-name:text-is('{name}')")
        assert await page.is_disabled("#arm") is (mode is GateMode.ESTOPPED)


async def a_gamepad_drives_the_robot_of_the_page_that_has_the_focus(page: Page) -> None:
    await page.evaluate(
        """() => {
            const buttons = Array.from({ length: 17 }, (_, i) => ({ pressed: i === 5 }));
            const pad = { connected: true, mapping: "standard", id: "pad", axes: [0, -0.9], buttons };
            navigator.getGamepads = () => [pad];
        }"""
    )
    assert await beats(page)
    await page.evaluate("void (document.hasFocus = () => false)")
    assert not await beats(page)


async def an_unknown_way_is_taken_to_be_slow(page: Page) -> None:
    await page.fill("#speed", "0.2")
    await page.focus("#stick")
    await page.keyboard.down("w")
    beat = (await beats(page))[-1]
    assert beat["speed"] > 0.18
    assert beat["heard"] > 5000
    assert beat["since"] >= 0.0
    await page.evaluate("void (window.answers = false)")
    assert (await beats(page, 0.9))[-1]["speed"] < 0.16, "an answer that does not come is no quick one"
    await page.evaluate("void (window.answers = true)")
    assert max(beat["speed"] for beat in await beats(page, 0.8)) > 0.18
    await say(page, {"kind": "link", "alive": False, "round_trip": None, "text": "gone"})
    assert (await beats(page))[-1]["speed"] < 0.06, "what is not known is taken to be slow"
    # Another run of the robot, or another robot: what was said of this one is void.
    await say(page, {"kind": "goal", "m": {"number": 3, "phase": "driving", "remaining": 1.0, "goal": [1, 1, 0]}})
    assert await page.inner_text("#goal-text")
    await say(page, {"kind": "robot", "name": "truck"})
    await expect(page.locator("#goal")).to_be_hidden()


async def parts_of_the_map_outlive_the_whole_map_that_they_belong_to(page: Page) -> None:
    grid = {"width": 2, "height": 2, "resolution": 0.1, "origin": [0, 0, 0], "frame": "map"}
    await page.route("**/robots/truck/map/*", lambda route: route.fulfill(body=bytes([0, 0, 0, 0])))
    kept = await page.evaluate(
        """async (grid) => {
            const { MapView } = await import("/page/map.js");
            const link = { on() {}, newest: {}, robot: "truck" };
            const map = new MapView(document.querySelector("#map"), link, () => {});
            const tile = (version, x) => {
                map.takeTile({ ...grid, version, origin: [x, 0, 0], payload: new ArrayBuffer(4) });
            };
            tile(1, 1);
            tile(2, 2);
            await map.takeMap({ ...grid, version: 2 });
            tile(1, 3);
            tile(2, 4);
            return [...map.tiles.values()].map(({ origin }) => origin[0]);
        }""",
        grid,
    )
    assert kept == [2, 4]


async def the_map_is_saved_as_the_files_of_map_server(page: Page, folder: Path) -> None:
    cells = bytes([0, 100, 255, 50, 0, 100])
    await page.route("**/robots/truck/map/*", lambda route: route.fulfill(body=cells))
    grid = {"width": 3, "height": 2, "resolution": 0.5, "origin": [-1, 2, 0], "frame": "map"}
    await page.click("#tab-tasks")
    await expect(page.locator("#task-map")).to_be_hidden()
    await say(page, {"kind": "map", "version": 7, **grid})
    await page.wait_for_selector("#map[data-drawn=true]")
    for part in ("image", "text"):
        async with page.expect_download() as download:
            await page.click(f"#map-{part}")
        await (await download.value).save_as(folder / (await download.value).suggested_filename)
        await say(page, {"kind": "map", "version": 8, **grid, "origin": [-2, 2, 0]})  # it grows between the presses
        await page.wait_for_timeout(200)
    world = load_map(folder / "map.yaml")
    assert (world.resolution, world.origin) == (0.5, (-1.0, 2.0))
    assert world.cells.tolist() == [[0, 100, -1], [-1, 0, 100]]
    tiles = """async (grid) => {
        const { mapImage } = await import("/page/mapfile.js");
        const tile = { ...grid, width: 2, height: 2, origin: [0, 2.5, 0], cells: [100, 0, 0, 0] };
        return [...mapImage({ ...grid, cells: new Int8Array(6) }, [tile])].slice(-6);
    }"""
    assert await page.evaluate(tiles, grid) == [254, 254, 0, 254, 254, 254], "a tile is cut at the edge of its map"
    await page.click("#tab-drive")


async def a_zone_is_drawn_on_the_map_and_turned_off(page: Page) -> None:
    await expect(page.locator("#tool-zone"), "the robot keeps none").to_be_hidden()
    zone = {"name": "ramp", "kind": "speed", "corners": [[0, 0], [1, 0], [1, 1]], "mask": None, "limit": 0.1}
    zone |= {"inside": "stop", "saved": True, "off_until": None}
    await say(page, {"kind": "zones", "m": {"zones": [zone], "inside": ["ramp"]}})
    await page.click("#tab-tasks")
    await page.click("#zone-draw")
    for place in ([-1, 1], [0.5, 1], [0.5, -0.5]):
        assert await page.is_disabled("#zone-add")
        assert "corners left" in await page.inner_text("#zone-text")
        await page.mouse.click(*await page.evaluate(PLACE, place))
    await page.fill("#zone-name", "1st")
    assert await page.is_disabled("#zone-add")
    await expect(page.locator("#zone-text")).to_contain_text("a letter first")
    await page.fill("#zone-name", "My zone")
    assert await page.input_value("#zone-name") == "my-zone"
    await drag(page, await page.evaluate(PLACE, [0.5, -0.5]), await page.evaluate(PLACE, [0.5, -0.8]))
    await page.evaluate("void (window.sent = [])")
    await page.click("#zone-add")
    await expect(page.locator("#zones")).to_contain_text("ramp, speed limit 0.10 m/s, robot inside")
    await page.click("#zones button >> nth=0")
    sent = json.loads(await page.evaluate("JSON.stringify(window.sent)"))
    add, off = (each for each in sent if each["do"] == "zone")
    assert (add["name"], add["area"]["kind"], add["area"]["inside"]) == ("my-zone", "keepout", "stop")
    corners = [value for corner in add["area"]["corners"] for value in corner]
    assert corners == pytest.approx([-1, 1, 0.5, 1, 0.5, -0.8], abs=0.02), "a corner that is dragged is no new one"
    assert (off["order"], off["name"], off["seconds"]) == ("off", "ramp", 600)
    await page.click("#zone-drop")
    await page.click("#tool-zone")
    x, y = await page.evaluate(PLACE, [1, 0])
    await drag(page, (x, y), (x, y + 90))
    assert await page.input_value("#zone-name") == "ramp", "a zone that is there is edited"
    await page.evaluate("void (window.sent = [])")
    await page.click("#zone-add")
    (edited,) = await asked(page)
    assert (edited["name"], edited["area"]["kind"], edited["area"]["limit"]) == ("ramp", "speed", 0.1)
    assert edited["area"]["corners"][1] == pytest.approx([1, -1], abs=0.02)
    await answer(page, edited)
    await page.wait_for_selector("#zone", state="hidden")
    await page.click("#tab-drive")


async def places_are_marked_moved_renamed_driven_to_and_removed_on_the_map(page: Page) -> None:
    await expect(page.locator("#tool-point"), "the robot keeps none").to_be_hidden()
    point = {"name": "door", "kind": "mark", "x": 1.0, "y": 0.0, "yaw": 0.0}
    tag = {"name": "tag-3", "kind": "tag", "x": -1.0, "y": 0.0, "yaw": 0.0}
    await say(page, {"kind": "points", "m": {"points": [point, tag]}})
    await page.click("#tool-point")
    await page.evaluate("void (window.sent = [])")
    x, y = await page.evaluate(PLACE, [0, 1])
    await drag(page, (x, y), (x, y - 60))
    await page.fill("#point-name", "door")
    assert await page.is_disabled("#point-save"), "another point's name"
    await page.fill("#point-name", "bench")
    await page.click("#point-save")
    (marked,) = await asked(page)
    assert (marked["order"], marked["name"], marked["place"]) == ("mark", "bench", pytest.approx([0, 1], abs=0.02))
    assert marked["yaw"] == pytest.approx(math.pi / 2, abs=0.03), "dragged upwards"
    await answer(page, marked)
    await page.wait_for_selector("#point", state="hidden")

    x, y = await page.evaluate(PLACE, [1, 0])
    await drag(page, (x, y), (x + 90, y))
    await page.fill("#point-name", "gate")
    await page.click("#point-save")
    (moved,) = await asked(page)
    assert (moved["order"], moved["name"], moved["place"]) == ("mark", "gate", pytest.approx([2, 0], abs=0.02))
    await answer(page, moved)
    await page.wait_for_function("() => window.sent.length > 0")
    (gone,) = await asked(page)
    assert (gone["order"], gone["name"]) == ("remove", "door")
    await answer(page, gone)

    x, y = await page.evaluate(PLACE, [-1, 0])
    await page.mouse.click(x, y)
    assert await page.is_disabled("#point-name"), "a tag is where the camera sees it"
    await page.click("#point-go")
    (goal,) = await asked(page)
    assert goal["goal"] == pytest.approx([-0.3, 0, math.pi]), "it faces the tag"
    await answer(page, goal, ok=False, reason="busy", text="a mission runs")
    await page.click("#point-remove")
    (gone,) = await asked(page)
    assert gone["name"] == "tag-3"
    await answer(page, gone)
    await page.click("#tool-point")
    await page.click("#tab-tasks")
    assert await page.locator("#points li").count() == 2
    await page.click("#point-here")
    (here,) = await asked(page)
    assert here == {"do": "point", "order": "mark", "name": "place-1", "id": here["id"]}
    await answer(page, here)


async def a_mission_is_drawn_on_the_map_run_and_watched(page: Page) -> None:
    point = {"name": "door", "kind": "mark", "x": 1.0, "y": 0.0, "yaw": 0.0}
    await say(page, FACTS, {"kind": "points", "m": {"points": [point]}})
    await expect(page.locator("#tool-mission"), "the robot has no planner").to_be_hidden()
    await say(page, FACTS | {"goals": True})
    await page.click("#tab-tasks")
    await page.click("#mission-draw")
    await expect(page.locator("#mission-text")).to_contain_text("first waypoint")
    for place in ([0, 1], [1, 0], [0, -1], [-1, -1]):
        x, y = await page.evaluate(PLACE, place)
        await page.mouse.click(x, y)
    x, y = await page.evaluate(PLACE, [0, 1])
    await drag(page, (x, y), (x - 90, y))
    await page.locator("#mission-stops button").last.click()
    assert await page.locator("#mission-stops li").all_inner_texts() == [
        "-1.00, 1.00 m, 0°×",
        "door×",
        "0.00, -1.00 m, -135°×",
    ]
    await page.fill("#mission-name", "not/a/name")
    assert await page.is_disabled("#mission-run")
    await expect(page.locator("#mission-text")).to_contain_text("a letter first")
    await page.fill("#mission-name", "patrol")
    await page.fill("#mission-rounds", "3")
    await page.evaluate("void (window.sent = [])")
    async with page.expect_download() as download:
        await page.click("#mission-keep")
    assert (await download.value).suggested_filename == "patrol.yaml"
    await page.click("#mission-run")
    (order,) = await asked(page)
    mission = read_mission(order["text"])
    loop, home = mission.steps
    assert (mission.name, loop.do, loop.times, home.do) == ("patrol", "repeat", 3, "return")
    first, door, last = loop.steps
    assert (door.do, door.point) == ("goto_point", "door")
    assert (first.x, first.y, last.x, last.y) == pytest.approx((-1, 1, 0, -1), abs=0.02)
    await answer(page, order)
    await page.wait_for_selector("#mission", state="hidden")
    assert await page.evaluate(STOPS) == [1, 1, -1]
    await page.click("#tab-drive")
    ends = {"number": 1, "running": False, "outcome": "goal_blocked", "text": "step 1 of 3: in a keepout zone"}
    await say(page, {"kind": "mission", "m": ends | {"number": 0, "outcome": "ok"}}, {"kind": "mission", "m": ends})
    await expect(page.locator("#refusal")).to_have_text("Mission: step 1 of 3: in a keepout zone")
    await page.evaluate("void (document.querySelector('#refusal').textContent = '')")
    await say(page, {"kind": "mission", "m": ends}, {"kind": "mission", "m": ends | {"number": 2, "running": True}})
    await say(page, {"kind": "mission", "m": ends | {"number": 2, "outcome": "mission_done", "text": "done"}})
    assert await page.inner_text("#refusal") == ""
    await say(page, {"kind": "robot", "name": "truck"}, FACTS)


STOPS = """
async () => {
  const { stopOf } = await import("/page/mission.js");
  return ["1.2", "2", null].map((node) => stopOf({ running: true, node }, [1, 2, 3]));
}
"""
PLACE = """
([x, y]) => {
  const { left, top, width, height } = document.querySelector("#map").getBoundingClientRect();
  return [left + width / 2 + 90 * x, top + height / 2 - 90 * y];
}
"""
"""Where a place in map is on the screen, before the robot has a pose."""


async def drag(page: Page, start: tuple[float, float], end: tuple[float, float]) -> None:
    await page.mouse.move(*start)
    await page.mouse.down()
    await page.mouse.move(*end, steps=4)
    await page.mouse.up()


async def asked(page: Page) -> list[dict[str, Any]]:
    """What the page has asked since the last call."""
    return list(await page.evaluate("window.sent.splice(0).filter((each) => each.id !== undefined)"))


async def answer(page: Page, command: dict[str, Any], **outcome: Any) -> None:
    await say(page, {"kind": "answer", "id": command["id"], "ok": True, **outcome})


async def a_robot_without_a_map_is_called_so(page: Page) -> None:
    await expect(page.locator("#map-none")).to_be_hidden()
    await say(page, FACTS | {"mapping": False})
    await expect(page.locator("#map-none")).to_be_visible()
    await page.click("#tool-goal")
    await expect(page.locator("#map-none"), "the hint of a tool has its place").to_be_hidden()
    await page.click("#tool-goal")
    await say(page, FACTS | {"mapping": True})
    await expect(page.locator("#map-none")).to_be_hidden()


async def what_a_sensor_said_long_ago_is_not_shown_as_of_now(page: Page) -> None:
    battery = {"kind": "battery", "m": {"voltage": 24.8, "level": "normal"}}
    compass = {"kind": "compass", "m": {"roll": 0.0, "pitch": 0.0, "tilt_valid": True}}
    await say(page, battery, compass)
    await asyncio.sleep(0.2)
    await expect(page.locator("#chip-battery")).to_have_text("24.8 V")
    await page.evaluate("void (window.passed += 2900)")
    await say(page, compass)
    await page.wait_for_function("() => /^24.8 V, . s old$/.test(document.querySelector('#chip-battery').textContent)")
    assert "old" not in (await page.text_content("#tilt") or "")


async def a_stop_is_shown_with_its_chain_of_causes(page: Page) -> None:
    lost = Cause(reason=Reason.DEVICE_LOST, source="lidar", since=9 * 10**8, text="lidar: <b>unplugged</b>")
    stale = Cause(reason=Reason.SCAN_STALE, source="lidar", since=9 * 10**8, text="no fresh lidar scan", because=1)
    header = {"stamp": 10**9, "received": 10**9, "seq": 1, "number": 3}
    stop = Stop(**header, reason=stale.reason, mode=GateMode.STOPPING, causes=(stale, lost), text="")
    await say(page, {"kind": "stop", "m": json.loads(stop.model_dump_json())})
    shown = await page.text_content("#causes") or ""
    assert "no fresh lidar scan" in shown
    assert "lidar: <b>unplugged</b>" in shown, "as text, whatever a device says"


async def a_mission_of_a_robot_that_was_moved_goes_on_once_that_is_said(page: Page) -> None:
    async def press(button: str, **answer: Any) -> dict[str, Any]:
        await page.evaluate("void (window.sent = [])")
        await page.click(button)
        (asked,) = await page.evaluate("window.sent.filter((each) => each.do === 'mission')")
        await say(page, {"kind": "answer", "id": asked.pop("id"), **answer})
        return asked

    stopped = {"number": 0, "running": False, "resumable": True, "name": "round", "text": "interrupted at step 2"}
    await say(page, FACTS | {"goals": True}, {"kind": "mission", "m": stopped})
    await page.click("#tab-tasks")
    await expect(page.locator("#mission-state")).to_have_text("interrupted at step 2")
    await expect(page.locator("#mission-moved"), "unless the robot asks").to_be_hidden()
    refused = {"ok": False, "reason": "pose_lost", "text": "its pose is 3.0 m from where round was interrupted"}
    await say(page, {"kind": "slam", "m": {"standing": "searching", "overlap": 0.0}})
    await press("#mission-resume", **refused | {"text": "its pose on the saved map is unknown (searching)"})
    await expect(page.locator("#mission-moved"), "its pose is not right").to_be_hidden()
    await say(page, {"kind": "slam", "m": {"standing": "localised", "overlap": 0.9}})
    assert await press("#mission-resume", **refused) == {"do": "mission", "order": "resume"}
    await expect(page.locator("#refusal")).to_contain_text("3.0 m from where")
    assert await press("#mission-moved", ok=True) == {"do": "mission", "order": "resume", "moved": True}
    await expect(page.locator("#mission-moved")).to_be_hidden()
    lines = [
        {"number": "1", "depth": 0, "text": "repeat 3 times", "active": True},
        {"number": "1.1", "depth": 1, "text": "goto <b>1 2 0", "active": True},
        {"number": "2", "depth": 0, "text": "return", "active": False},
    ]
    running = {"number": 1, "running": True, "resumable": False, "lines": lines}
    await say(page, {"kind": "mission", "m": stopped | running})
    await expect(page.locator("#mission-resume")).to_be_hidden()
    await expect(page.locator("#mission-lines [aria-current]")).to_have_text("1.1 goto <b>1 2 0")
    assert await page.locator("#mission-lines li").count() == 3


async def a_task_arms_the_robot_and_lets_planners_drive_once_it_has_begun(page: Page) -> None:
    await say(page, FACTS | {"explores": True})
    await page.click("#tab-tasks")
    await page.evaluate("void (window.sent = [])")

    async def asked(**answer: Any) -> dict[str, Any]:
        pick = "window.sent.find((each) => each.id !== undefined)"
        await page.wait_for_function(f"() => {pick}")
        message = await page.evaluate(f"{{ const found = {pick}; window.sent = []; found }}")
        await say(page, {"kind": "answer", "id": message.pop("id"), **answer})
        return message

    begin, hold = {"do": "explore", "order": "start"}, {"do": "order", "order": "arm", "hold": True}
    await page.click("#explore-start")
    assert await asked(ok=False, reason="disarmed") == begin
    assert await asked(ok=True) == hold
    assert await asked(ok=True) == begin
    assert await asked(ok=True) == {"do": "order", "order": "arm"}
    await page.click("#explore-start")
    assert await asked(ok=False, reason="disarmed") == begin
    assert await asked(ok=True) == hold
    assert await asked(ok=False, reason="no_map", text="no map yet") == begin
    assert await asked(ok=True) == {"do": "order", "order": "disarm"}
    await expect(page.locator("#refusal")).to_contain_text("no map yet")
    await say(page, {"kind": "gate", "m": {"mode": "driving", "holder": "track", "reasons": [], "waiting": []}})
    await page.click("#explore-start")
    assert await asked(ok=True) == begin
    await asyncio.sleep(0.1)
    assert not await page.evaluate("window.sent.some((each) => each.id !== undefined)"), "armed by somebody else"


COLOUR = """
([x, y]) => {
  const map = document.querySelector("#map");
  const { left, top } = map.getBoundingClientRect();
  const ratio = window.devicePixelRatio;
  return [...map.getContext("2d").getImageData((x - left) * ratio, (y - top) * ratio, 1, 1).data].join();
}
"""
"""Colour of the map at a place on the screen."""


async def a_dock_is_drawn_on_the_map_and_driven_to_by_its_button(page: Page) -> None:
    docked = {"pose": [0.5, 0.5, 0.0], "direction": "reverse"}
    robot = FACTS | {"goals": True, "geometry": {"length": 0.4, "width": 0.3}}
    await page.click("#tab-tasks")
    idle = {"kind": "mission", "m": {"number": 0, "running": False, "resumable": False}}
    await say(page, robot | {"docks": {}}, idle)
    bar = await page.evaluate(PLACE, [0.28, 0.55])
    bare = await page.evaluate(COLOUR, bar)
    await say(page, robot | {"docks": {"charger": docked}})
    await page.wait_for_function(f"([place, bare]) => ({COLOUR})(place) !== bare", arg=[bar, bare])
    for button, step in (("Dock at charger", "dock"), ("Leave charger", "undock")):
        await page.evaluate("void (window.sent = [])")
        await page.click(f"#docks >> text={button}")
        await page.wait_for_function("() => window.sent.some((each) => each.do === 'mission')")
        (begun,) = await asked(page)
        assert json.loads(begun["text"])["steps"] == [{"do": step, "dock": "charger"}]
        await answer(page, begun)


async def the_configured_path_is_started_by_its_name(page: Page) -> None:
    await say(page, FACTS)
    await expect(page.locator("#path-start"), "this robot has none").to_be_hidden()
    await say(page, FACTS | {"path": "lap", "tracks": True})
    await expect(page.locator("#path-start")).to_have_text("Start lap")
    await page.evaluate("void (window.sent = [])")
    await page.click("#path-start")
    asked = await page.evaluate("window.sent.find((each) => each.id !== undefined)")
    assert {key: asked[key] for key in ("do", "path")} == {"do": "start_path", "path": "lap"}
    await say(page, {"kind": "answer", "id": asked["id"], "ok": True, "value": {"path": "lap-1"}})
    await page.evaluate("void (window.sent = [])")
    await page.check("#path-closed")
    await page.set_input_files("#path-file", {"name": "ring.csv", "mimeType": "text/csv", "buffer": b"0,0\n1,0\n"})
    pick = "window.sent.find((each) => each.id !== undefined)"
    while (asked := await page.evaluate(pick)) is None:
        await asyncio.sleep(0.02)
    assert asked == {"do": "track_file", "name": "ring.csv", "text": "0,0\n1,0\n", "closed": True, "id": asked["id"]}
    await say(page, {"kind": "answer", "id": asked["id"], "ok": True})


async def an_emulated_robot_fails_and_gets_obstacles_by_hand(page: Page) -> None:
    await say(page, {"kind": "emulated", "faults": {}})
    await expect(page.locator("#tab-tryout"), "this robot is real").to_be_hidden()
    await say(page, {"kind": "emulated", "faults": {"lidar": "none", "drive": "deaf"}, "obstacles": []})
    await page.click("#tab-tryout")
    assert await page.input_value("#fault-drive") == "deaf"
    assert await page.is_disabled("#obstacle-clear")
    await page.evaluate("void (window.sent = [])")
    await page.select_option("#fault-lidar", "unplugged")
    await page.click("#obstacle-add")
    await expect(page.locator("#tool-goal")).to_have_attribute("aria-pressed", "false")
    await page.click("#map", position={"x": 200, "y": 150})
    await expect(page.locator("#obstacle-add")).to_have_attribute("aria-pressed", "false")
    await expect(page.locator("#goal-go"), "this place is no goal").to_be_hidden()
    asked = [each for each in await page.evaluate("window.sent") if "id" in each]
    assert [(each["do"], each.get("fault")) for each in asked] == [("fault", "unplugged"), ("obstacle", None)]
    assert len(asked[1]["at"]) == 2
    await say(page, {"kind": "answer", "id": asked[0]["id"], "ok": False, "reason": "input", "text": "no such device"})
    await page.wait_for_function("() => document.querySelector('#fault-lidar').value === 'none'")
    await expect(page.locator("#refusal")).to_contain_text("no such device")
    await say(page, {"kind": "answer", "id": asked[1]["id"], "ok": True})
    await page.click("#tab-drive")


async def a_goal_says_what_the_gate_lets_it_do(page: Page) -> None:
    goal = {"number": 3, "phase": "driving", "remaining": 1.0, "goal": {"x": 1, "y": 0, "yaw": 0}, "text": ""}
    await say(page, {"kind": "goal", "m": goal}, gate_says(GateMode.DRIVING))
    await expect(page.locator("#goal-text")).to_have_text("Goal 3: driving, 1.0 m to go")
    await say(page, gate_says(GateMode.DISARMED))
    await expect(page.locator("#goal-text")).to_have_text("Goal 3: waiting, the robot is disarmed, 1.0 m to go")
    await say(page, {"kind": "goal", "m": goal | {"phase": "planning", "remaining": 0.0}}, gate_says(GateMode.DRIVING))
    await expect(page.locator("#goal-text")).to_have_text("Goal 3: planning")
    ended = goal | {"phase": "idle", "goal": None, "outcome": "estopped", "text": "emergency stop is latched"}
    await say(page, {"kind": "goal", "m": ended})
    await expect(page.locator("#goal-text")).to_have_text("Goal 3 was ended by an emergency stop")
    await say(page, {"kind": "goal", "m": goal | {"number": 0, "phase": "idle", "goal": None}})
    await page.click("#tool-goal")
    await page.mouse.click(*await page.evaluate(PLACE, [0.5, 0.5]))
    await expect(page.locator("#goal-go")).to_be_enabled()
    await say(page, gate_says(GateMode.ESTOPPED))
    await expect(page.locator("#goal-go")).to_be_disabled()
    await page.click("#goal-drop")
    await say(page, gate_says(GateMode.DRIVING))


async def armed_at_rest_is_called_armed(page: Page) -> None:
    await say(page, {"kind": "pilot", "source": "me"})
    twist = {"vx": 0.0, "vy": 0.0, "wz": 0.0}
    fields = {"holder": "me", "lease_left": 0.2}
    await say(page, gate_says(GateMode.DRIVING, twist=twist, **fields))
    await page.wait_for_selector("#authority[data-mode=driving]")
    await expect(page.locator("#mode-name")).to_have_text("Armed")
    await expect(page.locator("#holder-name")).to_have_text("You have control")
    await say(page, gate_says(GateMode.DRIVING, twist=twist | {"vx": 0.1}, **fields))
    await expect(page.locator("#mode-name")).to_have_text("Driving")
    await expect(page.locator("#holder-name")).to_have_text("You drive")


async def a_hand_on_a_disarmed_robot_hears_arm_first(page: Page) -> None:
    await say(page, gate_says(GateMode.DISARMED))
    await page.focus("#stick")
    await page.keyboard.down("w")
    await expect(page.locator("#hand-note")).to_have_text("Arm first: the robot is disarmed")
    await page.keyboard.up("w")
    await expect(page.locator("#hand-note")).to_have_text("")


async def space_and_a_gamepads_face_button_are_the_emergency_stop_and_escape_stops(page: Page) -> None:
    async def orders() -> list[str]:
        await asyncio.sleep(0.15)
        given = await page.evaluate("window.sent.filter((each) => each.do === 'order').map((each) => each.order)")
        await page.evaluate("void (window.sent = [])")
        return list(given)

    await orders()
    await page.keyboard.press("Space")
    assert await orders() == ["estop"]
    await page.keyboard.press("Escape")
    assert await orders() == ["stop"]
    pad = """(pressed) => {
        const buttons = Array.from({ length: 17 }, (_, i) => ({ pressed: pressed && i === 1 }));
        const pad = { connected: true, mapping: "standard", id: "synthetic", axes: [0, 0, 0, 0], buttons };
        navigator.getGamepads = () => [pad];
    }"""
    await page.evaluate("document.hasFocus = () => true")
    await page.evaluate(pad, True)
    assert await orders() == ["estop"], "once, however long it is held"
    await page.evaluate(pad, False)
    await page.evaluate("navigator.getGamepads = () => []")


async def the_link_that_failed_is_named_with_its_age(page: Page) -> None:
    await say(page, gate_says(GateMode.DISARMED), {"kind": "link", "alive": True, "round_trip": 8.9, "text": ""})
    await page.wait_for_function(
        "() => document.querySelector('#chip-link').textContent === 'Station to robot: 8900 ms'"
    )
    await say(page, {"kind": "link", "alive": True, "round_trip": 0.02, "text": ""})
    await page.evaluate("void (window.passed += 2000)")
    await page.wait_for_function(
        "() => /^Station to robot: silent for/.test(document.querySelector('#chip-link').textContent)"
    )
    text = "The station has received no data from truck for"
    await page.wait_for_function(f"() => document.querySelector('#banners').textContent.startsWith('{text}')")
    gone = "class { static OPEN = 1; constructor() { setTimeout(() => this.onclose(), 0); } send() {} }"
    await page.evaluate(f"void (window.WebSocket = {gone})")
    await page.evaluate("window.socket.onclose()")
    await page.evaluate("void (window.passed += 2500)")
    await page.wait_for_function(
        "() => /^Browser to station: lost for . s$/.test(document.querySelector('#chip-link').textContent)"
    )
    text = "This browser has lost the station for"
    await expect(page.locator("#banners")).to_contain_text(text)


async def why_the_robot_stands_is_in_the_panel_with_time_and_remedy(page: Page) -> None:
    cause = Cause(reason=Reason.SCAN_STALE, source="lidar", since=9 * 10**8, text="no fresh lidar scan")
    header = {"stamp": 0, "text": "", "received": 10**9, "seq": 1, "number": 4}
    stop = Stop(**header, reason=cause.reason, mode=GateMode.DISARMED, causes=(cause,))
    await say(page, gate_says(GateMode.DISARMED), {"kind": "stop", "m": json.loads(stop.model_dump_json())})
    expected = "1 s ago: no fresh lidar scan. Check the lidar's cable and supply"
    await expect(page.locator("#stopped")).to_contain_text(expected)
    for source, text in (("ann", "emergency stop by ann. Find out"), ("me.1", "you pressed emergency stop. Reset")):
        cause = Cause(reason=Reason.ESTOP_REQUESTED, source=source, since=10**9, text=f"emergency stop by {source}")
        stop = Stop(**header, reason=cause.reason, mode=GateMode.ESTOPPED, causes=(cause,))
        await say(page, {"kind": "pilot", "source": "me.1"}, {"kind": "stop", "m": json.loads(stop.model_dump_json())})
        await say(page, gate_says(GateMode.ESTOPPED))
        await expect(page.locator("#stopped")).to_contain_text(f"s ago: {text}")
    await say(page, gate_says(GateMode.DISARMED))
    await expect(page.locator("#stopped")).to_have_text(re.compile("s ago: you pressed emergency stop.$"))
    await say(page, gate_says(GateMode.DRIVING, twist={"vx": 0.1, "vy": 0.0, "wz": 0.0}))
    await page.wait_for_selector("#stopped", state="hidden")


async def events_have_times_are_counted_and_filtered(page: Page) -> None:
    event = {"severity": "warning", "source": "lidar", "reason": "scan_stale", "stamp": 10**9}
    await say(page, {"kind": "robot", "name": "truck"}, FACTS)
    await say(page, {"kind": "event", "m": event | {"text": "late by 3 ms"}})
    await say(page, gate_says(GateMode.DISARMED))
    for text in ("late by 4 ms", "late by 50 ms"):
        await say(page, {"kind": "event", "m": event | {"text": text}})
    await say(page, {"kind": "event", "m": event | {"text": "armed", "severity": "info"}})
    for text in ("late by 5 ms", "armed"):
        severity = "info" if text == "armed" else "warning"
        await say(page, {"kind": "event", "m": event | {"text": text, "severity": severity}})
    await page.click("#tab-events")
    rows = page.locator("#events > li")
    assert await rows.count() == 2, "alike are one row, whatever came between"
    newest, before = await rows.all_inner_texts()
    assert "2 times" in newest
    assert "late by 5 ms" in before
    assert re.search(r"4 times, \d\d:\d\d:\d\d.* to \d\d:\d\d:\d\d", before)
    assert await rows.last.locator("button").count() == 4, "each with its own moment"
    await rows.last.locator("summary").click()
    await page.evaluate("void (window.sent = [])")
    await rows.last.locator("button").first.click()
    (listing,) = await asked(page)
    files = [("run-2-0", 9e12, False), ("run-3-1", 2e12, True), ("run-3-0", 1.0, False)]
    recordings = [{"name": name, "modified": at, "kind": "run", "open": is_open} for name, at, is_open in files]
    await answer(page, listing, value={"recordings": recordings})
    await page.wait_for_function("() => window.sent.some((each) => each.do === 'replay')")
    (replay,) = await asked(page)
    assert (replay["name"], replay["stamp"]) == ("run-2-0", 10**9), "the first that ended later"
    await answer(page, replay, ok=False, reason="busy", text="somebody else downloads")
    await expect(page.locator("#refusal")).to_contain_text("somebody else downloads")
    await page.select_option("#events-least", "error")
    assert await page.locator("#events > li:visible").count() == 0
    await page.select_option("#events-least", "warning")
    assert await page.locator("#events > li:visible").count() == 1
    await page.click("#tab-drive")


async def settings_have_names_units_degrees_search_and_a_way_back(page: Page) -> None:
    angle = {
        "key": "gate.tilt.stop",
        "value": 0.35,
        "began": 0.35,
        "meaning": "Tilt that stops the robot, rad.",
        "above": 0.0,
        "at_least": None,
        "below": None,
        "at_most": 0.7,
    }
    speed = angle | {
        "key": "gate.speed",
        "value": 0.1,
        "began": 0.2,
        "meaning": "Of the fastest wheel, m/s.",
        "at_most": 1.0,
    }
    await page.evaluate("void (window.sent = [])")
    await page.click("#tab-settings")
    await page.wait_for_function("() => window.sent.some((each) => each.do === 'settings')")
    (asked,) = await page.evaluate("window.sent.filter((each) => each.do === 'settings')")
    await say(page, {"kind": "answer", "id": asked["id"], "ok": True, "value": {"settings": [angle, speed]}})
    row = page.locator(".setting").first
    text = await row.inner_text()
    assert "Tilt stop, °" in text
    assert "> 0 °, ≤ 40.11 °" in text
    assert await row.locator("input").input_value() == "20.0535"
    await page.evaluate("void (window.sent = [])")
    await row.locator("input").fill("30")
    await row.locator("input").press("Enter")
    (asked,) = await page.evaluate("window.sent.filter((each) => each.do === 'set')")
    assert asked["value"] == pytest.approx(0.5235988)
    await page.fill("#settings-find", "fastest wheel")
    assert await page.locator(".setting:visible").count() == 1
    await page.fill("#settings-find", "")
    await page.check("#settings-changed")
    assert "changed, 0.2 m/s at the start" in await page.locator(".setting:visible").inner_text()
    await page.evaluate("void (window.sent = [])")
    await page.locator(".setting:visible button").click()
    (asked,) = await page.evaluate("window.sent.filter((each) => each.do === 'set')")
    assert (asked["key"], asked["value"]) == ("gate.speed", 0.2)
    await page.uncheck("#settings-changed")
    await page.click("#tab-drive")


async def stick_and_map_are_in_view_together_on_a_phone_and_tabs_stay_in_one_line(page: Page) -> None:
    for width, height in ((390, 844), (844, 390)):
        await page.set_viewport_size({"width": width, "height": height})
        await page.click("#tab-drive")
        await page.evaluate("window.scrollTo(0, 0)")
        stop = await page.locator("#estop").bounding_box()
        assert stop is not None
        lowest = stop["y"] if stop["y"] > height / 2 else height  # on a phone held upright it is at the bottom
        for part in ("#map", "#stick"):
            box = await page.locator(part).bounding_box()
            assert box is not None
            assert box["height"] > 120, (part, width)
            assert box["y"] + box["height"] <= lowest + 1, (part, width)
        tops = "all => new Set(all.filter(tab => tab.offsetParent).map(tab => tab.getBoundingClientRect().top)).size"
        assert await page.locator("[role=tab]").evaluate_all(tops) == 1, "one line, all read at one moment"
        assert await page.evaluate("document.documentElement.scrollWidth") <= width
    await page.set_viewport_size({"width": 390, "height": 700})
    boxes = await page.evaluate("""() => {
        document.querySelector("#tab-truck").click();
        return ["#pane-truck", "#estop"].map((id) => document.querySelector(id).getBoundingClientRect());
    }""")
    assert boxes[0]["bottom"] <= boxes[1]["top"], "a press on a tab brings its pane into view"
    await page.set_viewport_size({"width": 1280, "height": 720})


SERIES = """
async () => {
  const { Past, Table, titleOf, unitIn } = await import("/page/series.js");
  const table = new Table();
  table.choose(["a", "b"]);
  for (let i = 0; i < 8000; i++) table.add(i / 10, [i, i % 2 ? null : -i]);
  const kept = [table.times.length, table.times[0]];
  const [times, a, b] = table.between(799.5, 799.8, ["a", "b"], [1, 2]);
  const last = [table.value("b", 799.5), table.value("b", 799.65), table.value("a", -1)];
  table.choose(["b", "c"]);
  const added = [table.columns.get("c").length === table.times.length, table.value("b", 799.8)];
  table.add(800.5, [5, 6]);
  table.add(800.5, [7, 8]);
  const twice = table.value("c", 801);
  table.add(3, [1, 1]);
  const past = new Past(1);
  for (const at of [0, 0.5, 1, 2, 700]) past.add(at, `row ${at}`);
  const again = new Past(1);
  for (const at of [10, 3]) again.add(at, at);
  return {
    kept, times, a, b, last, added, twice, anew: table.times,
    past: past.rows.map(([at]) => at), at: past.at(700.3), again: again.rows.length,
    units: ["Speed, m/s", "Filtered pack voltage, V; None at fault.", "Yaw rate (rad/s).", "How many"].map(
      (text) => unitIn(text).name,
    ),
    title: titleOf("state/pose:pose.x"),
  };
}
"""


async def values_over_time_are_kept_for_ten_minutes_and_found_by_their_time(page: Page) -> None:
    found = await page.evaluate(SERIES)
    count, first = found["kept"]
    assert 6000 <= count <= 6700
    assert first >= 799.9 - 670
    assert found["times"] == [799.5, 799.6, 799.7, 799.8]
    assert found["a"] == [7995, 7996, 7997, 7998]
    assert found["b"] == [None, -15992, None, -15996], "multiplied for people"
    assert found["last"] == [-7994, -7996, None]
    assert found["added"] == [True, -7998], "what stays keeps its values"
    assert found["twice"] == 6, "one row for a time"
    assert found["anew"] == [3], "the robot's clock began anew"
    assert found["past"] == [700]
    assert found["at"] == "row 700"
    assert found["again"] == 1
    assert found["units"] == ["m/s", "V", "°/s", ""]
    assert found["title"] == "pose pose x"


MATCHING = """
async ([meanings, typed]) => {
  const { matching } = await import("/page/series.js");
  return typed.map((each) => matching(meanings, each));
}
"""


async def numbers_are_plotted_pinned_and_pointed_at(page: Page) -> None:
    async def asked() -> list[dict[str, Any]]:
        sent: list[dict[str, Any]] = await page.evaluate("window.sent.filter((each) => each.do === 'plot')")
        return sent

    await page.evaluate("void (window.sent = [])")
    await page.click("#tab-plots")
    await page.fill("#plot-name", "compass")
    await page.click("#plot-add")  # before the station has named any number
    await page.wait_for_function("() => window.sent.some((each) => each.do === 'numbers')")
    (listed,) = await page.evaluate("window.sent.filter((each) => each.do === 'numbers')")
    meanings = {"sensor/battery:voltage": "Pack voltage, V.", "state/pose:twist.wz": "Turn rate, rad/s."}
    await say(page, {"kind": "answer", "id": listed["id"], "ok": True, "value": {"numbers": meanings}})
    await page.wait_for_function("() => document.querySelectorAll('#plot-names option').length === 2")

    await expect(page.locator("#plot-note")).to_have_text("No number matches compass")
    await page.fill("#plot-name", "a")
    await page.click("#plot-add")
    await expect(page.locator("#plot-found span")).to_contain_text(["battery voltagePack", "pose twist wzTurn"])
    await page.get_by_role("button", name="Add battery voltage").click()
    await expect(page.locator("#plot-found li")).to_have_count(0)
    assert await page.evaluate(MATCHING, [meanings, ["Battery", "pose twist wz", "turn rate", "", "battery rate"]]) == [
        ["sensor/battery:voltage"],
        *2 * [["state/pose:twist.wz"]],
        *2 * [[]],
    ]
    await page.select_option("#plot-into", "0")
    await page.fill("#plot-name", "state/pose:twist.wz")
    await page.press("#plot-name", "Enter")
    await page.locator(".plot canvas").wait_for()
    assert await page.locator(".plot").count() == 1
    order = (await asked())[-1]
    assert order["names"] == [*meanings]
    for i in range(40):
        at = 100.0 + i / 10
        await say(page, {"kind": "samples", "set": order["set"], "at": at, "values": [7.4, None if i % 2 else 0.5]})
        pose = {"stamp": round(at * 1e9), "pose": [i / 10, 0.0, 0.0], "twist": [0.0, 0.0, 0.0], "age": 0.0}
        await say(page, {"kind": "pose", "frame": "map", **pose})
    await say(page, {"kind": "samples", "set": order["set"] - 1, "at": 200.0, "values": [9.9]})
    outputs = page.locator(".legend output")
    await expect(outputs).to_have_text(["7.400 V", "28.648 °/s"])

    await page.select_option("#plot-window", "10")
    over = page.locator(".plot .u-over")
    await over.scroll_into_view_if_needed()
    box = await over.bounding_box()
    assert box is not None
    at = -1.0
    for i in range(200):  # until the curve is drawn over the 10 s
        await page.mouse.move(box["x"] + box["width"] * 0.8, box["y"] + 20 + i % 2)
        past = await page.get_attribute("#map", "data-past")
        at = float(past.split(",")[0]) if past else -1.0
        if 1.5 < at < 2.3:
            break
        await asyncio.sleep(0.05)
    assert 1.5 < at < 2.3, "two seconds ago"
    await page.mouse.move(5, 5)
    await page.wait_for_function("() => !document.querySelector('#map').dataset.past")

    assert json.loads(await page.evaluate("localStorage.plots")) == [[*meanings]]
    for _ in meanings:
        await page.locator(".legend button").first.click()
    assert (await asked())[-1]["names"] == []
    await expect(page.locator("#plots-none")).to_be_visible()
    await page.click("#tab-drive")


async def a_wizard_asks_and_its_result_is_accepted_beside_the_one_before(page: Page) -> None:
    async def asked() -> dict[str, Any]:
        sent: dict[str, Any] = await page.evaluate("window.sent.filter((each) => each.do === 'calibrate').at(-1)")
        return sent

    await page.evaluate("void (window.sent = [])")
    await page.click("#tab-system")
    await page.click("#wizards-list")
    wizards = [
        {"id": "drive.inverted", "name": "drive", "rough": True, "doc": "Which way is forward.", "due": True},
        {"id": "battery.gain", "name": "battery", "rough": False, "doc": "Scale of the voltage.", "due": False},
    ]
    bounds = {"low": 0.1, "high": 5.0, "choices": [], "whole": False}
    fresh = {"name": "fresh", "default": False, "help": "Forget the earlier readings.", **bounds}
    wizards[1]["options"] = [{"name": "meter_error", "default": 0.5, "help": "Of the meter, %.", **bounds}, fresh]
    await say(page, {"kind": "answer", "id": (await asked())["id"], "ok": True, "value": {"wizards": wizards}})
    await expect(page.locator("#wizards button")).to_have_text(["Rough calibration of drive", "Calibrate battery"])
    await page.click("#wizards summary")
    await page.get_by_label("meter error").fill("0.8")
    await page.locator("#wizards button").last.click()
    begun = await asked()
    assert (begun["order"], begun["step"], begun["options"]) == ("start", "battery.gain", {"meter_error": 0.8})
    await expect(page.locator("#command code")).to_have_text("monstertruckd calibrate battery --meter-error 0.8")

    state = {"kind": "calibrating", "step": "battery.gain", "phase": "running", "said": ["battery: Scale"], "text": ""}
    state |= {"progress": None, "plot": None, "measured": None, "question": None}
    question = {"kind": "number", "name": "meter", "text": "What does the meter show, V?", "low": 5.0, "high": 30.0}
    await say(page, state | {"question": question})
    await expect(page.locator("#wizard-question")).to_have_text(question["text"])
    await page.fill("#wizard-number", "12,6")
    await page.press("#wizard-number", "Enter")
    assert ((await asked())["order"], (await asked())["value"]) == ("answer", 12.6)
    await say(page, state | {"question": {"kind": "confirm", "name": "another", "text": "Another?", "fact": True}})
    await page.click("#wizard-no")
    assert (await asked())["value"] is False
    await say(page, state | {"progress": {"name": "drive", "done": 0.5, "total": 1.0}})
    assert await page.locator("#wizard-progress").evaluate("(bar) => bar.position") == 0.5
    await expect(page.locator("#wizard-ask")).to_be_hidden()
    await expect(page.locator("#wizard-plot")).to_be_hidden()
    axes = {"name": "scale", "x": "input (V)", "y": "meter (V)"}
    await say(
        page, state | {"plot": axes | {"points": [[10.0, 10.2], [12.0, 12.4]], "curve": [[10.0, 10.2], [12.0, 12.4]]}}
    )
    await expect(page.locator("#wizard-plot text")).to_have_text(["12.4", "10.2", "10", "12", "input (V)", "meter (V)"])
    places = await page.locator("#wizard-plot circle").evaluate_all(
        "(all) => all.map((one) => [one.cx, one.cy].map((at) => at.baseVal.value))"
    )
    assert places == [[44, 162], [292, 22]], "up and to the right"
    assert await page.locator("#wizard-plot .fit").get_attribute("d") == "M44 162L292 22"
    row = {"name": "gain", "value": 1.0213, "low": 1.0, "high": 1.04, "unit": "V", "meaning": "scale", "grade": "A"}
    measured = {"rows": [row | {"before": {"value": 0.98, "low": 0.97, "high": 0.99}}], "text": "two readings"}
    await say(page, state | {"phase": "measured", "measured": measured})
    await expect(page.locator("#wizard-rows td")).to_contain_text(["gain", "1.021 ± 0.020 V", "0.980 ± 0.010 V", "A"])
    ends = await page.locator("#wizard-rows path").evaluate_all("(all) => all.map((path) => path.getBBox().x)")
    assert ends[0] > ends[1], "its interval above that of the value before"
    await page.click("#wizard-accept")
    assert (await asked())["order"] == "accept"
    await say(page, state | {"phase": "saved", "text": "0002.json"})
    await expect(page.locator("#wizard-text")).to_contain_text("0002.json; the daemon applies it at its next start")
    await expect(page.locator("#wizards")).to_be_visible()
    await page.click("#tab-drive")


LENS = LensConfig().model_dump()
PROJECTED = """
async (lens) => {
  const { projected, relative } = await import("/page/geometry.js");
  const level = { translation: [0.18, 0, 0.25], rotation: [0, 0, 0, 1] };
  const down = { translation: [0, 0, 1], rotation: [0, Math.sin(Math.PI / 4), 0, Math.cos(Math.PI / 4)] };
  return {
    level: [[1.18, 0, 0.25], [1.18, 0, 0], [1.18, 0.5, 0.25], [0, 0, 0]].map((point) => projected(point, level, lens)),
    down: projected([0, 0.1, 0], down, lens),
    barrel: projected([1.18, 0.5, 0.25], level, { ...lens, k1: -0.2 }),
    relative: relative([1, 2, Math.PI / 2], [1, 4, Math.PI]),
  };
}
"""


async def the_path_is_drawn_into_the_large_picture_of_the_camera(page: Page) -> None:
    found = await page.evaluate(PROJECTED, LENS)
    assert found["level"][0] == pytest.approx([0.5, 0.5])
    assert found["level"][1] == pytest.approx([0.5, 0.5 + 522.2 * 0.25 / 480]), "the ground is below the axis"
    assert found["level"][2] == pytest.approx([0.5 - 522.2 * 0.5 / 640, 0.5]), "left is left"
    assert found["level"][3] is None, "behind the lens"
    assert found["down"] == pytest.approx([0.5 - 522.2 * 0.1 / 640, 0.5]), "a camera that looks down"
    assert found["barrel"][0] == pytest.approx(0.5 - 522.2 * 0.5 * (1 - 0.2 * 0.25) / 640)
    assert found["relative"] == pytest.approx([2.0, 0.0, 1.5708], abs=1e-4)

    tree = {"camera": ["base", 0.18, 0.0, 0.25, 0.0, 0.0, 0.0, 1.0]}
    await say(page, {**FACTS, "lens": LENS}, {"kind": "transforms", "tree": tree})
    pose = {"stamp": 10**9, "pose": [0.0, 0.0, 0.0], "twist": [0.0, 0.0, 0.0], "age": 0.0}
    poses = [value for i in range(30) for value in (i / 10, 0.0, 0.0)]
    await say(page, {"kind": "pose", "frame": "map", **pose})
    await say(page, {"kind": "path", "frame": "map", "name": "route", "poses": poses, "directions": []})
    await page.evaluate(PICTURE)
    await page.click("#tab-truck")
    await page.click("#camera-large")
    await page.wait_for_function("() => Number(document.querySelector('#camera-lines').dataset.drawn) > 60")
    box, view = await page.locator("#camera-lines").bounding_box(), await page.locator("#view").bounding_box()
    assert box is not None
    assert view is not None
    assert box["width"] / box["height"] == pytest.approx(4 / 3, rel=0.02)
    assert box["width"] == pytest.approx(view["width"], abs=4) or box["height"] == pytest.approx(view["height"], abs=4)
    await page.click("#camera-close")
    await expect(page.locator("#map")).to_be_visible()
    await page.click("#tab-drive")


PICTURE = """
async () => {
  const canvas = Object.assign(document.createElement("canvas"), { width: 64, height: 48 });
  canvas.getContext("2d").fillRect(0, 0, 64, 48);
  const blob = await new Promise((done) => canvas.toBlob(done, "image/jpeg"));
  const jpeg = new Uint8Array(await blob.arrayBuffer());
  const head = new TextEncoder().encode(JSON.stringify({ kind: "camera", sequence: 1, stamp: 1e9 }));
  const frame = new Uint8Array(4 + head.length + jpeg.length);
  new DataView(frame.buffer).setUint32(0, head.length, true);
  frame.set(head, 4);
  frame.set(jpeg, 4 + head.length);
  window.socket.onmessage({ data: frame.buffer });
}
"""


COMMANDS: list[tuple[dict[str, Any], str | None]] = [
    ({"do": "order", "order": "arm", "hold": False}, "arm"),
    ({"do": "order", "order": "arm", "hold": True}, "arm --hold"),
    ({"do": "order", "order": "estop"}, "estop"),
    ({"do": "order", "order": "stop"}, None),
    ({"do": "goal", "goal": [1, -2.5, 1.5708], "via": [[0.5, 1]]}, "goto --via 0.5,1 -- 1 -2.5 90"),
    ({"do": "start_path", "path": "loop"}, "path loop"),
    ({"do": "track_file", "name": "my race.csv", "text": "", "closed": True}, "track 'my race.csv' --closed"),
    ({"do": "explore", "order": "start"}, "explore"),
    ({"do": "explore", "order": "stop"}, "explore --stop"),
    ({"do": "mission", "order": "start", "text": ""}, "mission run FILE"),
    ({"do": "mission", "order": "resume", "moved": True}, "mission run --resume --moved"),
    ({"do": "mission", "order": "stop"}, "mission stop"),
    ({"do": "behave", "order": "start", "behaviour": "wall"}, "behave start wall"),
    ({"do": "behave", "order": "stop", "behaviour": "wall"}, "behave stop"),
    ({"do": "set", "key": "gate.speed", "value": 0.1, "save": True}, "set --save gate.speed 0.1"),
    ({"do": "set", "key": "gate.speed", "value": -1, "save": False}, "set gate.speed -- -1"),
    ({"do": "settings"}, "get"),
    (
        {"do": "point", "order": "mark", "name": "door", "place": [1, -2], "yaw": 3.14159},
        "points mark door -- 1 -2 180",
    ),
    ({"do": "point", "order": "remove", "name": "door"}, "points remove door"),
    ({"do": "zone", "order": "off", "name": "ramp", "seconds": 600}, "zone off ramp"),
    ({"do": "calibrate", "order": "start", "step": "battery.gain"}, "calibrate battery"),
    ({"do": "calibrate", "order": "list"}, None),
    ({"do": "hand_over", "to": "ann"}, None),
]
LINES = """
async ([commands, robot]) => {
  const { commandLine } = await import("/page/commandline.js");
  return commands.map((command) => commandLine(command, robot));
}
"""


def understood(line: str) -> None:
    """Have the program parse a command line, without running it."""
    program, *rest = shlex.split(line)
    assert program == "monstertruckd"
    command: Any = get_command(app)
    context = command.make_context(program, [], resilient_parsing=True)
    while hasattr(command, "commands"):
        name, *rest = rest
        command = command.commands[name]
        if not hasattr(command, "commands"):
            command.make_context(name, rest, parent=context)


async def what_is_pressed_is_shown_as_a_command_line(page: Page) -> None:
    given = [command for command, _ in COMMANDS]
    lines = await page.evaluate(LINES, [given, "truck"])
    assert lines == [None if expected is None else f"monstertruckd {expected}" for _, expected in COMMANDS]
    named = await page.evaluate(LINES, [given, "rover"])
    for line in filter(None, (*lines, *named)):
        understood(line)
    assert named[0] == "monstertruckd arm --robot rover"
    await say(page, gate_says(GateMode.ARMED))
    await page.click("#disarm")
    await expect(page.locator("#command code")).to_have_text("monstertruckd disarm")


async def the_guide_help_and_keys_explain_the_page_and_never_cover_the_emergency_stop(page: Page) -> None:
    await expect(page.locator("#guide")).to_be_hidden()
    await page.focus("#map")
    await page.keyboard.press("?")
    await expect(page.locator("#keys kbd")).to_contain_text(["Space", "Esc", "W A S D"])
    await page.click("#guide-again")
    await expect(page.locator("#keys")).to_be_hidden()
    pointed = []
    for step in range(1, 6):
        await expect(page.locator("#guide-count")).to_have_text(f"{step} of 5")
        pointed.append(await page.locator(".pointed-at").get_attribute("id"))
        await page.click("#estop", trial=True)
        await page.click("#guide-next")
    assert pointed == ["map", "authority", None, "tool-goal", "estop"]
    await expect(page.locator("#guide")).to_be_hidden()
    assert await page.locator(".pointed-at").count() == 0
    assert await page.evaluate("localStorage.guided") == "yes"
    await page.click("#pane-drive .help summary")
    await expect(page.locator("#pane-drive .help p")).to_contain_text("release them to stop")
    await page.click("#pane-drive .help summary")
    panes = await page.locator("[role=tabpanel]").count()
    assert await page.locator("[role=tabpanel] > .help").count() == panes, "each has its help"


@pytest.mark.timeout(300)
async def test_the_page_drives_as_the_hand_does_and_shows_what_is_true(tmp_path: Path):
    """All in one browser, for it takes seconds to start."""
    async with serving() as (station, _), chromium(tmp_path) as browser:
        page = await browser.new_page()
        errors: list[str] = []
        page.on("pageerror", lambda error: errors.append(str(error)))
        await page.add_init_script(PLAYED)
        await page.goto(station.place.url)
        await page.wait_for_selector("html[data-ready=true]")
        await say(page, {"kind": "hello", "version": "1", "user": "", "role": "engineer"})
        await say(page, {"kind": "robots", "names": ["truck"]}, {"kind": "robot", "name": "truck"}, FACTS)
        await say(page, {"kind": "link", "alive": True, "round_trip": 0.02, "text": ""})
        await nothing_drives_once_the_hand_is_gone(page)
        await unseen_ground_is_confirmed_only_while_the_hand_says_so(page)
        await a_robot_that_has_yet_to_stand_is_shown_stopping_and_cannot_be_armed(page)
        await a_gamepad_drives_the_robot_of_the_page_that_has_the_focus(page)
        await an_unknown_way_is_taken_to_be_slow(page)
        await parts_of_the_map_outlive_the_whole_map_that_they_belong_to(page)
        await a_robot_without_a_map_is_called_so(page)
        await the_map_is_saved_as_the_files_of_map_server(page, tmp_path)
        await a_zone_is_drawn_on_the_map_and_turned_off(page)
        await places_are_marked_moved_renamed_driven_to_and_removed_on_the_map(page)
        await a_mission_is_drawn_on_the_map_run_and_watched(page)
        await what_a_sensor_said_long_ago_is_not_shown_as_of_now(page)
        await a_stop_is_shown_with_its_chain_of_causes(page)
        await a_mission_of_a_robot_that_was_moved_goes_on_once_that_is_said(page)
        await a_task_arms_the_robot_and_lets_planners_drive_once_it_has_begun(page)
        await a_dock_is_drawn_on_the_map_and_driven_to_by_its_button(page)
        await the_configured_path_is_started_by_its_name(page)
        await an_emulated_robot_fails_and_gets_obstacles_by_hand(page)
        await a_goal_says_what_the_gate_lets_it_do(page)
        await armed_at_rest_is_called_armed(page)
        await a_hand_on_a_disarmed_robot_hears_arm_first(page)
        await space_and_a_gamepads_face_button_are_the_emergency_stop_and_escape_stops(page)
        await why_the_robot_stands_is_in_the_panel_with_time_and_remedy(page)
        await events_have_times_are_counted_and_filtered(page)
        await settings_have_names_units_degrees_search_and_a_way_back(page)
        await stick_and_map_are_in_view_together_on_a_phone_and_tabs_stay_in_one_line(page)
        await values_over_time_are_kept_for_ten_minutes_and_found_by_their_time(page)
        await numbers_are_plotted_pinned_and_pointed_at(page)
        await a_wizard_asks_and_its_result_is_accepted_beside_the_one_before(page)
        await the_path_is_drawn_into_the_large_picture_of_the_camera(page)
        await what_is_pressed_is_shown_as_a_command_line(page)
        await the_guide_help_and_keys_explain_the_page_and_never_cover_the_emergency_stop(page)
        await the_link_that_failed_is_named_with_its_age(page)
        assert errors == []
