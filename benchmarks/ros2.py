"""The robot as a ROS 2 node, judged by programs that others wrote.

    python -m benchmarks.ros2 [--seconds S] [--rclpy PYTHON] [--parts all|stand-in|robot]

Each face is a process of its own, ``monstertruckd ros2``.

- **A robot without devices** publishes all topics with values of which no two are equal. ``zenoh-ros2-sdk`` (face
  ``zenoh``) and a node of ``rclpy`` (face ``rclpy``) read them: values are compared with their source by stamp, and
  rates and the processor time of the face are taken. A node comes late. ``pyzeros`` and ``rclpy`` send twists, each
  timed from its sending to its request on the robot's bus. Then hostile publishers send as fast as they can: unknown
  identities, repetitions, old stamps, and a second publisher of a topic.
- **An emulated robot** (``configs/explore.yaml``) is driven by ``pyzeros`` and ``rclpy``: who holds the drive, how long
  the last message stands; goals of ``navigate_to_pose`` are driven, cancelled, and refused for their reason. ``rclpy``
  also drives through poses, follows a path backward, sends a goal pose, arms and stops.

``--rclpy`` is a Python 3.12 with the wheels of ROS 2, the interfaces that ``benchmarks/ros2_parts/build_messages.py``
builds, and this program's own libraries. Without it the face ``rclpy`` is not measured.
"""

import argparse
import asyncio
import json
import math
import os
import pickle
import sys
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import numpy as np
import zenoh
from zenoh import ext

from benchmarks import ROOT
from benchmarks.ros2_parts.all_topics import CONFIG, RATES, Maker, compared
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import WallClock, run_wall
from monstertruck_runtime.errors import NotFoundError, TruckError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics as t
from monstertruck_schemas.event import Severity
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.state import ClockOffset
from monstertruckd.ros2.cdr import encode
from monstertruckd.ros2.rmw import Attachment, data_key
from monstertruckd.ros2.zenoh_node import session_settings
from monstertruckd.tools.demo.runs import free_endpoint, write_overlay
from tests.bus_kit import Robot, gate_state, running_robot
from tests.daemon.wall_kit import kept_armed, planner_ready

PARTS = "benchmarks.ros2_parts"
ENDS = {"driven": 4, "cancelled": 5, "refused": 6}
"""Statuses of ``action_msgs`` with which goals are to end."""
GOALS = {
    "unequal": {},
    "silent": [],
    "least_rate": 0.9,
    "late_joiner_ms": 200.0,
    "cmd_vel_p50_ms": 12.0,
    "lease_s": 0.5,
    "hostile_passed": 0,
    "cpu_percent": 5.0,
    "goals": ENDS,
}
"""Goals of each face; ``least_rate`` is a least share, statuses and faults are exact, all others greatest values."""
TICKS = os.sysconf("SC_CLK_TCK")
TWIST = "geometry_msgs/msg/Twist"
DOMAIN = "77"
"""Domain of ROS 2 in which ``rclpy`` is judged."""


@asynccontextmanager
async def process(
    *words: str, folder: Path = ROOT, errors: int | None = None, environment: Mapping[str, str] | None = None
) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a process for the duration of the context."""
    pipe = asyncio.subprocess.PIPE
    running = await asyncio.create_subprocess_exec(
        *words, stdin=pipe, stdout=pipe, stderr=errors, cwd=folder, env=os.environ | (environment or {})
    )
    try:
        yield running
    finally:
        with suppress(ProcessLookupError):
            running.terminate()
        await running.wait()


def processor_seconds(pid: int) -> float:
    """Return the processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


async def connected(endpoint: str, clock: WallClock) -> TruckClient:
    """Return a client of the robot once its daemon answers."""
    while True:
        with suppress(TruckError):
            client = TruckClient("truck", endpoint, clock=clock, source="bench")
            await client.__aenter__()
            with suppress(NotFoundError):
                if await client.alive():
                    return client
            await client.__aexit__()
        await asyncio.sleep(0.5)


@dataclass(frozen=True, slots=True)
class Face:
    """A face, and the independent programs that judge it."""

    kind: str
    python: str
    """Interpreter of the face, and of its judges if it is ``rclpy``."""
    port: str
    """Port that nodes of the face ``zenoh`` dial."""

    @property
    def environment(self) -> dict[str, str]:
        """Environment of all processes."""
        path = ":".join(str(ROOT / part) for part in ("", "drivers", "planners", "schemas"))
        return {"PYTHONPATH": path, "ROS_DOMAIN_ID": DOMAIN} if self.kind == "rclpy" else {}

    @property
    def ros(self) -> str:
        """Endpoint of the face ``zenoh``."""
        return f"tcp/127.0.0.1:{self.port}"

    @asynccontextmanager
    async def serving(self, robot: str) -> AsyncIterator[asyncio.subprocess.Process]:
        """Run the face of a robot, once ROS 2 sees it."""
        own = ("--face", "rclpy") if self.kind == "rclpy" else ("--listen", self.ros)
        words = (self.python, "-m", "monstertruckd", "ros2", "--robot", f"truck@{robot}", *own)
        async with process(*words, errors=asyncio.subprocess.STDOUT, environment=self.environment) as face:
            assert face.stdout is not None
            while b"is node" not in (line := await face.stdout.readline()):
                assert line, "the face ended"
            rest = asyncio.create_task(face.stdout.read())
            await asyncio.sleep(2.0)  # discovery
            yield face
            rest.cancel()

    def judge(self, what: str, *words: str) -> Any:
        """Run a process that reads, drives by twists, or sends goals."""
        if self.kind == "rclpy":
            return process(self.python, "-m", f"{PARTS}.rclpy_judge", what, *words, environment=self.environment)
        names = {"read": "sdk_reader", "twists": "pyzeros_driver", "drive": "pyzeros_goals"}
        folder = Path(gettempdir()) / "pyzeros"  # it compiles in the folder that it runs in
        folder.mkdir(exist_ok=True)
        return process(
            self.python,
            "-m",
            f"{PARTS}.{names[what]}",
            self.port,
            *words,
            folder=folder,
            environment={"PYTHONPATH": python_path()},
        )


def python_path() -> str:
    """Return the import path for a process in another folder."""
    own = ":".join(str(ROOT / part) for part in ("", "drivers", "planners", "schemas"))
    return f"{own}:{os.environ.get('PYTHONPATH', '')}"


async def answered(judge: asyncio.subprocess.Process, line: str = "go") -> Any:
    """Start a ready judge; return the JSON of its last line."""
    text, _ = await judge.communicate(f"{line}\n".encode())
    return json.loads(text.splitlines()[-1])


async def ready(judge: asyncio.subprocess.Process) -> None:
    """Wait until a judge has finished loading and compiling."""
    assert judge.stdout is not None
    while (await judge.stdout.readline()).strip() != b"ready":
        pass


# A robot without devices


@dataclass(slots=True)
class StandIn:
    """A robot's bus without devices, with known messages and requests."""

    robot: Robot
    real_offset: int
    sources: dict[t.Topic[Any], list[Any]] = field(default_factory=lambda: {topic: [] for topic in (*RATES, t.EVENT)})


@asynccontextmanager
async def stand_in(clock: WallClock) -> AsyncIterator[StandIn]:
    """Run a robot that publishes every topic."""
    async with running_robot() as robot:
        found = StandIn(robot, clock.real_offset())
        gate, offset = (robot.bus.publisher(topic, topic.writer) for topic in (t.GATE, t.CLOCK))
        config, maker = CONFIG.model_dump(mode="json"), Maker(1)

        async def tell(_: dict[str, Any]) -> dict[str, Any]:
            return config

        async def live() -> None:
            while True:
                now = clock.now()
                gate.put(gate_state(gate.next_seq()).model_copy(update={"stamp": now, "received": now}))
                offset.put(ClockOffset(stamp=now, received=now, seq=offset.next_seq(), offset=found.real_offset))
                await asyncio.sleep(0.1)

        async def report() -> None:
            tell_event = robot.bus.event_sink()
            while True:
                tell_event(Reason.BUSY, Severity.WARNING, "gate", f"event at {clock.now()}")
                await asyncio.sleep(1.0)

        async def publish(topic: t.Topic[Any], rate: float) -> None:
            publisher = robot.bus.publisher(topic, topic.writer)
            while True:
                message = maker.message(topic, clock.now(), publisher.next_seq())
                found.sources[topic].append(message)
                publisher.put(message)
                await asyncio.sleep(1.0 / rate)

        robot.bus.listen(t.EVENT, found.sources[t.EVENT].append)
        robot.rpc.register("config", tell, AccessRole.OBSERVER)
        tasks = [
            *(asyncio.create_task(work()) for work in (live, report)),
            *(asyncio.create_task(publish(*row)) for row in RATES.items()),
        ]
        try:
            yield found
        finally:
            for task in tasks:
                task.cancel()


async def read_all(face: Face, scene: StandIn, pid: int, seconds: float, folder: Path) -> dict[str, Any]:
    """Return equality, rates and processor time of the face while a judge reads all topics."""
    output = folder / f"{face.kind}.pickle"
    async with face.judge("read", str(seconds), str(output)) as reader:
        await asyncio.sleep(6.0)  # until it has subscribed to everything
        begin, busy = time.monotonic(), processor_seconds(pid)
        await asyncio.sleep(max(seconds - 8.0, 1.0))
        cpu = 100.0 * (processor_seconds(pid) - busy) / (time.monotonic() - begin)
        await reader.wait()
    ros = pickle.loads(output.read_bytes())
    return compared(ros, scene.sources, scene.real_offset) | {"cpu_percent": round(cpu, 2)}


async def timed(face: Face, scene: StandIn) -> dict[str, Any]:
    """Return the latency of twists to the robot's bus."""
    requests = scene.robot.bus.subscribe(t.REQ_DRIVE, fifo(10_000))
    async with face.judge("twists", "200") as driver:
        await ready(driver)
        sent = await answered(driver)
    arrived = {round(r.twist.vx, 7): r.received + scene.real_offset for r in requests.drain() if r.twist is not None}
    requests.close()
    delays = [(arrived[round(s, 7)] - at) / 1e6 for s, at in sent if round(s, 7) in arrived]
    return {
        "twists": f"{len(delays)} of {len(sent)}",
        "cmd_vel_p50_ms": round(float(np.median(delays)), 2) if delays else math.inf,
        "cmd_vel_p99_ms": round(float(np.percentile(delays, 99)), 2) if delays else math.inf,
    }


def late_joiner(ros: str) -> float:
    """Return the time (ms) until map, static transforms and description are received."""
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_settings(ros, ""))))
    wanted = {
        "/map": "nav_msgs/msg/OccupancyGrid",
        "/tf_static": "tf2_msgs/msg/TFMessage",
        "/robot_description": "std_msgs/msg/String",
    }
    found: dict[str, float] = {}
    begin = time.monotonic()
    kept = []
    for topic, kind in wanted.items():

        def take(_: zenoh.Sample, topic: str = topic) -> None:
            found.setdefault(topic, time.monotonic() - begin)

        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        kept.append(ext.declare_advanced_subscriber(session, data_key(0, topic, kind), take, history=history))
    while len(found) < len(wanted) and time.monotonic() - begin < 5.0:
        time.sleep(0.005)
    session.close()
    return 1e3 * max(found.values()) if len(found) == len(wanted) else math.inf


HOSTILE = 0.2
"""Speed of every hostile twist, m/s."""


def attack(ros: str, known: bytes, seconds: float) -> int:
    """Send twists with unknown identities, repeated numbers of a known one, and old stamps; return their number."""
    key, data = data_key(0, "/cmd_vel", TWIST), encode(TWIST, {"linear": {"x": HOSTILE}})
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_settings(ros, ""))))
    random, sent = np.random.default_rng(1), 0
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        now = time.time_ns()
        unknown, again = (sent + 10**6, now, random.bytes(16)), (1, now, known)
        for number, stamp, gid in (unknown, again, (10**9, now - 10**10, known)):
            session.put(key, data, attachment=Attachment(number, stamp, gid).packed())
            sent += 1
    session.close()
    return sent


async def attacked_by_zenoh(face: Face, driver: asyncio.subprocess.Process, seconds: float) -> int:
    """Attack under the identity of a driver and others."""
    listener = zenoh.open(zenoh.Config.from_json5(json.dumps(session_settings(face.ros, ""))))
    gids: list[bytes] = []
    key = data_key(0, "/cmd_vel", TWIST)
    listener.declare_subscriber(key, lambda s: gids.append(Attachment.parse(s.attachment.to_bytes()).gid))
    driving = asyncio.create_task(answered(driver))
    while not gids:
        await asyncio.sleep(0.05)
    await asyncio.to_thread(listener.close)
    sent = await asyncio.to_thread(attack, face.ros, gids[-1], seconds)
    await driving
    return sent


async def hostile(face: Face, scene: StandIn, seconds: float = 5.0) -> dict[str, Any]:
    """Return the number of hostile twists that reached the robot beside those of a driver."""
    requests = scene.robot.bus.subscribe(t.REQ_DRIVE, fifo(100_000))
    async with face.judge("twists", str(int(seconds * 20))) as driver:
        await ready(driver)
        if face.kind == "rclpy":
            async with face.judge("hostile", str(seconds)) as attacker:
                await ready(attacker)
                sent, _ = await asyncio.gather(answered(attacker), answered(driver))
        else:
            sent = await attacked_by_zenoh(face, driver, seconds)
    found = [request.twist.vx for request in requests.drain() if request.twist is not None]
    requests.close()
    passed = sum(speed == HOSTILE for speed in found)
    return {
        "hostile_per_s": round(sent / seconds),
        "hostile_passed": passed,
        "twists_beside_the_hostile": len(found) - passed,
    }


async def late(face: Face) -> float:
    """Return the time (ms) until a late node has the latched topics."""
    if face.kind == "zenoh":
        return await asyncio.to_thread(late_joiner, face.ros)
    async with face.judge("late") as judge:
        return float(await answered(judge))


async def beside_a_stand_in(clock: WallClock, face: Face, seconds: float, folder: Path) -> dict[str, Any]:
    """Return all figures of a face that need no devices."""
    async with stand_in(clock) as scene, face.serving(scene.robot.endpoint) as serving:
        figures = await read_all(face, scene, serving.pid, seconds, folder)
        show(figures)
        figures["late_joiner_ms"] = round(await late(face), 1)
        figures |= await timed(face, scene)
        figures |= await hostile(face, scene)
    show(figures)
    return figures


def show(figures: dict[str, Any]) -> None:
    """Print figures as they become available."""
    print(json.dumps(figures, default=str), file=sys.stderr, flush=True)


# An emulated robot


async def held(face: Face, client: TruckClient) -> dict[str, Any]:
    """Return the holder of the drive during twists, and how long the last message was valid."""
    offset = (await client.get_retained(t.CLOCK)).offset
    gate = client.subscribe(t.GATE, fifo(100_000))
    async with face.judge("twists", "60") as driver:
        await ready(driver)
        await client.order(Order.ARM)
        sent = await answered(driver)
    holders = [(state.stamp + offset, state.holder) for state in gate.drain()]
    gate.close()
    last = sent[-1][1]
    ended = next((at for at, holder in holders if at > last and holder is None), math.inf)
    return {"holders": sorted({holder for _, holder in holders if holder}), "lease_s": round((ended - last) / 1e9, 2)}


async def ahead(client: TruckClient, *distances: float) -> list[list[float]]:
    """Return poses at these distances ahead of the robot: m, m, rad."""
    async for message in client.subscribe(t.POSE, latest()):
        place = message.pose
        break
    return [[place.x + d * math.cos(place.yaw), place.y + d * math.sin(place.yaw), place.yaw] for d in distances]


async def driven(face: Face, client: TruckClient) -> dict[str, Any]:
    """Run goals by actions, and the judge's other tests."""
    async with kept_armed(client), face.judge("drive") as judge:
        if face.kind == "rclpy":
            return dict(await answered(judge))
        await ready(judge)
        return {"actions": await answered(judge, json.dumps(await ahead(client, 0.5, 0.9)))}


async def with_a_robot(clock: WallClock, faces: list[Face], folder: Path) -> dict[str, dict[str, Any]]:
    """Return all figures that need a driving robot, by face."""
    endpoint, found = free_endpoint(), {}
    config = write_overlay(ROOT / "configs" / "explore.yaml", folder, endpoint)
    program = (sys.executable, "-m", "monstertruckd")
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(process(*program, "simulate", "--config", str(config)))
        await stack.enter_async_context(process(*program, "run", "--config", str(config)))
        client = await connected(endpoint, clock)
        stack.push_async_callback(client.__aexit__, None, None, None)
        await planner_ready(client)
        for face in faces:
            with suppress(TruckError):
                await client.order(Order.RESET)
            async with face.serving(endpoint):
                figures = await held(face, client)
                show(figures)
                figures |= await driven(face, client)
            ends = {name: status for name, (status, *_) in figures["actions"].items()}
            figures["goals"] = {name: ends.get(name) for name in ENDS}
            show(figures)
            found[face.kind] = figures
    return found


async def measure(clock: WallClock, folder: Path, options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Return all figures by face."""
    port = free_endpoint().rpartition(":")[2]
    faces = [Face("zenoh", sys.executable, port)]
    faces += [] if options.rclpy is None else [Face("rclpy", options.rclpy, port)]
    faces = [face for face in faces if options.face in ("all", face.kind)]
    figures: dict[str, dict[str, Any]] = {face.kind: {} for face in faces}
    if options.parts != "robot":
        for face in faces:
            figures[face.kind] |= await beside_a_stand_in(clock, face, options.seconds, folder)
    if options.parts != "stand-in":
        for kind, row in (await with_a_robot(clock, faces, folder)).items():
            figures[kind] |= row
    return figures


def missed(figures: dict[str, Any]) -> list[str]:
    """Return the goals that a face does not meet, or that were not measured."""
    found = []
    for name, goal in GOALS.items():
        value = figures.get(name)
        if isinstance(goal, float | int) and isinstance(value, float | int):
            good = value >= goal if name == "least_rate" else value <= goal
        else:
            good = value == goal
        found += [] if good else [name]
    return found


def main() -> int:
    """Measure; 0: all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=25.0, help="of reading all topics")
    parser.add_argument("--rclpy", metavar="PYTHON")
    parser.add_argument("--parts", choices=("all", "stand-in", "robot"), default="all")
    parser.add_argument("--face", choices=("all", "zenoh", "rclpy"), default="all")
    options = parser.parse_args()
    with TemporaryDirectory(prefix="ros2-") as folder:
        figures = run_wall(lambda clock: measure(clock, Path(folder), options))
    lacking = {kind: names for kind, row in figures.items() if (names := missed(row))}
    met = not lacking and len(figures) == 2  # both faces
    print(json.dumps({"bench": "ros2", "figures": figures, "goals": GOALS, "missed": lacking, "met": met}, default=str))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
