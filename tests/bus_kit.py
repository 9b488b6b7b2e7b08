"""A bus with a real Zenoh bridge on a free port, for tests of both ends."""

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from monstertruck_runtime.clock import WallClock
from monstertruck_runtime.mailbox import Mailbox, fifo
from monstertruck_schemas.base import Pose2D, Twist2D
from monstertruck_schemas.event import Event
from monstertruck_schemas.state import GateMode, GateState, Odometry
from monstertruck_schemas.topics import EVENT
from monstertruckd.bus.local import Bus
from monstertruckd.bus.rpc import Rpc
from monstertruckd.bus.zenoh_config import ZenohConfig
from monstertruckd.bus.zenoh_session import ZenohBridge


def free_endpoint(protocol: str = "tcp") -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"{protocol}/127.0.0.1:{probe.getsockname()[1]}"


@dataclass
class Robot:
    bus: Bus
    rpc: Rpc
    bridge: ZenohBridge
    endpoint: str
    events: Mailbox[Event]


@asynccontextmanager
async def running_robot(
    endpoint: str | None = None, *, robot: str = "truck", deadline: float = 0.3, stand: bool = False, **config: object
) -> AsyncIterator[Robot]:
    """A bridge that is ready; cancelled and awaited at the end. Calls may take ``deadline`` seconds."""
    endpoint = endpoint or free_endpoint()
    clock = WallClock()
    settings = ZenohConfig(**{"gather_seconds": 0.0, "listen": (endpoint,), **config})
    bus = Bus(clock, settings.gather_seconds)
    rpc = Rpc(clock, deadline=deadline)
    bridge = ZenohBridge(robot, bus, settings, clock, rpc, stand=stand)
    ready = asyncio.Event()
    events = bus.subscribe(EVENT, fifo(100))
    task = asyncio.create_task(bridge.run(ready.set))
    waiter = asyncio.create_task(ready.wait())
    try:
        await asyncio.wait([task, waiter], return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            await task
        yield Robot(bus, rpc, bridge, endpoint, events)
    finally:
        waiter.cancel()
        task.cancel()
        await asyncio.wait([task, waiter])


def odometry(seq: int, x: float = 0.0) -> Odometry:
    return Odometry(
        stamp=seq * 1000,
        received=seq * 1000,
        seq=seq,
        frame="map",
        pose=Pose2D(x=x, y=2.0, yaw=0.0),
        twist=Twist2D(vx=0.0, vy=0.0, wz=0.0),
        pose_covariance=[0.0] * 9,
        twist_covariance=[0.0] * 9,
        age=0.0,
    )


def gate_state(seq: int, nonce: str = "n0", **fields: object) -> GateState:
    return GateState(stamp=seq, received=seq, seq=seq, mode=GateMode.ARMED, nonce=nonce, speed_limit=1.0, **fields)
