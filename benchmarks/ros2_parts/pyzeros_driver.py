"""Drives with ``pyzeros``: twists at 20 Hz, each with a unique speed that identifies it.

    python benchmarks/ros2_parts/pyzeros_driver.py PORT COUNT

Prints ``ready``, waits for a line, sends, and prints a JSON list of speed (m/s) and time of sending (ns since 1970).
"""

import asyncio
import json
import sys
import time

import pyzeros
import zenoh
from ros2_pyterfaces.cyclone.all_msgs import Twist, Vector3

FIRST = 0.05
STEP = 1e-6


def session(port: int, timeout: int = 10_000) -> zenoh.Session:
    """Return a session connected to the face; ``timeout`` is that of service calls, ms."""
    config = {
        "mode": "client",
        "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"]},
        "scouting": {"multicast": {"enabled": False}},
        "timestamping": {"enabled": True},
        "queries_default_timeout": timeout,
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


async def main(port: int, count: int) -> None:
    """Send and report."""
    sent = []
    with pyzeros.auto_context(node="pyzeros_driver", zenoh_session=session(port)):
        publisher = pyzeros.Pub(Twist, "/cmd_vel")
        publisher.publish(Twist(linear=Vector3(x=0.0, y=0.0, z=0.0), angular=Vector3(x=0.0, y=0.0, z=0.0)))  # compiles
        print("ready", flush=True)
        await asyncio.to_thread(sys.stdin.readline)
        for number in range(count):
            speed = FIRST + number * STEP
            message = Twist(linear=Vector3(x=speed, y=0.0, z=0.0), angular=Vector3(x=0.0, y=0.0, z=0.0))
            sent.append((speed, time.time_ns()))
            publisher.publish(message)
            await asyncio.sleep(0.05)
        await asyncio.sleep(2.0)
    print(json.dumps(sent), flush=True)


if __name__ == "__main__":
    asyncio.run(main(int(sys.argv[1]), int(sys.argv[2])))
