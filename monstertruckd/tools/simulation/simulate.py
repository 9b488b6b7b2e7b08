"""``monstertruckd simulate``: the emulated robot as a process, its devices behind ptys."""

import asyncio
import signal
import sys
from array import array
from collections.abc import Iterator
from contextlib import AsyncExitStack, ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from monstertruck_drivers.cable import EmulatedPort, PtyPort
from monstertruck_drivers.config import Monitors, PortConfig
from monstertruck_drivers.hokuyo_urg.recording import RecordedHokuyoEmulator
from monstertruck_kinematics.elementary import Array
from monstertruck_runtime.client import TruckClient
from monstertruck_runtime.clock import SECOND, Clock
from monstertruck_runtime.endpoints import DEFAULT_ENDPOINT
from monstertruck_runtime.errors import InputError, NotFoundError
from monstertruck_runtime.memory import settle
from monstertruck_sim.computer import EmulatedComputer, hangs_by_hub
from monstertruck_sim.console import Commanded, Emulated, EmulatedFiles, FaultConsole
from monstertruck_sim.faults import FaultInjector, SimContext
from monstertruck_sim.robot import SimulatedRobot
from monstertruck_sim.stand import SimulatedStand
from monstertruck_sim.world.world import World
from monstertruckd.tools.simulation.config import SimulatedTruckConfig
from monstertruckd.tools.simulation.ports import claimed
from monstertruckd.tools.simulation.program import program

TRUTH_PERIOD = SECOND // 20
STAND_RETRY = 1.0
"""Seconds between two looks for a daemon."""


class TruthLog:
    """True state of the simulated truck, 20 times a second; for evaluation, never for the daemon."""

    COLUMNS = ("time", "x", "y", "yaw", "speed", "stuck")

    def __init__(self, world: World, clock: Clock) -> None:
        self._world = world
        self._clock = clock
        self._samples = array("d")

    async def run(self) -> None:
        """Sample until cancelled."""
        due = self._clock.now()
        while True:
            now = self._clock.now()
            state = self._world.truth(now)
            self._samples.extend((now / SECOND, state.x, state.y, state.yaw, state.v, float(state.stuck)))
            due += TRUTH_PERIOD
            await self._clock.sleep_until(due)

    def array(self) -> Array:
        """Shape (n, 6): ``COLUMNS``, s, m, m, rad, m/s, 0 or 1."""
        return np.array(self._samples).reshape(-1, len(self.COLUMNS))


async def serve(
    clock: Clock, config: SimulatedTruckConfig, truth: Path | None = None, daemon_of: Path | None = None
) -> int:
    """Serve the devices of ``config`` behind ptys at their configured ports until SIGTERM or SIGINT.

    Faults are read from standard input, each line beginning with the device's role, the monitor's name, or ``usb``.

    Args:
        clock: time.
        config: the truck.
        truth: file of what really happened.
        daemon_of: configuration of a daemon that is run meanwhile: stopped before the devices go, and when it ends by
            itself they go, too.

    Returns:
        The daemon's exit code if it ended by itself, else 0.

    Raises:
        NotPermittedError: this user may not make a port there.
        InputError: ``machine`` names an existing file or folder instead of a link to the emulated computer, or so does
            a port.
        BusyError: another program serves one of the ports.
        OSError: a port cannot be made.
    """
    links = [it.port.path for it in config.devices.present().values() if isinstance(it.port, PortConfig)]
    with ExitStack() as stack:
        stack.enter_context(claimed(*links))
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="monstertruck-")))
        stack.enter_context(_linked(config, folder))
        return await _serve(clock, config, folder, truth, daemon_of)


@contextmanager
def _linked(config: SimulatedTruckConfig, folder: Path) -> Iterator[None]:
    """Link ``machine`` to the folder of the emulated computer, where the daemon needs one."""
    if not hangs_by_hub(config.devices) and config.monitors == Monitors():
        yield
        return
    link = config.machine
    if link.exists() and not link.is_symlink():
        raise InputError(f"machine: {link} exists: expected the name of a link to be made to the emulated computer")
    with claimed(link):
        link.unlink(missing_ok=True)
        link.symlink_to(folder, target_is_directory=True)
        try:
            yield
        finally:
            link.unlink(missing_ok=True)


async def _serve(
    clock: Clock, config: SimulatedTruckConfig, folder: Path, truth: Path | None, daemon_of: Path | None
) -> int:
    devices = config.devices.present()
    cables: dict[str, EmulatedPort] = {}
    for role, device in devices.items():
        path = device.port.path if isinstance(device.port, PortConfig) else folder / "cables" / role
        path.parent.mkdir(parents=True, exist_ok=True)
        cables[role] = PtyPort(path)
    computer = EmulatedComputer(folder, config.devices, cables, clock)
    robot = SimulatedRobot(config.sim, config.devices, config.monitors, clock, computer.ports, folder)
    robot.world.scene.on_contact = lambda contact: _say(str(contact))
    log = TruthLog(robot.world, clock)
    emulated: dict[str, Commanded] = {role: Emulated(robot.emulators[role], robot.ports[role]) for role in devices}
    emulated |= {name: EmulatedFiles(files) for name, files in robot.monitored.items()}
    emulated["usb"] = computer
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    tasks: list[asyncio.Task[Any]] = [
        asyncio.create_task(robot.run(), name="robot"),
        asyncio.create_task(log.run(), name="truth"),
        asyncio.create_task(FaultConsole(emulated, sys.stdin, _say).run(), name="console"),
    ]
    if config.stand == "simulator":
        tasks.append(asyncio.create_task(_see(clock, config, robot.world), name="stand"))
    if config.sim.drill is not None:
        context = SimContext(config.sim, config.devices, robot, computer, clock)
        tasks.append(asyncio.create_task(FaultInjector(context, config.sim.drill, _say).run(), name="faults"))
    if robot.recorded is not None:
        tasks.append(asyncio.create_task(_report_end(robot.recorded), name="recording"))
    waiting = asyncio.create_task(stop.wait())
    settle()
    _say("ready")
    async with AsyncExitStack() as stack:
        code = None
        if daemon_of is not None:
            daemon = await stack.enter_async_context(program(None, "run", "--config", str(daemon_of)))
            tasks.append(code := asyncio.create_task(daemon.wait(), name="daemon"))
        await asyncio.wait([waiting, *tasks], return_when=asyncio.FIRST_COMPLETED)
        ended_by = code.result() if code is not None and code.done() else 0
    for task in (waiting, *tasks):
        task.cancel()
    results = await asyncio.gather(*tasks, return_exceptions=True)
    if truth is not None:
        np.savez(truth, truth=log.array())
    for result in results:
        if isinstance(result, Exception):
            raise result
    return ended_by


async def _see(clock: Clock, config: SimulatedTruckConfig, world: World) -> None:
    """Say where the robot really is, whenever there is a daemon."""
    endpoint = next(iter(config.zenoh.listen), DEFAULT_ENDPOINT)
    while True:
        try:
            async with TruckClient(config.robot, endpoint, clock=clock) as client:
                seed = config.sim.seed if config.sim.world.noise else None
                await SimulatedStand(config.sim.stand, world, clock, client.publish_stand_pose, seed).run()
        except NotFoundError:
            await clock.sleep(STAND_RETRY)


async def _report_end(recorded: RecordedHokuyoEmulator) -> None:
    await recorded.finished.wait()
    _say(f"recording sent, began {recorded.began}")
    await asyncio.Event().wait()


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
