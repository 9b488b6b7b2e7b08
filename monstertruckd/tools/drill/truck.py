"""The simulated truck of a drill: rig, operator, observer and reports of the daemon."""

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import Final, Self

import numpy as np

from monstertruck_kinematics.chassis import Chassis
from monstertruck_kinematics.elementary import KinematicsError
from monstertruck_kinematics.se2 import Twist2, integrate
from monstertruck_runtime.clock import SECOND, VirtualClock, on_computer
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_runtime.map_files import FREE
from monstertruck_schemas import topics
from monstertruck_schemas.event import Event
from monstertruck_schemas.health import HealthTable, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import DriveRequest, Order, RequestedTwist, Role
from monstertruck_schemas.roles import DeviceRole
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import GOAL
from monstertruck_sim.world.built_in import BUILT_IN
from monstertruck_sim.world.world import World
from monstertruckd.bus.local import Bus
from monstertruckd.daemon import Daemon
from monstertruckd.tools.drill.judge import MAY_MOVE, WorldJudge
from monstertruckd.tools.drill.observer import Observer
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

OPTIONAL: Final = frozenset({"recorder"})
"""Services that a fault may end for the rest of a run, because driving continues without them."""

DaemonReport = Event | GateState | HealthTable


class DrivingStation:
    """A station that sends 20 drive requests a second until it is silenced.

    Args:
        bus: bus of the daemon.
        clock: source of time.
        speed: requested speed (m/s).
        front: requested angle of the bicycle's front axle (rad).
    """

    def __init__(self, bus: Bus, clock: VirtualClock, speed: float = 0.18, front: float = 0.0) -> None:
        self.speed = speed
        self.front = front
        self.rear = 0.0
        """Requested rear axle angle (rad)."""
        self.unseen = False
        """Whether the operator holds the second control, which permits driving into unseen ground."""
        self.twist: RequestedTwist | None = None
        """Requested twist instead of speed and angles, which are then 0."""
        self._clock = clock
        self._seq = 0
        self.attach(bus)

    def attach(self, bus: Bus) -> None:
        """Connect to a daemon, initially silent."""
        self.silent = True
        self._bus = bus
        self._gate = bus.subscribe(topics.GATE, latest())

    async def run(self) -> None:
        """Send until cancelled."""
        while True:
            self.send()
            await self._clock.sleep(0.05)  # interval between requests of a station (s)

    def send(self) -> None:
        """Send one request, unless silent."""
        if self.silent:
            return
        now = self._clock.now()
        self._seq += 1
        gate = self._gate.latest
        request = DriveRequest(
            stamp=now,
            received=now,
            seq=self._seq,
            source="station",
            role=Role.STATION,
            lease=0.25,
            nonce=gate.nonce if gate is not None else "",
            gate_stamp=gate.stamp if gate is not None else None,
            speed=self.speed,
            front=self.front,
            rear=self.rear,
            twist=self.twist,
            unseen=self.unseen,
        )
        inject = self._bus.inject
        asyncio.get_running_loop().call_soon(lambda: inject(topics.REQ_DRIVE, request), context=on_computer())


STEERING: Final[Mapping[str, tuple[str, ...]]] = {
    "both": ("front", "counter", "crab", "free"),
    "front": ("front",),
    "parallel": ("crab",),
}
"""Steering modes of a wanderer by the body's degrees of freedom: front axle alone, both opposed, both parallel, each
independent.
"""


def _can(chassis: Chassis, twist: Twist2) -> bool:
    with suppress(KinematicsError):
        chassis.possible(twist)
        return True
    return False


def stays_clear(world: World, twist: Twist2) -> bool:
    """Whether a robot stays free of contact for twice ``MAY_MOVE``, at its current motion or at ``twist``."""
    pose, motions = world.plant.pose, (twist, world.plant.twist)
    looks = 8  # number of poses checked over that time
    times = [2 * MAY_MOVE * (look + 1) / looks for look in range(looks)]
    return all(world.is_free(integrate(pose, *motion, time)) for motion in motions for time in times)


class Wanderer(DrivingStation):
    """A station that drives at random, in both directions and all steering modes.

    When the gate stops the robot before unseen ground, it holds the second control after a while, until it drives
    elsewhere. A robot without range sensors is not stopped before obstacles by the gate: its operator keeps it clear.

    Args:
        bus: bus of the daemon.
        clock: source of time.
        config: limits of the robot.
        rng: source of randomness.
        confirm: called with each confirmed request into unseen ground.
        clear: whether the robot stays free of contact soon at a twist; of an operator who watches.
    """

    def __init__(
        self,
        bus: Bus,
        clock: VirtualClock,
        config: SimulatedTruckConfig,
        rng: np.random.Generator,
        confirm: Callable[[], None],
        clear: Callable[[Twist2], bool] = lambda _: True,
    ) -> None:
        super().__init__(bus, clock)
        self._rng = rng
        self._confirm = confirm
        self._clear = clear
        self._refused_since: int | None = None
        self._limits = config.gate.reverse_speed, config.gate.speed
        self._angle = config.gate.angle
        chassis = config.sim.world.truck.chassis()
        self._bicycle = chassis.bicycle
        self._steering = STEERING[chassis.freedom]
        self._twists = tuple(twist for twist in ((0.0, 0.0, 0.5), (0.0, 0.1, 0.0)) if _can(chassis, twist))
        self._until = 0
        self.backwards: bool | None = None
        """Restriction to one direction of travel; None: either."""

    def choose(self, *, backwards: bool | None = None) -> None:
        """Choose another motion and its duration; ``backwards`` as the attribute, for this motion and later ones."""
        rng = self._rng
        self.backwards = backwards
        back = bool(rng.random() < 0.5) if backwards is None else backwards
        self.speed = float(rng.uniform(0.4, 1.0)) * self._limits[not back] * (-1 if back else 1)
        self.front = float(rng.uniform(-1.0, 1.0)) * self._angle
        steering = self._steering[rng.integers(len(self._steering))]
        free = float(rng.uniform(-1.0, 1.0)) * self._angle
        self.rear = {"front": 0.0, "counter": -self.front, "crab": self.front, "free": free}[steering]
        self.twist = None
        # 0.3: fraction of motions on the spot or sideways, for a body that can do them
        if backwards is None and self._twists and rng.random() < 0.3:
            vx, vy, wz = float(rng.uniform(-1.0, 1.0)) * np.array(self._twists[rng.integers(len(self._twists))])
            self.speed = self.front = self.rear = 0.0
            self.twist = RequestedTwist(vx=float(vx), vy=float(vy), wz=float(wz))
        self.unseen, self._refused_since = False, None
        # (0.4, 2.0): duration of a wanderer's motion, s
        self._until = self._clock.now() + round(float(rng.uniform(0.4, 2.0)) * SECOND)

    def run_up(self, seconds: float) -> None:
        """Drive straight ahead, at most for ``seconds``."""
        self.choose(backwards=False)
        self.speed, self.front, self.rear = self._limits[1], 0.0, 0.0
        self._until = self._clock.now() + round(seconds * SECOND)

    def send(self) -> None:
        """Send one request, unless silent; now and then of another motion."""
        now = self._clock.now()
        if now >= self._until:
            self.choose(backwards=self.backwards)
        self._keep_clear()
        gate = self._gate.latest
        if gate is None or Reason.UNSEEN_STOP not in gate.reasons:
            self._refused_since = None
        elif self._refused_since is None:
            self._refused_since = now
        # 0.5: waiting time before unseen ground until a wanderer holds the second control, s
        elif now - self._refused_since >= 0.5 * SECOND:
            self.unseen = True
        if self.unseen and not self.silent:
            self._confirm()
        super().send()

    def _keep_clear(self) -> None:
        """Choose motions until one stays clear; stand if none does."""
        # 10: motions that it considers for a request; if none of them stays clear, the robot shall stand
        for _ in range(10):
            if self._clear(self._requested()):
                return
            self.choose(backwards=self.backwards)
        self.speed, self.twist = 0.0, None

    def _requested(self) -> Twist2:
        if self.twist is not None:
            return self.twist.vx, self.twist.vy, self.twist.wz
        return self._bicycle.body_twist(self.speed, self.front, self.rear)


class GoalGiver:
    """An operator that sends the planner one goal after another, at random free places of the world.

    Args:
        truck: truck whose planner drives.
        rng: source of randomness.
    """

    def __init__(self, truck: "DrillTruck", rng: np.random.Generator) -> None:
        self._truck = truck
        self._rng = rng
        known = BUILT_IN[truck.rig.config.sim.world.map]().map
        rows, columns = np.nonzero(known.cells == FREE)
        self._places = np.column_stack((columns, rows)) * known.resolution + np.array(known.origin[:2])

    async def run(self) -> None:
        """Send a goal whenever the robot is armed and has none, until cancelled; the planner may refuse it."""
        while True:
            truck = self._truck
            goal = truck.rig.bus.newest(GOAL)
            if truck.gate is not None and truck.gate.mode.active and not (goal is not None and goal.running):
                x, y = self._places[self._rng.integers(len(self._places))].tolist()
                with suppress(TruckError):
                    pose = {"x": x, "y": y, "yaw": float(self._rng.uniform(-math.pi, math.pi))}
                    await truck.operator.call("goal", {**await truck.operator.header(), "frame": "map", "goal": pose})
            await truck.clock.sleep(0.5)  # interval between checks for a missing goal (s)


class DrillTruck:
    """A simulated truck with its operator and observer.

    Args:
        rig: rig that is not running yet.
        by_station: whether a station drives it, in a circle.
        wander: randomness of a station that drives a judged truck at random instead.
        judged: whether only a ``WorldJudge`` observes the world's truth.
        by_hand: whether the station drives from the start; otherwise a tracker does until the attribute is set.
    """

    def __init__(
        self,
        rig: VirtualRig,
        *,
        by_station: bool = False,
        wander: np.random.Generator | None = None,
        judged: bool = False,
        by_hand: bool = True,
    ) -> None:
        self.rig = rig
        self.by_hand = by_hand
        """Whether the operator at the station drives."""
        self.clock = rig.clock
        self.judge = WorldJudge(rig.world, rig.clock) if judged else None
        self._observer = None if judged else Observer(rig.config, rig.world, rig.ports, rig.clock)
        self.station: DrivingStation | None = None
        # 0.1: minimum true speed of a driving truck, m/s; half of its limit for a slow one
        self._cruise = min(0.1, rig.config.gate.speed / 2)
        self._heard: Daemon | None = None
        self.listen()
        if wander is not None:
            assert self.judge is not None
            self.station = Wanderer(rig.bus, rig.clock, rig.config, wander, self.judge.confirm, self._looks())
        elif by_station:
            # 0.5: radius of a station's circle with a robot without a tracker, m
            angle = min(math.atan(rig.config.geometry.wheelbase / 0.5), rig.config.gate.angle)
            # 0.8: speed that the station requests, as a fraction of the gate's limit
            self.station = DrivingStation(rig.bus, rig.clock, 0.8 * rig.config.gate.speed, angle)

    def _looks(self) -> Callable[[Twist2], bool]:
        """Return whether a motion stays clear for the operator, who looks where the robot has no range sensor.

        A robot with a lidar stops by itself before ground that it has not seen, one with sonars only ahead.
        """
        present, clear = self.rig.config.devices.present(), partial(stays_clear, self.rig.world)
        if DeviceRole.LIDAR in present:
            return lambda _: True
        return (lambda twist: twist[0] > 0 or clear(twist)) if DeviceRole.SONAR in present else clear

    @property
    def observer(self) -> Observer:
        """Observer of a truck that is not judged by the world alone."""
        assert self._observer is not None
        return self._observer

    @property
    def speed(self) -> float:
        """True speed (m/s)."""
        return self.observer.speed if self.judge is None else self.judge.speed

    def listen(self) -> None:
        """Subscribe to the rig's daemon if it is a new one."""
        rig = self.rig
        if self._heard is rig.daemon:
            return
        self._heard = rig.daemon
        self.operator = LocalOperator(rig.daemon, rig.clock)
        queues = (rig.bus.subscribe(topic, fifo(1 << 16)) for topic in (topics.EVENT, topics.GATE, topics.HEALTH))
        self._reports = tuple(queues)
        self._gate = rig.bus.subscribe(topics.GATE, latest())
        self._health = rig.bus.subscribe(topics.HEALTH, latest())
        if self.station is not None:
            self.station.attach(rig.bus)

    @classmethod
    @asynccontextmanager
    async def running(
        cls,
        config: SimulatedTruckConfig,
        clock: VirtualClock,
        *,
        by_station: bool = False,
        wander: np.random.Generator | None = None,
        judged: bool = False,
        by_hand: bool = True,
    ) -> AsyncIterator[Self]:
        """Run world, daemon and observer while the context is open; arguments as for the class.

        Raises:
            BaseException: error that ended the daemon early.
        """
        rig = VirtualRig(config, clock)
        truck = cls(rig, by_station=by_station, wander=wander, judged=judged, by_hand=by_hand)
        watching = truck.observer if truck.judge is None else truck.judge
        async with rig.running():
            observing = asyncio.create_task(watching.run(), name="observer")
            operators = [] if truck.station is None else [truck.station.run()]
            if wander is not None and not by_hand and config.own_planner is not None:
                operators.append(GoalGiver(truck, wander.spawn(1)[0]).run())
            asking = [asyncio.create_task(operator, name="operator") for operator in operators]
            try:
                yield truck
            finally:
                for task in asking:
                    task.cancel()
                observing.cancel()
                with suppress(asyncio.CancelledError):
                    await observing  # raises the error of a failed observer

    @property
    def gate(self) -> GateState | None:
        """Latest state of the gate."""
        return self._gate.latest

    def blockers(self) -> tuple[str, ...]:
        """Services that are not ready, and reasons that prevent arming; empty if the truck can be driven."""
        table, state = self._health.latest, self._gate.latest
        if table is None or state is None:
            return ("daemon",)
        down = [r.name for r in table.services if r.state is not ServiceState.READY and r.name not in OPTIONAL]
        driving = state.mode is GateMode.DRIVING
        return (*down, *(() if driving else state.hindrances))

    async def until(self, condition: Callable[[], bool], seconds: float, order: Order | None = None) -> bool:
        """Return whether the condition becomes true in time; repeat the order while the truck is disarmed.

        The operator resets an emergency stop before driving, because the end of a fault may look like motion.
        """
        end = self.clock.now() + round(seconds * SECOND)
        while self.clock.now() < end and not self.rig.daemon_ended:
            if condition():
                return True
            if (
                order is not None and self.station is not None and self.by_hand
            ):  # a released stick, until the truck is armed
                self.station.silent = self.gate is None or not self.gate.mode.active
            if order is not None and self.gate is not None and not self.gate.mode.active:
                await self.order(Order.RESET if self.gate.mode is GateMode.ESTOPPED else order)
            await self.clock.sleep(0.02)
        return condition()

    async def order(self, order: Order) -> None:
        """Send an order if the daemon runs; a refusal is not an error.

        It waits on the robot's computer while that is stalled.
        """
        if not self.rig.daemon_ended:
            giving = asyncio.get_running_loop().create_task(self.operator.order(order), context=on_computer())
            with suppress(TruckError):
                await giving

    def drives(self) -> bool:
        """Whether it moves fast enough that a stop is observable."""
        return abs(self.speed) > self._cruise

    def reports(self) -> list[DaemonReport]:
        """Return events, gate states and health tables since the last call, by time."""
        return sorted(self._drained(), key=lambda report: report.stamp)

    def _drained(self) -> Iterator[DaemonReport]:
        for queue in self._reports:
            yield from queue.drain()
