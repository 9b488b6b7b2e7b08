"""A fleet behind one router: delay that the router adds, processor time and bytes of each robot, loss of the router.

    python -m benchmarks.fleet [--robots 20] [--seconds 30] [--quick]

Robots publish every topic that a page shows at its nominal rate and size (``station_parts/published.py``), each with a
session, a certificate and a liveliness token of its own; five of them share a process. The router is a session of
zenoh-python with the configuration that ``security router`` makes. A page follows one robot and looks at all of them; a
recorder takes everything of all. The added delay is that of one message by way of the router against the same one from
the robot's own endpoint. Then the router is killed and started again. The last line is JSON.
"""

import argparse
import asyncio
import contextlib
import json
import os
import sys
import time
from contextlib import AsyncExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import aiohttp
import numpy as np
import zenoh

from benchmarks.station import cpu
from benchmarks.station_parts import published
from monstertruck_runtime.clock import SECOND, Clock, WallClock, run_wall
from monstertruck_runtime.stations import TLS_VARIABLE, ClientTls, session_config
from monstertruck_schemas.req import Role
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.topics import KEY_ROOT, POSE, SCAN
from monstertruckd.bus.access import out_groups
from monstertruckd.bus.zenoh_config import ZenohConfig
from monstertruckd.tools.demo.runs import free_endpoint
from monstertruckd.tools.security.folder import Folder
from monstertruckd.tools.security.router import make_router

ROOT = Path(__file__).parents[1]
GOALS = {"added_delay_p99_ms": 10.0, "seen_again_s": 10.0}
TOGETHER = 5
STATION = "page"


def publish(files: list[Path]) -> None:
    """Robots of one process, by their configurations."""

    async def all_of_them(clock: Clock) -> None:
        await asyncio.gather(
            *(
                published.main(ZenohConfig.model_validate_json(file.read_text(), strict=False), file.stem, clock)
                for file in files
            )
        )

    run_wall(all_of_them)


def route(file: Path) -> None:
    """The router, until standard input ends."""
    with zenoh.open(zenoh.Config.from_json5(file.read_text())):
        print("ready", flush=True)
        sys.stdin.read()


def prepare(folder: Path, count: int) -> tuple[list[Path], Path, str]:
    """Certificates of all; configurations of the robots and of the router, and its endpoint."""
    now = (WallClock().now() + WallClock().real_offset()) // SECOND
    endpoint = free_endpoint().replace("tcp/", "tls/")
    robots = [Folder(folder / f"robot{number}") for number in range(count)]
    for number, robot in enumerate(robots):
        robot.init(f"robot{number}", ("127.0.0.1",), robot.robot, now)
        robot.add(STATION, AccessRole.PILOT, Role.STATION, now)
    place = folder / "router" / "router"
    make_router(folder / "router", robots, ("127.0.0.1",), now, place, int(endpoint.rpartition(":")[2]))
    files = []
    for number, robot in enumerate(robots):
        settings = robot.zenoh().model_dump(mode="json") | {"listen_pilots": [], "local_socket": False}
        settings["listen"] = [free_endpoint().replace("tcp/", "tls/")]
        files.append(folder / f"robot{number}.json")
        files[-1].write_text(json.dumps(settings))
    return files, place / "zenoh.json5", endpoint


def station_files(folder: Path, number: int) -> ClientTls:
    """Certificate of the page as a robot made it."""
    own = folder / f"robot{number}" / "stations" / STATION
    return ClientTls(ca=own / "ca.pem", certificate=own / "station.pem", key=own / "station.key")


class Heard:
    """When which message came, by sequence number; and how many bytes of each robot."""

    def __init__(self) -> None:
        self.at: dict[bytes, int] = {}
        self.bytes: dict[str, int] = {}

    def pose(self, sample: zenoh.Sample) -> None:
        """A message of the robot that is measured; its bytes tell it from others."""
        self.at[sample.payload.to_bytes()] = time.monotonic_ns()

    def count(self, sample: zenoh.Sample) -> None:
        """Any message."""
        robot = str(sample.key_expr).split("/")[1]
        self.bytes[robot] = self.bytes.get(robot, 0) + len(sample.payload)


@contextlib.asynccontextmanager
async def process(*words: str, ready: int, environment: dict[str, str] | None = None) -> Any:
    """A process, once it has said so often that it is ready; what it prints later is thrown away."""
    pipe = asyncio.subprocess.PIPE
    running = await asyncio.create_subprocess_exec(
        sys.executable, "-m", *words, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=asyncio.subprocess.STDOUT,
        env={**os.environ, **(environment or {})},
    )  # fmt: skip
    assert running.stdout is not None
    while ready:
        line = (await running.stdout.readline()).decode()
        assert line, f"{words} ended"
        ready -= "ready" in line or "station:" in line
    reading = asyncio.create_task(_drain(running.stdout))
    try:
        yield running
    finally:
        with contextlib.suppress(ProcessLookupError):
            running.kill()
        await running.wait()
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)


async def _drain(stream: asyncio.StreamReader) -> None:
    while await stream.readline():
        pass


async def page(url: str, rows: list[dict[str, Any]]) -> None:
    """A browser that follows the first robot and looks at the fleet."""
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


async def until(condition: Any, seconds: float) -> float:
    """Seconds until a condition holds; infinite if it does not in time."""
    began = time.monotonic()
    while time.monotonic() - began < seconds:
        if condition():
            return time.monotonic() - began
        await asyncio.sleep(0.05)
    return float("inf")


async def measure(folder: Path, count: int, seconds: float) -> dict[str, Any]:
    """Everything."""
    files, config, endpoint = await asyncio.to_thread(prepare, folder, count)
    figures: dict[str, Any] = {"robots": count, "load_average": os.getloadavg()[0]}
    router_words = ("benchmarks.fleet", "--route", str(config))
    port = free_endpoint().rpartition(":")[2]
    async with AsyncExitStack() as stack, AsyncExitStack() as routed:
        router = await routed.enter_async_context(process(*router_words, ready=1))
        batches = [files[n : n + TOGETHER] for n in range(0, count, TOGETHER)]
        robots = [
            await stack.enter_async_context(
                process("benchmarks.fleet", "--publish", *map(str, batch), ready=len(batch))
            )
            for batch in batches
        ]
        tls = station_files(folder, 0)
        environment = {TLS_VARIABLE: str(tls.certificate.parent)}
        words = ("monstertruckd", "station", "--router", endpoint, "--port", port)
        station = await stack.enter_async_context(process(*words, ready=1, environment=environment))
        rows: list[dict[str, Any]] = []
        looking = asyncio.create_task(page(f"http://127.0.0.1:{port}/", rows))
        figures["all_on_the_page_s"] = round(await until(lambda: sum(r["alive"] for r in rows) == count, 60), 1)

        heard, direct, routed_poses = Heard(), Heard(), Heard()
        own = json.loads(files[0].read_text())["listen"][0]
        sessions = [await asyncio.to_thread(_open, end, tls) for end in (endpoint, endpoint, own)]
        recorder, by_router, by_robot = sessions
        robot_names = [file.stem for file in files]
        for robot in robot_names:
            for group in out_groups():
                recorder.declare_subscriber(f"{KEY_ROOT}/{robot}/{group}/**", heard.count)
        for topic in (POSE, SCAN):
            by_router.declare_subscriber(topic.key("robot0"), routed_poses.pose)
            by_robot.declare_subscriber(topic.key("robot0"), direct.pose)
        await asyncio.sleep(3.0)
        heard.bytes.clear()
        processes = {"router": [router], "robots": robots, "station": [station]}
        before = {name: sum(cpu(each.pid) for each in group) for name, group in processes.items()}
        began = time.monotonic()
        await asyncio.sleep(seconds)
        elapsed = time.monotonic() - began
        used = {
            name: 100 * (sum(cpu(each.pid) for each in group) - before[name]) / elapsed
            for name, group in processes.items()
        }
        added = [1e-6 * (routed_poses.at[key] - at) for key, at in direct.at.items() if key in routed_poses.at]
        rate = [heard.bytes.get(robot, 0) / elapsed / 1000 for robot in robot_names]
        figures |= {
            "messages_compared": len(added),
            "added_delay_p50_ms": round(float(np.median(added)), 2),
            "added_delay_p99_ms": round(float(np.percentile(added, 99)), 2),
            "cpu_percent_per_robot": round(used["robots"] / count, 1),
            "cpu_percent_router_per_robot": round(used["router"] / count, 1),
            "cpu_percent_station": round(used["station"], 1),
            "kb_s_per_robot": round(float(np.mean(rate)), 1),
            "kb_s_least_and_most": [round(min(rate), 1), round(max(rate), 1)],
        }

        direct.at.clear()
        await routed.aclose()
        figures["gone_after_s"] = round(await until(lambda: not any(r["alive"] for r in rows), 30), 1)
        without = len(direct.at)
        await asyncio.sleep(2.0)
        figures["robots_publish_on_without_router"] = len(direct.at) > without
        await stack.enter_async_context(process(*router_words, ready=1))
        figures["seen_again_s"] = round(await until(lambda: sum(r["alive"] for r in rows) == count, 60), 1)
        looking.cancel()
        await asyncio.gather(looking, return_exceptions=True)
        for session in sessions:
            await asyncio.to_thread(session.close)
    return figures


def _open(endpoint: str, tls: ClientTls) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(endpoint, 5.0, tls))))


def main() -> int:
    """Measure; 0 = all goals met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--quick", action="store_true", help="4 robots, 6 s")
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
    with TemporaryDirectory(prefix="fleet-") as folder:
        figures = asyncio.run(measure(Path(folder), count, seconds))
    for name, value in figures.items():
        print(f"{name:34} {value}")
    met = (
        figures["added_delay_p99_ms"] <= GOALS["added_delay_p99_ms"]
        and figures["seen_again_s"] <= GOALS["seen_again_s"]
        and figures["robots_publish_on_without_router"]
    )
    print(json.dumps({"bench": "fleet", "figures": figures, "goals": GOALS, "met": bool(met)}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
