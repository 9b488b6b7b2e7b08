"""The robot as a ROS 2 node, judged by programs that others wrote.

    python -m benchmarks.ros2 [--seconds S] [--rclpy PYTHON]

An emulated robot that explores (``configs/explore.yaml``), its daemon and ``monstertruckd ros2``, each a process.

- ``zenoh-ros2-sdk`` reads all topics; their values are compared with the robot's own messages by stamp.
- An AdvancedSubscriber of zenoh-python with the options of ``rmw_zenoh`` comes late.
- ``pyzeros`` drives: who holds the drive, and how long the last message stands. Each twist is timed, too, from its
  sending to its request on the bus of a robot without devices.
- A hostile publisher sends to that robot for five seconds as fast as it can, beside ``pyzeros``: unknown identities,
  repetitions, old stamps.
- Goals of ``navigate_to_pose`` are driven, cancelled, and refused for their reason; poses are driven through by
  ``navigate_through_poses``, and a path is followed backward by ``follow_path``.
- ``--rclpy``: a Python with the wheels of ROS 2 (``ros-jazzy-rclpy[fastrtps]`` and messages, on Python 3.12) and this
  program's own libraries. There the face ``rclpy`` runs, and a node of ``rclpy`` reads, arms, drives, sends a goal and
  stops. Without it this part is not measured.
"""

import argparse
import asyncio
import json
import math
import os
import pickle
import sys
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import numpy as np
import zenoh
from zenoh import ext

from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, WallClock, run_wall
from monstertruck_runtime.errors import NotFoundError, TruckError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics as t
from monstertruck_schemas.req import Order
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.state import ClockOffset
from monstertruckd.config.load import load_truck
from monstertruckd.ros2.cdr import encode
from monstertruckd.ros2.rmw import Attachment, data_key
from monstertruckd.ros2.zenoh_node import session_settings
from monstertruckd.tools.demo.runs import free_endpoint, write_overlay
from tests.bus_kit import gate_state, running_robot
from tests.daemon.wall_kit import kept_armed, planner_ready
from tests.ros2_kit import ServiceClient

ROOT = Path(__file__).parents[1]
PARTS = Path(__file__).parent / "ros2_parts"
GOALS = {
    "unequal": 0,
    "least_rate": 0.9,
    "late_joiner_ms": 200.0,
    "cmd_vel_p50_ms": 12.0,
    "lease_s": 0.5,
    "hostile_passed": 0,
    "cpu_percent": 5.0,
    "goal": "driven, cancelled, refused, through, followed",
}
TICKS = os.sysconf("SC_CLK_TCK")
ACTIONS = {
    "/navigate_to_pose/_action": "nav2_msgs/action/NavigateToPose",
    "/navigate_through_poses/_action": "nav2_msgs/action/NavigateThroughPoses",
    "/follow_path/_action": "nav2_msgs/action/FollowPath",
}
TWIST = "geometry_msgs/msg/Twist"


@asynccontextmanager
async def process(*words: str, folder: Path = ROOT, **environment: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """A process that is ended at the end."""
    pipe = asyncio.subprocess.PIPE
    running = await asyncio.create_subprocess_exec(
        *words, stdin=pipe, stdout=pipe, stderr=asyncio.subprocess.DEVNULL, cwd=folder, env=os.environ | environment
    )
    try:
        yield running
    finally:
        with suppress(ProcessLookupError):
            running.terminate()
        await running.wait()


def processor_seconds(pid: int) -> float:
    """Processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


async def connected(endpoint: str, clock: WallClock) -> TruckClient:
    """A client of the robot, once its daemon answers."""
    while True:
        with suppress(TruckError):
            client = TruckClient("truck", endpoint, clock=clock, source="bench")
            await client.__aenter__()
            with suppress(NotFoundError):
                if await client.alive():
                    return client
            await client.__aexit__()
        await asyncio.sleep(0.5)


# Values


def yaw(orientation: dict[str, float]) -> float:
    """Heading, rad."""
    return 2.0 * math.atan2(orientation["z"], orientation["w"])


def scan_values(m: dict[str, Any]) -> list[Any]:
    return [m["angle_min"], m["angle_max"], m["range_max"], *m["ranges"]]


def scan_source(m: Any) -> list[Any]:
    known = np.where((m.codes == 255) | (m.codes <= 2), m.ranges, np.nan)
    return [m.start_angle, m.end_angle, m.range_max, *known]


def pose_values(m: dict[str, Any]) -> list[Any]:
    place, covariance = m["pose"]["pose"], m["pose"]["covariance"]
    position = place["position"]
    return [position["x"], position["y"], yaw(place["orientation"]), covariance[0], covariance[7], covariance[35]]


def pose_source(m: Any) -> list[Any]:
    covariance = m.pose_covariance
    return [m.pose.x, m.pose.y, math.remainder(m.pose.yaw, math.tau), covariance[0], covariance[4], covariance[8]]


def odom_values(m: dict[str, Any]) -> list[Any]:
    twist = m["twist"]["twist"]
    return [*pose_values(m), twist["linear"]["x"], twist["linear"]["y"], twist["angular"]["z"]]


def odom_source(m: Any) -> list[Any]:
    return [*pose_source(m), m.twist.vx, m.twist.vy, m.twist.wz]


def battery_values(m: dict[str, Any]) -> list[Any]:
    return [m["voltage"], m["percentage"], m["design_capacity"]]


def battery_source(m: Any) -> list[Any]:
    return [math.nan if value is None else value for value in (m.voltage, m.charge, m.capacity_ah)]


def map_values(m: dict[str, Any]) -> list[Any]:
    info = m["info"]
    return [info["resolution"], info["width"], info["height"], info["origin"]["position"]["x"], *m["data"]]


def map_source(m: Any) -> list[Any]:
    return [m.resolution, m.width, m.height, m.origin.x, *m.cells]


def path_values(m: dict[str, Any]) -> list[Any]:
    poses = [row["pose"] for row in m["poses"]]
    return [n for p in poses for n in (p["position"]["x"], p["position"]["y"], yaw(p["orientation"]))]


def path_source(m: Any) -> list[Any]:
    return [n for x, y, turn in m.poses.reshape(-1, 3) for n in (x, y, math.remainder(turn, math.tau))]


COMPARED: dict[str, Any] = {
    "/scan": (t.SCAN, scan_values, scan_source),
    "/odom": (t.ODOMETRY, odom_values, odom_source),
    "/pose": (t.POSE, pose_values, pose_source),
    "/battery_state": (t.BATTERY, battery_values, battery_source),
    "/map": (t.MAP, map_values, map_source),
    "/plan": (t.PATH, path_values, path_source),
}
CHANGED_ONLY = {"/map", "/plan"}


def compared(ros: dict[str, list[Any]], sources: dict[str, list[Any]], offset: int) -> dict[str, Any]:
    """Messages with a source of the same stamp, those that differ, and the share of the sources that came."""
    figures: dict[str, Any] = {"messages": {}, "unequal": 0, "unmatched": 0, "least_rate": 1.0}
    for topic, (_, values, source_values) in COMPARED.items():
        by_stamp = {m.stamp: m for m in sources[topic]}
        stamps = np.array(sorted(by_stamp))
        matched = 0
        for message in ros.get(topic, []):
            stamp = message["header"]["stamp"]
            own = stamp["sec"] * SECOND + stamp["nanosec"] - offset
            nearest = int(stamps[np.abs(stamps - own).argmin()]) if len(stamps) else 0
            if abs(nearest - own) > 2_000_000:  # the face follows the offset in steps of 1 ms
                figures["unmatched"] += 1
                continue
            matched += 1
            found, expected = (np.array(part, float) for part in (values(message), source_values(by_stamp[nearest])))
            same = found.shape == expected.shape and np.allclose(found, expected, rtol=1e-6, atol=1e-6, equal_nan=True)
            figures["unequal"] += not same
        figures["messages"][topic] = [matched, len(stamps)]
        if topic not in CHANGED_ONLY and len(stamps):
            figures["least_rate"] = round(min(figures["least_rate"], matched / len(stamps)), 3)
    return figures


class Sources:
    """The robot's own messages."""

    def __init__(self, client: TruckClient) -> None:
        self._mailboxes = {topic: client.subscribe(row[0], fifo(100_000)) for topic, row in COMPARED.items()}

    def drained(self) -> dict[str, list[Any]]:
        """All that came since the last call, by topic of ROS 2."""
        return {topic: mailbox.drain() for topic, mailbox in self._mailboxes.items()}


async def read_by_sdk(client: TruckClient, face: Any, port: int, seconds: float, folder: Path) -> dict[str, Any]:
    """Equality, rates and processor time of the face while the SDK reads all."""
    offset = (await client.get_retained(t.CLOCK)).offset
    sources = Sources(client)
    output = folder / "sdk.pickle"
    async with process(sys.executable, str(PARTS / "sdk_reader.py"), str(port), str(seconds), str(output)) as reader:
        await asyncio.sleep(4.0)  # until it has subscribed to everything
        begin, busy = time.monotonic(), processor_seconds(face.pid)
        await asyncio.sleep(seconds - 6.0)
        cpu = 100.0 * (processor_seconds(face.pid) - busy) / (time.monotonic() - begin)
        await reader.wait()
    ros = pickle.loads(output.read_bytes())
    first = min(m["header"]["stamp"]["sec"] for m in ros["/odom"]) + 1
    last = max(m["header"]["stamp"]["sec"] for m in ros["/odom"]) - 1
    within = {
        topic: [m for m in rows if topic in CHANGED_ONLY or first <= m["header"]["stamp"]["sec"] < last]
        for topic, rows in ros.items()
        if topic in COMPARED
    }
    known = {
        topic: [m for m in rows if topic in CHANGED_ONLY or first <= (m.stamp + offset) // SECOND < last]
        for topic, rows in sources.drained().items()
    }
    figures = compared(within, known, offset)
    figures["others"] = {topic: len(rows) for topic, rows in ros.items() if topic not in COMPARED}
    return figures | {"cpu_percent": round(cpu, 2)}


def late_joiner(ros: str) -> float:
    """Milliseconds until map, fixed transforms and description are there."""
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


# Requests


@asynccontextmanager
async def pyzeros(port: int, count: int) -> AsyncIterator[asyncio.subprocess.Process]:
    """A driver that has compiled what it needs, and begins when it is sent a line."""
    compiled = Path(gettempdir()) / "pyzeros"  # which it compiles in the folder that it runs in
    compiled.mkdir(exist_ok=True)
    words = (sys.executable, str(PARTS / "pyzeros_driver.py"), str(port), str(count))
    async with process(*words, folder=compiled) as driver:
        assert driver.stdout is not None
        assert (await driver.stdout.readline()).strip() == b"ready"
        yield driver


async def sent_by(driver: asyncio.subprocess.Process) -> list[tuple[float, int]]:
    """Have it begin; returns speeds and times of sending once it has sent all."""
    text, _ = await driver.communicate(b"go\n")
    rows: list[tuple[float, int]] = json.loads(text.splitlines()[-1])
    return rows


async def driven_by_pyzeros(client: TruckClient, port: int) -> dict[str, Any]:
    """Who held the drive, and how long the last message stood."""
    offset = (await client.get_retained(t.CLOCK)).offset
    gate = client.subscribe(t.GATE, fifo(100_000))
    async with pyzeros(port, 60) as driver:
        await client.order(Order.ARM)
        sent = await sent_by(driver)
    holders = [(state.stamp + offset, state.holder) for state in gate.drain()]
    gate.close()
    last = sent[-1][1]
    ended = next((at for at, holder in holders if at > last and holder is None), math.inf)
    return {"holders": sorted({holder for _, holder in holders if holder}), "lease_s": round((ended - last) / 1e9, 2)}


HOSTILE = 0.2
"""Speed of every hostile twist, m/s."""


@asynccontextmanager
async def stand_in(clock: WallClock) -> AsyncIterator[tuple[Any, str]]:
    """A robot's bus without devices, whose requests can be timed, and the endpoint of its face for ROS 2."""
    ros = free_endpoint()
    async with running_robot() as robot:
        gate, offset = (robot.bus.publisher(topic, topic.writer) for topic in (t.GATE, t.CLOCK))
        config = load_truck(ROOT / "configs" / "demo.yaml")[0].model_dump(mode="json")

        async def tell(_: dict[str, Any]) -> dict[str, Any]:
            return config

        async def live() -> None:
            while True:
                now = clock.now()
                gate.put(gate_state(gate.next_seq()).model_copy(update={"stamp": now, "received": now}))
                real = clock.real_offset()
                offset.put(ClockOffset(stamp=now, received=now, seq=offset.next_seq(), offset=real))
                await asyncio.sleep(0.1)

        robot.rpc.register("config", tell, AccessRole.OBSERVER)
        living = asyncio.create_task(live())
        words = ("-m", "monstertruckd", "ros2", "--robot", f"truck@{robot.endpoint}", "--listen", ros)
        async with process(sys.executable, *words):
            await asyncio.sleep(6.0)
            yield robot, ros
        living.cancel()


async def timed(robot: Any, port: int, real_offset: int) -> dict[str, Any]:
    """Latency of twists of ``pyzeros`` up to the robot's bus."""
    requests = robot.bus.subscribe(t.REQ_DRIVE, fifo(10_000))
    async with pyzeros(port, 200) as driver:
        sent = await sent_by(driver)
    arrived = {round(r.twist.vx, 7): r.received + real_offset for r in requests.drain() if r.twist is not None}
    requests.close()
    delays = [(arrived[round(s, 7)] - at) / 1e6 for s, at in sent if round(s, 7) in arrived]
    return {
        "twists": f"{len(delays)} of {len(sent)}",
        "cmd_vel_p50_ms": round(float(np.median(delays)), 2) if delays else math.inf,
        "cmd_vel_p99_ms": round(float(np.percentile(delays, 99)), 2) if delays else math.inf,
    }


async def hostile(robot: Any, ros: str, seconds: float = 5.0) -> dict[str, Any]:
    """Twists with unknown identities, repeated numbers of a known one and old stamps; how many reached the robot."""
    requests = robot.bus.subscribe(t.REQ_DRIVE, fifo(100_000))
    key, data = data_key(0, "/cmd_vel", TWIST), encode(TWIST, {"linear": {"x": HOSTILE}})
    listener = zenoh.open(zenoh.Config.from_json5(json.dumps(session_settings(ros, ""))))
    gids: list[bytes] = []
    listener.declare_subscriber(key, lambda s: gids.append(Attachment.parse(s.attachment.to_bytes()).gid))
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(session_settings(ros, ""))))
    random, sent = np.random.default_rng(1), 0

    def attack(known: bytes) -> None:
        nonlocal sent
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            now = time.time_ns()
            unknown, again = (sent + 10**6, now, random.bytes(16)), (1, now, known)
            for number, stamp, gid in (unknown, again, (10**9, now - 10**10, known)):
                session.put(key, data, attachment=Attachment(number, stamp, gid).packed())
                sent += 1

    async with pyzeros(int(ros.rpartition(":")[2]), int(seconds * 20)) as driver:
        known = gids[-1]
        await asyncio.to_thread(listener.close)
        sending = asyncio.create_task(sent_by(driver))
        await asyncio.sleep(0.5)
        await asyncio.to_thread(attack, known)
        await sending
    await asyncio.to_thread(session.close)
    found = [request.twist.vx for request in requests.drain() if request.twist is not None]
    requests.close()
    passed = sum(speed == HOSTILE for speed in found)
    return {
        "hostile_per_s": round(sent / seconds),
        "hostile_passed": passed,
        "twists_beside_the_hostile": len(found) - passed,
    }


async def goals(client: TruckClient, ros: str) -> dict[str, Any]:
    """Status and text of goals: driven, cancelled, without a route; of poses driven through and a path followed."""
    asker = ServiceClient(ros, "bench_nav")

    def pose(x: float, y: float, yaw: float) -> dict[str, Any]:
        turn = {"z": math.sin(yaw / 2.0), "w": math.cos(yaw / 2.0)}
        return {"header": {"frame_id": "map"}, "pose": {"position": {"x": x, "y": y}, "orientation": turn}}

    async def send(action: str, number: int, goal: dict[str, Any]) -> dict[str, Any]:
        uuid = {"uuid": bytes([number]) * 16}
        with suppress(TruckError):
            await client.order(Order.ARM)
        request = {"goal_id": uuid, "goal": goal}
        accepted = await asker.ask(f"{action}/send_goal", f"{ACTIONS[action]}_SendGoal", request)
        assert accepted["accepted"]
        return uuid

    async def result(action: str, uuid: dict[str, Any]) -> tuple[int, str]:
        answer = await asker.ask(f"{action}/get_result", f"{ACTIONS[action]}_GetResult", {"goal_id": uuid}, 90.0)
        return answer["status"], answer["result"]["error_msg"]

    async def done(action: str, number: int, goal: dict[str, Any]) -> tuple[int, str]:
        return await result(action, await send(action, number, goal))

    async def ahead(*distances: float) -> list[dict[str, Any]]:
        """Poses so far ahead of the robot, m."""
        async for message in client.subscribe(t.POSE, latest()):
            place = message.pose
            break
        return [
            pose(place.x + d * math.cos(place.yaw), place.y + d * math.sin(place.yaw), place.yaw) for d in distances
        ]

    to_pose, through, follow = ACTIONS
    near, far = await ahead(0.6, 1.1)
    found = {"driven": await done(to_pose, 1, {"pose": near})}
    uuid = await send(to_pose, 2, {"pose": far})
    await asyncio.sleep(1.5)
    info = {"goal_info": {"goal_id": uuid}}
    await asker.ask(f"{to_pose}/cancel_goal", "action_msgs/srv/CancelGoal", info)
    found["cancelled"] = await result(to_pose, uuid)
    found["refused"] = await done(to_pose, 3, {"pose": pose(80.0, 80.0, 0.0)})
    found["through"] = await done(through, 4, {"poses": [near, far]})
    rows = await ahead(*(-0.05 * step for step in range(10)))  # backward, where it has come from
    found["followed"] = await done(follow, 5, {"path": {"header": {"frame_id": "map"}, "poses": rows}})
    await asyncio.to_thread(asker.close)
    right = [status for status, _ in found.values()] == [4, 5, 6, 4, 4] and found["refused"][1]
    return {"goals": found, "goal": GOALS["goal"] if right else "no"}


async def judged_by_rclpy(client: TruckClient, endpoint: str, python: str, folder: Path) -> dict[str, Any]:
    """The face ``rclpy`` and a node of real ROS 2."""
    path = ":".join(str(ROOT / part) for part in ("", "drivers", "planners", "schemas"))
    offset = (await client.get_retained(t.CLOCK)).offset
    sources = Sources(client)
    with suppress(TruckError):
        await client.order(Order.RESET)
    words = (python, "-m", "monstertruckd", "ros2", "--robot", f"truck@{endpoint}", "--face", "rclpy", "--domain", "77")
    async with process(*words, PYTHONPATH=path) as face:
        await asyncio.sleep(8.0)
        output = folder / "rclpy.json"
        judge = (python, str(PARTS / "rclpy_judge.py"), "10", str(output))
        async with process(*judge, ROS_DOMAIN_ID="77") as judging:
            await judging.wait()
        cpu = processor_seconds(face.pid)
    found = json.loads(output.read_text())
    read = {topic: rows for topic, rows in found["topics"].items() if topic in COMPARED}
    figures = compared(read, sources.drained(), offset)
    counts = {topic: len(rows) for topic, rows in found["topics"].items()}
    return found["figures"] | {"unequal": figures["unequal"], "read": counts, "cpu_s": round(cpu, 1)}


async def measure(clock: WallClock, folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """All figures."""
    endpoint, ros = free_endpoint(), free_endpoint()
    config = write_overlay(ROOT / "configs" / "explore.yaml", folder, endpoint)
    program = (sys.executable, "-m", "monstertruckd")
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(process(*program, "simulate", "--config", str(config)))
        await stack.enter_async_context(process(*program, "run", "--config", str(config)))
        client = await connected(endpoint, clock)
        stack.push_async_callback(client.__aexit__, None, None, None)
        await planner_ready(client)
        face = await stack.enter_async_context(
            process(*program, "ros2", "--robot", f"truck@{endpoint}", "--listen", ros)
        )
        await asyncio.sleep(6.0)
        port = int(ros.rpartition(":")[2])
        figures = await read_by_sdk(client, face, port, options.seconds, folder)
        print(json.dumps(figures), file=sys.stderr)
        figures["late_joiner_ms"] = round(await asyncio.to_thread(late_joiner, ros), 1)
        figures |= await driven_by_pyzeros(client, port)
        print(json.dumps(figures), file=sys.stderr)
        async with kept_armed(client):
            figures |= await goals(client, ros)
        print(json.dumps(figures), file=sys.stderr)
        if options.rclpy is not None:
            figures["rclpy"] = await judged_by_rclpy(client, endpoint, options.rclpy, folder)
    async with stand_in(clock) as (robot, ros):
        figures |= await timed(robot, int(ros.rpartition(":")[2]), clock.real_offset())
        figures |= await hostile(robot, ros)
    return figures


def met(figures: dict[str, Any]) -> bool:
    """Whether every goal is."""
    above = {"least_rate"}
    return all(
        figures[name] == goal
        if isinstance(goal, str)
        else figures[name] >= goal
        if name in above
        else figures[name] <= goal
        for name, goal in GOALS.items()
    )


def main() -> int:
    """Measure; 0 = all goals are met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=25.0)
    parser.add_argument("--rclpy", metavar="PYTHON")
    options = parser.parse_args()
    with TemporaryDirectory(prefix="ros2-") as folder:
        figures = run_wall(lambda clock: measure(clock, Path(folder), options))
    result = {"bench": "ros2", "figures": figures, "goals": GOALS, "met": met(figures)}
    if options.rclpy is None:
        result["not_measured"] = ["rclpy"]
    print(json.dumps(result, default=str))
    return 0 if result["met"] else 1


if __name__ == "__main__":
    sys.exit(main())
