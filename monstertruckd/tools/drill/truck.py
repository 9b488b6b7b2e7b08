"""The simulated truck of a drill: rig, operator and observer, and what the daemon reports."""

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, suppress
from typing import Final, Self

from monstertruck_runtime.clock import SECOND, VirtualClock
from monstertruck_runtime.errors import TruckError
from monstertruck_runtime.mailbox import fifo, latest
from monstertruck_schemas import topics
from monstertruck_schemas.event import Event
from monstertruck_schemas.health import HealthTable, ServiceState
from monstertruck_schemas.req import DriveRequest, Order, Role
from monstertruck_schemas.state import GateMode, GateState
from monstertruckd.bus.local import Bus
from monstertruckd.daemon import Daemon
from monstertruckd.tools.drill.observer import Observer
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.virtual_rig import VirtualRig

CRUISE: Final = 0.1
"""True speed of a truck that drives, m/s; of a slow one half of what it may."""
CIRCLE: Final = 0.5
"""Radius of the circle in which a station drives a robot without a tracker, m."""
STATION_SPEED: Final = 0.8
"""Speed that the station requests, as a share of the gate's limit."""
REQUESTS: Final = 0.05
"""Seconds from one request of a station to the next."""
OPTIONAL: Final = frozenset({"recorder"})
"""Services that a fault may end for the rest of a run: driving goes on without."""

DaemonReport = Event | GateState | HealthTable


class DrivingStation:
    """A station that sends drive requests, 20 a second, until it is made silent.

    Args:
        bus: of the daemon.
        clock: time.
        speed: requested, m/s.
        front: angle of the bicycle's front axle that is requested, rad.
    """

    def __init__(self, bus: Bus, clock: VirtualClock, speed: float = 0.18, front: float = 0.0) -> None:
        self.speed = speed
        self.front = front
        self._clock = clock
        self._seq = 0
        self.attach(bus)

    def attach(self, bus: Bus) -> None:
        """Send to a daemon, silent at first."""
        self.silent = True
        self._bus = bus
        self._gate = bus.subscribe(topics.GATE, latest())

    async def run(self) -> None:
        """Send until cancelled."""
        while True:
            self.send()
            await self._clock.sleep(REQUESTS)

    def send(self) -> None:
        """One request, unless it is silent."""
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
        )
        self._bus.inject(topics.REQ_DRIVE, request)


class DrillTruck:
    """One rig with its operator and observer.

    Args:
        rig: not running yet.
        by_station: a station drives it, in a circle.
    """

    def __init__(self, rig: VirtualRig, *, by_station: bool = False) -> None:
        self.rig = rig
        self.clock = rig.clock
        self.observer = Observer(rig.config, rig.world, rig.ports, rig.clock)
        self.station: DrivingStation | None = None
        self._cruise = min(CRUISE, rig.config.gate.speed / 2)
        self._heard: Daemon | None = None
        self.listen()
        if by_station:
            angle = min(math.atan(rig.config.geometry.wheelbase / CIRCLE), rig.config.gate.angle)
            self.station = DrivingStation(rig.bus, rig.clock, STATION_SPEED * rig.config.gate.speed, angle)

    def listen(self) -> None:
        """Listen to the rig's daemon where it is another one than before."""
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
        cls, config: SimulatedTruckConfig, clock: VirtualClock, *, by_station: bool = False
    ) -> AsyncIterator[Self]:
        """World, daemon and observer run while the context lasts; arguments as of the class.

        Raises:
            BaseException: what ended the daemon early.
        """
        rig = VirtualRig(config, clock)
        truck = cls(rig, by_station=by_station)
        async with rig.running():
            observing = asyncio.create_task(truck.observer.run(), name="observer")
            asking = None if truck.station is None else asyncio.create_task(truck.station.run(), name="station")
            try:
                yield truck
            finally:
                if asking is not None:
                    asking.cancel()
                observing.cancel()
                with suppress(asyncio.CancelledError):
                    await observing  # an observer that broke has seen nothing

    @property
    def gate(self) -> GateState | None:
        """Newest state of the gate."""
        return self._gate.latest

    def blockers(self) -> tuple[str, ...]:
        """Services that are not ready, and reasons that keep the truck from being armed; empty = it can be driven."""
        table, state = self._health.latest, self._gate.latest
        if table is None or state is None:
            return ("daemon",)
        down = [r.name for r in table.services if r.state is not ServiceState.READY and r.name not in OPTIONAL]
        driving = state.mode is GateMode.DRIVING
        return (*down, *(() if driving else state.hindrances))

    async def until(self, condition: Callable[[], bool], seconds: float, order: Order | None = None) -> bool:
        """Whether the condition becomes true in time; until then the order is repeated while the truck is disarmed."""
        end = self.clock.now() + round(seconds * SECOND)
        while self.clock.now() < end and not self.rig.daemon_ended:
            if condition():
                return True
            if order is not None and self.station is not None:  # a stick at rest, until it is armed
                self.station.silent = self.gate is None or not self.gate.mode.active
            if order is not None and self.gate is not None and not self.gate.mode.active:
                await self.order(order)
            await self.clock.sleep(0.02)
        return condition()

    async def order(self, order: Order) -> None:
        """Give an order, if the daemon runs; a refused one is not an error."""
        if not self.rig.daemon_ended:
            with suppress(TruckError):
                await self.operator.order(order)

    def drives(self) -> bool:
        """Whether it moves at a speed worth stopping."""
        return abs(self.observer.speed) > self._cruise

    def reports(self) -> list[DaemonReport]:
        """Events, gate states and health tables since the last call, by time."""
        return sorted(self._drained(), key=lambda report: report.stamp)

    def _drained(self) -> Iterator[DaemonReport]:
        for queue in self._reports:
            yield from queue.drain()
