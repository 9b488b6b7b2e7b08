"""Clients that are not ours at an emulated RPLIDAR, over a pty: what each of them measures."""

import asyncio
import contextlib
import io
import json
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from unittest import mock

import numpy as np
import pyrplidar
import rplidar
import rplidarc1
import serial
from numpy.typing import NDArray

from monstertruck_drivers.cable import PtyPort
from monstertruck_drivers.rplidar.emulator import RplidarEmulator
from monstertruck_drivers.rplidar.protocol import MODELS
from monstertruck_runtime.clock import WallClock
from tests.unit.drivers.scanning.kit import Room

Points = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Angles, rad, clockwise, and ranges, m, of returns; each (n,)."""
SPUN_UP = 3.0
"""Seconds after which a client's samples count."""


def _points(rows: list[tuple[float, float]]) -> Points:
    angles, millimetres = np.array([row for row in rows if row[1] > 0.0]).T
    return np.radians(angles), millimetres / 1000.0


def roboticia(port: str, baud: int, mode: str) -> Points:
    """Client rplidar-roboticia (MIT licence), modes normal and express."""
    client = rplidar.RPLidar(port, baud)
    try:
        time.sleep(1.0)
        client.clean_input()
        assert client.get_health()[0] == "Good"
        assert client.get_info()["hardware"] == 7
        until = time.monotonic() + SPUN_UP
        measures = client.iter_measures(mode, max_buf_meas=False)
        while time.monotonic() < until:
            next(measures)
        return _points([(angle, far) for _, _, angle, far in islice(measures, 3000)])
    finally:
        client.stop()
        client.stop_motor()
        client.disconnect()


def pyrplidar_points(port: str, baud: int, mode: str) -> Points:
    """Client pyrplidar (MIT licence), by the number of the mode."""
    client = pyrplidar.PyRPlidar()
    with contextlib.redirect_stdout(io.StringIO()):
        client.connect(port, baud, 3)
        try:
            time.sleep(1.0)
            client.lidar_serial._serial.reset_input_buffer()
            assert client.get_health().status == 0
            assert client.get_info().hardware == 7
            client.set_motor_pwm(660)
            number = int(mode)
            samples = (client.start_scan_express(number) if number else client.force_scan())()
            until = time.monotonic() + SPUN_UP
            while time.monotonic() < until:
                next(samples)
            return _points([(sample.angle, sample.distance) for sample in islice(samples, 3000)])
        finally:
            client.stop()
            client.set_motor_pwm(0)
            client.disconnect()


def c1(port: str, baud: int, _mode: str) -> Points:
    """Client rplidarc1 (MIT licence)."""

    async def listen() -> list[tuple[float, float]]:
        client = rplidarc1.RPLidar(port, baud)
        rows: list[tuple[float, float]] = []
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(client.simple_scan())
                until = time.monotonic() + SPUN_UP
                while len(rows) < 2000:
                    sample = await client.output_queue.get()
                    if time.monotonic() > until:
                        rows.append((sample["a_deg"], sample["d_mm"] or 0.0))
                client.stop_event.set()
        finally:
            client.shutdown()
        return rows

    time.sleep(1.0)
    return _points(asyncio.run(listen()))


def maker(port: str, baud: int, _mode: str) -> Points:
    """The maker's own library, in its typical mode."""
    time.sleep(1.0)
    script = Path(__file__).with_name("maker_client.py")
    done = subprocess.run(
        [sys.executable, script, port, str(baud), str(SPUN_UP)], capture_output=True, text=True, timeout=30, check=True
    )
    angles, ranges = (np.array(values) for values in json.loads(done.stdout.splitlines()[-1]))
    return angles[ranges > 0], ranges[ranges > 0]


Client = Callable[[str, int, str], Points]
USES: tuple[tuple[str, Client, str, str], ...] = (
    ("a1", roboticia, "normal", "rplidar-roboticia standard"),
    ("a1", pyrplidar_points, "0", "pyrplidar standard"),
    ("a1", pyrplidar_points, "1", "pyrplidar express"),
    ("a2", pyrplidar_points, "2", "pyrplidar ultra"),
    ("c1", c1, "", "rplidarc1 standard"),
    ("a1", maker, "", "pyrplidarsdk express"),
    ("a3", maker, "", "pyrplidarsdk ultra"),
    ("c1", maker, "", "pyrplidarsdk standard"),
    ("s2", maker, "", "pyrplidarsdk dense"),
)
"""Model, client, mode, name. rplidarc1 reads angles with the check bit, up to 2 degrees off. Left out: roboticia's
express (it places samples one too far), pyrplidar's dense (it swaps the bytes of distances)."""


async def measured(folder: Path, model: str, client: Client, mode: str) -> Points:
    """What a client measures in the room."""
    sheet = MODELS[model]
    port, emulator = PtyPort(folder / "lidar"), RplidarEmulator(WallClock(), Room(), sheet)
    running = asyncio.create_task(emulator.run(port.device))
    await asyncio.sleep(0)
    port.plug()
    no_lines = {"_update_dtr_state": mock.DEFAULT, "_update_rts_state": mock.DEFAULT}  # a pty has neither
    try:
        async with asyncio.timeout(45):
            with mock.patch.multiple(serial.Serial, **no_lines):
                return await asyncio.to_thread(client, port.name, sheet.baud, mode)
    finally:
        port.unplug()
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running


def steps_off(points: Points, step: float) -> NDArray[np.float64]:
    """By how many steps of ``step`` rad the ends of beams lie beside the room's walls, at least."""
    angles, ranges = points
    half, best = Room().half, np.full(len(ranges), np.inf)
    for steps in np.linspace(-3.0, 3.0, 121):
        ways = -angles + steps * step
        true = half / np.maximum(np.abs(np.cos(ways)), np.abs(np.sin(ways)))
        best = np.where(np.abs(true - ranges) < 0.006, np.minimum(best, abs(steps)), best)
    return best
