"""Five robots and three people in one world: every robot drives from place to place by moves, for ten minutes.

    python -m benchmarks.fleet_world              one simulator process, a daemon process for each robot, real time
    python -m benchmarks.fleet_world --virtual    the same daemons on one virtual clock, as fast as it computes

Robots do not know each other's plans. Of the places that are drawn for it a robot takes the first of the next few to
which the straight line leads past nobody it hears. Each hears where the others say that they are (``peers``), which
counts behind it, where its lidar of 240 degrees sees nobody; it stops before what it sees and hears. Of those that are
near to each other one has the right of way, for a minute each in turn: it waits, and the others drive away from those
near them. Before people, and where that fails, a robot waits a time drawn by its seed, turns or drives elsewhere, and
tries again; where it cannot turn it drives on a little, else it backs up, where its lidar does not look, only as far
as it must to turn.
Contacts in which a robot moves count against the goal; people who walk into a standing one are counted apart.
"""

import argparse
import asyncio
import contextlib
import json
import math
import re
import sys
from collections import Counter
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any

import numpy as np

from benchmarks import ROOT
from benchmarks.scoring import rms
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock, VirtualClock, run_virtual, run_wall
from monstertruck_runtime.errors import NoAnswerError, NotFoundError, RequestRefusedError
from monstertruck_runtime.mailbox import Mailbox, latest
from monstertruck_runtime.requests import Operator
from monstertruck_runtime.yaml_files import yaml_text
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.state import GateState, Odometry, Peers
from monstertruck_schemas.topics import GATE, PEERS, POSE
from monstertruck_sim.world.scene import MOVING, Contact
from monstertruckd.tools.cli.runs import RunEnd, run_behaviour
from monstertruckd.tools.demo.runs import free_endpoint
from monstertruckd.tools.simulation.config import load_simulated
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig
from tests.fleet_kit import virtual_fleet

ROBOTS = {
    "differential": (-2.0, -1.8, 0.0),
    "skid_steer": (2.0, -1.8, 1.57),
    "mecanum": (-2.0, 2.0, 0.0),
    "omni": (2.0, 2.2, -1.57),
    "independent": (0.9, -0.6, 3.14),
}
"""Configuration of configs/robots, and where it starts in the yard; all of them turn on the spot."""
PEOPLE = (
    {"waypoints": [{"x": 0.0, "y": -2.4}, {"x": 0.0, "y": 2.6}], "speed": 0.6, "before": "stop"},
    {"waypoints": [{"x": -2.6, "y": 0.9}, {"x": 2.6, "y": 0.9}], "speed": 0.5, "before": "turn"},
    {"waypoints": [{"x": -1.0, "y": -2.6}, {"x": -1.0, "y": 1.9}], "speed": 0.8, "before": "stop"},
)
HALF = 2.2
"""Places are drawn within this of the yard's middle, m."""
REACHED = 0.15
"""A place nearer than this is reached, m."""
PENDING = 6
"""Places among which a robot chooses."""
PASSES = 0.7
"""A straight line leads past another robot at least so far from it, m."""
NEAR = 1.1
"""Robots that stand nearer to each other than this settle which of them goes first, m."""
TURN_OF_EACH = 60.0
"""Seconds for which one robot has the right of way before all others."""
TASKS = 8
GOALS = {"contacts_by_moving_robots": 0, "tasks_of_each": TASKS}
CONTACT = re.compile(r"contact: (.+) at ([\d.]+) m/s with (.+) at ([\d.]+) m/s")


@dataclass
class Score:
    """Record of one robot."""

    tasks: int = 0
    moves: int = 0
    held: Counter[str] = field(default_factory=Counter)
    """Why moves were refused or ended early."""
    pose_errors: list[float] = field(default_factory=list)
    """Errors of its pose against the true pose, once a second, m; on the virtual clock only."""


def configurations(folder: Path) -> list[Path]:
    """Write a file for every robot, with its name, place and folders."""
    files = []
    endpoints = {kind: free_endpoint() for kind in ROBOTS}
    for i, (kind, (x, y, yaw)) in enumerate(ROBOTS.items()):
        start = {"x": x, "y": y, "yaw": yaw}
        world: dict[str, Any] = {"map": "yard", "start": start}
        robot = {
            "include": str(ROOT / "configs" / "robots" / f"{kind}.yaml"),
            "version": 2,
            "robot": kind,
            "path": None,
            "tracker": None,
            "blackbox": None,
            "recorder": None,
            "odometry": {"start": start},
            "slam": {"mode": "mapping"},
            "state_directory": str(folder / "{robot}" / "state"),
            "zenoh": {"listen": [endpoints[kind]]},
            "peers": {other: {"endpoint": end} for other, end in endpoints.items() if other != kind},
            "sim": {"world": world | ({"people": list(PEOPLE)} if i == 0 else {})},
        }
        file = folder / f"{kind}.yaml"
        file.write_text(yaml_text(robot))
        files.append(file)
    return files


@dataclass
class Pilot:
    """Drives one robot from one drawn place to the next.

    Args:
        driver: client of the robot.
        clock: source of time.
        seed: seed of places and pauses.
        score: record of the robot.
        pose: latest pose of the robot.
        number: number of the robot in ``ROBOTS``.
    """

    driver: Operator
    clock: Clock
    seed: int
    score: Score
    pose: Mailbox[Odometry]
    number: int
    rng: np.random.Generator = field(init=False)
    gate: Mailbox[GateState] = field(init=False)
    peers: Mailbox[Peers] = field(init=False)

    async def patrol(self, until: int) -> None:
        """Drive until an instant, ns."""
        self.rng = np.random.default_rng(self.seed)
        places = [self.draw() for _ in range(PENDING)]
        with (
            self.driver.subscribe(GATE, latest()) as self.gate,
            self.driver.subscribe(PEERS, latest()) as self.peers,
        ):
            while self.clock.now() < until:
                place = next(filter(self.passes, places), places[0])
                places.remove(place)
                try:
                    async with self.clock.deadline(60.0):
                        await self.go_to(*place, until)
                    places.append(self.draw())
                except TimeoutError:
                    places.append(place)  # somebody may stand there: later

    def draw(self) -> tuple[float, float]:
        """Return a place in the yard, m."""
        x, y = self.rng.uniform(-HALF, HALF, 2).tolist()
        return x, y

    def passes(self, place: tuple[float, float]) -> bool:
        """Whether the straight line to a place passes the other robots by their reported poses."""
        if self.pose.latest is None or self.peers.latest is None:
            return True
        start = np.array((self.pose.latest.pose.x, self.pose.latest.pose.y))
        line = np.linspace(start, place, 20)
        others = np.array([(peer.pose.x, peer.pose.y) for peer in self.peers.latest.peers]).reshape(-1, 2)
        return bool((np.hypot(*(line[:, None] - others[None]).T) > PASSES).all())

    async def go_to(self, x: float, y: float, until: int) -> None:
        """Turn to a place and drive there; after a stop give way and try again."""
        while self.clock.now() < until:
            if (newest := self.pose.latest) is None:
                await self.clock.sleep(0.2)
                continue
            pose = newest.pose
            way = math.dist((x, y), (pose.x, pose.y))
            if way < REACHED:
                self.score.tasks += 1
                return
            turn = math.remainder(math.atan2(y - pose.y, x - pose.x) - pose.yaw, math.tau)
            turned = abs(turn) < 0.05 or await self.turn(turn)
            if turned and await self.move(length=way, speed=0.18):
                continue
            if await self.make_way():
                continue
            await self.clock.sleep(float(self.rng.uniform(0.3, 3.0)))
            if not await self.turn(float(self.rng.uniform(-1.5, 1.5))):
                # Ahead its lidar looks, and what it leaves behind has been seen.
                if not await self.move(length=float(self.rng.uniform(0.2, 0.4)), speed=0.15):
                    await self.move(length=-float(self.rng.uniform(0.1, 0.2)), speed=0.1)
            elif self.rng.random() < 0.5:
                await self.move(length=float(self.rng.uniform(0.2, 0.8)), speed=0.15)

    async def make_way(self) -> bool:
        """Give way, or wait until the others have; return False if no robot is near, or it cannot move."""
        assert self.pose.latest is not None
        me, heard = self.pose.latest.pose, self.peers.latest
        others = {} if heard is None else {peer.robot: (me.x - peer.pose.x, me.y - peer.pose.y) for peer in heard.peers}
        near = {name: off for name, off in others.items() if math.hypot(*off) < NEAR}
        if not near:
            return False
        if self.rank(self.number) < min(self.rank(list(ROBOTS).index(name)) for name in near):
            await self.clock.sleep(float(self.rng.uniform(1.0, 2.0)))
            return True
        pushes = [(x / (x * x + y * y), y / (x * x + y * y)) for x, y in near.values()]
        away = math.atan2(sum(y for _, y in pushes), sum(x for x, _ in pushes))
        turn = math.remainder(away - me.yaw, math.tau)
        if abs(turn) > 0.3 and not await self.turn(turn):
            return False
        return await self.move(length=float(self.rng.uniform(0.4, 0.8)), speed=0.18)

    def rank(self, number: int) -> int:
        """Return the robot's rank; the robot of rank 0 currently has the right of way."""
        return (number - int(self.clock.now() / SECOND / TURN_OF_EACH)) % len(ROBOTS)

    async def turn(self, angle: float) -> bool:
        """Turn on the spot; return whether it did."""
        return await self.move(radius=0.0, angle=angle)

    async def move(self, **settings: float) -> bool:
        """Run a move; return whether it was completed."""
        self.score.moves += 1
        gate = self.gate.latest
        try:
            armed = gate is not None and gate.mode.accepts_motion
            end: RunEnd = await run_behaviour(self.driver, "move", arm=not armed, settings=settings)
        except (RequestRefusedError, NoAnswerError) as error:
            self.score.held[getattr(error, "refusal", error.reason).value] += 1
            await self.clock.sleep(0.5)
            return False
        if end.reason is not Reason.BEHAVIOUR_DONE:
            self.score.held[end.reason.value] += 1
        return end.reason is Reason.BEHAVIOUR_DONE


@dataclass
class Run:
    """Record of a run."""

    scores: dict[str, Score]
    contacts: list[tuple[str, float, str, float]]
    """Mover and other, each with its speed, m/s."""
    simulated: float
    """s."""
    taken: float
    """Real seconds of that."""
    processor: float | None = None
    """Seconds of processor time, where all is one process."""


def on_virtual_clock(seconds: float, seed: int) -> Run:
    """Run all daemons in this process."""
    with TemporaryDirectory() as folder:
        configs = [load_simulated(file) for file in configurations(Path(folder))]
    scores = {config.robot: Score() for config in configs}

    async def main(clock: VirtualClock) -> tuple[list[Contact], float, float]:
        async with virtual_fleet(configs, clock) as (rigs, scene):
            await clock.sleep(2.0)
            began, used, until = perf_counter(), process_time(), clock.now() + round(seconds * SECOND)
            async with asyncio.TaskGroup() as group:
                for i, rig in enumerate(rigs):
                    score, pose = scores[rig.config.robot], rig.bus.subscribe(POSE, latest())
                    pilot = Pilot(LocalOperator(rig.daemon, clock), clock, seed + i, score, pose, i)
                    group.create_task(pilot.patrol(until))
                    group.create_task(compare_poses(rig, pose, until, score))
            return scene.contacts, perf_counter() - began, process_time() - used

    contacts, taken, processor = run_virtual(main, start=SECOND)
    found = [(it.mover, it.speed, it.other, it.other_speed) for it in contacts]
    return Run(scores, found, seconds, taken, processor)


async def compare_poses(rig: VirtualRig, pose: Mailbox[Odometry], until: int, score: Score) -> None:
    """Compare a robot's pose with the world's truth once a second until an instant, ns."""
    while rig.clock.now() < until:
        await rig.clock.sleep(1.0)
        if (newest := pose.latest) is not None:
            true = rig.world.truth(rig.clock.now())
            score.pose_errors.append(math.dist((newest.pose.x, newest.pose.y), (true.x, true.y)))


def in_processes(seconds: float, seed: int) -> Run:
    """Run one simulator, and a daemon process for each robot."""
    scores = {name: Score() for name in ROBOTS}
    lines: list[str] = []

    async def main(clock: Clock) -> tuple[float, float]:
        with TemporaryDirectory() as name:
            folder = Path(name)
            files = configurations(folder)
            endpoints = {c.robot: c.zenoh.listen[0] for c in map(load_simulated, files)}
            async with simulator(files, folder / "truth.npz", lines) as process:
                clients = [await connected(clock, robot, end) for robot, end in endpoints.items()]
                until = clock.now() + round(seconds * SECOND)
                began = perf_counter()
                try:
                    async with asyncio.TaskGroup() as group:
                        for i, client in enumerate(clients):
                            pose = client.subscribe(POSE, latest())
                            pilot = Pilot(client, clock, seed + i, scores[client.robot], pose, i)
                            group.create_task(pilot.patrol(until))
                finally:
                    taken = perf_counter() - began
                    for client in clients:
                        await client.__aexit__(None, None, None)
                assert process.returncode is None, "the simulator ended early"
            with np.load(folder / "truth.npz") as archive:
                times = archive[next(iter(ROBOTS))][:, 0]
            return float(np.sum(times > times[-1] - seconds)) / 20.0, taken

    simulated, taken = run_wall(main)
    found = [(m[1], float(m[2]), m[3], float(m[4])) for line in lines if (m := CONTACT.match(line))]
    return Run(scores, found, simulated, taken)


@asynccontextmanager
async def simulator(files: Iterable[Path], truth: Path, lines: list[str]) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run the processes for the duration of the context; ``lines`` receives the simulator's output."""
    command = ("simulate", "--robots", ",".join(map(str, files)), "--run", "--truth", str(truth))
    with (truth.parent / "daemons.txt").open("wb") as errors:
        process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "monstertruckd",
            *command,
            cwd=truth.parent,
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.PIPE,
            stderr=errors,
        )

    async def read() -> None:
        assert process.stdout is not None
        while line := await process.stdout.readline():
            lines.append(line.decode().strip())

    reading = asyncio.create_task(read())
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        await process.wait()
        await reading


async def connected(clock: Clock, robot: str, endpoint: str) -> TruckClient:
    """Return a client of a robot once it answers."""
    async with clock.deadline(180.0):
        while True:
            client = TruckClient(robot, endpoint, clock=clock, timeout=5.0)
            try:
                await client.__aenter__()
                if await client.alive():
                    return client
                await client.__aexit__(None, None, None)
            except NotFoundError:
                await clock.sleep(0.5)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--virtual", action="store_true", help="all daemons on one virtual clock")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    run = (on_virtual_clock if options.virtual else in_processes)(60.0 * options.minutes, options.seed)
    for name, score in run.scores.items():
        held = ", ".join(f"{reason} {count}" for reason, count in score.held.most_common())
        print(f"{name:13} {score.tasks:3} tasks  {score.moves:4} moves  held: {held or 'never'}")
    moving: list[str] = []
    people: list[str] = []
    for mover, speed, other, other_speed in run.contacts:
        print(f"contact: {mover} at {speed:.2f} m/s with {other} at {other_speed:.2f} m/s")
        by_robot = (mover in ROBOTS and speed >= MOVING) or (other in ROBOTS and other_speed >= MOVING)
        (moving if by_robot else people).append(mover)
    rate = run.simulated / run.taken
    print(f"{run.simulated:.0f} s simulated in {run.taken:.0f} s: rate {rate:.2f}")
    if run.processor is not None:
        idle = run.simulated / run.processor
        print(f"{run.processor:.0f} s of processor time: {idle:.2f} times as fast as real time on an idle core")
    poses = {name: rms(np.array(score.pose_errors)) for name, score in run.scores.items() if score.pose_errors}
    for name, error in poses.items():
        print(f"{name:13} pose {error * 100:.1f} cm RMS, {max(run.scores[name].pose_errors) * 100:.1f} at most")
    found = {
        "daemons": "one process" if options.virtual else "a process each",
        "minutes": options.minutes,
        "contacts_by_moving_robots": len(moving),
        "people_into_standing_robots": len(people),
        "least_tasks": min(score.tasks for score in run.scores.values()),
        "tasks": {name: score.tasks for name, score in run.scores.items()},
        "pose_rms_m": {name: round(error, 4) for name, error in poses.items()},
        "rate": round(rate, 2),
        "rate_on_idle_core": None if run.processor is None else round(run.simulated / run.processor, 2),
    }
    met = not moving and found["least_tasks"] >= TASKS * options.minutes / 10.0
    print(json.dumps({"bench": "fleet_world", "figures": found, "goals": GOALS, "met": met}))


if __name__ == "__main__":
    main()
