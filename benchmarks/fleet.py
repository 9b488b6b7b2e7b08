"""A fleet behind one router: delay that the router adds, processor time and bytes of each robot, loss of the router.

    python -m benchmarks.fleet [--robots 20] [--seconds 30] [--quick]

Two robots are whole: emulated truck and daemon, the first drives a path by itself, the second by hand through the
router. The others publish every topic that a page shows at its nominal rate and size (``station_parts/published.py``),
five in a process; all have a session, a certificate and a liveliness token of their own. The router is a session of
zenoh-python with the configuration that ``security router`` makes. A page follows one robot and looks at all of them; a
recorder takes everything of all. Nothing is measured before all robots are seen through the router; who is missing is
named. The added delay is that of one message by way of the router against the same one from the robot's own endpoint.
Then the router is killed, and started again. The last line is JSON.
"""

import argparse
import asyncio
import contextlib
import json
import os
import sys
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import aiohttp
import numpy as np
import zenoh

from benchmarks import ROOT
from benchmarks.station import cpu
from benchmarks.station_parts import published
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock, WallClock, run_wall
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.stations import TLS_VARIABLE, ClientTls, session_config
from monstertruck_runtime.yaml_files import read_yaml, yaml_text
from monstertruck_schemas.req import Order, Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.state import GateMode
from monstertruck_schemas.topics import GATE, KEY_ROOT, ODOMETRY, SCAN, STOP, alive_key
from monstertruckd.bus.access import out_groups
from monstertruckd.bus.zenoh_config import ZenohConfig
from monstertruckd.tools.demo.runs import free_endpoint, write_overlay
from monstertruckd.tools.security.folder import Folder
from monstertruckd.tools.security.router import make_router

GOALS = {
    "missing": [],
    "added_delay_p99_ms": 10.0,
    "seen_again_s": 10.0,
    "by_itself_driven_without_router_m": 0.5,
    "by_hand_stopped_after_s": 1.0,
}
TOGETHER = 5
STATION = "page"
WHOLE: tuple[dict[str, Any], ...] = ({}, {"path": None, "map": None, "tracker": None})
"""What the whole robots have otherwise than ``configs/demo.yaml``: the first drives its path, the second by hand."""
PATIENCE = 120.0
"""Seconds for a process to come up, and for all robots to be seen."""
WITHOUT = 6.0
"""Seconds without a router."""


def publish(files: list[Path]) -> None:
    """Run the robots of one process, given by their configurations."""

    async def all_of_them(clock: Clock) -> None:
        await asyncio.gather(
            *(
                published.main(ZenohConfig.model_validate_json(file.read_text(), strict=False), file.stem, clock)
                for file in files
            )
        )

    run_wall(all_of_them)


def route(file: Path) -> None:
    """Run the router until standard input ends."""
    with zenoh.open(zenoh.Config.from_json5(file.read_text())):
        print("ready", flush=True)
        sys.stdin.read()


@dataclass
class Prepared:
    """Files of all robots, and the endpoint of the router."""

    folder: Path
    names: list[str]
    settings: dict[str, dict[str, Any]]
    """Zenoh's part of each robot's configuration."""
    router: Path
    endpoint: str

    def own_endpoint(self, robot: str) -> str:
        """Return the robot's own endpoint."""
        return str(self.settings[robot]["listen"][0])


def prepare(folder: Path, count: int) -> Prepared:
    """Write certificates and settings of all robots."""
    now = (WallClock().now() + WallClock().real_offset()) // SECOND
    endpoint = free_endpoint().replace("tcp/", "tls/")
    names = [f"robot{number}" for number in range(count)]
    robots = {name: Folder(folder / name) for name in names}
    for name, robot in robots.items():
        robot.init(name, ("127.0.0.1",), robot.robot, now)
        robot.add(STATION, AccessRole.PILOT, Role.STATION, now)
    place = folder / "router" / "router"
    make_router(folder / "router", list(robots.values()), ("127.0.0.1",), now, place, int(endpoint.rpartition(":")[2]))
    settings = {}
    for name, robot in robots.items():
        own = {"listen": [free_endpoint().replace("tcp/", "tls/")], "listen_pilots": [], "local_socket": False}
        settings[name] = robot.zenoh().model_dump(mode="json") | own
    return Prepared(folder, names, settings, place / "zenoh.json5", endpoint)


def publisher_file(made: Prepared, robot: str) -> Path:
    """Write the settings of a robot that only publishes."""
    file = made.folder / f"{robot}.json"
    file.write_text(json.dumps(made.settings[robot]))
    return file


def whole_file(made: Prepared, robot: str, otherwise: dict[str, Any]) -> Path:
    """Write the configuration of a complete robot."""
    file = write_overlay(ROOT / "configs" / "demo.yaml", made.folder / f"{robot}-whole", made.own_endpoint(robot))
    overlay = {**read_yaml(file), "robot": robot, "zenoh": made.settings[robot], **otherwise}
    file.write_text(yaml_text(overlay))
    return file


def station_files(folder: Path, robot: str) -> ClientTls:
    """Return the page's certificate issued by a robot."""
    own = folder / robot / "stations" / STATION
    return ClientTls(ca=own / "ca.pem", certificate=own / "station.pem", key=own / "station.key")


class Heard:
    """Arrival times of messages, by their bytes, and the received bytes of each robot."""

    def __init__(self) -> None:
        self.at: dict[bytes, int] = {}
        self.bytes: dict[str, int] = {}

    def arrival(self, sample: zenoh.Sample) -> None:
        """Note a message of a measured robot; its bytes identify it."""
        self.at[sample.payload.to_bytes()] = time.monotonic_ns()

    def count(self, sample: zenoh.Sample) -> None:
        """Count any message."""
        robot = str(sample.key_expr).split("/")[1]
        self.bytes[robot] = self.bytes.get(robot, 0) + len(sample.payload)


class GivenUpError(Exception):
    """A process did not become ready; the text names it and its last line."""


@dataclass
class Program:
    """A process whose output is read continuously; its last line is reported if it ends or does not become ready."""

    name: str
    running: asyncio.subprocess.Process
    ready: int
    """How often it has yet to say that it is ready."""
    last: deque[str] = field(default_factory=lambda: deque(maxlen=4))

    async def read(self) -> None:
        """Until it ends."""
        assert self.running.stdout is not None
        while line := (await self.running.stdout.readline()).decode():
            self.last.append(line.strip())
            self.ready -= "ready" in line or "station:" in line

    async def come_up(self) -> None:
        """Wait until it is ready.

        Raises:
            GivenUpError: it ended, or took too long.
        """
        waited = await until(lambda: self.ready <= 0 or self.running.returncode is not None, PATIENCE)
        if self.ready > 0:
            why = "ended" if self.running.returncode is not None else f"not ready after {waited:.0f} s"
            raise GivenUpError(f"{self.name}: {why}, said last: {' / '.join(self.last) or 'nothing'}")


@asynccontextmanager
async def program(
    name: str, *words: str, ready: int = 1, environment: dict[str, str] | None = None
) -> AsyncIterator[Program]:
    """Run a process for the duration of the context, and kill it at the end.

    Args:
        name: name for messages.
        words: arguments after ``python -m``.
        ready: number of lines that report readiness, awaited by ``come_up``.
        environment: additional environment.
    """
    pipe = asyncio.subprocess.PIPE
    running = await asyncio.create_subprocess_exec(
        sys.executable, "-m", *words, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=asyncio.subprocess.STDOUT,
        env={**os.environ, **(environment or {})},
    )  # fmt: skip
    made = Program(name, running, ready)
    reading = asyncio.create_task(made.read())
    try:
        yield made
    finally:
        with contextlib.suppress(ProcessLookupError):
            running.kill()
        await running.wait()
        await asyncio.gather(reading, return_exceptions=True)


async def page(url: str, rows: list[dict[str, Any]]) -> None:
    """Run a browser that follows the first robot and shows the fleet."""
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{url}socket", origin=url[:-1], max_msg_size=0) as socket,
    ):
        await socket.send_json({"do": "fleet", "on": True})
        watched = False
        async for message in socket:
            if not isinstance(message.data, str):
                continue
            frame = json.loads(message.data)
            if frame["kind"] == "robots" and frame["names"] and not watched:
                watched = True
                await socket.send_json({"do": "watch", "robot": frame["names"][0]})
            elif frame["kind"] == "fleet":
                rows[:] = frame["robots"]


async def until(condition: Callable[[], bool], seconds: float) -> float:
    """Return the seconds until a condition is true; infinite if it is not in time."""
    began = time.monotonic()
    while time.monotonic() - began < seconds:
        if condition():
            return time.monotonic() - began
        await asyncio.sleep(0.02)
    return float("inf")


async def missing(session: zenoh.Session, names: list[str], seconds: float) -> list[str]:
    """Return the robots that do not appear through the router within this time."""

    def seen() -> set[str]:
        replies = session.liveliness().get(alive_key("*"), timeout=2.0)
        return {str(reply.ok.key_expr).split("/")[1] for reply in replies if reply.ok is not None}

    began = time.monotonic()
    while absent := sorted(set(names) - await asyncio.to_thread(seen)):
        if time.monotonic() - began > seconds:
            break
        await asyncio.sleep(0.2)
    return absent


class Whole:
    """A complete robot: observed by its own endpoint, commanded through the router."""

    def __init__(self, made: Prepared, robot: str) -> None:
        own, tls = station_files(made.folder, robot), station_files(made.folder, made.names[0])
        self.direct = TruckClient(robot, made.own_endpoint(robot), tls=own)
        self.routed = TruckClient(robot, made.endpoint, tls=tls)

    async def __aenter__(self) -> Self:
        await self.direct.__aenter__()
        await self.routed.__aenter__()
        self.odometry = self.direct.watch(ODOMETRY)
        self.gate = self.direct.watch(GATE)
        self.stop = self.direct.watch(STOP)
        if await until(lambda: self.odometry.latest is not None, PATIENCE) == float("inf"):
            raise GivenUpError(f"{self.direct.robot}: no odometry")
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.routed.__aexit__(None, None, None)
        await self.direct.__aexit__(None, None, None)

    @property
    def mode(self) -> GateMode | None:
        """Mode of its gate."""
        return self.gate.latest.mode if self.gate.latest else None

    @property
    def place(self) -> np.ndarray:
        """Position by its odometry, m."""
        pose = self.odometry.latest.pose if self.odometry.latest else None
        return np.array([pose.x, pose.y]) if pose else np.full(2, np.nan)

    @property
    def moves(self) -> bool:
        """Whether its odometry shows motion."""
        return self.odometry.latest is not None and abs(self.odometry.latest.twist.vx) > 0.02

    async def drive(self, *, by_hand: bool) -> None:
        """Arm it through the router, again after stops by late samples; by hand it drives to and fro."""
        start, speed = self.place, 0.1
        while True:
            with contextlib.suppress(TruckError, zenoh.ZError, TimeoutError):
                if not self.mode.accepts_motion:
                    await self.routed.order(Order.ARM, hold=by_hand)
                if by_hand:
                    way = float(self.place[0] - start[0])
                    speed = -0.1 if way > 0.3 else 0.1 if way < 0.0 else speed
                    await self.routed.drive(speed, 0.0)
            await asyncio.sleep(0.05)


@dataclass
class Fleet:
    """Processes of all robots; the complete ones are the last."""

    made: Prepared
    publishing: list[Program]
    daemons: list[Program]

    @property
    def publishers(self) -> list[str]:
        """Names of robots that only publish."""
        return self.made.names[: -len(WHOLE)]

    @property
    def whole(self) -> list[str]:
        """Names of complete robots."""
        return self.made.names[-len(WHOLE) :]

    async def start(self, stack: AsyncExitStack) -> None:
        """Start all, and wait until they appear through the router."""
        for n in range(0, len(self.publishers), TOGETHER):
            batch = self.publishers[n : n + TOGETHER]
            files = [str(publisher_file(self.made, robot)) for robot in batch]
            words = ("benchmarks.fleet", "--publish", *files)
            self.publishing.append(await stack.enter_async_context(program(", ".join(batch), *words, ready=len(batch))))
        for robot, otherwise in zip(self.whole, WHOLE, strict=True):
            config = ("--config", str(whole_file(self.made, robot, otherwise)))
            simulator = program(f"{robot}'s simulator", "monstertruckd", "simulate", *config)
            await (await stack.enter_async_context(simulator)).come_up()
            daemon = program(robot, "monstertruckd", "run", *config, ready=0)
            self.daemons.append(await stack.enter_async_context(daemon))
        for each in self.publishing:
            await each.come_up()


async def measure(folder: Path, count: int, seconds: float) -> dict[str, Any]:
    """Measure all figures.

    Raises:
        GivenUpError: a process did not become ready, or a robot is missing.
    """
    made = await asyncio.to_thread(prepare, folder, count)
    figures: dict[str, Any] = {"robots": count, "whole": len(WHOLE), "load_average": round(os.getloadavg()[0], 1)}
    router_words = ("benchmarks.fleet", "--route", str(made.router))
    port = free_endpoint().rpartition(":")[2]
    async with AsyncExitStack() as stack, AsyncExitStack() as routed:
        router = await routed.enter_async_context(program("router", *router_words))
        await router.come_up()
        fleet = Fleet(made, [], [])
        await fleet.start(stack)
        tls = station_files(folder, made.names[0])
        environment = {TLS_VARIABLE: str(tls.certificate.parent)}
        words = ("monstertruckd", "station", "--router", made.endpoint, "--port", port)
        station = await stack.enter_async_context(program("station", *words, environment=environment))
        await station.come_up()
        with await asyncio.to_thread(_open, made.endpoint, tls) as session:
            if absent := await missing(session, made.names, PATIENCE):
                said = {each.name: list(each.last) for each in (*fleet.publishing, *fleet.daemons)}
                raise GivenUpError(f"not seen through the router: {', '.join(absent)}; said last: {said}")
        rows: list[dict[str, Any]] = []
        await _during(stack, page(f"http://127.0.0.1:{port}/", rows))

        def on_the_page() -> bool:
            return sum(row["alive"] for row in rows) == count

        figures["all_on_the_page_s"] = round(await until(on_the_page, PATIENCE), 1)
        figures["missing"] = sorted(set(made.names) - {row["name"] for row in rows if row["alive"]})
        by_itself, by_hand = [await stack.enter_async_context(Whole(made, robot)) for robot in fleet.whole]
        await _during(stack, by_itself.drive(by_hand=False))
        await _during(stack, by_hand.drive(by_hand=True))
        await _both_move(by_itself, by_hand)
        figures |= await _costs(fleet, router, station, seconds)
        await _both_move(by_itself, by_hand)
        figures |= await _without_router(routed, by_itself, by_hand, rows)
        await (await stack.enter_async_context(program("router", *router_words))).come_up()
        figures["seen_again_s"] = round(await until(on_the_page, 60), 1)
    return figures


async def _both_move(by_itself: Whole, by_hand: Whole) -> None:
    if await until(lambda: by_itself.moves and by_hand.moves, PATIENCE) == float("inf"):
        states = {each.direct.robot: each.gate.latest for each in (by_itself, by_hand)}
        raise GivenUpError(f"whole robots do not drive: {states}")


async def _costs(fleet: Fleet, router: Program, station: Program, seconds: float) -> dict[str, Any]:
    """Return delay, processor time and bytes, with a recorder."""
    made = fleet.made
    everything, direct, routed = Heard(), Heard(), Heard()
    tls = station_files(made.folder, made.names[0])
    async with AsyncExitStack() as stack:
        recorder, by_router = [await _opened(stack, made.endpoint, tls) for _ in range(2)]
        for robot in made.names:
            for group in out_groups():
                recorder.declare_subscriber(f"{KEY_ROOT}/{robot}/{group}/**", everything.count)
        for robot in (made.names[0], *fleet.whole):
            session = await _opened(stack, made.own_endpoint(robot), station_files(made.folder, robot))
            for topic in (ODOMETRY, SCAN):
                by_router.declare_subscriber(topic.key(robot), routed.arrival)
                session.declare_subscriber(topic.key(robot), direct.arrival)
        await asyncio.sleep(3.0)
        everything.bytes.clear()
        processes = {"router": [router], "publishers": fleet.publishing, "daemons": fleet.daemons, "page": [station]}

        def used() -> dict[str, float]:
            return {name: sum(cpu(each.running.pid) for each in group) for name, group in processes.items()}

        before, began = used(), time.monotonic()
        await asyncio.sleep(seconds)
        elapsed = time.monotonic() - began
        percent = {name: 100 * (now - before[name]) / elapsed for name, now in used().items()}
        rate = [everything.bytes.get(robot, 0) / elapsed / 1000 for robot in fleet.publishers]
        whole_rate = [everything.bytes.get(robot, 0) / elapsed / 1000 for robot in fleet.whole]
    added = [1e-6 * (routed.at[key] - at) for key, at in direct.at.items() if key in routed.at]
    return {
        "messages_compared": len(added),
        "added_delay_p50_ms": round(float(np.median(added)), 2),
        "added_delay_p99_ms": round(float(np.percentile(added, 99)), 2),
        "cpu_percent_per_publisher": round(percent["publishers"] / len(fleet.publishers), 1),
        "cpu_percent_per_daemon": round(percent["daemons"] / len(fleet.daemons), 1),
        "cpu_percent_router_per_robot": round(percent["router"] / len(made.names), 1),
        "cpu_percent_station": round(percent["page"], 1),
        "kb_s_per_publisher": round(float(np.mean(rate)), 1),
        "kb_s_least_and_most": [round(min(rate), 1), round(max(rate), 1)],
        "kb_s_per_whole_robot": round(float(np.mean(whole_rate)), 1),
    }


async def _without_router(
    router: AsyncExitStack, by_itself: Whole, by_hand: Whole, rows: list[dict[str, Any]]
) -> dict[str, Any]:
    """Kill the router, and observe the complete robots."""
    before = [robot.stop.latest for robot in (by_itself, by_hand)]
    began, place = time.monotonic(), by_itself.place
    gone = asyncio.create_task(until(lambda: not any(row["alive"] for row in rows), 30))
    killed = asyncio.create_task(router.aclose())
    hand = await until(lambda: by_hand.mode is not GateMode.DRIVING and not by_hand.moves, WITHOUT)
    await killed
    await asyncio.sleep(max(0.0, began + WITHOUT - time.monotonic()))
    stops = [robot.stop.latest for robot in (by_itself, by_hand)]
    itself_by, hand_by = (
        now.reason.value if now is not None and now != old else None for now, old in zip(stops, before, strict=True)
    )
    return {
        "by_hand_stopped_after_s": round(hand, 2),
        "by_hand_stopped_by": hand_by,
        "by_itself_driven_without_router_m": round(float(np.linalg.norm(by_itself.place - place)), 2),
        "by_itself_stopped_by": itself_by,
        "gone_from_the_page_after_s": round(await gone, 1),
    }


async def _during(stack: AsyncExitStack, work: Coroutine[Any, Any, None]) -> None:
    """Run work until the stack is closed."""
    task = asyncio.create_task(work)

    async def end() -> None:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    stack.push_async_callback(end)


async def _opened(stack: AsyncExitStack, endpoint: str, tls: ClientTls) -> zenoh.Session:
    session = await asyncio.to_thread(_open, endpoint, tls)
    stack.push_async_callback(asyncio.to_thread, session.close)
    return session


def _open(endpoint: str, tls: ClientTls) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(endpoint, 5.0, tls))))


def main() -> int:
    """Measure; 0: all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=20, help="at least 3, of which 2 are whole")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--quick", action="store_true", help="2 whole robots and 2 publishers, 6 s")
    parser.add_argument("--publish", type=Path, nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--route", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.publish:
        publish(options.publish)
        return 0
    if options.route:
        route(options.route)
        return 0
    count, seconds = (4, 6.0) if options.quick else (options.robots, options.seconds)
    figures: dict[str, Any]
    with TemporaryDirectory(prefix="fleet-") as folder:
        try:
            figures = asyncio.run(measure(Path(folder), count, seconds))
        except GivenUpError as error:
            figures = {"robots": count, "given_up": str(error)}
    for name, value in figures.items():
        print(f"{name:34} {value}")
    met = (
        "given_up" not in figures
        and not figures["missing"]
        and figures["added_delay_p99_ms"] <= GOALS["added_delay_p99_ms"]
        and figures["seen_again_s"] <= GOALS["seen_again_s"]
        and figures["by_itself_driven_without_router_m"] >= GOALS["by_itself_driven_without_router_m"]
        and figures["by_hand_stopped_after_s"] <= GOALS["by_hand_stopped_after_s"]
    )
    print(json.dumps({"bench": "fleet", "figures": figures, "goals": GOALS, "met": bool(met)}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
