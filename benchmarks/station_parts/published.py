"""Publishes every topic a page shows at its nominal rate and size, as a daemon does, and answers a station's questions.

    python -m benchmarks.station_parts.published ENDPOINT [ROBOT [TIMES]]

Scans have 682 beams at 10 Hz, the map 400 x 400 cells at 2 Hz, pictures 20 kB at 15 Hz. Prints the delay of every
control request, ns from the moment its sender wrote into it. TIMES as fast, it sends the messages of as much more time.
"""

import asyncio
import sys
from functools import partial
from typing import Any

import numpy as np

from monstertruck_runtime.clock import SECOND, Clock, run_wall
from monstertruck_runtime.mailbox import fifo
from monstertruck_schemas import topics
from monstertruck_schemas.base import Message, Pose2D, Twist2D
from monstertruck_schemas.health import ServiceHealth, ServiceState
from monstertruck_schemas.roles import AccessRole
from monstertruck_schemas.sensor import BatteryLevel
from monstertruck_schemas.state import GateMode, Transform
from monstertruck_schemas.topics import Topic
from monstertruckd.bus.local import Bus
from monstertruckd.bus.rpc import Rpc
from monstertruckd.bus.zenoh_config import ZenohConfig
from monstertruckd.bus.zenoh_session import ZenohBridge

RNG = np.random.default_rng(1)
BEAMS, SIDE, PICTURE = 682, 400, 20_000
CONFIG = {
    "robot": "truck",
    "body": {"kind": "truck"},
    "geometry": {"wheelbase": 0.32, "track": 0.26, "wheel_radius": 0.075, "length": 0.47, "width": 0.34},
    "gate": {"speed": 0.21, "reverse_speed": 0.15, "angle": 0.436, "tilt": {}, "leases": {}},
    "devices": {},
}


def messages() -> dict[Topic[Any], tuple[float, dict[str, Any]]]:
    """Return rate and fields of each topic."""
    covariance = np.zeros(9)
    pose, twist = Pose2D(x=1.0, y=2.0, yaw=0.5), Twist2D(vx=0.1, vy=0.0, wz=0.0)
    odometry = {
        "pose": pose,
        "twist": twist,
        "pose_covariance": covariance,
        "twist_covariance": covariance,
        "age": 0.01,
    }
    row = Transform(parent="base", child="lidar", stamp=0, translation=(0.14, 0.0, 0.2), rotation=(0.0, 0.0, 0.0, 1.0))
    services = tuple(ServiceHealth(name=f"service {n}", state=ServiceState.READY, since=0) for n in range(16))
    return {
        topics.GATE: (10, {"mode": GateMode.DISARMED, "nonce": "n", "speed_limit": 0.0, "twist": twist}),
        topics.POSE: (50, {"frame": "map", **odometry}),
        topics.ODOMETRY: (50, {"frame": "odom", **odometry}),
        topics.TRANSFORMS: (10, {"transforms": (row,)}),
        topics.SCAN: (
            10,
            {
                "frame": "lidar",
                "start_angle": -2.09,
                "end_angle": 2.09,
                "time_increment": 1e-4,
                "scan_time": 0.1,
                "range_min": 0.02,
                "range_max": 5.6,
                "ranges": RNG.uniform(0.1, 5.5, BEAMS),
                "codes": np.full(BEAMS, 255, np.uint8),
            },
        ),
        topics.MAP: (
            2,
            {
                "frame": "map",
                "resolution": 0.05,
                "width": SIDE,
                "height": SIDE,
                "origin": Pose2D(x=-10.0, y=-10.0, yaw=0.0),
                "cells": world(),
            },
        ),
        topics.COMPASS: (20, {"heading": 1.0, "roll": 0.0, "pitch": 0.0}),
        topics.BATTERY: (10, {"voltage": 24.5, "raw_voltage": 24.5, "cells": 6, "level": BatteryLevel.NORMAL}),
        topics.HEALTH: (1, {"services": services}),
        topics.CAMERA: (15, {"data": RNG.bytes(PICTURE), "sequence": 1}),
    }


def world() -> np.ndarray:
    """Return map cells as drawn by SLAM: rooms with walls, free floor of varied certainty, and unknown cells."""
    cells = np.full((SIDE, SIDE), -1, np.int8)
    cells[60:340, 60:340] = RNG.integers(0, 12, (280, 280))
    cells[60:340:70, 60:340] = cells[60:340, 60:340:70] = 95
    return cells.ravel()


async def main(zenoh: ZenohConfig, robot: str, clock: Clock, times: float = 1.0) -> None:
    """Publish until cancelled."""
    bus, rpc = Bus(clock), Rpc(clock)

    async def answer(value: dict[str, Any], _: dict[str, Any]) -> dict[str, Any]:
        return value

    rpc.register("config", partial(answer, CONFIG | {"robot": robot}), AccessRole.OBSERVER)
    rpc.register("versions", partial(answer, {"monstertruckd": "0.1.0"}), AccessRole.OBSERVER)
    bridge = ZenohBridge(robot, bus, zenoh, clock, rpc)
    await bridge.open()
    control = bus.subscribe(topics.REQ_CONTROL, fifo(1024))
    jobs: list[Any] = [publish(bus, clock, topic, times * rate, fields) for topic, (rate, fields) in messages().items()]
    print("ready", flush=True)
    await asyncio.gather(bridge.run(lambda: None), report(control, clock), *jobs)


async def publish(bus: Bus, clock: Clock, topic: Topic[Message], rate: float, fields: dict[str, Any]) -> None:
    """Publish one topic, with current stamps."""
    number = 0
    due = clock.now()
    while True:
        now = clock.now()
        bus.hand_over(topic, topic.model(stamp=now, received=now, seq=number, **fields))
        number += 1
        due += round(SECOND / rate)
        await clock.sleep(max((due - clock.now()) / SECOND, 0.0))


async def report(control: Any, clock: Clock) -> None:
    """Print the delays of control requests; both ends read the same monotonic clock."""
    async for request in control:
        print(clock.now() - request.stamp, flush=True)


if __name__ == "__main__":
    _, endpoint, robot, times = [*sys.argv, *("truck", "1")[len(sys.argv) - 2 :]]
    config = ZenohConfig(listen=(endpoint,))
    run_wall(lambda clock: main(config, robot, clock, float(times)))
