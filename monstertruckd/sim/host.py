"""The emulated robot as a process of its own: devices behind ptys, world truth kept for the judges."""

import asyncio
import gc
import signal
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from monstertruck_drivers.hokuyo_urg.recording import RecordedHokuyoEmulator
from monstertruck_drivers.pty_port import PtyPort
from monstertruck_drivers.world.world import World
from monstertruck_runtime.clock import SECOND, Clock
from monstertruckd.config.validate import load_config
from monstertruckd.sim.config import SimulatedTruckConfig
from monstertruckd.sim.console import Emulated, FaultConsole
from monstertruckd.sim.robot import SimulatedRobot

TRUTH_PERIOD = SECOND // 20


class TruthLog:
    """What really happened, sampled on an absolute schedule; for judges only, never for the daemon."""

    COLUMNS = ("time", "x", "y", "yaw", "speed", "stuck")

    def __init__(self, world: World, clock: Clock) -> None:
        self._world = world
        self._clock = clock
        self._rows: list[tuple[float, ...]] = []

    async def run(self) -> None:
        """Sample until cancelled."""
        due = self._clock.now()
        while True:
            now = self._clock.now()
            state = self._world.truth(now)
            self._rows.append((now / SECOND, state.x, state.y, state.yaw, state.v, float(state.stuck)))
            due += TRUTH_PERIOD
            await self._clock.sleep_until(due)

    def array(self) -> NDArray[np.float64]:
        """Shape (n, 6): ``COLUMNS``, s, m, m, rad, m/s, 0 or 1."""
        return np.array(self._rows).reshape(-1, len(self.COLUMNS))


async def serve(clock: Clock, config_file: Path, truth: Path | None) -> None:
    """Serve the devices of ``config_file`` behind ptys at their configured paths until SIGTERM or SIGINT.

    Faults are read from standard input, each line beginning with the device's role.
    """
    config, _ = load_config(config_file, SimulatedTruckConfig)
    devices = config.devices.present()
    ports = {role: PtyPort(device.port.path) for role, device in devices.items()}
    for device in devices.values():
        device.port.path.parent.mkdir(parents=True, exist_ok=True)
    robot = SimulatedRobot(config.sim, config.devices, clock, ports)
    log = TruthLog(robot.world, clock)
    emulated = {role: Emulated(robot.emulators[role], ports[role]) for role in devices}
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    tasks = [
        asyncio.create_task(robot.run(), name="robot"),
        asyncio.create_task(log.run(), name="truth"),
        asyncio.create_task(FaultConsole(emulated, sys.stdin, _say).run(), name="console"),
    ]
    if robot.recorded is not None:
        tasks.append(asyncio.create_task(_tell_end(robot.recorded), name="recording"))
    waiting = asyncio.create_task(stop.wait())
    gc.collect()
    gc.freeze()
    _say("ready")
    await asyncio.wait([waiting, *tasks], return_when=asyncio.FIRST_COMPLETED)
    for task in (waiting, *tasks):
        task.cancel()
    results = await asyncio.gather(*tasks, return_exceptions=True)
    if truth is not None:
        np.savez(truth, truth=log.array())
    for result in results:
        if isinstance(result, Exception):
            raise result


async def _tell_end(recorded: RecordedHokuyoEmulator) -> None:
    await recorded.finished.wait()
    _say(f"recording sent, began {recorded.began}")
    await asyncio.Event().wait()


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
