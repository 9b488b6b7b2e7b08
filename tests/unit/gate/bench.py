"""A gate service with every sensor alive, on the virtual clock."""

import asyncio
from collections import deque
from contextlib import asynccontextmanager

from monstertruck_runtime.clock import run_virtual
from monstertruck_runtime.threads import in_thread, inline
from monstertruck_schemas import topics
from monstertruck_schemas.req import ControlRequest, DriveRequest, Role
from monstertruckd.gate.latch import MemoryLatch
from monstertruckd.gate.service import GateOutputs, GateService
from tests.unit.gate.rig import NONCE, attitude, battery, feedback, header, health, make_gate, scan, servos


class Inbox:
    """Both deliveries at once: newest message and a FIFO."""

    def __init__(self):
        self.latest = None
        self.drops = 0
        self._queue = asyncio.Queue()

    def send(self, message):
        self.latest = message
        self._queue.put_nowait(message)

    async def next(self):
        return await self._queue.get()


class Outbox:
    def __init__(self):
        self.messages = deque()

    def next_seq(self):
        return len(self.messages)

    def put(self, message):
        self.messages.append(message)

    @property
    def last(self):
        return self.messages[-1]


class Bench:
    """A gate service with every sensor alive."""

    def __init__(self, clock, latch=None, state=None, offload=in_thread):
        self.clock = clock
        self.latch = latch or MemoryLatch()
        self.scan, self.attitude, self.drive, self.steering, self.battery = (Inbox() for _ in range(5))
        self.out = GateOutputs((Outbox(),), Outbox(), state or Outbox(), Outbox(), Outbox())
        self.events = []
        self.readies = 0
        self.speed = 0.0
        inputs = {
            topics.SCAN: self.scan,
            topics.COMPASS: self.attitude,
            topics.DRIVE: self.drive,
            topics.STEERING: self.steering,
            topics.BATTERY: self.battery,
        }
        gate = make_gate(self.latch.engaged())
        self.boxes = []
        self.service = GateService(
            gate, 50, clock, inputs, self.out, self.note, self.latch, black_box=self.keep, offload=offload
        )

    def note(self, reason, severity, source, text="", **values):
        self.events.append((reason, source, text, values))

    def keep(self, trip):
        self.boxes.append(trip.reason)
        return f"box-{trip.number}"

    def ready(self):
        self.readies += 1

    async def sense(self):
        while True:
            now = self.clock.now()
            self.scan.send(scan(now))
            self.attitude.send(attitude(now))
            self.drive.send(feedback(now, self.speed))
            self.steering.send(servos(now))
            self.battery.send(battery(now))
            self.service.observe_health(health(now))
            await self.clock.sleep(0.05)

    def order(self, order):
        now = self.clock.now()
        return self.service.control(
            ControlRequest(
                **header(now, len(self.events) + now),
                source="ann",
                role=Role.STATION,
                lease=1,
                nonce=NONCE,
                gate_stamp=now,
                order=order,
            )
        )

    def ask(self, take, role):
        now = self.clock.now()
        return take(
            DriveRequest(
                **header(now, now),
                source=role.value,
                role=role,
                lease=1,
                nonce=NONCE,
                gate_stamp=now,
                speed=0.1,
                front=0.1,
            )
        )

    @asynccontextmanager
    async def running(self):
        tasks = [asyncio.create_task(self.service.run(self.ready)), asyncio.create_task(self.sense())]
        await self.clock.sleep(0.1)
        yield
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await self.service.close()


def on_bench(scenario, latch=None, offload=inline):
    """Run a scenario on the virtual clock, whose time runs on while a thread works: nothing is given to one."""

    async def main(clock):
        bench = Bench(clock, latch, offload=offload)
        async with bench.running():
            await scenario(bench)
        return bench

    return run_virtual(main)
