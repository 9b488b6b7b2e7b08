"""Plausible sensors that lie: noticed before contact, and no false alarm.

    python benchmarks/lying_sensors.py [--seeds 5] [--case NAME ...] [--world NAME ...]
    python benchmarks/lying_sensors.py --quiet [--seconds 60]
    python benchmarks/lying_sensors.py --logs FOLDER [--log NAME ...]

On the virtual clock an operator drives the emulated truck straight ahead by hand, at its greatest speed, towards a post
that is 0.9 m before its bumper when the lie begins; with some seeds it begins before the truck is armed, with others
while it drives. In the cases ``mirrored`` and ``compass`` the truck follows the demo's lap, in ``goal-...`` planner and
tracker take it to a goal, in ``slam-...`` it maps while it follows the lap. Judged by the world alone: contact is an
outline in a wall or in the post, noticed is a stop or a refusal to arm with ``sensors_disagree`` or ``sensor_frozen``.

    repeated   one revolution again and again, with fresh stamps
    noisy      the same, with new noise
    late       scans as they were 0.8 s ago
    doubled    all ranges twice as long; halved: half as long
    half-odometry   the drive counts half of the distance
    turned     the lidar is mounted 0.5 rad off; mirrored: left and right are exchanged
    compass    all values of the compass repeat

``--quiet`` drives shipped configurations without a fault, and with wheels that slip by 30 %, and counts alarms.
``--logs`` replays recorded logs (``.npz`` with t, ranges and odom; ``.dat.gz`` of a URG-04LX with wheel ticks) through
the pure core; *compared* are the seconds between scans that overlap. The last line is JSON.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from benchmarks import ROOT
from monstertruck_estimation.consistency.comparison import Measure
from monstertruck_estimation.consistency.config import ConsistencyConfig
from monstertruck_estimation.consistency.exchange import StepInput
from monstertruck_estimation.consistency.monitor import ConsistencyMonitor
from monstertruck_estimation.consistency.scan_odometry import ScanMotionStep
from monstertruck_estimation.slam.worker_io import ScanInput
from monstertruck_estimation.wheel_motion import WheelIncrement
from monstertruck_kinematics.elementary import Array
from monstertruck_kinematics.se2 import between
from monstertruck_runtime.clock import SECOND, VirtualClock, run_virtual
from monstertruck_runtime.errors import RequestRefusedError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest
from monstertruck_sim.faults import SimContext, place_obstacle
from monstertruck_sim.world.built_in import BUILT_IN
from monstertruckd.config.load import load_config
from monstertruckd.tools.simulation.config import SimulatedTruckConfig, with_overlay
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CONFIGS: Final = ROOT / "configs"
NOTICED: Final = (Reason.SENSORS_DISAGREE, Reason.SENSOR_FROZEN)
GAP: Final = 0.9
"""Distance of the post from the bumper when the lie begins, m."""
LONGEST: Final = 14.0
"""Seconds of a trial."""
PERIOD: Final = 0.05
WORLDS: Final = ("loop", "rooms", "corridor_maze", "workshop")

Lie = Callable[[SimContext], None]


def falsified(role: str, *faults: tuple[str, ...]) -> Lie:
    """Return faults of signals of an emulated device: (signal, fault, argument) each."""

    def start(context: SimContext) -> None:
        for signal, fault, *values in faults:
            context.signals(role).inject(signal, fault, *values)

    return start


def commanded(role: str, line: str) -> Lie:
    """Return a fault given by a command of the emulator's console."""
    return lambda context: context.command(role, line)


class Drive(StrEnum):
    """Kind of drive of the truck."""

    HAND = "hand"
    """Straight ahead, by an operator."""
    LAP = "lap"
    """The demo's lap; there is no post."""
    GOAL = "goal"
    """To a goal straight ahead, planned over the map of the rooms."""
    SLAM = "slam"
    """The demo's lap while it maps."""


@dataclass(frozen=True, slots=True)
class Case:
    """A kind of fault."""

    start: Lie | None = None
    overlay: dict[str, Any] | None = None
    """What is wrong in the world from the beginning."""
    drive: Drive = Drive.HAND
    settled: bool = False
    """It begins long before the truck is armed: its own beginning does not give it away."""


SHAFT: Final = ("position_actual", "velocity_actual", "velocity_averaged")
"""What the drive controller says of its shaft."""
CASES: dict[str, Case] = {
    "repeated": Case(falsified("lidar", ("range", "frozen"))),
    "noisy": Case(falsified("lidar", ("range", "frozen"), ("range", "noisy", "6"))),
    "late": Case(falsified("lidar", ("range", "delayed", "0.8")), settled=True),
    "doubled": Case(falsified("lidar", ("range", "scaled", "2"))),
    "halved": Case(falsified("lidar", ("range", "scaled", "0.5"))),
    "half-odometry": Case(falsified("drive", *((signal, "scaled", "0.5") for signal in SHAFT))),
    "turned": Case(overlay={"sim": {"world": {"lidar": {"yaw": 0.5}}}}),
    "mirrored": Case(falsified("lidar", ("range", "mirrored")), drive=Drive.LAP),
    "compass": Case(commanded("compass", "frozen on"), drive=Drive.LAP),
}
CASES |= {
    f"{drive}-{name}": replace(CASES[name], drive=drive)
    for drive in (Drive.GOAL, Drive.SLAM)
    for name in ("repeated", "noisy", "late", "doubled")
}
HOME: Final = {Drive.LAP: "loop", Drive.SLAM: "loop", Drive.GOAL: "rooms"}
"""World of each kind of drive that does not run in every world."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one trial."""

    contact: bool
    noticed: float | None
    """Seconds after the lie began, None = never."""
    driven: float
    """Distance travelled meanwhile, or until the end, m."""
    reason: str = ""


def trial(case: Case, world: str, seed: int) -> Outcome:
    """Drive towards a post, or along the lap, with a faulty sensor."""
    rng = np.random.default_rng(seed)
    name = "slam.yaml" if case.drive is Drive.SLAM else "demo.yaml" if world == "loop" else "goals.yaml"
    config = load_config(CONFIGS / name, SimulatedTruckConfig)[0]
    x, y, yaw = BUILT_IN[world]().start
    start = {"x": x + float(rng.uniform(0, 0.1)), "y": y + float(rng.uniform(-0.04, 0.04)), "yaw": yaw}
    overlay: dict[str, Any] = {
        "recorder": None,
        "map": None,
        "odometry": {"start": start},
        "sim": {"seed": seed + 1, "world": {"map": world}},
    }
    if case.drive is Drive.HAND:
        overlay |= {"path": None, "tracker": None, "planner": None}
    if case.drive is Drive.GOAL:
        overlay |= {"planner": {"route": {"effort": 3000, "margin": 0.04}}}
        overlay |= {"placement": {"planner": "loop", "local_planner": "loop"}}
    config = with_overlay(with_overlay(config, overlay), case.overlay or {})

    async def main(clock: VirtualClock) -> Outcome:
        rig = VirtualRig(config, clock)
        return await _Driver(rig, clock, case, early=seed % 2 == 0).run()

    return run_virtual(main, start=SECOND)


class _Driver:
    """Operator and judge of one trial."""

    def __init__(self, rig: VirtualRig, clock: VirtualClock, case: Case, *, early: bool) -> None:
        self._rig, self._clock, self._case, self._early = rig, clock, case, early
        config = rig.config
        self._context = SimContext(config.sim, config.devices, rig.robot, rig.computer, clock)
        self._operator = LocalOperator(rig.daemon, clock)
        self._gate = rig.bus.subscribe(topics.GATE, fifo(4096))

    async def run(self) -> Outcome:
        """Arm, drive, observe."""
        rig, clock = self._rig, self._clock
        async with rig.running():
            await clock.sleep(2.5)
            began = clock.now()
            if self._early or self._case.settled:
                self._lie()
                await clock.sleep(2.0 if self._case.settled else 0.4)
                began = clock.now() if self._case.settled else began
            try:
                await self._operator.arm()
            except RequestRefusedError as refused:
                noticed = refused.refusal in NOTICED
                return Outcome(
                    contact=False,
                    noticed=(clock.now() - began) / SECOND if noticed else None,
                    driven=0.0,
                    reason=refused.refusal.value,
                )
            if self._case.drive is Drive.GOAL:
                await self._start()
            if not self._early and not self._case.settled:
                await self._drive(1.5)
                began = clock.now()
                self._lie()
            return await self._watch(began)

    def _lie(self) -> None:
        self._gate.drain()
        if self._case.start is not None:
            self._case.start(self._context)
        if self._case.drive is not Drive.LAP:
            place_obstacle(GAP)(self._context)

    async def _start(self) -> None:
        """Request a goal 4 m ahead."""
        truth = self._rig.world.truth(self._clock.now())
        goal = {"x": truth.x + 4.0 * math.cos(truth.yaw), "y": truth.y + 4.0 * math.sin(truth.yaw), "yaw": truth.yaw}
        request = {**await self._operator.header(), "frame": "map", "goal": goal}
        await self._operator.call("goal", request)

    async def _drive(self, seconds: float) -> None:
        until = self._clock.now() + round(seconds * SECOND)
        while self._clock.now() < until:
            await self._ask()
            await self._clock.sleep(PERIOD)

    async def _ask(self) -> None:
        if self._case.drive is not Drive.HAND:
            return
        request = DriveRequest(**await self._operator.header(0.25), speed=0.3, front=0.0, rear=0.0)
        self._rig.bus.inject(topics.REQ_DRIVE, request)

    async def _watch(self, began: int) -> Outcome:
        clock, before, driven = self._clock, self._rig.world.truth(self._clock.now()), 0.0
        while clock.now() - began < LONGEST * SECOND:
            await self._ask()
            await clock.sleep(PERIOD)
            truth = self._rig.world.truth(clock.now())
            driven += math.hypot(truth.x - before.x, truth.y - before.y)
            before = truth
            seen = [
                reason
                for state in self._gate.drain()
                if state.stamp >= began
                for reason in state.reasons
                if reason in NOTICED
            ]
            if seen:
                await self._drive(1.0)
                return Outcome(
                    self._rig.world.truth(clock.now()).stuck,
                    (clock.now() - began) / SECOND - 1.0,
                    driven,
                    seen[0].value,
                )
            if self._rig.world.truth(clock.now()).stuck:
                return Outcome(contact=True, noticed=None, driven=driven)
        return Outcome(self._rig.world.truth(clock.now()).stuck, None, driven)


QUIET: Final[dict[str, dict[str, Any]]] = {
    "demo.yaml": {},
    "slam.yaml": {},
    "kiss.yaml": {},
    "fusion.yaml": {},
    "full.yaml": {},
    "ramp.yaml": {},
    "points.yaml": {},
    "goals.yaml": {},
    "explore.yaml": {},
    "full3d.yaml": {},
    **{f"robots/{path.name}": {} for path in sorted((CONFIGS / "robots").glob("*.yaml")) if path.stem != "hall"},
}
"""Shipped configurations that drive by themselves once they are armed, and what is changed in them."""
STARTS: Final[dict[str, tuple[str, dict[str, Any]]]] = {
    "goals.yaml": ("goal", {"frame": "map", "goal": {"x": 8.5, "y": 6.0, "yaw": 0.0}}),
    "explore.yaml": ("explore", {"order": "start"}),
}
"""What those are asked for that do not drive by themselves."""
SLIP: Final = {"sim": {"world": {"truck": {"motor": {"ratio": 644.0 / 0.7}}}}}
"""Wheels of which the robot moves 0.7 of the distance."""


@dataclass(frozen=True, slots=True)
class Quiet:
    """A drive without a fault."""

    alarms: tuple[str, ...]
    measures: tuple[str, ...]
    driven: float


def quiet(name: str, seconds: float, overlay: dict[str, Any]) -> Quiet:
    """Drive a shipped configuration without a fault."""
    config = load_config(CONFIGS / name, SimulatedTruckConfig)[0]
    config = with_overlay(with_overlay(config, {"recorder": None, "map": None}), overlay)

    async def main(clock: VirtualClock) -> Quiet:
        rig = VirtualRig(config, clock)
        compared = rig.bus.subscribe(topics.CONSISTENCY, fifo(1 << 16))
        operator, driven = LocalOperator(rig.daemon, clock), 0.0
        async with rig.running():
            await clock.sleep(2.0)
            await operator.arm()
            if name in STARTS:
                call, request = STARTS[name]
                await operator.call(call, {**await operator.header(), **request})
            before = rig.world.truth(clock.now())
            until, number = clock.now() + round(seconds * SECOND), 0
            while clock.now() < until:
                if config.tracker is None and config.path is None and name not in STARTS:
                    number += 1
                    front = 0.2 * math.sin(number / 40)
                    request = DriveRequest(**await operator.header(0.25), speed=0.2, front=front, rear=0.0)
                    rig.bus.inject(topics.REQ_DRIVE, request)
                await clock.sleep(PERIOD)
                truth = rig.world.truth(clock.now())
                driven += math.hypot(truth.x - before.x, truth.y - before.y)
                before = truth
        said = compared.drain()
        alarms = dict.fromkeys(f"{doubt.sensor}: {doubt.text}" for message in said for doubt in message.doubts)
        alarms |= dict.fromkeys("stands while its wheels roll" for message in said if message.standing is not None)
        return Quiet(tuple(alarms), said[-1].measures, driven)

    return run_virtual(main, start=SECOND)


class Recording(NamedTuple):
    """A recorded log."""

    stamps: Array
    """Shape (n,), s."""
    ranges: Array
    """Shape (n, beams), m; infinite where there is no echo."""
    odom: Array
    """Shape (n, 3): dead reckoning, m and rad."""
    start: float
    """Angle of the first beam, rad."""
    step: float
    """Angle between beams, rad."""
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Mount of the lidar, m and rad."""
    time_step: float = 0.0
    """Time between beams, s."""


URG_STEP: Final = 2.0 * math.pi / 1024
"""Angle between beams of a URG-04LX, rad; beam 341 points ahead."""
URG_WHEELS: Final = 2.26e-4, 7.2e-4
"""Metres and radians per tick of the wheels of that log, measured against its lidar."""


def recorded(path: Path) -> Recording:
    """Read a log."""
    if path.suffix == ".npz":
        log = np.load(path)
        ranges, beams = log["ranges"].astype(float), log["ranges"].shape[1]
        longest = float(log["range_max"]) if "range_max" in log else float(np.max(ranges)) * 0.98
        step = math.pi / 180 if beams == 180 else math.pi / (beams - 1)
        return Recording(
            log["t"],
            np.where(ranges < longest, ranges, np.inf),
            log["odom"],
            float(log["start_angle"]) if "start_angle" in log else -math.pi / 2,
            float(log["angle_increment"]) if "angle_increment" in log else step,
            tuple(log["mount"].tolist()) if "mount" in log else (0.0, 0.0, 0.0),
            float(log["time_increment"]) if "time_increment" in log else 0.0,
        )
    rows = np.loadtxt(path)
    left, right = (np.diff(rows[:, column], prepend=rows[0, column]) for column in (2, 3))
    yaw = np.cumsum(URG_WHEELS[1] * (right - left))
    way = URG_WHEELS[0] * (left + right) / 2
    odom = np.column_stack((np.cumsum(way * np.cos(yaw)), np.cumsum(way * np.sin(yaw)), yaw))
    ranges = rows[:, 24:] / 1000.0
    ranges[ranges < 0.02] = np.nan
    return Recording(rows[:, 0] * 1e-6, ranges, odom, -341 * URG_STEP, URG_STEP, (0.145, 0.0, 0.0))


def replayed(log: Recording) -> tuple[list[str], float, float]:
    """Return the alarms of a recorded log, its duration, and its compared time, s."""
    stamps = log.stamps - log.stamps[0] + 1.0
    longest = float(np.max(log.ranges[np.isfinite(log.ranges)]))
    monitor = ConsistencyMonitor(ConsistencyConfig(), {Measure.WHEELS: "drive", Measure.SCANS: "lidar"})
    odometry, alarms, compared, last = ScanMotionStep(), [], 0.0, 0
    monitor.activate(0)
    for k, seconds in enumerate(stamps):
        stamp = int(seconds * SECOND)
        if stamp <= last:
            continue
        if k:
            dt, (x, y, turn) = (stamp - last) / SECOND, between(log.odom[k - 1], log.odom[k]).tolist()
            c, s = math.cos(turn / 2), math.sin(turn / 2)
            twist = (c * x + s * y) / dt, (c * y - s * x) / dt, turn / dt
            monitor.observe_wheels(WheelIncrement(last, stamp, twist, abs(x), (), ()))
        last = stamp
        scan = ScanInput(stamp, log.ranges[k], log.start, log.step, 0.02, longest, log.time_step, mount=log.mount)
        end = stamp + round(len(scan.ranges) * scan.time_increment * SECOND)
        claim, rest, rolled = monitor.claim(stamp), monitor.rest_claim(stamp, end), monitor.rolled(stamp)
        output = odometry.step(StepInput(scan, "kiss", claim=claim, lag=monitor.lag(), rest=rest, rolled=rolled))
        compared += 0.0 if output.since is None else (output.stamp - output.since) / SECOND
        monitor.observe_scan(output)
        if monitor.unshown is not None:
            alarms.append(f"{seconds - 1.0:.1f} s: moves {monitor.unshown.distance:.2f} m while its wheels stand")
        if (body := monitor.standing) is not None:
            alarms.append(f"{seconds - 1.0:.1f} s: stands while its wheels roll {body.rolled:.2f} m")
        if found := monitor.findings():
            alarms += [f"{seconds - 1.0:.1f} s: {doubt.sensor}: {doubt.text}" for doubt in found]
            monitor.activate(stamp)
    return alarms, float(stamps[-1] - stamps[0]), compared


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def lies(cases: list[str], worlds: list[str], seeds: int) -> dict[str, Any]:
    """Run all trials; return figures by case."""
    figures: dict[str, Any] = {}
    for name in cases:
        case = CASES[name]
        outcomes = [
            trial(case, world, seed)
            for world in ([HOME[case.drive]] if case.drive in HOME else worlds)
            for seed in range(seeds)
        ]
        times = [one.noticed for one in outcomes if one.noticed is not None]
        figures[name] = {
            "trials": len(outcomes),
            "noticed": len(times),
            "contacts": sum(one.contact for one in outcomes),
            "seconds_max": round(max(times, default=math.nan), 2),
            "metres_max": round(max(one.driven for one in outcomes), 2),
        }
        _say(f"{name:14} {figures[name]}")
    return figures


def main() -> None:
    """Run the selected parts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--case", action="append", choices=CASES)
    parser.add_argument("--world", action="append", choices=WORLDS)
    parser.add_argument("--quiet", action="store_true", help="shipped configurations without a fault")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each of them")
    parser.add_argument("--only", action="append", help="of the shipped configurations, by name")
    parser.add_argument("--logs", type=Path, help="folder of recorded logs")
    parser.add_argument("--log", action="append", help="of these logs, by file name")
    args = parser.parse_args()
    began = time.monotonic()
    figures: dict[str, Any] = {}
    if args.logs is not None:
        files = sorted((*args.logs.glob("*.npz"), *args.logs.glob("*.dat.gz")))
        for path in (path for path in files if not args.log or path.name in args.log):
            alarms, duration, compared = replayed(recorded(path))
            row = {"alarms": len(alarms), "seconds": round(duration), "compared": round(compared)}
            figures[path.name] = row
            _say(f"{path.name:24} {row} {'; '.join(alarms)}")
        met = not any(one["alarms"] for one in figures.values())
        goals: dict[str, Any] = {"alarms": 0}
    elif args.quiet:
        names = [name for name in QUIET if not args.only or name in args.only]
        runs = [(name, QUIET[name], "") for name in names]
        runs += [(name, SLIP, " slip 30 %") for name in ("demo.yaml", "slam.yaml") if name in names]
        for name, overlay, label in runs:
            found = quiet(name, args.seconds, overlay)
            figures[name + label] = {"alarms": len(found.alarms), "driven_m": round(found.driven, 2)}
            _say(f"{name + label:28} {figures[name + label]} {', '.join(found.measures)} {'; '.join(found.alarms)}")
        met = not any(one["alarms"] for one in figures.values())
        goals = {"alarms": 0}
    else:
        figures = lies(args.case or list(CASES), args.world or list(WORLDS), args.seeds)
        met = all(one["noticed"] == one["trials"] and one["contacts"] == 0 for one in figures.values())
        goals = {"noticed": "all", "contacts": 0}
    figures["seconds_of_work"] = round(time.monotonic() - began)
    said: dict[str, Any] = {"bench": "lying_sensors", "figures": figures, "goals": goals, "met": met}
    _say(json.dumps(said))


if __name__ == "__main__":
    main()
