"""Runs one scenario and watches it."""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import asynccontextmanager
from typing import Any, Final

import numpy as np

from monstertruck_drivers.epos import objects as od
from monstertruck_drivers.epos.protocol import Control
from monstertruck_runtime.clock import SECOND, VirtualClock
from monstertruck_runtime.errors import NoAnswerError
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message
from monstertruck_schemas.event import Event
from monstertruck_schemas.health import HealthTable, ServiceHealth, ServiceState
from monstertruck_schemas.reasons import Reason
from monstertruck_schemas.req import Order
from monstertruck_schemas.state import GateMode, GateState
from monstertruck_schemas.topics import Topic
from monstertruckd.tools.drill.scenario import AT_REST, SENSORS, Expect, Reaction, Scenario, Stage, Station
from monstertruckd.tools.drill.wire import WireTap, stop_bytes, written
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.operator import LocalOperator
from monstertruckd.tools.simulation.rig import VirtualRig

PATIENCE: Final = 10.0
"""Seconds in which a sound truck is ready, and drives when it is told to."""
SAMPLE: Final = SECOND // 200
ALL: Final = 1 << 20
"""Depth of queues that must not lose anything."""


def with_overlay(config: SimulatedTruckConfig, overlay: Mapping[str, Any]) -> SimulatedTruckConfig:
    """``config`` with some values replaced."""
    return SimulatedTruckConfig.model_validate(_merged(config.model_dump(), overlay))


def _merged(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    deep = {
        k: _merged(base[k], v) if isinstance(v, Mapping) and isinstance(base.get(k), Mapping) else v
        for k, v in top.items()
    }
    return {**base, **deep}


class _Drill:
    """One run of one scenario."""

    def __init__(self, scenario: Scenario, rig: VirtualRig, driven: float) -> None:
        self.scenario = scenario
        self.rig = rig
        self.driven = driven
        self.clock = rig.clock
        self.station = Station(rig)
        self.stage = Stage(rig, self.station)
        self.operator = LocalOperator(rig.bus, rig.clock)
        self.wire = WireTap(rig.ports["drive"], rig.clock)
        self.truth: list[tuple[int, float, float, float]] = []
        self.gate: list[GateState] = []
        self.health: list[HealthTable] = []
        self.events: list[Event] = []
        self.samples: list[Message] = []
        self.injected = 0
        self.healed = 0
        self.stands = scenario.expect is Expect.REFUSE

    async def run(self) -> Reaction:
        """Drive, break, look, mend, drive again."""
        scenario = self.scenario
        async with self._witnesses():
            await self._until(lambda: self.ready() and self.armable(), "the truck to be ready")
            if not self.stands:
                await self.drive()
                await self.clock.sleep(self.driven)
            self.injected = self.clock.now()
            scenario.inject(self.stage)
            await self.clock.sleep(scenario.lead)
            await self._waits(lambda: False, scenario.hold - scenario.lead, Order.ARM if self.stands else None)
            await self.clock.sleep_until(self.injected + round(scenario.hold * SECOND))
            self.healed = self.clock.now()
            if self.rig.daemon_ended:
                return self._reaction(exited=True)
            scenario.heal(self.stage)
            recovered = await self._waits(lambda: self.ready() and self.armable(), scenario.patience)
            after = (self.clock.now() - self.healed) / SECOND if recovered else None
            await self.clock.sleep(0.5)
            moved = self._fastest(self.clock.now() - SECOND // 4, self.clock.now()) > AT_REST
            again = recovered and await self._drives_again()
            return self._reaction(recovered_after_s=after, moved_by_itself=moved, drove_again=again)

    async def drive(self) -> None:
        """Arm and come to speed."""
        self.station.silent = True  # nobody may arm with a deflected stick
        await self._until(lambda: self.gate[-1].mode.active, "the truck to be armed", Order.ARM)
        self.station.silent = not self.scenario.by_station
        await self._until(self.moving, "the truck to drive")

    async def _drives_again(self) -> bool:
        try:
            await self.drive()
        except NoAnswerError:
            return False
        return True

    # Conditions

    def ready(self) -> bool:
        """Every service works."""
        return bool(self.health) and not _unready(self.health[-1:])

    def armable(self) -> bool:
        """Nothing stops the truck but that nobody armed it."""
        return bool(self.gate) and (
            self.gate[-1].mode is GateMode.DRIVING or set(self.gate[-1].reasons) <= {Reason.DISARMED}
        )

    def moving(self) -> bool:
        """The gate drives, and the truck goes."""
        return self.gate[-1].mode is GateMode.DRIVING and abs(self.truth[-1][3]) > 0.1

    async def _until(self, condition: Callable[[], bool], what: str, order: Order | None = None) -> None:
        if not await self._waits(condition, PATIENCE, order):
            held: list[str] = [*self.gate[-1].reasons] if self.gate else []
            held += [f"{row.name}: {row.detail or row.state}" for row in _unready(self.health[-1:])]
            raise NoAnswerError(f"{self.scenario.name}: waited for {what}; held by {', '.join(held) or 'nothing'}")

    async def _waits(self, condition: Callable[[], bool], seconds: float, order: Order | None = None) -> bool:
        end = self.clock.now() + round(seconds * SECOND)
        while self.clock.now() < end and not self.rig.daemon_ended:
            if condition():
                return True
            if order is not None and self.gate and not self.gate[-1].mode.active:
                await self.operator.order(order)
            await self.clock.sleep(0.02)
        return condition()

    # Witnesses

    @asynccontextmanager
    async def _witnesses(self) -> AsyncIterator[None]:
        device = self.scenario.device
        tasks = [
            asyncio.create_task(self._watch_truth()),
            asyncio.create_task(self.station.run()),
            asyncio.create_task(self._follow(topics.GATE, self.gate)),
            asyncio.create_task(self._follow(topics.HEALTH, self.health)),
            asyncio.create_task(self._follow(topics.EVENT, self.events)),
        ]
        if device is not None:
            tasks.append(asyncio.create_task(self._follow(SENSORS[device], self.samples)))
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)

    async def _watch_truth(self) -> None:
        while True:
            now = self.clock.now()
            state = self.rig.world.truth(now)
            self.truth.append((now, state.x, state.y, state.v))
            await self.clock.sleep_until(now + SAMPLE)

    async def _follow(self, topic: Topic[Any], kept: list[Any]) -> None:
        with self.rig.bus.subscribe(topic, fifo(ALL)) as mailbox:
            while True:
                kept.append(await mailbox.next())

    # Figures

    def _reaction(self, **more: Any) -> Reaction:
        stopped = self._gate_stops()
        bytes_at = None if self.stands else stop_bytes(self.wire, self.injected)
        still = self._standstill()
        return Reaction(
            fault=self.scenario.name,
            detected_after_s=self._since(min((t for t in (self._lost(), stopped and stopped[0]) if t), default=None)),
            stop_bytes_after_s=self._since(bytes_at),
            stop_bytes_after_sample_s=self._after_sample(bytes_at),
            standstill_after_s=self._since(still),
            metres=self._metres(still or self.healed),
            reason=stopped[1] if stopped else None,
            seen=self._seen(),
            down=self._down(),
            top_speed=self._fastest(self.injected, self.healed),
            healed_after_s=(self.healed - self.injected) / SECOND,
            resets=sum(control == Control.FAULT_RESET for control in self._controls()),
            collided=self.rig.world.truth(self.clock.now()).stuck,
            **more,
        )

    def _controls(self) -> list[int]:
        during = (row for row in written(self.wire, self.injected) if row[0] <= self.healed)
        return [value for _, index, value in during if index == od.CONTROLWORD.index]

    def _since(self, instant: int | None) -> float | None:
        return None if instant is None else (instant - self.injected) / SECOND

    def _gate_stops(self) -> tuple[int, Reason | None] | None:
        """When the gate stopped, and why; a limit of 0 is a stop too."""
        for state in self.gate:
            halted = state.mode is not GateMode.DRIVING or state.speed_limit == 0
            if state.stamp >= self.injected and halted:
                wanted = [reason for reason in self.scenario.seen[-1:] if reason in state.reasons]
                return state.stamp, next(iter((*wanted, *state.reasons)), None)
        return None

    def _lost(self) -> int | None:
        return next((table.stamp for table in self._tables() if _unready([table])), None)

    def _down(self) -> dict[str, tuple[Reason, ...]]:
        down: dict[str, dict[Reason, None]] = {}
        for row in _unready(self._tables()):
            if row.reason is not Reason.OK:
                down.setdefault(row.name, {})[row.reason] = None
        return {name: tuple(reasons) for name, reasons in down.items()}

    def _tables(self) -> list[HealthTable]:
        return [table for table in self.health if self.injected <= table.stamp <= self.healed]

    def _seen(self) -> tuple[Reason, ...]:
        told: list[tuple[int, tuple[Reason, ...]]] = [(event.stamp, (event.reason,)) for event in self.events]
        told += [(state.stamp, state.reasons) for state in self.gate]
        told.sort(key=lambda row: row[0])
        during = (reasons for stamp, reasons in told if self.injected <= stamp <= self.healed)
        return tuple(dict.fromkeys(reason for reasons in during for reason in reasons))

    def _after_sample(self, instant: int | None) -> float | None:
        good = [
            m.received
            for m in self.samples
            if instant is not None and m.received < instant and m.received - m.stamp < 0.4 * SECOND
        ]
        return (instant - good[-1]) / SECOND if instant is not None and good else None

    def _standstill(self) -> int | None:
        after = ((t, v) for t, _, _, v in self.truth if t >= self.injected and not self.stands)
        return next((t for t, v in after if abs(v) < AT_REST), None)

    def _metres(self, until: int) -> float:
        points = np.array([(x, y) for t, x, y, _ in self.truth if self.injected <= t <= until])
        return float(np.hypot(*np.diff(points, axis=0).T).sum()) if len(points) > 1 else 0.0

    def _fastest(self, since: int, until: int) -> float:
        return max((abs(v) for t, _, _, v in self.truth if since <= t <= until), default=0.0)


def _unready(tables: Iterable[HealthTable]) -> list[ServiceHealth]:
    return [row for table in tables for row in table.services if row.state is not ServiceState.READY]


async def measure(
    scenario: Scenario, config: SimulatedTruckConfig, clock: VirtualClock, driven: float = 3.0
) -> Reaction:
    """Run one scenario.

    Args:
        scenario: what to do.
        config: of the truck; recorder and map are left out unless the scenario's overlay has them.
        clock: of the running virtual loop.
        driven: seconds at speed before the fault; shifts it against the ticks and exchanges it meets.

    Raises:
        NoAnswerError: the truck did not come to drive in the first place.
    """
    plain = with_overlay(config, {"recorder": None, "map": None})
    rig = VirtualRig(with_overlay(plain, scenario.overlay), clock)
    drill = _Drill(scenario, rig, driven)
    reaction = None
    try:
        async with rig.running():
            reaction = await drill.run()
    except BaseExceptionGroup:
        if reaction is None or not reaction.exited:
            raise
    return reaction
