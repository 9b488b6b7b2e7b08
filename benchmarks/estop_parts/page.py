"""Time from an operator's action on the page to the bytes on the wires, in a real browser, with SLAM and the recorder.

The daemon of the emulated truck is pinned to one core; world, emulators, station and browser share the other. The page
drives to and fro by keyboard. Times of clicks and heartbeats are the browser's own, converted to this computer's
monotonic clock by the fastest of many round trips, so that delays are never understated.

    click     click on the emergency stop to the first quick stop on the drive controller's wire
    drive     a heartbeat with the opposite speed to the first bytes that change the motor's target
    steering  a heartbeat with the opposite steering to the first bytes that change a servo's target
    freeze    last heartbeat before SIGSTOP of the whole browser to the first bytes that stop the motor

A command counts only if the wire was steady before it.
"""

import asyncio
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from playwright.async_api import Page

from benchmarks import ROOT
from benchmarks.estop_parts.processes import ORDER_TIMEOUT, TO_AND_FRO, on_stderr, order, process
from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.protocol import FrameError, Opcode, decode_body, join
from monstertruck_drivers.maestro.protocol import Code, Decoder, ServoCommand
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock, run_wall
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_runtime.yaml_files import read_yaml, yaml_text
from monstertruck_schemas import topics
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode, GateState, Odometry
from monstertruckd.tools.demo.runs import connect, free_endpoint, write_overlay
from monstertruckd.tools.drill.observer import STOP_CONTROLS
from monstertruckd.tools.simulation import simulate
from monstertruckd.tools.simulation.config import load_simulated
from tests.daemon.browser_kit import chromium, opened

GOALS = {"click_p99_ms": 60.0, "drive_p99_ms": 75.0, "steering_p99_ms": 30.0, "freeze_max_ms": 350.0, "trials": 500}
HELD = 0.8
"""Seconds for which speed or steering are held before they are turned round."""
STEADY = 0.1
"""Seconds before a command without a change on its wire."""
WAIT = 0.6
"""Seconds for the bytes of a command."""
LISTEN = """
globalThis.clicks = [];
globalThis.beats = [];
const send = WebSocket.prototype.send;
WebSocket.prototype.send = function (data) {
  send.call(this, data);
  const message = JSON.parse(data);
  if (message.do === "drive") beats.push([performance.now(), message.speed, message.front]);
};
addEventListener("pointerdown", (event) => event.target.closest("#estop") && clicks.push(event.timeStamp), true);
"""


# World and emulators


class WirePort(PtyPort):
    """Prints the bytes that reach drive and servos: ``wire NAME INSTANT VALUE``, ns; a stop's value is ``stop``."""

    def __init__(self, link: Path) -> None:
        super().__init__(link)
        if link.name == "drive":
            self.device.on_bytes = self._drive
        elif link.name == "steering":
            self._decoder = Decoder()
            self.device.on_bytes = self._servo

    @staticmethod
    def _drive(to_device: bool, data: bytes) -> None:
        now = time.monotonic_ns()
        with suppress(FrameError):
            words = decode_body(Opcode.WRITE, data).words if to_device else ()
            if len(words) != 4:
                return
            index, value = words[0], join(words[2], words[3])
            if index == od.TARGET_VELOCITY.index:
                print(f"wire drive {now} {value}", flush=True)
            elif index == od.CONTROLWORD.index and value in STOP_CONTROLS:
                print(f"wire drive {now} stop", flush=True)

    def _servo(self, to_device: bool, data: bytes) -> None:
        now = time.monotonic_ns()
        for command in self._decoder.feed(data) if to_device else ():
            if isinstance(command, ServoCommand) and command.code is Code.SET_TARGET:
                print(f"wire servo{command.data[0]} {now} {command.value}", flush=True)


def serve(config: Path) -> None:
    """Run ``monstertruckd simulate`` with taps on both wires."""
    simulate.PtyPort = WirePort  # type: ignore[attr-defined, misc]
    run_wall(lambda clock: simulate.serve(clock, (load_simulated(config),), on_stderr))


class Wires:
    """Changes on the wires, as printed by the simulator."""

    def __init__(self, stream: asyncio.StreamReader) -> None:
        self._stream = stream
        self._last: dict[str, str] = {}
        self.changes: dict[str, list[int]] = {"drive": [], "servo": [], "stop": []}
        """Instants at which a target became another one, and of all bytes that stop the motor, ns."""
        self.quick: list[int] = []
        """Instants of quick stops, and others that need no ramp, ns."""

    async def run(self) -> None:
        """Read until the simulator ends."""
        while line := (await self._stream.readline()).decode():
            if not line.startswith("wire "):
                continue
            _, name, instant, value = line.split()
            at = int(instant)
            if value in ("stop", "0") and name == "drive":
                self.changes["stop"].append(at)
            if value == "stop":
                self.quick.append(at)
            elif self._last.get(name) != value:
                self.changes["servo" if name.startswith("servo") else name].append(at)
                self._last[name] = value

    async def first(self, found: list[int], since: int) -> int | None:
        """Wait for the first of these from an instant on; None if there is none in time."""
        end = time.monotonic() + WAIT
        while True:
            if after := [at for at in found if at >= since]:
                return after[0]
            if time.monotonic() > end:
                return None
            await asyncio.sleep(0.01)


# Hand and page


class Hand:
    """The page's keyboard and mouse in front of a truck, and the robot's messages."""

    def __init__(self, page: Page, client: TruckClient, wires: Wires) -> None:
        self.page, self.client, self.wires = page, client, wires
        self.gate: Mailbox[GateState] = client.subscribe(topics.GATE, latest())
        self.odometry: Mailbox[Odometry] = client.subscribe(topics.ODOMETRY, latest())
        self._offset = 0
        self._held: str | None = None

    async def synchronise(self) -> None:
        """Map the page's clock to ours; the start of the fastest query is taken as the time of its answer."""
        best = SECOND
        for _ in range(50):
            before = time.monotonic_ns()
            now = await self.page.evaluate("performance.now()")
            if (trip := time.monotonic_ns() - before) < best:
                best, self._offset = trip, before - round(1e6 * now)

    def instant(self, milliseconds: float) -> int:
        """Convert the page's time to our clock, ns."""
        return self._offset + round(1e6 * milliseconds)

    async def hold(self, key: str | None) -> None:
        """Hold only this key."""
        if self._held is not None:
            await self.page.keyboard.up(self._held)
        if key is not None:
            await self.page.keyboard.down(key)
        self._held = key

    async def drive(self, key: str, moves: Callable[[], bool]) -> None:
        """Arm and hold a key until the truck reacts; repeat if a busy computer has disarmed it."""
        async with asyncio.timeout(ORDER_TIMEOUT):
            while not moves():
                if self.gate.latest is None or not self.gate.latest.mode.accepts_motion:
                    await self.hold(None)
                    await order(self.client, Order.ARM)
                if self._held != key:
                    await self.hold(key)
                await asyncio.sleep(0.02)

    def goes(self, forward: bool) -> bool:
        """Whether it drives in that direction."""
        speed = self.odometry.latest.twist.vx if self.odometry.latest else 0.0
        return (speed if forward else -speed) > 0.05

    def driven(self) -> bool:
        """Whether the page drives it."""
        return self.gate.latest is not None and self.gate.latest.mode is GateMode.DRIVING

    async def click(self, forward: bool, more: float) -> float | None:
        """Drive and click on the emergency stop; return the seconds, None if it is missed."""
        await self.drive("w" if forward else "s", lambda: self.goes(forward))
        await asyncio.sleep(more)
        await self.page.mouse.down()
        await self.page.mouse.up()
        clicked = self.instant(await self.page.evaluate("clicks.at(-1)"))
        at = await self.wires.first(self.wires.quick, clicked)
        await self.hold(None)
        await order(self.client, Order.RESET)
        return None if at is None else (at - clicked) / SECOND

    async def turn_round(self, wire: str, keys: tuple[str, str], more: float) -> float | None:
        """Hold one key, then the other; return the seconds from the first heartbeat with the new value, or None."""
        field = 1 if wire == "drive" else 2
        await self.drive(keys[0], self.driven)
        await asyncio.sleep(HELD + more)
        count = await self.page.evaluate("beats.length")
        await self.hold(keys[1])
        await asyncio.sleep(0.12)
        before, *beats = await self.page.evaluate("(count) => beats.slice(count - 1)", count)
        differs = [beat[0] for beat in beats if abs(beat[field] - before[field]) > 0.02]
        if not differs:
            return None
        said = self.instant(differs[0])
        changes = self.wires.changes[wire]
        at = await self.wires.first(changes, said)
        steady = not any(said - STEADY * SECOND < change < said for change in changes)
        return (at - said) / SECOND if at is not None and steady else None

    async def freeze(self, forward: bool, pids: list[int]) -> float | None:
        """Stop the browser while it drives; return the seconds from the last heartbeat to the stopping bytes."""
        await self.drive("w" if forward else "s", lambda: self.goes(forward))
        await asyncio.sleep(HELD)
        if not self.driven():
            return None
        try:
            for pid in pids:
                os.kill(pid, signal.SIGSTOP)
            frozen = time.monotonic_ns()
            await asyncio.sleep(1.5)
        finally:
            for pid in pids:
                os.kill(pid, signal.SIGCONT)
        await self.hold(None)
        beats = await self.page.evaluate("beats.map((beat) => beat[0])")
        last = max(at for at in map(self.instant, beats) if at < frozen)
        at = await self.wires.first(self.wires.changes["stop"], last)
        async with asyncio.timeout(ORDER_TIMEOUT):
            while self.gate.latest is None or self.gate.latest.mode is not GateMode.DISARMED:
                await asyncio.sleep(0.05)
        return None if at is None else (at - last) / SECOND


async def measure(clock: Clock, folder: Path, count: int) -> dict[str, dict[str, Any]]:
    """Run this many trials of each kind; a tenth of them of freezing, which takes long.

    Args:
        clock: source of time.
        folder: folder for files.
        count: number of trials.
    """
    endpoint = free_endpoint()
    config = write_overlay(ROOT / "configs" / "slam.yaml", folder, endpoint)
    config.write_text(yaml_text(read_yaml(config) | TO_AND_FRO | {"path": None, "tracker": None}))
    port = free_endpoint().rpartition(":")[2]
    cores = sorted(os.sched_getaffinity(0))
    own, other = cores[0], cores[-1]
    station = ("-m", "monstertruckd", "station", "--robot", f"truck@{endpoint}", "--port", port)
    rng = np.random.default_rng(1)
    async with (
        process(other, folder / "simulate.txt", "-m", "benchmarks.estop_parts.page", str(config)) as simulator,
        process(own, folder / "daemon.txt", "-m", "monstertruckd", "run", "--config", str(config)),
        await connect(clock, "truck", endpoint) as client,
        process(other, folder / "station.txt", *station) as serving,
        chromium(folder) as browser,
    ):
        assert serving.stdout is not None
        async with asyncio.timeout(60):
            while b"station:" not in (folder / "station.txt").read_bytes():
                await asyncio.sleep(0.1)
        assert simulator.stdout is not None
        wires = Wires(simulator.stdout)
        reading = asyncio.create_task(wires.run())
        page = await opened(browser, f"http://127.0.0.1:{port}/")
        await page.add_init_script(LISTEN)
        await page.reload()
        await page.wait_for_selector("#authority[data-mode=disarmed]")
        pids = browser_processes()
        for pid in pids:
            with suppress(ProcessLookupError):
                os.sched_setaffinity(pid, {other})
        hand = Hand(page, client, wires)
        await hand.synchronise()
        box = await page.locator("#estop").bounding_box()
        assert box is not None
        await page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        await hand.click(True, 0.3)  # everything is warm then
        found: dict[str, list[float | None]] = {"click": [], "drive": [], "steering": [], "freeze": []}
        for number in range(count):
            forward = number % 2 == 1
            found["click"].append(await hand.click(forward, float(rng.uniform(0.2, 0.4))))
        for number in range(count):
            keys = ("w", "s") if number % 2 else ("s", "w")
            found["drive"].append(await hand.turn_round("drive", keys, float(rng.uniform(0, 0.05))))
        await hand.hold(None)
        for number in range(count):
            keys = ("a", "d") if number % 2 else ("d", "a")
            found["steering"].append(await hand.turn_round("servo", keys, float(rng.uniform(0, 0.05))))
        await hand.hold(None)
        for number in range(max(2, count // 10)):
            found["freeze"].append(await hand.freeze(number % 2 == 1, pids))
        reading.cancel()
    return {name: summary(values) for name, values in found.items()}


def summary(values: list[float | None]) -> dict[str, Any]:
    """Summarise delays in seconds; None: the event did not occur, or is excluded."""
    known = [1e3 * value for value in values if value is not None]
    p50, p99, most = np.percentile(known, (50, 99, 100)).tolist() if known else (np.inf, np.inf, np.inf)
    figures = {"p50_ms": round(p50, 1), "p99_ms": round(p99, 1), "max_ms": round(most, 1)}
    return {"trials": len(values), "without": len(values) - len(known), **figures}


def met(figures: dict[str, dict[str, Any]]) -> bool:
    """Whether all goals are met."""
    return (
        figures["click"]["without"] == 0
        and figures["click"]["p99_ms"] <= GOALS["click_p99_ms"]
        and figures["drive"]["p99_ms"] <= GOALS["drive_p99_ms"]
        and figures["steering"]["p99_ms"] <= GOALS["steering_p99_ms"]
        and figures["freeze"]["max_ms"] <= GOALS["freeze_max_ms"]
        and figures["freeze"]["without"] == 0
    )


def browser_processes() -> list[int]:
    """Return all processes of the browser started by this process."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            head, _, tail = (folder / "stat").read_text().rpartition(")")
            parents[int(folder.name)] = int(tail.split()[1]), head.partition("(")[2]
    below, found = {os.getpid()}, []
    while more := {child for child, (above, _) in parents.items() if above in below} - below:
        below |= more
        found += [child for child in more if "chromium" in parents[child][1]]
    return found


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
